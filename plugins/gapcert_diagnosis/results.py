"""What a diagnosis says: causes with their numbers, rivals, the gain, what is left, and the experiment that would tell more."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, final

import numpy as np

from gapcert.plugin import Array, Extension, Model, Shown, view

Verdict = Literal["causes", "ambiguous", "nothing", "unexplained"]

# Names of effects, simplest law first within a kind of site: ties between equally small sets go by this order.
_ORDER = """
viscous-friction coulomb-friction stribeck-friction lugre-friction dahl-friction quadratic-drag
load-dependent-friction asymmetric-coulomb-friction asymmetric-viscous-friction linear-spring cubic-spring
constant-force gravity-tilt cogging payload joint-coupling backlash gear-play external-push parameter
contact-friction contact-restitution engine-setting input-gain input-offset input-dead-zone input-saturation
wheel-slip side-slip input-nonlinearity input-hysteresis input-delay input-lag input-rate-limit input-rate-limited-lag
supply-sag sensor-bias sensor-scale sensor-delay sensor-lag sensor-quantisation
"""
ORDER = tuple(_ORDER.split())


@final
@dataclass(frozen=True)
class Estimate:
    """A fitted number and its 95 % interval."""

    value: float
    unit: str
    low: float
    high: float

    @classmethod
    def of(cls, value: float, half: float = 0.0, unit: str = "1") -> Estimate:
        """value ± half."""
        return cls(value, unit, value - half, value + half)


@final
@dataclass(frozen=True)
class Rival:
    """What else was tried in place of a cause, how much it explained, and by how much its score is worse (margin ΔS).

    leaves: the held-out RMSE per channel at the longest horizon with it in the cause's place.
    """

    effect: str
    site: str
    explained: float
    margin: float = float("nan")
    leaves: Mapping[str, float] = field(default_factory=dict)


@final
@dataclass(frozen=True)
class Cause:
    """An effect that was named: parameters with intervals and the share of the held-out rollout error that it explains.

    explained = 1 − E_after/E_before with all other named causes kept. native: the engine's own name; flags: sentences about
    values that are not plausible; setting: `value` and `was` of an engine's setting; unit_slip: units that a factor confuses.
    """

    effect: str
    site: str
    parameters: Mapping[str, Estimate]
    explained: float
    runner_up: Rival | None = None
    native: str | None = None
    flags: tuple[str, ...] = ()
    setting: Mapping[str, Any] | None = None
    unit_slip: str | None = None


@final
@dataclass(frozen=True)
class Gain:
    """RMSE of held-out rollouts of one channel before and after; [low, high] is the 95 % bootstrap interval of `after`."""

    before: float
    after: float
    low: float
    high: float


@final
@dataclass(frozen=True)
class Misfit:
    """RMS error of the fitted windows of one channel, before and after, beside the noise floor."""

    before: float
    after: float
    noise_floor: float


@final
@dataclass(frozen=True)
class Push:
    """A short force at `site` that no law in the library makes: in which trajectory, from when (s of the log), for how long.

    size: its impulse, with the 95 % interval [low, high]; force: its mean. Of what is much shorter than the motion only the
    impulse is known well.
    """

    trajectory: str
    t: float
    duration: float
    site: str
    sign: int
    size: float
    unit: str
    low: float
    high: float
    force: float
    force_unit: str


@final
@dataclass(frozen=True)
class Correction:
    """A law of the missing force at `site` that data suggest where no effect fits: offered as such, never a cause.

    kind: `basis`; terms: text in the model's names → coefficient; explained: share of the residual in windows that it has
    not seen; extension: what `Model.extend` takes to add it.
    """

    site: str
    kind: str
    terms: Mapping[str, float]
    explained: float
    extension: Extension | None = None


@final
@dataclass(frozen=True)
class Unexplained:
    """What is left: does it need memory (a law of the present state and input cannot make it), and single events.

    looks_like: share of the residual that features of each kind predict in windows they have not seen; where: (from, to) in
    s of the stretches that carry most of it; correction: what data alone would add.
    """

    needs_memory: bool
    events: tuple[Push, ...] = ()
    looks_like: Mapping[str, float] = field(default_factory=dict)
    where: tuple[tuple[float, float], ...] = ()
    correction: Correction | None = None

    def summary(self) -> dict[str, Any]:
        """As plain data; keys that do not apply are absent."""
        out: dict[str, Any] = {"needs_memory": self.needs_memory, "events": [vars(e).copy() for e in self.events]}
        out |= {"looks_like": dict(self.looks_like)} if self.looks_like else {}
        out |= {"where": [list(w) for w in self.where]} if self.where else {}
        if (c := self.correction) is not None:
            out["correction"] = {"site": c.site, "kind": c.kind, "terms": dict(c.terms), "explained": c.explained}
        return out


@final
@dataclass(frozen=True)
class Apart:
    """How far apart an experiment drives two rivals: RMS in noise floors of what the other cannot copy, if `one` is true, and
    if `other` is. separated: does that decide?
    """

    one: tuple[str, str]
    other: tuple[str, str]
    if_one: float
    if_other: float
    separated: bool


@final
@dataclass(frozen=True)
class Travel:
    """Of a measured output in an experiment, as any rival expects it: where it goes, and how fast at most, per s; beside what
    it did in the recording.
    """

    low: float
    high: float
    unit: str
    speed: float
    recorded: tuple[float, float]
    recorded_speed: float


@final
@dataclass(frozen=True)
class Experiment:
    """An input that tells two rivals apart: computed from both fits, inside the limits.

    t (T,) in s, inputs: name → (T,); separation: rms distance, in units of the noise floor, between what one rival predicts
    and the best that the other can do to copy it, of the pair in `rivals`, which is the hardest; others: separation of every
    other input that was tried, by its name; travel: of every measured output. apart: of every two that tie. start: the states
    from which it begins and the inputs that are held there, (value, unit). predicted: of every measured output (rivals, T).
    window: how long the stretches are, in s, whose starts the copy may choose.
    """

    rivals: tuple[tuple[str, str], tuple[str, str]]
    name: str
    sentence: str
    t: Array
    inputs: Mapping[str, Array]
    separation: float
    others: Mapping[str, float] = field(default_factory=dict)
    travel: Mapping[str, Travel] = field(default_factory=dict)
    apart: tuple[Apart, ...] = ()
    start: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    predicted: Mapping[str, Array] = field(default_factory=dict)
    window: float | None = None

    def summary(self) -> dict[str, Any]:
        """As plain data, without the signal."""
        rivals = [_of(r) for r in self.rivals]
        seconds = float(np.ptp(self.t)) if len(self.t) else 0.0
        told = {"name": self.name, "sentence": self.sentence, "seconds": seconds, "separation": self.separation}
        told |= {} if self.window is None else {"window": self.window}
        travel = {n: vars(t) | {"recorded": list(t.recorded)} for n, t in self.travel.items()}
        apart = [vars(p) | {"one": _of(p.one), "other": _of(p.other)} for p in self.apart]
        start = {n: {"value": v, "unit": unit} for n, (v, unit) in self.start.items()}
        return {"rivals": rivals, **told, "start": start, "travel": travel, "apart": apart, "others": dict(self.others)}

    def csv(self) -> str:
        """As a file to play: column t in s, then every input in the model's unit, held from one row to the next."""
        rows = np.column_stack([self.t, *self.inputs.values()])
        lines = (",".join(f"{v:.9g}" for v in row) for row in rows.tolist())
        return "\n".join([",".join(["t", *self.inputs]), *lines]) + "\n"


@final
@dataclass(frozen=True)
class Seen:
    """The smallest size of an effect that these data would show: the value of one of its parameters.

    share: of the effort at its site, of the spread of an output, or of a stated value, where it does most; None where there is
    next to no effort. off: the value at which the effect does nothing, where that is neither zero nor beyond all bounds.
    """

    effect: str
    site: str
    parameter: str
    value: float
    unit: str
    share: float | None = None
    off: float | None = None


@final
@dataclass(frozen=True, repr=False)
class Diagnosis(Shown):
    """Ranked causes with evidence and rivals, what they bought on held-out data, and the model extended by them.

    ambiguous_with: other sets of (effect, site) that explain these data as well; gain: horizon in s as text → channel → Gain;
    negligible: (effect, site, share of the effort) of what is there, but too small to be named; smallest: for the answer
    `nothing`; evidence: tests of the residual by name → channel → number; log: what was repaired in the recording, and how
    its input is held; assumptions: what is taken for granted, in words; seconds: how long the experiments were that were tried
    to tell apart what is `ambiguous_with` the causes, where none does; warnings: what puts the whole answer in doubt, in words;
    refitted: name → {"stated", "value", "low", "high", "unit"} of the model's parameters that have a tolerance; pushes: short
    forces from outside, all along the recording.
    """

    verdict: Verdict
    causes: tuple[Cause, ...]
    residual: Mapping[str, Misfit]
    gain: Mapping[str, Mapping[str, Gain]]
    extended_model: Model
    ambiguous_with: tuple[tuple[tuple[str, str], ...], ...] = ()
    experiment: str | None = None
    unexplained: Unexplained | None = None
    figure: Any = None
    timings: Mapping[str, float] = field(default_factory=dict)
    design: Experiment | None = None
    negligible: tuple[tuple[str, str, float], ...] = ()
    smallest: tuple[Seen, ...] = ()
    evidence: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    log: Mapping[str, Any] = field(default_factory=dict)
    assumptions: tuple[str, ...] = ()
    seconds: float | None = None
    warnings: tuple[str, ...] = ()
    refitted: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    pushes: tuple[Push, ...] = ()

    def sentence(self) -> str:
        """What was found, and what it bought, in one sentence or two."""
        return view("Diagnosis").sentence(self)

    def summary(self) -> dict[str, Any]:
        """As plain data; keys that do not apply are absent."""
        part = {"partial": True} if self.verdict == "unexplained" else {}
        out: dict[str, Any] = {"verdict": self.verdict, "causes": [_cause(c) | part for c in self.causes]}
        if self.ambiguous_with:
            out["ambiguous_with"] = [[{"effect": e, "site": s} for e, s in group] for group in self.ambiguous_with]
        out |= {k: v for k, v in (("seconds", self.seconds), ("experiment", self.experiment)) if v}
        out |= {k: v.summary() for k, v in (("design", self.design), ("unexplained", self.unexplained)) if v is not None}
        measured = {s.name: s.unit for s in self.extended_model.outputs if s.name in self.residual}
        out["units"] = {n: measured.get(n, "1") for n in self.residual}
        out["residual"] = {n: vars(m).copy() for n, m in self.residual.items()}
        out["gain"] = {h: {n: vars(g).copy() for n, g in channels.items()} for h, channels in self.gain.items()}
        out |= {"evidence": {test: dict(channels) for test, channels in self.evidence.items()}} if self.evidence else {}
        out |= {"negligible": [{"effect": e, "site": s, "share": v} for e, s, v in self.negligible]} if self.negligible else {}
        out |= {"smallest": [vars(s).copy() for s in self.smallest]} if self.smallest else {}
        out |= {"pushes": [vars(p).copy() for p in self.pushes]} if self.pushes else {}
        told: dict[str, Any] = {k: list(getattr(self, k)) for k in ("warnings", "assumptions")}
        told |= {k: dict(getattr(self, k)) for k in ("refitted", "log")}
        return out | {k: v for k, v in told.items() if v} | {"timings": dict(self.timings)}


def _of(key: tuple[str, str]) -> dict[str, str]:
    return {"effect": key[0], "site": key[1]}


def _cause(cause: Cause) -> dict[str, Any]:
    out: dict[str, Any] = {"effect": cause.effect, "site": cause.site}
    out |= {} if cause.native is None else {"native": cause.native}
    out |= {} if cause.setting is None else {"setting": dict(cause.setting)}
    out |= {} if cause.unit_slip is None else {"unit_slip": cause.unit_slip}
    out["parameters"] = {n: vars(p).copy() for n, p in cause.parameters.items()}
    out["explained"] = cause.explained
    if cause.runner_up is not None:
        rival = vars(cause.runner_up) | {"leaves": dict(cause.runner_up.leaves)}
        out["runner_up"] = {k: v for k, v in rival.items() if v == v and v != {}}
    if cause.flags:
        out["flags"] = list(cause.flags)
    return out
