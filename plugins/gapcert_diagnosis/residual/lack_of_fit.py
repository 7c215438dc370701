"""Does what a fit leaves go with anything along the path? Score tests of many small forces, each for itself and kind by kind.

A force z at a coordinate adds a multiple of c = ∂y/∂z to the residual r. With c free of what starts and fitted numbers make (as
far as these may move: what is stated of them is measured, too), T = cᵀr has mean 0 and the variance of the noise along c unless
the force is there: one direction shows what is too small for a test of all of r. Of the K forces of a kind together, with Q an
orthonormal basis of their c, ‖Qᵀr‖² is the noise's variance times χ²(K): a law that no single one of them is like shows there.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import islice
from operator import attrgetter
from typing import final

import numpy as np
import numpy.typing as npt
from scipy.special import chdtrc, ndtri

from gapcert.plugin import Array
from gapcert_diagnosis.data.dataset import flat
from gapcert_diagnosis.fitting.fit import slopes
from gapcert_diagnosis.fitting.linearised import Tangent, states
from gapcert_diagnosis.thresholds import THRESHOLDS

from .regression import features, hats, input_features
from .whiteness import noise

KINDS = {
    "static": "the present state and input",
    "periodic": "the position, again and again",
    "input memory": "past inputs",
    "input hysteresis": "how the input got where it is",
    "position memory": "how the position got where it is",
}


@final
@dataclass(frozen=True)
class Lack:
    """What the residual goes with most, as a force at which coordinate, and how clearly.

    sigmas: standard deviations of noise, of one direction, or as rare as the sum over a kind.
    """

    site: str
    kind: str
    sigmas: float


def lack(long: Tangent, short: Tangent, seed: int = 0) -> Lack | None:
    """None where no score stands out; short: shows the colour of the noise."""
    (gone, stated, r), shared = _absorbed(long), input_features(long)
    against = np.concatenate([long.linear.free, *(a.reshape(*long.residual.shape, -1) for a in (gone, r.T))], axis=2)
    weighed, rng = long.linear.adjoint(against), np.random.default_rng(seed)

    @functools.cache
    def drawn() -> list[Array]:
        rows = (n.reshape(len(n), -1) for n in noise(long, short, seed))
        return [_without(gone, n, rng.standard_normal((len(n), len(stated))) @ stated) for n in rows]

    best, clearly = Lack("", "", THRESHOLDS.lack_sigmas), attrgetter("sigmas")
    for site in long.model.sites("coordinate"):
        forces = _Forces.of(long, site, *weighed)
        found = {**shared, **features(long, site), **_shapes(long, site)}
        for kind, force in ((k, f) for k, f in found.items() if f.shape[-1]):
            columns = forces.columns(force) or _Columns.made(long.responses(site, force), gone, r)
            scores = functools.cache(lambda c=columns, f=force, s=site: c.scores(long.responses(s, f), drawn()))
            sigmas = np.abs(columns.along)
            if len(some := np.flatnonzero(sigmas > best.sigmas)):
                coloured = np.sqrt(np.max([np.mean(s[:, some] ** 2, axis=0) for s in scores()], axis=0))
                best = max(best, Lack(site, kind, float(np.max(sigmas[some] / np.maximum(1.0, coloured)))), key=clearly)
            best = max(best, Lack(site, kind, _together(columns, best.sigmas, scores)), key=clearly)
    return Lack(best.site, KINDS.get(best.kind, best.kind), best.sigmas) if best.site else None


def _without(gone: Array, rows: Array, off: Array) -> Array:
    """Rows (n, W·L·ny) without what numbers make; off (n, k): how far they are along each direction from what is stated."""
    return np.asarray(rows - (rows @ gone + off) @ gone.T)


@final
@dataclass(frozen=True)
class _Columns:
    """Columns c, without what starts and fitted numbers make, of length one, where enough of them is left.

    which, size: those of which enough is left, and how much; square: their products; along: those with the residual.
    """

    which: npt.NDArray[np.intp]
    size: Array
    square: Array
    along: Array

    @classmethod
    def made(cls, columns: Array, gone: Array, r: Array) -> _Columns:
        """Of columns (W, L·ny, K) without what starts make."""
        rows = columns.reshape(len(gone), -1)
        with np.errstate(all="ignore"):
            return cls.of(rows.T @ rows, gone.T @ rows, (r @ rows)[0])

    @classmethod
    def of(cls, square: Array, gone: Array, along: Array) -> _Columns:
        """From products of columns without what starts make: with each other, and with a basis of what numbers make."""
        with np.errstate(all="ignore"):
            whole = np.diag(square).copy()
            square = square - gone.T @ gone
            left = np.diag(square)
            which = np.flatnonzero(np.isfinite(whole) & (left > THRESHOLDS.new_direction**2 * whole))
        size = np.sqrt(left[which])
        return cls(which, size, square[np.ix_(which, which)] / np.outer(size, size), along[which] / size)

    def scores(self, made: Array, drawn: Sequence[Array]) -> list[Array]:
        """Products (draws, K) of rows (draws, W·L·ny), in which nothing is of what is gone, with columns (W, L·ny, K)."""
        with np.errstate(all="ignore"):
            return [(rows @ made.reshape(rows.shape[1], -1))[:, self.which] / self.size for rows in drawn]


@final
@dataclass(frozen=True)
class _Forces:
    """Products of the columns that forces at a coordinate make, from a motion of states alone: there are fewer than outputs.

    step (W, S, nx + 1, nx + 1): from a state and the force to the next state, and to the product of all that was made so far
    with what a force of one would make now, of which the last force counts half; back (W, S, m): what a force of one at each
    step adds to the products with m rows, of which the first `starts` are of each window for itself, and the last the residual.
    """

    step: Array
    back: Array
    starts: int

    @classmethod
    def of(cls, motion: Tangent, site: str, rows: Array, own: Array) -> _Forces:
        """rows, own: as the motion has weighed them."""
        B = motion.probed(site).reshape(motion.x.shape)[..., None]
        with np.errstate(all="ignore"):
            felt = np.swapaxes(B, 2, 3) @ own
            step = np.block([[motion.linear.A, B], [felt @ motion.linear.A, felt @ B / 2]])
            return cls(step, (np.swapaxes(rows, 2, 3) @ B)[..., 0], motion.linear.free.shape[2])

    def columns(self, force: Array) -> _Columns | None:
        """Of forces (W, S, K); None where starts make so nearly all of a column that the rest is lost in its square."""
        count, made = force.shape[2], np.empty(force.shape)
        with np.errstate(all="ignore"):
            for i, state in enumerate(islice(states(self.step, force=force), 1, None)):
                made[:, i] = state[:, -1]
            half = flat(made).T @ flat(force)
            with_rows = np.swapaxes(self.back, 1, 2) @ force
            free, rest = with_rows[:, : self.starts].reshape(-1, count), with_rows[:, self.starts :].sum(axis=0)
            square = half + half.T
            left = square - free.T @ free
            if (np.diag(left) < THRESHOLDS.told_by_products * np.diag(square)).any():
                return None
        return _Columns.of(left, rest[:-1], rest[-1])


def _spanning(square: Array) -> Array:
    """V (K, k) that makes an orthonormal basis of columns with these products, without directions that are nearly others."""
    if not len(square):
        return np.empty((0, 0))
    square, v = np.linalg.eigh(square)
    kept = square > THRESHOLDS.joint_direction**2 * square[-1]  # far above what squaring loses
    return np.asarray(v[:, kept] / np.sqrt(square[kept]))


def _together(columns: _Columns, least: float, scores: Callable[[], Sequence[Array]]) -> float:
    """‖Qᵀr‖² of a basis of columns, as the standard deviations of one number that is as rare in noise; 0 if below `least`.

    scores: of noise, (draws, K). In coloured noise ‖Qᵀr‖² is taken for a multiple of χ² with the mean and the variance that
    it then has (Satterthwaite).
    """
    basis = _spanning(columns.square)
    total = float(np.sum((columns.along @ basis) ** 2))
    sigmas = rare(total, basis.shape[1]) if basis.shape[1] else 0.0
    if sigmas < least:
        return 0.0
    for drawn in scores():
        sums = np.sum((drawn @ basis) ** 2, axis=1)
        mean, variance = float(sums.mean()), float(sums.var())
        sigmas = min(sigmas, rare(2 * mean * total / variance, 2 * mean**2 / variance))
    return sigmas


def rare(total: float, k: float) -> float:
    """The standard score as rare as χ²(k) ≥ total."""
    return float(-ndtri(max(float(chdtrc(k, total)), 1e-300)))


def _absorbed(motion: Tangent) -> tuple[Array, Array, Array]:
    """An orthonormal basis of what the fitted numbers make, with the starts free to follow: of outputs (W·L·ny, k), and of what
    is stated of the numbers (p, k), a measurement whose noise is a tolerance; the residual (1, W·L·ny) without it.

    A fit leaves nothing of what it can make. What it leaves, two equal lags that would have to swing, or a number at its bound,
    it cannot make.
    """
    h, (moved, step) = motion.fitted.hypothesis, slopes(motion.fitted)
    # As in the fit: what is left is noise, and what is stated counts as much more.
    weight, rows = (
        math.sqrt(max(1.0, float(np.mean(motion.residual**2)))),
        motion.project(moved).reshape(motion.residual.size, -1),
    )
    r, off = motion.project(motion.residual).reshape(1, -1), weight * (h.value - motion.fitted.theta) / h.sd
    if not rows.shape[1]:
        return rows, np.empty((0, 0)), r
    rows = np.concatenate([rows, np.diag(weight * step / h.sd)])
    u, size, _ = np.linalg.svd(rows / (np.linalg.norm(rows, axis=0) + 1e-300), full_matrices=False)
    left = np.abs(np.append(r[0], off) @ u)
    u = u[:, (size > THRESHOLDS.shared_direction * size[0]) & (left < THRESHOLDS.unmade * weight)]
    gone, stated = u[: r.size], u[r.size :]
    return gone, weight * stated, _without(gone, r, off @ stated)


def _shapes(motion: Tangent, site: str) -> dict[str, Array]:
    """Forces (W, S, K) of speed, position, load, input and time, in no particular law's form."""
    (q, v), u, effort = motion.place(site), motion.u, motion.effort(site)
    speed = motion.x[..., v] / _size(motion.x[..., v])
    fast, sign = np.abs(speed), np.tanh(speed / THRESHOLDS.sign_width)[..., None]
    near = np.exp(-fast[..., None] / THRESHOLDS.speed_decays)
    curves = np.concatenate([hats(fast, np.quantile(fast, THRESHOLDS.speeds)), near], axis=-1)
    sides = np.maximum(np.stack([speed, -speed], axis=-1), 0)
    load = np.minimum(effort / _size(effort), THRESHOLDS.effort_peak)[..., None]
    t = motion.windows.t[:, None] + np.arange(motion.x.shape[1]) * motion.model.period
    late = ((t - t.min()) / max(float(np.ptp(t)), 1e-12))[..., None]
    out = {
        f"the speed of {site}": np.concatenate([sign * curves, sign * near**2, curves, sides, sides**2, sides > 0], axis=-1),
        f"the load at {site}": np.concatenate([sign * load, sign * np.sqrt(load), load], axis=-1),
        "the time": np.concatenate([b * late**k for b in (1.0, sign, speed[..., None]) for k in (1, 2)], axis=-1),
    }
    if u.shape[-1]:
        share, top = u / (np.sqrt(np.mean(u**2, axis=(0, 1))) + 1e-12), u / (np.abs(u).max(axis=(0, 1)) + 1e-12)
        cut = [*(np.clip(share, -c, c) for c in THRESHOLDS.input_cuts), *(np.clip(top, -c, c) for c in THRESHOLDS.input_peaks)]
        out["the size of the input"] = np.concatenate([*cut, np.abs(share)], axis=-1)
    if q is not None:
        z = motion.x[..., q]
        place, at = hats(z, np.quantile(z, THRESHOLDS.places)), (z - z.mean())[..., None] / max(float(np.ptp(z)) / 2, 1e-12)
        powers = [at**2, at**3, at**4, at * np.abs(at), np.maximum(at - 0.5, 0), np.maximum(-at - 0.5, 0)]
        moving = [place * speed[..., None], place * sign]
        out[f"the position of {site}"] = np.concatenate([place, *powers, *moving], axis=-1)
    return out


def _size(a: Array) -> float:
    return float(np.sqrt(np.mean(a**2))) + 1e-12
