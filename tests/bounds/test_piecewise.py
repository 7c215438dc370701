"""The estimator piecewise: its contract, its trails, its options, and what it makes of hidden state and held axes."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from rough_fields import Coarse, Contact, slide

import gapcert as gc
from gapcert.certification.refutation import growth
from gapcert.contracts.systems.cells import Cells
from gapcert.contracts.systems.domain import Relation
from gapcert.testing import LipschitzContract
from gapcert_bounds.config import PiecewiseConfig
from gapcert_bounds.constants.piecewise import Piecewise
from gapcert_bounds.families.basis import Basis
from gapcert_bounds.families.constant import Constant
from gapcert_bounds.testing.fields import Kink, Waves, gap_problem, lipschitz_problem


class TestPiecewise(LipschitzContract):
    def estimator(self):
        return Piecewise(budget=6_000)


class TestPiecewiseOfWaves(LipschitzContract):
    def estimator(self):
        return Piecewise(budget=3_000)

    def field(self):
        return Waves.smooth()


def trail(law, start, end, steps=8, noise=1e-15):
    z = np.array([[[start], [end]]], dtype=np.float64)
    asked = []

    def query(k, points):
        asked.append(k)
        return law(points)

    t = gc.plugin.follow(query, z, law(z[0])[None], np.array([0]), np.array([noise]), steps)
    assert t.queried == 3 * len(asked)
    return t


@pytest.mark.parametrize(
    ("law", "start", "growing"),
    [
        (lambda z: 1.0 * (z > 0.3), -0.9, True),
        (lambda z: 0.05 * (z > 0.3) + np.sin(3 * z), 0.2, True),
        (np.abs, -0.9, False),
        (lambda z: np.maximum(z - 0.3, 0) * 100, -0.9, False),
        (lambda z: np.tanh(z / 1e-3), -0.9, False),
        (lambda z: np.sin(40 * z), -0.9, False),
        (lambda z: 0 * z, -0.9, False),
    ],
    ids=["jump", "small jump", "kink", "steep kink", "layer", "waves", "nothing"],
)
def test_a_slope_grows_across_a_jump_and_settles_elsewhere(law, start, growing):
    assert trail(law, start, 0.4).growing.tolist() == [growing]


def test_a_trail_ends_at_the_jump_and_measures_it():
    t = trail(lambda z: 0.7 * (z > 0.3) + z, -1.0, 1.0)
    assert t.z[0, 0, 0] <= 0.3 <= t.z[0, 1, 0]
    assert t.change[0, 0] == pytest.approx(0.7, abs=1e-4)
    assert np.ptp(t.z) == pytest.approx(2 / 4**8)


def test_rounding_is_no_jump():
    """A residual rounded to multiples of 1e-3 jumps everywhere, by its resolution."""
    coarse = lambda z: np.round(z / 1e-3) * 1e-3  # noqa: E731
    assert not trail(coarse, -0.9, 1.0, noise=4e-3).growing.any()
    assert trail(coarse, -0.9, 1.0, noise=0.0).growing.any()
    problem = lipschitz_problem(Waves.smooth(), backend=Coarse(Waves.smooth(), 1e-3))
    assert not Piecewise(budget=6_000).bound(problem).cells.marked.any()


def test_a_pair_is_followed_along_each_axis_on_its_own():
    field = Contact(slide)
    segments = np.array([[[-0.5, -0.5, -0.5], [0.5, 0.7, 0.5]]])
    found, spent = growth(lambda _, z: field(z), field.domain, segments, np.array([1]), np.full(2, 1e-15))
    assert (found["state"], found["axis"]) == (1, 1)
    assert found["size"] == pytest.approx(0.2, abs=1e-4)
    assert found["where"][1] == pytest.approx(0, abs=1e-4)
    assert found["slopes"][1] > 1_000 * found["slopes"][0]
    assert 2 * 3 < spent <= 2 * 3 + 3 * 3 * 8


def test_options_and_limits():
    with pytest.raises(ValueError, match="budget"):
        PiecewiseConfig(kind="piecewise", budget=10)
    assert gc.registry().build("lipschitz", "piecewise").cells == 256
    many = Kink(np.zeros((5, 10)), np.zeros(10))
    with pytest.raises(gc.UsageError, match="10 states and inputs; it looks at all corners"):
        Piecewise().bound(lipschitz_problem(many))


def test_at_most_as_many_cells_and_none_thinner_than_asked_for():
    bound = Piecewise(budget=6_000, cells=40, thinnest=0.05).bound(lipschitz_problem(Contact(slide)))
    width = bound.cells.boxes.hi - bound.cells.boxes.lo
    assert len(bound.cells) <= 40
    assert (width >= 2 * 0.05 * (1 - 1e-9)).all()
    assert bound.cells.marked.any()


def test_held_axes_cost_nothing_and_have_no_constants():
    plain = lipschitz_problem(Contact(slide))
    asked = []

    def query(name, z):
        asked.append(z)
        return plain.query(name, z)

    bound = Piecewise(budget=6_000).bound(replace(plain, query=query, held=(0,)))
    assert (bound.value[:, 0] == 0).all()
    assert (bound.cells.axis != 0).all()
    assert bound.cells.marked.any()


def test_a_domain_with_relations_keeps_every_query_inside():
    field = Contact(slide)
    domain = gc.Domain(field.domain.states, field.domain.inputs, (Relation("x1 + u0 <= 0.5", (0.0, 1.0, 1.0), 0.5),))
    plain, asked = lipschitz_problem(field), []

    def query(name, z):
        asked.append(z)
        return plain.query(name, z)

    bound = Piecewise(budget=6_000).bound(replace(plain, domain=domain, query=query))
    assert domain.contains(np.concatenate(asked)).all()
    assert bound.cells.marked.any()
    anchors = bound.cells.anchors
    assert domain.contains(anchors).all()
    held = [len(rows) > 0 for rows in bound.cells.closures(anchors)]
    assert set(np.unique(bound.cells.locate(domain.draw(20_000, np.random.default_rng(0))))) <= set(np.flatnonzero(held))


def with_cells(problem, cells):
    return replace(problem, lipschitz=replace(problem.lipschitz, cells=cells, value=cells.worst))


def test_other_routes_take_the_worst_cell_or_refuse():
    problem = gap_problem(Waves.smooth(), (8, 8, 8), route="theorem1")
    domain, value = problem.domain, problem.lipschitz.value
    cut = np.array([0]), np.array([0.1]), np.array([[-1, -2]])
    calm = Cells(domain.low, domain.high, *cut, np.stack([value / 2, value]), np.zeros((2, 2)), domain.centre[None])
    assert (Constant().fit(with_cells(problem, calm)).value == Constant().fit(problem).value).all()
    wild = replace(calm, jumps=np.array([[0.0, 0.1], [0.0, 0.0]]))
    for family in (Constant(), Basis(["1"])):
        with pytest.raises(gc.UsageError, match="its margin needs a residual without jumps, and it jumps in 1 cells"):
            family.fit(with_cells(problem, wild))


def test_diagnostics_name_the_largest_jump_of_each_state():
    problem = lipschitz_problem(Contact(slide))
    bound = Piecewise(budget=6_000).bound(problem)
    jumps = bound.largest_jumps(problem.domain.axes)
    assert [j["state"] for j in jumps] == ["x0", "x1"]
    assert jumps[1]["size"] == pytest.approx(0.2, rel=1e-3)
    assert jumps[1]["where"]["x1"] == pytest.approx(0, abs=1e-4)
    assert json.loads(json.dumps(bound.summary(problem.domain.axes)))["marked"] == bound.cells.marked.sum()
