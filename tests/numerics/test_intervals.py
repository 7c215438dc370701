"""Every operation contains every image; a single inward step of rounding is noticed."""

from fractions import Fraction

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gapcert.numerics import intervals
from gapcert.numerics.intervals import Interval

numbers = st.floats(-1e3, 1e3) | st.floats(-1e-3, 1e-3) | st.sampled_from([0.0, 1.0, -1.0, 0.1, 3.0])
shares = st.lists(st.floats(0, 1), min_size=3, max_size=3)

BINARY = {
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": lambda a, b: a / b,
}
UNARY = ["sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "arctan", "arcsin", "arccos", "sign", "abs"]


@st.composite
def boxes(draw: st.DrawFn) -> tuple[Interval, list[float]]:
    a, b = sorted((draw(numbers), draw(numbers)))
    inside = [min(max(a + s * (b - a), a), b) for s in draw(shares)]
    return Interval(np.array([a]), np.array([b])), [a, b, *inside]


def holds(interval: Interval, value: Fraction) -> bool:
    """Exact comparison of a rational number with the ends of an interval of one element."""
    lo, hi = float(interval.lo[0]), float(interval.hi[0])
    return (lo == -np.inf or Fraction(lo) <= value) and (hi == np.inf or value <= Fraction(hi))


@pytest.mark.parametrize("name", BINARY)
@given(boxes(), boxes())
@settings(max_examples=150, derandomize=True)
def test_arithmetic_contains_the_exact_rational_result(name, left, right):
    operation = BINARY[name]
    (x, xs), (y, ys) = left, right
    z = operation(x, y)
    for a in xs:
        for b in ys:
            if name == "/" and b == 0:
                continue
            assert holds(z, operation(Fraction(a), Fraction(b)))


@pytest.mark.parametrize("n", [-3, -2, -1, 0, 1, 2, 3, 4, 7])
@given(boxes())
@settings(max_examples=60, derandomize=True)
def test_integer_powers_contain_the_exact_result(n, left):
    x, xs = left
    for a in xs:
        if a != 0 or n >= 0:
            assert holds(x**n, Fraction(a) ** n)
    assert n % 2 or n < 0 or x.__pow__(n).lo[0] >= 0


@pytest.mark.exam
@pytest.mark.parametrize("name", UNARY)
@given(boxes())
@settings(max_examples=150, derandomize=True)
def test_functions_contain_every_image(name, left):
    x, xs = left
    image = abs(x) if name == "abs" else getattr(x, name)()
    points = np.array(xs)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        values = getattr(np, name)(points)
    assert image.contains(values[~np.isnan(values)]).all()


@pytest.mark.parametrize("name", ["sin", "cos", "tan", "exp", "log", "tanh", "arctan"])
def test_library_functions_contain_the_true_value(name):
    """Against 40 digits, near zeros and poles of the circular functions too."""
    rng = np.random.default_rng(0)
    near = np.arange(-40, 41) * np.pi / 2
    points = np.concatenate([near, np.nextafter(near, 9e9), rng.uniform(-700, 700, 300), rng.normal(0, 1e-8, 50)])
    if name == "log":
        points = np.abs(points[points != 0])
    image = getattr(Interval.exact(points), name)()
    reference = {"arctan": mpmath.atan}.get(name) or getattr(mpmath, name)
    with mpmath.workdps(40):
        for lo, hi, p in zip(image.lo, image.hi, points, strict=True):
            assert lo <= reference(mpmath.mpf(float(p))) <= hi
    assert np.isfinite(image.lo).all() or name == "tan"


@pytest.mark.parametrize("name", ["sin", "cos"])
def test_interior_extrema(name):
    rng = np.random.default_rng(1)
    lo = rng.uniform(-30, 30, 4000)
    hi = lo + rng.choice([0.01, 1.0, 4.0, 7.0], 4000)
    image = getattr(Interval(lo, hi), name)()
    inside = getattr(np, name)(lo + (hi - lo) * np.linspace(0, 1, 200)[:, None])
    assert image.contains(inside).all()
    assert (image.width <= np.ptp(inside, axis=0) + 2e-3).all()


@pytest.mark.parametrize("value", [1e300, -(2.0**60), np.inf])
def test_huge_arguments_of_circular_functions_know_nothing(value):
    x = Interval.hull(value, value)
    assert (x.sin().lo, x.sin().hi) == (-1.0, 1.0)
    assert (x.tan().lo, x.tan().hi) == (-np.inf, np.inf)


def test_division_by_zero_and_infinities():
    assert (1.0 / Interval(-1.0, 1.0)).width == np.inf
    whole = Interval(-np.inf, np.inf)
    for z in (
        whole - whole,
        whole * 0.0 + 1.0,
        whole / whole,
        whole.sin(),
        whole.exp(),
        whole**2,
        whole,
    ):
        assert z.contains(1.0)
    assert (whole * 0.0).mag < 1e-300
    assert Interval(1e308, 1e308).exp().contains(np.inf)
    assert (Interval(1e300, 1e300) * 1e300).contains(np.inf)
    assert whole.mid == 0.0


def test_sums_and_products_of_matrices():
    rng = np.random.default_rng(2)
    a, v = rng.normal(size=(5, 4, 3)), rng.normal(size=(5, 3)) * 10.0 ** rng.integers(-8, 8, (5, 3))
    out = Interval.dot(Interval.exact(a), v[:, None, :])
    for i in range(5):
        for j in range(4):
            true = sum((Fraction(p) * Fraction(q) for p, q in zip(a[i, j], v[i], strict=True)), Fraction(0))
            assert holds(out[i, j : j + 1], true)


def test_constants_on_either_side_broadcast():
    x = Interval(np.zeros((2, 1)), np.ones((2, 1)))
    for z in (np.ones(3) + x, x + np.ones(3), np.ones(3) * x, np.ones(3) - x, np.ones(3) / (x + 1), np.float64(2) * x):
        assert isinstance(z, Interval)
        assert z.shape[0] == 2
    assert Interval.stack([x, 1.0 * x], axis=1).shape == (2, 2, 1)
    assert Interval.concatenate([x, x]).shape == (4, 1)
    assert Interval.exact(2**53 + 1).contains(2.0**53)
    assert Interval.exact(2**53 + 1).contains(2.0**53 + 2)


def test_a_step_outwards_passes_the_neighbouring_float_and_little_more():
    rng = np.random.default_rng(4)
    v = np.concatenate(
        [rng.normal(size=2000) * 10.0 ** rng.integers(-290, 300, 2000), 2.0 ** np.arange(-1000, 1000), [0.0, 1.7e308]]
    )
    v = np.concatenate([v, -v, np.nextafter(v, np.inf), np.nextafter(v, -np.inf)])
    below, above = intervals._down(v), intervals._up(v)
    assert (below <= np.nextafter(v, -np.inf)).all()
    assert (above >= np.nextafter(v, np.inf)).all()
    assert (above - below <= 4 * np.spacing(np.abs(v)) + 5e-308).all()


def test_geometry():
    x = Interval(np.array([-1.0, 2.0]), np.array([3.0, 2.0]))
    assert x.mid.tolist() == [1.0, 2.0]
    assert (x.rad >= [2.0, 0.0]).all()
    assert (x.rad < [2.0 + 1e-15, 1e-300]).all()
    assert x.mag.tolist() == [3.0, 2.0]
    assert x.intersect(Interval(np.array([0.0, 1.0]), np.array([9.0, 9.0]))).lo.tolist() == [0.0, 2.0]
    assert Interval.hull(x, 5.0).hi.tolist() == [5.0, 5.0]
    assert Interval.around(0.1, 0.2).contains([-0.1, 0.3]).all()
    assert x.minimum(0.0).hi.tolist() == [0.0, 0.0]
    assert x.maximum(0.0).lo.tolist() == [0.0, 2.0]


@pytest.mark.parametrize("ends", [(1.0, 0.0), (np.nan, 1.0)])
def test_impossible_intervals_are_refused(ends):
    with pytest.raises(ValueError, match="give lo <= hi"):
        Interval(*ends)


def test_nan_constants_and_empty_intersections_are_refused():
    with pytest.raises(ValueError, match="NaN"):
        Interval(0.0, 1.0) + np.nan
    with pytest.raises(ValueError, match="give lo <= hi"):
        Interval(0.0, 1.0).intersect(Interval(2.0, 3.0))


def test_boxes_are_cut_across_an_axis_of_each():
    boxes = Interval(np.array([[0.0, 0.0], [1.0, 2.0]]), np.array([[4.0, 2.0], [3.0, 6.0]]))
    parts = boxes.cut(np.array([0, 1]))
    assert (parts.lo == [[0, 0], [1, 2], [2, 0], [1, 4]]).all()
    assert (parts.hi == [[2, 2], [3, 4], [4, 2], [3, 6]]).all()
    low, high = np.split(boxes.cut(np.array([0, 0]), np.array([1.0, 9.0])).hi[:, 0], 2)
    assert (low.tolist(), high.tolist()) == ([1, 3], [4, 3])


@pytest.mark.parametrize("name", BINARY)
def test_rounding_inwards_would_be_caught(name, monkeypatch):
    """The outward step is necessary: without it some exact result lies outside."""
    monkeypatch.setattr(intervals, "_down", np.asarray)
    monkeypatch.setattr(intervals, "_up", np.asarray)
    rng = np.random.default_rng(3)
    operation = BINARY[name]
    escaped = 0
    for a, b in rng.uniform(0.1, 1, (50, 2)):
        z = operation(Interval(np.array([a]), np.array([a])), Interval(np.array([b]), np.array([b])))
        escaped += not holds(z, operation(Fraction(a), Fraction(b)))
    assert escaped > 5
