"""Attacks on route dominate: no violation with true constants, and every ingredient of the guarantee is necessary."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rough_fields import Bump, Coarse

import gapcert as gc
from gapcert_bounds.families.constant import Constant
from gapcert_bounds.families.envelope import Envelope
from gapcert_bounds.families.envelope_gap import EnvelopeGap
from gapcert_bounds.testing.fields import Kink, Waves, gap_problem, lattice

KINK = Kink(np.array([[0.5, 0.25, 0.125], [0.3, 1.0, 0.5]]), np.array([0.11, -0.3, 0.2]))


def outside(gap, field, z):
    low, high = gap.interval(z)
    r = field(z)
    return int(((r < low) | (r > high)).any(axis=1).sum())


def drawn_field(seed, kind):
    rng = np.random.default_rng(seed)
    waves = Waves(rng.normal(size=(2, 3)), rng.uniform(0, 8, (2, 3)), rng.uniform(-3, 3, (2, 3)), float(rng.normal()))
    if kind == "waves":
        return waves
    if kind == "bump":
        return Bump(waves, float(rng.normal()), float(rng.uniform(0.02, 0.5)), rng.uniform(-1, 1, 3))
    return Kink(rng.normal(size=(2, 3)), rng.uniform(-1.2, 1.2, 3))


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(["waves", "bump", "kink"]),
    counts=st.tuples(st.integers(1, 6), st.integers(1, 6), st.integers(1, 6)),
    affine=st.booleans(),
)
def test_no_violation_with_true_constants(seed, kind, counts, affine):
    field = drawn_field(seed, kind)
    problem = gap_problem(field, counts, affine=affine)
    z = np.concatenate([field.domain.draw(5_000, np.random.default_rng(seed)), lattice(field.domain, (5, 5, 5))])
    gap = Envelope().fit(problem)
    assert outside(gap, field, z) == 0
    assert (np.abs(field(z)) <= gap.gamma(z)).all()


@pytest.mark.exam
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), kind=st.sampled_from(["waves", "bump", "kink"]))
def test_no_violation_of_the_constant_and_of_boxes(seed, kind):
    field = drawn_field(seed, kind)
    problem = gap_problem(field, (4, 4, 4), affine=True)
    gap, constant = Envelope().fit(problem), Constant().fit(problem)
    rng = np.random.default_rng(seed)
    z = field.domain.draw(5_000, rng)
    assert (np.abs(field(z)) <= constant.gamma(z)).all()
    boxes = gc.Interval(z, np.minimum(z + rng.random(z.shape) * 0.3, 1.0))
    inner = boxes.lo + rng.random(z.shape) * (boxes.hi - boxes.lo)
    assert gap.interval_over(boxes).contains(field(inner)).all()


@pytest.mark.parametrize("field", [Waves.smooth(), KINK], ids=["smooth", "kink"])
def test_nine_tenths_of_the_constants_are_not_enough(field):
    z = field.domain.draw(100_000, np.random.default_rng(0))
    assert outside(Envelope().fit(gap_problem(field, (6, 6, 6))), field, z) == 0
    assert outside(Envelope().fit(gap_problem(field, (6, 6, 6), factor=0.9)), field, z) > 0


def test_a_bump_between_the_samples_needs_its_own_constants():
    bump = Bump(Waves.smooth(), 0.5, 0.1, np.array([0.21, -0.4, 0.6]))
    problem = gap_problem(bump, (6, 6, 6))
    z = bump.centre + np.random.default_rng(0).uniform(-0.05, 0.05, (2_000, 3))
    assert outside(Envelope().fit(problem), bump, z) == 0
    without = replace(problem, lipschitz=replace(problem.lipschitz, value=bump.waves.constants))
    assert outside(Envelope().fit(without), bump, z) > 0


def test_the_resolution_term_is_necessary():
    """A residual rounded to multiples of 1e-3 is not Lipschitz; 2 e per pair of answers is what its rounding needs."""
    coarse = Coarse(KINK, 1e-3)
    problem = gap_problem(KINK, (7, 7, 7), backend=coarse)
    assert np.allclose(problem.resolution, 0.5e-3)
    z = KINK.domain.draw(100_000, np.random.default_rng(1))
    x, u = KINK.domain.split(z)
    r = coarse.step(x, u).x

    def violations(e):
        low, high = Envelope().fit(problem).interval(z) if e is None else without(e).interval(z)
        return int(((r < low) | (r > high)).any(axis=1).sum())

    def without(e):
        return EnvelopeGap(problem.samples.z, problem.remainder, problem.lipschitz.value, e, problem.predictor)

    assert violations(None) == 0
    assert violations(np.zeros(2)) > 0
    assert violations(problem.resolution / 2) > 0


def test_the_resolution_of_plain_float64_is_necessary_too():
    """f̂ and f both near 1e6 differ by whole ulps of 1e6, however flat the exact residual is."""
    field = Waves(np.full((2, 3), 1e-12), np.ones((2, 3)), np.zeros((2, 3)))
    rng = np.random.default_rng(2)
    z = field.domain.draw(2_000, rng)
    r = (1e6 + field(z)) + np.spacing(1e6) * rng.integers(-1, 2, (len(z), 2)) - 1e6
    p = gc.plugin.AffinePredictor.none(2, 3)
    for e, holds in ((2 * np.spacing(np.full(2, 1e6)), True), (np.zeros(2), False)):
        low, high = EnvelopeGap(z[:100], r[:100], field.constants, e, p).interval(z)
        assert ((r >= low) & (r <= high)).all() == holds


@pytest.mark.exam
def test_the_centre_of_a_box_does_not_stand_for_the_box():
    field = Waves.smooth()
    gap = Envelope().fit(gap_problem(field, (6, 6, 6)))
    z = field.domain.draw(20_000, np.random.default_rng(3))
    boxes = gc.Interval(z, np.minimum(z + 0.2, 1.0))
    corner = boxes.hi
    low, high = gap.interval(boxes.mid)
    assert ((field(corner) < low) | (field(corner) > high)).any()
    over = gap.interval_over(boxes)
    assert over.contains(field(corner)).all()


def test_the_band_is_empty_exactly_where_two_samples_refute_the_constants():
    """u < l somewhere if and only if |Δg| > Σ L |Δz| + 4 e for some pair; whatever the residual, an audit there fails."""
    for factor in (0.7, 0.9, 0.97, 1.0):
        problem = gap_problem(KINK, (5, 5, 5), factor=factor)
        z, g = problem.samples.z, problem.remainder
        apart = np.abs(z[:, None] - z[None]) @ problem.lipschitz.value.T
        refuted = (np.abs(g[:, None] - g[None]) > apart * (1 + 1e-12) + 4 * problem.resolution).any()
        low, high = Envelope().fit(problem).interval((z[:, None] + z[None]).reshape(-1, 3) / 2)
        assert (low > high).any() == refuted == (factor < 1)
