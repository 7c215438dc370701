"""Attacks on route theorem1: no violation with true constants, and margin, radius and final check are necessary."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rough_fields import Coarse

import gapcert as gc
from gapcert_bounds.families.basis import Basis, BasisGap, parse, scenario, shortfall
from gapcert_bounds.families.constant import Constant, ConstantGap
from gapcert_bounds.testing.fields import Field, Kink, Waves, gap_problem

FUNCTIONS = ("1", "x0^2", "sin(x1)", "abs(u0)", "cos(2*x0)")
SPIKES = Kink(np.array([[-1.0, -0.5, -0.25], [0.5, -1.0, -1.0]]), np.zeros(3))


def violations(gap, field: Field, n=50_000, seed=0):
    z = field.domain.draw(n, np.random.default_rng(seed))
    return int((np.abs(field(z)) > gap.gamma(z)).any(axis=1).sum())


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    counts=st.tuples(st.integers(2, 8), st.integers(2, 8), st.integers(2, 8)),
    family=st.sampled_from([Constant(), Basis(FUNCTIONS)]),
)
def test_no_violation_with_true_constants(seed, counts, family):
    rng = np.random.default_rng(seed)
    field = Waves(rng.normal(size=(2, 3)), rng.uniform(0, 6, (2, 3)), rng.uniform(-3, 3, (2, 3)))
    gap = family.fit(gap_problem(field, counts, route="theorem1"))
    assert violations(gap, field, 5_000, seed) == 0


class Ridge(Field):
    """r = 1 − |z − peak|₂ · slope in the state alone: the peak stands where the cover is thinnest."""

    def __init__(self, peak, slope):
        super().__init__(2, 1)
        self.peak, self.slope = np.asarray(peak), slope
        self.constants = np.array([[slope, slope, 0.0]] * 2)

    def _step(self, x, u, **options):
        r = 1 - self.slope * np.sqrt(((x - self.peak) ** 2).sum(axis=1))
        return np.stack([r, r], axis=1)

    def enclosure(self, z):
        raise NotImplementedError

    def jacobian_enclosure(self, z):
        raise NotImplementedError


def at_the_peak(gap, field):
    z = np.append(field.peak, 0.0)[None]
    return gap.gamma(z)[0] - np.abs(field(z)[0])


def test_margin_and_radius_are_as_large_as_they_must_be():
    """With the peak in the corner of a cell the exact radius is enough, and a slightly smaller one is not."""
    counts = (4, 4, 1)
    field = Ridge((0.5, 0.5), 0.4)  # a corner shared by four cells: every sample is a full radius away
    problem = gap_problem(field, counts, route="theorem1")
    ex, _ = problem.samples.cover.radii()
    # The field's joint constant is its slope, √2 below what two per-axis constants allow.
    joint = field.slope * ex
    largest = np.abs(problem.samples.r[np.argsort(((problem.samples.z[:, :2] - 0.5) ** 2).sum(axis=1))[:4]]).max(axis=0)
    exact = ConstantGap(largest + joint + 2 * problem.resolution)
    assert (at_the_peak(exact, field) >= 0).all()
    for radius in (0.99 * ex, 0.25 * np.sqrt(2) * 0.999, 0.0):
        short = ConstantGap(largest + field.slope * radius + 2 * problem.resolution)
        assert (at_the_peak(short, field) < 0).all()


def test_a_cover_radius_that_is_rounded_down_is_not_enough():
    """0.01 half a spacing in two inputs needs 0.01 √2 = 0.014142…, not 0.014 (the published figure)."""
    box = gc.Box((gc.StateSpec("x0"),), (-1.0,), (1.0,))
    inputs = gc.Box((gc.StateSpec("u0"), gc.StateSpec("u1")), (-0.01, -0.01), (0.01, 0.01))
    cover = gc.plugin.Cover(gc.Domain(box, inputs), (1, 1, 1))
    _, eu = cover.radii()
    assert eu >= np.hypot(0.01, 0.01)
    corner, centre = np.array([0.01, 0.01]), cover.chunk(0, 1)[0, 1:]
    assert np.linalg.norm(corner - centre) <= eu
    assert np.linalg.norm(corner - centre) > 0.014


@pytest.mark.parametrize("field", [Waves.smooth(), SPIKES], ids=["smooth", "kink"])
def test_the_margin_is_necessary(field):
    problem = gap_problem(field, (5, 5, 5), route="theorem1")
    constant = Constant().fit(problem)
    assert violations(constant, field) == 0
    assert violations(ConstantGap(np.abs(problem.samples.r).max(axis=0)), field) > 0
    basis = Basis(FUNCTIONS).fit(problem)
    assert violations(basis, field) == 0
    assert violations(BasisGap(basis.terms, basis.weights, np.zeros(2)), field) > 0


def test_the_functions_own_slope_is_part_of_the_margin():
    """γ may dip between samples while r does not: with r constant the whole margin is L₁ ε."""
    flat = Waves(np.zeros((2, 3)), np.ones((2, 3)), np.zeros((2, 3)), offset=1.0)
    problem = gap_problem(flat, (4, 4, 4), route="theorem1")
    # cos(4 π x) is −1 at every grid point −0.75, −0.25, …, and vanishes between them.
    terms = [parse("cos(12.566370614359172*x0)", ("x0", "x1", "u0"))]
    values = terms[0].value(problem.samples.z)
    assert np.allclose(np.abs(values), 1)
    weights = np.full((2, 1), 1 / values[0])
    shift = shortfall(terms, weights, problem.samples).max(axis=0)
    bare = BasisGap(terms, weights, np.maximum(shift, 0) + 2 * problem.resolution)
    assert (np.abs(problem.samples.r) <= bare.gamma(problem.samples.z)).all()
    assert violations(bare, flat) > 0


def test_every_sample_is_checked_at_the_end():
    """The solver's weights alone miss samples by its tolerance; the shift repairs exactly what is missing."""
    problem = gap_problem(Waves.smooth(), (8, 8, 8), route="theorem1")
    names = [a.name for a in problem.domain.axes]
    terms = [parse(t, names) for t in FUNCTIONS]
    weights = scenario(terms, problem.samples, problem.domain, 0.1, 0)
    short = shortfall(terms, weights, problem.samples).max(axis=0)
    assert (short < 1e-6).all()
    raised = BasisGap(terms, weights, np.maximum(short, 0))
    assert (np.abs(problem.samples.r) <= raised.gamma(problem.samples.z)).all()
    gap = Basis(FUNCTIONS).fit(problem)
    own = gap.gamma(problem.samples.z) - np.abs(problem.samples.r)
    assert (own.min(axis=0) >= problem.margin).all()


def test_constants_too_small_are_violated():
    field = SPIKES
    fair, small = (gap_problem(field, (3, 3, 3), route="theorem1", factor=f) for f in (1.0, 0.3))
    assert violations(Constant().fit(fair), field) == 0
    assert violations(Constant().fit(small), field) > 0


def test_the_margin_holds_the_resolution():
    field = Waves.smooth()
    problem = gap_problem(field, (4, 4, 4), route="theorem1", backend=Coarse(field, 0.1))
    without = replace(problem, resolution=np.zeros(2))
    assert (problem.resolution >= 0.05).all()
    assert problem.margin - without.margin == pytest.approx(2 * problem.resolution, rel=1e-12)
