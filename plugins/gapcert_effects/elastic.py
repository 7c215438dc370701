"""Springs and couplings: forces that depend on where the coordinate is, or on how another one moves."""

from __future__ import annotations

from typing import ClassVar, final

import gapcert as gc

from .shared.experiments import BOTH_WAYS, FREE_DECAY, PLACES, SHAKE_AND_HOLD, VARY_SPEED
from .shared.law import Law
from .shared.sites import neighbour, placed


@final
class LinearSpring(Law):
    """f = −k·q."""

    name = "linear-spring"
    site = "coordinate"
    parameters = (
        gc.plugin.EffectParameter(
            "stiffness", {"force": 1, "position": -1}, (0.03, 0.3), -30.0, 30.0, plausible=(0.0, float("inf"))
        ),
    )
    equation = "f = −stiffness·q"
    adds: ClassVar = {"force": "-{stiffness}*{q}"}
    where = (placed,)
    signature = "the frequency of oscillations is wrong, and more force is needed the farther out it is held"
    experiment = PLACES
    amplitude = "stiffness"
    family = "spring"
    rivals: ClassVar = {"cubic-spring": PLACES, "constant-force": PLACES, "parameter": SHAKE_AND_HOLD, "gravity-tilt": PLACES}


@final
class CubicSpring(Law):
    """f = −k·q³: hardening for k > 0, softening for k < 0."""

    name = "cubic-spring"
    site = "coordinate"
    parameters = (gc.plugin.EffectParameter("stiffness", {"force": 1, "position": -3}, (0.03, 0.3), -30.0, 30.0),)
    equation = "f = −stiffness·q³"
    adds: ClassVar = {"force": "-{stiffness}*{q}**3"}
    where = (placed,)
    signature = "the frequency of oscillations changes with their amplitude"
    experiment = PLACES
    amplitude = "stiffness"
    family = "cubic"
    rivals: ClassVar = {"linear-spring": PLACES, "quadratic-drag": PLACES, "cogging": PLACES}


@final
class JointCoupling(Law):
    """f = −c·v_other: what moves the neighbouring coordinate also drags at this one."""

    name = "joint-coupling"
    site = "coordinate"
    parameters = (gc.plugin.EffectParameter("coefficient", {"force": 1, "velocity": -1}, (-0.1, 0.1), -30.0, 30.0),)
    equation = "f = −coefficient·v of the next coordinate of the same unit (of the one before, at the last)"
    signature = "the coordinate is pushed when its neighbour moves, whatever it does itself"
    experiment = "move the neighbouring coordinate alone, fast and slowly, while this one is held by its drive"
    where = (neighbour,)
    amplitude = "coefficient"
    family = "coupling"
    rivals: ClassVar = {"viscous-friction": VARY_SPEED, "parameter": FREE_DECAY, "constant-force": BOTH_WAYS}

    def extension(self, site: str, model: gc.Model) -> gc.plugin.Extension:
        (c,) = self.named(site, model)
        return gc.plugin.Extension(self.name, site, (c,), force=f"-{c.name}*{neighbour(site, model)}_dot")
