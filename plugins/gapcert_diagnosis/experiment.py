"""Which experiment tells rivals apart: inputs within limits, judged by what one rival predicts and the other cannot copy."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np

from gapcert.plugin import Array, Model, Recording, UsageError, difference, magnitude

from .data.dataset import Dataset, Windows, driven, flat
from .fitting.fit import Fit, fit, nearby
from .fitting.hypothesis import between, memories, shows_memory
from .results import Apart, Experiment, Travel
from .search.candidates import Causes
from .thresholds import THRESHOLDS

LIMITS = ("diagnose", "experiment", "limits")  # where a spec says them
BANDS = {"a slow swing": (0.08, 0.4), "a slow multisine": (0.2, 1.5), "a multisine": (0.3, 4.0),
         "a fast multisine": (3.0, 12.0), "a very fast multisine": (12.0, 30.0)}  # fmt: skip
BEYOND = ("a slow multisine", "a multisine", "slow steps")  # what is tried where no input within the limits tells
# Also tried small, and begun gently: where speeds or ends of a range allow no more.
GENTLE = ("a slow swing", "a multisine", "slow steps", "a creeping ramp")
# Also tried with their opposites, so that what drifts comes back.
BACK = ("a slow swing", "a slow multisine", "a multisine", "a fast multisine", "steps", "slow steps", "switching")


@final
@dataclass(frozen=True)
class Rivalry:
    """Two sets of causes that explain the data alike: the effects in which they differ, and their fits."""

    named: tuple[str, str]
    other: tuple[str, str]
    here: Fit
    there: Fit


@final
@dataclass(frozen=True)
class Limits:
    """What an experiment may do: [low, high] of every input and of every measured output, and its length in s.

    wider: of each output, how many times as wide as in the data; its speed may grow as much.
    """

    inputs: Mapping[str, tuple[float, float]]
    outputs: Mapping[str, tuple[float, float]]
    seconds: float
    wider: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(
        cls, model: Model, measured: Dataset, given: Mapping[str, Any] | None = None, seconds: float | None = None
    ) -> Limits:
        """Where nothing is given: inputs as in the data, or off; outputs as in the data; 12 s or some turns of the motion, as
        far as the data are as long. Texts may carry units.
        """
        asked = {}
        units = {s.name: s.unit for s in (*model.inputs, *measured.channels)}
        for name, pair in (given or {}).items():
            if name not in units:
                there = ", ".join(units)
                what = f"experiment.limits: '{name}' is no input or measured output"
                raise UsageError(f"{what}; there are {there}", (*LIMITS, name))
            try:
                low, high = (magnitude(v, units[name]) for v in pair)
            except ValueError as error:
                raise UsageError(f"experiment.limits.{name}: {error}", (*LIMITS, name)) from None
            if not low < high:
                what = f"experiment.limits.{name}: found [{low:g}, {high:g}]"
                raise UsageError(f"{what}; expected [low, high] with low < high", (*LIMITS, name))
            asked[name] = low, high
        u, y = np.concatenate(measured.inputs), np.concatenate(measured.outputs)
        inputs = {s.name: _range(np.append(u[:, i], np.zeros(len(u) // 100 + 1))) for i, s in enumerate(model.inputs)}
        outputs = {s.name: _range(y[:, i]) for i, s in enumerate(measured.channels)}
        if seconds is None:
            long = max(THRESHOLDS.least_experiment, THRESHOLDS.experiment_turns / _beat(measured))
            seconds = min(long, sum(map(len, measured.times)) * measured.period)
        wider = {n: max(1.0, np.ptp(asked.get(n, r)) / max(r[1] - r[0], 1e-300)) for n, r in outputs.items()}
        inputs, outputs = ({n: asked.get(n, r) for n, r in ranges.items()} for ranges in (inputs, outputs))
        return cls(inputs, outputs, seconds, wider)


def _range(values: Array) -> tuple[float, float]:
    low, high = np.nanquantile(values, [0.001, 0.999]).tolist()
    return low, high


def design(
    pairs: Sequence[Rivalry], measured: Dataset, limits: Limits, length: int, seed: int = 0
) -> tuple[Experiment | None, tuple[bool, ...], dict[int, str]]:
    """The input from which the pair that it separates least gains most, which pairs can be separated at all, and by its number
    what would separate each of the others, in words, where that can be computed.

    length: of a window in samples. For every input one rival is simulated, and the other refitted to it with starts,
    nuisances and its own numbers free as far as the data leave them free; what it cannot copy counts, in both directions.
    """
    if not pairs or not limits.inputs:
        return None, tuple(False for _ in pairs), {}
    fits = list({id(f): f for pair in pairs for f in (pair.here, pair.there)}.values())
    begin, held = _rest(fits, measured, limits)
    plays = {id(f): _Plays(f, measured, begin, held) for f in fits}
    part = THRESHOLDS.experiment_fitted
    few, many = (math.ceil((n * length + measured.history) / part) + 1 for n in (1, THRESHOLDS.experiment_windows))
    least = max(few, 2 * length, min(many, measured.samples(limits.seconds)))
    allowed = _within(list(plays.values()), shapes(limits.inputs, limits.seconds, measured, seed, held), limits, least)
    trials = [_Trial(pair, allowed, plays, length) for pair in pairs]
    best = [t.best(t.table) for t in trials]
    separable = tuple(
        name is not None and t.table[name].expected > THRESHOLDS.settled_fall for t, name in zip(trials, best, strict=True)
    )
    most = np.abs(np.concatenate(measured.inputs)).max(axis=0)
    far = {n: max(*map(abs, pair), m) for (n, pair), m in zip(limits.inputs.items(), most.tolist(), strict=True)}
    away = {n: (-a, a) for n, a in far.items()}
    wide = [shapes(to, limits.seconds, measured, seed, held)[n] for to in (limits.inputs, away) for n in BEYOND]
    besides = {i: text for i, t in enumerate(trials) if not separable[i] and (text := t.besides(wide))}
    if not any(separable):
        return None, separable, besides
    able = [t for t, yes in zip(trials, separable, strict=True) if yes]
    name = _common(able)
    # Where no input is played for all of them, the pair that is hardest decides.
    hardest = min(able, key=lambda t: t.table[name].value if name else max(s.value for s in t.table.values()))
    return _experiment(hardest, name or hardest.best(hardest.table) or "", trials, begin), separable, besides


def _common(trials: Sequence[_Trial]) -> str | None:
    """The input from which the pair that gains least gains most, judged by full fits."""
    names = [n for n in trials[0].table if all(n in t.table for t in trials)]
    names = sorted(names, key=lambda n: -min(t.table[n].value for t in trials))[: THRESHOLDS.judged_inputs]
    for t in trials:
        t.judge(names)
    return max(names, key=lambda n: min(t.table[n].value for t in trials), default=None)


def told_apart(
    causes: Causes, last: Fit, ties: Sequence[tuple[Causes, Fit]], measured: Dataset, limits: Limits, seed: int = 0
) -> tuple[Experiment | None, tuple[bool, ...], dict[int, str]]:
    """`design` for every two of a set of causes and the others that explain the data as well; pairs with the causes first."""
    pairs = []
    for (one, here), (tie, there) in itertools.combinations([(causes, last), *ties], 2):
        mine, other = {c.told for c in one}, {c.told for c in tie}
        a, b = next(iter(sorted(mine - other)), min(mine)), next(iter(sorted(other - mine)), min(other))
        pairs.append(Rivalry(a, b, here, there))
    return design(pairs, measured, limits, last.residual.shape[1], seed)


@final
@dataclass(frozen=True)
class _Separation:
    """Of one input: u (T, nu), and per direction the rms that cannot be copied and the expected fall in score."""

    u: Array
    rms: tuple[float, float]
    falls: tuple[float, float]

    @classmethod
    def of(cls, u: Array, left: Sequence[Array], own: Sequence[Array], pair: Rivalry) -> _Separation:
        """From what cannot be copied, (W, L, ny), in each direction, beyond what the copying rival misses of its own log.

        Coloured noise counts for less.
        """
        whiteness = np.minimum(pair.here.whiteness, pair.there.whiteness)
        if len(whiteness) < left[0].shape[2]:
            whiteness = np.full(left[0].shape[2], whiteness.min())
        beyond = [
            np.maximum(np.sum(r**2, axis=(0, 1)) - np.sum(o**2, axis=(0, 1)), 0.0) for r, o in zip(left, own, strict=True)
        ]
        falls = [float(rest @ whiteness) for rest in beyond]
        rms = [math.sqrt(float(rest.sum()) / r.size) for rest, r in zip(beyond, left, strict=True)]
        return cls(u, (rms[0], rms[1]), (falls[0], falls[1]))

    @property
    def nested(self) -> bool:
        """Does one rival contain the other, so that it copies it everywhere?"""
        return min(self.rms) < THRESHOLDS.nested_separation * max(self.rms)

    @property
    def expected(self) -> float:
        return max(self.falls)

    @property
    def settles(self) -> bool:
        """Does it say which is right, whichever is? Of two of which one contains the other, by what the larger alone does."""
        return (max(self.falls) if self.nested else min(self.falls)) > THRESHOLDS.settled_fall

    @property
    def told(self) -> float:
        return max(self.rms) if self.nested else min(self.rms)

    @property
    def value(self) -> float:
        """What is gained whichever of the two is true."""
        return THRESHOLDS.nested_separation**2 * max(self.falls) if self.nested else min(self.falls)


@final
class _Trial:
    """A pair of rivals under every input: all of them to first order, the best of them by fits to both logs."""

    def __init__(self, pair: Rivalry, inputs: Mapping[str, Array], plays: Mapping[int, _Plays], length: int) -> None:
        self.pair, self.length = pair, length
        self.plays = plays[id(pair.here)], plays[id(pair.there)]
        self.measured, self.plays_all = self.plays[0].measured, tuple(plays.values())
        self.table: dict[str, _Separation] = {}
        self._full: set[str] = set()
        for name, u in inputs.items():
            if (found := self._looked(u, self.plays)) is not None:
                self.table[name] = found
        # What looks best to first order may be less by full fits: until the best is one that has been judged so.
        for _ in range(THRESHOLDS.most_judged):
            self.judge([n for n in [self.best(self.table)] if n is not None])

    def _looked(self, u: Array, plays: Sequence[_Plays]) -> _Separation | None:
        """To first order."""
        turns = zip((self.pair.there, self.pair.here), [p.log(u) for p in plays], strict=True)
        both = [_first_order(b, log.windows(self.length)) for b, log in turns if log]
        if len(both) < 2:
            return None
        return _Separation.of(u, both, [p.own(u, self.length) for p in reversed(plays)], self.pair)

    def besides(self, beyond: Sequence[Array]) -> str:
        """What would separate a pair that no input does: an output of the model that is not measured, inputs beyond the limits,
        or more samples; "" where none of these does.
        """
        m, model = self.measured, self.pair.here.hypothesis.model
        named = sorted(self.table, key=lambda n: -self.table[n].value)[: THRESHOLDS.judged_inputs]
        for i in (i for i in range(len(model.outputs)) if i not in m.columns):
            more = [p.showing(i) for p in self.plays]
            if any(self._settles(self.table[n].u, more) for n in named):
                share = f"{100 * THRESHOLDS.further_noise:g} % of its deviation"
                return f"measure {model.outputs[i].name} as well, with noise of {share} or less"
        for u in beyond:
            if self._settles(u, self.plays):  # with no regard to how far and how fast outputs go
                y = np.concatenate([p.outputs(u[None])[0] for p in self.plays])
                ways = [f"{s.name} go from {_span(u[:, i], s.unit)}" for i, s in enumerate(model.inputs)]
                ways += [f"{s.name} from {_span(y[:, i], s.unit)}" for i, s in enumerate(m.channels)]
                return f"where the machine may, let {' and '.join(ways)} (diagnose.experiment.limits)"
        few = [self.table[n] for n in named[:1]]
        alike = self.pair.here.hypothesis.charged == self.pair.there.hypothesis.charged
        for most, u in [(min(s.falls) if alike else s.expected, s.u) for s in few]:
            if most * THRESHOLDS.longer_experiment > THRESHOLDS.settled_fall:
                times = math.ceil(2 * THRESHOLDS.settled_fall / most)
                long = f"{times * len(u) * m.period:.3g} s of {named[0]} (diagnose.experiment.seconds)"
                return f"play {long}, or take {times} times as many samples in the same time"
        return ""

    def _settles(self, u: Array, plays: Sequence[_Plays]) -> bool:
        found = self._looked(u, plays)
        return found is not None and found.expected > THRESHOLDS.settled_fall

    def judge(self, names: Sequence[str]) -> None:
        """By full fits."""
        pair, turns = self.pair, ((self.pair.here, self.pair.there), (self.pair.there, self.pair.here))
        for name in (n for n in names if n not in self._full):
            u = self.table[name].u
            both = [
                _copied(rival, self.measured, play.log(u), self.length)
                for play, (_, rival) in zip(self.plays, turns, strict=True)
            ]
            own = [p.own(u, self.length) for p in reversed(self.plays)]
            self.table[name] = _Separation.of(u, both, own, pair)
            self._full.add(name)

    def best(self, names: Iterable[str]) -> str | None:
        return max(names, key=lambda n: self.table[n].value, default=None)


def _rest(fits: Sequence[Fit], measured: Dataset, limits: Limits) -> tuple[Array, Array]:
    """State (nx,) and held input (nu,) from which an experiment begins: of where the recording was, with rates set to zero,
    what moves little by every fit, away from the ends of what is allowed, under the least input.
    """
    model, apart = fits[0].hypothesis.model, -(-sum(map(len, measured.times)) // THRESHOLDS.starts_tried)
    seen, told = (np.concatenate(parts)[::apart] for parts in (measured.states, measured.inputs))
    ranges = [np.array(list(pairs.values()), dtype=float).T for pairs in (limits.inputs, limits.outputs)]
    off, width = np.clip(0.0, *ranges[0]), np.maximum(np.ptp(seen, axis=0), 1e-300)
    states = np.concatenate(
        [measured.states[0][:1], np.clip(np.zeros((1, model.nx)), seen.min(axis=0), seen.max(axis=0)), seen]
    )
    states[:, [j for _, j in driven(model)]] = 0.0
    x, u = np.concatenate([states, states[2:]]), np.concatenate([np.tile(off, (len(states), 1)), told])
    u = np.clip(u, *ranges[0])
    with np.errstate(all="ignore"):
        y = model.output(x, u, _values(fits[0]))[:, measured.columns]
        moved = np.zeros(len(x))
        for f in fits:
            hidden, now = _memory(f, x, u, measured), np.repeat(u[:, None], measured.repeat, axis=1)
            ahead = f.hypothesis.model.fast_rollout(x, now, parameters=_values(f), hidden=hidden).x[:, -1]
            each = np.abs(difference(model.states, ahead, x)) / width
            moved = np.maximum(moved, np.nan_to_num(each, nan=np.inf).max(axis=1))
    usual = np.median(np.abs(np.diff(np.concatenate(measured.states), axis=0) / width).max(axis=1))
    ends = np.minimum(y - ranges[1][0], ranges[1][1] - y) / (ranges[1][1] - ranges[1][0])
    short = np.round(np.maximum(THRESHOLDS.free_ends - ends.min(axis=1), 0.0), 2)
    loud = moved > max(2 * float(moved.min()), THRESHOLDS.at_rest * float(usual))
    effort = np.abs((u - off) / np.maximum(ranges[0][1] - ranges[0][0], 1e-300)).sum(axis=1)
    best = int(np.lexsort([moved, effort, short, loud])[0])
    return x[best], u[best]


def _memory(fitted: Fit, x: Array, u: Array, measured: Dataset) -> Array | None:
    """What is remembered (n, nh) of inputs u (n, nu) that were held for long, where a model remembers."""
    model = fitted.hypothesis.model
    if not model.hidden:
        return None
    before = np.repeat(u[:, None], max(map(len, measured.times)) * measured.repeat, axis=1)
    with np.errstate(all="ignore"):
        return model.fast_rollout(x, before, parameters=_values(fitted), every=before.shape[1]).hidden


def _span(values: Array, unit: str) -> str:
    return f"{values.min():.3g} to {values.max():.3g}{'' if unit in ('', '1') else f' {unit}'}"


def _values(fitted: Fit) -> dict[str, float] | None:
    return {**fitted.hypothesis.fixed, **fitted.values} or None


@final
class _Plays:
    """A fitted model as it is played to from a start (nx,) under an input (nu,) that was held: what is measured, and what would
    be recorded without noise.
    """

    def __init__(self, fitted: Fit, measured: Dataset, begin: Array, held: Array) -> None:
        self.fitted, self.measured, self.held = fitted, measured, held
        self._hidden, self.begin = _memory(fitted, begin[None], held[None], measured), begin
        # A sensor that is off shows another state: what it shows is where the experiment begins.
        states = [s.name for s in fitted.hypothesis.model.states]
        shown = [(i, states.index(c.name)) for i, c in enumerate(measured.channels) if c.name in states]
        rows, columns = np.array(shown, dtype=int).reshape(-1, 2).T
        off = begin[columns] - self.outputs(held[None, None])[0, 0, rows]
        self.begin = begin.copy()
        self.begin[columns] += off
        if not (np.abs(begin[columns] - self.outputs(held[None, None])[0, 0, rows]) <= np.abs(off)).all():
            self.begin = begin
        self._logs: dict[int, tuple[Array, Dataset | None]] = {}

    def showing(self, column: int) -> _Plays:
        """With one more output of the model measured."""
        m, model = self.measured, self.fitted.hypothesis.model
        more = replace(m, channels=(*m.channels, model.outputs[column]), columns=(*m.columns, column))
        return _Plays(self.fitted, more, self.begin, self.held)

    def states(self, u: Array) -> Array:
        """(n, T, nx) under u (n, T, nu)."""
        fine, x0 = np.repeat(u, self.measured.repeat, axis=1), np.tile(self.begin, (len(u), 1))
        with np.errstate(all="ignore"):
            hidden = None if self._hidden is None else np.tile(self._hidden, (len(u), 1))
            x = self.fitted.hypothesis.model.fast_rollout(x0, fine, parameters=_values(self.fitted), hidden=hidden).x
        return np.asarray(x[:, : -1 : self.measured.repeat])

    def outputs(self, u: Array) -> Array:
        """Measured channels (n, T, ny) under u (n, T, nu). What comes late shows the start until then."""
        m, model, values = self.measured, self.fitted.hypothesis.model, _values(self.fitted)
        with np.errstate(all="ignore"):
            x, sent, known = self.states(u), u, None
            if (arriving := model.input_delays(values)).any():
                past = np.floor(np.arange(u.shape[1])[:, None] - arriving / m.period + THRESHOLDS.whole_sample)[None]
                sent = np.where(past < 0, self.held, np.take_along_axis(u, np.maximum(past, 0).astype(np.intp), axis=1))
            if self._hidden is not None and shows_memory(model):
                fine = np.repeat(u, m.repeat, axis=1)[:, : (u.shape[1] - 1) * m.repeat]
                known = flat(memories(model, x, fine, values or {}, np.tile(self._hidden, (len(u), 1)), m.repeat))
            y = model.output(flat(x), flat(sent), values, known)[:, m.columns].reshape(len(u), u.shape[1], -1)
            late = model.output_delays(values)[..., m.columns] / m.period
            ahead = np.maximum(-late, -np.arange(u.shape[1])[:, None])
            return between(y[None], ahead)[0] if late.any() else y

    def log(self, u: Array) -> Dataset | None:
        """What would be recorded and fitted; None where nothing moves."""
        if id(u) not in self._logs:
            self._logs[id(u)] = u, self._log(u)
        return self._logs[id(u)][1]

    def _log(self, u: Array) -> Dataset | None:
        # The rest will be held out of the fit.
        u = u[: int(THRESHOLDS.experiment_fitted * len(u))]
        m, model, y = self.measured, self.fitted.hypothesis.model, self.outputs(u[None])[0]
        known = len(m.spread)
        if not np.isfinite(y).all() or (np.ptp(y, axis=0)[:known] < 1e-9 * m.spread).any() or not np.ptp(y, axis=0).all():
            return None
        channels = {c.name: y[:, i] for i, c in enumerate(m.channels)}
        channels |= {s.name: u[:, i] for i, s in enumerate(model.inputs)}
        found = Dataset.of(model, Recording.of(np.asarray(np.arange(len(u)) * m.period), channels))
        order = [[c.name for c in found.channels].index(c.name) for c in m.channels]
        own = np.std(y, axis=0)[known:]
        floor, spread = np.append(m.sigma, THRESHOLDS.further_noise * own), np.append(m.spread, own)
        back = np.argsort(order)
        states = (self.states(u[None])[0],) if len(found.times) == 1 and len(found.times[0]) == len(u) else found.states
        # An experiment is played sample by sample, whatever the recording was.
        return replace(found, sigma=floor[back], spread=spread[back], hold="zero", states=states)

    def own(self, u: Array, length: int) -> Array:
        """What its own windows (W, L, ny) miss of its log from the true starts: what is late is not known where they begin."""
        log, f = self.log(u), self.fitted
        assert log is not None
        windows = log.windows(length)
        y = f.hypothesis.simulate(windows, f.theta[None], windows.start[None])
        return np.asarray(np.nan_to_num(difference(log.channels, y, windows.y[None])[0] / log.sigma * windows.weight))


def _speed(y: Array, measured: Dataset) -> Array:
    """How fast outputs (…, T, ny) change at most, (ny,), per s."""
    rows = np.abs(np.diff(y, axis=-2)).reshape(-1, y.shape[-1])
    return np.asarray(np.nan_to_num(rows, posinf=np.inf).max(axis=0) / measured.period)


def recorded_speed(fits: Sequence[Fit], measured: Dataset) -> Array:
    """How fast each measured channel was in the recording, (ny,), per s, as the quickest of the fits has it."""
    moved = [f.hypothesis.simulate(f.windows, f.theta[None], f.start[None])[0] for f in fits]
    return np.asarray(np.max([_speed(y, measured) for y in moved], axis=0))


def _within(plays: Sequence[_Plays], signals: Mapping[str, Array], limits: Limits, least: int) -> dict[str, Array]:
    """Name → u (T, nu): each input at the size whose beginning, within the limits under every fit, times the size is longest,
    and then back to what was held.

    An input of which less than `least` samples can be played is left out.
    """
    measured = plays[0].measured
    names = [c.name for c in measured.channels]
    low, high = (np.array([limits.outputs[n][i] for n in names]) for i in (0, 1))
    # No fit is the machine: some room is left, but where it begins is allowed.
    room = THRESHOLDS.experiment_room * (high - low)
    held = plays[0].held
    begin = [p.outputs(held[None, None])[0, 0] for p in plays]
    lowest, highest = (np.array([f(end, b) for b in begin]) for f, end in ((np.minimum, low + room), (np.maximum, high - room)))
    fastest = recorded_speed([p.fitted for p in plays], measured) * [limits.wider.get(n, 1.0) for n in names] * measured.period

    def inside(u: Array) -> Array:
        """How many samples of each of u (n, T, nu) can be played."""
        good = np.ones(u.shape[:2], dtype=bool)
        for p, least_y, most_y in zip(plays, lowest, highest, strict=True):
            y = p.outputs(u)
            good &= ((y >= least_y) & (y <= most_y)).all(axis=2)
            good[:, 1:] &= (np.abs(np.diff(y, axis=1)) <= fastest).all(axis=2)
        return np.asarray(np.cumprod(good, axis=1).sum(axis=1))

    longest: dict[str, Array] = {}
    worth: dict[str, float] = {}
    for size in THRESHOLDS.input_sizes:
        tried = [n for n in signals if worth.get(n, 0.0) < size * len(signals[n])]
        if not tried:
            break
        u = np.stack([held + size * (signals[n] - held) for n in tried])
        for n, row, kept in zip(tried, u, inside(u).tolist(), strict=True):
            # It may not end at full speed near an end: back to what is held, for so long that this is seen.
            back = math.ceil(THRESHOLDS.experiment_tail * len(row))
            kept = min(kept, len(row) - back)
            cuts = [k for k in (int(kept * part) for part in THRESHOLDS.experiment_cuts) if k + back >= least]
            if not cuts or size * (kept + back) <= worth.get(n, 0.0):
                continue
            fall = np.maximum(1 - 2 * np.arange(back) / back, 0.0)[:, None]
            ended = np.stack([np.concatenate([row[:k], held + fall * (row[k - 1] - held), row[k:] * 0 + held]) for k in cuts])
            whole = [k + back for k, far in zip(cuts, inside(ended).tolist(), strict=True) if far >= k + back]
            if whole and size * whole[0] > worth.get(n, 0.0):
                longest[n], worth[n] = ended[cuts.index(whole[0] - back), : whole[0]], size * whole[0]
    return longest


def _first_order(rival: Fit, windows: Windows) -> Array:
    """What the rival cannot copy of these windows (W, L, ny) once its numbers and the starts have followed, to first order.

    The numbers cost what they cost on the data that they come from: δᵀ C⁻¹ δ.
    """
    h, theta, p, nx = rival.hypothesis, rival.theta, len(rival.theta), windows.start.shape[1]
    start = fit(h.holding(theta), windows, iterations=THRESHOLDS.design_start_iterations).start
    thetas, starts, width = nearby(h, theta, start, h.step)
    m = windows.measured
    r = difference(m.channels, h.simulate(windows, thetas, starts), windows.y[None]) / m.sigma * windows.weight
    rows = np.nan_to_num(r.reshape(1 + p + nx, len(windows), -1), posinf=0.0, neginf=0.0)
    slopes = np.moveaxis((rows[1:] - rows[:1]) / width[:, None, None], 0, -1)
    free = np.linalg.qr(slopes[..., p:])[0]
    kept = np.concatenate([slopes[..., :p], rows[0][..., None]], axis=-1)
    kept = (kept - free @ (np.swapaxes(free, 1, 2) @ kept)).reshape(-1, p + 1)
    known = np.linalg.pinv(rival.covariance) if p else np.empty((0, 0))
    move = np.linalg.lstsq(kept[:, :p].T @ kept[:, :p] + known, kept[:, :p].T @ kept[:, p], rcond=None)[0]
    return np.asarray((kept[:, p] - kept[:, :p] @ move).reshape(windows.y.shape))


def _copied(rival: Fit, measured: Dataset, log: Dataset | None, length: int) -> Array:
    """What the rival cannot copy of the log's windows (W, L, ny) when it is fitted to the old data and to the log together."""
    assert log is not None
    both = joined(measured, log)
    windows = both.windows(length)
    again = fit(rival.hypothesis, windows, theta=rival.theta, iterations=THRESHOLDS.design_iterations)
    return again.residual[windows.place[:, 0] >= len(measured.outputs)]


def joined(first: Dataset, second: Dataset) -> Dataset:
    """Both, with the noise floor of the first."""
    parts = ("times", "outputs", "inputs", "states", "weights", "offsets")
    both: dict[str, Any] = {n: (*getattr(first, n), *getattr(second, n)) for n in parts}
    hold = first.hold or "zero"
    drives = dict.fromkeys(first.drives, (*first.drives[hold], *second.drives["zero"]))
    source = (*first.source, *(max(first.source) + 1 + s for s in second.source))
    return replace(first, **both, drives=drives, source=source)


def _experiment(trial: _Trial, name: str, trials: Sequence[_Trial], begin: Array) -> Experiment:
    pair, table, measured, model = trial.pair, trial.table, trial.measured, trial.pair.here.hypothesis.model
    for other in trials:
        other.judge([name] if name in other.table else [])
    chosen = table[name]
    t = np.asarray(np.arange(len(chosen.u)) * measured.period)
    inputs = {s.name: chosen.u[:, i] for i, s in enumerate(model.inputs)}
    (a, b), (c, d) = pair.named, pair.other
    apart = tuple(
        Apart(o.pair.named, o.pair.other, *o.table[name].rms, o.table[name].settles) for o in trials if name in o.table
    )
    moved = np.concatenate([p.outputs(chosen.u[None]) for p in trial.plays_all])
    fits = [p.fitted for p in trial.plays_all]
    # What decays towards rest is told as rest.
    ends, fast = np.where(np.abs(moved) < measured.sigma, 0.0, moved), _speed(moved, measured)
    known = recorded_speed(fits, measured)
    before = [_range(np.concatenate(measured.outputs)[:, i]) for i in range(len(known))]
    travel = {
        s.name: Travel(float(ends[..., i].min()), float(ends[..., i].max()), s.unit, float(fast[i]), before[i], float(known[i]))
        for i, s in enumerate(measured.channels)
    }
    sentence = (
        f"to tell {a} at {b} from {c} at {d}: play {name} for {t[-1]:.3g} s; "
        f"their predictions then differ by {chosen.told:.2g} times the noise, by {math.sqrt(chosen.expected):.2g} sigma in all"
    )
    others = {n: s.told for n, s in table.items() if n != name}
    values = [*begin.tolist(), *trial.plays[0].held.tolist()]
    start = {s.name: (v, s.unit) for s, v in zip((*model.states, *model.inputs), values, strict=True)}
    predicted = {s.name: moved[..., i] for i, s in enumerate(measured.channels)}
    rivals, window = (pair.named, pair.other), trial.length * measured.period
    return Experiment(rivals, name, sentence, t, inputs, chosen.told, others, travel, apart, start, predicted, window)


def shapes(
    limits: Mapping[str, tuple[float, float]], seconds: float, measured: Dataset, seed: int, held: Array | None = None
) -> dict[str, Array]:
    """Name → u (T, nu): every input at once, each with phases and levels of its own; frequencies in units of the motion's.

    held (nu,): where gentle ones begin, by default off.
    """
    period, count = measured.period, measured.samples(seconds)
    t, beat = np.arange(count) * period, _beat(measured)
    most = THRESHOLDS.fastest_input / period
    low, high = (np.array([pair[i] for pair in limits.values()]) for i in (0, 1))
    middle, half = (low + high) / 2, (high - low) / 2
    rest = np.clip(0.0, low, high) if held is None else held
    rng = np.random.default_rng(seed)

    def sines(band: tuple[float, float]) -> Array:
        top = min(band[1] * beat, most)
        frequencies = np.linspace(min(max(band[0] * beat, 1 / seconds), top), top, THRESHOLDS.multisine_lines)
        phases = rng.uniform(0, 2 * np.pi, (THRESHOLDS.multisine_lines, len(low)))
        waves = np.sin(2 * np.pi * frequencies[:, None, None] * t[:, None] + phases[:, None]).sum(axis=0)
        return np.asarray(waves / np.abs(waves).max(axis=0))

    def levels(hold: float) -> Array:
        each = max(1, round(hold / beat / period))
        drawn = rng.uniform(-1, 1, (-(-count // each), len(low)))
        return np.repeat(drawn, each, axis=0)[:count]

    def every(shape: Array) -> Array:
        return np.repeat(shape[:, None], len(low), axis=1)

    turn = min(10.0 * beat, most)
    unit = {name: sines(band) for name, band in BANDS.items()}
    unit |= {
        "steps": levels(0.4),
        "slow steps": levels(2.0),
        "switching": np.sign(levels(0.3)),
        "fast switching": np.sign(levels(0.06)),
    }
    unit["a chirp"] = every(np.sin(2 * np.pi * (0.1 * beat * t + (turn - 0.1 * beat) * t**2 / (2 * seconds))))
    unit["a creeping ramp"] = every(1 - 4 * np.abs((t / seconds + 0.25) % 1 - 0.5))
    unit |= {f"{name}, small": THRESHOLDS.small_input * unit[name] for name in GENTLE}
    # What drifts comes back: a double integrator ends at rest where it began.
    unit |= {f"{name}, there and back": _returning(unit[name]) for name in BACK}
    out = {name: middle + half * shape for name, shape in unit.items()}
    # A first jump alone may be quicker than anything recorded.
    rise = np.minimum(t / (THRESHOLDS.gentle_rise * seconds), 1.0)[:, None]
    out |= {f"{name}, begun gently": rest + rise * (out[name] - rest) for name in GENTLE}
    # One push, then nothing: what is left decays freely, four times.
    phase = (t % (seconds / 4)) / (seconds / 4)
    kick = np.where(phase < min(0.1, 0.25 / (beat * seconds / 4)), 1.0, 0.0) * np.where(
        (4 * t / seconds).astype(int) % 2, -1, 1
    )
    out["pulses and free decay"] = np.where(kick[:, None] > 0, high, np.where(kick[:, None] < 0, low, rest))
    own = next((u for u in measured.inputs if len(u) >= count), None)
    if own is not None:
        out["the input of the recording"] = np.clip(own[:count], low, high)
    return out


def _returning(shape: Array) -> Array:
    """The first quarter of a shape, then its opposite twice, then itself."""
    quarter = shape[: -(-len(shape) // 4)]
    return np.concatenate([quarter, -quarter, -quarter, quarter])[: len(shape)]


def _beat(measured: Dataset) -> float:
    """How often the quickest output crosses its mean upwards, in Hz."""
    rates = []
    for y in measured.outputs:
        swing = np.nan_to_num(y - np.nanmean(y, axis=0)) / np.maximum(measured.spread, 1e-300)
        # Only crossings from well below to well above: noise crosses all the time.
        level = np.where(swing > 0.3, 1, np.where(swing < -0.3, -1, 0))
        for column in level.T:
            marks = column[column != 0]
            rates.append(np.count_nonzero((marks[:-1] < 0) & (marks[1:] > 0)) / (len(y) * measured.period))
    return float(max(rates)) or 1 / (len(measured.outputs[0]) * measured.period)
