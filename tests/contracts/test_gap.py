"""Predictors: ranges contain values, slopes are exact, and an extended model's range is as narrow as its difference."""

from __future__ import annotations

import numpy as np
import pytest

import gapcert as gc
from gapcert_bounds.testing.fields import Kink, Nothing, Waves, gap_problem


def boxes(domain, n=300, size=0.2):
    rng = np.random.default_rng(0)
    z = domain.draw(n, rng)
    return gc.Interval(z, np.minimum(z + size * rng.random(z.shape), domain.high))


def predictors():
    field = Waves.smooth()
    problem = gap_problem(field, (5, 5, 5), affine=True)
    return field.domain, [
        problem.predictor,
        gc.plugin.AffinePredictor.none(2, 3),
        gc.plugin.ModelPredictor(field, Nothing(field)),
    ]


@pytest.mark.parametrize("k", range(3))
def test_ranges_contain_values_and_slopes(k):
    domain, all_of_them = predictors()
    p, over = all_of_them[k], boxes(domain)
    rng, step = np.random.default_rng(1), 1e-6
    slopes = p.jacobian_over(over)
    for _ in range(10):
        z = over.lo + rng.random(over.shape) * (over.hi - over.lo)
        e = p.resolution(domain)
        inside = p.over(over)
        assert ((inside.lo - e <= p(z)) & (p(z) <= inside.hi + e)).all()
        for j in range(3):
            moved = (p(z + step * np.eye(3)[j]) - p(z)) / step
            assert (moved >= slopes.lo[:, :, j] - 1e-5).all()
            assert (moved <= slopes.hi[:, :, j] + 1e-5).all()


def test_affine_resolution_bounds_its_rounding():
    rng = np.random.default_rng(2)
    domain = Waves.smooth().domain
    p = gc.plugin.AffinePredictor(rng.normal(size=2), rng.normal(size=(2, 3)))
    z = domain.draw(5_000, rng)
    exact = p.offset.astype(np.longdouble) + z.astype(np.longdouble) @ p.slope.astype(np.longdouble).T
    error = np.abs(p(z) - exact).max(axis=0)
    assert (error > 0).all()
    assert (error <= p.resolution(domain)).all()
    assert (p.resolution(domain) <= 1e-14).all()


def test_affine_fit_of_an_affine_residual_leaves_nothing():
    field = Kink(np.array([[0.5, 0.25, 0.125], [0.3, 1.0, 0.5]]), np.full(3, -2.0))
    problem = gap_problem(field, (4, 4, 4), affine=True)
    assert np.abs(problem.remainder).max() < 1e-14
    assert np.allclose(problem.predictor.slope, field.steepness, atol=1e-13)


class Shifted(gc.Model):
    """x⁺ of another model plus a little of its own: nearly equal models whose difference is small."""

    def __init__(self, base, share):
        self.base, self.share = base, share
        self.states, self.inputs, self.outputs, self.period = base.states, base.inputs, base.outputs, base.period

    def _step(self, x, u, **options):
        return self.base.step(x, u).x * (1 + self.share)

    def enclosure(self, z):
        return self.base.enclosure(z) * (1 + self.share)

    def jacobian_enclosure(self, z):
        return self.base.jacobian_enclosure(z) * (1 + self.share)

    def jacobian(self, x, u):
        return self.base.jacobian(x, u) * (1 + self.share)

    extend = equations = to_spec = sites = None


def test_the_range_of_a_model_predictor_shrinks_with_the_square_of_the_box():
    field = Waves.smooth()
    p = gc.plugin.ModelPredictor(Shifted(field, 1e-3), field)

    def width(size):
        return p.over(boxes(field.domain, size=size)).width.max()

    def plain(size):
        b = boxes(field.domain, size=size)
        return (p.extended.enclosure(b) - p.nominal.enclosure(b)).width.max()

    assert width(1e-3) < 0.05 * plain(1e-3)
    assert width(1e-2) < 0.5 * plain(1e-2)


def test_gamma_is_the_larger_side_of_one_point_or_many():
    problem = gap_problem(Waves.smooth(), (3, 3, 3))
    gap = gc.registry().build("gap_family", "envelope").fit(problem)
    z = problem.domain.draw(7, np.random.default_rng(0))
    assert gap.gamma(z).shape == (7, 2)
    assert np.array_equal(gap.gamma(z[0]), gap.gamma(z)[:1])


def test_joint_constants_are_rounded_up():
    bound = gc.plugin.LipschitzBound(np.array([[3.0, 4.0, 0.1]]), np.zeros((1, 3)), "declared", "declared")
    assert bound.joint(slice(None, 2))[0] >= 5.0
    assert bound.joint(slice(None, 2))[0] == pytest.approx(5.0, rel=1e-14)
    with pytest.raises(gc.UsageError, match="negative or non-finite"):
        gc.plugin.LipschitzBound(np.array([[-1.0]]), np.zeros((1, 1)), "declared", "declared")
