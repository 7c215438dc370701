"""What happens where bodies touch: a physics engine realises it by parameters of its own, so that no equation stands here."""

from __future__ import annotations

from typing import ClassVar, NoReturn, final

import gapcert as gc

from .shared.experiments import DROP, SLIDE
from .shared.law import Law


class _Contact(Law):
    """An effect that only an engine's native parameters can say."""

    site = "contact"

    def extension(self, site: str, model: gc.Model) -> NoReturn:
        raise gc.UsageError(f"{self.name}: equations have no contacts; expected a physics engine as the model, kind: engine")


@final
class ContactFriction(_Contact):
    """|tangential force| ≤ μ · normal force between bodies that touch."""

    name = "contact-friction"
    parameters = (gc.plugin.EffectParameter("mu", {}, (0.1, 0.5, 2.0), 0.0, 10.0, off=1.0, plausible=(0.0, 2.0)),)
    equation = "|tangential force| <= mu * normal force"
    signature = "what slides stops too soon or too late, and what lands starts to turn too much or too little"
    experiment = SLIDE
    family = "contact"
    rivals: ClassVar = {"contact-restitution": DROP}


@final
class ContactRestitution(_Contact):
    """Speed after an impact = coefficient · speed before it; engines with springs in contacts say it by their damping."""

    name = "contact-restitution"
    parameters = (gc.plugin.EffectParameter("coefficient", {}, (0.1, 0.3, 0.6), 0.0, 1.0, plausible=(0.0, 1.0)),)
    equation = "normal speed after an impact = coefficient * normal speed before it"
    signature = "after an impact the motion is too lively or too dull, in flight it is right"
    experiment = DROP
    family = "contact"
    rivals: ClassVar = {"contact-friction": SLIDE}
