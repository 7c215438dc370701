"""Lines and ranges of networks and of sums against rational arithmetic: units of 1e-12 and 1e12, boxes without width, kinks."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gapcert.numerics.intervals import Interval
from gapcert_functions.bounded_function import Function
from gapcert_functions.sums import WeightedSum, term
from gapcert_networks.network import Network

Array = np.ndarray
Exact = list[Fraction]
SLOPES = {"relu": Fraction(0), "leaky-relu": Fraction(0.01), "identity": Fraction(1)}


def exact_network(q: Network, z: Exact) -> Exact:
    for k, (w, b) in enumerate(zip(q.weights, q.biases, strict=True)):
        z = [sum((Fraction(a) * x for a, x in zip(row, z, strict=True)), Fraction(c)) for row, c in zip(w, b, strict=True)]
        name = q.output if k == len(q.weights) - 1 else q.activation
        z = z if name is None else [x if x >= 0 else SLOPES[name] * x for x in z]
    return z


def exact_sum(q: WeightedSum, z: Exact) -> Exact:
    x, y = z
    values = [Fraction(1), x**3, abs(x) * y**2, (x + y) * (x + y), abs(x - y)]
    return [sum(Fraction(w) * v for w, v in zip(row, values, strict=True)) for row in q.weights]


def network(rng: np.random.Generator, unit: float) -> Network:
    sizes, scale = (2, 5, 4, 2), 10.0 ** rng.integers(-3, 4)
    weights = [scale * rng.normal(size=(b, a)) * (rng.random((b, a)) < 0.8) for a, b in pairwise(sizes)]
    weights[0] /= unit
    name, output = rng.choice(list(SLOPES)), rng.choice(["relu", "leaky-relu", ""])
    return Network(tuple(weights), tuple(scale * rng.normal(size=n) for n in sizes[1:]), str(name), str(output) or None)


def sums(rng: np.random.Generator, unit: float) -> WeightedSum:
    x, y = ["axis", 0], ["axis", 1]
    cross, ridge = ["^", ["+", x, y], 2], ["abs", ["+", x, ["*", -1.0, y]]]
    data = [[], [[0, "power", 3]], [[0, "abs", 1], [1, "power", 2]], cross, ridge]
    return WeightedSum(tuple(term(d) for d in data), rng.normal(size=(2, 5)) / unit ** np.array([0, 3, 3, 2, 1]))


def boxes(rng: np.random.Generator, unit: float, offset: float, n: int) -> Interval:
    """Some without width, some between neighbouring floats, some with an end at 0."""
    low = (offset + rng.uniform(-1, 1, (n, 2))) * unit
    high = low + unit * rng.choice([0.0, 1e-12, 1e-3, 2.0], (n, 2)) * rng.random((n, 2))
    high[::3] = np.nextafter(low[::3], np.inf)
    if offset == 0:
        low[1::4], high[1::4] = 0.0, np.abs(high[1::4])
    return Interval(low, high)


@pytest.mark.exam
@pytest.mark.parametrize("make", [network, sums])
@given(seed=st.integers(0, 2**32 - 1), unit=st.sampled_from([1.0, 1e-12, 1e12]), offset=st.sampled_from([0.0, 3.0, -1e6, 1e15]))
def test_lines_ranges_and_rounding_hold_exactly(
    make: Callable[[np.random.Generator, float], Function], seed: int, unit: float, offset: float
) -> None:
    rng = np.random.default_rng(seed)
    q = make(rng, unit)
    exact: Callable[[Any, list[Fraction]], Any] = exact_network if isinstance(q, Network) else exact_sum
    found = boxes(rng, unit, offset, 5)
    whole, tight, over = Interval(found.lo.min(axis=0)[None], found.hi.max(axis=0)[None]), q.tight_over(found), q.over(found)
    lines, rounding = [q.line_over(found, i) for i in range(2)], q.rounding(whole)
    for k in range(5):
        low, high, c = found.lo[k], found.hi[k], found.mid[k]
        ends = [np.where(bits, low, high) for bits in ([True, True], [True, False], [False, True], [False, False])]
        for z in [*ends, c, np.clip(low + (high - low) * rng.random(2), low, high)]:
            y, computed = exact(q, [Fraction(x) for x in z]), q(z[None])[0]
            for i, (a, rest) in enumerate(lines):
                line = y[i] - sum(Fraction(s) * (Fraction(x) - Fraction(m)) for s, x, m in zip(a[k], z, c, strict=True))
                assert Fraction(rest.lo[k]) <= line <= Fraction(rest.hi[k])
                assert Fraction(max(tight.lo[k, i], over.lo[k, i])) <= y[i] <= Fraction(min(tight.hi[k, i], over.hi[k, i]))
                assert abs(Fraction(computed[i]) - y[i]) <= Fraction(rounding[i])
