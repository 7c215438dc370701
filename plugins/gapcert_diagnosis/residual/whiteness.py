"""Is a residual noise? The colour of noise is learnt from short windows; longer ones must then look as it predicts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import final

import numpy as np
from scipy.optimize import nnls
from scipy.signal import lfilter

from gapcert.plugin import Array
from gapcert_diagnosis.fitting.linearised import Tangent
from gapcert_diagnosis.thresholds import THRESHOLDS

AT_ONCE = 10  # draws, or windows: what memory holds


@final
@dataclass(frozen=True)
class Growth:
    """How much more is left in long windows than stationary noise with the colour of short ones would leave there.

    A missing force adds up over a window; noise, coloured or not, does not. chi_long, chi_short: mean squares in units of the
    white noise floor; beyond (ny,): measured over predicted mean square of the long windows; sigmas: of the largest
    log(beyond), in standard deviations of that noise; excess (ny,): the part of the mean square that noise does not explain.
    """

    chi_long: float
    chi_short: float
    beyond: Array
    sigmas: float
    excess: Array


def growth(long: Tangent, short: Tangent, seed: int = 0) -> Growth:
    """Noise is independent per channel: of one colour, or, with more standard deviations asked for, any mixture of colours.

    Its spread comes from simulated logs.
    """
    expected = _Expected.of(short, long)
    sums, squares = expected.sums(_residual(short)), _squares(_residual(long))
    found = {}
    for model in (expected.mixture, expected.single):
        variances = model(sums)
        beyond, sigmas = expected.beyond(variances, squares)[0], 0.0
        if beyond.max() > THRESHOLDS.clear_excess:
            pairs = [(expected.sums(a), _squares(b)) for a, b in _simulated(variances[0], short, long, seed)]
            a, b = (np.concatenate(rows) for rows in zip(*pairs, strict=True))
            drawn = np.log(expected.beyond(model(a), b))
            sigmas = float(np.max((np.log(beyond) - drawn.mean(axis=0)) / np.maximum(drawn.std(axis=0), 1e-9)))
        found[model.__name__] = beyond, sigmas
    beyond, sigmas = found["mixture"]
    if found["single"][1] - THRESHOLDS.single_colour > sigmas:
        beyond, sigmas = found["single"][0], found["single"][1] - THRESHOLDS.single_colour
    chi = squares[0] / (len(long.windows) * long.windows.length)
    excess = np.maximum(chi * (1 - 1 / np.maximum(beyond, 1e-300)), 0.0)
    return Growth(float(chi.mean()), float(np.mean(short.residual**2)), beyond, sigmas, excess)


def noise(long: Tangent, short: Tangent, seed: int = 0) -> tuple[Array, Array]:
    """Residuals (`noise_draws`, W, L, ny) of long windows in noise of the colour of short ones: of one colour, and of any
    mixture."""
    expected = _Expected.of(short, long)
    sums = expected.sums(_residual(short))
    drawn = [[b for _, b in _simulated(model(sums)[0], short, long, seed)] for model in (expected.single, expected.mixture)]
    one, any_of_them = (np.concatenate(b, axis=1).transpose(1, 0, 3, 2) for b in drawn)
    return one, any_of_them


@final
@dataclass(frozen=True)
class _Expected:
    """Sums that unit noise of each channel and colour would give: short (lags, ny, ny, J), long (ny, ny, J)."""

    short: Array
    long: Array

    @classmethod
    def of(cls, short: Tangent, long: Tangent) -> _Expected:
        lags = min(THRESHOLDS.colour_lags, short.windows.length // 2)
        return cls(_sums(short, lags), _sums(long, 0)[0])

    def sums(self, rows: Array) -> Array:
        """Autocovariances of residuals (W, n, ny, L) of short windows: sums over windows and times, (n, lags, ny)."""
        length = rows.shape[3]
        return np.stack(
            [np.einsum("wnct,wnct->nc", rows[..., : length - k], rows[..., k:]) for k in range(len(self.short))], axis=1
        )

    def mixture(self, sums: Array) -> Array:
        """Variances (n, ny, J) ≥ 0 whose projected autocovariances are nearest to these (n, lags, ny)."""
        size = np.maximum(sums[:, 0], 1e-100)  # its inverse has a square
        scaled = ((self.short / s[:, None, None], own / s) for own, s in zip(sums, size, strict=True))
        found = [_nearest(matrix.reshape(own.size, -1), own) for matrix, own in scaled]
        return np.stack(found).reshape(len(sums), *self.long.shape[1:])

    def single(self, sums: Array) -> Array:
        """The same, each channel of one colour: two neighbouring ones of the list at most."""
        out = np.zeros((len(sums), *self.long.shape[1:]))
        for c in range(sums.shape[2]):
            own, best = sums[:, :, c], np.full(len(sums), np.inf)
            for j in range(len(THRESHOLDS.noise_colours) - 1):
                columns = self.short[:, c, c, j : j + 2]
                pair = _nearest_pair(columns, own)
                left = np.sum((pair @ columns.T - own) ** 2, axis=1)
                rows = np.flatnonzero(left < best)
                best[rows], out[rows, c] = left[rows], 0.0
                out[rows, c, j : j + 2] = pair[rows]
        return out

    def beyond(self, variances: Array, squares: Array) -> Array:
        """squares (n, ny): summed over all samples of the long windows."""
        predicted = np.einsum("cdj,ndj->nc", self.long, variances)
        # Of a channel that is met exactly both are zero.
        return np.asarray(np.maximum(squares, 1e-300) / np.maximum(predicted, 1e-300))


def _nearest(matrix: Array, values: Array) -> Array:
    """x ≥ 0 with the least |matrix x − values|."""
    scale = np.linalg.norm(matrix, axis=0) + 1e-300
    return np.asarray(nnls(matrix / scale, values.ravel())[0] / scale)


def _nearest_pair(columns: Array, values: Array) -> Array:
    """x (n, 2) ≥ 0 with the least |columns x − v| for each row v of values (n, k)."""
    first, second = columns.T
    size = np.linalg.norm(columns, axis=0) + 1e-300
    one, shared = first / size[0], float(first @ second) / size[0]
    apart = second - shared * one
    rest = float(np.linalg.norm(apart)) + 1e-300
    y = values @ (apart / rest) / rest
    both = np.stack([(values @ one - shared * y) / size[0], y], axis=1)
    # Else one of them is zero: of the two edges, the one that takes more away.
    edge = np.maximum(values @ (columns / size), 0)
    more = edge[:, :1] >= edge[:, 1:]
    return np.where(both.min(axis=1, keepdims=True) >= 0, both, np.where(np.hstack([more, ~more]), edge / size, 0.0))


def _residual(motion: Tangent) -> Array:
    return motion.residual.reshape(motion.windows.y.shape).transpose(0, 2, 1)[:, None]


def _squares(rows: Array) -> Array:
    """Sums (n, ny) over windows and times of (W, n, ny, L)."""
    return np.asarray(np.einsum("wnct,wnct->nc", rows, rows))


def _sums(motion: Tangent, lags: int) -> Array:
    """Expected lagged sums of P ε per unit of each noise: P Γ P = Γ − QQᵀΓ − ΓQQᵀ + Q(QᵀΓQ)Qᵀ, (lags + 1, ny, ny, J)."""
    w, length, ny = motion.windows.y.shape
    basis = motion.linear.free.reshape(w, length, ny, -1).transpose(2, 0, 3, 1)
    gap = np.abs(np.subtract.outer(np.arange(length), np.arange(length)))
    covers, kinds = [colour**gap for colour in THRESHOLDS.noise_colours], len(THRESHOLDS.noise_colours)
    out, square = np.zeros((lags + 1, ny, kinds * ny)), np.zeros((ny, length, length))
    for start in range(0, w, AT_ONCE):
        q = np.ascontiguousarray(basis[:, start : start + AT_ONCE])  # Qᵀ of some windows, (ny, w, nx, L)
        rows = q.reshape(ny, -1, length)
        square += np.swapaxes(rows, 1, 2) @ rows
        inner = np.stack([(rows @ cover).reshape(q.shape) @ np.swapaxes(q, 2, 3) for cover in covers]).reshape(kinds * ny, -1)
        for k in range(lags + 1):
            out[k] += (q[..., : length - k] @ np.swapaxes(q[..., k:], 2, 3)).reshape(ny, -1) @ inner.T
    found = np.swapaxes(out.reshape(lags + 1, ny, kinds, ny), 2, 3).copy()
    each = np.arange(ny)
    for j, (colour, cover) in enumerate(zip(THRESHOLDS.noise_colours, covers, strict=True)):
        for k, passed in enumerate(_diagonals(cover, square, lags)):
            found[k, each, each, j] += w * (length - k) * colour**k - 2 * passed
    return found


def _diagonals(cover: Array, square: Array, lags: int) -> list[Array]:
    """Sums (ny,) over the diagonals of Γ QQᵀ (ny, L, L), the mean over those k above and k below, of k = 0 … lags."""
    if not lags:
        return [np.tensordot(square, cover)]
    passed = cover @ square
    return [sum(np.trace(passed, s * k, 1, 2) for s in (-1, 1)) / 2 for k in range(lags + 1)]


def _simulated(variances: Array, short: Tangent, long: Tangent, seed: int) -> Iterator[tuple[Array, Array]]:
    """Residuals (short, long) that logs of nothing but this noise (ny, J) would leave, some logs (W, n, ny, L) at a time."""
    rng, ny = np.random.default_rng(seed), len(variances)
    there = [
        (d, THRESHOLDS.noise_colours[j], np.sqrt(v * (1 - THRESHOLDS.noise_colours[j] ** 2)))
        for (d, j), v in np.ndenumerate(variances)
        if v > 0
    ]
    logged = [_Logged.of(m) for m in (short, long)]
    steps = THRESHOLDS.noise_warm_up + max(m.windows * m.length for m in logged)
    for _ in range(0, THRESHOLDS.noise_draws, AT_ONCE):
        noise, fresh = np.zeros((AT_ONCE, ny, steps)), rng.standard_normal((AT_ONCE, len(there), steps))
        for i, (d, colour, size) in enumerate(there):
            noise[:, d] += lfilter([1.0], [1.0, -colour], size * fresh[:, i])
        a, b = (m.residual(noise[..., THRESHOLDS.noise_warm_up :]) for m in logged)
        yield a, b


@final
@dataclass(frozen=True)
class _Logged:
    """Windows that are cut out of logs, one after another; free (W, ny·L, nx): what their starts can make."""

    windows: int
    length: int
    free: Array

    @classmethod
    def of(cls, motion: Tangent) -> _Logged:
        w, length, ny = motion.windows.y.shape
        free = motion.linear.free.reshape(w, length, ny, -1).transpose(0, 2, 1, 3)
        return cls(w, length, free.reshape(w, ny * length, -1))

    def residual(self, logs: Array) -> Array:
        """What logs (n, ny, T) leave in the windows, (W, n, ny, L)."""
        rows = logs[..., : self.windows * self.length].reshape(*logs.shape[:2], self.windows, self.length).transpose(2, 0, 1, 3)
        flat = rows.reshape(self.windows, len(logs), -1)
        return np.asarray(flat - (flat @ self.free) @ np.swapaxes(self.free, 1, 2)).reshape(rows.shape)
