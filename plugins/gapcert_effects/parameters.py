"""Effects that are a number and no text: a parameter of the model, or of the contacts of its physics engine."""

from __future__ import annotations

from typing import ClassVar, NoReturn, final

import gapcert as gc
from gapcert.plugin import EffectParameter, Extension

from .experiments import DROP, FREE_DECAY, SHAKE_AND_HOLD, SLIDE
from .law import Law


@final
class Parameter(Law):
    """p = value, with the tolerance lifted. A parameter without a tolerance is exact, unless the model doubts it."""

    name = "parameter"
    site = "parameter"
    parameters = (EffectParameter("value", {"value": 1}, (0.7, 1.4), 0.02, 50.0, off=1.0, plausible=(0.5, 2.0)),)
    equation = "parameter = value instead of the stated one"
    signature = "the misfit has the shape of what this parameter does in the model"
    experiment = SHAKE_AND_HOLD
    family = "parameter"
    equivalent: ClassVar = {
        "input-gain": "where only one mass resists the input",
        "payload": "along a level line, where the model has one mass",
    }
    rivals: ClassVar = {"input-gain": FREE_DECAY, "payload": SHAKE_AND_HOLD, "linear-spring": SHAKE_AND_HOLD}

    def applies(self, site: str, model: gc.Model) -> bool:
        return site in model.doubts or any(p.name == site and p.tolerance > 0 for p in model.parameters)

    def extension(self, site: str, model: gc.Model) -> Extension:
        return Extension(self.name, site, (), frees=site)


class _Contact(Law):
    """An effect that only an engine's native parameters can say."""

    site = "contact"

    def extension(self, site: str, model: gc.Model) -> NoReturn:
        raise gc.UsageError(f"{self.name}: equations have no contacts; expected a physics engine as the model, kind: engine")


@final
class ContactFriction(_Contact):
    """|tangential force| ≤ μ · normal force between bodies that touch."""

    name = "contact-friction"
    parameters = (EffectParameter("mu", {}, (0.1, 0.5, 2.0), 0.0, 10.0, off=1.0, plausible=(0.0, 2.0)),)
    equation = "|tangential force| <= mu * normal force"
    signature = "what slides stops too soon or too late, and what lands starts to turn too much or too little"
    experiment = SLIDE
    family = "contact"
    rivals: ClassVar = {"contact-restitution": DROP}


@final
class ContactRestitution(_Contact):
    """Speed after an impact = coefficient · speed before it; engines with springs in contacts say it by their damping."""

    name = "contact-restitution"
    parameters = (EffectParameter("coefficient", {}, (0.1, 0.3, 0.6), 0.0, 1.0, plausible=(0.0, 1.0)),)
    equation = "normal speed after an impact = coefficient * normal speed before it"
    signature = "after an impact the motion is too lively or too dull, in flight it is right"
    experiment = DROP
    family = "contact"
    rivals: ClassVar = {"contact-friction": SLIDE}
