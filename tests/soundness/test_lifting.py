"""Attacks on what lifts functions over a band: every bound over a box against exact arithmetic, and what each part is for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gapcert as gc
from gapcert.certification.certify import _violations
from gapcert.numerics.intervals import Interval
from gapcert_bounds.families.constant import ConstantGap
from gapcert_bounds.testing.fields import Kink, Waves, gap_problem
from gapcert_functions.dominating import DominatingGap, dominate
from gapcert_functions.lifting import Band, Cones, Table
from gapcert_networks import network as layers
from gapcert_networks.network import Network

Array = np.ndarray


def exact_cones(part: Cones, z: Array) -> Fraction:
    ends = [
        Fraction(g) + sum(Fraction(a) * abs(Fraction(x) - Fraction(y)) for a, x, y in zip(part.constants, z, k, strict=True))
        for k, g in zip(part.z, part.g, strict=True)
    ]
    return min(ends) + Fraction(part.slack)


def exact_band(part: Band, z: Array) -> Fraction:
    """Tensor interpolation and Σ b_j, in rational numbers, of two axes."""
    total, weights = Fraction(part.slack), []
    for j, a in enumerate(part.axes):
        if len(a) < 2:
            total += Fraction(part.constants[j]) * abs(Fraction(z[j]) - Fraction(a[0]))
            weights.append({0: Fraction(1)})
            continue
        k = int(np.clip(np.searchsorted(a, z[j], "right") - 1, 0, len(a) - 2))
        low, high, x = Fraction(a[k]), Fraction(a[k + 1]), Fraction(z[j])
        total += Fraction(part.factors[j][k]) * (x - low) * (high - x)
        t = (x - low) / (high - low)
        weights.append({k: 1 - t, k + 1: t})
    return total + sum(s * t * Fraction(part.g.lo[i, j]) for i, s in weights[0].items() for j, t in weights[1].items())


def points_of(low: Array, high: Array, rng: np.random.Generator) -> Array:
    """Corners, their neighbours inside, the middle, and points at random."""
    bits = np.array([[0, 0], [0, 1], [1, 0], [1, 1]], dtype=bool)
    inner = np.where(bits, np.nextafter(high, low), np.nextafter(low, high))
    middle, drawn = low / 2 + high / 2, low + (high - low) * rng.random((6, 2))
    return np.clip(np.vstack([np.where(bits, high, low), inner, middle, drawn]), low, high)


def assert_above(part: Cones | Band, exact: Callable[..., Fraction], low: Array, high: Array, rng: np.random.Generator) -> None:
    box = Interval(low[None], high[None])
    slope, c = rng.normal(size=(1, 2)) * 10.0 ** rng.integers(-3, 4), box.mid[0]
    upper = Fraction(float(part.lifted(box, slope, np.ones(2)).upper[0]))
    for z in points_of(low, high, rng):
        moved = sum(Fraction(m) * (Fraction(x) - Fraction(y)) for m, x, y in zip(slope[0], z, c, strict=True))
        assert exact(part, z) - moved <= upper


UNITS = st.sampled_from([1.0, 1e-12, 1e12])
OFFSETS = st.sampled_from([0.0, 1.0, 1e6, -1e15])
NARROW = st.sampled_from([1.0, 1e-3, 0.0, None])


@settings(max_examples=60, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), unit=UNITS, offset=OFFSETS, narrow=NARROW, banded=st.booleans())
def test_bounds_over_boxes_hold_in_exact_arithmetic(
    seed: int, unit: float, offset: float, narrow: float | None, banded: bool
) -> None:
    """Far from 0, in any unit, on boxes of no width, and (None) on those between neighbouring floats, whose middle is none."""
    rng = np.random.default_rng(seed)
    low = (offset + rng.uniform(-1, 1, 2)) * unit
    high = low + rng.uniform(4, 8, 2) * np.maximum(unit, 4 * np.spacing(np.abs(low)))
    whole = Interval(low[None], high[None])
    constants = rng.exponential(size=2) / unit * (rng.random(2) < 0.8)
    if banded:
        axes = [np.linspace(low[0], high[0], 4), low[1:] if rng.random() < 0.5 else np.array([low[1], high[1]])]
        axes = [np.unique(a) for a in axes]
        g = rng.normal(size=tuple(len(a) for a in axes))
        bends = [rng.exponential(size=len(a) - 1) / unit**2 for a in axes]
        part: Cones | Band = Band.of(whole, axes, Interval.exact(g), bends, constants, 1e-9)
    else:
        z = low + (high - low) * rng.random((30, 2))
        z[20:] = z[:10]
        part = Cones(whole, z, rng.normal(size=30), constants, 1e-9)
    for _ in range(4):
        a = np.clip(low + (high - low) * rng.random(2), low, high)
        b = np.nextafter(a, np.inf) if narrow is None else a + narrow * (high - a) * rng.random(2)
        b = np.maximum(a, np.minimum(b, high))
        assert_above(part, exact_band if banded else exact_cones, a, b, rng)


def test_a_middle_that_is_no_float() -> None:
    """Between 1e16 and its neighbour the middle is 1e16 itself, and the other end is a whole width away."""
    low, high = np.array([1e16, 0.0]), np.array([1e16 + 2, 1.0])
    part = Band.of(
        Interval(low[None], high[None]),
        [low[:1], np.array([0.0, 1.0])],
        Interval.exact(np.zeros((1, 2))),
        [np.zeros(0), np.zeros(1)],
        np.zeros(2),
        0.0,
    )
    upper = part.lifted(part.box, np.array([[-1.0, 0.0]]), np.zeros(2)).upper[0]
    assert upper >= 1.0 * (high[0] - part.box.mid[0, 0])


def network(seed: int, nx: int = 2) -> Network:
    rng = np.random.default_rng(seed)
    return Network((2 * rng.normal(size=(12, 3)), rng.normal(size=(nx, 12))), (rng.normal(size=12), np.zeros(nx)), "tanh")


SPIKES = Kink(np.array([[-1.0, -0.5, -0.25], [0.5, -1.0, -1.0]]), np.zeros(3))


def outside(gap: gc.GapFunction, field: Waves | Kink, n: int = 50_000) -> int:
    z = field.domain.draw(n, np.random.default_rng(3))
    low, high = gap.interval(z)
    return int((~((low <= field(z)) & (field(z) <= high))).any(axis=1).sum())


def test_shifts_of_a_neighbouring_cell_are_not_enough() -> None:
    """The even table is proved; the same numbers one cell further are not, and the truth escapes."""
    problem = gap_problem(SPIKES, (4, 4, 4))
    gap = dominate(problem, "drawn", network(1), network(2), (4, 4, 4), 0.01, 40_000)
    assert outside(gap, SPIKES) == 0
    moved = DominatingGap(
        gap.family, gap.sides, gap.table, np.roll(gap.shifts, 1, axis=2), gap.predictor, gap.rounding, gap.boxes, gap.target
    )
    assert outside(moved, SPIKES) > 0


def test_lines_of_a_network_without_their_distance_prove_too_much(monkeypatch: pytest.MonkeyPatch) -> None:
    """An activation lies within δ of its line; where that is left out, the function is taken for the lines themselves."""
    flat, both = Kink(np.zeros((2, 3)), np.zeros(3)), np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    zero = Network((np.zeros((2, 3)),), (np.zeros(2),))
    roof = Network((both, -np.ones((2, 2))), (np.zeros(2), np.zeros(2)))  # −|x0|, whose two lines add up to −1/2
    problem = gap_problem(flat, (3, 3, 3))
    assert outside(dominate(problem, "drawn", zero, roof, (1, 1, 1), budget=1), flat) == 0
    real = layers.lines

    def bare(*given: Any) -> tuple[Array, Array, Array]:
        alpha, mu, delta = real(*given)
        return alpha, mu, 0 * delta

    monkeypatch.setattr(layers, "lines", bare)
    assert outside(dominate(problem, "drawn", zero, roof, (1, 1, 1), budget=1), flat) > 0


def test_a_table_that_ends_before_the_domain_promises_nothing_beyond() -> None:
    """Points beyond its last edge take the shift of the last cell, which was lifted up to that edge alone."""
    problem = gap_problem(SPIKES, (4, 4, 4))
    short = replace(
        problem,
        domain=gc.Domain(*(gc.Box(b.axes, b.low, (0.0, *b.high[1:])) for b in (problem.domain.states,)), problem.domain.inputs),
    )
    gap = dominate(short, "drawn", network(1), network(2), (4, 4, 4), 0.01, 40_000)
    assert gap.table.edges[0][-1] == 0.0
    assert outside(gap, SPIKES) > 0
    assert outside(dominate(problem, "drawn", network(1), network(2), (4, 4, 4), 0.01, 40_000), SPIKES) == 0


def test_a_slope_that_a_predictor_takes_away_leaves_that_of_rounding() -> None:
    """γ itself rounds by what p and q are large, wherever they cancel: its stated slope has to say so."""
    field = Waves(np.zeros((1, 2)), np.ones((1, 2)), np.zeros((1, 2)), offset=0.5)
    problem = replace(gap_problem(field, (3, 3)), predictor=gc.plugin.AffinePredictor(np.zeros(1), np.array([[1.0, 0.0]])))
    problem = replace(problem, lipschitz=replace(problem.lipschitz, value=np.array([[1.0, 1e-9]])))
    q = Network((np.array([[-1.0, 0.0]]),), (np.zeros(1),))
    gap = dominate(problem, "drawn", q, q, (1, 1))
    z = np.array([[0.0, 0.0], [1.0, 0.0]])
    slope = gap.lipschitz(field.domain.interval)[0, 0, 0]
    assert gap.gamma(z)[1, 0] - gap.gamma(z)[0, 0] <= slope


def test_bounds_that_are_no_numbers_are_violations() -> None:
    """NaN is neither below nor above a residual: an audit that asks for either would find nothing wrong."""

    gap = ConstantGap(np.zeros(1))
    gap.value = np.array([np.nan])
    for flags in _violations(gap, np.zeros((5, 2)), np.zeros((5, 1))):
        assert flags.all()


def test_a_budget_of_one_box_and_tables_of_one_cell() -> None:
    for counts in ((1, 1, 1), (1, 3, 1)):
        gap = dominate(gap_problem(SPIKES, (4, 4, 4)), "drawn", network(1), network(2), counts, 0.01, 1)
        assert outside(gap, SPIKES) == 0
        assert Table.uniform((-1,) * 3, (1,) * 3, counts).counts == counts
