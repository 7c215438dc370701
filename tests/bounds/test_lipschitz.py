"""The estimators declared, interval and wood-zhang: their contracts, a textbook twin of the fit, and what they refuse."""

from __future__ import annotations

import re
import time
from dataclasses import replace

import numpy as np
import pytest
from rough_fields import Bump, Coarse
from scipy import stats

import gapcert as gc
from gapcert.plugin import AffinePredictor, LipschitzProblem, Residual
from gapcert.testing import LipschitzContract
from gapcert_bounds.config import DeclaredConfig, WoodZhangConfig
from gapcert_bounds.constants.declared_constants import Declared
from gapcert_bounds.constants.interval import IntervalJacobian
from gapcert_bounds.constants.wood_zhang import ReverseWeibull, WoodZhang
from gapcert_bounds.testing.fields import Kink, Nothing, Waves, lipschitz_problem

VALUES = {"x0": {"x0": 0.5, "x1": 0.25, "u0": 0.125}, "x1": {"x0": 0.0, "x1": 1.0, "u0": 0.5}}


class TestDeclared(LipschitzContract):
    def estimator(self):
        return Declared(VALUES)


class TestInterval(LipschitzContract):
    def estimator(self):
        return IntervalJacobian()


class TestIntervalOfWaves(LipschitzContract):
    def estimator(self):
        return IntervalJacobian(512)

    def field(self):
        return Waves.smooth()


class TestIntervalOfCells(LipschitzContract):
    def estimator(self):
        return IntervalJacobian(512, cells=8)

    def field(self):
        return Waves.smooth()


class TestIntervalOfCurvature(LipschitzContract):
    def estimator(self):
        return IntervalJacobian(512, curvature=True, slabs=4)

    def field(self):
        return Waves.smooth()


class TestWoodZhang(LipschitzContract):
    def estimator(self):
        return WoodZhang()


class TestWoodZhangOfWaves(LipschitzContract):
    def estimator(self):
        return WoodZhang(pairs=500)

    def field(self):
        return Waves.smooth()


def test_declared_constants_are_found_by_name_in_any_order():
    shuffled = {"x1": dict(reversed(VALUES["x1"].items())), "x0": VALUES["x0"]}
    bound = Declared(shuffled).bound(lipschitz_problem(Kink(np.zeros((2, 3)), np.zeros(3))))
    assert bound.value.tolist() == [[0.5, 0.25, 0.125], [0.0, 1.0, 0.5]]
    assert bound.provenance == "declared"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"x0": VALUES["x0"]}, "lipschitz.values: no entry for state 'x1'"),
        ({**VALUES, "xx1": {}}, r"'xx1' is no state of the problem; did you mean 'x1'\?"),
        ({**VALUES, "x1": {"x0": 1.0, "x1": 1.0}}, "lipschitz.values.x1: no entry for axis 'u0'"),
        ({**VALUES, "x1": {**VALUES["x1"], "torque": 1.0}}, "'torque' is no axis of the problem; there are x0, x1, u0"),
    ],
)
def test_declared_constants_must_be_complete(values, message):
    with pytest.raises(gc.UsageError, match=message):
        Declared(values).bound(lipschitz_problem(Waves.smooth()))


def test_options_are_checked():
    with pytest.raises(ValueError, match="greater than or equal to 0"):
        DeclaredConfig(kind="declared", values={"x": {"x": -1}})
    with pytest.raises(ValueError, match="safety"):
        WoodZhangConfig(kind="wood-zhang", safety=0)
    with pytest.raises(gc.UsageError, match="30 pairs make no 20 batches; give at least 40 pairs"):
        WoodZhang(pairs=30, batches=20)
    assert gc.registry().get("lipschitz", "wood-zhang").claim == "statistical"


def test_interval_constants_approach_the_exact_ones():
    field = Waves.smooth()
    rough, fine = (IntervalJacobian(n).bound(lipschitz_problem(field)).value for n in (1, 4096))
    assert (rough >= fine).all()
    assert (fine >= field.constants * (1 - 1e-12)).all()
    assert np.allclose(fine, field.constants, rtol=2e-3)


def test_interval_subtracts_an_affine_predictor_exactly():
    kink = Kink(np.array([[0.5, 0.25], [0.5, 0.5]]), np.array([-2.0, 2.0]))
    p = gc.plugin.AffinePredictor(np.zeros(2), np.array([[0.5, -0.25], [0.25, 0.0]]))
    # Both kinks lie outside the domain, where the field is affine with slopes +a and −a.
    bound = IntervalJacobian().bound(lipschitz_problem(kink, predictor=p))
    assert np.allclose(bound.value, [[0, 0], [0.25, 0.5]], atol=1e-15)
    assert np.allclose(bound.lower, [[0, 0], [0.25, 0.5]], atol=1e-15)


def test_interval_subtracts_a_model_predictor():
    field = Waves.smooth()
    p = gc.plugin.ModelPredictor(field, Nothing(field))
    value = IntervalJacobian(4096).bound(lipschitz_problem(field, predictor=p)).value
    assert (value <= 0.8 * field.constants).all()


def test_interval_needs_a_white_box():
    with pytest.raises(gc.UsageError, match="black box, and interval bounds need its equations"):
        IntervalJacobian().bound(lipschitz_problem(Waves.smooth(), backend=Coarse(Waves.smooth(), 1e-9)))


def test_interval_refuses_angles_that_may_wrap():
    field = Waves(np.array([[4.0, 0.0]]), np.array([[2.0, 2.0]]), np.zeros((1, 2)))
    field.states = (gc.StateSpec("x0", "rad", "angle"),)
    with pytest.raises(gc.UsageError, match="residual of angle 'x0' may reach"):
        IntervalJacobian().bound(lipschitz_problem(field))


def textbook_location(x):
    """Reverse Weibull with shape ≥ 1 by brute force over locations and shapes; the best scale is the k-th power mean."""
    best, at = -np.inf, x.max()
    for location in x.max() + np.ptp(x) * np.concatenate([[1e-9], np.geomspace(1e-4, 30, 300)]):
        for k in np.geomspace(1, 60, 60):
            scale = np.mean((location - x) ** k) ** (1 / k)
            y = (location - x) / scale
            likelihood = np.sum(np.log(k / scale) + (k - 1) * np.log(y) - y**k)
            if likelihood > best:
                best, at = likelihood, location
    return at, best


@pytest.mark.exam
@pytest.mark.parametrize("shape", [0.7, 1.5, 2.5, 4.0])
def test_weibull_fit_equals_its_textbook_twin(shape):
    x = stats.weibull_max(shape, loc=3, scale=0.5).rvs(size=(1, 50), random_state=np.random.default_rng(int(10 * shape)))
    fit = ReverseWeibull.fit(x)
    for k, row in enumerate(x):
        location, likelihood = textbook_location(row)
        ours = stats.weibull_max.logpdf(row, max(fit.shape[k], 1.0), loc=fit.location[k] + 1e-12, scale=fit.scale[k]).sum()
        assert ours >= likelihood - 1e-3
        assert fit.location[k] == pytest.approx(location, abs=0.05 * np.ptp(row))
        assert fit.location[k] >= row.max()
        assert fit.upper[k] >= fit.location[k]
        distance = stats.kstest(row, stats.weibull_max(fit.shape[k], loc=fit.location[k], scale=fit.scale[k]).cdf)
        assert fit.ks[k] == pytest.approx(distance.statistic, abs=1e-6)
        assert fit.p_value[k] == pytest.approx(distance.pvalue, abs=0.02)


def test_weibull_recovers_parameters_from_many_values():
    x = stats.weibull_max(2.5, loc=3, scale=0.5).rvs(size=(1, 4_000), random_state=np.random.default_rng(1))
    fit = ReverseWeibull.fit(x)
    assert fit.location[0] == pytest.approx(3, abs=0.05)
    assert fit.shape[0] == pytest.approx(2.5, abs=0.3)
    assert fit.upper[0] >= 3


def test_weibull_of_equal_values_is_that_value():
    fit = ReverseWeibull.fit(np.array([[2.0] * 30, [0.0] * 30]))
    assert fit.location.tolist() == [2.0, 0.0]
    assert np.isnan(fit.shape).all()


def test_wood_zhang_as_published_falls_below_the_truth_in_many_trials():
    """The safety factor is necessary: without it most trials claim too little, with it none does on these fields."""
    field = Waves.smooth()
    bare = np.array([WoodZhang(safety=1.0).bound(lipschitz_problem(field, seed=s)).value for s in range(20)])
    below = (bare < field.constants).any(axis=(1, 2)).mean()
    assert below >= 0.5
    assert (bare * 1.2 >= field.constants).all()


def test_no_safety_factor_saves_wood_zhang_from_a_narrow_bump():
    field = Bump(Waves.smooth(), 0.03, 0.03, np.array([0.31, -0.4, 0.6]))
    values = np.array([WoodZhang().bound(lipschitz_problem(field, seed=s)).value for s in range(10)])
    assert (values < field.constants).any(axis=(1, 2)).mean() >= 0.5


def test_wood_zhang_multiplies_by_its_safety():
    problem = lipschitz_problem(Waves.smooth(), seed=3)
    plain, doubled = WoodZhang(safety=1).bound(problem), WoodZhang(safety=2).bound(problem)
    assert np.allclose(doubled.value, 2 * plain.value)
    assert np.array_equal(doubled.lower, plain.lower)
    assert doubled.safety == 2
    # Pairs, and those of the sweep: per state and axis 4 pairs at 3 distances, and per axis 4 random ones at 7.
    assert plain.samples == 2 * 2500 * 3 + 6 * 4 * (2 + 5 + 5) + 3 * 4 * 7 * 2


def test_a_fit_that_runs_away_is_cut_at_twice_the_largest_slope():
    rng = np.random.default_rng(1)
    waves = Waves(rng.uniform(0.2, 1, (1, 3)), rng.uniform(1, 6, (1, 3)), rng.uniform(0, 6, (1, 3)))
    narrow = Bump(waves, 0.5, 0.25, rng.uniform(-0.5, 0.5, 3))
    bound = WoodZhang(safety=1.2, pairs=1000, batches=20).bound(lipschitz_problem(narrow, seed=1))
    seen = np.array([[bound.diagnostics[a]["largest_slope"][0] for a in ("x0", "u0", "u1")]])
    location = np.array([[bound.diagnostics[a]["location"][0] for a in ("x0", "u0", "u1")]])
    assert (location > 10 * seen).any(), "there is nothing to cut"
    assert np.allclose(bound.value, 1.2 * np.clip(location, seen, 2 * seen))


def test_wood_zhang_reports_its_fit():
    report = WoodZhang().bound(lipschitz_problem(Waves.smooth())).diagnostics["x0"]
    for i in range(2):
        assert report["location"][i] >= report["largest_slope"][i]
        assert report["shape"][i] >= 1
        assert 0 <= report["p_value"][i] <= 1
        assert report["profile_limit_95"][i] is None or report["profile_limit_95"][i] >= report["location"][i]
    assert "no confidence bound" in report["note"]


def test_pairs_too_close_for_the_resolution_are_refused_with_a_distance_that_works():
    problem = lipschitz_problem(Waves.smooth(), backend=Coarse(Waves.smooth(), 1e-5))
    distance = 1e-4
    for _ in range(9):  # the next state or axis may need a longer distance than the one that was named
        try:
            bound = WoodZhang(distance=distance).bound(problem)
        except gc.UsageError as refused:
            advice = re.search(r"too close for 'x\d'.*set distance: (0\.\d+)$", str(refused))
            distance = max(float(advice[1]), 1.01 * distance)
    assert 1e-3 < distance < 0.1
    assert (bound.lower <= Waves.smooth().constants).all()


def test_an_inert_axis_gets_what_the_resolution_may_hide():
    field = Kink(np.array([[0.5, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.zeros(3))
    problem = lipschitz_problem(field)
    bound = WoodZhang().bound(problem)
    assert bound.diagnostics["u0"]["inert"] == [True, True]
    assert (bound.lower[:, 2] == 0).all()
    expected = 4 * problem.resolution / (0.5e-2 * 2)
    assert (bound.value[:, 2] <= expected * (1 + 1e-9)).all()
    assert (bound.value[:, 2] >= expected / 2).all()


def test_slopes_are_of_the_distance_that_floating_point_realised():
    """Far from zero, z + δ − z is not δ; the constants of a linear residual must still come out to the last digits."""
    field = Kink(np.array([[0.5, 0.25]]), np.zeros(2))
    far = gc.Domain(gc.Box(field.states, (1e6,), (1e6 + 1e-3,)), gc.Box(field.inputs, (1e6,), (1e6 + 1e-3,)))

    def query(name, z):
        return (z - 1e6) @ np.array([[0.5], [0.25]])

    problem = replace(lipschitz_problem(field), domain=far, query=query, resolution=np.array([1e-20]))
    bound = WoodZhang(safety=1, distance=1e-6).bound(problem)
    assert np.allclose(bound.value, [[0.5, 0.25]], rtol=1e-6)


def test_wood_zhang_is_fast():
    problem = lipschitz_problem(Waves.smooth())
    WoodZhang().bound(problem)
    start = time.process_time()
    WoodZhang().bound(problem)
    assert time.process_time() - start < 1.5


def beside_straight(text):
    """The problem of v⁺ = text beside v⁺ = 0.4 v."""
    section = {"kind": "equations", "states": {"v": "1"}, "inputs": {"u": "1"}, "period": "0.1 s"}
    known = gc.registry()
    config = known.config("model", "equations")
    f, fhat = (known.build("model", "equations", config.model_validate(section | {"next": {"v": t}})) for t in ("0.4*v", text))
    domain, r = gc.Domain.of(f, {"v": (-1.0, 1.0), "u": (-1.0, 1.0)}), Residual(fhat, f)
    return LipschitzProblem(domain, AffinePredictor.none(1, 2), np.full(1, 1e-15), lambda name, z: r(z), f, fhat)


@pytest.mark.parametrize(
    "text",
    ["0.4*v + 0.2/(v*v - 1.1*v + 0.5 + 0.1*u)", "0.4*v + 0.3*log(v*v - v + 0.45 + 0.05*u)"],
    ids=["quotient", "logarithm"],
)
def test_slopes_that_are_infinite_over_the_whole_are_bounded_in_its_parts(text):
    problem = beside_straight(text)
    domain, r = problem.domain, Residual(problem.backend, problem.model)
    assert np.isinf(problem.backend.jacobian_enclosure(domain.interval).mag).any()
    found = IntervalJacobian().bound(problem)
    z, h = domain.draw(20_000, np.random.default_rng(5)), 1e-6
    seen = np.array([np.abs(r(z + h * e) - r(z - h * e)).max() / (2 * h) for e in np.eye(2)])
    assert (seen <= found.value[0] + 1e-8).all()
    assert (found.value[0] <= 1.6 * seen).all()


def test_slopes_that_are_infinite_somewhere_are_refused():
    with pytest.raises(gc.UsageError, match="∂v/∂v is unbounded on the domain"):
        IntervalJacobian().bound(beside_straight("0.4*v + 0.1*sqrt(abs(v))"))
