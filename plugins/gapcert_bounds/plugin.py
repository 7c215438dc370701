"""Declares what this package offers; imports nothing but gapcert."""

from typing import Any

from gapcert.plugin import Component, hookimpl


@hookimpl
def gapcert_components() -> list[Component]:
    home = "gapcert_bounds.testing.contracts"
    return [
        *(_bound("lipschitz", "constants", *row, claim="deterministic") for row in _PROVED),
        *(_bound("lipschitz", "constants", *row, claim="statistical") for row in _ESTIMATED),
        *(_bound("gap_family", "families", *row) for row in _FAMILIES),
        _bound(
            "gap_family",
            "families",
            "declared",
            "a constant that the user states",
            "constant:Declared",
            "DeclaredGap",
            claim="assumed",
        ),
        _bound(
            "gap_family",
            "families",
            "basis",
            "a sum of named basis functions by the scenario program",
            "basis:Basis",
            requires=("cvxpy", "clarabel"),
            extra="basis",
        ),
        Component("contract", "GapFamilyContract", "what every gap family keeps", f"{home}:GapFamilyContract"),
        Component("contract", "LipschitzContract", "what every estimator keeps", f"{home}:LipschitzContract"),
    ]


def _bound(kind: str, folder: str, name: str, summary: str, target: str, options: str = "", **more: Any) -> Component:
    """Its options are called like its class, unless something else is said."""
    config = f"gapcert_bounds.config:{options or target.partition(':')[2]}Config"
    return Component(kind, name, summary, f"gapcert_bounds.{folder}.{target}", config, **more)


_PROVED = (
    ("declared", "constants that the user states", "lipschitz:Declared"),
    ("interval", "constants proved from the equations of both systems", "lipschitz:IntervalJacobian"),
)
_ESTIMATED = (
    ("wood-zhang", "constants estimated from sampled slopes by extreme value theory", "wood_zhang:WoodZhang"),
    ("gradient-elite", "constants estimated from slopes searched for around the steepest", "gradient_elite:GradientElite"),
    ("piecewise", "constants per cell and jumps where slopes grow, estimated from close pairs", "piecewise:Piecewise"),
)
_FAMILIES = (
    ("constant", "the smallest certified constant", "constant:Constant"),
    ("envelope", "the tightest band that samples and constants allow", "envelope:Envelope"),
    ("multilinear", "interpolation on a lattice, and what curvature allows it to miss", "multilinear:Multilinear"),
)
