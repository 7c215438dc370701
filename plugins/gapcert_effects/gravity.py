"""Forces that never change, and what gravity does to a tilted or loaded machine."""

from __future__ import annotations

from typing import ClassVar, final

import gapcert as gc

from .shared.experiments import BOTH_WAYS, FREE_DECAY, LEVELS, PLACES, SHAKE_AND_HOLD
from .shared.sites import mechanical, points, straight, turning, weighs


@final
class ConstantForce(gc.plugin.Effect):
    """f = F."""

    name = "constant-force"
    site = "coordinate"
    parameters = (gc.plugin.EffectParameter("force", {"force": 1}, (-0.1, 0.1), -3.0, 3.0),)
    sentence = "a force that never changes"
    equation = "f = force"
    signature = "equilibria are shifted, whatever the direction of motion"
    experiment = BOTH_WAYS
    amplitude = "force"
    family = "constant"
    equivalent: ClassVar = {
        "input-offset": "where one input is the force at one coordinate",
        "gravity-tilt": "at a coordinate that moves along a line, and carries nothing that swings",
    }
    rivals: ClassVar = {
        "viscous-friction": BOTH_WAYS,
        "coulomb-friction": BOTH_WAYS,
        "asymmetric-coulomb-friction": BOTH_WAYS,
        "quadratic-drag": BOTH_WAYS,
        "gravity-tilt": FREE_DECAY,
        "input-gain": LEVELS,
        "sensor-bias": PLACES,
    }

    def extension(self, site: str, model: gc.Model) -> gc.plugin.Extension:
        (f,) = self.named(site, model)
        return gc.plugin.Extension(self.name, site, (f,), force=f.name)


@final
class GravityTilt(gc.plugin.Effect):
    """Gravity turned by φ: what rests on q feels q − φ; along a line all masses feel 9.80665·sin φ."""

    name = "gravity-tilt"
    site = "coordinate"
    parameters = (gc.plugin.EffectParameter("angle", {"angle": 1}, (-0.1, 0.1), -0.8, 0.8, plausible=(-0.3, 0.3)),)
    sentence = "a base that does not stand level"
    equation = "weight(q − angle) instead of weight(q); along a line + mass·9.80665·sin(angle)"
    signature = "the equilibrium is turned, and swings about it are not"
    experiment = FREE_DECAY
    amplitude = "angle"
    family = "tilt"
    equivalent: ClassVar = {
        "sensor-bias": "at an angle that only gravity pulls back",
        "constant-force": "at a coordinate that moves along a line, and carries nothing that swings",
    }
    rivals: ClassVar = {"constant-force": FREE_DECAY, "sensor-bias": PLACES, "linear-spring": PLACES}

    def applies(self, site: str, model: gc.Model) -> bool:
        return mechanical(model) and (straight(site, model) or (turning(site, model) and weighs(site, model)))

    def extension(self, site: str, model: gc.Model) -> gc.plugin.Extension:
        (angle,) = self.named(site, model)
        return gc.plugin.Extension(self.name, site, (angle,), tilt=angle.name)


@final
class Payload(gc.plugin.Effect):
    """A point mass at the coordinate's point p(q): M + m·JᵀJ, its weight and its centrifugal force, with J = ∂p/∂q."""

    name = "payload"
    site = "coordinate"
    parameters = (gc.plugin.EffectParameter("mass", {"mass": 1}, (0.03, 0.2, 0.6), 0.0, 10.0),)
    sentence = "a mass that is carried at a point, and that the model does not know"
    equation = "M + mass·JᵀJ, force + mass·Jᵀ·(gravity − J̇·v), J = ∂point/∂q"
    signature = "it is slower and heavier, by an inertia and a weight that belong together"
    experiment = SHAKE_AND_HOLD
    family = "payload"
    equivalent: ClassVar = {"parameter": "along a level line, where the model has one mass"}
    rivals: ClassVar = {"parameter": SHAKE_AND_HOLD, "input-gain": FREE_DECAY, "linear-spring": SHAKE_AND_HOLD}

    def applies(self, site: str, model: gc.Model) -> bool:
        return site in points(model)

    def extension(self, site: str, model: gc.Model) -> gc.plugin.Extension:
        (mass,) = self.named(site, model)
        return gc.plugin.Extension(self.name, site, (mass,), payload=mass.name)
