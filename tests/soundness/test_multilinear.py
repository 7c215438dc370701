"""Attacks on interpolation with curvature: no violation with true bounds, and every ingredient is necessary."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rough_fields import Bump, Coarse

import gapcert as gc
from gapcert.certification.refutation import curvature_contradiction
from gapcert_bounds import MultilinearPredictor
from gapcert_bounds.families.multilinear import Multilinear, MultilinearGap
from gapcert_bounds.testing.fields import Field, Kink, Waves, gap_problem, lattice


def outside(gap, r, z):
    low, high = gap.interval(z)
    return int(((r < low) | (r > high)).any(axis=1).sum())


def drawn(seed):
    rng = np.random.default_rng(seed)
    return Waves(rng.normal(size=(2, 3)), rng.uniform(0, 8, (2, 3)), rng.uniform(-3, 3, (2, 3)), float(rng.normal()))


def refitted(problem, **changes):
    """The same nodes with other bounds of curvature, constants or resolution."""
    axes, bound = problem.samples.lattice, problem.lipschitz
    g = problem.remainder.reshape(*(len(a) for a in axes), -1)
    data = {"curvature": bound.curvature, "lipschitz": bound.value, "resolution": problem.remainder_resolution, **changes}
    data["curvature"] = [np.repeat(data["curvature"][:, j : j + 1], len(a) - 1, axis=1) for j, a in enumerate(axes)]
    return MultilinearGap(axes, g, predictor=problem.predictor, **data)


@pytest.mark.exam
@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    counts=st.tuples(st.integers(1, 6), st.integers(1, 6), st.integers(1, 6)),
    affine=st.booleans(),
)
def test_no_violation_with_true_bounds(seed, counts, affine):
    field = drawn(seed)
    gap = Multilinear().fit(gap_problem(field, counts, affine=affine))
    rng = np.random.default_rng(seed)
    z = np.concatenate([field.domain.draw(5_000, rng), lattice(field.domain, (5, 5, 5))])
    assert outside(gap, field(z), z) == 0
    size = rng.random(z.shape) * np.array([0.5, 0.05, 1e-3])[rng.integers(3, size=len(z))][:, None]
    boxes = gc.Interval(z, np.minimum(z + size, 1.0))
    inner = boxes.lo + rng.random(z.shape) * (boxes.hi - boxes.lo)
    over = gap.interval_over(boxes)
    assert over.contains(field(inner)).all()
    low, high = gap.interval(inner)
    assert ((over.lo <= low) & (high <= over.hi)).all()


def test_a_tenth_less_curvature_is_not_enough():
    """A parabola along one axis fills the whole band between nodes, so that no part of it is slack."""
    field = Parabola()
    z = field.domain.draw(20_000, np.random.default_rng(0))
    problem = gap_problem(field, (5, 4, 3))
    assert outside(Multilinear().fit(problem), field(z), z) == 0
    assert outside(refitted(problem, curvature=0.9 * problem.lipschitz.curvature), field(z), z) > 0
    assert outside(refitted(problem, curvature=0 * problem.lipschitz.curvature), field(z), z) > 0
    # At the middle of a cell the bound is reached.
    low, high = Multilinear().fit(problem).interval(np.array([[0.25, 0.0, 0.0]]))
    r = field(np.array([[0.25, 0.0, 0.0]]))
    assert (np.minimum(high - r, r - low) < 1e-12).all()


def test_where_curvature_is_unknown_the_constants_bound_what_is_missed():
    kink = Kink(np.array([[0.5, 0.25, 0.125], [0.3, 1.0, 0.5]]), np.array([0.11, -0.3, 0.2]))
    problem = gap_problem(kink, (6, 6, 6))
    unknown = np.full((2, 3), np.inf)
    z = kink.domain.draw(50_000, np.random.default_rng(1))
    assert outside(refitted(problem, curvature=unknown), kink(z), z) == 0
    # The kinks in the middle of cells reach it, so a tenth less is too little; and zero curvature is a lie.
    centred = Kink(kink.steepness, np.zeros(3))
    problem = gap_problem(centred, (6, 6, 6))
    z = centred.domain.draw(50_000, np.random.default_rng(1)) * 0.2
    assert outside(refitted(problem, curvature=unknown), centred(z), z) == 0
    assert outside(refitted(problem, curvature=unknown, lipschitz=0.9 * centred.constants), centred(z), z) > 0
    assert outside(refitted(problem, curvature=np.zeros((2, 3))), centred(z), z) > 0


def test_a_narrow_bump_between_the_nodes_needs_its_own_bounds():
    bump = Bump(Waves.smooth(), 0.5, 0.1, np.array([0.21, -0.4, 0.6]))
    problem = gap_problem(bump, (6, 6, 6))
    z = bump.centre + np.random.default_rng(0).uniform(-0.05, 0.05, (2_000, 3))
    unknown = np.full((2, 3), np.inf)
    assert outside(refitted(problem, curvature=unknown), bump(z), z) == 0
    assert outside(refitted(problem, curvature=Waves.smooth().curvature), bump(z), z) > 0


def test_the_resolution_counts_twice():
    """Answers in multiples of 1e-3: the nodes err by half of that, and so does the answer in between."""
    field = Parabola()
    coarse = Coarse(field, 1e-3)
    problem = gap_problem(field, (9, 5, 5), backend=coarse)
    z = field.domain.draw(100_000, np.random.default_rng(1))
    r = coarse.step(*field.domain.split(z)).x
    assert outside(Multilinear().fit(problem), r, z) == 0
    assert outside(refitted(problem, resolution=np.zeros(1)), r, z) > 0
    assert outside(refitted(problem, resolution=problem.resolution / 2), r, z) > 0


def test_nodes_refute_too_little_curvature():
    field = Parabola()
    assert curvature_contradiction(gap_problem(field, (5, 4, 3))) is None
    found = curvature_contradiction(gap_problem(field, (5, 4, 3), bent=0.9))
    assert found is not None
    assert found["state"] == 0
    assert curvature_contradiction(gap_problem(Coarse(field, 1e-3).field, (5, 4, 3), backend=Coarse(field, 1e-3))) is None


class Parabola(Field):
    """x0² along one axis, and straight along the others: nothing in its band is slack."""

    def __init__(self):
        super().__init__(1, 2)
        self.constants = np.array([[2.0, 0.5, 0.25]])
        self.curvature = np.array([[2.0, 0.0, 0.0]])

    def _step(self, x, u, **options):
        return x**2 + 0.5 * u[:, :1] + 0.25 * u[:, 1:]

    def enclosure(self, z):
        return z[:, :1] ** 2 + z[:, 1:2] * 0.5 + z[:, 2:3] * 0.25

    def jacobian_enclosure(self, z):
        rest = gc.Interval.exact(np.broadcast_to([0.5, 0.25], (len(z), 2)))
        return gc.Interval.concatenate([z[:, :1] * 2.0, rest], axis=1)[:, None, :]


@pytest.mark.parametrize("counts", [(1, 2, 3), (4, 1, 5), (3, 3, 3)])
def test_a_multilinear_predictor_is_what_it_says(counts):
    field = drawn(3)
    samples = gap_problem(field, (4, 5, 3)).samples
    rng = np.random.default_rng(2)
    axes = tuple(np.sort(rng.uniform(-1, 1, n)) for n in counts)
    p = MultilinearPredictor(axes, rng.normal(size=(*counts, 2)))
    z = field.domain.draw(500, rng)
    # Slow twin: one axis after the other by numpy's own interpolation.
    for k in range(0, 500, 50):
        for i in range(2):
            v = p.values[..., i]
            for a, x in zip(reversed(axes), z[k, ::-1], strict=True):
                v = np.apply_along_axis(lambda column, a=a, x=x: np.interp(x, a, column), -1, v)
            assert abs(p(z[k : k + 1])[0, i] - v) < 1e-13
    boxes = gc.Interval(z, z + rng.random(z.shape) * 0.7)
    inner = [boxes.lo + rng.random(z.shape) * (boxes.hi - boxes.lo) for _ in range(8)]
    over, slope = p.over(boxes), p.jacobian_over(boxes)
    values = [p(x) for x in inner]
    assert all(over.contains(v).all() for v in values)
    change = np.abs(values[0] - values[1])
    assert (change <= (slope.mag * np.abs(inner[0] - inner[1])[:, None]).sum(axis=2) + 1e-12).all()
    # Exact where a box lies in one cell, and elsewhere too: no wider than its corners and the nodes inside.
    fine = [boxes.lo + (boxes.hi - boxes.lo) * s for s in np.stack(np.meshgrid(*[[0, 1]] * 3), -1).reshape(-1, 3)]
    one = (np.searchsorted(axes[0], boxes.lo[:, 0]) == np.searchsorted(axes[0], boxes.hi[:, 0])) & True
    for j in (1, 2):
        one &= np.searchsorted(axes[j], boxes.lo[:, j]) == np.searchsorted(axes[j], boxes.hi[:, j])
    corner = np.stack([p(x) for x in fine])[:, one]
    assert one.any()
    assert np.allclose(corner.max(axis=0), over.hi[one], atol=1e-12)
    assert np.allclose(corner.min(axis=0), over.lo[one], atol=1e-12)
    fitted = MultilinearPredictor.fit(samples, field.domain)
    assert [len(a) for a in fitted.axes] == [3, 3, 3]
    assert (
        np.abs(samples.r - fitted(samples.z)).mean()
        < np.abs(samples.r - gc.plugin.AffinePredictor.fit(samples)(samples.z)).mean()
    )


class Steep(Field):
    """0.2 tanh(x0 / 0.1) + 0.3 u0², bent only near x0 = 0."""

    def __init__(self):
        super().__init__(1, 1)
        self.constants = np.array([[2.0, 0.6]]) * (1 + 1e-15)
        self.curvature = np.array([[80 / (3 * np.sqrt(3)), 0.6]]) * (1 + 1e-15)

    def _step(self, x, u, **options):
        return 0.2 * np.tanh(x / 0.1) + 0.3 * u**2

    enclosure = jacobian_enclosure = Kink.enclosure


def test_curvature_in_slabs_holds_and_cannot_be_put_elsewhere():
    field = Steep()
    cuts = np.array([-1.0, -0.4, -0.2, 0.0, 0.2, 0.4, 1.0])

    def bend(v):
        return 40 * np.tanh(v) / np.cosh(v) ** 2 * (1 + 1e-12)

    slab = bend(np.array([4.0, 2.0, np.arctanh(1 / np.sqrt(3)), np.arctanh(1 / np.sqrt(3)), 2.0, 4.0]))[None]
    z = field.domain.draw(50_000, np.random.default_rng(0))
    results = []
    for cut, several in ((cuts, slab), (cuts, None), (cuts + np.array([0, 0.25, 0.15, 0.1, 0.1, 0.1, 0]), slab)):
        slabs = None if several is None else ((cut, several), None)
        bound = gc.plugin.LipschitzBound(
            field.constants, 0 * field.constants, "analytic", "", curvature=field.curvature, slabs=slabs
        )
        plan = gc.LatticeSampling(budget=300)
        first = plan.first(field.domain).z
        nodes = plan.further(field.domain, first, field(first), bound.value, bound)
        samples = gc.plugin.Samples(nodes, field(nodes), lattice=tuple(np.unique(c) for c in nodes.T))
        e, p = np.full(1, 1e-14), gc.plugin.AffinePredictor.none(1, 2)
        problem = gc.plugin.GapProblem(samples, field.domain, bound, p, e, "dominate")
        gap = Multilinear("none").fit(problem)
        low, high = gap.interval(z)
        results.append((outside(gap, field(z), z), float((high - low).mean()), curvature_contradiction(problem)))
    assert [missed for missed, _, _ in results[:2]] == [0, 0]
    assert results[0][1] < 0.5 * results[1][1]
    assert results[0][2] is None
    assert results[2][0] > 0
