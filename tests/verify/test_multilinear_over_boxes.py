"""A band between nodes, over boxes: it holds at random points of them, is not much wider, and needs what counts as missed."""

import numpy as np
import pytest

from gapcert.plugin import Interval, Zone
from gapcert_verify import multilinear


def drawn(rng, counts, nx):
    """(arrays, zone, g) of a stored form over nodes at random places; along an axis with one node constants alone count."""
    low, high = -rng.uniform(0.5, 2, len(counts)), rng.uniform(0.5, 2, len(counts))
    nodes = [
        np.sort(np.append(rng.uniform(a, b, max(n - 2, 0)), [a, b][: min(n, 2)]))
        for a, b, n in zip(low, high, counts, strict=True)
    ]
    arrays = {f"gap.axis{j}": a for j, a in enumerate(nodes)} | {"lipschitz": rng.uniform(0.1, 2, (nx, len(counts)))}
    arrays |= {"curvature": rng.uniform(0, 3, (nx, len(counts))), "resolution": np.zeros(nx)}
    arrays["remainder.resolution"] = np.full(nx, 1e-9)
    return arrays, Zone(tuple(low.tolist()), tuple(high.tolist())), Interval.exact(rng.normal(0, 1, (int(np.prod(counts)), nx)))


def inside(arrays, zone, g, found, z):
    """(n, nx): l and u at points of boxes lie in what was found of these."""
    low, high = multilinear.band(arrays, zone, z, Interval.exact(np.zeros((len(z), g.shape[-1]))), g)
    return (found.lo <= low.hi) & (high.lo <= found.hi)


@pytest.mark.parametrize("counts", [(4,), (1, 6), (3, 2, 5)])
def test_a_band_over_boxes_holds_at_points_of_them(counts):
    rng = np.random.default_rng([7, *counts])
    for _ in range(5):
        arrays, zone, g = drawn(rng, counts, 2)
        low, width = (np.array(end) for end in (zone.low, np.subtract(zone.high, zone.low)))
        share = rng.uniform(0, 0.8, (200, 2, len(counts))) * rng.choice([1e-3, 0.1, 1.0], (200, 1, 1))
        a = low + width * rng.uniform(0, 0.2, (200, len(counts))) + width * share[:, 0] * (share[:, 0] < 0.8)
        b = np.minimum(a + width * share[:, 1], zone.high)
        found = multilinear.over(arrays, zone, g, Interval(a, b))
        z = a + (b - a) * rng.random((30, *a.shape))
        assert all(inside(arrays, zone, g, found, at).all() for at in z)
        assert all(inside(arrays, zone, g, found, end).all() for end in (a, b))
        # Within 3 times of what is seen, over boxes in which slopes decide.
        narrow = ((b - a) < 2e-3 * width).all(axis=1)
        ends = [multilinear.band(arrays, zone, at, Interval.exact(np.zeros((200, 2))), g) for at in (a, b, *z)]
        seen = np.max([u.hi for _, u in ends], axis=0) - np.min([u.lo for _, u in ends], axis=0)
        over = found.hi - np.max([u.hi for _, u in ends], axis=0)
        assert (over[narrow] <= 3 * seen[narrow] + 1e-6).mean() > 0.9


def test_without_the_slopes_of_what_is_missed_it_would_not_hold(monkeypatch):
    rng, missed = np.random.default_rng(4), 0

    def flat(arrays, zone, axes, g, boxes):
        return (Interval.exact(np.zeros((len(boxes), 2, 1))),) * 2

    monkeypatch.setattr(multilinear, "_slopes", flat)
    for _ in range(8):
        arrays, zone, g = drawn(rng, (5,), 2)
        a = rng.uniform(zone.low[0], zone.high[0], (200, 1))
        b = np.minimum(a + 0.05, zone.high[0])
        found = multilinear.over(arrays, zone, g, Interval(a, b))
        missed += int((~inside(arrays, zone, g, found, a)).sum())
    assert missed > 100
