"""Friction: laws of the speed, dry and wet, with a bound that holds at rest where they are dry."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import ClassVar, final

import gapcert as gc

from .shared.experiments import BOTH_WAYS, CREEP, FREE_DECAY, LOADS, REST, VARY_SPEED
from .shared.sites import driven, spread

INFINITY = float("inf")
COEFFICIENT = {"force": 1, "velocity": -1}


def _wet(name: str, dimension: Mapping[str, int] = COEFFICIENT) -> gc.plugin.EffectParameter:
    """May be negative, where the stated damping is too strong; that is flagged."""
    return gc.plugin.EffectParameter(name, dimension, (0.03, 0.3), -30.0, 30.0, plausible=(0.0, INFINITY))


def _dry(name: str) -> gc.plugin.EffectParameter:
    return gc.plugin.EffectParameter(name, {"force": 1}, (0.03, 0.3), 0.0, 3.0)


def _sides(high: float, low: float, count: int, scale: float) -> list[tuple[float, ...]]:
    """Levels with both sides alike, and with either one at 0.4 of the other."""
    sides = ((1.0, 1.0), (1.0, 0.4), (0.4, 1.0))
    return [(a * level * scale, b * level * scale) for level, (a, b) in itertools.product(spread(low, high, count), sides)]


@final
class ViscousFriction(gc.plugin.Effect):
    """f = −c·v."""

    name = "viscous-friction"
    site = "coordinate"
    parameters = (_wet("coefficient"),)
    sentence = "a force against the motion, proportional to speed"
    equation = "f = −coefficient·v"
    signature = "swings lose a constant share of their amplitude per period"
    experiment = VARY_SPEED
    amplitude = "coefficient"
    family = "viscous"
    rivals: ClassVar = {
        "quadratic-drag": VARY_SPEED,
        "coulomb-friction": VARY_SPEED,
        "asymmetric-viscous-friction": BOTH_WAYS,
        "constant-force": BOTH_WAYS,
    }

    def extension(self, site: str, model: gc.Model) -> gc.plugin.Extension:
        (c,) = self.named(site, model)
        return gc.plugin.Extension(self.name, site, (c,), force=f"-{c.name}*{{v}}")


@final
class AsymmetricViscousFriction(gc.plugin.Effect):
    """f = −c₊·v forwards, −c₋·v backwards."""

    name = "asymmetric-viscous-friction"
    site = "coordinate"
    parameters = (_wet("plus"), _wet("minus"))
    sentence = "a force against the motion, proportional to speed, with a factor for each direction"
    equation = "f = −plus·v if v > 0, else −minus·v"
    signature = "swings lose a constant share of their amplitude, more in one direction than in the other"
    experiment = BOTH_WAYS
    family = "viscous"
    contains: ClassVar = {"viscous-friction": {"plus": "coefficient", "minus": "coefficient"}}
    rivals: ClassVar = {
        "viscous-friction": BOTH_WAYS,
        "quadratic-drag": VARY_SPEED,
        "asymmetric-coulomb-friction": VARY_SPEED,
        "constant-force": VARY_SPEED,
    }

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return _sides(1.5, 0.02, 6, self.parameters[0].scale(scales))

    def extension(self, site: str, model: gc.Model) -> gc.plugin.Extension:
        plus, minus = (p.name for p in self.named(site, model))
        force = f"-{plus}*max({{v}}, 0) - {minus}*min({{v}}, 0)"
        return gc.plugin.Extension(self.name, site, self.named(site, model), force=force)


@final
class QuadraticDrag(gc.plugin.Effect):
    """f = −c·v·|v|."""

    name = "quadratic-drag"
    site = "coordinate"
    parameters = (_wet("coefficient", {"force": 1, "velocity": -2}),)
    sentence = "a force against the motion, proportional to speed squared"
    equation = "f = −coefficient·v·|v|"
    signature = "large swings are damped strongly, small ones hardly"
    experiment = VARY_SPEED
    amplitude = "coefficient"
    family = "drag"
    rivals: ClassVar = {
        "viscous-friction": VARY_SPEED,
        "asymmetric-viscous-friction": VARY_SPEED,
        "coulomb-friction": VARY_SPEED,
        "constant-force": BOTH_WAYS,
    }

    def extension(self, site: str, model: gc.Model) -> gc.plugin.Extension:
        (c,) = self.named(site, model)
        return gc.plugin.Extension(self.name, site, (c,), force=f"-{c.name}*{{v}}*abs({{v}})")


@final
class CoulombFriction(gc.plugin.Effect):
    """f = −F·sgn(v) in motion; |f| ≤ F at rest."""

    name = "coulomb-friction"
    site = "coordinate"
    parameters = (_dry("level"),)
    sentence = "dry friction: constant against the motion, and sticking at rest"
    equation = "f = −level·sgn(v); |f| ≤ level at rest"
    signature = "amplitudes fall by equal steps, and motion ends in rest away from equilibrium"
    experiment = REST
    amplitude = "level"
    family = "dry"
    rivals: ClassVar = {
        "viscous-friction": VARY_SPEED,
        "quadratic-drag": VARY_SPEED,
        "asymmetric-coulomb-friction": BOTH_WAYS,
        "stribeck-friction": REST,
        "dahl-friction": CREEP,
        "load-dependent-friction": LOADS,
        "constant-force": BOTH_WAYS,
    }

    def extension(self, site: str, model: gc.Model) -> gc.plugin.Extension:
        (level,) = self.named(site, model)
        return gc.plugin.Extension(self.name, site, (level,), dry_friction=level.name)


@final
class AsymmetricCoulombFriction(gc.plugin.Effect):
    """f = −F₊ forwards, F₋ backwards; −F₊ ≤ f ≤ F₋ at rest: a symmetric law and a constant force."""

    name = "asymmetric-coulomb-friction"
    site = "coordinate"
    parameters = (_dry("plus"), _dry("minus"))
    sentence = "dry friction that is stronger in one direction than in the other"
    equation = "f = −plus if v > 0, minus if v < 0; −plus ≤ f ≤ minus at rest"
    signature = "amplitudes fall by steps that differ between the directions"
    experiment = BOTH_WAYS
    family = "dry"
    contains: ClassVar = {"coulomb-friction": {"plus": "level", "minus": "level"}}
    rivals: ClassVar = {
        "coulomb-friction": BOTH_WAYS,
        "constant-force": BOTH_WAYS,
        "asymmetric-viscous-friction": VARY_SPEED,
    }

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return _sides(1.0, 0.02, 6, self.parameters[0].scale(scales))

    def extension(self, site: str, model: gc.Model) -> gc.plugin.Extension:
        plus, minus = (p.name for p in self.named(site, model))
        level, offset = f"({plus} + {minus})/2", f"({minus} - {plus})/2"
        return gc.plugin.Extension(self.name, site, self.named(site, model), force=offset, dry_friction=level)


@final
class StribeckFriction(gc.plugin.Effect):
    """|f| ≤ F·(1 + ρ·exp(−(v/v_s)²)), with equality in motion. (Armstrong-Hélouvry et al., Automatica 30, 1994)"""

    name = "stribeck-friction"
    site = "coordinate"
    parameters = (
        _dry("level"),
        gc.plugin.EffectParameter("ratio", {}, (0.2, 0.8), 0.0, 10.0, plausible=(0.0, 3.0)),
        gc.plugin.EffectParameter("velocity", {"velocity": 1}, (0.05, 0.3), 0.003, 3.0, off=1.0),
    )
    sentence = "dry friction that is stronger near rest, and falls to its level at higher speed"
    equation = "|f| = level·(1 + ratio·exp(−(v/velocity)²)) against the motion"
    signature = "motion stops and starts in jerks at low speed"
    experiment = REST
    amplitude = "level"
    family = "dry"
    contains: ClassVar = {"coulomb-friction": {"level": "level"}}
    rivals: ClassVar = {"coulomb-friction": REST, "lugre-friction": CREEP, "viscous-friction": VARY_SPEED}

    def extension(self, site: str, model: gc.Model) -> gc.plugin.Extension:
        level, ratio, velocity = (p.name for p in self.named(site, model))
        bound = f"{level}*(1 + {ratio}*exp(-({{v}}/{velocity})**2))"
        return gc.plugin.Extension(self.name, site, self.named(site, model), dry_friction=bound)


@final
class LoadDependentFriction(gc.plugin.Effect):
    """|f| ≤ μ·|force applied at the coordinate|, with equality in motion: losses of a gear."""

    name = "load-dependent-friction"
    site = "coordinate"
    parameters = (gc.plugin.EffectParameter("coefficient", {}, (0.05, 0.2), 0.0, 2.0, plausible=(0.0, 0.9)),)
    sentence = "dry friction in proportion to the force that the drive transmits"
    equation = "|f| = coefficient·|applied force| against the motion"
    signature = "the drive is weaker when it pushes and stronger when it brakes; without input there is no loss"
    experiment = LOADS
    amplitude = "coefficient"
    family = "load"
    stage = 3
    rivals: ClassVar = {"coulomb-friction": LOADS, "viscous-friction": FREE_DECAY, "input-gain": BOTH_WAYS}

    def applies(self, site: str, model: gc.Model) -> bool:
        return driven(site, model)

    def extension(self, site: str, model: gc.Model) -> gc.plugin.Extension:
        (mu,) = self.named(site, model)
        return gc.plugin.Extension(self.name, site, (mu,), dry_friction=f"{mu.name}*abs({{f}})")
