"""A model with free numbers, and what it predicts for windows of a recording.

What hidden states remember where the history of a window begins is carried there along the measured motion.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import final
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Model, difference
from gapcert_diagnosis.data.dataset import Dataset, Windows, flat
from gapcert_diagnosis.thresholds import THRESHOLDS

Acted = Mapping[tuple[float, ...], Array]
NOTHING: Acted = {}


@final
@dataclass(frozen=True)
class Hypothesis:
    """A model with free numbers: first values, bounds, difference steps; sd: of a normal prior about `value`, inf for none.

    acted: beginning of a piece of a recording → inputs (nu,) that had always acted before it, where that is known; begun: how
    many of these are fitted.
    """

    model: Model
    names: tuple[str, ...] = ()
    value: Array = field(default_factory=lambda: np.empty(0))
    low: Array = field(default_factory=lambda: np.empty(0))
    high: Array = field(default_factory=lambda: np.empty(0))
    step: Array = field(default_factory=lambda: np.empty(0))
    sd: Array = field(default_factory=lambda: np.empty(0))
    fixed: Mapping[str, float] = field(default_factory=dict)
    acted: Acted = field(default_factory=dict)
    begun: int = 0

    @property
    def charged(self) -> int:
        """Free numbers that the nominal model does not have."""
        return int(np.isinf(self.sd).sum()) + self.begun

    def theta(self, known: Mapping[str, float]) -> Array:
        """Numbers (p,): those that are known, and the others as they are stated."""
        return np.array([known.get(n, v) for n, v in zip(self.names, self.value.tolist(), strict=True)])

    def prior(self, theta: Array) -> Array:
        """Σ ((θ − θ₀)/sd)² of theta (…, p)."""
        return np.asarray(np.sum(((theta - self.value) / self.sd) ** 2, axis=-1))

    def holding(self, theta: Array) -> Hypothesis:
        """With all numbers fixed at theta."""
        known = {**self.fixed, **dict(zip(self.names, theta.tolist(), strict=True))}
        return Hypothesis(self.model, fixed=known, acted=self.acted)

    def simulate(self, windows: Windows, theta: Array, start: Array) -> Array:
        """Outputs (b, W, L, ny) from theta (b, p) and starts (b, W, nx), at the times of the samples.

        Not finite where a motion blows up.
        """
        b, (w, length, _), m = len(theta), windows.y.shape, windows.measured
        with np.errstate(all="ignore"):
            hidden, values = self._begun(windows, theta), self._values(theta, w)
            late = np.broadcast_to(self.model.output_delays(values), (b * w, len(self.model.outputs)))[:, m.columns]
            ahead = windows.offset[None, :, :, None] - (late.reshape(b, w, 1, -1) if late.any() else 0.0)
            if ahead.any() and m.hold == "zero" and shows_states(self.model):
                x = self._moved(windows, theta, start, hidden, every=1)
                return self._late(windows, x, values, hidden, ahead / m.period)
            x = self._moved(windows, theta, start, hidden, every=m.repeat)
            if shows_states(self.model):
                shown = x.reshape(b * w * length, -1)
            else:
                shown = seen(self.model, windows, x, values, hidden, acted=self.acted).reshape(b * w * length, -1)
            every = m.columns == tuple(range(shown.shape[1]))
            y = (shown if every else shown[:, m.columns]).reshape(b, w, length, -1)
            if ahead.any():
                y = between(y, ahead / m.period)
        return np.asarray(y)

    def _late(
        self, windows: Windows, x: Array, values: Mapping[str, Array | float], hidden: Array | None, ahead: Array
    ) -> Array:
        """Channels (b, W, L, ny) that show states (b·W, steps + 1, nx) `ahead` samples after each.

        What they showed before a window follows from its start, under the input before that.
        """
        w, m, steps = len(windows), windows.measured, x.shape[1] - 1
        u = windows.drive[:, np.clip(np.arange(-1, steps) + m.past, 0, None)]
        at = np.arange(windows.length)[:, None] * m.repeat + ahead * m.repeat
        at = np.broadcast_to(at, (len(x) // w, w, windows.length, len(m.columns))).reshape(len(x), windows.length, -1)
        begun = np.concatenate([x[:, :1], x[:, :-1]], axis=1)
        shown = within(
            self.model, begun, np.tile(u, (len(x) // w, 1, 1)), np.where(at < 0, at, at + 1), m.columns, values, hidden
        )
        return shown.reshape(-1, w, *shown.shape[1:])

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

    def guessed(self, windows: Windows, theta: Array, start: Array) -> Array:
        """Starts (W, nx) in which states that sensors scale or shift are where these show what was measured.

        Where no channel shows any state, those of the model from rest, which a machine forgets.
        """
        if not any(map(np.any, windows.measured.states)):
            return self._played(windows, theta, start)
        if shows_states(self.model):
            return start
        m, names, start = windows.measured, [s.name for s in self.model.states], start.copy()
        u, values = windows.u[:, m.history], self._values(theta[None], len(windows))
        for channel, column in zip(m.channels, m.columns, strict=True):
            if channel.name in names:
                own = np.arange(len(names)) == names.index(channel.name)
                x, width = np.where(own, windows.start, start), nudges(start)
                y, moved = (self.model.output(z, u, values)[:, column] for z in (x, x + width * own))
                with np.errstate(all="ignore"):
                    off = (y - x[:, own][:, 0]) * width[own] / (moved - y)
                sensed = np.isfinite(off) & (np.abs(off) > 1e-9 * np.abs(y))
                start[sensed] = np.where(own, x[sensed] - off[sensed, None], start[sensed])
        return start

    def _played(self, windows: Windows, theta: Array, start: Array) -> Array:
        m, values, start = windows.measured, self._values(theta[None], 1), start.copy()
        for piece in np.unique(windows.place[:, 0]).tolist():
            rows, u = windows.place[:, 0] == piece, m.driven[piece][None]
            with np.errstate(all="ignore"):
                x = self.model.fast_rollout(np.zeros((1, self.model.nx)), u, parameters=values, every=m.repeat).x[0]
            if np.isfinite(x).all():
                start[rows] = x[windows.place[rows, 1]]
        return start

    def led(self, windows: Windows, theta: Array, start: Array, rows: npt.NDArray[np.bool_]) -> Windows:
        """Windows whose history begins, in these rows, with the state (nx,) that leads to their start: Newton's shooting.

        At the edge of a recording speeds are guessed worst, and a bristle is bent by whatever they lead to.
        """
        part = windows.take(rows)
        past, nx = part.measured.past, start.shape[1]
        u, before, values = part.drive[:, :past], part.before.copy(), self._values(theta[None], len(part))
        hidden = recalled(self.model, part, self._values(theta[None], 1), 1, self.acted)
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
        hidden = recalled(self.model, windows, self._values(theta, 1), b, self.acted)
        before, values = np.tile(windows.before, (b, 1)), self._values(theta, w)
        after = self.model.fast_rollout(before, u, parameters=values, hidden=hidden, every=max(1, u.shape[1])).hidden
        return hidden if after is None else after

    def _values(self, theta: Array, w: int) -> dict[str, Array | float]:
        """Of the parameters, one per row where they are free."""
        return {**self.fixed, **{n: np.repeat(theta[:, i], w) for i, n in enumerate(self.names)}}


def shows_states(model: Model) -> bool:
    x = np.zeros((1, model.nx))
    return model.output(x, np.zeros((1, model.nu))) is x


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
    for j, weight in enumerate(_weights(inside, nodes)):
        out += signals.take(rows.ravel() + j * ny, axis=1) * np.broadcast_to(weight, shape).reshape(1, -1, 1)
    return np.asarray(out.reshape(y.shape))


def _weights(at: Array, nodes: int = THRESHOLDS.sample_nodes) -> Iterator[Array]:
    """Of the values at 0, 1, … that a polynomial goes through, its value `at`."""
    for j in range(nodes):
        yield np.asarray(math.prod((at - k) / (j - k) for k in range(nodes) if k != j))


def within(
    model: Model,
    x: Array,
    u: Array,
    at: Array,
    columns: Sequence[int],
    values: Mapping[str, Array | float] | None,
    hidden: Array | None,
) -> Array:
    """States (n, K, ny), those of `columns`, at times `at` (n, K, ny) in steps, each cubic as the input of its step moves them.

    x (n, S, nx), u (n, S, nu): where a step begins, and its input. A held input bends a motion where it changes: no polynomial
    goes across.
    """
    nodes = [x]
    # Later nodes remember what the first does, which is up to three steps old: it bends what a step adds, not where it begins.
    for _ in range(THRESHOLDS.sample_nodes - 1):
        nodes.append(model.along(nodes[-1], u, parameters=values, hidden=hidden))
    first = np.clip(np.floor(np.nan_to_num(at)), 0, x.shape[1] - 1)
    rows = np.arange(len(x))[:, None, None], first.astype(np.int64), np.array(columns)
    out = np.zeros(at.shape)
    for weight, node in zip(_weights(at - first), nodes, strict=True):
        out += weight * node[rows]
    return out


def seen(
    model: Model,
    windows: Windows,
    x: Array,
    values: Mapping[str, Array | float],
    hidden: Array | None,
    back: int = 0,
    acted: Acted = NOTHING,
) -> Array:
    """Outputs (n, K, ny) at K samples from `back` before each window on, of motions x (n, K, nx), W dividing n.

    values: a number each, or one per motion; hidden (n, nh): at the first of these samples.
    """
    n, count, w, m = *x.shape[:2], len(windows), windows.measured
    u: Array = windows.u[None, :, m.history - back :][:, :, :count]
    if (late := model.input_delays(values)).any():
        u = _arriving(windows, np.broadcast_to(late, (n, model.nu)).reshape(-1, w, model.nu), count, back, acted)
    rows = {k: np.repeat(v, count) if np.ndim(v) else v for k, v in values.items()}
    known = None
    if hidden is not None and shows_memory(model):
        drive = windows.drive[:, m.past - back * m.repeat :][:, : (count - 1) * m.repeat]
        known = flat(memories(model, x, drive, values, hidden, m.repeat))
    u = np.broadcast_to(u, (n // w, *u.shape[1:]))
    return model.output(flat(x), flat(u), rows, known).reshape(n, count, -1)


def _arriving(windows: Windows, late: Array, count: int, back: int, acted: Acted) -> Array:
    """Inputs (b, W, count, nu) as they arrive `late` (b, W, nu) seconds after they were sent, as they are held."""
    m, out = windows.measured, np.empty((*late.shape[:2], count, late.shape[2]))
    for k, (piece, first) in enumerate(windows.place.tolist()):
        at = first - back + np.arange(count) - late[:, k, :, None] / m.period
        at = at if m.hold == "first" else np.floor(at + THRESHOLDS.whole_sample)
        before = acted.get(m.beginning(piece), m.inputs[piece][0])
        for j, sent in enumerate(m.inputs[piece].T):
            out[:, k, :, j] = np.interp(at[:, j], np.arange(len(sent)), sent, left=before[j])
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


def recalled(
    model: Model, windows: Windows, parameters: Mapping[str, Array | float], count: int, acted: Acted = NOTHING
) -> Array:
    """Hidden states (count·W, nh), `history` samples before each window, for parameters of shape (count,) or ().

    A lag, a play or a sagging supply knows more of the past than the history before a window tells.
    """
    out = _defaults(model, count, windows.t - windows.measured.history * windows.measured.period)
    if model.remembers:
        if windows not in _WAYS:
            _WAYS[windows] = _Way(windows.measured, windows.place[:, 0], windows.place[:, 1] - windows.measured.history)
        out = _Past(model, _WAYS[windows], parameters, count, acted).found()
    _commanded(model, windows, out, acted)
    return out.reshape(count * len(windows), -1)


def _commanded(model: Model, windows: Windows, out: Array, acted: Acted) -> None:
    """Late inputs among hidden states (count, W, nh), as they were commanded; before a recording what acted, or the first."""
    m, inputs, names = windows.measured, [s.name for s in model.inputs], [s.name for s in model.hidden]
    for i, name in enumerate(inputs):
        late = [j for j, n in enumerate(names) if n.rpartition("_")[0] == f"{name}_delay"]
        back = np.array([int(names[j].rpartition("_")[2]) for j in late], dtype=int)
        for w, (piece, first) in enumerate(windows.place.tolist() if late else ()):
            at, sent = (first - m.history) * m.repeat - back, m.driven[piece]
            out[:, w, late] = np.where(at < 0, acted.get(m.beginning(piece), sent[0])[i], sent[np.maximum(at, 0), i])


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
    """The measured motion of all pieces, onto which models are put back every `free_stretch` and where windows begin.

    piece, first (W,): where these begin. It is the same for every model and all its numbers.
    """

    measured: Dataset
    piece: Array
    first: Array

    @cached_property
    def stops(self) -> dict[int, Array]:
        return {p: self.first[self.piece == p] for p in np.unique(self.piece).tolist()}

    @cached_property
    def pieces(self) -> list[int]:
        """Those that end last come first."""
        return sorted(self.stops, key=lambda p: -int(self.stops[p].max()))

    @cached_property
    def place(self) -> tuple[list[int], npt.NDArray[np.intp]]:
        """Where windows begin, among the pieces and among the marks."""
        return [self.pieces.index(p) for p in self.piece.tolist()], np.searchsorted(self.marks, self.first)

    @cached_property
    def begun(self) -> Array:
        """Times (pieces,) of the first samples."""
        return np.array([self.measured.times[p][0] for p in self.pieces])

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

    @cached_property
    def head(self) -> tuple[Array, Array, Array]:
        """The first samples of every piece: states (pieces, n, nx), inputs (pieces, steps, nu); and spreads of the states."""
        m, pieces = self.measured, self.pieces
        few = min(max(THRESHOLDS.first_samples, m.samples(THRESHOLDS.free_stretch)), *(len(m.states[p]) - 1 for p in pieces))
        spread = np.maximum(np.std(np.concatenate(m.states), axis=0), 1e-300)
        u = np.stack([m.driven[p][: few * m.repeat] for p in pieces])
        return np.stack([m.states[p][: few + 1] for p in pieces]), u, spread


_WAYS = WeakKeyDictionary[Windows, _Way]()


@final
@dataclass(frozen=True)
class _Past:
    """Motions along a way."""

    model: Model
    way: _Way
    parameters: Mapping[str, Array | float]
    count: int
    acted: Acted = field(default_factory=dict)

    def found(self) -> Array:
        """Hidden states (count, W, nh) where windows begin."""
        known, (piece, mark) = self._at_once(), self.way.place
        return (self._stepwise() if known is None else known)[:, piece, mark]

    @cached_property
    def start(self) -> Array:
        """Hidden states (count, pieces, nh) at the first sample: nothing acted before a recording, or its first input did.

        A machine that is just switched on, or at an operating point: the first samples tell, where it is not known what acted.
        """
        hidden, u = _defaults(self.model, self.count, self.way.begun), self.way.path[1][:, 0].copy()
        held = np.zeros(len(u), dtype=bool)
        for i, p in enumerate(self.way.pieces if self.acted else ()):
            if (given := self.acted.get(self.way.measured.beginning(p))) is not None:
                u[i], held[i] = given, True
        if not u.any():
            return hidden
        settled = self._settled(u, hidden)
        if np.array_equal(settled, hidden):
            return hidden
        if not held.all():
            held = held | np.less(*self._missed(np.stack([settled, hidden], axis=1)))
        return np.where(held[..., None], settled, hidden)

    def _settled(self, u: Array, hidden: Array) -> Array:
        """What is remembered where the first state, and inputs u (pieces, nu), have been held for as long as the log is.

        What moves without an input is bent by the motion, which was another one before.
        """
        way, rows, given = self.way, self._rows(len(u)), hidden.reshape(-1, hidden.shape[2])
        x, steps = way.path[0][:, 0], max(len(way.measured.driven[p]) for p in way.pieces) - 1
        found = self.model.held_memories(x, u, steps, rows, given) if steps > 0 else given
        if found is None:
            begun, drive = np.tile(np.nan_to_num(x), (self.count, 1)), np.repeat(u[:, None], steps, axis=1)
            settled, plain = (
                self.model.fast_rollout(begun, v, parameters=rows, hidden=given, every=steps).hidden for v in (drive, 0 * drive)
            )
            found = given if settled is None else np.where(np.isfinite(settled) & (plain == given), settled, given)
        return found.reshape(hidden.shape)

    def _missed(self, hidden: Array) -> Array:
        """Squares (k, count, pieces) by which the first samples are missed from hidden states (count, k, pieces, nh) on, in
        spreads of the states."""
        (seen, u, spread), k = self.way.head, hidden.shape[1]
        begun, rows = np.tile(seen[:, 0], (self.count * k, 1)), self._rows(k * len(u))
        with np.errstate(all="ignore"):
            given = hidden.reshape(-1, hidden.shape[3])
            moved = self.model.fast_rollout(begun, u, parameters=rows, hidden=given, every=self.way.measured.repeat).x
            off = difference(self.model.states, moved.reshape(*hidden.shape[:3], *seen.shape[1:]), seen) / spread
        off[..., self.way.blind] = 0.0
        return np.asarray(np.nan_to_num((off**2).sum(axis=(3, 4)), nan=np.inf).swapaxes(0, 1))

    def _rows(self, pieces: int) -> dict[str, Array | float]:
        return {n: np.repeat(v, pieces) if np.ndim(v) else v for n, v in self.parameters.items()}

    def _at_once(self) -> Array | None:
        """Hidden states (count, pieces, marks, nh), where the model knows a way."""
        way, (path, u) = self.way, self.way.path
        hidden = self.start.reshape(self.count * len(way.pieces), -1)
        stops = [a * way.measured.repeat for a in way.marks]
        found = self.model.fast_memories(path, u, stops, self._rows(len(way.pieces)), hidden)
        return None if found is None else found.reshape(*self.start.shape[:2], *found.shape[1:])

    def _stepwise(self) -> Array:
        """The same, by rollouts from mark to mark; pieces that end first leave first."""
        way, m, hidden = self.way, self.way.measured, self.start
        last = np.array([way.stops[p].max() for p in way.pieces])
        known, x = [hidden], np.tile([m.states[p][0] for p in way.pieces], (self.count, 1, 1))
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
            known.append(np.concatenate([hidden, known[-1][:, w:]], axis=1))
        return np.stack(known, axis=2)
