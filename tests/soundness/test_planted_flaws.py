"""Flaws that look like rounding, luck or thrift, each planted on purpose: the truth escapes, and without them it does not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from faulty import Coasting

import gapcert as gc
from gapcert.certification.routes import Request
from gapcert.certification.samples.executors import threads
from gapcert.contracts.gaps.predictor import Samples
from gapcert.testing.toys import Opaque
from gapcert_bounds.constants.declared_constants import Declared
from gapcert_bounds.families.envelope import Envelope
from gapcert_bounds.testing.fields import Field, Kink, Nothing, Waves, gap_problem
from gapcert_networks import theorem1_network as covered
from gapcert_networks.network import Network

Array = np.ndarray


def outside(gap: gc.GapFunction, field: Field, z: Array) -> int:
    low, high = gap.interval(z)
    return int((~((low <= field(z)) & (field(z) <= high))).any(axis=1).sum())


@pytest.mark.parametrize("offset", [-1 / 3, 0.1])
def test_float32_residuals_that_are_rounded_away_from_zero(offset: float) -> None:
    """Larger in size is lower where a residual is negative, and is no bound from above there; nor the other way round."""
    field = Waves(np.zeros((1, 2)), np.ones((1, 2)), np.zeros((1, 2)), offset=offset)
    problem, z = gap_problem(field, (3, 3)), field.domain.draw(1000, np.random.default_rng(0))
    near = problem.samples.r.astype(np.float32)
    away = np.where(np.abs(near) < np.abs(problem.samples.r), np.nextafter(near, np.sign(near) * np.float32(np.inf)), near)
    stored = replace(problem, samples=replace(problem.samples, r=away.astype(np.float64)))
    assert (np.abs(away) >= np.abs(problem.samples.r)).all()
    assert outside(Envelope().fit(stored), field, z) == len(z)
    whole = np.spacing(np.abs(away)).astype(np.float64).max(axis=0)
    assert outside(Envelope().fit(replace(stored, resolution=problem.resolution + whole)), field, z) == 0
    assert outside(Envelope().fit(problem), field, z) == 0


def test_gamma_in_float32_that_is_rounded_up_once() -> None:
    """The next float32 is above the computed value, not above what the computation lost where z and a sample nearly cancel."""
    field = Kink(np.array([[1.0, 0.5]]), np.array([0.3, 0.3]))
    problem = gap_problem(field, (3, 3))
    at = np.array([[0.3, 0.3]])
    problem = replace(problem, samples=Samples(at, field(at)))
    z = at + np.random.default_rng(0).uniform(-1e-3, 1e-3, (1000, 2))
    assert outside(Envelope().fit(problem), field, z) == 0
    narrow = (np.abs(z.astype(np.float32) - at.astype(np.float32)) * problem.lipschitz.value[0].astype(np.float32)).sum(axis=1)
    gamma = np.nextafter(narrow + np.float32(2 * problem.resolution[0]), np.float32(np.inf))
    assert (field(z)[:, 0] > gamma).sum() > 100


def test_networks_with_a_constant_that_is_a_hundredth_too_small(monkeypatch: pytest.MonkeyPatch) -> None:
    """On route theorem1 a network falls by all of L₁ ε between a sample and the corner of its cell."""
    flat = Waves(np.zeros((1, 2)), np.ones((1, 2)), np.zeros((1, 2)), offset=1.0)
    problem = gap_problem(flat, (4, 3), route="theorem1")
    q = Network((np.array([[1.0, 0.5]]), np.array([[2.0]])), (np.array([4.0]), np.array([-8.0])))
    corners = np.array([[a, b] for a in (-1.0, 1.0) for b in (-1.0, 1.0)])
    ex, eu = problem.samples.cover.radii()
    # The direction of steepest descent leads from the lowest sample as far as the cover's radius, along a grid of that shape.
    q = Network((np.array([[ex, eu]]), q.weights[1]), q.biases)
    assert outside(covered.raised(problem, "drawn", q), flat, corners) == 0
    proved = covered._constant

    def less(q: Network, i: int) -> tuple[float, float, tuple[Array, ...]]:
        square, constant, multipliers = proved(q, i)
        return square, 0.99 * constant, multipliers

    monkeypatch.setattr(covered, "_constant", less)
    assert outside(covered.raised(problem, "drawn", q), flat, corners) > 0


def test_data_from_rest_alone_bound_nothing_in_motion() -> None:
    """At rest r = −u/20, in motion (v − u)/20: half of the spread over v is 1/20, and with it in e the bound holds."""
    system, rng = Coasting(), np.random.default_rng(0)

    def residual(z: Array, v: Array) -> Array:
        return system.step(z[:, :1], z[:, 1:], hidden=np.column_stack([v, 0 * v])).x - z[:, :1] - 0.1 * z[:, 1:]

    like = Waves(np.zeros((1, 2)), np.ones((1, 2)), np.zeros((1, 2)))
    like.constants = np.array([[0.0, 0.05]])
    problem, z = gap_problem(like, (3, 9)), like.domain.draw(5000, rng)
    problem = replace(problem, samples=Samples(problem.samples.z, residual(problem.samples.z, np.zeros(27))))
    moving, still = residual(z, rng.uniform(-1, 1, len(z))), residual(z, np.zeros(len(z)))

    def share(e: Array, r: Array) -> float:
        low, high = Envelope().fit(replace(problem, resolution=problem.resolution + e)).interval(z)
        return float((~((low <= r) & (r <= high))).mean())

    assert share(np.zeros(1), still) == 0
    assert share(np.zeros(1), moving) > 0.3
    assert share(np.full(1, 0.05), moving) == 0


def test_an_audit_after_one_that_failed_has_half_of_its_risk(tmp_path: Path) -> None:
    """Constants are raised until an audit passes: the second one is asked at other points, and for less risk."""
    field = Waves.smooth()
    names = [a.name for a in field.domain.axes]

    def made(name: str, factor: float) -> gc.Certificate:
        rows = (factor * field.constants).tolist()
        values = {n: dict(zip(names, row, strict=True)) for n, row in zip(names, rows, strict=False)}
        options = {
            "request": Request("statistical", 1e-2, 1e-3),
            "sampling": gc.AdaptiveSampling(200),
            "executor": threads,
            "predictor": "none",
        }
        return gc.certify(
            Nothing(field), Opaque(field), field.domain, lipschitz=Declared(values), folder=tmp_path / name, **options
        )

    first, second = made("small", 0.2), made("true", 1.0)
    assert first.audit.violations > 0
    assert first.claim.kind == "empirical"
    assert (first.audit.k, second.audit.k) == (1, 2)
    assert second.claim.kind == "statistical"
    assert len(second.audit.z) > len(first.audit.z)
    assert (1 - 1e-2) ** len(first.audit.z) > 1e-3 / 4 >= (1 - 1e-2) ** len(second.audit.z)
    assert not np.isin(second.audit.z, first.audit.z).any()
