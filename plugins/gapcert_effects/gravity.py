"""Forces that never change, and what gravity does to a tilted or loaded machine."""

from __future__ import annotations

from typing import ClassVar, final

import gapcert as gc

from .shared.experiments import BOTH_WAYS, FREE_DECAY, LEVELS, PLACES, SHAKE_AND_HOLD
from .shared.law import Law
from .shared.sites import carries, tilts


@final
class ConstantForce(Law):
    """f = F."""

    name = "constant-force"
    site = "coordinate"
    parameters = (gc.plugin.EffectParameter("force", {"force": 1}, (-0.1, 0.1), -3.0, 3.0),)
    equation = "f = force"
    adds: ClassVar = {"force": "{force}"}
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


@final
class GravityTilt(Law):
    """Gravity turned by φ: what rests on q feels q − φ; along a line all masses feel 9.80665·sin φ."""

    name = "gravity-tilt"
    site = "coordinate"
    parameters = (gc.plugin.EffectParameter("angle", {"angle": 1}, (-0.1, 0.1), -0.8, 0.8, plausible=(-0.3, 0.3)),)
    equation = "weight(q − angle) instead of weight(q); along a line + mass·9.80665·sin(angle)"
    adds: ClassVar = {"tilt": "{angle}"}
    where = (tilts,)
    signature = "the equilibrium is turned, and swings about it are not"
    experiment = FREE_DECAY
    amplitude = "angle"
    family = "tilt"
    equivalent: ClassVar = {
        "sensor-bias": "at an angle that only gravity pulls back",
        "constant-force": "at a coordinate that moves along a line, and carries nothing that swings",
    }
    rivals: ClassVar = {"constant-force": FREE_DECAY, "sensor-bias": PLACES, "linear-spring": PLACES}


@final
class Payload(Law):
    """A point mass at the coordinate's point p(q): M + m·JᵀJ, its weight and its centrifugal force, with J = ∂p/∂q."""

    name = "payload"
    site = "coordinate"
    parameters = (gc.plugin.EffectParameter("mass", {"mass": 1}, (0.03, 0.2, 0.6), 0.0, 10.0),)
    equation = "M + mass·JᵀJ, force + mass·Jᵀ·(gravity − J̇·v), J = ∂point/∂q"
    adds: ClassVar = {"payload": "{mass}"}
    where = (carries,)
    signature = "it is slower and heavier, by an inertia and a weight that belong together"
    experiment = SHAKE_AND_HOLD
    family = "payload"
    equivalent: ClassVar = {"parameter": "along a level line, where the model has one mass"}
    rivals: ClassVar = {"parameter": SHAKE_AND_HOLD, "input-gain": FREE_DECAY, "linear-spring": SHAKE_AND_HOLD}
