"""What candidates promise for one fit: their pushes as columns beside what is free already, and the gains of those columns,
each for itself, in pairs, or taken one after another."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array
from gapcert_diagnosis.data.dataset import Windows, flat
from gapcert_diagnosis.fitting.fit import Fit
from gapcert_diagnosis.fitting.gauss_newton import bounded
from gapcert_diagnosis.fitting.linearised import LinearisedMotion, Motion, shortened
from gapcert_diagnosis.thresholds import THRESHOLDS

from .candidates import Candidate, Causes, Library

Rows = npt.NDArray[np.intp]
AT_ONCE = 200  # columns that are pushed along the path together, or little more


@final
@dataclass(frozen=True)
class Promise:
    """A move, first values of its numbers by name, and the fall of the squared residual, in units of χ, that they promise.

    start: of the short windows (W, nx), where those of the set that is moved from are of no use.
    """

    move: Causes
    values: Mapping[str, float]
    gain: float
    start: Array | None = None


@final
@dataclass(frozen=True)
class Push:
    """What values (g, p) of a candidate's parameters do along the path: state (W, S, nx, g) per step, output (W, L, ny, g)."""

    candidate: Candidate
    values: Array
    state: Array | None
    output: Array | None


@final
@dataclass(frozen=True)
class Column:
    """Starts (g, p) of a candidate, rows (N, g), their part in the free starts (M, g), best multiples, gains and curvatures."""

    values: Array
    rows: Array
    seen: Array
    multiple: Array
    gain: Array
    curve: Array

    def beside(self, other: Column) -> Column:
        mine, theirs = (vars(c).values() for c in (self, other))
        return Column(
            *(np.concatenate([a, b], axis=0 if k == 0 else -1) for k, (a, b) in enumerate(zip(mine, theirs, strict=True)))
        )


@final
class GainTable:
    """Gains of columns for one fit: normal equations after the starts of the windows and the free numbers are projected out.

    Samples are averaged over blocks, which costs nothing that the eye of a screen would miss.
    """

    def __init__(self, library: Library, windows: Windows, rows: Rows, motion: Motion, fit: Fit, parts: int) -> None:
        """The windows of the fit are those of `rows`, each cut into so many parts."""
        self.library, self.fit, self.parts = library, fit, parts
        m, h, scale = windows.measured, fit.hypothesis, 1 / np.sqrt(np.maximum(fit.chi, 0.5))
        self.whole, block = windows.length // parts * m.repeat, max(1, round(THRESHOLDS.screening_block / m.period))
        self.steps = self.whole - m.repeat
        self.weigh = (shortened(windows.weight, parts) * scale / m.sigma)[..., None]
        observe = shortened(motion.observe, parts) * self.weigh / math.sqrt(block)
        self.motion = LinearisedMotion(self._cut(motion.A), observe, m.repeat, block, THRESHOLDS.steep_column)
        mine = (rows[:, None] * parts + np.arange(parts)).ravel()
        self.residual = flat(self.motion.project(self.motion.blocks((fit.residual[mine] * scale)[..., None])))
        self.slopes = flat(self.motion.project(self._rows(motion.free, motion.shown)))
        self.precision, self.off = 1 / h.sd**2, np.where(np.isinf(h.sd), 0.0, fit.theta - h.value)
        self.normal = self.slopes.T @ self.slopes
        self.pull = (self.slopes.T @ self.residual)[:, 0]
        # A number that has reached its bound makes no more of the residual: a law that it stood in for has all of it to gain.
        self.pinned = (fit.theta <= h.low) | (fit.theta >= h.high)
        self.along = np.where(self.pinned, 0.0, self.pull + self.precision * self.off)
        self.inverse = self._inverse(self.precision, self.pinned)
        self.columns: dict[tuple[str, str], Column] = {}
        self.entered: set[tuple[str, str]] = set()
        self._empty: MatchingPursuit | None = None

    def _inverse(self, precision: Array, pinned: npt.NDArray[np.bool_]) -> Array:
        """Of the normal equations with a prior, without the numbers that are pinned."""
        normal = self.normal + np.diag(precision)
        normal[pinned], normal[:, pinned] = 0.0, 0.0
        return np.asarray(np.linalg.pinv(normal, hermitian=True))

    def without(self, numbers: Sequence[int]) -> Array:
        """The inverse of the normal equations with these free numbers held."""
        held = self.pinned.copy()
        held[list(numbers)] = True
        return self._inverse(self.precision, held)

    def enter(self, pushes: Sequence[Push]) -> None:
        """The columns of candidates, many in one pass; beside those that are there already."""
        moving = [p for p in pushes if p.state is not None and p.output is None]
        # As many as stay near the processor: a pass goes through all of them at every step.
        ends = np.cumsum([0, *(len(p.values) for p in moving)]) // AT_ONCE
        for k in np.unique(ends[:-1]).tolist():
            some = [p for p, end in zip(moving, ends, strict=False) if end == k]
            self._split(some, self._rows(np.concatenate([p.state for p in some if p.state is not None], axis=-1), None))
        self.entered |= {p.candidate.key for p in pushes}
        for p in pushes:
            if p.output is not None:
                self._split([p], self._rows(p.state, p.output))

    def _split(self, pushes: Sequence[Push], rows: Array) -> None:
        seen = np.swapaxes(self.motion.free, 1, 2) @ rows
        seen, rows = seen.reshape(-1, seen.shape[-1]), rows.reshape(-1, rows.shape[-1])
        cross = rows.T @ self.slopes
        curve = np.einsum("ij,ij->j", rows, rows) - np.einsum("ij,ij->j", seen, seen)
        curve = curve - np.einsum("gi,ij,gj->g", cross, self.inverse, cross)
        slope = cross @ self.inverse @ self.along - (rows.T @ self.residual)[:, 0]
        limits = np.array([self._bounds(p.candidate, v) for p in pushes for v in p.values])
        a, gain = _alone(slope, curve, limits, curve > 1e-9)
        ends = np.cumsum([0, *(len(p.values) for p in pushes)])
        for p, k, n in zip(pushes, ends[:-1], ends[1:], strict=True):
            new = Column(p.values, rows[:, k:n], seen[:, k:n], a[k:n], gain[k:n], curve[k:n])
            old = self.columns.get(p.candidate.key)
            self.columns[p.candidate.key] = new if old is None else old.beside(new)

    def promise(self, move: Causes) -> Promise | None:
        """The best first values of a move, None where it promises nothing."""
        if self.library.loosened(move[0]) is not None:
            return self._freed(move[0]) if len(move) == 1 else None
        return self._started(move, [int(np.argmax(self.columns[c.key].gain)) for c in move])

    def _started(self, move: Causes, best: Sequence[int]) -> Promise:
        """A move whose members begin at these of their starts."""
        column = self.columns[move[0].key]
        gain, multiples = float(column.gain[best[0]]), column.multiple[best[:1]]
        if len(move) > 1:
            gain, multiples = self._together(move, best)
        found: dict[str, float] = {}
        for own in zip(move, best, multiples, strict=True):
            found |= self._times(*own)
        return Promise(move, found, max(gain, 0.0))

    def _times(self, c: Candidate, i: int, a: float) -> dict[str, float]:
        """The numbers of a candidate's start, a times as large where it is linear in one."""
        k, start = self.library.amplitude(c), self.columns[c.key].values[i].copy()
        if k is not None:
            off = self.library.off(c)[k]
            start[k] = off + a * (start[k] - off)
        return dict(zip(self.library.names(c), start.tolist(), strict=True))

    def pursue(self, most: int) -> list[Promise]:
        """Sets of 1, 2, … candidates, each next one the one that promises most beside those before it."""
        pursuit, sets = self._pursuit(), list[Promise]()
        e = pursuit.columns
        while len(sets) < most and (i := pursuit.best()) is not None:
            pursuit.take(i)
            sets.append(self._started(tuple(e.known[o] for o in e.owner[pursuit.picks]), e.inner[pursuit.picks].tolist()))
        return sets

    def beside(self, causes: Causes) -> dict[tuple[str, str], float]:
        """Per candidate what it promises beside these, each at the start that promises most beside those before it."""
        pursuit = self._pursuit()
        columns = pursuit.columns
        for c in causes:
            gains = np.where(columns.of(c), pursuit.gains(), 0.0)
            if gains.max(initial=0.0) > 0:
                pursuit.take(int(np.argmax(gains)))
        gains, out = pursuit.gains(), dict[tuple[str, str], float]()
        for o, gain in zip(columns.owner.tolist(), gains.tolist(), strict=True):
            key = columns.known[o].key
            out[key] = max(out.get(key, 0.0), gain)
        return out

    def _pursuit(self) -> MatchingPursuit:
        """Of all that has been entered, nothing taken yet."""
        count = sum(len(c.gain) for c in self.columns.values())
        if self._empty is None or len(self._empty.open) != count:
            self._empty = MatchingPursuit(self)
        return copy.copy(self._empty)

    def all_columns(self) -> Columns:
        entered = [c for c in self.library.candidates if c.key in self.columns and len(self.columns[c.key].gain)]
        known = sorted(entered, key=lambda c: c.key)
        columns = [self.columns[c.key] for c in known]
        counts = [len(c.gain) for c in columns]
        owner, inner = np.repeat(np.arange(len(known)), counts), np.array([i for n in counts for i in range(n)], dtype=np.intp)
        empty = np.empty((self.residual.size, 0)), np.empty((0, 0))
        rows, seen = (np.concatenate([getattr(c, n) for c in columns], axis=1) for n in ("rows", "seen")) if known else empty
        limits = np.array([self._bounds(known[o], columns[o].values[i]) for o, i in zip(owner, inner, strict=True)])
        return Columns(known, owner, inner, rows, seen, limits.reshape(-1, 2))

    def pairs(self, most: int) -> list[Promise]:
        """Two candidates at once, the most promising first; of pairs whose columns point the same way, the best.

        Greedy steps miss two laws neither of which helps much without the other.
        """
        e = self.all_columns()
        known, owner, inner, rows, seen, limits = e.known, e.owner, e.inner, e.rows, e.seen, e.limits
        if len(known) < 2:
            return []
        gains = np.concatenate([self.columns[c.key].gain for c in known])
        keep = np.sort(np.argsort(-gains, kind="stable")[: THRESHOLDS.paired_columns])
        owner, inner, rows, seen, limits = owner[keep], inner[keep], rows[:, keep], seen[:, keep], limits[keep]
        curve, slope = self._normal_equations(rows, seen)
        gain = _both(curve, slope, limits[:, 0], limits[:, 1])
        clash = np.array([[self.library.related(a, b) for b in known] for a in known])
        gain[clash[np.ix_(owner, owner)]] = 0.0
        size = np.sqrt(np.maximum(np.diag(curve), 1e-300))
        alike = np.abs(curve / np.outer(size, size)) > THRESHOLDS.alike_columns
        found: list[Promise] = []
        gain = np.triu(gain)
        while len(found) < most and gain.max(initial=0.0) > 0:
            i, j = (int(k) for k in np.unravel_index(int(np.argmax(gain)), gain.shape))
            found.append(self._started((known[owner[i]], known[owner[j]]), [int(inner[i]), int(inner[j])]))
            gain[np.outer(alike[i], alike[j]) | np.outer(alike[j], alike[i])] = 0.0
        return found

    def loosened_pairs(self) -> list[Promise]:
        """Pairs of a stated number, freed of its tolerance, and the law that explains most together with it.

        What a law leaves may be held by that prior so firmly that neither the law nor the number helps without the other.
        """
        e, found = self.all_columns(), list[Promise]()
        cross = e.rows.T @ self.slopes
        own = np.einsum("ij,ij->j", e.rows, e.rows) - np.einsum("ij,ij->j", e.seen, e.seen)
        for c in self.library.candidates:
            if self.library.loosened(c) is None or not e.known or (freed := self._freed(c)) is None:
                continue
            k = self.fit.hypothesis.names.index(self.library.names(c)[0])
            inverse, along = self._loosened(k)
            curve = own - np.einsum("ij,ij->i", cross @ inverse, cross)
            slope = cross @ inverse @ along - (e.rows.T @ self.residual)[:, 0]
            a, gain = _alone(slope, curve, e.limits, curve > 1e-9)
            i = int(np.argmax(gain))
            law, moved = e.known[int(e.owner[i])], float((inverse @ (along + cross[i] * a[i]))[k])
            values = self._times(law, int(e.inner[i]), float(a[i])) | self._within(c, k, moved)
            found.append(Promise((law, c), values, freed.gain + max(float(gain[i]), 0.0)))
        return found

    def _normal_equations(self, rows: Array, seen: Array) -> tuple[Array, Array]:
        """Curvatures (K, K) and slopes (K,) of columns, without what starts and free numbers make of them."""
        cross = rows.T @ self.slopes
        curve = rows.T @ rows - seen.T @ seen - cross @ self.inverse @ cross.T
        return curve, cross @ self.inverse @ self.along - (rows.T @ self.residual)[:, 0]

    def best(self, c: Candidate) -> Array:
        """The start of a candidate that promises most."""
        column = self.columns[c.key]
        return np.asarray(column.values[int(np.argmax(column.gain))])

    def least_freed(self, c: Candidate, gain: float) -> Array | None:
        """The smallest value beyond the stated one that promises so much, by the prior, and by the data where they hold it."""
        (name,), names = self.library.names(c), self.fit.hypothesis.names
        if name not in names:
            return None
        k = names.index(name)
        precision = self.precision.copy()
        precision[k] = 0.0
        left = np.linalg.pinv(self.normal + np.diag(precision), hermitian=True)[k, k]
        scale = np.sqrt(gain / float(self.fit.whiteness.min()))
        return np.array([self.fit.hypothesis.value[k] + scale * np.sqrt(1 / self.precision[k] + left)])

    def _bounds(self, c: Candidate, values: Array) -> tuple[float, float]:
        k = self.library.amplitude(c)
        if k is None:
            return THRESHOLDS.nonlinear_gain
        off = self.library.off(c)[k]
        low, high = (float((b[k] - off) / (values[k] - off)) for b in self.library.bounds(c))
        return min(low, high), max(low, high)

    def _together(self, move: Causes, best: Sequence[int]) -> tuple[float, Array]:
        """(gain, multiples): all columns at once, each multiple in its bounds."""
        columns = [(self.columns[c.key], i) for c, i in zip(move, best, strict=True)]
        low, high = np.array([self._bounds(k, c.values[i]) for k, (c, i) in zip(move, columns, strict=True)]).T
        rows, seen = (np.stack([getattr(c, n)[:, i] for c, i in columns], axis=-1) for n in ("rows", "seen"))
        curve, slope = self._normal_equations(rows, seen)
        a, usable = np.zeros(len(low)), np.diag(curve) > 1e-9
        a[usable] = bounded(curve[np.ix_(usable, usable)], slope[usable], low[usable], high[usable])
        return float(2 * a @ slope - a @ curve @ a), a

    def _freed(self, c: Candidate) -> Promise | None:
        """What the fit gains where a number is no longer held by its prior."""
        (name,) = self.library.names(c)
        if name not in self.fit.hypothesis.names:
            return None
        k = self.fit.hypothesis.names.index(name)
        inverse, along = self._loosened(k)
        move = inverse @ along
        gain = self.precision[k] * self.off[k] ** 2 + along @ move - self.along @ self.inverse @ self.along
        return Promise((c,), self._within(c, k, float(move[k])), max(float(gain), 0.0))

    def _loosened(self, k: int) -> tuple[Array, Array]:
        """(inverse, slopes) of the free numbers where the k-th has no prior."""
        precision, along, pinned = self.precision.copy(), self.along.copy(), self.pinned.copy()
        precision[k], along[k], pinned[k] = 0.0, self.pull[k], False
        return self._inverse(precision, pinned), along

    def _within(self, c: Candidate, k: int, move: float) -> dict[str, float]:
        # A straight line says little about a value that is far off; a fit from half or twice the stated one finds it.
        low, high = np.sort(self.fit.hypothesis.value[k] * np.array(THRESHOLDS.freed_values))
        return {self.library.names(c)[0]: float(np.clip(self.fit.theta[k] - move, low, high))}

    def _rows(self, state: Array | None, output: Array | None) -> Array:
        """What pushes (W, S, nx, K) and differences of the output (W, L, ny, K) do to the residual, (W', blocks·ny, K)."""
        rows: Array | float = 0.0 if state is None else self.motion.push(added=self._cut(state))
        return np.asarray(rows if output is None else rows + self.motion.blocks(shortened(output, self.parts) * self.weigh))

    def _cut(self, steps: Array) -> Array:
        """(W, S, …) per step of the long windows → (W', S', …) of the short ones."""
        if self.parts == 1:
            return steps
        rows = [steps[:, i * self.whole : i * self.whole + self.steps] for i in range(self.parts)]
        return np.stack(rows, axis=1).reshape(len(steps) * self.parts, *rows[0].shape[1:])


@final
@dataclass(frozen=True)
class Columns:
    """Candidates that push; of every column whose it is, which of its starts, its rows (N, K), what starts see, its bounds."""

    known: Sequence[Candidate]
    owner: Rows
    inner: Rows
    rows: Array
    seen: Array
    limits: Array

    def of(self, c: Candidate) -> npt.NDArray[np.bool_]:
        """Which columns (K,) are those of a candidate."""
        return np.asarray(np.array([k.key == c.key for k in self.known], dtype=bool)[self.owner])


@final
class MatchingPursuit:
    """Orthogonal matching pursuit.

    With curvature c, slope s and i the column that is taken, c − cᵢᵢ⁻¹ cᵢcᵢᵀ and s − cᵢᵢ⁻¹ sᵢcᵢ are left.
    """

    def __init__(self, table: GainTable) -> None:
        """Of all that has been entered into a table."""
        self.library, self.columns = table.library, table.all_columns()
        rows, seen = self.columns.rows, self.columns.seen
        self.cross = rows.T @ table.slopes
        self.pulled = self.cross @ table.inverse
        self.slope = self.pulled @ table.along - (rows.T @ table.residual)[:, 0]
        own = np.einsum("ij,ij->j", rows, rows) - np.einsum("ij,ij->j", seen, seen)
        self.curve = own - np.einsum("ij,ij->i", self.pulled, self.cross)
        self.least = np.maximum((1 - THRESHOLDS.alike_columns**2) * self.curve, 1e-9)
        self.open = np.ones(len(self.curve), dtype=bool)
        self.picks: list[int] = []
        self._gone: list[Array] = []

    def gains(self) -> Array:
        """What each column (K,) promises beside those that are taken: nothing, if it is alike or at odds with one of them."""
        return _alone(self.slope, self.curve, self.columns.limits, self.open & (self.curve > self.least))[1]

    def best(self) -> int | None:
        """The column that promises most; of laws that contain one another the simplest that promises nearly as much."""
        gains, known, owner = self.gains(), self.columns.known, self.columns.owner
        if gains.max(initial=0.0) <= 0:
            return None
        i = int(np.argmax(gains))
        inside = [o for o, c in enumerate(known) if self.library.within(c, known[int(owner[i])])]
        kin = np.flatnonzero(np.isin(owner, inside) & (gains > THRESHOLDS.even_promise * gains[i])).tolist()
        return min([i, *kin], key=lambda k: (self.library.simplicity((known[int(owner[k])],))[0], -gains[k]))

    def take(self, i: int) -> None:
        e = self.columns
        own = e.rows.T @ e.rows[:, i] - e.seen.T @ e.seen[:, i] - self.pulled @ self.cross[i]
        column = (own - sum((g * g[i] for g in self._gone), np.zeros_like(own))) / math.sqrt(self.curve[i])
        self.slope, self.curve = self.slope - column * (self.slope[i] / column[i]), self.curve - column**2
        self.picks, self._gone = [*self.picks, i], [*self._gone, column]
        c = e.known[int(e.owner[i])]
        # Not twice the same law at one site.
        at_odds = np.array([self.library.related(k, c) for k in e.known])
        self.open = self.open & ~at_odds[e.owner]


def _alone(slope: Array, curve: Array, limits: Array, usable: npt.NDArray[np.bool_]) -> tuple[Array, Array]:
    """(multiples, gains) of columns (K,), each for itself and in its bounds."""
    a = np.clip(np.divide(slope, curve, out=np.zeros_like(slope), where=usable), limits[:, 0], limits[:, 1])
    return a, np.where(usable, 2 * a * slope - a**2 * curve, 0.0)


def _both(curve: Array, slope: Array, low: Array, high: Array) -> Array:
    """Gains (K, K) of two columns together, 2 aᵀs − aᵀ C a with each multiple in its bounds."""
    own = np.diag(curve)
    usable = own > 1e-9
    own = np.where(usable, own, 1.0)
    det = np.outer(own, own) - curve**2
    safe = (det > 1e-6 * np.outer(own, own)) & np.outer(usable, usable)
    free = np.divide(slope[:, None] * own - curve * slope, det, out=np.zeros_like(curve), where=safe)
    first = np.clip(free, low[:, None], high[:, None])
    second = np.clip((slope - curve * first) / own, low, high)
    gain = (
        2 * (first * slope[:, None] + second * slope) - first**2 * own[:, None] - second**2 * own - 2 * first * second * curve
    )
    return np.where(safe, gain, 0.0)
