"""Declares what this package offers; imports nothing but gapcert."""

import gapcert

CONFIG = "gapcert_bounds.config"


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    return [*_estimators(), *_families(), *_contracts()]


def _estimators() -> list[gapcert.Component]:
    return [
        gapcert.Component(
            "lipschitz",
            "declared",
            "constants that the user states",
            "gapcert_bounds.constants.lipschitz:Declared",
            f"{CONFIG}:DeclaredConfig",
        ),
        gapcert.Component(
            "lipschitz",
            "interval",
            "constants proved from the equations of both systems",
            "gapcert_bounds.constants.lipschitz:IntervalJacobian",
            f"{CONFIG}:IntervalJacobianConfig",
        ),
        gapcert.Component(
            "lipschitz",
            "wood-zhang",
            "constants estimated from sampled slopes by extreme value theory",
            "gapcert_bounds.constants.wood_zhang:WoodZhang",
            f"{CONFIG}:WoodZhangConfig",
            claim="statistical",
        ),
        gapcert.Component(
            "lipschitz",
            "gradient-elite",
            "constants estimated from slopes searched for around the steepest",
            "gapcert_bounds.constants.gradient_elite:GradientElite",
            f"{CONFIG}:GradientEliteConfig",
            claim="statistical",
        ),
        gapcert.Component(
            "lipschitz",
            "piecewise",
            "constants per cell and jumps where slopes grow, estimated from close pairs",
            "gapcert_bounds.constants.piecewise:Piecewise",
            f"{CONFIG}:PiecewiseConfig",
            claim="statistical",
        ),
    ]


def _families() -> list[gapcert.Component]:
    return [
        gapcert.Component(
            "gap_family",
            "constant",
            "the smallest certified constant",
            "gapcert_bounds.families.constant:Constant",
            f"{CONFIG}:ConstantConfig",
        ),
        gapcert.Component(
            "gap_family",
            "declared",
            "a constant that the user states",
            "gapcert_bounds.families.constant:Declared",
            f"{CONFIG}:DeclaredGapConfig",
            claim="assumed",
        ),
        gapcert.Component(
            "gap_family",
            "envelope",
            "the tightest band that samples and constants allow",
            "gapcert_bounds.families.envelope:Envelope",
            f"{CONFIG}:EnvelopeConfig",
        ),
        gapcert.Component(
            "gap_family",
            "multilinear",
            "interpolation on a lattice, and what curvature allows it to miss",
            "gapcert_bounds.families.multilinear:Multilinear",
            f"{CONFIG}:MultilinearConfig",
        ),
        gapcert.Component(
            "gap_family",
            "basis",
            "a sum of named basis functions by the scenario program",
            "gapcert_bounds.families.basis:Basis",
            f"{CONFIG}:BasisConfig",
            requires=("cvxpy", "clarabel"),
            extra="basis",
        ),
    ]


def _contracts() -> list[gapcert.Component]:
    home = "gapcert_bounds.testing.contracts"
    return [
        gapcert.Component("contract", "GapFamilyContract", "what every gap family keeps", f"{home}:GapFamilyContract"),
        gapcert.Component("contract", "LipschitzContract", "what every estimator keeps", f"{home}:LipschitzContract"),
    ]
