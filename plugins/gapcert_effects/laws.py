"""The first laws: three frictions, a constant force, and two faults of an input."""

from __future__ import annotations

from typing import ClassVar, final

import gapcert as gc

VARY_SPEED = (
    "let the coordinate move over a wide range of speeds, from near rest to its fastest: the laws differ in the exponent"
)
REST = "start and stop often, and creep through zero speed: only dry friction keeps its size there"
BOTH_WAYS = "move in both directions: friction turns its sign with the velocity, a constant force does not"
LEVELS = "hold several input levels, zero included: only a wrong gain grows with the input"


@final
class ViscousFriction(gc.Effect):
    """f = −c·v."""

    name = "viscous-friction"
    site = "coordinate"
    parameters = (gc.EffectParameter("coefficient", {"force": 1, "velocity": -1}, (0.03, 0.3), 0.0, 30.0),)
    sentence = "a force against the motion, proportional to speed"
    signature = "swings lose a constant share of their amplitude per period"
    experiment = VARY_SPEED
    rivals: ClassVar = {"quadratic-drag": VARY_SPEED, "coulomb-friction": VARY_SPEED, "constant-force": BOTH_WAYS}

    def extension(self, site: str, model: gc.Model) -> gc.Extension:
        (c,) = self.named(site, model)
        return gc.Extension(self.name, site, (c,), force=f"-{c.name}*{{v}}")


@final
class CoulombFriction(gc.Effect):
    """f = −F·sgn(v) in motion; |f| ≤ F at rest."""

    name = "coulomb-friction"
    site = "coordinate"
    parameters = (gc.EffectParameter("level", {"force": 1}, (0.03, 0.3), 0.0, 3.0),)
    sentence = "dry friction: constant against the motion, and sticking at rest"
    signature = "amplitudes fall by equal steps, and motion ends in rest away from equilibrium"
    experiment = REST
    rivals: ClassVar = {"viscous-friction": VARY_SPEED, "quadratic-drag": VARY_SPEED, "constant-force": BOTH_WAYS}

    def extension(self, site: str, model: gc.Model) -> gc.Extension:
        (level,) = self.named(site, model)
        return gc.Extension(self.name, site, (level,), dry_friction=level.name)


@final
class QuadraticDrag(gc.Effect):
    """f = −c·v·|v|."""

    name = "quadratic-drag"
    site = "coordinate"
    parameters = (gc.EffectParameter("coefficient", {"force": 1, "velocity": -2}, (0.03, 0.3), 0.0, 30.0),)
    sentence = "a force against the motion, proportional to speed squared"
    signature = "large swings are damped strongly, small ones hardly"
    experiment = VARY_SPEED
    rivals: ClassVar = {"viscous-friction": VARY_SPEED, "coulomb-friction": VARY_SPEED, "constant-force": BOTH_WAYS}

    def extension(self, site: str, model: gc.Model) -> gc.Extension:
        (c,) = self.named(site, model)
        return gc.Extension(self.name, site, (c,), force=f"-{c.name}*{{v}}*abs({{v}})")


@final
class ConstantForce(gc.Effect):
    """f = F."""

    name = "constant-force"
    site = "coordinate"
    parameters = (gc.EffectParameter("force", {"force": 1}, (-0.1, 0.1), -3.0, 3.0),)
    sentence = "a force that never changes"
    signature = "equilibria are shifted, whatever the direction of motion"
    experiment = BOTH_WAYS
    rivals: ClassVar = {
        "viscous-friction": BOTH_WAYS,
        "coulomb-friction": BOTH_WAYS,
        "quadratic-drag": BOTH_WAYS,
        "input-gain": LEVELS,
    }

    def extension(self, site: str, model: gc.Model) -> gc.Extension:
        (f,) = self.named(site, model)
        return gc.Extension(self.name, site, (f,), force=f.name)


@final
class InputGain(gc.Effect):
    """u acts as g·u."""

    name = "input-gain"
    site = "input"
    parameters = (gc.EffectParameter("gain", {}, (0.8, 1.25), -5.0, 5.0, off=1.0),)
    sentence = "an input that acts stronger or weaker than it says"
    signature = "the response to every input level is wrong by the same factor"
    experiment = LEVELS
    rivals: ClassVar = {"constant-force": LEVELS}

    def extension(self, site: str, model: gc.Model) -> gc.Extension:
        (gain,) = self.named(site, model)
        return gc.Extension(self.name, site, (gain,), input=f"{gain.name}*{{u}}")


@final
class InputDelay(gc.Effect):
    """u acts T seconds late."""

    name = "input-delay"
    site = "input"
    parameters = (gc.EffectParameter("delay", {"time": 1}, (0.003, 0.02, 0.05), 0.0, 0.1),)
    sentence = "an input that acts late"
    signature = "the response to fast inputs lags, the response to slow ones is right"
    experiment = "play fast inputs, steps or a chirp up to the bandwidth: the phase falls in proportion to the frequency"

    def extension(self, site: str, model: gc.Model) -> gc.Extension:
        (delay,) = self.named(site, model)
        return gc.Extension(self.name, site, (delay,), delay=delay.name)
