"""Physical causes with names, and the sites where they act."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal, final

import numpy as np

from gapcert.contracts.data.units import grouped, product
from gapcert.contracts.systems.system import Extension, Model, Parameter
from gapcert.numerics.arrays import Array
from gapcert.numerics.errors import UsageError

SiteKind = Literal["coordinate", "input", "output", "parameter", "contact"]


@final
@dataclass(frozen=True)
class EffectParameter:
    """One number of an effect, in powers of what a site is measured in.

    `dimension` maps force, velocity, position, input, output (the root mean square at the site), input_rate, each with `_peak`,
    position_range, time, period (of sampling), angle, mass and value (of a parameter) to exponents (empty: a pure number). It
    gives the unit at a site and, from the data there, the scale; `starts`, `low` and `high` are multiples of that scale (of
    1 s, 1 rad and 1 for times, angles and pure numbers). At `off`, in its unit, the effect does nothing; it may lie beyond the
    bounds. plausible: values in the same multiples outside which a fit is flagged. step: of differences, likewise; 0: from the
    starts. longest: of a time, as a share of the duration of the data.
    """

    name: str
    dimension: Mapping[str, int]
    starts: tuple[float, ...]
    low: float
    high: float
    off: float = 0.0
    plausible: tuple[float, float] = (float("-inf"), float("inf"))
    step: float = 0.0
    longest: float = float("inf")

    def unit(self, site: Mapping[str, str]) -> str:
        """From the units of force, velocity, position and input at a site."""
        known = {**site, "time": "s", "period": "s", "angle": "rad", "mass": "kg"}
        return product((known[k.partition("_")[0]], n) for k, n in self.dimension.items())

    def scale(self, site: Mapping[str, float]) -> float:
        """From the root mean squares of force, velocity, position and input at a site."""
        return float(np.prod([{**site, "time": 1.0, "angle": 1.0}[k] ** n for k, n in self.dimension.items()]))

    def bounds(self, site: Mapping[str, float]) -> tuple[float, float]:
        """(low, high) in its unit, from the same."""
        scale = self.scale(site)
        return self.low * scale, min(self.high * scale, self.longest * site.get("duration", float("inf")))


class Effect(ABC):
    """One physical cause, written as equations at a site. Subclasses set the attributes and implement `extension`.

    name: kebab-case, a contract; site: the kind of site; sentence: what it is; equation: its law in one line; signature:
    how data show it; rivals: name of a similar effect → the experiment that tells the two apart; experiment: what makes
    this effect visible at all. amplitude: the parameter in which the effect is linear, None where there is none (a delay, a
    limit); family: effects of one family look alike, and screening lets the best of each family through; contains: name of
    a simpler effect → how its parameters become mine, {my parameter: its parameter} (mine that are not mentioned keep their
    start; {}: it comes near the simpler one in all its forms); equivalent: name of an effect that is the same on some
    excitation → which; stage: the order along an input's path, small ones nearer to the command; variants: other forms of
    the same cause, with numbers of their own, that are tried beside it; variant_of: under whose name such a form is
    reported.
    """

    name: str
    site: SiteKind
    parameters: tuple[EffectParameter, ...]
    sentence: str
    signature: str
    experiment: str
    equation: str = ""
    rivals: ClassVar[Mapping[str, str]] = {}
    amplitude: str | None = None
    family: str = ""
    contains: ClassVar[Mapping[str, Mapping[str, str]]] = {}
    equivalent: ClassVar[Mapping[str, str]] = {}
    stage: int = 0
    variants: ClassVar[tuple[type[Effect], ...]] = ()
    variant_of: str = ""

    def applies(self, site: str, model: Model) -> bool:
        """Can it act at this site of this model? Sites where it cannot are left out of a search."""
        return True

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        """Values of all parameters, in their units, from which a search starts.

        scales: root mean squares of force, velocity, position, input and output at the site, the mean `input_rate` per s, their
        `…_peak`s, `position_range`, `input_low` and `input_high`, and in s the `period` of sampling and the `start` and
        `duration` of the data.
        """
        return list(itertools.product(*([s * p.scale(scales) for s in p.starts] for p in self.parameters)))

    def suggested(self, place: Array, force: Array) -> list[tuple[float, ...]]:
        """More first values, in their units, that a force (n,) left over at places (n,) of a coordinate suggests."""
        return []

    def scaled(self, scales: Mapping[str, float]) -> Effect:
        """With what it takes from the data at a site, such as the knots of a curve; `scales` as for `grid`."""
        return self

    def canonical(self, values: Mapping[str, float]) -> dict[str, float]:
        """The same effect in the numbers that a report shows, where several sets of numbers mean the same."""
        return dict(values)

    def seen_in(self, values: Array) -> dict[str, float] | None:
        """Its parameters, read off the measured values (T,) of an output alone, for an effect whose trace no fit can follow."""
        return None

    @abstractmethod
    def extension(self, site: str, model: Model) -> Extension:
        """What `model.extend` adds, with every parameter at its `off` value."""

    @final
    def named(self, site: str, model: Model) -> tuple[Parameter, ...]:
        """The parameters at one site, with names that are unique in the model, units, and value `off`."""
        if self.site == "parameter":
            return tuple(p for p in model.parameters if p.name == site)
        units = site_units(model, self.site, site)
        taken = {p.name for p in model.parameters}
        # A model that an earlier diagnosis extended has the effect at this site: what is added to it has a name of its own.
        stems = (f"{self.name.replace('-', '_')}_{site}{'' if k == 1 else f'_{k}'}" for k in itertools.count(1))
        suffixes = {p.name: "" if len(self.parameters) == 1 else f"_{p.name}" for p in self.parameters}
        stem = next(s for s in stems if taken.isdisjoint(s + suffix for suffix in suffixes.values()))

        def one(p: EffectParameter) -> Parameter:
            # Bounds in units of the data are the fit's affair; only a sign is physics.
            absolute = set(p.dimension) <= {"time", "angle"}
            low, high = (p.low, p.high) if absolute else (0.0 if p.low >= 0 else float("-inf"), float("inf"))
            return Parameter(stem + suffixes[p.name], p.off, p.unit(units), low=low, high=high)

        return tuple(map(one, self.parameters))


def site_units(model: Model, kind: SiteKind, site: str) -> dict[str, str]:
    """Units of force, velocity, position and input at a site.

    At a coordinate q the force is energy per q; at a state equation ẋ = f the `force` adds to f and the `velocity` is x.
    """
    if site not in model.sites(kind):
        raise UsageError(f"effect: '{site}' is no {kind} of the model; there are {', '.join(model.sites(kind)) or 'none'}")
    specs = {s.name: s.unit for s in (*model.states, *model.inputs, *model.outputs)}
    if kind in ("input", "output"):
        return {kind: specs[site]}
    if kind != "coordinate":
        return {}
    unit = specs[site]
    if f"{site}_dot" in specs:
        force = model.force_unit(site) or {"rad": "N*m", "m": "N"}.get(unit) or f"J/{grouped(unit)}"
        return {"position": unit, "velocity": f"{unit}/s", "force": force}
    place = position(model, site)
    return {"position": specs[place] if place else f"{grouped(unit)}*s", "velocity": unit, "force": f"{grouped(unit)}/s"}


def position(model: Model, site: str) -> str | None:
    """The state that is a coordinate's position: the coordinate, or the state whose equation is the site's state alone."""
    if any(s.name == f"{site}_dot" for s in model.states):
        return site
    rates = model.text().get("derivative") or {}
    return next((name for name, text in rates.items() if str(text).strip() == site), None)
