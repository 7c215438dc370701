"""A model with free numbers, and what it predicts for windows of a recording.

What hidden states remember where the history of a window begins is carried there along the measured motion.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import final
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Model, difference
from gapcert_diagnosis.data.dataset import Dataset, Windows, flat
from gapcert_diagnosis.thresholds import THRESHOLDS


@final
@dataclass(frozen=True)
class Hypothesis:
    """A model with free numbers: first values, bounds, difference steps; sd: of a normal prior about `value`, inf for none."""

    model: Model
    names: tuple[str, ...] = ()
    value: Array = field(default_factory=lambda: np.empty(0))
    low: Array = field(default_factory=lambda: np.empty(0))
    high: Array = field(default_factory=lambda: np.empty(0))
    step: Array = field(default_factory=lambda: np.empty(0))
    sd: Array = field(default_factory=lambda: np.empty(0))
    fixed: Mapping[str, float] = field(default_factory=dict)

    @property
    def charged(self) -> int:
        """Free numbers that the nominal model does not have."""
        return int(np.isinf(self.sd).sum())

    def theta(self, known: Mapping[str, float]) -> Array:
        """Numbers (p,): those that are known, and the others as they are stated."""
        return np.array([known.get(n, v) for n, v in zip(self.names, self.value.tolist(), strict=True)])

    def prior(self, theta: Array) -> Array:
        """Σ ((θ − θ₀)/sd)² of theta (…, p)."""
        return np.asarray(np.sum(((theta - self.value) / self.sd) ** 2, axis=-1))

    def holding(self, theta: Array) -> Hypothesis:
        """With all numbers fixed at theta."""
        return Hypothesis(self.model, fixed={**self.fixed, **dict(zip(self.names, theta.tolist(), strict=True))})

    def simulate(self, windows: Windows, theta: Array, start: Array) -> Array:
        """Outputs (b, W, L, ny) from theta (b, p) and starts (b, W, nx), at the times of the samples.

        Not finite where a motion blows up.
        """
        b, (w, length, _), m = len(theta), windows.y.shape, windows.measured
        with np.errstate(all="ignore"):
            hidden, values = self._begun(windows, theta), self._values(theta, w)
            x = self._moved(windows, theta, start, hidden, every=m.repeat)
            if self._shows_states():
                shown = x.reshape(b * w * length, -1)
            else:
                shown = seen(self.model, windows, x, values, hidden).reshape(b * w * length, -1)
            every = m.columns == tuple(range(shown.shape[1]))
            y = (shown if every else shown[:, m.columns]).reshape(b, w, length, -1)
            late = np.broadcast_to(self.model.output_delays(values), (b * w, len(self.model.outputs)))[:, m.columns]
            if late.any() or windows.offset.any():
                ahead = windows.offset[None, :, :, None] - (late.reshape(b, w, 1, -1) if late.any() else 0.0)
                y = between(y, ahead / m.period)
        return np.asarray(y)

    def motion(self, windows: Windows, theta: Array, start: Array, every: int = 1) -> Array:
        """States (b·W, (L − 1)·repeat // every + 1, nx) at every `every`-th model step."""
        return self._moved(windows, theta, start, self._begun(windows, theta), every)

    def _begun(self, windows: Windows, theta: Array) -> Array | None:
        """Hidden states (b·W, nh) where the windows begin."""
        return self._remembered(windows, theta) if self.model.hidden else None

    def _moved(self, windows: Windows, theta: Array, start: Array, hidden: Array | None, every: int) -> Array:
        w, m = len(windows), windows.measured
        u = windows.drive[:, m.past : m.past + (windows.length - 1) * m.repeat]
        start = start.reshape(len(theta) * w, -1)
        return self.model.fast_rollout(start, u, parameters=self._values(theta, w), hidden=hidden, every=every).x

    def led(self, windows: Windows, theta: Array, start: Array, rows: npt.NDArray[np.bool_]) -> Windows:
        """Windows whose history begins, in these rows, with the state (nx,) that leads to their start: Newton's shooting.

        At the edge of a recording speeds are guessed worst, and a bristle is bent by whatever they lead to.
        """
        part = windows.take(rows)
        past, nx = part.measured.past, start.shape[1]
        u, before, values = part.drive[:, :past], part.before.copy(), self._values(theta[None], len(part))
        hidden = recalled(self.model, part, self._values(theta[None], 1), 1)
        size = nudges(start)
        many = {n: np.tile(v, nx + 1) if np.ndim(v) else v for n, v in values.items()}
        for _ in range(THRESHOLDS.history_shots):
            tried = np.concatenate([before, *(before + size * e for e in np.eye(nx))])
            with np.errstate(all="ignore"):
                moved = self.model.fast_rollout(tried, u, parameters=many, hidden=np.tile(hidden, (nx + 1, 1)), every=past)
            end = moved.x[:, -1].reshape(nx + 1, len(part), nx)
            slope = np.moveaxis(difference(self.model.states, end[1:], end[0]), 0, -1) / size
            miss = difference(self.model.states, start[rows], end[0])
            if not (np.isfinite(slope).all() and np.isfinite(miss).all()):
                return windows
            before = before + (np.linalg.pinv(slope, rcond=THRESHOLDS.history_cutoff) @ miss[..., None])[..., 0]
        return windows.begun(before, rows)

    def _remembered(self, windows: Windows, theta: Array) -> Array:
        """Hidden states (b·W, nh) at the windows' beginnings, as far as these know them."""
        b, w = len(theta), len(windows)
        if windows.memory is None:
            # Rows that differ in their starts alone have one past.
            given = [tuple(row) for row in theta.tolist()]
            different = sorted(set(given))
            hidden = self.hidden(windows, np.array(different)).reshape(len(different), w, -1)
            return np.asarray(hidden[[different.index(row) for row in given]].reshape(b * w, -1))
        if windows.about is None or windows.leaning is None:
            return np.tile(windows.memory, (b, 1))
        moved = np.einsum("whp,bwp->bwh", windows.leaning, theta[:, None] - windows.about)
        return np.asarray((windows.memory + moved).reshape(b * w, -1))

    def remembering(self, windows: Windows, theta: Array) -> Windows:
        """Windows for rollouts at one theta (p,) only: what the model remembers where they begin is found once."""
        memory = self._begun(windows, theta[None])
        return replace(windows, memory=memory, about=None, leaning=None)

    def leaning(self, windows: Windows, theta: Array) -> Windows:
        """Windows for rollouts near theta (p,): what the model remembers where they begin follows the numbers to first order.

        A pass through all of a recording takes longer than the rollouts.
        """
        width = np.where(theta + self.step > self.high, -self.step, self.step)
        found = self.hidden(windows, np.concatenate([theta[None], theta + np.diag(width)])).reshape(
            1 + len(theta), len(windows), -1
        )
        slopes = np.moveaxis(found[1:] - found[0], 0, -1) / width
        about = np.tile(theta, (len(windows), 1))
        return replace(windows, memory=found[0], about=about, leaning=np.nan_to_num(slopes, posinf=0.0, neginf=0.0))

    def hidden(self, windows: Windows, theta: Array) -> Array:
        """Hidden states (b·W, nh) at the windows' beginnings, from motions through the history before them."""
        b, w, u = len(theta), len(windows), windows.drive[:, : windows.measured.past]
        hidden = recalled(self.model, windows, self._values(theta, 1), b)
        before, values = np.tile(windows.before, (b, 1)), self._values(theta, w)
        after = self.model.fast_rollout(before, u, parameters=values, hidden=hidden, every=max(1, u.shape[1])).hidden
        return hidden if after is None else after

    def _values(self, theta: Array, w: int) -> dict[str, Array | float]:
        """Of the parameters, one per row where they are free."""
        return {**self.fixed, **{n: np.repeat(theta[:, i], w) for i, n in enumerate(self.names)}}

    def _shows_states(self) -> bool:
        x = np.zeros((1, self.model.nx))
        return self.model.output(x, np.zeros((1, self.model.nu))) is x


def nudges(x: Array, share: float = THRESHOLDS.start_nudge) -> Array:
    """Difference steps (nx,) of states (…, nx)."""
    return np.asarray(share * np.maximum(np.sqrt(np.mean(x**2, axis=tuple(range(x.ndim - 1)))), 1e-3))


def between(y: Array, ahead: Array) -> Array:
    """Values of signals y (b, W, L, ny) `ahead` samples after each (broadcast to y): cubic through the four nearest."""
    b, w, length, ny = y.shape
    nodes = min(THRESHOLDS.sample_nodes, length)
    at = np.arange(length)[None, None, :, None] + ahead
    first = np.clip(np.floor(np.nan_to_num(at)) - (nodes // 2 - 1), 0, length - nodes)
    inside, base = at - first, first.astype(np.int64)
    # One clock for all motions and channels: these are looked up together, which takes a tenth of the time.
    alike = at.shape[0] == at.shape[3] == 1
    signals, shape, ny = (y.reshape(b, -1, ny), (1, w, length, 1), 1) if alike else (y.reshape(1, -1, 1), y.shape, ny)
    rows = (length * np.arange(shape[0] * w).reshape(-1, w, 1, 1) + base) * ny + np.arange(ny)
    out = np.zeros_like(signals)
    for j in range(nodes):
        weight = np.ones_like(inside)
        for k in range(nodes):
            if k != j:
                weight *= (inside - k) / (j - k)
        out += signals.take(rows.ravel() + j * ny, axis=1) * np.broadcast_to(weight, shape).reshape(1, -1, 1)
    return np.asarray(out.reshape(y.shape))


def seen(
    model: Model, windows: Windows, x: Array, values: Mapping[str, Array | float], hidden: Array | None, back: int = 0
) -> Array:
    """Outputs (n, K, ny) at K samples from `back` before each window on, of motions x (n, K, nx), W dividing n.

    values: a number each, or one per motion; hidden (n, nh): at the first of these samples.
    """
    n, count, w, m = *x.shape[:2], len(windows), windows.measured
    u: Array = windows.u[None, :, m.history - back :][:, :, :count]
    if (late := model.input_delays(values)).any():
        u = _arriving(windows, np.broadcast_to(late, (n, model.nu)).reshape(-1, w, model.nu), count, back)
    rows = {k: np.repeat(v, count) if np.ndim(v) else v for k, v in values.items()}
    known = None
    if hidden is not None and shows_memory(model):
        drive = windows.drive[:, m.past - back * m.repeat :][:, : (count - 1) * m.repeat]
        known = flat(memories(model, x, drive, values, hidden, m.repeat))
    u = np.broadcast_to(u, (n // w, *u.shape[1:]))
    return model.output(flat(x), flat(u), rows, known).reshape(n, count, -1)


def _arriving(windows: Windows, late: Array, count: int, back: int) -> Array:
    """Inputs (b, W, count, nu) as they arrive `late` (b, W, nu) seconds after they were sent, as they are held."""
    m, out = windows.measured, np.empty((*late.shape[:2], count, late.shape[2]))
    for k, (piece, first) in enumerate(windows.place.tolist()):
        at = first - back + np.arange(count) - late[:, k, :, None] / m.period
        at = np.clip(at if m.hold == "first" else np.floor(at + THRESHOLDS.whole_sample), 0, None)
        for j, sent in enumerate(m.inputs[piece].T):
            out[:, k, :, j] = np.interp(at[:, j], np.arange(len(sent)), sent)
    return out


def shows_memory(model: Model) -> bool:
    """Do outputs show what is remembered: are they unknown where it is?"""
    x, u, unknown = (np.full((1, k), v) for k, v in ((model.nx, 0.0), (model.nu, 0.0), (len(model.hidden), np.nan)))
    with np.errstate(all="ignore"):
        return bool(model.hidden) and bool(np.isnan(model.output(x, u, None, unknown)).any())


def memories(model: Model, x: Array, drive: Array, values: Mapping[str, Array | float], hidden: Array, repeat: int) -> Array:
    """Hidden states (n, K, nh) at the samples of motions x (n, K, nx), from those at the first.

    What an input leaves behind does not depend on the motion, which may therefore be any.
    """
    stops, path = np.arange(x.shape[1]) * repeat, np.full((*drive.shape[:2], x.shape[2]), np.nan)
    if drive.shape[1] == 0:
        return hidden[:, None]
    path[:, 0] = x[: len(drive), 0]
    if (found := model.fast_memories(path, drive, stops.tolist(), values, hidden)) is not None:
        return found
    out = [hidden]
    for k, stop in enumerate(stops[:-1].tolist()):
        step = model.fast_rollout(x[:, k], drive[:, stop : stop + repeat], parameters=values, hidden=out[-1], every=repeat)
        out.append(out[-1] if step.hidden is None else step.hidden)
    return np.stack(out, axis=1)


def recalled(model: Model, windows: Windows, parameters: Mapping[str, Array | float], count: int) -> Array:
    """Hidden states (count·W, nh), `history` samples before each window, for parameters of shape (count,) or ().

    A lag, a play or a sagging supply knows more of the past than the history before a window tells.
    """
    out = _defaults(model, count, windows.t - windows.measured.history * windows.measured.period)
    if len(model.hidden) > ("time" in {s.name for s in model.hidden}):
        if windows not in _WAYS:
            first = windows.place[:, 1] - windows.measured.history
            rows = {piece: np.flatnonzero(windows.place[:, 0] == piece) for piece in np.unique(windows.place[:, 0]).tolist()}
            _WAYS[windows] = _Way(windows.measured, rows, {p: first[r] for p, r in rows.items()})
        past = _Past(model, _WAYS[windows], parameters, count)
        for piece, hidden in past.found().items() if model.remembers else ():
            out[:, _WAYS[windows].rows[piece]] = hidden
        _commanded(model, windows, past, out)
    return out.reshape(count * len(windows), -1)


def _commanded(model: Model, windows: Windows, past: _Past, out: Array) -> None:
    """Late inputs among hidden states (count, W, nh), as they were commanded."""
    m = windows.measured
    for i, late in _late(model).items():
        back = np.array([int(model.hidden[j].name.rpartition("_")[2]) for j in late])
        for w, (piece, first) in enumerate(windows.place.tolist()):
            at = (first - m.history) * m.repeat - back
            out[:, w, late] = m.driven[piece][np.maximum(at, 0), i]
            if at.min() < 0:
                begun = past.start[:, past.way.pieces.index(piece), late]
                out[:, w, late] = np.where(at < 0, begun, out[:, w, late])


def _late(model: Model) -> dict[int, list[int]]:
    """Which hidden states are an input's past, by the inputs that have one."""
    names = [s.name.rpartition("_")[0] for s in model.hidden]
    found = {i: [j for j, n in enumerate(names) if n == f"{s.name}_delay"] for i, s in enumerate(model.inputs)}
    return {i: late for i, late in found.items() if late}


def _defaults(model: Model, count: int, t: Array) -> Array:
    """Hidden states (count, n, nh) at times (n,) of which nothing is remembered."""
    out = np.tile(model.hidden_default, (count, len(t), 1))
    names = [s.name for s in model.hidden]
    if "time" in names:
        out[:, :, names.index("time")] = t
    return out


@final
@dataclass(frozen=True)
class _Way:
    """The measured motion of all pieces, onto which models are put back every `free_stretch` and at their stops (piece →
    samples).

    rows: piece → the windows that begin in it. It is the same for every model and all its numbers.
    """

    measured: Dataset
    rows: Mapping[int, npt.NDArray[np.intp]]
    stops: Mapping[int, Array]

    @cached_property
    def pieces(self) -> list[int]:
        """Those that end last come first."""
        return sorted(self.stops, key=lambda p: -int(self.stops[p].max()))

    @cached_property
    def own(self) -> list[set[int]]:
        """The samples at which each piece is put back."""
        last = int(self.stops[self.pieces[0]].max())
        every = {0, *range(0, last, self.measured.samples(THRESHOLDS.free_stretch))}
        return [every | set(self.stops[p].tolist()) for p in self.pieces]

    @cached_property
    def marks(self) -> list[int]:
        return sorted(set().union(*self.own))

    @cached_property
    def blind(self) -> Array:
        """States (nx,) that no channel shows: they go on as the model has them."""
        return np.asarray(~np.any(np.concatenate(self.measured.states), axis=0))

    @cached_property
    def path(self) -> tuple[Array, Array]:
        """(states (pieces, steps, nx), NaN where the motion is free; inputs (pieces, steps, nu)) at every model step."""
        m, w, steps = self.measured, len(self.pieces), max(1, self.marks[-1] * self.measured.repeat)
        path, u = np.full((w, steps, m.states[0].shape[1]), np.nan), np.zeros((w, steps, m.driven[0].shape[1]))
        for i, p in enumerate(self.pieces):
            drive = m.driven[p][:steps]
            u[i, : len(drive)] = drive
            at = np.array([a for a in self.own[i] if a * m.repeat < steps and a < len(m.states[p])])
            path[i, at * m.repeat] = np.where(self.blind, np.nan, m.states[p][at])
        return path, u


_WAYS = WeakKeyDictionary[Windows, _Way]()


@final
@dataclass(frozen=True)
class _Past:
    """Motions along a way."""

    model: Model
    way: _Way
    parameters: Mapping[str, Array | float]
    count: int

    def found(self) -> dict[int, Array]:
        """Per piece, hidden states (count, stops, nh)."""
        known, way = self._at_once() or self._stepwise(), self.way
        return {p: np.stack([known[s][:, i] for s in way.stops[p].tolist()], axis=1) for i, p in enumerate(way.pieces)}

    @cached_property
    def start(self) -> Array:
        """Hidden states (count, pieces, nh) at the first sample: before a recording nothing acted, or its first input did, or
        what holds its first state at rest.

        A machine that is just switched on, or at an operating point: the first samples tell.
        """
        u, first = self.way.path[1], [self.way.measured.times[p][0] for p in self.way.pieces]
        hidden = _defaults(self.model, self.count, np.array(first))
        begun = np.tile(u[:, 0], (self.count, 1, 1))
        levels = [v for v in (begun, self._resting(begun)) if v is not None and v.any()]
        if not levels:
            return hidden
        plain = self._settled(0 * begun, hidden)
        own = plain == hidden  # what moves without an input is bent by the motion, which was another one before
        for i, late in _late(self.model).items():
            hidden[..., late] = begun[..., i, None]
        best, least = hidden, self._missed(hidden)
        for settled in (*(self._settled(level, hidden) for level in levels), plain):
            settled = np.where(np.isfinite(settled) & own, settled, hidden)
            missed = self._missed(settled)
            best, least = np.where((missed < least)[..., None], settled, best), np.minimum(missed, least)
        return best

    def _resting(self, u: Array) -> Array | None:
        """Inputs (count, pieces, nu) that hold the first states at rest, to first order; u: the first ones.

        None where states are not known, or where no input but these or none does.
        """
        m, model = self.way.measured, self.model
        if self.way.blind.any() or not model.nu:
            return None
        loose = {p.name for p in model.parameters if p.tolerance > 0}
        rows = {n: v for n, v in self._rows(u.shape[1]).items() if n in loose}
        x, size = np.tile([m.states[p][0] for p in self.way.pieces], (self.count, 1)), np.std(np.concatenate(m.inputs), axis=0)
        spread, size = np.maximum(np.std(np.concatenate(m.states), axis=0), 1e-300), np.maximum(size, 1e-300)

        def off(by: Array) -> Array:
            return np.asarray(difference(model.states, model.step(x, flat(u) + by, parameters=rows).x, x) / spread)

        with np.errstate(all="ignore"):
            here = off(np.zeros(model.nu))
            slope = np.nan_to_num(np.stack([off(d) - here for d in np.diag(size)], axis=-1))
            moved = (np.linalg.pinv(slope) @ np.nan_to_num(here)[..., None])[..., 0].reshape(u.shape) * size
        new = np.minimum(np.abs(u - moved), np.abs(moved)) > THRESHOLDS.other_level * size
        return u - moved if new.any() else None

    def _settled(self, u: Array, hidden: Array) -> Array:
        """What is remembered where first states, and inputs (count, pieces, nu), have been held for as long as the log is."""
        out = hidden.copy()
        if self.model.remembers:
            long, first = max(len(self.way.measured.driven[p]) for p in self.way.pieces), self.way.path[0][:, 0]
            x, drive = (np.repeat(a[:, None], long, axis=1) for a in (np.tile(first, (self.count, 1)), flat(u)))
            rows, given = self._rows(len(first)), flat(hidden)
            found = self.model.fast_memories(x, drive, [long - 1], rows, given)
            if found is None:
                found = self.model.fast_rollout(np.nan_to_num(x[:, 0]), drive, parameters=rows, hidden=given, every=long).hidden
            out = out if found is None else found.reshape(hidden.shape)
        for i, late in _late(self.model).items():
            out[..., late] = u[..., i, None]
        return out

    def _missed(self, hidden: Array) -> Array:
        """Squares (count, pieces) by which the first samples are missed from there on, in spreads of the states."""
        m, pieces = self.way.measured, self.way.pieces
        few = min(max(THRESHOLDS.first_samples, m.samples(THRESHOLDS.free_stretch)), *(len(m.states[p]) - 1 for p in pieces))
        seen = np.tile([m.states[p][: few + 1] for p in pieces], (self.count, 1, 1))
        u, rows = np.stack([m.driven[p][: few * m.repeat] for p in pieces]), self._rows(len(pieces))
        with np.errstate(all="ignore"):
            moved = self.model.fast_rollout(seen[:, 0], u, parameters=rows, hidden=flat(hidden), every=m.repeat).x
            off = difference(self.model.states, moved, seen) / np.maximum(np.std(np.concatenate(m.states), axis=0), 1e-300)
        missed = np.sum(np.where(self.way.blind, 0.0, off) ** 2, axis=(1, 2))
        return np.asarray(np.nan_to_num(missed, nan=np.inf).reshape(hidden.shape[:2]))

    def _rows(self, pieces: int) -> dict[str, Array | float]:
        return {n: np.repeat(v, pieces) if np.ndim(v) else v for n, v in self.parameters.items()}

    def _at_once(self) -> dict[int, Array] | None:
        """Mark → hidden states (count, pieces, nh), where the model knows a way."""
        way, (path, u) = self.way, self.way.path
        hidden = self.start.reshape(self.count * len(way.pieces), -1)
        stops = [a * way.measured.repeat for a in way.marks]
        found = self.model.fast_memories(path, u, stops, self._rows(len(way.pieces)), hidden)
        return None if found is None else {a: found[:, k].reshape(self.start.shape) for k, a in enumerate(way.marks)}

    def _stepwise(self) -> dict[int, Array]:
        """The same, by rollouts from mark to mark; pieces that end first leave first."""
        way, m, hidden = self.way, self.way.measured, self.start
        last = np.array([way.stops[p].max() for p in way.pieces])
        known, x = {0: hidden}, np.tile([m.states[p][0] for p in way.pieces], (self.count, 1, 1))
        for a, b in itertools.pairwise(way.marks):
            here = way.pieces[: int(np.count_nonzero(last >= b))]
            w, steps = len(here), (b - a) * m.repeat
            free = way.blind | np.array([[a not in way.own[i]] for i in range(w)])
            x = np.where(free, np.nan_to_num(x[:, :w]), [m.states[p][a] for p in here])
            hidden = hidden[:, :w]
            moved = self.model.fast_rollout(
                x.reshape(self.count * w, -1),
                np.stack([m.driven[p][a * m.repeat : b * m.repeat] for p in here]),
                parameters=self._rows(w),
                hidden=hidden.reshape(self.count * w, -1),
                every=steps,
            )
            assert moved.hidden is not None
            new = moved.hidden.reshape(hidden.shape)
            x, hidden = moved.x[:, -1].reshape(x.shape), np.where(np.isfinite(new), new, hidden)
            known[b] = hidden
        return known
