"""The same measurement twice: trajectories, or stretches of them, that hold the values of another, noise included.

Found by content, whatever their names, clocks, lengths, formats and digits are. A repetition of one command is no copy, since
what is measured has noise of its own; nor are two logs that stand still at the same values.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import SHORTEST, Array, Bools, Recording, Trajectory
from gapcert_recordings.thresholds import THRESHOLDS

Rows = npt.NDArray[np.intp]
_EPS = float(np.finfo(np.float64).eps)
SINGLE_DIGITS = 7  # that single precision keeps: any number of it has more


@final
@dataclass(frozen=True)
class Copy:
    """`rows` rows of trajectory `name`, from `start` s on, hold what is in trajectory `of`; whole: there are no others."""

    name: str
    of: str
    start: float
    rows: int
    whole: bool

    def __str__(self) -> str:
        part = "is" if self.whole else f"has {self.rows} rows from {self.start:.6g} s on that are"
        return f"'{self.name}' {part} a copy of {'' if self.whole else 'rows of '}'{self.of}'"


@final
@dataclass(frozen=True)
class Copies:
    """What counts once: found, and per trajectory which of its rows (T,) are in another one that counts."""

    found: tuple[Copy, ...]
    rows: tuple[Bools, ...]

    @classmethod
    def of(
        cls, recording: Recording, inputs: Collection[str] = (), first: Collection[int] = (), within: bool = False
    ) -> Copies:
        """Longer trajectories count before shorter ones, and then those that were read before; those in `first` before all.

        inputs: channels that are commanded, which may be the same to the last bit in two different measurements. within: are
        rows compared with those of their own trajectory, too?
        """
        series = [_Series.of(tr, inputs) for tr in recording.trajectories]
        order = sorted(range(len(series)), key=lambda i: (i not in first, -len(series[i].t), series[i].coarse, i))
        rows, found = tuple(np.zeros(len(s.t), dtype=bool) for s in series), dict[tuple[int, int], Rows]()
        # Few neighbours are looked up of a row: more copies of it are found once these are left out.
        while new := _found(series, [i for i in order if not rows[i].all()], rows, within):
            found |= new
        titles = _titles(recording.trajectories)
        told = []
        for (a, b), k in sorted(found.items(), key=lambda item: (item[0][1], item[1][0])):
            tr = recording.trajectories[b]
            told.append(Copy(titles[b], titles[a], float(tr.t[k[0]]), len(k), len(k) == len(tr)))
        return cls(tuple(told), rows)

    def kept(self, tr: Trajectory, number: int) -> Trajectory | None:
        """What counts of the trajectory of that number, without values in rows that are copies; None where too few are left."""
        rows = self.rows[number]
        left = {n: np.where(rows, np.nan, v) for n, v in tr.channels.items()}
        enough = all(np.isfinite(v).sum() >= SHORTEST for v in left.values())
        return tr if not rows.any() else replace(tr, channels=left) if enough else None

    def without(self, recording: Recording) -> Recording:
        """What counts of all trajectories."""
        kept = (self.kept(tr, i) for i, tr in enumerate(recording.trajectories))
        return replace(recording, trajectories=tuple(tr for tr in kept if tr is not None)) if self.found else recording

    @property
    def told(self) -> str:
        """How many of the trajectories, and the `copies_told` first by name, those that are copies as a whole before others, in
        one sentence without its end; empty where nothing was found.
        """
        if not self.found:
            return ""
        whole, parts = ([c for c in self.found if c.whole is k] for k in (True, False))
        named = [*map(str, whole[:1]), *(f"'{c.name}' of '{c.of}'" for c in whole[1:]), *map(str, parts)]
        named, more = named[: THRESHOLDS.copies_told], len(named) - THRESHOLDS.copies_told
        count = len({c.name for c in self.found})
        one, many = ("has rows that are", "have rows that are") if parts else ("is", "are")
        are = f"{one} a copy and counts" if count == 1 else f"{many} copies of others and count"
        rest = [f"and {more} more"] if more > 0 else []
        return f"{count} of {len(self.rows)} trajectories {are} once: {', '.join([*named, *rest])}"

    def summary(self) -> list[dict[str, Any]]:
        """As plain data: name, of, start, rows and whole of each."""
        return [vars(c).copy() for c in self.found]


def _titles(trajectories: Sequence[Trajectory]) -> list[str]:
    """Names, with a number where several share one."""
    names = [tr.name for tr in trajectories]
    return [f"{n} ({names[: i + 1].count(n)})" if names.count(n) > 1 else n for i, n in enumerate(names)]


@final
@dataclass(frozen=True)
class _Series:
    """A trajectory as it was written: values (T, c), by the names of the channels; `measured` (c,) are not commanded.

    forms: how the values of each channel are written; quantum (T, c): by how much a value differs from the next that can be.
    """

    t: Array
    values: Array
    measured: Bools
    forms: tuple[tuple[int, int, bool], ...]
    quantum: Array

    @classmethod
    def of(cls, tr: Trajectory, inputs: Collection[str]) -> _Series:
        names = sorted(tr.channels)
        values = np.stack([tr.channels[n] for n in names], axis=1)
        forms = tuple(_form(v) for v in values.T)
        quantum = np.stack([_quantum(v, form) for v, form in zip(values.T, forms, strict=True)], axis=1)
        return cls(tr.t, values, np.array([n not in inputs for n in names]), forms, quantum)

    @property
    def coarse(self) -> float:
        """How much of each value its digits leave open, on the whole."""
        size = np.broadcast_to(np.nanmax(np.abs(self.values), axis=0), self.quantum.shape)
        return float(np.mean(np.divide(self.quantum, size, out=np.zeros(size.shape), where=size > 0)))

    @cached_property
    def clock(self) -> float:
        """What the digits of the times leave open, in rows."""
        period = float(np.median(np.diff(self.t)))
        return float(_quantum(self.t, _form(self.t)).max()) / period if period > 0 else 0.0

    @cached_property
    def moves(self) -> Bools:
        """(T, c): where a value is another than that of the row before."""
        there = np.isfinite(self.values)
        moved = (self.values[1:] != self.values[:-1]) & there[1:] & there[:-1]
        return np.vstack([np.zeros((1, self.values.shape[1]), dtype=bool), moved])

    @cached_property
    def bits(self) -> Array:
        """(c,): what it tells, at least, that another measurement changes to the same value in the same row.

        A half by chance where the noise is below the step of the values, and less by the size of the noise where it is above.
        """
        from .smoothing import noise_floor

        out = np.ones(self.values.shape[1])
        for j, v in enumerate(self.values.T):
            known = v[np.isfinite(v)]
            if (noise := noise_floor(known)) > 0:
                out[j] += np.log2(1 + noise / max(_step(known), float(self.quantum[:, j].max())))
        return np.where(self.measured, out, 0.0)


def _step(v: Array) -> float:
    """The step of a lattice on which values (n,) lie, as counts do, by Euclid's algorithm; 0 where they lie on none."""
    gaps = np.diff(np.unique(v))
    gaps = gaps[gaps > 1e-9 * gaps.sum()]
    left = gaps
    while len(left) and (step := float(left.min())) > 1e-9 * gaps.sum():
        # What is written with few digits knows a step from many of them.
        for most in (1, 5, 50, np.inf):
            counts = np.round(gaps / step)
            few = (counts > 0) & (counts <= most) & (np.abs(gaps - step * counts) < 0.05 * step)
            step = float(gaps[few] @ counts[few] / (counts[few] @ counts[few])) if few.any() else step
        left = np.abs(gaps - step * np.round(gaps / step))
        left = left[left > 1e-3 * step]
        if not len(left):
            return step
    return 0.0


def _form(v: Array) -> tuple[int, int, bool]:
    """(digits behind the point, digits in all, was it in single precision?) of how values (T,) are written; 17 where more."""
    known = v[np.isfinite(v) & (v != 0)]
    some = known[:: max(1, len(known) // THRESHOLDS.form_values)]
    with np.errstate(over="ignore", under="ignore"):
        single = some.astype(np.float32)
    plain = _digits(some, 4 * _EPS * np.abs(some))
    # What was rounded first and written in single precision next, or the other way round, was both.
    left, apart = _quantum(some, (*plain, False)), np.spacing(np.abs(single)).astype(np.float64)
    if len(some) and (np.abs(single - some) <= left).all() and 4 * np.median(left) <= np.median(apart):
        behind, digits = _digits(some, 0.6 * apart)
        return (behind, digits, True) if digits <= SINGLE_DIGITS else (17, 17, True)
    return *plain, False


def _single(s: _Series, values: Array) -> Array:
    """(n, c): how far single precision puts numbers apart, where a channel was in it."""
    size = np.maximum(np.abs(np.nan_to_num(values)), np.finfo(np.float32).tiny)
    return np.where([form[2] for form in s.forms], np.spacing(size.astype(np.float32)).astype(np.float64), 0.0)


def _digits(v: Array, near: Array) -> tuple[int, int]:
    """(behind the point, in all) that give values (n,) to within `near`."""
    power = 10.0 ** np.floor(np.log10(np.abs(v)))
    behind = next((d for d in range(13) if (np.abs(np.round(v, d) - v) <= near).all()), 17)
    digits = next((d for d in range(1, 15) if (np.abs(np.round(v / power, d - 1) * power - v) <= near).all()), 17)
    return behind, digits


def _quantum(v: Array, form: tuple[int, int, bool]) -> Array:
    """(T,)"""
    behind, digits, single = form
    size = np.maximum(np.abs(np.nan_to_num(v)), np.finfo(np.float64).tiny)
    out = 4 * _EPS * size
    if single:
        out = np.maximum(out, np.spacing(size.astype(np.float32)).astype(np.float64))
    if behind < 17:
        out = np.maximum(out, 10.0**-behind)
    return np.maximum(out, 10.0 ** (np.floor(np.log10(size)) - digits + 1)) if digits < 17 else out


def _found(series: Sequence[_Series], order: Sequence[int], rows: Sequence[Bools], within: bool) -> dict[tuple[int, int], Rows]:
    """(a, b): rows of b that are in a, an earlier one of the order; they are marked."""
    kept, found = [series[i] for i in order], dict[tuple[int, int], Rows]()
    if len(kept) == 1 and not within:
        return found
    for (j, k), places in sorted(_meetings(kept, within).items(), key=lambda item: item[0][::-1]):
        a, b = order[j], order[k]
        own = np.any([_shared(kept[j], kept[k], at, rows[a]) for at in places], axis=0) & ~rows[b]
        if own.any():
            found[a, b] = np.flatnonzero(own)
            rows[b][own] = True
    return found


def _meetings(series: Sequence[_Series], within: bool) -> dict[tuple[int, int], list[Array]]:
    """Of trajectories (a, b), a before b, that may share rows: where in a, in rows, those of b (T,) would be.

    Where several rows lie alike, and as far apart in both, they are worth a look. Trajectories may be sampled at other rates.
    """
    found: dict[tuple[int, int], list[Array]] = {}
    periods, points, every = [float(np.median(np.diff(s.t))) for s in series], _scaled(series), range(len(series))
    slower = _distinct(periods)
    ratios = {round(p / q) for p, q in itertools.combinations(slower, 2)}
    for step in sorted({1, *THRESHOLDS.copy_steps, *(r for r in ratios if r <= THRESHOLDS.copy_ratio)}):
        for a, b, fine, shift in _alike(points, step, within):
            rows = np.arange(len(series[b].t))
            place = step * rows + float(shift) if fine == a else (rows - float(shift)) / step
            found.setdefault((a, b), []).append(np.asarray(place))
    for a, b in itertools.combinations(every, 2) if len(slower) > 1 else ():
        if abs(periods[a] - periods[b]) > 0.02 * periods[a]:
            found.setdefault((a, b), []).extend(_resampled(series[a], series[b]))
    return found


def _distinct(periods: Sequence[float]) -> list[float]:
    """Those that differ by more than what clocks do."""
    out: list[float] = []
    for period in sorted((p for p in periods if p > 0), reverse=True):
        if not out or period < 0.98 * out[-1]:
            out.append(period)
    return out


def _scaled(series: Sequence[_Series]) -> list[Array]:
    """Values (T, c) of the channels that tell most, in units of what their digits leave open."""
    every, quantum = (np.concatenate([getattr(s, n) for s in series]) for n in ("values", "quantum"))
    alike = np.array([len({s.forms[j][:2] for s in series}) == 1 for j in range(every.shape[1])])
    size = np.abs(np.nan_to_num(every)).max(axis=0)
    single = np.any([[form[2] for form in s.forms] for s in series], axis=0)
    same = np.where(single, 2 * np.spacing(size.astype(np.float32)), 8 * _EPS * size)
    open_ = np.where(alike, same, 2 * quantum.max(axis=0) + same) + np.finfo(np.float64).tiny
    told = np.array([len(np.unique(column)) for column in every.T])
    best = np.argsort(-told - len(every) * series[0].measured, kind="stable")[: THRESHOLDS.copy_channels]
    return [np.nan_to_num(s.values[:, best]) / open_[best] for s in series]


def _alike(points: Sequence[Array], step: int, within: bool) -> Iterator[tuple[int, int, int, int]]:
    """(a, b, fine, shift): rows of a and b that are alike where of `fine`, one of both, every step-th row is taken.

    Row i of that one and row j of the other belong together as i = step·j + shift.
    """
    from scipy.spatial import cKDTree

    parts = [_lagged(v, i, k, len(points)) for k in sorted({1, step}) for i, v in enumerate(points)]
    z, row, number, steps = (np.concatenate(part) for part in zip(*parts, strict=True))
    asked = np.flatnonzero(steps == 1)
    asked = asked[:: 1 + len(asked) // (THRESHOLDS.copy_queries if step == 1 else THRESHOLDS.copy_queries // 4)]
    own = np.flatnonzero(steps == step)
    if not len(own) or not len(asked):
        return
    tree = cKDTree(z[own], balanced_tree=False, compact_nodes=False)
    near = tree.query(z[asked], k=THRESHOLDS.copy_neighbours, p=np.inf, distance_upper_bound=1.0 + 1e-6)[1]
    i, j = near.reshape(-1), np.repeat(asked, near.shape[1])
    i, j = own[i[i < len(own)]], j[i < len(own)]
    shift, apart = row[i] - step * row[j], number[i] != number[j]
    if step == 1:
        # Each of two is found beside the other.
        first = (number[i] < number[j]) | ((number[i] == number[j]) & (row[i] < row[j]))
        apart = first & (apart | (within & (row[j] - row[i] >= THRESHOLDS.copy_apart)))
    a, b = np.minimum(number[i], number[j]), np.maximum(number[i], number[j])
    met, votes = np.unique(np.stack([a, b, number[i], shift], axis=1)[apart], axis=0, return_counts=True)
    met, votes = met[votes >= THRESHOLDS.copy_votes], votes[votes >= THRESHOLDS.copy_votes]
    best = np.lexsort((-votes, met[:, 1], met[:, 0]))
    start = np.unique(met[best, :2], axis=0, return_index=True)[1]
    for k, stop in itertools.pairwise([*start.tolist(), len(best)]):
        yield from (tuple(m) for m in met[best[k : min(stop, k + THRESHOLDS.copy_places)]].tolist())


def _lagged(v: Array, number: int, step: int, count: int) -> tuple[Array, Rows, Rows, Rows]:
    """Rows of one trajectory with some that follow every so many, where those are not all the same; row, number and step."""
    apart = THRESHOLDS.copy_lag * step
    lagged = [v[k * apart :][: max(len(v) - 3 * apart, 0)] for k in range(4)]
    moving = np.flatnonzero(np.any([(lagged[0] != later).any(axis=1) for later in lagged[1:]], axis=0))
    # Of rows that are the same, those of neighbours in the order are the nearest.
    place = np.full((len(moving), 1), 0.5 * number / count)
    one = np.ones(len(moving), dtype=np.intp)
    return np.hstack([*(part[moving] for part in lagged), place]), moving, number * one, step * one


def _resampled(a: _Series, b: _Series) -> list[Array]:
    """Where rows of b would be in a by their clocks, or had both begun or ended together."""
    shifts = {0.0, float(b.t[0] - a.t[0]), float(b.t[-1] - a.t[-1])}
    if not ((np.diff(a.t) > 0).all() and np.isfinite(a.t).all() and np.isfinite(b.t).all()):
        return []
    return [np.interp(b.t - shift, a.t, np.arange(len(a.t)), left=-1.0, right=-1.0) for shift in shifts]


def _shared(a: _Series, b: _Series, at: Array, marked: Bools) -> Bools:
    """(T,): which rows of b are those at places `at` (T,) of a, in stretches that tell enough.

    What a row that is marked is itself a copy of is equal to b as well only where nothing was rounded.
    """
    out = np.zeros(len(at), dtype=bool)
    coarse = len(at) > 1 and 0 < at[1] - at[0] < 0.98
    known = np.flatnonzero((at >= 0) & (at <= len(a.t) - 1) & (not coarse or np.abs(at - np.round(at)) < 0.01))
    if len(known) < THRESHOLDS.copy_rows:
        return out
    same = _equal(a, b, at, known)
    if a.forms != b.forms:
        same &= ~marked[np.round(at[known]).astype(np.intp)]
    event = np.where(np.isfinite(a.values[np.round(at[known]).astype(np.intp)]), b.moves[known] * b.bits, 0.0).max(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]))).reshape(-1, 2)
    total = np.concatenate([[0.0], np.cumsum(event)])
    long = edges[:, 1] - edges[:, 0] >= THRESHOLDS.copy_rows
    for start, stop in edges[long & (total[edges[:, 1]] - total[edges[:, 0]] >= THRESHOLDS.copy_bits)].tolist():
        if _told(event[start + 1 : stop], event > 0, same, start, stop):
            out[known[start] : known[stop - 1] + 1] = True
    return out


def _told(bits: Array, event: Bools, same: Bools, start: int, stop: int) -> bool:
    """Do the rows of a stretch tell enough, with these bits each, beside the others of the alignment?

    Where steps are coarse and noise is small, two measurements may agree in many rows; in how many, the others show.
    """
    others = np.concatenate([same[:start][event[:start]], same[stop:][event[stop:]]])
    if len(others) >= THRESHOLDS.copy_rows:
        chance = -np.log2((others.sum() + 1) / (len(others) + 2))
        bits = np.where(bits < THRESHOLDS.copy_coarse, np.minimum(bits, chance), bits)
    return bool(bits.sum() >= THRESHOLDS.copy_bits)


def _equal(a: _Series, b: _Series, at: Array, known: Rows) -> Bools:
    """Which of the `known` rows of b are, channel by channel, within what the digits of both leave open."""
    place = at[known]
    low = np.minimum(np.floor(place).astype(np.intp), len(a.t) - 1)
    high, part = np.minimum(low + 1, len(a.t) - 1), (place - low)[:, None]
    value, own = a.values[low], b.values[known]
    step = np.where(part > 0, a.values[high] - value, 0.0)
    alike = np.array([p[:2] == q[:2] for p, q in zip(a.forms, b.forms, strict=True)]) & (part == 0)
    one, two = a.quantum[low], b.quantum[known]
    rounded = np.where(alike, 0.0, one + two) + (_single(a, value) + _single(b, own))
    # Where rows lie between others, the digits of the times count as well.
    between = np.abs(step) * (a.clock + b.clock) if step.any() else 0.0
    allowed = rounded + 8 * _EPS * np.abs(own) + between
    # A value that is missing contradicts none.
    return np.asarray(~(np.abs(value + part * step - own) > allowed).any(axis=1))
