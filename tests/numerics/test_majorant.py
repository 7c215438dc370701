"""Affine majorants from bounds over cells: sound on points nobody bounded, near the best, and never worse than a constant."""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st

import gapcert as gc
from gapcert_bounds.families.basis import BasisGap, parse
from gapcert_bounds.testing.fields import Waves, gap_problem

Array = np.ndarray
module = importlib.import_module("gapcert.numerics.majorant")


def grid(low: Array, high: Array, counts: tuple[int, ...]) -> gc.Interval:
    """Cells that tile a box."""
    edges = [np.linspace(a, b, n + 1) for a, b, n in zip(low, high, counts, strict=True)]
    parts = list(itertools.product(*(list(itertools.pairwise(e)) for e in edges)))
    return gc.Interval(np.array([[a for a, _ in p] for p in parts]), np.array([[b for _, b in p] for p in parts]))


def drawn(seed: int) -> tuple[gc.Interval, Array, Array]:
    """Cells, bounds with rounded and unrounded values over many sizes, and a centre inside, outside or on an edge."""
    rng = np.random.default_rng(seed)
    nz = int(rng.integers(1, 4))
    low = rng.normal(size=nz) * 10.0 ** rng.integers(-3, 3)
    cells = grid(low, low + rng.uniform(0.1, 5, nz), tuple(rng.integers(1, 6, nz)))
    bounds = np.abs(rng.normal(size=(len(cells), 2))) * 10.0 ** rng.integers(-6, 6)
    centre = low + rng.choice([-1.0, 0.0, 0.3, 2.0], nz)
    return cells, bounds, centre


def short(cells: gc.Interval, bounds: Array, centre: Array, found: tuple[Array, Array]) -> float:
    """By how much the majorant lies below a bound, at most, at the point of each cell that is next to the centre."""
    c, a = found
    z = np.clip(centre, cells.lo, cells.hi)
    return float(((bounds - c) - np.abs(z - centre) @ a.T).max())


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_it_holds_in_every_cell(seed: int) -> None:
    cells, bounds, centre = drawn(seed)
    c, a = found = gc.plugin.majorant(bounds, cells.lo, cells.hi, centre)
    assert (c >= 0).all()
    assert (a >= 0).all()
    assert short(cells, bounds, centre, found) <= 0
    e = module._mean(cells.lo.min(axis=0), cells.hi.max(axis=0), centre)
    assert (c + a @ e <= bounds.max(axis=0) * (1 + 1e-12)).all()


def unrepaired(bounds: Array, near: Array, mean: Array) -> tuple[float, Array]:
    """What the solver says."""
    rows = np.column_stack([np.ones(len(near)), near])
    x = scipy.optimize.linprog(np.append(1.0, mean), A_ub=-rows, b_ub=-bounds, method="highs").x
    return float(x[0]), np.asarray(x[1:])


def of_any_point(low: Array, high: Array, centre: Array) -> Array:
    return np.maximum(np.abs(low - centre), np.abs(high - centre))


def of_the_middle(low: Array, high: Array, centre: Array) -> Array:
    return np.abs((low + high) / 2 - centre)


@pytest.mark.parametrize(("name", "fault"), [("_line", unrepaired), ("_near", of_any_point), ("_near", of_the_middle)])
def test_it_fails_without_its_parts(name: str, fault: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """The solver's tolerance, and the least distance in a cell."""
    monkeypatch.setattr(module, name, fault)
    monkeypatch.setattr(module, "_raised", lambda c, most, nz: c)
    worst = max(short(*case, gc.plugin.majorant(case[1], case[0].lo, case[0].hi, case[2])) for case in map(drawn, range(40)))
    assert worst > 0


def test_what_a_sum_rounds_by_is_added() -> None:
    rng = np.random.default_rng(5)
    c, a, z = rng.uniform(0, 1, 300), rng.uniform(0, 3, (300, 4)), rng.uniform(0, 2, (300, 4))
    raised = module._raised(c, (a * z).sum(axis=1), 4) + (a * z).sum(axis=1)
    for k in range(300):
        assert Fraction(raised[k]) >= Fraction(c[k]) + sum(Fraction(s) * Fraction(v) for s, v in zip(a[k], z[k], strict=True))


def gap(*functions: str, weights: Any = None) -> gc.GapFunction:
    """γ_i = |Σ_l w_il p_l(z)| of named functions of x0, x1 and u0."""
    terms = [parse(f, ("x0", "x1", "u0")) for f in functions]
    return BasisGap(terms, np.ones((1, len(terms))) if weights is None else np.asarray(weights), np.zeros(1))


def test_a_slope_is_recovered() -> None:
    """γ = 0.1 + 0.5 |u|, by cells and by `lipschitz`; the constant is 1.6."""
    one = gap("1", "abs(u0)", weights=[[0.1, 0.5]])
    low, high = np.array([-1.0, -2.0, -3.0]), np.array([1.0, 2.0, 3.0])
    cells, bounds = gc.plugin.cells_of(one.gamma_over, low, high, np.zeros(3))
    for c, a in (
        gc.plugin.majorant(bounds, cells.lo, cells.hi, np.zeros(3)),
        (m[0] for m in one.majorant_over(gc.Interval(low[None], high[None]))),
    ):
        assert 0.1 <= c[0] <= 0.105
        assert a[0] == pytest.approx([0, 0, 0.5], abs=0.005)


@pytest.mark.parametrize("factor", [1.0, 0.9])
def test_slopes_are_taken_where_they_are_better(factor: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """γ = |x0| + 0.5 |u| + 0.1 x1² without cells: nothing is lost along kinks; with slopes that are too small it fails."""
    one = gap("abs(x0)", "abs(u0)", "x1^2", weights=[[1.0, 0.5, 0.1]])
    exact = type(one).lipschitz
    monkeypatch.setattr(type(one), "lipschitz", lambda self, boxes: factor * exact(self, boxes))
    low = np.array([[-1.0, -1.0, -1.0], [0.3, -1.0, -2.0], [-2.0, 0.5, 0.1]])
    some, bad = gc.Interval(low, low + np.array([[2.0, 2.0, 2.0], [1.0, 0.5, 1.5], [1.0, 0.5, 0.4]])), 0
    c, a = one.majorant_over(some, 1)
    for share in (np.zeros(3), np.ones(3), *np.random.default_rng(0).random((200, 3))):
        z = some.lo + share * (some.hi - some.lo)
        bad += int((one.gamma(z) > c + (a * np.abs(z)[:, None, :]).sum(axis=2)).sum())
    assert (bad == 0) == (factor == 1.0)
    assert a[:, 0, [0, 2]] == pytest.approx(factor * np.array([[1.0, 0.5]] * 3))


def test_slopes_along_several_axes_around_any_centre() -> None:
    """γ = 0.1 + 0.5 |u − 0.7| + 0.2 |x0|: four percent of the range above it, with about 2,000 cells."""
    centre = np.array([0.0, 0.0, 0.7])

    def bound(z: gc.Interval) -> Array:
        away = abs(z - centre).hi
        return np.stack([0.1 + 0.5 * away[:, 2] + 0.2 * away[:, 0]], axis=1)

    low, high = np.array([-1.0, -2.0, -1.0]), np.array([1.0, 2.0, 1.0])
    cells, bounds = gc.plugin.cells_of(bound, low, high, centre)
    assert np.prod(cells.hi - cells.lo, axis=1).sum() == pytest.approx(16.0)
    assert len(cells) <= module.THRESHOLDS.majorant_cells
    c, a = gc.plugin.majorant(bounds, cells.lo, cells.hi, centre)
    assert 0.1 <= c[0] <= 0.1 + 0.04 * 1.05
    assert a[0] == pytest.approx([0.2, 0, 0.5], abs=0.03)
    assert np.ptp(cells.hi[:, 1] - cells.lo[:, 1]) == 0, "cut along an axis on which nothing depends"


def test_eight_dimensions() -> None:
    """γ = 0.1 + |x0| + 0.5 u², of eight coordinates: a third of the constant's excess over the best, with 1,000 cells."""

    def bound(z: gc.Interval) -> Array:
        return np.stack([0.1 + z.mag[:, 0] + 0.5 * z.mag[:, 7] ** 2], axis=1)

    low, high, zero = -np.ones(8), np.ones(8), np.zeros(8)
    cells, bounds = gc.plugin.cells_of(bound, low, high, zero, 1000)
    c, a = gc.plugin.majorant(bounds, cells.lo, cells.hi, zero)
    z = np.random.default_rng(0).uniform(-1, 1, (20_000, 8))
    most = c + np.abs(z) @ a.T
    assert (most >= bound(gc.Interval.exact(z))).all()
    # Of any affine one the mean is at least 0.1 + 0.5 + 0.25: at |u| = 1 and u = 0 it lies above γ.
    assert most.mean() - 0.85 <= (1.6 - 0.85) / 4


def test_each_function_has_its_own_cells() -> None:
    """Two along different axes: cells that suit both are many, and with the same number the majorants are farther above."""
    low, high, zero = -np.ones(4), np.ones(4), np.zeros(4)

    def bound(z: gc.Interval) -> Array:
        return np.stack([z[:, :2].mag.sum(axis=1), z[:, 2:].mag.sum(axis=1)], axis=1)

    c, a = gc.plugin.majorant_of(bound, low, high, zero, 1000)
    cells, bounds = gc.plugin.cells_of(bound, low, high, zero, 1000)
    shared, slopes = gc.plugin.majorant(bounds, cells.lo, cells.hi, zero)
    assert (c + a.sum(axis=1) / 2 < 1.25).all()
    assert (shared + slopes.sum(axis=1) / 2 > 1.3).all()
    z = np.random.default_rng(0).uniform(-1, 1, (5000, 4))
    assert (bound(gc.Interval.exact(z)) <= c + np.abs(z) @ a.T).all()


def test_what_does_not_pay_is_not_asked() -> None:
    asked = 0

    def bound(z: gc.Interval) -> Array:
        nonlocal asked
        asked += len(z)
        return np.full((len(z), 2), 0.3)

    cells, bounds = gc.plugin.cells_of(bound, -np.ones(8), np.ones(8), np.zeros(8))
    assert (len(cells), asked) == (1, 1 + 3 * 8)
    c, a = gc.plugin.majorant(bounds, cells.lo, cells.hi, np.zeros(8))
    assert c == pytest.approx([0.3, 0.3])
    assert not a.any()


def test_infinite_bounds_and_boxes_that_are_points() -> None:
    cells = grid(np.zeros(2), np.ones(2), (2, 1))
    c, a = gc.plugin.majorant(np.array([[1.0, 1.0], [np.inf, 2.0]]), cells.lo, cells.hi, np.zeros(2))
    assert np.isinf(c[0])
    assert not a[0].any()
    assert np.isfinite(c[1])
    one = gap("1", "x0", "u0^2")
    z = np.array([[0.5, 0.1, -2.0], [-1.0, 0.0, 1.0]])
    c, a = one.majorant_over(gc.Interval.exact(z))
    most = c + (a * np.abs(z)[:, None]).sum(axis=2)
    assert most == pytest.approx(one.gamma(z))


def test_weights_move_it_to_where_they_are() -> None:
    """γ = |u|³ on [−1, 1]: low near 0 if points lie there, low at the ends if they lie there."""
    cells = grid(np.array([-1.0]), np.array([1.0]), (200,))
    bounds = np.abs(np.stack([cells.lo, cells.hi])).max(axis=0) ** 3
    near = gc.plugin.majorant(bounds, cells.lo, cells.hi, np.zeros(1), np.array([0.01]))
    far = gc.plugin.majorant(bounds, cells.lo, cells.hi, np.zeros(1))
    assert near[0] < 0.02
    assert near[0] + near[1][0] * 0.01 <= far[0] + far[1][0] * 0.01


@pytest.mark.exam
def test_over_boxes_it_holds_between_samples() -> None:
    field = Waves.smooth()
    one = gc.registry().build("gap_family", "envelope").fit(gap_problem(field, (4, 4, 4), affine=True))
    rng = np.random.default_rng(0)
    low = rng.uniform(-1, 0.5, (4, 3))
    boxes = gc.Interval(low, low + rng.uniform(0.05, 0.5, (4, 3)))
    c, a = one.majorant_over(boxes, 400)
    for _ in range(200):
        z = boxes.lo + rng.random(boxes.shape) * (boxes.hi - boxes.lo)
        assert (one.gamma(z) <= c + (a * np.abs(z)[:, None, :]).sum(axis=2)).all()
    mean = c + (a * np.stack([module._mean(*b, np.zeros(3)) for b in zip(boxes.lo, boxes.hi, strict=True)])[:, None]).sum(
        axis=2
    )
    assert mean.sum() < 0.95 * one.gamma_over(boxes).sum()


@pytest.mark.parametrize(
    ("bounds", "low", "high", "centre"),
    [
        (np.ones((2, 1)), np.zeros((3, 2)), np.ones((3, 2)), np.zeros(2)),
        (np.ones(3), np.zeros((3, 2)), np.ones((3, 2)), np.zeros(2)),
        (np.ones((3, 1)), np.ones((3, 2)), np.zeros((3, 2)), np.zeros(2)),
        (np.full((3, 1), np.nan), np.zeros((3, 2)), np.ones((3, 2)), np.zeros(2)),
        (np.ones((3, 1)), np.zeros((3, 2)), np.ones((3, 2)), np.zeros(3)),
        (np.ones((0, 1)), np.zeros((0, 2)), np.ones((0, 2)), np.zeros(2)),
    ],
)
def test_bad_input(bounds: Array, low: Array, high: Array, centre: Array) -> None:
    with pytest.raises(gc.UsageError, match="majorant: found bounds"):
        gc.plugin.majorant(bounds, low, high, centre)
