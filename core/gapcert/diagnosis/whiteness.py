"""Is a residual noise? The colour of noise is learnt from short windows; longer ones must then look as it predicts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from scipy.optimize import nnls
from scipy.signal import lfilter

from gapcert.diagnosis.tangent import Tangent
from gapcert.system import Array

COLOURS = (0.0, 0.15, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95)  # correlation of neighbouring samples
LAGS = 30
PURE = 1.0  # standard deviations more, where a mixture of colours could excuse what one colour does not
DRAWS, WARM = 100, 200
CLEAR = 1.05  # least excess that is worth a simulation of its spread


@final
@dataclass(frozen=True)
class Growth:
    """How much more is left in long windows than stationary noise with the colour of short ones would leave there.

    A missing force adds up over a window; noise, coloured or not, does not. chi_long, chi_short: mean squares in units of the
    white noise floor; growth = chi_long/max(chi_short, 1); beyond (ny,): measured over predicted mean square of the long
    windows; sigmas: of the largest log(beyond), in standard deviations of that noise; excess (ny,): the part of the mean square
    that the noise does not explain.
    """

    chi_long: float
    chi_short: float
    beyond: Array
    sigmas: float
    excess: Array

    @property
    def growth(self) -> float:
        return self.chi_long / max(self.chi_short, 1.0)


def growth(long: Tangent, short: Tangent, seed: int = 0) -> Growth:
    """Noise is independent per channel: of one colour, or, with more standard deviations asked for, any mixture of colours.

    Its spread comes from simulated logs.
    """
    expected = _Expected.of(short, long)
    r_short, r_long = (_channels(m, m.residual) for m in (short, long))
    found = {}
    for model in (expected.mixture, expected.single):
        variances = model(r_short)
        beyond, sigmas = expected.beyond(variances, r_long), 0.0
        if beyond.max() > CLEAR:
            pairs = _simulated(variances, short, long, seed)
            drawn = np.log([expected.beyond(model(a), b) for a, b in pairs])
            sigmas = float(np.max((np.log(beyond) - drawn.mean(axis=0)) / np.maximum(drawn.std(axis=0), 1e-9)))
        found[model.__name__] = beyond, sigmas
    beyond, sigmas = found["mixture"]
    if found["single"][1] - PURE > sigmas:
        beyond, sigmas = found["single"][0], found["single"][1] - PURE
    chi = np.mean(r_long**2, axis=(0, 1))
    excess = np.maximum(chi * (1 - 1 / np.maximum(beyond, 1e-300)), 0.0)
    return Growth(float(chi.mean()), float(np.mean(r_short**2)), beyond, sigmas, excess)


def noise(long: Tangent, short: Tangent, seed: int = 0) -> tuple[Array, Array]:
    """Residuals (DRAWS, W, L, ny) of long windows in noise of the colour of short ones: of one colour, and of any mixture."""
    expected, r = _Expected.of(short, long), _channels(short, short.residual)
    drawn = [[b for _, b in _simulated(model(r), short, long, seed)] for model in (expected.single, expected.mixture)]
    return np.stack(drawn[0]), np.stack(drawn[1])


@final
@dataclass(frozen=True)
class _Expected:
    """Sums that unit noise of each channel and colour would give: short (lags, ny, ny, J), long (ny, ny, J)."""

    short: Array
    long: Array

    @classmethod
    def of(cls, short: Tangent, long: Tangent) -> _Expected:
        lags = min(LAGS, short.windows.length // 2)
        return cls(_sums(short, lags), _sums(long, 0)[0])

    def mixture(self, residual: Array) -> Array:
        """Variances (ny, J) ≥ 0 whose projected autocovariance is nearest to that of the residual (W, L, ny)."""
        sums = _autocovariance(residual, len(self.short) - 1)
        size = np.maximum(sums[0], 1e-100)  # its inverse has a square
        return _nearest((self.short / size[None, :, None, None]).reshape(sums.size, -1), sums / size).reshape(len(size), -1)

    def single(self, residual: Array) -> Array:
        """The same, each channel of one colour: two neighbouring ones of the list at most."""
        sums = _autocovariance(residual, len(self.short) - 1)
        out = np.zeros(self.long.shape[1:])
        for c, own in enumerate(sums.T):
            best = np.inf
            for j in range(len(COLOURS) - 1):
                columns = self.short[:, c, c, j : j + 2]
                pair = _nearest(columns, own)
                if (left := float(np.sum((columns @ pair - own) ** 2))) < best:
                    best, out[c] = left, 0.0
                    out[c, j : j + 2] = pair
        return out

    def beyond(self, variances: Array, long: Array) -> Array:
        predicted = np.einsum("cdj,dj->c", self.long, variances)
        # Of a channel that is met exactly both are zero.
        return np.asarray(np.maximum(np.sum(long**2, axis=(0, 1)), 1e-300) / np.maximum(predicted, 1e-300))


def _nearest(matrix: Array, values: Array) -> Array:
    """x ≥ 0 with the least |matrix x − values|."""
    scale = np.linalg.norm(matrix, axis=0) + 1e-300
    return np.asarray(nnls(matrix / scale, values.ravel())[0] / scale)


def _channels(motion: Tangent, rows: Array) -> Array:
    return rows.reshape(motion.windows.y.shape)


def _autocovariance(r: Array, lags: int) -> Array:
    """Sums over windows and times, (lags + 1, ny)."""
    length = r.shape[1]
    r = np.ascontiguousarray(r.transpose(2, 0, 1))
    return np.stack([np.einsum("cwt,cwt->c", r[..., : length - k], r[..., k:]) for k in range(lags + 1)])


def _sums(motion: Tangent, lags: int) -> Array:
    """Expected lagged sums of P ε per unit of each noise: P Γ P = Γ − QQᵀΓ − ΓQQᵀ + Q(QᵀΓQ)Qᵀ, (lags + 1, ny, ny, J)."""
    w, length, ny = motion.windows.y.shape
    basis = motion.free.reshape(w, length, ny, -1)
    size = 2 * length
    waves = _waves(basis, size)
    gap = np.abs(np.subtract.outer(np.arange(length), np.arange(length)))
    out = np.zeros((lags + 1, ny, ny, len(COLOURS)))

    def lagged(own: Array, other: Array) -> Array:
        """Σ own[t, i]·other[t + k, i] from the waves (W, 2, f, ..., i) of both, the mean over k and −k, (lags + 1, ...)."""
        # Of the spectrum that mean needs the real part alone.
        return np.fft.irfft(np.einsum("wzf...i,wzf...i->f...", own, other), size, axis=0)[: lags + 1]

    for j, colour in enumerate(COLOURS):
        cover = colour**gap
        for d in range(ny):
            passed = cover @ basis[:, :, d]
            inner = np.swapaxes(passed, 1, 2) @ basis[:, :, d]
            moved = (waves.reshape(w, -1, inner.shape[1]) @ inner).reshape(waves.shape)
            out[:, :, d, j] = lagged(waves, moved)
            out[:, d, d, j] -= 2 * lagged(waves[..., d, :], _waves(passed, size))
            out[:, d, d, j] += w * (length - np.arange(lags + 1)) * colour ** np.arange(lags + 1)
    return out


def _waves(a: Array, size: int) -> Array:
    """Real and imaginary parts (W, 2, f, ...) of signals (W, L, ...)."""
    waves = np.fft.rfft(a, size, axis=1)
    return np.stack([waves.real, waves.imag], axis=1)


def _simulated(variances: Array, short: Tangent, long: Tangent, seed: int) -> list[tuple[Array, Array]]:
    """Residuals (short, long) that logs of nothing but this noise would leave."""
    rng, ny = np.random.default_rng(seed), short.windows.y.shape[2]
    counts = [len(m.windows) * m.windows.length for m in (short, long)]
    pairs = []
    for _ in range(DRAWS):
        noise = np.zeros((WARM + max(counts), ny))
        for (d, j), variance in np.ndenumerate(variances):
            if variance > 0:
                fresh = rng.standard_normal(len(noise)) * np.sqrt(variance * (1 - COLOURS[j] ** 2))
                noise[:, d] += lfilter([1.0], [1.0, -COLOURS[j]], fresh)
        rows = [noise[WARM : WARM + n].reshape(len(m.windows), -1) for m, n in zip((short, long), counts, strict=True)]
        pairs.append((_channels(short, short.project(rows[0])), _channels(long, long.project(rows[1]))))
    return pairs
