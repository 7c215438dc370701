"""A stated value that the data push outside its tolerance."""

from __future__ import annotations

from typing import ClassVar, final

import gapcert as gc

from .shared.experiments import FREE_DECAY, SHAKE_AND_HOLD
from .shared.law import Law


@final
class Parameter(Law):
    """p = value, with the tolerance lifted. A parameter without a tolerance is exact, unless the model doubts it."""

    name = "parameter"
    site = "parameter"
    parameters = (gc.plugin.EffectParameter("value", {"value": 1}, (0.7, 1.4), 0.02, 50.0, off=1.0, plausible=(0.5, 2.0)),)
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

    def extension(self, site: str, model: gc.Model) -> gc.plugin.Extension:
        return gc.plugin.Extension(self.name, site, (), frees=site)
