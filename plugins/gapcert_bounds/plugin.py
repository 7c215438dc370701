"""Declares what this package offers; imports nothing but gapcert."""

import gapcert


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    config = "gapcert_bounds.config"
    return [
        gapcert.Component(
            "lipschitz",
            "declared",
            "constants that the user states",
            "gapcert_bounds.lipschitz:Declared",
            f"{config}:DeclaredConfig",
        ),
        gapcert.Component(
            "lipschitz",
            "interval",
            "constants proved from the equations of both systems",
            "gapcert_bounds.lipschitz:IntervalJacobian",
            f"{config}:IntervalJacobianConfig",
        ),
        gapcert.Component(
            "lipschitz",
            "wood-zhang",
            "constants estimated from sampled slopes by extreme value theory",
            "gapcert_bounds.wood_zhang:WoodZhang",
            f"{config}:WoodZhangConfig",
            claim="statistical",
        ),
        gapcert.Component(
            "lipschitz",
            "gradient-elite",
            "constants estimated from slopes searched for around the steepest",
            "gapcert_bounds.gradient_elite:GradientElite",
            f"{config}:GradientEliteConfig",
            claim="statistical",
        ),
        gapcert.Component(
            "lipschitz",
            "piecewise",
            "constants per cell and jumps where slopes grow, estimated from close pairs",
            "gapcert_bounds.piecewise:Piecewise",
            f"{config}:PiecewiseConfig",
            claim="statistical",
        ),
        gapcert.Component(
            "gap_family",
            "constant",
            "the smallest certified constant",
            "gapcert_bounds.constant:Constant",
            f"{config}:ConstantConfig",
        ),
        gapcert.Component(
            "gap_family",
            "envelope",
            "the tightest band that samples and constants allow",
            "gapcert_bounds.envelope:Envelope",
            f"{config}:EnvelopeConfig",
        ),
        gapcert.Component(
            "gap_family",
            "basis",
            "a sum of named basis functions by the scenario program",
            "gapcert_bounds.basis:Basis",
            f"{config}:BasisConfig",
            requires=("cvxpy", "clarabel"),
            extra="basis",
        ),
    ]
