"""A recording in a model's terms: noise floor, first guesses of the states, and windows."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar, final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Hold, Model, Recording, StateSpec, UsageError, difference
from gapcert_diagnosis.thresholds import THRESHOLDS
from gapcert_recordings import JITTER, Log, Piece, pieces

K = TypeVar("K")
V = TypeVar("V")
_HOLDS: tuple[Hold, ...] = ("zero", "first")


@final
@dataclass(frozen=True)
class Dataset:
    """A recording in the model's terms, per trajectory: times (T,), outputs (T, ny), inputs (T, nu), smoothed states (T, nx).

    columns: where the measured channels are in `model.output`; repeat: model periods per sample; sigma, spread (ny,): noise
    floor and standard deviation of each channel; weights (T, ny): 0 where a value is missing or absurd, else 1; offsets (T,):
    measured time minus the time on the even grid, in s; hold: how the inputs go on from one sample to the next, None where
    the recording does not say (treated as zero); drives: hold → per trajectory (T·repeat, nu), the mean input over each model
    period; source: the recording's trajectory that each of these is a piece of; log: what was found and repaired;
    since: per trajectory of the recording, the time from which windows may begin, in s (all of it where empty); rough (ny,): by
    how much at most what is seen in the values alone moves them (not at all where empty); whole: do windows begin at once?
    """

    channels: tuple[StateSpec, ...]
    columns: tuple[int, ...]
    period: float
    repeat: int
    times: tuple[Array, ...]
    outputs: tuple[Array, ...]
    inputs: tuple[Array, ...]
    states: tuple[Array, ...]
    sigma: Array
    spread: Array
    weights: tuple[Array, ...]
    offsets: tuple[Array, ...]
    drives: Mapping[Hold, tuple[Array, ...]]
    source: tuple[int, ...]
    hold: Hold | None = None
    log: Mapping[str, Any] = field(default_factory=dict)
    since: tuple[float, ...] = ()
    rough: Array = field(default_factory=lambda: np.empty(0))
    whole: bool = False

    @classmethod
    def of(cls, model: Model, recording: Recording) -> Dataset:
        """UsageError where a needed channel is missing, or where the samples are not a whole number of model periods apart."""
        channels, columns = _channels(model, recording)
        recording = recording.converted({s.name: s.unit for s in (*channels, *model.inputs)})
        period, repeat = _period(model, recording)
        log, at = Log(), {c.name: i for i, c in enumerate(channels)}
        if abs(recording.period - period) > THRESHOLDS.uneven_period * period:
            log.resampled = {"from": recording.period, "to": period}
        named = {model.states[i].name: model.states[j].name for i, j in driven(model)}
        rates = {at[a]: at[b] for a, b in named.items() if a in at and b in at}
        found = [
            (i, piece)
            for i, tr in enumerate(recording.trajectories)
            for piece in pieces(tr, channels, model.inputs, period, recording.every, log, bool(recording.noise), rates)
        ]
        if not found:
            raise UsageError("recording: no stretch is long and whole enough to be used; `gapcert inspect` shows its gaps")
        kept = [p for _, p in found]
        y, weight = (np.concatenate([getattr(p, n) for p in kept]) for n in ("y", "weight"))
        spread = np.sqrt(np.average((y - np.average(y, 0, weight)) ** 2, 0, weight))
        if (still := np.flatnonzero(spread <= 1e-12 * np.abs(y).max(axis=0))).size:
            raise UsageError(f"recording: '{channels[still[0]].name}' never changes; record a motion, or leave the channel out")
        sizes, noise = np.array([len(p.t) for p in kept]), np.array([p.noise for p in kept])
        floor = np.sqrt(np.average(np.nan_to_num(noise) ** 2, 0, sizes))
        states = tuple(_states(model, channels, p) for p in kept)
        floor = _beneath(model, columns, kept, states, floor, repeat)
        floor = np.array([recording.noise.get(c.name, e) for c, e in zip(channels, floor, strict=True)])
        return cls(
            channels,
            columns,
            period,
            repeat,
            tuple(p.t for p in kept),
            tuple(p.y for p in kept),
            tuple(p.means(1, "zero") for p in kept),
            states,
            # Data without noise would otherwise ask the model for more digits than any integrator has.
            np.maximum(floor, THRESHOLDS.least_floor * spread),
            spread,
            tuple(p.weight for p in kept),
            tuple(p.offset for p in kept),
            {h: tuple(p.means(repeat, h) for p in kept) for h in _HOLDS},
            tuple(i for i, _ in found),
            recording.hold,
            {"samples": int(sizes.sum()), "period": period, "hold": recording.hold or "undeclared"}
            | {k: v for k, v in vars(log).items() if v or k != "resampled"},
        )

    def quieter(self, model: Model, rows: Array, known: Collection[str]) -> Dataset | None:
        """With less noise in channels that inputs make jump: what varies in half of a residual (W, L, ny) in noise
        floors; None where none falls. known: channels whose noise is stated."""
        least = np.array([scatter(list(r)) for r in rows.transpose(2, 0, 1)])
        falls = (least > 0) & (least < THRESHOLDS.jumping_floor) & [c.name not in known for c in self.channels]
        if falls.any():
            falls &= jumped(model, self.columns, self.states, self.inputs, self.repeat) > self.sigma
        falls &= ~(self.rough > 0) if self.rough.size else True
        return replace(self, sigma=np.where(falls, least, 1.0) * self.sigma) if falls.any() and not self.exact else None

    @property
    def history(self) -> int:
        """Samples of input kept before every window."""
        return 1 if self.whole else math.ceil(THRESHOLDS.input_history / self.period - 1e-6)

    @property
    def past(self) -> int:
        """Model steps of that history."""
        return self.history * self.repeat

    @property
    def driven(self) -> tuple[Array, ...]:
        """The inputs of each piece at every model step, (T·repeat, nu), as they are held."""
        return self.drives[self.hold or "zero"]

    @property
    def paths(self) -> tuple[Array, ...]:
        """The smoothed states of each piece at every model step, (T·repeat, nx)."""
        fine = [np.arange(len(x) * self.repeat) / self.repeat for x in self.states]
        known = zip(fine, self.states, strict=True)
        return tuple(np.stack([np.interp(t, np.arange(len(x)), column) for column in x.T], axis=-1) for t, x in known)

    @property
    def exact(self) -> bool:
        """Is there no noise, as in what a simulator says?"""
        return bool((self.sigma <= (1 + 1e-9) * THRESHOLDS.least_floor * self.spread).all())

    def samples(self, seconds: float) -> int:
        return max(1, round(seconds / self.period))

    def brief(self, seconds: float) -> int:
        """Samples of a window that is to be short, but long enough to say something."""
        return max(THRESHOLDS.window_samples, self.samples(seconds))

    def between(self, stretches: Sequence[tuple[int, float, float]]) -> Dataset | None:
        """Without stretches (source, from, until in s): their ends are ends of pieces; None where no window is left."""
        kept: list[tuple[int, slice]] = []
        for i, t in enumerate(self.times):
            out = np.zeros(len(t) + 2, dtype=bool)
            out[[0, -1]] = True
            for source, a, b in stretches:
                out[1:-1] |= (source == self.source[i]) & (t > a - self.period) & (t < b + self.period)
            edges = np.flatnonzero(np.diff(out))
            kept += [
                (i, slice(a, b)) for a, b in edges.reshape(-1, 2).tolist() if b - a > self.history + THRESHOLDS.window_samples
            ]
        if not kept:
            return None
        each = ("times", "outputs", "inputs", "states", "weights", "offsets")
        parts: dict[str, Any] = {n: tuple(getattr(self, n)[i][part] for i, part in kept) for n in each}
        fine = [(i, slice(s.start * self.repeat, s.stop * self.repeat)) for i, s in kept]
        drives = {h: tuple(d[i][part] for i, part in fine) for h, d in self.drives.items()}
        return replace(self, **parts, drives=drives, source=tuple(self.source[i] for i, _ in kept))

    def beginning(self, piece: int) -> tuple[float, ...]:
        """What tells a piece from others, also in other parts of the recording: when it begins, and with what values."""
        return float(self.times[piece][0]), *self.outputs[piece][0].tolist()

    def first(self, piece: int) -> int:
        """The first sample of a piece at which a window may begin."""
        since = self.since[self.source[piece]] if self.since else -math.inf
        return max(self.history, int(np.searchsorted(self.times[piece], since - 0.5 * self.period)))

    def windows(self, length: int, stride: int | None = None) -> Windows:
        """Windows of `length` samples: as many as fit side by side, or one every `stride` samples."""
        parts = []
        for i, y in enumerate(self.outputs):
            first, last = self.first(i), len(y) - length
            count = max(0, (len(y) - first) // length)
            starts = first + length * np.arange(count) if stride is None else np.arange(first, last + 1, stride)
            for s in starts.tolist():
                share = self.weights[i][s : s + length].mean(axis=0)
                parts += [(i, s)] if share.mean() >= THRESHOLDS.seen_share and share.min() >= THRESHOLDS.seen_share / 2 else []
        if not parts:
            longest = max(map(len, self.outputs)) * self.period
            need, before, window = ((n * self.period) for n in (length + self.history, self.history, length))
            if longest >= need:
                there = np.average([w.mean(axis=0) for w in self.weights], axis=0, weights=[len(w) for w in self.weights])
                slowest = self.period * round(1 / max(float(there.min()), 1e-3))
                raise UsageError(
                    f"recording: too many values are missing; expected {100 * THRESHOLDS.seen_share:g} % of each window "
                    f"of {window:.3g} s; "
                    f"where channels come at different rates, add the period of the slowest to the recording, "
                    f"every: {slowest:.3g} s"
                )
            raise UsageError(
                f"recording: the longest stretch is {longest:.3g} s; expected a window of {window:.3g} s after {before:.3g} s "
                "of history; record for longer, or, where its time is not in s, give the unit of that column, "
                "recording.units: {TIME: min}"
            )
        return self.at(np.array(parts), length)

    def at(self, place: Array, length: int) -> Windows:
        """Windows of `length` samples at places (W, 2): piece and first sample."""
        h, reach, parts = self.history, np.arange(length), place.tolist()
        return Windows(
            self,
            np.array([self.times[i][s] for i, s in parts]),
            np.array([self.source[i] for i, _ in parts]),
            np.stack([self.outputs[i][s + reach] for i, s in parts]),
            np.stack([self.inputs[i][s - h : s + length] for i, s in parts]),
            np.stack([self.states[i][s - h] for i, s in parts]),
            np.stack([self.states[i][s] for i, s in parts]),
            np.stack([self.weights[i][s + reach] for i, s in parts]),
            np.stack([self.offsets[i][s + reach] for i, s in parts]),
            place,
        )


@final
@dataclass(frozen=True, eq=False)
class Windows:
    """W stretches of L samples: outputs y (W, L, ny), inputs with their history u (W, H + L, nu), guessed states (W, nx).

    trajectory (W,): of the recording; weight (W, L, ny) and offset (W, L) as in Dataset; place (W, 2): piece and sample.
    memory (W, nh): the hidden states of a model where the windows begin, where they are known: at numbers `about` (W, p), with
    which they change by `leaning` (W, nh, p).
    """

    measured: Dataset
    t: Array
    trajectory: Array
    y: Array
    u: Array
    before: Array
    start: Array
    weight: Array
    offset: Array
    place: Array
    memory: Array | None = None
    about: Array | None = None
    leaning: Array | None = None

    def __len__(self) -> int:
        return len(self.t)

    @property
    def length(self) -> int:
        return int(self.y.shape[1])

    def take(self, rows: npt.NDArray[np.bool_] | npt.NDArray[np.intp]) -> Windows:
        columns = {f.name: getattr(self, f.name) for f in fields(self)[1:]}
        return replace(self, **{name: column[rows] for name, column in columns.items() if column is not None})

    def thinned(self, most: int, fewest: int = 1) -> Windows:
        """Every k-th window, with about `most` values left: what more of the same would add is not worth its time.

        fewest: windows that are kept, however many values each has.
        """
        return self.take(np.arange(0, len(self), max(1, min(round(self.y.size / most), len(self) // fewest))))

    def wide(self, horizon: float) -> Windows | None:
        """Of the same data, well beyond these and a horizon in s, where what is slow adds up; None where they are too few."""
        m, rooms = self.measured, [len(y) - self.measured.first(i) for i, y in enumerate(self.measured.outputs)]
        length = round(THRESHOLDS.wide_window * max(m.samples(horizon), self.length))
        length = min(length, max(rooms), sum(rooms) // THRESHOLDS.guard_windows)
        if length < THRESHOLDS.longer_window * self.length:
            return None
        return m.windows(length).thinned(THRESHOLDS.fitted_values, THRESHOLDS.guard_windows)

    def with_hold(self, hold: Hold) -> Windows:
        """The same windows with the input held in a given way."""
        return replace(self, measured=replace(self.measured, hold=hold))

    def retraced(self, x: Array) -> tuple[Windows, npt.NDArray[np.bool_]]:
        """The same windows in a recording whose guessed states are those of motions x (W, L, nx), as far as these reach.

        What a model remembers where one of them begins then follows from the motion of the one before, and not from noise.
        Also (W,): whether the motions reach back to where the history of a window begins.
        """
        m = self.measured
        states, reached = [s.copy() for s in m.states], [np.zeros(len(s), dtype=bool) for s in m.states]
        for (piece, first), motion in zip(self.place.tolist(), x, strict=True):
            states[piece][first : first + self.length] = motion
            reached[piece][first : first + self.length] = True
        return self._with(states), np.array([reached[i][s - m.history] for i, s in self.place.tolist()])

    def begun(self, before: Array, rows: npt.NDArray[np.bool_]) -> Windows:
        """With guessed states (·, nx) where the histories of these rows begin."""
        states, history = [s.copy() for s in self.measured.states], self.measured.history
        for (piece, first), x in zip(self.place[rows].tolist(), before, strict=True):
            states[piece][first - history] = x
        return self._with(states)

    def _with(self, states: Sequence[Array]) -> Windows:
        """The same windows in a recording with these guessed states."""
        m = replace(self.measured, states=tuple(states))
        return replace(self, measured=m, before=np.stack([states[i][s - m.history] for i, s in self.place.tolist()]))

    def head(self, length: int) -> Windows:
        """Their first `length` samples."""
        short = {n: getattr(self, n)[:, :length] for n in ("y", "weight", "offset")}
        return replace(self, u=self.u[:, : self.measured.history + length], **short)

    def cut(self, parts: int) -> Windows:
        """Each as `parts` shorter ones, in order."""
        place = np.repeat(self.place, parts, axis=0)
        place[:, 1] += np.tile(self.length // parts * np.arange(parts), len(self))
        return self.measured.at(place, self.length // parts)

    @functools.cached_property
    def drive(self) -> Array:
        """The mean input over each model period, (W, (H + L)·repeat, nu), as the inputs are held; the last sample is held."""
        m, after = self.measured, self.length * self.measured.repeat
        return np.stack([m.driven[i][s * m.repeat - m.past : s * m.repeat + after] for i, s in self.place.tolist()])

    def guard(self, share: float = 0.25) -> tuple[Windows, Windows]:
        """(earlier, later): the last quarter of every trajectory's windows, in time order, judges what the rest suggests; or
        the last quarter of the trajectories, where they are too short for that.
        """
        late = np.zeros(len(self), dtype=bool)
        for i in np.unique(self.trajectory):
            rows = np.flatnonzero(self.trajectory == i)
            late[rows[len(rows) - round(share * len(rows)) :]] = True
        if late.mean() < share / 2 and len(np.unique(self.trajectory)) >= THRESHOLDS.guard_windows:
            # Runs that are a window or two each are judged by the last of them.
            last = np.unique(self.trajectory)[-max(1, round(share * len(np.unique(self.trajectory)))) :]
            late = np.isin(self.trajectory, last)
        if late.all() or not late.any():
            raise UsageError(
                f"recording: {len(self)} windows are too few to fit on some and check on others; record for longer"
            )
        return self.take(~late), self.take(late)


def _channels(model: Model, recording: Recording) -> tuple[tuple[StateSpec, ...], tuple[int, ...]]:
    if missing := [u.name for u in model.inputs if u.name not in recording.names]:
        found = ", ".join(recording.names)
        what = f"recording: no channel for the input '{missing[0]}' (there are {found}); add it to `columns`"
        raise UsageError(what, ("recording", "columns"))
    names = {s.name for s in (*model.inputs, *model.outputs)}
    if unknown := [n for n in recording.names if n not in names]:
        there = ", ".join(sorted(names))
        what = f"recording: channel '{unknown[0]}' is no input or output of the model; there are {there}"
        raise UsageError(what, ("recording", "columns", unknown[0]))
    columns = tuple(i for i, s in enumerate(model.outputs) if s.name in recording.names)
    if not columns:
        outputs = ", ".join(s.name for s in model.outputs)
        what = f"recording: no output is measured; add one of {outputs} to `columns`"
        raise UsageError(what, ("recording", "columns"))
    return tuple(model.outputs[i] for i in columns), columns


def _period(model: Model, recording: Recording) -> tuple[float, int]:
    """(of the grid of samples, model periods per sample)."""
    period = recording.period
    repeat = round(period / model.period)
    off = abs(repeat * model.period - period)
    if recording.every is not None and (raw := min(tr.period for tr in recording.trajectories)) > (1 + JITTER) * period:
        raise UsageError(
            f"recording.every: found {period:.6g} s, but samples are {raw:.6g} s apart; expected at least that; leave it out",
            ("recording", "every"),
        )
    if repeat > THRESHOLDS.most_repeats:
        raise UsageError(
            f"recording: samples are {period:.6g} s apart, {repeat:,} steps of the model, {model.period:.6g} s; expected "
            f"{THRESHOLDS.most_repeats:,} at most; is the time in s? Give the unit of that column otherwise, "
            "recording.units: {TIME: ms}, or a longer period of the model",
            ("recording",),
        )
    if repeat >= 1 and off <= JITTER * period:
        return period, repeat
    even = all(np.abs(np.diff(tr.t) / period - 1).max() <= JITTER for tr in recording.trajectories)
    if repeat >= 1 and not even and off <= THRESHOLDS.uneven_period * period:
        return repeat * model.period, repeat
    # Stamps that tremble are on no grid of their own: that of the model does as well.
    apart = np.concatenate([np.diff(tr.t) for tr in recording.trajectories])
    trembling = np.median(np.abs(apart / period - 1)) > THRESHOLDS.trembling
    if recording.every is None and trembling and period > THRESHOLDS.crowded_period * model.period:
        return (repeat or 1) * model.period, repeat or 1
    steps = max(1, math.ceil(period / model.period - JITTER))
    raise UsageError(
        f"recording: samples are {period:.6g} s apart, the model steps by {model.period:.6g} s; expected a whole number of "
        f"steps per sample; set the model's period to {period:.6g} s or a whole fraction of it, or add "
        f"`every: {steps * model.period:.6g} s` to the recording",
        ("recording",),
    )


def _states(model: Model, channels: tuple[StateSpec, ...], piece: Piece) -> Array:
    """First guesses of the states (T, nx): smoothed where measured, the slope of what they drive where not, else zero."""
    at = {c.name: i for i, c in enumerate(channels)}
    x = np.zeros((len(piece.t), model.nx))
    for j, state in enumerate(model.states):
        if state.name in at:
            x[:, j] = piece.smooth[:, at[state.name]]
    for i, j in driven(model):
        place, speed = (model.states[k].name for k in (i, j))
        if place in at and speed not in at:
            x[:, j] = piece.slope[:, at[place]]
    return x


def at_once(model: Model, x: Array, u: Array, change: Array, repeat: int) -> Array:
    """What a change (nu,) of the inputs moves of the outputs (n, ny) within a sample of `repeat` model steps."""
    on = u + change
    direct = difference(model.outputs, model.output(x, on), model.output(x, u))
    for _ in range(repeat):
        new, x = model.step(x, on).x, model.step(x, u).x
    held = difference(model.outputs, model.output(new, u), model.output(x, u))
    return np.maximum(np.abs(direct), np.abs(held))


def jumped(model: Model, columns: tuple[int, ...], states: Sequence[Array], inputs: Sequence[Array], repeat: int) -> Array:
    """By how much (ny,) the largest step of an input moves the measured channels within a sample."""
    few, jumps = slice(None, None, max(1, sum(map(len, inputs)) // THRESHOLDS.jumping_samples)), np.zeros(len(columns))
    x, u = np.concatenate(states)[few], np.concatenate(inputs)[few]
    for i, most in enumerate(np.max([np.abs(np.diff(a, axis=0)).max(axis=0, initial=0.0) for a in inputs], axis=0).tolist()):
        moved = at_once(model, x, u, most * (np.arange(model.nu) == i), repeat)[:, columns]
        jumps = np.fmax(jumps, moved.max(axis=0))
    return jumps


def _beneath(
    model: Model, columns: tuple[int, ...], kept: Sequence[Piece], states: Sequence[Array], floor: Array, repeat: int
) -> Array:
    """Noise floors (ny,): where inputs make channels jump, no more than what varies in half of their samples.

    Of a channel that shows an input at once, what the model says of that is taken away first.
    """
    u, found = [p.means(1, "zero") for p in kept], floor.copy()
    jumps = jumped(model, columns, states, u, repeat)
    shown = [model.output(x, a)[:, columns] for x, a in zip(states, u, strict=True)]
    rows = [np.where(p.weight > 0, p.y, np.nan) for p in kept]
    for c in np.flatnonzero(jumps > floor).tolist():
        left = [y[:, c] - s[:, c] for y, s in zip(rows, shown, strict=True)]
        least = min(scatter([y[:, c] for y in rows]), scatter(left))
        found[c] = least if 0 < least < THRESHOLDS.jumping_floor * floor[c] else floor[c]
    return found


def scatter(rows: Sequence[Array]) -> float:
    """σ of white noise beneath signals (T,): the median of |k-th differences| is 0.6745 √C(2k, k) σ; NaN takes no part."""
    found = []
    for k in (2, 3, 4):
        apart = np.concatenate([np.abs(np.diff(y, k)) for y in rows])
        found.append(float(np.nanmedian(apart)) / math.sqrt(math.comb(2 * k, k)) if np.isfinite(apart).any() else math.inf)
    return min(found) / 0.6745


def driven(model: Model) -> list[tuple[int, int]]:
    """(i, j): xⱼ is the velocity of xᵢ, ∂xᵢ⁺/∂xⱼ ≈ period."""
    jacobian = model.jacobian(np.zeros((1, model.nx)), np.zeros((1, model.nu)))[0] / model.period
    found = np.abs(jacobian[:, : model.nx] - 1) < 0.05
    return [(i, j) for j in range(model.nx) for i in range(model.nx) if i != j and found[i, j]]


def flat(a: Array) -> Array:
    """(…, k) as rows (n, k), for k = 0 too."""
    return a.reshape(math.prod(a.shape[:-1]), a.shape[-1])


def once(known: dict[K, V], key: K, make: Callable[[], V]) -> V:
    """What is kept under a key, made the first time."""
    if key not in known:
        known[key] = make()
    return known[key]
