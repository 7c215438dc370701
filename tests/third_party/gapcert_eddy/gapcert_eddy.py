from typing import ClassVar

import gapcert as gc


@gc.hookimpl
def gapcert_components():
    return [gc.Component("effect", "eddy-brake", EddyBrake.sentence, "gapcert_eddy:EddyBrake")]


class EddyBrake(gc.plugin.Effect):
    name = "eddy-brake"
    site = "coordinate"
    parameters = (
        gc.plugin.EffectParameter("peak", {"force": 1}, (0.1, 0.5), 0.0, 3.0),  # multiples of the rms force in the data
        gc.plugin.EffectParameter(
            "speed", {"velocity": 1}, (0.3, 1.0), 0.05, 10.0, off=1.0
        ),  # of the rms speed; while off, any
    )
    sentence = "a magnetic brake, strongest at one speed"
    equation = "f = −peak·2s/(1 + s²), s = v/speed"
    signature = "damping that grows with speed up to a point, and fades beyond it"
    experiment = "run at steady speeds from creeping to fastest"
    amplitude = "peak"  # the law is linear in it, so a search need not try its values
    family = "viscous"  # it looks like viscous friction: a screen lets the better of the two through
    rivals: ClassVar = {"viscous-friction": "run faster than the speed at which the brake is strongest"}

    def extension(self, site, model):
        peak, speed = self.named(site, model)
        s = f"({{v}}/{speed.name})"
        return gc.plugin.Extension(self.name, site, (peak, speed), force=f"-{peak.name}*2*{s}/(1 + {s}**2)")
