"""States that an input leaves exactly where they are stay in their cells; all others may touch the cells beside."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import touched

from gapcert import Box, Interval, Model
from gapcert_cells.testing import Band
from gapcert_equations.config import EquationsConfig
from gapcert_symbolic.cells.abstraction import windows
from gapcert_symbolic.cells.bounds import Enclosed, Grown
from gapcert_symbolic.cells.gaps import disturbance
from gapcert_symbolic.cells.grid import Grid, spaced


def model(**given: Any) -> Model:
    from gapcert_equations.model import EquationsModel

    base = {
        "kind": "equations",
        "states": {"x": "1", "y": "1"},
        "inputs": {"u": "1", "v": "1"},
        "period": "0.3 s",
        "parameters": {"b": "2 1/s"},
    }
    return EquationsModel(EquationsConfig.model_validate(base | given))


MODELS = [
    ({"derivative": {"x": "b*u*cos(y)", "y": "u*tan(v)*b"}, "integrator": "rk4", "substeps": 3}, "u", "uv"),
    ({"derivative": {"x": "b*(u + sin(v))", "y": "v*x*y*b"}, "integrator": "euler"}, "", "v"),
    ({"derivative": {"x": "b*(u - v)*x", "y": "b*cos(u)"}, "integrator": "rk4"}, "", ""),
    ({"next": {"x": "x + h*b*u*v**2", "y": "y + u/3"}}, "uv", "u"),
    ({"next": {"x": "x + u/(1 + y**2)", "y": "y + max(u, v)"}}, "", ""),
    ({"next": {"x": "y", "y": "y*(1 + v)"}}, "", ""),
    ({"next": {"x": "x + u**(-2)", "y": "y + v**3"}}, "", "v"),
]


@pytest.mark.parametrize(("given", "x", "y"), MODELS)
def test_states_that_do_not_move(given: dict[str, Any], x: str, y: str) -> None:
    """x, y: the inputs of which a single zero suffices; both being zero is told where one is."""
    made, rng = model(**given), np.random.default_rng(0)
    u = np.array([[0.0, 0.7], [0.7, 0.0], [0.3, -0.4], [-0.0, -0.0], [1e-320, 1e-320]])
    found = made.unmoved(u)
    for k, by in enumerate((x, y)):
        assert found[0, k] == ("u" in by)
        assert found[1, k] == ("v" in by)
        assert not found[2, k]
        assert not found[4, k]
        assert found[3, k] >= bool(by)
    for row, which in zip(u, found, strict=True):
        start = rng.normal(size=(200, 2)) * 10.0 ** rng.integers(-12, 6, (200, 1))
        after = made.step(start, np.tile(row, (200, 1))).x
        assert (after[:, which] == start[:, which]).all()


def test_nothing_is_known_of_friction_and_of_what_is_remembered() -> None:
    late = model(next={"x": "x + u", "y": "y + v"}, input_delay={"u": "0.1 s"})
    assert not late.unmoved(np.zeros((1, 2))).any()


def test_windows_of_states_that_do_not_move() -> None:
    made = model(derivative={"x": "b*u/2", "y": "b*v*x/2"}, integrator="rk4")
    grid = Grid(Box(made.states, (0.1, 0.1), (0.9, 0.9)), (8, 8))
    axes = (spaced(-0.9, 0.9, 7), spaced(-0.9, 0.9, 7))
    assert (axes[0] == 0).sum() == 1
    assert (np.abs(np.linspace(-0.9, 0.9, 7)) > 0).all()
    pairs = [v.ravel() for v in np.meshgrid(np.arange(grid.size), np.arange(49), indexing="ij")]
    u, own = pairs[1] // 7, np.stack(np.unravel_index(pairs[0], grid.counts), axis=1)

    def width(bound: Any, gap: Any = None) -> np.ndarray:
        added = None if gap is None else disturbance(gap, grid, axes)
        first, last = touched.ends(windows(bound, grid, axes, added), *pairs)
        inside = (first >= 0).all(axis=1) & (last < 8).all(axis=1)
        still = inside & (u == 3)
        assert still.sum() > 100
        assert (first[still] <= own[still])[:, 0].all()
        return (last - first)[still, 0]

    assert (width(Enclosed(made)) == 0).all()
    # With a gap, or a bound that is declared, what touches the cells beside may be there.
    assert (width(Enclosed(made), Band((-1e-6, 0.0), (1e-6, 0.0))) == 2).all()
    assert (width(Enclosed(made), Band((0.0, -1e-6), (0.0, 1e-6))) == 0).all()
    assert (width(Grown(made, model(next={"x": "x", "y": "y"}), np.full(2, 1e-9))) == 2).all()


def test_a_wrong_claim_loses_successors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Were states told to stay that move, there are points whose successors are in no window."""
    from gapcert_equations.model import EquationsModel

    made = model(derivative={"x": "b*u/2", "y": "b*v*x/2"}, integrator="rk4")
    grid, axes = Grid(Box(made.states, (0.0, 0.0), (1.0, 1.0)), (8, 8)), (np.array([0.0, 0.2]),) * 2
    rng = np.random.default_rng(1)

    def lost() -> int:
        x, which = rng.random((2000, 2)), rng.integers(0, 4, 2000)
        points = np.stack([axes[0][which // 2], axes[1][which % 2]], axis=1)
        cell = np.ravel_multi_index(tuple((x * 8).astype(int).T), grid.counts)
        first, last = touched.ends(windows(Enclosed(made), grid, axes, None), cell, which)
        after = np.floor(made.step(x, points).x * 8)
        return int(((after < first) | (after > last)).any(axis=1).sum())

    assert lost() == 0
    monkeypatch.setattr(EquationsModel, "unmoved", lambda self, u: np.ones((len(u), 2), dtype=bool))
    assert lost() > 0


def test_values_keep_their_ends() -> None:
    for low, high, n in ((-1.0, 1.0, 5), (-0.9, 0.9, 7), (1e-20, 1.0, 4), (-1.0, -1e-20, 3), (0.0, 1.0, 2), (2.0, 2.0, 1)):
        found = spaced(low, high, n)
        assert (found[0], found[-1] if n > 1 else high) == (low, high)
        assert np.allclose(found, np.linspace(low, high, n), rtol=1e-15, atol=1e-15)


def test_equations_enclose_what_their_mean_value_form_does() -> None:
    """The bound of successors is no wider than the mean-value form about the middle."""
    made, rng = (
        model(derivative={"x": "b*u*cos(y)", "y": "u*tan(v)*b"}, integrator="rk4", substeps=3),
        np.random.default_rng(2),
    )
    low = rng.normal(size=(50, 2))
    high, u = low + 0.2 * rng.random((50, 2)), rng.uniform(-1, 1, (50, 2))
    plain = Enclosed(made).over(low, high, u)
    z = Interval(np.concatenate([low, u], axis=1), np.concatenate([high, u], axis=1))
    centre = z[:, :2].mid
    at = made.enclosure(Interval.exact(np.concatenate([centre, u], axis=1)))
    slopes = made.jacobian_enclosure(z)[:, :, :2]
    both = (slopes * (z[:, :2] - centre).reshape(50, 1, 2)).sum(-1) + at
    assert (plain.lo >= both.lo - 1e-12).all()
    assert (plain.hi <= both.hi + 1e-12).all()
