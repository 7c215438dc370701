"""No violation of l ≤ r ≤ u at more than twenty million fresh points: random fields with known constants, every kind of bound.

Half of the points are uniform. The others have, along about half of their axes, a coordinate at which a bound is likely to
break: an edge of a table or of a cell, a sample, an end of the domain, or a float beside one of these.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rough_fields import Bump

import gapcert as gc
from gapcert.contracts.gaps.gap import FitRoute
from gapcert.contracts.gaps.predictor import Samples
from gapcert_bounds.constants.interval import IntervalJacobian
from gapcert_bounds.families.basis import Basis
from gapcert_bounds.families.constant import Constant
from gapcert_bounds.families.envelope import Envelope
from gapcert_bounds.families.multilinear import Multilinear
from gapcert_bounds.testing.fields import Field, Kink, Nothing, Waves, gap_problem, lattice, lipschitz_problem
from gapcert_neural.family import Neural

Array = np.ndarray
BLOCK = 1 << 17
FUNCTIONS = ("1", "x0^2", "sin(x1)", "abs(u0)", "cos(2*x0)*x1", "exp(-u0^2)")


def waves(rng: np.random.Generator, unit: float, half: float) -> Waves:
    amplitude = unit * rng.normal(size=(2, 3)) * (rng.random((2, 3)) < 0.8)
    return Waves(amplitude, rng.uniform(0, 6, (2, 3)) / half, rng.uniform(-3, 3, (2, 3)), unit * rng.normal(), half)


def kink(rng: np.random.Generator, unit: float, half: float) -> Kink:
    return Kink(unit * rng.normal(size=(2, 3)) / half, half * rng.uniform(-1, 1, 3), half)


def bump(rng: np.random.Generator, unit: float, half: float) -> Bump:
    return Bump(waves(rng, unit, half), unit * rng.normal(), half * rng.uniform(0.05, 0.5), half * rng.uniform(-1, 1, 3))


SMOOTH: tuple[Callable[..., Field], ...] = (waves,)
ROUGH: tuple[Callable[..., Field], ...] = (waves, kink, bump)


def special(problem: gc.plugin.GapProblem, gap: gc.GapFunction) -> list[Array]:
    """Per axis, the coordinates at which something changes, and the floats beside them, within the domain."""
    cells, found = problem.lipschitz.cells, []
    for j, (low, high) in enumerate(zip(problem.domain.low, problem.domain.high, strict=True)):
        parts = [np.array([low, high, (low + high) / 2, 0.0]), problem.samples.z[:, j]]
        parts += [gap.table.edges[j]] if hasattr(gap, "table") else []
        parts += [cells.boxes.lo[:, j], cells.boxes.hi[:, j]] if cells is not None else []
        at = np.unique(np.concatenate(parts))
        at = np.concatenate([at, np.nextafter(at, -np.inf), np.nextafter(at, np.inf)])
        found.append(np.unique(np.clip(at, low, high)))
    return found


def fresh(problem: gc.plugin.GapProblem, at: list[Array], n: int, rng: np.random.Generator) -> Array:
    z = problem.domain.draw(n, rng)
    some = z[: n // 2]
    for j, values in enumerate(at):
        rows = rng.random(len(some)) < 0.5
        some[rows, j] = rng.choice(values, int(rows.sum()))
    return z


def held(field: Field, problem: gc.plugin.GapProblem, gap: gc.GapFunction, points: int, seed: int) -> int:
    """How many fresh points lie inside; the samples have to as well."""
    at, rng, done = special(problem, gap), np.random.default_rng([seed, 1]), 0
    while done < points:
        z = fresh(problem, at, min(BLOCK, points - done), rng)
        rows = z if done else np.concatenate([problem.samples.z, z])
        (low, high), r = gap.interval(rows), field(rows)
        wrong = ~((low <= r) & (r <= high)).all(axis=1)
        assert not wrong.any(), (rows[wrong][:3], low[wrong][:3], r[wrong][:3], high[wrong][:3])
        done += len(z)
    return done


def plain(
    route: FitRoute, least: int, most: int, affine: bool = False
) -> Callable[[Field, np.random.Generator], gc.plugin.GapProblem]:
    def made(field: Field, rng: np.random.Generator) -> gc.plugin.GapProblem:
        counts = tuple(rng.integers(least, most, 3).tolist())
        return gap_problem(field, counts, route=route, affine=affine and bool(rng.integers(2)))

    return made


def cells(field: Field, rng: np.random.Generator) -> gc.plugin.GapProblem:
    """As `certify` does it: a first round, constants per cell, and further samples where the band is loosest."""
    residual, first = gc.plugin.Residual(field, Nothing(field)), lattice(field.domain, (3, 3, 3))
    bound = IntervalJacobian(1024, 16).bound(lipschitz_problem(field))
    more = [] if bound.cells is None else [bound.cells.points(field.domain, residual(first), 150)]
    z = np.concatenate([first, *more])
    none = gc.plugin.AffinePredictor.none(field.nx, z.shape[1])
    return gc.plugin.GapProblem(
        Samples(z, residual(z)), field.domain, bound, none, residual.resolution(field.domain), "dominate"
    )


LIFTED = {"cells": (2, 3, 1), "boxes": 4000}
TRAINED = {"hidden": (12,), "steps": 40, "device": "cpu"}
KINDS = {
    "constant": (Constant(), plain("dominate", 2, 8), ROUGH, 24, 4_000_000),
    "constant, theorem1": (Constant(), plain("theorem1", 2, 12), ROUGH, 24, 4_000_000),
    "envelope": (Envelope(), plain("dominate", 1, 8, affine=True), ROUGH, 24, 3_000_000),
    "multilinear": (Multilinear(), plain("dominate", 2, 8, affine=True), SMOOTH, 24, 4_000_000),
    "basis": (Basis(FUNCTIONS, **LIFTED), plain("dominate", 3, 7, affine=True), ROUGH, 12, 2_000_000),
    "basis, theorem1": (Basis(FUNCTIONS[:5]), plain("theorem1", 3, 12), ROUGH, 12, 2_000_000),
    "neural": (Neural(**LIFTED, **TRAINED), plain("dominate", 3, 6, affine=True), ROUGH, 12, 1_600_000),
    "neural, theorem1": (Neural(**TRAINED), plain("theorem1", 4, 12), ROUGH, 12, 1_600_000),
    "cells": (Envelope(), cells, (waves, bump), 12, 1_600_000),
    "cells, lifted": (Basis(FUNCTIONS, **LIFTED), cells, (waves, bump), 12, 1_000_000),
}


def test_there_are_twenty_million_points() -> None:
    assert sum(points for *_, points in KINDS.values()) >= 20_000_000


@pytest.mark.exam
@pytest.mark.parametrize("kind", KINDS)
def test_no_violation(kind: str) -> None:
    family, problem_of, fields, examples, points = KINDS[kind]
    done: list[int] = []

    @settings(max_examples=examples, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck), database=None)
    @given(
        seed=st.integers(0, 2**32 - 1),
        draw=st.sampled_from(fields),
        unit=st.sampled_from([1.0, 1e-9, 1e6]),
        half=st.sampled_from([1.0, 1e-6, 1e4])
        if kind.startswith(("constant", "envelope", "multilinear", "cells"))
        else st.just(1.0),
    )
    def holds(seed: int, draw: Callable[..., Field], unit: float, half: float) -> None:
        rng = np.random.default_rng(seed)
        field = draw(rng, unit, half)
        problem = problem_of(field, rng)
        done.append(held(field, problem, family.fit(problem), -(-points // examples), seed))

    holds()
    assert sum(done) >= points
