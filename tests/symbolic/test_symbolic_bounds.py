"""Successor boxes without a declared growth bound: exact where f is monotone, and narrower than what is declared."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gapcert as gc
from gapcert import Interval
from gapcert_bounds.testing.fields import Nothing, Waves, gap_problem
from gapcert_equations.config import EquationsConfig
from gapcert_functions import mean_value
from gapcert_symbolic.cells.abstraction import windows
from gapcert_symbolic.cells.bounds import Bound, Enclosed
from gapcert_symbolic.cells.gaps import disturbance
from gapcert_symbolic.cells.grid import Grid, View, combined
from gapcert_symbolic.synthesizer import Symbolic

VEHICLE = Path(__file__).parents[2] / "specs" / "benchmarks" / "vehicle.yaml"


def mixing() -> gc.Model:
    """p⁺ rises with p and falls with q; q⁺ is monotone in q alone."""
    config = EquationsConfig(
        kind="equations",
        states={"p": "1", "q": "1"},
        inputs={"v": "1"},
        next={"p": "p + p**3/4 - exp(q)/2 + v", "q": "q + sin(2*p)/4 + p*q**3/20"},
        period="1 s",
    )
    model = gc.registry().build("model", "equations", config)
    assert isinstance(model, gc.Model)
    return model


def cells(n: int, width: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    low = rng.uniform(-1, 1 - width, (n, 2))
    return low, low + width, rng.uniform(-1, 1, (n, 1))


def hull(model: gc.Model, low: np.ndarray, high: np.ndarray, u: np.ndarray, draws: int = 60) -> Interval:
    """Of the successors of corners and random points."""
    rng, nx = np.random.default_rng(6), low.shape[1]
    shares = [np.array([k >> j & 1 for j in range(nx)], dtype=float) for k in range(2**nx)]
    inside = [low + t * (high - low) for t in (*shares, *(rng.random(low.shape) for _ in range(draws)))]
    found = [model.step(x, u).x for x in inside]
    return Interval(np.min(found, axis=0), np.max(found, axis=0))


def centred(model: gc.Model, low: np.ndarray, high: np.ndarray, u: np.ndarray) -> Interval:
    """The mean-value form about the centre alone."""
    z, centre = Interval(np.hstack([low, u]), np.hstack([high, u])), (low + high) / 2
    slope = model.jacobian_enclosure(z)[:, :, : low.shape[1]]
    moved = (slope * (Interval(low, high) - centre)[:, None, :]).sum(-1)
    return moved + model.enclosure(Interval.exact(np.hstack([centre, u])))


def test_boxes_are_exact_where_f_is_monotone() -> None:
    model, (low, high, u) = mixing(), cells(200, 0.2)
    box, reached, about = Enclosed(model).over(low, high, u), hull(model, low, high, u), centred(model, low, high, u)
    assert box.contains(reached).all()
    # p⁺ is monotone in both states: its box is that of two corners.
    assert (box.width - reached.width)[:, 0].max() < 1e-13
    assert (about.width - reached.width)[:, 0].min() > 1e-5
    # q⁺ turns in p in some cells; nowhere is its box wider than the mean-value form's.
    assert (box.width <= about.width + 1e-13).all()


def test_a_wrong_sign_is_caught() -> None:
    """Slopes at the centre that stand for those over the cell, and slopes of the wrong sign, which exchange the corners."""
    model, (low, high, u) = mixing(), cells(200, 0.4)
    reached, z = hull(model, low, high, u), Interval(np.hstack([low, u]), np.hstack([high, u]))
    slope = model.jacobian_enclosure(z)[:, :, :2]
    assert mean_value(z, slope, model.enclosure).contains(reached).all()
    assert not mean_value(z, Interval.exact(slope.mid), model.enclosure).contains(reached).all()
    with pytest.raises(ValueError, match="lower end above upper end"):
        mean_value(z, -slope, model.enclosure)


def test_a_predictor_shifts_boxes_once() -> None:
    """Where the residual is about 1, successors move by it and widen by what is left alone, not by ±γ."""
    field = Waves(0.01 * np.ones((2, 3)), np.full((2, 3), 2.0), np.zeros((2, 3)), offset=1.0)
    gap = gc.registry().get("gap_family", "envelope").load()().fit(gap_problem(field, (5, 5, 5), affine=True))
    grid, axes = Grid(field.domain.states, (8, 6)), (np.linspace(-1, 1, 3),)
    plain, shifted = (windows(Enclosed(Nothing(field)), grid, axes, a) for a in (None, disturbance(gap, grid, axes)))
    for k, (low, high) in enumerate(zip(plain.axes, shifted.axes, strict=True)):
        cells_per_unit = grid.counts[k] / 2
        assert (high.first - low.first.max() >= np.floor(0.85 * cells_per_unit) - 1).all()
        assert (high.last - high.first <= np.ceil(0.3 * cells_per_unit) + 1).all()
        assert gap.gamma(np.zeros((1, 3)))[0, k] > 0.95


def published() -> tuple[Symbolic, gc.SynthesisProblem, Bound, Grid, tuple[np.ndarray, ...]]:
    spec = gc.load_spec(VEHICLE)
    model, made = spec.build("model"), spec.build("controller")
    domain = gc.Domain.of(model, dict(spec.config.domain))
    problem = gc.SynthesisProblem(model, None, domain, spec.goal(domain))
    plan = made._plan(model, domain, problem.goal, None)
    return made, problem, made._bound(model, plan.grid), plan.grid, plan.axes


def test_the_vehicle_needs_no_declared_growth_bound() -> None:
    """Mean widths over all headings and inputs: close to those of the successors themselves, and below the declared ones."""
    _, problem, grown, grid, axes = published()
    low, high = View(grid, (2,)).cells(0, grid.counts[2])
    points = combined(axes)[::8]
    n, m = len(low), len(points)
    rows = np.repeat(low, m, axis=0), np.repeat(high, m, axis=0), np.tile(points, (n, 1))
    box, reached, declared = Enclosed(problem.model).over(*rows), hull(problem.model, *rows, draws=20), grown.over(*rows)
    assert box.contains(reached).all()
    widths = [b.width.mean(axis=0) for b in (reached, box, declared)]
    assert (widths[1] < widths[0] + 2e-4).all()
    assert (widths[1][:2] < 0.96 * widths[2][:2]).all()


@pytest.mark.exam
def test_more_of_the_vehicle_s_cells_win_without_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """48,647 cells beyond the 140 of the target: as many as with the exact box of each cell's successors. More still where
    steering straight on keeps the heading, and so its cell, of which the closed box touches both neighbours.
    """
    made, problem, *_ = published()
    made = replace(made, growth=None)
    assert made.synthesize(replace(problem)).evidence["winning_cells"] == 53_046 + 140
    monkeypatch.setattr(Enclosed, "unmoved", lambda self, u: np.zeros((len(u), self.model.nx), dtype=bool))
    assert made.synthesize(replace(problem)).evidence["winning_cells"] == 48_647 + 140
