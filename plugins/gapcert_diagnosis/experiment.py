"""Which experiment tells rivals apart: inputs within limits, judged by what one rival predicts and the other cannot copy."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from gapcert.plugin import Array, Model, Recording, UsageError, difference, magnitude

from .data.dataset import Dataset, Windows, flat
from .fitting.fit import Fit, fit, nearby
from .fitting.hypothesis import between, memories, shows_memory
from .results import Experiment
from .search.candidates import Causes
from .thresholds import THRESHOLDS

LIMITS = ("diagnose", "experiment", "limits")  # where a spec says them
BANDS = {"a slow swing": (0.08, 0.4), "a slow multisine": (0.2, 1.5), "a multisine": (0.3, 4.0),
         "a fast multisine": (3.0, 12.0), "a very fast multisine": (12.0, 30.0)}  # fmt: skip
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
    """What an experiment may do: [low, high] of every input and of every measured output, and its length in s."""

    inputs: Mapping[str, tuple[float, float]]
    outputs: Mapping[str, tuple[float, float]]
    seconds: float

    @classmethod
    def of(cls, model: Model, measured: Dataset, given: Mapping[str, Any] | None = None, seconds: float = 12.0) -> Limits:
        """Where nothing is given: inputs as in the data, or off; outputs as in the data. Texts may carry units."""
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
        return cls({n: asked.get(n, r) for n, r in inputs.items()}, {n: asked.get(n, r) for n, r in outputs.items()}, seconds)


def _range(values: Array) -> tuple[float, float]:
    low, high = np.nanquantile(values, [0.001, 0.999]).tolist()
    return low, high


def design(
    pairs: Sequence[Rivalry], measured: Dataset, limits: Limits, length: int, seed: int = 0
) -> tuple[Experiment | None, tuple[bool, ...]]:
    """The input from which the pair that it separates least gains most, and which pairs can be separated at all.

    length: of a window in samples. For every input one rival is simulated, and the other refitted to it with starts,
    nuisances and its own numbers free as far as the data leave them free; what it cannot copy counts, in both directions.
    """
    if not pairs or not limits.inputs:
        return None, tuple(False for _ in pairs)
    fits = [f for k, pair in enumerate(pairs) for f in ((pair.here, pair.there) if k == 0 else (pair.there,))]
    allowed = _within(fits, shapes(limits.inputs, limits.seconds, measured, seed), measured, limits, 2 * length)
    trials = [_Trial(pair, allowed, measured, length) for pair in pairs]
    best = [t.best(t.table) for t in trials]
    separable = tuple(
        name is not None and t.table[name].expected > THRESHOLDS.settled_fall for t, name in zip(trials, best, strict=True)
    )
    if not any(separable):
        return None, separable
    able = [t for t, yes in zip(trials, separable, strict=True) if yes]
    name = _common(able)
    # Where no input is played for all of them, the pair that is hardest decides.
    hardest = min(able, key=lambda t: t.table[name].value if name else max(s.value for s in t.table.values()))
    return _experiment(hardest, name or hardest.best(hardest.table) or "", measured), separable


def _common(trials: Sequence[_Trial]) -> str | None:
    """The input from which the pair that gains least gains most, judged by full fits."""
    names = [n for n in trials[0].table if all(n in t.table for t in trials)]
    names = sorted(names, key=lambda n: -min(t.table[n].value for t in trials))[: THRESHOLDS.judged_inputs]
    for t in trials:
        t.judge(names)
    return max(names, key=lambda n: min(t.table[n].value for t in trials), default=None)


def told_apart(
    causes: Causes, last: Fit, ties: Sequence[tuple[Causes, Fit]], measured: Dataset, limits: Limits, seed: int = 0
) -> tuple[Experiment | None, tuple[bool, ...]]:
    """`design` for a set of causes and the other sets that explain the data as well."""
    pairs = []
    for tie, fitted in ties:
        mine, other = {c.told for c in causes}, {c.told for c in tie}
        a, b = next(iter(sorted(mine - other)), min(mine)), next(iter(sorted(other - mine)), min(other))
        pairs.append(Rivalry(a, b, last, fitted))
    return design(pairs, measured, limits, last.residual.shape[1], seed)


@final
@dataclass(frozen=True)
class _Separation:
    """Of one input: u (T, nu), and per direction the rms that cannot be copied and the expected fall in score."""

    u: Array
    rms: tuple[float, float]
    falls: tuple[float, float]

    @classmethod
    def of(cls, u: Array, left: Sequence[Array], pair: Rivalry) -> _Separation:
        """From what cannot be copied, (W, L, ny), in each direction. Coloured noise counts for less."""
        whiteness = np.minimum(pair.here.whiteness, pair.there.whiteness)
        falls = [float(np.sum(r**2, axis=(0, 1)) @ whiteness) for r in left]
        rms = [float(np.sqrt(np.mean(r**2))) for r in left]
        return cls(u, (rms[0], rms[1]), (falls[0], falls[1]))

    @property
    def nested(self) -> bool:
        """Does one rival contain the other, so that it copies it everywhere?"""
        return min(self.rms) < THRESHOLDS.nested_separation * max(self.rms)

    @property
    def expected(self) -> float:
        return max(self.falls)

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

    def __init__(self, pair: Rivalry, inputs: Mapping[str, Array], measured: Dataset, length: int) -> None:
        self.pair, self.measured, self.length = pair, measured, length
        self.table: dict[str, _Separation] = {}
        self._full: set[str] = set()
        for name, u in inputs.items():
            logs = [_log(f, u, measured) for f in (pair.here, pair.there)]
            both = [_first_order(b, log.windows(length)) for b, log in zip((pair.there, pair.here), logs, strict=True) if log]
            if len(both) == 2:
                self.table[name] = _Separation.of(u, both, pair)
        self.judge(sorted(self.table, key=lambda n: -self.table[n].value)[: THRESHOLDS.judged_inputs])

    def judge(self, names: Sequence[str]) -> None:
        """By full fits."""
        pair, turns = self.pair, ((self.pair.here, self.pair.there), (self.pair.there, self.pair.here))
        for name in (n for n in names if n not in self._full):
            u = self.table[name].u
            both = [_copied(rival, self.measured, _log(truth, u, self.measured), self.length) for truth, rival in turns]
            self.table[name] = _Separation.of(u, both, pair)
            self._full.add(name)

    def best(self, names: Iterable[str]) -> str | None:
        return max(names, key=lambda n: self.table[n].value, default=None)


def _within(
    fits: Sequence[Fit], signals: Mapping[str, Array], measured: Dataset, limits: Limits, least: int
) -> dict[str, Array]:
    """Name → u (T, nu): each input at the size whose beginning, within the limits under every fit, times the size is longest.

    An input of which less than `least` samples can be played is left out.
    """
    low, high = (np.array([limits.outputs[c.name][i] for c in measured.channels]) for i in (0, 1))
    middle = np.array([0.0 if a <= 0 <= b else (a + b) / 2 for a, b in limits.inputs.values()])
    longest: dict[str, Array] = {}
    worth: dict[str, float] = {}
    for size in THRESHOLDS.input_sizes:
        names = [n for n in signals if worth.get(n, 0.0) < size * len(signals[n])]
        if not names:
            break
        u = np.stack([middle + size * (signals[n] - middle) for n in names])
        inside = np.ones(u.shape[:2], dtype=bool)
        for f in fits:
            y = _played(f, u, measured)
            inside &= ((y >= low) & (y <= high)).all(axis=2)
        for n, row, kept in zip(names, u, np.cumprod(inside, axis=1).sum(axis=1).tolist(), strict=True):
            if kept >= least and size * kept > worth.get(n, 0.0):
                longest[n], worth[n] = row[:kept], size * kept
    return longest


def _played(fitted: Fit, u: Array, measured: Dataset) -> Array:
    """Measured channels (n, T, ny) of the fitted model under u (n, T, nu), from where the first recording started.

    What comes late shows that start until then.
    """
    h, n, repeat = fitted.hypothesis, len(u), measured.repeat
    values = {**h.fixed, **fitted.values}
    fine = np.repeat(u, repeat, axis=1)
    x0 = np.tile(measured.states[0][0], (n, 1))
    with np.errstate(all="ignore"):
        x = h.model.fast_rollout(x0, fine, parameters=values or None).x[:, :-1:repeat]
        past = np.floor(np.arange(u.shape[1])[:, None] - h.model.input_delays(values or None) / measured.period + 1e-6)
        sent, known = np.take_along_axis(u, np.maximum(past, 0).astype(np.intp)[None], axis=1), None
        if shows_memory(h.model):
            begun = np.tile(h.model.hidden_default, (n, 1))
            known = flat(memories(h.model, x, fine[:, : (u.shape[1] - 1) * repeat], values, begun, repeat))
        shown = h.model.output(flat(x), flat(sent), values or None, known)
        y = shown[:, measured.columns].reshape(n, u.shape[1], -1)
        late = h.model.output_delays(values or None)[..., measured.columns] / measured.period
        ahead = np.maximum(-late, -np.arange(u.shape[1])[:, None])
        return between(y[None], ahead)[0] if late.any() else y


def _log(fitted: Fit, u: Array, measured: Dataset) -> Dataset | None:
    """What would be recorded without noise; None where nothing moves."""
    y = _played(fitted, u[None], measured)[0]
    if not np.isfinite(y).all() or (np.ptp(y, axis=0) < 1e-9 * measured.spread).any():
        return None
    channels = {c.name: y[:, i] for i, c in enumerate(measured.channels)}
    channels |= {s.name: u[:, i] for i, s in enumerate(fitted.hypothesis.model.inputs)}
    found = Dataset.of(fitted.hypothesis.model, Recording.of(np.asarray(np.arange(len(u)) * measured.period), channels))
    # An experiment is played sample by sample, whatever the recording was.
    return replace(found, sigma=measured.sigma, spread=measured.spread, hold="zero")


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


def _experiment(trial: _Trial, name: str, measured: Dataset) -> Experiment:
    pair, table = trial.pair, trial.table
    chosen = table[name]
    inputs = {s.name: chosen.u[:, i] for i, s in enumerate(pair.here.hypothesis.model.inputs)}
    (a, b), (c, d) = pair.named, pair.other
    far, y = chosen.told, np.concatenate([_played(f, chosen.u[None], measured)[0] for f in (pair.here, pair.there)])
    # What decays towards rest is told as rest.
    ends = np.where(np.abs(y) < measured.sigma, 0.0, y)
    travel = {s.name: (float(ends[:, i].min()), float(ends[:, i].max()), s.unit) for i, s in enumerate(measured.channels)}
    sentence = (
        f"to tell {a} at {b} from {c} at {d}: play {name} for {len(chosen.u) * measured.period:.3g} s; "
        f"their predictions then differ by {far:.2g} times the noise, by {math.sqrt(chosen.expected):.2g} sigma in all"
    )
    others = {n: s.told for n, s in table.items() if n != name}
    t = np.asarray(np.arange(len(chosen.u)) * measured.period)
    return Experiment((pair.named, pair.other), name, sentence, t, inputs, far, others, travel)


def shapes(limits: Mapping[str, tuple[float, float]], seconds: float, measured: Dataset, seed: int) -> dict[str, Array]:
    """Name → u (T, nu): every input at once, each with phases and levels of its own; frequencies in units of the motion's."""
    period, count = measured.period, measured.samples(seconds)
    t, beat = np.arange(count) * period, _beat(measured)
    most = THRESHOLDS.fastest_input / period
    low, high = (np.array([pair[i] for pair in limits.values()]) for i in (0, 1))
    middle, half = (low + high) / 2, (high - low) / 2
    rest = np.clip(0.0, low, high)
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
    unit |= {
        f"{name}, small": THRESHOLDS.small_input * unit[name]
        for name in ("a slow swing", "a multisine", "slow steps", "a creeping ramp")
    }
    # What drifts comes back: a double integrator ends at rest where it began.
    unit |= {f"{name}, there and back": _returning(unit[name]) for name in BACK}
    out = {name: middle + half * shape for name, shape in unit.items()}
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
