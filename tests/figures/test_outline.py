"""What a picture draws of a region is the region: its section with the picture's plane, and its shadow on it."""

from __future__ import annotations

import numpy as np
import pytest

from gapcert import Box, Goal, Region, StateSpec
from gapcert.contracts.systems.region import Ellipsoid, Polytope
from gapcert.numerics.constraint_zone import Relation
from gapcert_figures.region_outlines import Part, outlines_of, projection, section

AXES = (StateSpec("x", "m"), StateSpec("y", "m"), StateSpec("z", "m"))
FRAME = Box(AXES, (-2.0, -2.0, -2.0), (2.0, 2.0, 2.0))
BOX = Box(AXES, (-1.0, -0.5, 0.2), (1.2, 0.7, 1.0))
CUTS = (((1.0, 1.0, 1.0), 1.0), ((-1.0, 2.0, -1.5), 1.5), ((0.3, -1.0, 0.5), 1.0))
POLYTOPE = Polytope(FRAME, tuple(Relation("cut", a, b) for a, b in CUTS))
TILTED = Ellipsoid(FRAME, (0, 1, 2), (0.2, -0.1, 0.3), ((1.5, 0.4, 0.7), (0.4, 1.2, -0.3), (0.7, -0.3, 2.0)))
COLUMN = Ellipsoid.of(FRAME, {"x": 0.5, "z": 0.0}, {"x": 0.4, "z": 0.6})
PARTS = {"box": BOX, "polytope": POLYTOPE, "tilted": TILTED, "column": COLUMN}


def within(points: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """(n,): how far inside a convex polygon, whichever way round it goes; negative outside."""
    then = np.roll(polygon, -1, axis=0)
    turn = np.sign((polygon[:, 0] * then[:, 1] - then[:, 0] * polygon[:, 1]).sum())
    long = np.abs(then - polygon).max(axis=1) > 1e-9
    (x, y), side = polygon[long].T, (then - polygon)[long]
    cross = side[:, 0] * (points[:, None, 1] - y) - side[:, 1] * (points[:, None, 0] - x)
    return np.asarray((turn * cross / np.hypot(*side.T)).min(axis=1))


def holds(part: Part, x: np.ndarray) -> np.ndarray:
    return np.asarray(part.contains(x))


@pytest.mark.parametrize("name", PARTS)
@pytest.mark.parametrize("height", [-1.7, 0.0, 0.25, 0.9])
def test_a_section_is_what_the_plane_has_of_the_region(name: str, height: float) -> None:
    part, rng = PARTS[name], np.random.default_rng(0)
    p = rng.uniform(-2.2, 2.2, (4000, 2))
    truth = holds(part, np.column_stack([p, np.full(len(p), height)]))
    polygon = section(part, np.array([9.0, 9.0, height]))
    if not len(polygon):
        assert not truth.any()
        return
    depth = within(p, polygon)
    assert truth[depth > 1e-3].all()
    assert not truth[depth < -1e-3].any()
    assert truth.any()
    assert (depth > 1e-3).any()


@pytest.mark.parametrize("name", PARTS)
def test_a_shadow_is_what_lies_above_or_below_the_region(name: str) -> None:
    part, rng = PARTS[name], np.random.default_rng(1)
    p = rng.uniform(-2.2, 2.2, (2000, 2))
    heights = np.linspace(-2.0, 2.0, 401)
    x = np.column_stack([p.repeat(len(heights), 0), np.tile(heights, len(p))])
    truth = holds(part, x).reshape(len(p), -1).any(axis=1)
    depth = within(p, projection(part))
    assert truth[depth > 2e-2].all()
    assert not truth[depth < -1e-3].any()
    assert truth.any()
    assert not truth.all()


def test_a_polytope_that_is_cut_away_has_no_shadow() -> None:
    nothing = Polytope(FRAME, (Relation("never", (1.0, 1.0, 1.0), -7.0),))
    assert not len(projection(nothing))
    assert not len(section(nothing, np.zeros(3)))


def test_outlines_say_where_they_hold_and_end_at_the_set_to_stay_in() -> None:
    post = Box(AXES, (-1.0, -3.0, -2.0), (-0.5, 0.0, 2.0))
    goal = Goal("reach_avoid", FRAME, Region((BOX,)), Region((post,), (), (TILTED,)))
    high, low = (outlines_of(goal, np.array([0.0, 0.0, z])) for z in (1.9, 0.5))
    assert [(o.role, o.where) for o in high] == [
        ("stay", "everywhere"), ("avoid", "everywhere"), ("avoid", "elsewhere"), ("target", "elsewhere"),
    ]  # fmt: skip
    assert [o.where for o in low[2:]] == ["section", "shadow"] * 2
    assert high[1].points[:, 1].min() == -2.0  # it goes on below, where nothing may be
    assert [(o.cut, o.dotted) for o in low[2:4]] == [(True, False), (False, True)]


def test_a_region_across_the_seam_of_an_angle_is_drawn_on_both_sides() -> None:
    axes = (StateSpec("h", "rad", "angle"), StateSpec("w", "rad/s"))
    frame = Box(axes, (-np.pi, -1.0), (np.pi, 1.0))
    disc = Ellipsoid.of(frame, {"h": 3.0, "w": 0.0}, {"h": 0.5, "w": 0.5})
    found = [o.points for o in outlines_of(Goal("reach_avoid", frame, Region((), (), (disc,))), np.zeros(2))[1:]]
    assert len(found) == 2
    p = np.random.default_rng(2).uniform((-np.pi, -1.0), (np.pi, 1.0), (4000, 2))
    depth = np.max([within(p, polygon) for polygon in found], axis=0)
    truth = disc.contains(p)
    assert truth[depth > 2e-3].all()
    assert not truth[depth < -2e-3].any()
    assert (depth > 0).any()
