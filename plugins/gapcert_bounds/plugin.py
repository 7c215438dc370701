"""Declares what this package offers; imports nothing but gapcert."""

from typing import Any

import gapcert

CONFIG = "gapcert_bounds.config"
_SAMPLED = {"claim": "statistical"}
_ESTIMATORS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "declared": ("declared_constants:Declared", "constants that the user states", {}),
    "interval": ("interval:IntervalJacobian", "constants proved from the equations of both systems", {}),
    "wood-zhang": ("wood_zhang:WoodZhang", "constants estimated from sampled slopes by extreme value theory", _SAMPLED),
    "gradient-elite": (
        "gradient_elite:GradientElite", "constants estimated from slopes searched for around the steepest", _SAMPLED,
    ),
    "piecewise": (
        "piecewise:Piecewise", "constants per cell and jumps where slopes grow, estimated from close pairs", _SAMPLED,
    ),
}  # fmt: skip
_FAMILIES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "constant": ("constant:Constant", "the smallest certified constant", {}),
    "declared": (
        "constant:Declared", "a constant that the user states", {"claim": "assumed", "config": f"{CONFIG}:DeclaredGapConfig"},
    ),
    "envelope": ("envelope:Envelope", "the tightest band that samples and constants allow", {}),
    "multilinear": ("multilinear:Multilinear", "interpolation on a lattice, and what curvature allows it to miss", {}),
    "basis": (
        "basis:Basis", "a sum of named basis functions by the scenario program",
        {"requires": ("cvxpy", "clarabel"), "extra": "basis"},
    ),
}  # fmt: skip


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    """Estimators of constants, and families of gap functions; their options bear the names of their classes."""
    components = [*_declared("lipschitz", "constants", _ESTIMATORS), *_declared("gap_family", "families", _FAMILIES)]
    return [*components, *_contracts()]


def _declared(kind: str, folder: str, offered: dict[str, tuple[str, str, dict[str, Any]]]) -> list[gapcert.Component]:
    return [
        gapcert.Component(
            kind, name, text, f"gapcert_bounds.{folder}.{home}", **{"config": f"{CONFIG}:{home.partition(':')[2]}Config"} | more
        )
        for name, (home, text, more) in offered.items()
    ]


def _contracts() -> list[gapcert.Component]:
    home = "gapcert_bounds.testing.contracts"
    return [
        gapcert.Component("contract", "GapFamilyContract", "what every gap family keeps", f"{home}:GapFamilyContract"),
        gapcert.Component("contract", "LipschitzContract", "what every estimator keeps", f"{home}:LipschitzContract"),
    ]
