"""Friction: laws of the speed, wet and dry, with a bound that holds at rest where they are dry; and bristles that bend."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import ClassVar, final

from gapcert.plugin import EffectParameter, Memory

from .experiments import BOTH_WAYS, CREEP, FREE_DECAY, LOADS, REST, VARY_SPEED
from .law import Law, driven, moves, placed, rubs, spread

_COEFFICIENT = {"force": 1, "velocity": -1}


def _wet(name: str, dimension: Mapping[str, int] = _COEFFICIENT) -> EffectParameter:
    """May be negative, where the stated damping is too strong; that is flagged."""
    return EffectParameter(name, dimension, (0.03, 0.3), -30.0, 30.0, plausible=(0.0, float("inf")))


def _dry(name: str) -> EffectParameter:
    return EffectParameter(name, {"force": 1}, (0.03, 0.3), 0.0, 3.0)


def _sides(high: float, low: float, count: int, scale: float) -> list[tuple[float, ...]]:
    """Levels with both sides alike, and with either one at 0.4 of the other."""
    sides = ((1.0, 1.0), (1.0, 0.4), (0.4, 1.0))
    return [(a * level * scale, b * level * scale) for level, (a, b) in itertools.product(spread(low, high, count), sides)]


@final
class ViscousFriction(Law):
    """f = −c·v."""

    name = "viscous-friction"
    parameters = (_wet("coefficient"),)
    equation = "f = −coefficient·v"
    adds: ClassVar = {"force": "-{coefficient}*{v}"}
    where = (rubs,)
    signature = "swings lose a constant share of their amplitude per period"
    experiment = VARY_SPEED
    amplitude = "coefficient"
    family = "viscous"
    rivals: ClassVar = {
        "quadratic-drag": VARY_SPEED,
        "coulomb-friction": VARY_SPEED,
        "asymmetric-viscous-friction": BOTH_WAYS,
        "constant-force": BOTH_WAYS,
    }


@final
class AsymmetricViscousFriction(Law):
    """f = −c₊·v forwards, −c₋·v backwards."""

    name = "asymmetric-viscous-friction"
    parameters = (_wet("plus"), _wet("minus"))
    equation = "f = −plus·v if v > 0, else −minus·v"
    adds: ClassVar = {"force": "-{plus}*max({v}, 0) - {minus}*min({v}, 0)"}
    where = (rubs,)
    signature = "swings lose a constant share of their amplitude, more in one direction than in the other"
    experiment = BOTH_WAYS
    family = "viscous"
    contains: ClassVar = {"viscous-friction": {"plus": "coefficient", "minus": "coefficient"}}
    rivals: ClassVar = {
        "viscous-friction": BOTH_WAYS,
        "quadratic-drag": VARY_SPEED,
        "asymmetric-coulomb-friction": VARY_SPEED,
        "constant-force": VARY_SPEED,
    }

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return _sides(1.5, 0.02, 6, self.parameters[0].scale(scales))


@final
class QuadraticDrag(Law):
    """f = −c·v·|v|."""

    name = "quadratic-drag"
    parameters = (_wet("coefficient", {"force": 1, "velocity": -2}),)
    equation = "f = −coefficient·v·|v|"
    adds: ClassVar = {"force": "-{coefficient}*{v}*abs({v})"}
    where = (rubs,)
    signature = "large swings are damped strongly, small ones hardly"
    experiment = VARY_SPEED
    amplitude = "coefficient"
    family = "drag"
    rivals: ClassVar = {
        "viscous-friction": VARY_SPEED,
        "asymmetric-viscous-friction": VARY_SPEED,
        "coulomb-friction": VARY_SPEED,
        "constant-force": BOTH_WAYS,
    }


@final
class CoulombFriction(Law):
    """f = −F·sgn(v) in motion; |f| ≤ F at rest."""

    name = "coulomb-friction"
    parameters = (_dry("level"),)
    equation = "f = −level·sgn(v); |f| ≤ level at rest"
    adds: ClassVar = {"dry_friction": "{level}"}
    where = (moves,)
    signature = "amplitudes fall by equal steps, and motion ends in rest away from equilibrium"
    experiment = REST
    amplitude = "level"
    family = "dry"
    rivals: ClassVar = {
        "viscous-friction": VARY_SPEED,
        "quadratic-drag": VARY_SPEED,
        "asymmetric-coulomb-friction": BOTH_WAYS,
        "stribeck-friction": REST,
        "dahl-friction": CREEP,
        "load-dependent-friction": LOADS,
        "constant-force": BOTH_WAYS,
    }


@final
class AsymmetricCoulombFriction(Law):
    """f = −F₊ forwards, F₋ backwards; −F₊ ≤ f ≤ F₋ at rest: a symmetric law and a constant force."""

    name = "asymmetric-coulomb-friction"
    parameters = (_dry("plus"), _dry("minus"))
    equation = "f = −plus if v > 0, minus if v < 0; −plus ≤ f ≤ minus at rest"
    adds: ClassVar = {"force": "({minus} - {plus})/2", "dry_friction": "({plus} + {minus})/2"}
    where = (moves,)
    signature = "amplitudes fall by steps that differ between the directions"
    experiment = BOTH_WAYS
    family = "dry"
    contains: ClassVar = {"coulomb-friction": {"plus": "level", "minus": "level"}}
    rivals: ClassVar = {
        "coulomb-friction": BOTH_WAYS,
        "constant-force": BOTH_WAYS,
        "asymmetric-viscous-friction": VARY_SPEED,
    }

    def grid(self, scales: Mapping[str, float]) -> list[tuple[float, ...]]:
        return _sides(1.0, 0.02, 6, self.parameters[0].scale(scales))


@final
class StribeckFriction(Law):
    """|f| ≤ F·(1 + ρ·exp(−(v/v_s)²)), with equality in motion. (Armstrong-Hélouvry et al., Automatica 30, 1994)"""

    name = "stribeck-friction"
    parameters = (
        _dry("level"),
        EffectParameter("ratio", {}, (0.2, 0.8), 0.0, 10.0, plausible=(0.0, 3.0)),
        EffectParameter("velocity", {"velocity": 1}, (0.05, 0.3), 0.003, 3.0, off=1.0),
    )
    equation = "|f| = level·(1 + ratio·exp(−(v/velocity)²)) against the motion"
    adds: ClassVar = {"dry_friction": "{level}*(1 + {ratio}*exp(-({v}/{velocity})**2))"}
    where = (moves,)
    signature = "motion stops and starts in jerks at low speed"
    experiment = REST
    amplitude = "level"
    family = "dry"
    contains: ClassVar = {"coulomb-friction": {"level": "level"}}
    rivals: ClassVar = {"coulomb-friction": REST, "lugre-friction": CREEP, "viscous-friction": VARY_SPEED}


@final
class LoadDependentFriction(Law):
    """|f| ≤ μ·|force applied at the coordinate|, with equality in motion: losses of a gear."""

    name = "load-dependent-friction"
    parameters = (EffectParameter("coefficient", {}, (0.05, 0.2), 0.0, 2.0, plausible=(0.0, 0.9)),)
    equation = "|f| = coefficient·|applied force| against the motion"
    adds: ClassVar = {"dry_friction": "{coefficient}*abs({f})"}
    where = (driven, moves)
    signature = "the drive is weaker when it pushes and stronger when it brakes; without input there is no loss"
    experiment = LOADS
    amplitude = "coefficient"
    family = "load"
    stage = 3
    rivals: ClassVar = {"coulomb-friction": LOADS, "viscous-friction": FREE_DECAY, "input-gain": BOTH_WAYS}


_LEVEL = EffectParameter("level", {"force": 1}, (0.1, 0.4), 0.0, 3.0)
_DISPLACEMENT = EffectParameter("displacement", {"position_range": 1}, (0.003, 0.015, 0.06), 3e-4, 0.3, off=1.0)


def _bristle(curve: str) -> str:
    """The bend after a sub-step of ṡ = (v/d)·(1 − s·sgn(v)/γ), exact at constant v, in shares of that at which it slides."""
    end = f"{curve}*sign({{v}})"
    return f"{end} + ({{memory}} - {end})*exp(-abs({{v}})*{{h}}/({{displacement}}*{curve}))"


@final
class DahlFriction(Law):
    """f = −F·s with ṡ = (v/d)·(1 − s·sgn(v)). (Dahl, 1968)

    The force uses the bend after the sub-step: then a resting bristle is a spring that neither gains nor loses energy.
    """

    name = "dahl-friction"
    parameters = (_LEVEL, _DISPLACEMENT)
    equation = "f = −level·s, displacement·ṡ = v − |v|·s"
    memory = Memory("{level}_bend", "1", _bristle("1"))
    adds: ClassVar = {"force": f"-{{level}}*({memory.next})"}
    where = (placed, moves)
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
    parameters = (
        _LEVEL,
        EffectParameter("ratio", {}, (0.5,), 0.0, 10.0, plausible=(0.0, 3.0)),
        EffectParameter("velocity", {"velocity": 1}, (0.05, 0.3), 0.003, 3.0, off=1.0),
        _DISPLACEMENT,
    )
    equation = "f = −level·s, displacement·ṡ = v − |v|·s/γ, γ = 1 + ratio·exp(−(v/velocity)²)"
    memory = Memory("{level}_bend", "1", _bristle("(1 + {ratio}*exp(-({v}/{velocity})**2))"))
    adds: ClassVar = {"force": f"-{{level}}*({memory.next})"}
    where = (placed, moves)
    signature = "friction builds up over a short way after every reversal, overshoots, and falls with speed"
    experiment = CREEP
    amplitude = "level"
    family = "bristle"
    contains: ClassVar = {
        "dahl-friction": {"level": "level", "displacement": "displacement"},
        "stribeck-friction": {"level": "level", "ratio": "ratio", "velocity": "velocity"},
    }
    rivals: ClassVar = {"stribeck-friction": CREEP, "dahl-friction": REST, "coulomb-friction": CREEP}
