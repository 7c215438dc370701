"""Why wrong: physical causes with names, the sites where they act, and what a diagnosis says about them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal, final

from gapcert.errors import UsageError
from gapcert.system import Extension, Model, Parameter

if TYPE_CHECKING:
    from gapcert.figures import DiagnosisFigure

SiteKind = Literal["coordinate", "input", "output", "parameter"]
Verdict = Literal["causes", "ambiguous", "nothing", "unexplained"]


@final
@dataclass(frozen=True)
class EffectParameter:
    """One number of an effect, in powers of what a site is measured in.

    `dimension` maps force, velocity, position, input and time to exponents (empty: a pure number). It gives the unit at a site
    and, from the data there, the scale; `starts`, `low` and `high` are multiples of that scale (of 1 s and 1 for times and pure
    numbers). At `off` the effect does nothing.
    """

    name: str
    dimension: Mapping[str, int]
    starts: tuple[float, ...]
    low: float
    high: float
    off: float = 0.0

    def unit(self, site: Mapping[str, str]) -> str:
        """From the units of force, velocity, position and input at a site."""
        known = {**site, "time": "s"}
        over = [known[k] if n == 1 else f"({known[k]})**{n}" for k, n in self.dimension.items() if n > 0]
        under = ["/" + (f"({known[k]})" if n == -1 else f"({known[k]})**{-n}") for k, n in self.dimension.items() if n < 0]
        return ("*".join(over) or "1") + "".join(under)

    def scale(self, site: Mapping[str, float]) -> float:
        """From the root mean squares of force, velocity, position and input at a site."""
        product = 1.0
        for k, n in self.dimension.items():
            product *= {**site, "time": 1.0}[k] ** n
        return product


class Effect(ABC):
    """One physical cause, written as equations at a site. Subclasses set the attributes and implement `extension`.

    name: kebab-case, a contract; site: the kind of site; sentence: what it is; signature: how data show it; rivals: name of a
    similar effect → the experiment that tells the two apart; experiment: what makes this effect visible at all.
    """

    name: str
    site: SiteKind
    parameters: tuple[EffectParameter, ...]
    sentence: str
    signature: str
    experiment: str
    rivals: ClassVar[Mapping[str, str]] = {}

    @abstractmethod
    def extension(self, site: str, model: Model) -> Extension:
        """What `model.extend` adds, with every parameter at its `off` value."""

    @final
    def named(self, site: str, model: Model) -> tuple[Parameter, ...]:
        """The parameters at one site, with names that are unique in the model, units, and value `off`."""
        units = site_units(model, self.site, site)
        prefix = self.name.replace("-", "_")

        def one(p: EffectParameter) -> Parameter:
            # Bounds in units of the data are the fit's affair; only a sign is physics.
            low = p.low if not p.dimension or "time" in p.dimension else (0.0 if p.low >= 0 else float("-inf"))
            high = p.high if not p.dimension or "time" in p.dimension else float("inf")
            suffix = "" if len(self.parameters) == 1 else f"_{p.name}"
            return Parameter(f"{prefix}_{site}{suffix}", p.off, p.unit(units), low=low, high=high)

        return tuple(map(one, self.parameters))


def site_units(model: Model, kind: SiteKind, site: str) -> dict[str, str]:
    """Units of force, velocity, position and input at a site.

    At a coordinate q the force is energy per q; at a state equation ẋ = f the `force` adds to f and the `velocity` is x.
    """
    if site not in model.sites(kind):
        raise UsageError(f"effect: '{site}' is no {kind} of the model; there are {', '.join(model.sites(kind)) or 'none'}")
    specs = {s.name: s.unit for s in (*model.states, *model.inputs, *model.outputs)}
    if kind == "input":
        return {"input": specs[site]}
    if kind != "coordinate":
        return {}
    unit = specs[site]
    if f"{site}_dot" in specs:
        force = {"rad": "N*m", "m": "N"}.get(unit, f"J/({unit})")
        return {"position": unit, "velocity": f"{unit}/s", "force": force}
    return {"position": unit, "velocity": unit, "force": f"({unit})/s"}


@final
@dataclass(frozen=True)
class Estimate:
    """A fitted number and its 95 % interval."""

    value: float
    unit: str
    low: float
    high: float


@final
@dataclass(frozen=True)
class Rival:
    """What else was tried in place of a cause, and how much it explained."""

    effect: str
    site: str
    explained: float


@final
@dataclass(frozen=True)
class Cause:
    """An effect that was named: parameters with intervals and the share of the held-out rollout error that it explains.

    explained = 1 − E_after/E_before with all other named causes kept. native: the engine's own name, for engine models.
    """

    effect: str
    site: str
    parameters: Mapping[str, Estimate]
    explained: float
    runner_up: Rival | None = None
    native: str | None = None


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
    """A single force at `site` that no law in the library makes: its time, its sign and its impulse."""

    t: float
    site: str
    sign: int
    size: float


@final
@dataclass(frozen=True)
class Unexplained:
    """What is left: does it need memory (a law of the present state and input cannot make it), and single events."""

    needs_memory: bool
    events: tuple[Push, ...] = ()


@final
@dataclass(frozen=True)
class Diagnosis:
    """Ranked causes with evidence and rivals, what they bought on held-out data, and the model extended by them.

    ambiguous_with: other sets of (effect, site) that explain these data as well; gain: horizon in s as text → channel → Gain.
    """

    verdict: Verdict
    causes: tuple[Cause, ...]
    residual: Mapping[str, Misfit]
    gain: Mapping[str, Mapping[str, Gain]]
    extended_model: Model
    ambiguous_with: tuple[tuple[tuple[str, str], ...], ...] = ()
    experiment: str | None = None
    unexplained: Unexplained | None = None
    figure: DiagnosisFigure | None = None
    timings: Mapping[str, float] = field(default_factory=dict)

    def summary(self) -> dict[str, Any]:
        """As plain data; keys that do not apply are absent."""
        out: dict[str, Any] = {"verdict": self.verdict, "causes": [_cause(c) for c in self.causes]}
        if self.ambiguous_with:
            out["ambiguous_with"] = [[{"effect": e, "site": s} for e, s in group] for group in self.ambiguous_with]
        if self.experiment:
            out["experiment"] = self.experiment
        out["residual"] = {n: vars(m).copy() for n, m in self.residual.items()}
        out["gain"] = {h: {n: vars(g).copy() for n, g in channels.items()} for h, channels in self.gain.items()}
        if self.unexplained is not None:
            events = [vars(e).copy() for e in self.unexplained.events]
            out["unexplained"] = {"needs_memory": self.unexplained.needs_memory, "events": events}
        out["timings"] = dict(self.timings)
        return out


def _cause(cause: Cause) -> dict[str, Any]:
    out: dict[str, Any] = {"effect": cause.effect, "site": cause.site}
    if cause.native is not None:
        out["native"] = cause.native
    out["parameters"] = {n: vars(p).copy() for n, p in cause.parameters.items()}
    out["explained"] = cause.explained
    if cause.runner_up is not None:
        out["runner_up"] = vars(cause.runner_up).copy()
    return out
