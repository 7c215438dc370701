"""Friction that is elastic before it slides: bristles, moved by their exact solution at constant speed."""

from __future__ import annotations

from typing import ClassVar, final

import gapcert as gc

from .shared.experiments import CREEP, REST, VARY_SPEED
from .shared.law import Law
from .shared.sites import placed

LEVEL = gc.plugin.EffectParameter("level", {"force": 1}, (0.1, 0.4), 0.0, 3.0)
DISPLACEMENT = gc.plugin.EffectParameter("displacement", {"position_range": 1}, (0.003, 0.015, 0.06), 3e-4, 0.3, off=1.0)


def _bristle(curve: str) -> str:
    """The bend after a sub-step of ṡ = (v/d)·(1 − s·sgn(v)/γ), in shares of the bend at which it slides."""
    end = f"{curve}*sign({{v}})"
    return f"{end} + ({{memory}} - {end})*exp(-abs({{v}})*{{h}}/({{displacement}}*{curve}))"


@final
class DahlFriction(Law):
    """f = −F·s with ṡ = (v/d)·(1 − s·sgn(v)). (Dahl, 1968)

    The force uses the bend after the sub-step: then a resting bristle is a spring that neither gains nor loses energy.
    """

    name = "dahl-friction"
    site = "coordinate"
    parameters = (LEVEL, DISPLACEMENT)
    equation = "f = −level·s, displacement·ṡ = v − |v|·s"
    memory = gc.plugin.Memory("{level}_bend", "1", _bristle("1"))
    adds: ClassVar = {"force": f"-{{level}}*({memory.next})"}
    where = (placed,)
    signature = "after every reversal the friction builds up over a short way, and a resting joint springs back"
    experiment = CREEP
    amplitude = "level"
    family = "bristle"
    contains: ClassVar = {"coulomb-friction": {"level": "level"}}
    rivals: ClassVar = {"coulomb-friction": CREEP, "lugre-friction": REST, "viscous-friction": VARY_SPEED}


@final
class LugreFriction(Law):
    """f = −F·s with ṡ = (v/d)·(1 − s·sgn(v)/γ), γ = 1 + ρ·exp(−(v/v_s)²). (Canudas de Wit et al., IEEE TAC 40, 1995)

    Its σ₀ is F/d; its viscous term is `viscous-friction`; its σ₁, which data at usual rates do not show, is left out.
    """

    name = "lugre-friction"
    site = "coordinate"
    parameters = (
        LEVEL,
        gc.plugin.EffectParameter("ratio", {}, (0.5,), 0.0, 10.0, plausible=(0.0, 3.0)),
        gc.plugin.EffectParameter("velocity", {"velocity": 1}, (0.05, 0.3), 0.003, 3.0, off=1.0),
        DISPLACEMENT,
    )
    equation = "f = −level·s, displacement·ṡ = v − |v|·s/γ, γ = 1 + ratio·exp(−(v/velocity)²)"
    memory = gc.plugin.Memory("{level}_bend", "1", _bristle("(1 + {ratio}*exp(-({v}/{velocity})**2))"))
    adds: ClassVar = {"force": f"-{{level}}*({memory.next})"}
    where = (placed,)
    signature = "friction builds up over a short way after every reversal, overshoots, and falls with speed"
    experiment = CREEP
    amplitude = "level"
    family = "bristle"
    contains: ClassVar = {
        "dahl-friction": {"level": "level", "displacement": "displacement"},
        "stribeck-friction": {"level": "level", "ratio": "ratio", "velocity": "velocity"},
    }
    rivals: ClassVar = {"stribeck-friction": CREEP, "dahl-friction": REST, "coulomb-friction": CREEP}
