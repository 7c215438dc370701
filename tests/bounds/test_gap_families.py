"""The families envelope, constant and basis: their contracts, slow twins of the fast kernels, and answers to bad input."""

from __future__ import annotations

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rough_fields import Bump

import gapcert as gc
import gapcert_functions
from gapcert.plugin import AffinePredictor
from gapcert.testing import GapFamilyContract
from gapcert_bounds import stored
from gapcert_bounds.config import BasisConfig, ConstantConfig, EnvelopeConfig
from gapcert_bounds.families import cone
from gapcert_bounds.families.basis import Basis, own_slope, parse, shortfall
from gapcert_bounds.families.constant import Constant
from gapcert_bounds.families.envelope import Envelope, EnvelopeGap
from gapcert_bounds.families.multilinear import Multilinear
from gapcert_bounds.testing.fields import Kink, Waves, gap_problem, lattice

NAMES = ("x0", "x1", "u0")
WRITTEN = (
    "exp(-x0^2)",
    "tanh(20*x1)",
    "sin(x0 + 2*x1 - 0.5*u0)",
    "x0 - x1",
    "sqrt(x0 + 3)*abs(x1 - u0)",
    "log(4 + x0*x1)^3",
    "atan(5*u0)*x0",
    "(x0 + x1)^2",
)
FUNCTIONS = ("1", "x0", "x1^2", "sin(x0)", "cos(2*x1)", "abs(u0)", "abs(x0)*abs(u0)", "x0*u0^3*cos(x1)")


class TestEnvelope(GapFamilyContract):
    def family(self):
        return Envelope()


class TestEnvelopeWithoutPredictor(GapFamilyContract):
    points = 200

    def family(self):
        return Envelope("none")


class TestEnvelopeOfABump(GapFamilyContract):
    points = 200

    def family(self):
        return Envelope("none")

    def field(self):
        return Bump(Waves.smooth(), 0.5, 0.1, np.array([0.21, -0.4, 0.6]))


class TestConstant(GapFamilyContract):
    points = 200

    def family(self):
        return Constant()


class TestMultilinear(GapFamilyContract):
    points = 200

    def family(self):
        return Multilinear()


class TestMultilinearWithoutPredictor(GapFamilyContract):
    points = 200

    def family(self):
        return Multilinear("none")


class TestBasis(GapFamilyContract):
    points = 500

    def family(self):
        return Basis(FUNCTIONS, cells=(2, 2, 2))


class TestBasisOfExpressions(GapFamilyContract):
    points = 200

    def family(self):
        return Basis(("1", *WRITTEN), cells=(2, 2, 2), boxes=2000, predictor="affine")

    def problem(self, route):
        # Route theorem1 bounds r itself.
        return gap_problem(
            self.field(), (10, 10, 10) if route == "theorem1" else (6, 6, 6), route=route, affine=route != "theorem1"
        )


class TestBasisOfKinks(GapFamilyContract):
    points = 200

    def family(self):
        return Basis(("1", "abs(x0)", "abs(x1)", "abs(u0)"), cells=(2, 2, 2))

    def field(self):
        return Kink(np.array([[0.5, 0.25, 0.125], [0.0, 1.0, 0.5]]), np.zeros(3))


def textbook_band(problem, z):
    """l and u by loops over points, states and samples."""
    low, high = np.empty((len(z), problem.domain.nx)), np.empty((len(z), problem.domain.nx))
    g, e = problem.samples.r - problem.predictor(problem.samples.z), problem.resolution
    for n, point in enumerate(z):
        p = problem.predictor(point[None])[0]
        for i in range(problem.domain.nx):
            reach = [
                sum(c * abs(a - b) for c, a, b in zip(problem.lipschitz.value[i], point, s, strict=True))
                for s in problem.samples.z
            ]
            high[n, i] = p[i] + min(v + d for v, d in zip(g[:, i], reach, strict=True)) + 2 * e[i]
            low[n, i] = p[i] + max(v - d for v, d in zip(g[:, i], reach, strict=True)) - 2 * e[i]
    return low, high


@pytest.mark.parametrize("affine", [False, True])
def test_envelope_equals_its_textbook_twin(affine):
    problem = gap_problem(Waves.smooth(), (4, 5, 3), affine=affine)
    gap = Envelope().fit(problem)
    z = problem.domain.draw(60, np.random.default_rng(0))
    low, high = gap.interval(z)
    slow_low, slow_high = textbook_band(problem, z)
    assert (low <= slow_low).all()
    assert (high >= slow_high).all()
    assert np.allclose(low, slow_low, rtol=0, atol=1e-13)
    assert np.allclose(high, slow_high, rtol=0, atol=1e-13)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), samples=st.integers(1, 60), inert=st.booleans())
def test_cones_that_are_left_out_never_matter(seed, samples, inert):
    rng = np.random.default_rng(seed)
    z, g, slope = rng.uniform(-1, 1, (samples, 3)), rng.normal(size=(samples, 2)), rng.uniform(0, 3, (2, 3))
    slope[:, 1] *= not inert
    points = np.concatenate([rng.uniform(-1, 1, (3_000, 3)), z])
    low, high = cone.Cones(z, g, slope)(points)
    distance = np.zeros((len(points), samples))
    for i in range(2):
        distance[:] = 0
        for j in range(3):
            distance += np.abs(points[:, j, None] - z[:, j]) * slope[i, j]
        assert np.array_equal(high[:, i], (distance + g[:, i]).min(axis=1))
        assert np.array_equal(low[:, i], (g[:, i] - distance).max(axis=1))


def test_a_refuted_envelope_still_answers_over_boxes():
    problem = gap_problem(Kink(np.array([[0.5, 0.25, 0.125], [0.0, 1.0, 0.5]]), np.zeros(3)), (4, 4, 4), factor=0.5)
    gap = Envelope("none").fit(problem)
    z = problem.domain.draw(500, np.random.default_rng(0))
    low, high = gap.interval(z)
    assert (low > high).any()
    over = gap.interval_over(gc.Interval(z, np.minimum(z + 0.01, 1.0)))
    assert (over.lo <= over.hi).all()
    assert (gap.gamma_over(gc.Interval.exact(z)) >= gap.gamma(z) * (1 - 1e-12)).all()


def test_envelope_needs_a_sample():
    problem = gap_problem(Waves.smooth(), (2, 2, 2))
    with pytest.raises(gc.UsageError, match="there are no samples"):
        Envelope().fit(replace(problem, samples=gc.plugin.Samples(np.empty((0, 3)), np.empty((0, 2)))))


def test_constant_is_the_supremum_of_the_envelope():
    problem = gap_problem(Waves.smooth(), (6, 6, 6))
    gap = Envelope().fit(problem)
    upper, lower = gc.plugin.supremum(gap, problem.domain)
    assert (lower <= upper).all()
    assert (upper <= lower * 1.001).all()
    dense = gap.gamma(lattice(problem.domain, (41, 41, 41))).max(axis=0)
    assert (dense <= upper).all()
    assert (dense >= lower * 0.97).all()
    assert np.array_equal(Constant().fit(problem).value, upper)


def test_supremum_stays_proved_when_the_budget_ends():
    problem = gap_problem(Waves.smooth(), (6, 6, 6))
    gap = Envelope().fit(problem)
    rough, _ = gc.plugin.supremum(gap, problem.domain, budget=10)
    exact, _ = gc.plugin.supremum(gap, problem.domain)
    assert (rough >= exact / 1.001).all()
    assert (rough > exact).any()


def test_constant_on_route_theorem1_is_the_largest_sample_and_the_margin():
    problem = gap_problem(Waves.smooth(), (9, 9, 9), route="theorem1")
    expected = np.abs(problem.samples.r).max(axis=0) + problem.margin
    value = Constant().fit(problem).value
    assert (value >= expected).all()
    assert np.allclose(value, expected, rtol=1e-12)


def test_a_constant_that_no_float_holds_is_refused():
    """Constants of 1e160 are numbers, and their norm is not."""
    huge = gap_problem(Waves.smooth(), (5, 5, 5), route="theorem1")
    huge = replace(huge, lipschitz=replace(huge.lipschitz, value=np.full_like(huge.lipschitz.value, 1e160)))
    with pytest.raises(gc.UsageError, match=r"γ = \[inf.* is no bound: .*; narrow the domain"):
        Constant().fit(huge)


def test_theorem1_needs_a_cover_and_no_predictor():
    plain = gap_problem(Waves.smooth(), (5, 5, 5))
    with pytest.raises(gc.UsageError, match="no uniform cover; use `sampling"):
        Basis(("1",)).fit(replace(plain, route="theorem1"))
    affine = gap_problem(Waves.smooth(), (5, 5, 5), route="theorem1", affine=True)
    with pytest.raises(gc.UsageError, match="set it to none"):
        Constant().fit(affine)


def test_basis_reaches_the_optimum_that_all_constraints_give():
    """Constraint generation against one linear program that holds every sample at once."""
    from scipy.optimize import linprog

    problem = gap_problem(Waves.smooth(), (9, 9, 9), route="theorem1")
    gap = Basis(FUNCTIONS).fit(problem)
    domain, samples = problem.domain, problem.samples
    matrix = np.stack([t.value(samples.z) for t in gap.terms], axis=1)
    cost = np.array([t.mean(domain.interval) for t in gap.terms])
    radius = float(np.hypot(*samples.cover.radii()))
    objective = gap.weights @ cost + radius * own_slope(gap.terms, gap.weights, domain)
    for i in range(2):
        free = linprog(cost, A_ub=-matrix, b_ub=-np.abs(samples.r[:, i]), bounds=[(None, None)] * len(cost))
        # Without the slope's cost the integral is smaller, and with it the same weights cost at least our optimum.
        assert free.fun <= gap.weights[i] @ cost + 1e-9
        priced = cost @ free.x + radius * own_slope(gap.terms, free.x[None], domain)[0]
        assert objective[i] <= priced + 1e-6
    assert (shortfall(gap.terms, gap.weights, samples).max(axis=0) <= 1e-6).all()


def test_basis_names_functions_that_dominate_nothing():
    with pytest.raises(gc.UsageError, match="no combination of the functions dominates the samples; add the function '1'"):
        Basis(("sin(x0)",)).fit(gap_problem(Waves.smooth(), (5, 5, 5), route="theorem1"))


@pytest.mark.parametrize("text", [*FUNCTIONS, *WRITTEN])
def test_terms_bound_their_values_and_slopes(text):
    term, rng = parse(text, NAMES), np.random.default_rng(5)
    low = rng.uniform(-2, 1.5, (200, 3))
    boxes = gc.Interval(low, low + rng.uniform(0, 0.8, low.shape))
    over, slopes = term.over(boxes), [term.derivative_over(boxes, j) for j in range(3)]
    step = 1e-6
    for _ in range(10):
        z = boxes.lo + rng.random(low.shape) * (boxes.hi - boxes.lo)
        assert over.contains(term.value(z)).all()
        for j in range(3):
            moved = z + np.eye(3)[j] * step
            inside = (moved <= boxes.hi).all(axis=1)
            slope = (term.value(moved) - term.value(z)) / step
            assert (slope[inside] <= slopes[j].hi[inside] + 1e-6).all()
            assert (slope[inside] >= slopes[j].lo[inside] - 1e-6).all()


@pytest.mark.parametrize("text", [*FUNCTIONS, *WRITTEN])
def test_terms_know_their_mean(text):
    box = gc.Box(tuple(gc.StateSpec(n) for n in NAMES[:2]), (-0.7, 0.2), (1.1, 1.5))
    domain = gc.Domain(box, gc.Box((gc.StateSpec("u0"),), (-1.0,), (0.4,)))
    term = parse(text, NAMES)
    cover = gc.plugin.Cover(domain, (60, 60, 60))
    assert term.mean(domain.interval) == pytest.approx(term.value(cover.chunk(0, len(cover))).mean(), abs=2e-3)


@pytest.mark.parametrize(
    ("text", "message", "offset"),
    [
        ("1/x0", "quotient", 1),
        ("x0/x1", "quotient", 2),
        ("x0*tan(x1)", "tan has poles", 3),
        ("sinh(x0)", "not in the set", 0),
        ("sin(x0", "cannot be read at 'its end'", 6),
        ("x0^-1", "exponent '-1' is no whole number", 3),
        ("x0^0.5", "exponent '0.5'", 3),
        ("x0 + ", "cannot be read at 'its end'", 5),
        ("x0 x1", "cannot be read at 'x1'", 3),
        ("3*x0", "gets its own weight", 0),
        ("-x0", "gets its own weight", 1),
        ("x0*", "cannot be read at 'its end'", 3),
        ("", "cannot be read at 'its end'", 0),
        ("sin()", r"cannot be read at '\)'", 4),
        ("__import__('os')", "not in the set", 0),
    ],
)
def test_functions_that_cannot_be_bounded_are_refused(text, message, offset):
    with pytest.raises(gc.UsageError, match=message):
        parse(text, NAMES)
    ((path, said, at),) = BasisConfig(kind="basis", functions=["1", text]).check()
    assert path == ("functions", 1)
    assert at == offset
    assert said


def test_unknown_names_are_suggested():
    with pytest.raises(gc.UsageError, match=r"'thta' is no state or input; did you mean 'theta'\?"):
        parse("sin(thta)", ("theta", "omega"))


def test_powers_of_one_axis_are_one_power():
    assert parse("x0*x0", NAMES).over(gc.Interval(np.array([[-1.0, 0, 0]]), np.array([[1.0, 0, 0]]))).lo[0] >= -1e-300
    assert [f.kind for f in parse("sin(x0)^2 * abs(x1)**3", NAMES).factors] == ["abs", "sin", "sin"]


def test_weighted_sum_is_within_its_stated_error():
    """Against extended precision."""
    terms, rng = [parse(t, NAMES) for t in FUNCTIONS[:6]], np.random.default_rng(1)
    domain = Waves.smooth().domain
    z, w = domain.draw(500, rng), rng.normal(size=(2, 6))
    x0, x1, u0 = z.astype(np.longdouble).T
    exact = w.astype(np.longdouble) @ np.stack([np.ones(500), x0, x1**2, np.sin(x0), np.cos(2 * x1), np.abs(u0)])
    error = np.abs(gapcert_functions.weighted(terms, w, z).T - exact).max(axis=1)
    stated = np.abs(w) @ np.array([t.error(domain.interval) for t in terms]) + 16 * np.finfo(float).eps * np.abs(w).sum(axis=1)
    assert (error <= stated).all()
    assert (stated <= 1e-13).all()


@pytest.mark.parametrize("text", ["log(x0)", "sqrt(x0 + 1)", "exp(800*x0)*exp(800*x0)", "atan(log(x0))", "sqrt(x0 + 0.5)*x1"])
@pytest.mark.parametrize("route", Basis.routes)
def test_functions_that_are_unbounded_on_the_domain_are_refused(text, route):
    with pytest.raises(gc.UsageError, match="unbounded on the domain's box"):
        Basis(("1", text)).fit(gap_problem(Waves.smooth(), (3, 3, 3), route=route))


@pytest.mark.parametrize("text", WRITTEN)
def test_expressions_are_within_their_stated_error(text):
    """Against extended precision."""
    expression, domain = parse(text, NAMES), Waves.smooth().domain
    z = domain.draw(2000, np.random.default_rng(3))
    at = dict(zip(NAMES, z.astype(np.longdouble).T, strict=True))
    functions = {
        "exp": np.exp,
        "tanh": np.tanh,
        "sin": np.sin,
        "sqrt": np.sqrt,
        "abs": np.abs,
        "log": np.log,
        "atan": np.arctan,
    }
    exact = eval(text.replace("^", "**"), {"__builtins__": {}}, at | functions)
    error = np.abs(expression.value(z) - exact).max()
    assert error <= expression.error(domain.interval) <= 1e-12


@pytest.mark.parametrize("data", [["axis", -1], ["+"], ["^", 1.0, 0], ["sinh", 1.0], "x0", float("nan"), ["sin", 1.0, 2.0]])
def test_malformed_expressions_are_refused(data):
    with pytest.raises(ValueError, match="is no expression"):
        gapcert_functions.Expression("", data)


@pytest.mark.exam
def test_basis_over_the_envelope_beats_the_published_route():
    """On as many samples: no slope of γ enters, and shifts are local."""
    z = Waves.smooth().domain.draw(5000, np.random.default_rng(0))
    gaps = [Basis(FUNCTIONS).fit(gap_problem(Waves.smooth(), (12, 12, 12), route=route)) for route in Basis.routes]
    published, lifted = (gap.gamma(z).mean() for gap in gaps)
    assert lifted < 0.7 * published


def test_basis_tables_have_a_count_per_axis():
    with pytest.raises(gc.UsageError, match=r"gap.cells: found \[2, 2\]; expected one number per axis, that is 3"):
        Basis(("1",), cells=(2, 2)).fit(gap_problem(Waves.smooth(), (3, 3, 3)))


def test_options():
    assert EnvelopeConfig(kind="envelope").predictor == "affine"
    assert EnvelopeConfig.model_validate({"kind": "envelope", "predictor": {"model": "a.yaml"}}).predictor.model == "a.yaml"
    assert ConstantConfig(kind="constant").predictor == "none"
    for name in ("constant", "envelope", "basis"):
        assert gc.registry().get("gap_family", name).missing() is None
    with pytest.raises(ValueError, match="functions"):
        BasisConfig(kind="basis", functions=[])
    with pytest.raises(ValueError, match="predictor"):
        BasisConfig(kind="basis", functions=["1"], predictor="multilinear")


@pytest.mark.parametrize("nz", [1, 2, 3, 9, 17])
@pytest.mark.parametrize("kind", ["affine", "none"])
def test_an_envelope_of_one_point_has_the_bits_of_many(nz: int, kind: str) -> None:
    rng = np.random.default_rng(nz)
    nx, count = 3, 1 + 40 * nz
    z, g, L = rng.uniform(-1, 1, (count, nz)), rng.normal(size=(count, nx)), rng.exponential(size=(nx, nz))
    L[rng.random((nx, nz)) < 0.2] = 0.0
    none = AffinePredictor.none(nx, nz)
    p = none if kind == "none" else AffinePredictor(rng.normal(size=nx), rng.normal(size=(nx, nz)))
    gap = EnvelopeGap(z, g, L, np.abs(1e-9 * rng.normal(size=nx)), p)
    points = np.vstack([rng.uniform(-1, 1, (60, nz)), z[:10], np.zeros((1, nz))])
    low, high = gap.interval(points)
    for k in range(len(points)):
        one = gap.interval(points[k : k + 1])
        assert np.array_equal(one[0][0], low[k])
        assert np.array_equal(one[1][0], high[k])


@pytest.mark.parametrize("affine", [False, True])
@pytest.mark.parametrize("family", [Envelope(), Constant(), Multilinear(), Basis(FUNCTIONS)], ids=lambda f: f.name)
def test_what_was_saved_answers_to_the_same_bits(family, affine: bool) -> None:
    route = "theorem1" if family.name == "basis" else "dominate"
    problem = gap_problem(Waves.smooth(), (5, 4, 3), route=route, affine=affine and route == "dominate")
    made, file = family.fit(problem), io.BytesIO()
    np.savez(file, **made.arrays())
    file.seek(0)
    again = stored(json.loads(json.dumps(made.form)), np.load(file), problem.domain.zone)
    z = problem.domain.draw(300, np.random.default_rng(11))
    for points in (z, z[:1]):
        assert all(np.array_equal(a, b) for a, b in zip(made.interval(points), again.interval(points), strict=True))
