"""What candidates promise for one fit: their pushes as columns beside what is free already, and the gains of those columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert.diagnosis.fit import Fit
from gapcert.diagnosis.library import Candidate, Causes, Library
from gapcert.diagnosis.measured import Windows
from gapcert.diagnosis.path import Motion, shortened
from gapcert.system import Array

Rows = npt.NDArray[np.intp]
STEEP = 1e9  # noise floors
NEAR = (0.6, 1.6)  # the gain of a law that is not linear in any of its numbers must stay near one


@final
@dataclass(frozen=True)
class Screened:
    """A move, first values of its numbers by name, and the fall of the squared residual, in units of χ, that they promise."""

    move: Causes
    values: Mapping[str, float]
    gain: float


@final
@dataclass(frozen=True)
class Push:
    """What values (g, p) of a candidate's parameters do along the path: state (W, S, nx, g) per step, output (W, L, ny, g)."""

    candidate: Candidate
    values: Array
    state: Array | None
    output: Array | None


@final
class Ledger:
    """Gains of columns for one fit: normal equations after the starts of the windows and the free numbers are projected out."""

    def __init__(self, library: Library, windows: Windows, rows: Rows, motion: Motion, fit: Fit, parts: int) -> None:
        """The windows of the fit are those of `rows`, each cut into so many parts."""
        self.library, self.fit, self.parts = library, fit, parts
        m, h, scale = windows.measured, fit.hypothesis, 1 / np.sqrt(np.maximum(fit.chi, 0.5))
        self.length, self.repeat = windows.length // parts, m.repeat
        self.steps = (self.length - 1) * m.repeat
        self.weigh = (shortened(windows.weight, parts) * scale / m.sigma)[..., None]
        self.A, self.observe = self._cut(motion.A), shortened(motion.observe, parts) * self.weigh
        count = len(windows) * parts
        start = np.tile(np.eye(motion.A.shape[-1]), (count, 1, 1))
        self.basis = np.linalg.qr(self._pushed(start, None))[0]
        mine = (rows[:, None] * parts + np.arange(parts)).ravel()
        self.residual = self._project((fit.residual[mine] * scale).reshape(count, -1, 1))[..., 0]
        self.slopes = self._rows(motion.free, motion.shown)
        self.precision, self.off = 1 / h.sd**2, np.where(np.isinf(h.sd), 0.0, fit.theta - h.value)
        self.normal = _cross(self.slopes, self.slopes)
        self.along = _cross(self.slopes, self.residual[..., None])[:, 0] + self.precision * self.off
        self.inverse = np.linalg.pinv(self.normal + np.diag(self.precision), hermitian=True)
        self.columns: dict[tuple[str, str], tuple[Array, Array]] = {}

    def enter(self, pushes: Sequence[Push]) -> None:
        """The columns of candidates, all in one pass; beside those that are there already."""
        moving = [p for p in pushes if p.state is not None]
        if moving:
            rows = self._rows(np.concatenate([p.state for p in moving if p.state is not None], axis=-1), None)
            ends = np.cumsum([len(p.values) for p in moving])[:-1]
            for p, columns in zip(moving, np.split(rows, ends, axis=-1), strict=True):
                self._beside(p, columns)
        for p in pushes:
            if p.output is not None:
                self._beside(p, self._rows(None, p.output))

    def _beside(self, push: Push, columns: Array) -> None:
        key, values = push.candidate.key, push.values
        if key in self.columns:
            values, columns = (
                np.concatenate(pair, axis=a)
                for pair, a in (((self.columns[key][0], values), 0), ((self.columns[key][1], columns), -1))
            )
        self.columns[key] = values, columns

    def promise(self, move: Causes) -> Screened | None:
        """The best first values of a move, None where it promises nothing."""
        if self.library.extension(move[0]).frees is not None:
            return self._freed(move[0]) if len(move) == 1 else None
        best = [self.best(c) for c in move]
        gains, values = self._together([b[1] for b in best], [b[2] for b in best])
        found: dict[str, float] = {}
        for c, (row, _, _), a in zip(move, best, values, strict=True):
            k, start = self.library.amplitude(c), row.copy()
            if k is not None:
                off = c.effect.parameters[k].off
                start[k] = off + a * (start[k] - off)
            found |= dict(zip(self.library.names(c), start.tolist(), strict=True))
        return Screened(move, found, max(gains, 0.0))

    def best(self, c: Candidate) -> tuple[Array, Array, tuple[float, float]]:
        """(values, column, bounds on its multiple) of the start of a candidate that promises most."""
        values, columns = self.columns[c.key]
        i = int(np.argmax(self._gains(c, values, columns)))
        return values[i], columns[..., i], self._bounds(c, values[i])

    def least(self, c: Candidate, gain: float) -> Array | None:
        """The smallest values of a candidate that promise so much, had they been there; None where none does."""
        freed, scale = self.library.extension(c).frees, np.sqrt(gain / float(self.fit.whiteness.min()))
        if freed is not None:
            return self._least_freed(freed, scale)
        values, columns = self.columns[c.key]
        cross = _cross(columns, self.slopes)
        curve = np.sqrt(
            np.maximum(np.sum(columns**2, axis=(0, 1)) - np.einsum("gi,ij,gj->g", cross, self.inverse, cross), 1e-300)
        )
        k = self.library.amplitude(c)
        if k is None:
            off, enough = c.effect.parameters[0].off, np.flatnonzero(curve > scale)
            if not len(enough):
                return None
            nearest: Array = values[enough[np.argmin(np.abs(values[enough, 0] - off))]]
            return nearest
        i, off = int(np.argmax(curve)), c.effect.parameters[k].off
        least: Array = values[i].copy()
        least[k] = off + (least[k] - off) * scale / curve[i]
        return least

    def _least_freed(self, name: str, scale: float) -> Array | None:
        """Off the stated value: what it costs the prior, and the data where they hold it."""
        names = self.fit.hypothesis.names
        if name not in names:
            return None
        k = names.index(name)
        precision = self.precision.copy()
        precision[k] = 0.0
        left = np.linalg.pinv(self.normal + np.diag(precision), hermitian=True)[k, k]
        return np.array([self.fit.hypothesis.value[k] + scale * np.sqrt(1 / self.precision[k] + left)])

    def _bounds(self, c: Candidate, values: Array) -> tuple[float, float]:
        k = self.library.amplitude(c)
        if k is None:
            return NEAR
        off = c.effect.parameters[k].off
        low, high = (float((b[k] - off) / (values[k] - off)) for b in self.library.bounds(c))
        return min(low, high), max(low, high)

    def _gains(self, c: Candidate, values: Array, columns: Array) -> Array:
        cross = _cross(columns, self.slopes)
        curve = np.sum(columns**2, axis=(0, 1)) - np.einsum("gi,ij,gj->g", cross, self.inverse, cross)
        slope = -np.einsum("wrg,wr->g", columns, self.residual) + cross @ self.inverse @ self.along
        limits = np.array([self._bounds(c, v) for v in values])
        usable = curve > 1e-9
        a = np.clip(np.divide(slope, curve, out=np.zeros_like(slope), where=usable), limits[:, 0], limits[:, 1])
        return np.where(usable, 2 * a * slope - a**2 * curve, 0.0)

    def _together(self, columns: Sequence[Array], bounds: Sequence[tuple[float, float]]) -> tuple[float, Array]:
        """(gain, multiples): all columns at once, each multiple in its bounds."""
        both = np.stack(columns, axis=-1)
        cross, low, high = _cross(both, self.slopes), *np.array(bounds, dtype=np.float64).T
        curve = _cross(both, both) - cross @ self.inverse @ cross.T
        slope = -np.einsum("wrg,wr->g", both, self.residual) + cross @ self.inverse @ self.along
        a, free = np.zeros(len(low)), np.diag(curve) > 1e-9
        for _ in range(len(a)):
            rest = slope - curve[:, ~free] @ a[~free]
            a[free] = np.linalg.lstsq(curve[np.ix_(free, free)], rest[free], rcond=None)[0]
            out = free & ((a < low) | (a > high))
            if not out.any():
                break
            a[out] = np.clip(a, low, high)[out]
            free = free & ~out
        return float(2 * a @ slope - a @ curve @ a), a

    def _freed(self, c: Candidate) -> Screened | None:
        """What the fit gains where a number is no longer held by its prior."""
        (name,) = self.library.names(c)
        if name not in self.fit.hypothesis.names:
            return None
        k = self.fit.hypothesis.names.index(name)
        precision, along = self.precision.copy(), self.along.copy()
        along[k] -= precision[k] * self.off[k]
        precision[k] = 0.0
        move = np.linalg.pinv(self.normal + np.diag(precision), hermitian=True) @ along
        gain = self.precision[k] * self.off[k] ** 2 + along @ move - self.along @ self.inverse @ self.along
        low, high = (float(b[0]) for b in self.library.bounds(c))
        return Screened((c,), {name: float(np.clip(self.fit.theta[k] - move[k], low, high))}, float(gain)) if gain > 0 else None

    def _rows(self, state: Array | None, output: Array | None) -> Array:
        """What pushes (W, S, nx, K) and differences of the output (W, L, ny, K) do to the residual, (W', L'·ny, K)."""
        rows: Array | float = 0.0
        if state is not None:
            push = self._cut(state)
            rows = self._pushed(np.zeros((len(push), *push.shape[2:])), push)
        if output is not None:
            shown = shortened(output, self.parts) * self.weigh
            rows = rows + flat(shown)
        return self._project(np.asarray(rows))

    def _pushed(self, start: Array, push: Array | None) -> Array:
        state, out = start, [self.observe[:, 0] @ start]
        with np.errstate(all="ignore"):
            for k in range(self.steps):
                state = self.A[:, k] @ state
                if push is not None:
                    state += push[:, k]
                if (k + 1) % self.repeat == 0:
                    out.append(self.observe[:, (k + 1) // self.repeat] @ state)
        rows = flat(np.stack(out, axis=1))
        # Where the linearised motion blows up, a column says nothing.
        usable = (np.abs(rows) < STEEP).all(axis=(0, 1))
        return rows if usable.all() else np.where(usable, rows, 0.0)

    def _cut(self, steps: Array) -> Array:
        """(W, S, …) per step of the long windows → (W', S', …) of the short ones."""
        whole = self.length * self.repeat
        if self.parts == 1:
            return steps
        rows = [steps[:, i * whole : i * whole + self.steps] for i in range(self.parts)]
        return np.stack(rows, axis=1).reshape(len(steps) * self.parts, *rows[0].shape[1:])

    def _project(self, rows: Array) -> Array:
        return np.asarray(rows - self.basis @ (np.swapaxes(self.basis, 1, 2) @ rows))


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(np.tensordot(a, b, axes=[range(a.ndim - 1)] * 2))


def flat(rows: Array) -> Array:
    """(W, L, ny, K) → (W, L·ny, K); K may be 0."""
    return rows.reshape(len(rows), rows.shape[1] * rows.shape[2], rows.shape[3])
