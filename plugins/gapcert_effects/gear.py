"""Play in the angle between a motor and what it drives: two inertias that knock together at either end of a gap."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping
from typing import ClassVar, final

import gapcert as gc
from gapcert.plugin import EffectParameter, Extension, Memory, site_units
from gapcert_effects.thresholds import THRESHOLDS

from .experiments import FREE_DECAY, SHAKE_AND_HOLD
from .law import Law, moves, placed, rigid, spread, turns

_WORD = re.compile(r"[^\W\d]\w*")


class _Gap(Law):
    """M = M_seen + M_hidden, M_hidden = h·M, δ of the hidden inertia from the seen one: δ̈ = min(max(p, l(−w/2)), l(w/2)).

    p is the difference of the accelerations that each has by itself, and l(e) = (e − δ − 1.5·Δ·δ̇)/Δ² what ends in two sub-steps
    Δ at rest at e: knocks throw nothing back, and the motion depends on all numbers without jumps. Of the seen one
    M·q̈ = F − G − h·M·δ̈, and h·w is its `shift` as the gap is crossed. F is the applied force and d·speed of the motor, G the
    bias and d·speed of the link, d = `decay`·M_link: as much of the model's friction is the link's. Along the numbers that
    are hard to tell apart only `width` changes. (Nordin and Gutman, Automatica 38, 2002)
    """

    name = "gear-play"
    hides_motor: ClassVar = False
    where = (placed, moves, turns, rigid)
    signature = "after every reversal one inertia moves alone across the gap, and both of them from the knock on"
    experiment = "reverse the drive slowly and often, then fast: the way across the gap is the same"
    family = "gap"
    stage = 99
    rivals: ClassVar = {
        "backlash": "reverse the drive slowly, then fast: a gap is a way, play in the force is a level",
        "parameter": SHAKE_AND_HOLD,
        "coulomb-friction": FREE_DECAY,
    }

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        shares = (0.15, 0.4, 0.75) if self.hides_motor else (0.25, 0.5, 0.8)
        widths = [w * scales["position_range"] for w in spread(0.001, 0.3, 9)]
        # A link without friction of its own coasts, and one with much of it stops: on the times of the motion these differ.
        rates = [0.0, *(r * scales["velocity"] / scales["position_range"] for r in (1.2, 3.6))]
        return [(w, w * h, rate) for w, h, rate in itertools.product(widths, shares, rates)]

    def extension(self, site: str, model: gc.Model) -> Extension:
        own, law = self.named(site, model), rigid(site, model)
        assert law is not None, "the effect applies"
        (width, shift, decay), (mass, force, bias, speed) = (p.name for p in own), law
        gap, apart = (f"{width.removesuffix('width')}{n}" for n in ("gap", "speed"))
        share = f"min({shift}/max({width}, 1e-9), 0.97)"
        seen, hidden = f"(1 - {share})", f"max({share}, 0.01)"
        damping = f"{decay}*{seen if self.hides_motor else hidden}*{mass}"

        def across(text: str) -> str:
            """At the place and the speed of the hidden inertia."""
            there = {site: f"({site} + {gap})", speed: f"({speed} + {apart})"}
            return _WORD.sub(lambda m: there.get(m[0], m[0]), text)

        def of_link(text: str) -> str:
            return text if self.hides_motor else across(text)

        drag = f"{of_link(bias or '0')} + {damping}*{of_link(speed)}"
        if self.hides_motor:
            drive = f"{across(force)} + {damping}*{across(speed)}"
            pull, other = f"(({drive})/{hidden} + ({drag})/{seen})/{mass}", f"{across(force)} - ({force}) + {damping}*{apart}"
        else:
            drive = f"{force} + {damping}*{speed}"
            pull = f"-(({drive})/{seen} + ({drag})/{hidden})/{mass}"
            other = f"{bias} - {across(bias)} - {damping}*{apart}" if bias else f"-{damping}*{apart}"
        low, high = (f"({sign}{width}/2 - {gap} - 1.5*{{h}}*{apart})/{{h}}**2" for sign in ("-", ""))
        kept, units = f"min(max({pull}, {low}), {high})", site_units(model, "coordinate", site)
        memory = (
            Memory(gap, units["position"], f"{gap} + {{h}}*{apart} + {{h}}**2/2*{kept}"),
            Memory(apart, units["velocity"], f"{apart} + {{h}}*{kept}"),
        )
        count = math.ceil(model.period / THRESHOLDS.gear_step - 1e-9)
        return Extension(self.name, site, own, force=f"{other} - {mass}*{share}*{kept}", memory=memory, substeps=count)


def _numbers(seen: str) -> tuple[EffectParameter, ...]:
    # Steps that are small against the way across, and large against the kinks of single knocks.
    return (
        EffectParameter("width", {"position_range": 1}, (0.03, 0.1), 0.0, 1.0, step=0.0002),
        EffectParameter(f"{seen}_shift", {"position_range": 1}, (0.01, 0.05), 0.0, 1.0, step=0.0001),
        EffectParameter("decay", {"time": -1}, (0.5,), -20.0, 100.0, plausible=(0.0, math.inf), step=0.05),
    )


@final
class GearPlaySeenFromTheLink(_Gap):
    """The coordinate is the link's, and no output shows the motor."""

    name = "gear-play-seen-from-the-link"
    variant_of = "gear-play"
    hides_motor = True
    parameters = _numbers("link")
    equation = (
        "the link is moved by link_shift while the motor crosses a gap of `width` from it; the link alone decays at `decay`"
    )


@final
class GearPlay(_Gap):
    """The coordinate is the motor's, and no output shows the link."""

    parameters = _numbers("motor")
    equation = (
        "the motor is moved by motor_shift while it crosses a gap of `width` from the link, which alone decays at `decay`"
    )
    variants = (GearPlaySeenFromTheLink,)
