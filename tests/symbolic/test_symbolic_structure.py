"""What successors depend on is told by slopes that do not vary, and f is asked once for axes that depend on the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gapcert import Box, Interval, Model, registry
from gapcert_equations.config import EquationsConfig
from gapcert_symbolic.cells.abstraction import windows
from gapcert_symbolic.cells.bounds import Enclosed, Grown, structure
from gapcert_symbolic.cells.grid import Grid, combined
from gapcert_symbolic.solvers import affine

INPUTS = np.linspace(-1.0, 1.0, 5), np.linspace(-0.5, 0.5, 3)


def trusted(model: Model) -> Grown:
    """A bound in floating point."""
    return Grown(model, model, np.zeros(len(model.states)))


def made(**section: Any) -> Model:
    config = EquationsConfig(
        kind="equations", inputs={"v": "m/s", "s": "rad"}, parameters={"L": "1 m", "tau": "1 s"}, period="0.3 s", **section
    )
    model = registry().build("model", "equations", config)
    assert isinstance(model, Model)
    return model


def car(**section: Any) -> Model:
    rates = {"x": "v*cos(h)", "y": "v*sin(h)", "h": "v*tan(s)/L"}
    given = {"derivative": rates, "integrator": "rk4", "substeps": 2} | section
    return made(states={"x": "m", "y": "m", "h": "rad"}, **given)


def grid(model: Model) -> Grid:
    n = len(model.states)
    return Grid(Box(model.states, (-1.0,) * n, (1.0,) * n), (7, 6, 5)[:n])


def test_slopes_of_the_car() -> None:
    slope = car().constant_slopes()
    nan = np.nan
    expected = [[1, 0, nan, nan, nan], [0, 1, nan, nan, nan], [0, 0, 1, nan, nan]]
    assert np.array_equal(np.asarray(slope), np.array(expected), equal_nan=True)


def test_slopes_of_an_affine_map_are_its_matrix() -> None:
    model = made(states={"p": "m", "q": "m"}, next={"p": "p + q/4 + 2*v*tau", "q": "q/2 - 0*p"})
    assert np.allclose(np.asarray(model.constant_slopes()), [[1, 0.25, 2, 0], [0, 0.5, 0, 0]], atol=1e-15)
    parts = structure(trusted(model), grid(model), INPUTS)
    assert [(p.on, p.moves, p.inputs) for p in parts] == [((1,), True, (True, False)), ((1,), False, (False, False))]


def test_slopes_at_an_input() -> None:
    """What multiplies a state is a slope that is constant where the input is given."""
    model = made(states={"p": "m", "q": "m"}, next={"p": "p + q*s", "q": "q/2 + v*tau"})
    assert np.isnan(np.asarray(model.constant_slopes())[0, 1])
    assert np.allclose(np.asarray(model.constant_slopes(np.array([3.0, 0.25])))[:, :2], [[1, 0.25], [0, 0.5]], atol=1e-15)
    radius = made(states={"p": "m", "q": "m"}, next={"p": "p + q*abs(s)", "q": "q/2"})
    cells, axes = grid(model), (np.linspace(-0.2, 0.2, 3), np.linspace(-0.1, 0.1, 3))
    bound, points = Grown(model, radius, cells.widths * 1e-10), combined(axes)
    slope = affine.known(bound, points)
    assert slope is not None
    assert slope.contains(np.array([[[1, s], [0, 0.5]] for _, s in points])).all()
    assert slope.width.max() < 1e-13
    found = affine.maps(bound, cells, axes, None, None)
    assert found is not None
    assert affine.invariance(found, cells, np.ones(cells.size, dtype=bool))[0].dtype == np.int8
    # Enclosures are to be proved, and then slopes in floating point do not do.
    assert affine.known(Enclosed(model), points) is None
    assert affine.known(Grown(car(), car(), np.zeros(3)), points) is None


def test_slopes_are_kept_with_the_model(monkeypatch: pytest.MonkeyPatch) -> None:
    model = made(states={"p": "m", "q": "m"}, next={"p": "p + q*s", "q": "q/2 + v*tau"})
    u, other = np.array([3.0, 0.25]), np.array([3.0, 0.5])
    first, of_all, second = (model.constant_slopes(v) for v in (u, None, other))
    assert first is not None
    assert first[0, 1] == 0.25 != np.asarray(second)[0, 1]
    kept = first.copy()
    first[:] = 0.0  # what the caller does with its own is no concern of the model
    monkeypatch.setattr(type(model), "_slopes", None)
    assert np.array_equal(np.asarray(model.constant_slopes(u)), kept, equal_nan=True)
    assert np.array_equal(np.asarray(model.constant_slopes()), np.asarray(of_all), equal_nan=True)
    with pytest.raises(TypeError):
        model.constant_slopes(np.array([3.0, 0.75]))


def test_the_same_is_told_by_slopes_as_by_enclosures(monkeypatch: pytest.MonkeyPatch) -> None:
    model = car()
    told = structure(trusted(model), grid(model), INPUTS)
    with monkeypatch.context() as patch:
        patch.setattr(type(model), "jacobian_enclosure", None)
        assert structure(trusted(model), grid(model), INPUTS) == told
    # Bounds that are rounded outwards rest on slopes that are.
    monkeypatch.setattr(type(model), "constant_slopes", None)
    looked = structure(Enclosed(model), grid(model), INPUTS)
    assert [(p.on, p.moves, p.inputs) for p in looked] == [(p.on, p.moves, p.inputs) for p in told]
    assert [p.on for p in told] == [(2,), (2,), ()]


def test_axes_that_depend_on_the_same_are_asked_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    model, asked, over = car(), list[int](), Enclosed.over

    def counted(self: Enclosed, low: np.ndarray, *given: np.ndarray) -> Interval:
        asked.append(len(low))
        return over(self, low, *given)

    monkeypatch.setattr(Enclosed, "over", counted)
    found = windows(Enclosed(model, groups=False), grid(model), INPUTS, None)
    assert sorted(asked) == [15, 75]
    assert [a.first.shape for a in found.axes] == [(5, 15), (5, 15), (1, 15)]
