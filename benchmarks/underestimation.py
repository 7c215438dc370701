"""Under-estimation: estimated Lipschitz constants over the true ones, gradient-elite beside wood-zhang, both with safety 1.

Eight functions on [−1, 1]^n whose constants, one per axis, are known. Median and trials below are those of the axis whose
estimate is lowest in a trial, trials above those of the one whose estimate is highest. Both estimators spend the same
transitions on their estimates; the sweep over distances, alike for both, comes on top. Peer: `wood-zhang`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace

import harness
import numpy as np

import gapcert
from gapcert_bounds.constants.gradient_elite import GradientElite
from gapcert_bounds.constants.wood_zhang import WoodZhang
from gapcert_bounds.testing.fields import Kink, lipschitz_problem

Array = np.ndarray
BUDGETS = (4_000, 60_000)
RIDGE, BUMP, WIDTH = np.array([0.6, -0.3, 0.5, 0.4]), np.array([0.31, -0.4, 0.6, 0.12]), 0.15


@dataclass(frozen=True)
class Case:
    """A function of z (n, axes) and its exact constants, one per axis."""

    name: str
    function: Callable[[Array], Array]
    truth: Array


def toy(z: Array) -> Array:
    """Kinks and a wave along every axis: 0.3 |z0 − 0.2| + 0.25 |sin 3 z1| + 0.2 z2 |z3|."""
    return 0.3 * np.abs(z[:, 0] - 0.2) + 0.25 * np.abs(np.sin(3 * z[:, 1])) + 0.2 * z[:, 2] * np.abs(z[:, 3])


CASES = (
    Case("x − x³/3", lambda z: z[:, 0] - z[:, 0] ** 3 / 3, np.array([1.0])),
    Case("sin 3x", lambda z: np.sin(3 * z[:, 0]), np.array([3.0])),
    Case("linear, 4-D", lambda z: z @ np.array([1.0, -0.5, 0.25, 2.0]), np.array([1.0, 0.5, 0.25, 2.0])),
    Case("Σ sin(c z), 4-D", lambda z: np.sin(z * [1.0, 2.0, 3.0, 4.0]).sum(axis=1), np.array([1.0, 2.0, 3.0, 4.0])),
    Case("½ ‖z‖², 4-D", lambda z: (z**2).sum(axis=1) / 2, np.ones(4)),
    Case("ReLU ridge, 4-D", lambda z: np.maximum(0.0, z @ RIDGE - 1.2), np.abs(RIDGE)),
    Case(
        "narrow bump, 4-D",
        lambda z: 0.05 * np.exp(-((z - BUMP) ** 2).sum(axis=1) / (2 * WIDTH**2)) + 0.1 * z.sum(axis=1),
        np.full(4, 0.1 + 0.05 / (WIDTH * np.sqrt(np.e))),
    ),
    Case("toy with kinks, 4-D", toy, np.array([0.3, 0.75, 0.2, 0.2])),
)


def ratios(case: Case, estimator: gapcert.plugin.LipschitzEstimator, trials: int) -> Array:
    """Estimate over truth, (trials, axes)."""
    axes = len(case.truth)
    flat = Kink(np.zeros((1, max(2, axes))), np.zeros(max(2, axes)))
    held = tuple(range(axes, max(2, axes)))
    out = []
    for seed in range(trials):
        problem = replace(lipschitz_problem(flat, seed=seed), query=lambda _, z: case.function(z)[:, None], held=held)
        out.append(estimator.bound(problem).value[0, :axes] / case.truth)
    return np.array(out)


QUANTITIES: dict[str, Callable[[Array], float]] = {
    "median of estimate / true": lambda r: float(np.median(r.min(axis=1))),
    "trials below the truth by > 1 %": lambda r: 100 * float((r.min(axis=1) < 0.99).mean()),
    "trials above the truth by > 20 %": lambda r: 100 * float((r.max(axis=1) > 1.2).mean()),
}


def measure(options: argparse.Namespace) -> list[harness.Row]:
    rows, trials = [], 10 if options.quick else 20
    for budget in BUDGETS:
        for case in CASES:
            ours = ratios(case, GradientElite(safety=1, budget=budget), trials)
            peer = ratios(case, WoodZhang(safety=1, pairs=budget // (2 * len(case.truth))), trials)
            name = f"{case.name}; {budget:,} transitions"
            for quantity, take in QUANTITIES.items():
                unit = "1" if quantity.startswith("median") else "%"
                rows.append(harness.Row(name, quantity, unit, take(ours), take(peer), "wood-zhang, safety 1", None))
    return rows


if __name__ == "__main__":
    harness.main(measure, argparse.ArgumentParser(description=__doc__))
