"""A user's function as a model: only with permission, and only what it can know."""

import pickle
from pathlib import Path

import numpy as np
import pytest

import gapcert as gc
from gapcert_equations.config import PythonConfig

SOURCE = """
import numpy as np
from gapcert import Interval

def step(x, u, k):
    return x + 0.1 * np.concatenate([x[:, 1:], u - k * np.sin(x[:, :1])], axis=1)

def linear(x, u, k):
    first, second = x[:, 0] + 0.1 * x[:, 1], x[:, 1] + 0.1 * u[:, 0] - 0.1 * k * x[:, 0]
    return Interval.stack([first, second], 1) if isinstance(x, Interval) else np.stack([first, second], 1)

def slope(x, u, k):
    j = np.broadcast_to([[1, 0.1, 0], [-0.1 * k, 1, 0.1]], (len(x), 2, 3))
    return Interval.exact(j) if isinstance(x, Interval) else j

def wrong(x, u, k):
    return x[:, 0]

def failing(x, u, k):
    raise ValueError("no such regime")

number = 3
"""
CONFIG = {
    "kind": "python",
    "function": "mine:step",
    "states": {"q": "m", "v": "m/s"},
    "inputs": {"u": "m/s^2"},
    "parameters": {"k": {"value": 2, "tolerance": "10 %"}},
    "period": "100 ms",
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "mine.py").write_text(SOURCE)
    return tmp_path


def build(folder: Path, allow: bool = True, **changes) -> gc.Model:
    config = PythonConfig.model_validate(CONFIG | changes)
    return gc.registry().get("model", "python").load().from_config(config, gc.Context(folder=folder, allow_code=allow))


def test_code_runs_only_with_permission(folder):
    with pytest.raises(gc.UsageError, match="--allow-code"):
        build(folder, allow=False)


def test_step_parameters_and_jacobian(folder):
    model = build(folder)
    x, u = np.random.default_rng(0).normal(size=(5, 2)), np.ones((5, 1))
    np.testing.assert_array_equal(model.step(x, u).x[:, 1], x[:, 1] + 0.1 * (1 - 2 * np.sin(x[:, 0])))
    np.testing.assert_array_equal(model.step(x, u, parameters={"k": 0.0}).x[:, 1], x[:, 1] + 0.1)
    varied = model.step(x, u, parameters={"k": np.array([0.0, 2.0, 0.0, 2.0, 1.0])}).x
    assert np.array_equal(varied[1], model.step(x, u).x[1])
    assert np.array_equal(varied[2], model.step(x, u, parameters={"k": 0.0}).x[2])
    jacobian = model.jacobian(x, u)
    np.testing.assert_allclose(jacobian[:, 1, 0], -0.2 * np.cos(x[:, 0]), atol=1e-9)
    copy = pickle.loads(pickle.dumps(model))
    assert copy.digest() == model.digest()
    assert np.array_equal(copy.step(x, u).x, model.step(x, u).x)
    assert model.parameters[0].tolerance == 0.2
    assert "def step" in model.equations()
    assert PythonConfig.model_validate(model.to_spec()) == model.config


def test_ranges_need_a_function_of_intervals(folder):
    box = gc.Interval(np.zeros((1, 3)), np.ones((1, 3)))
    with pytest.raises(gc.UsageError, match="use kind: equations"):
        build(folder).enclosure(box)
    with pytest.raises(gc.UsageError, match="use kind: equations"):
        build(folder, function="mine:linear", intervals=True).jacobian_enclosure(box)
    model = build(folder, function="mine:linear", jacobian="mine:slope", intervals=True)
    points = np.random.default_rng(0).random((50, 3))
    assert model.enclosure(box).contains(model.step(points[:, :2], points[:, 2:]).x).all()
    assert model.jacobian_enclosure(box).contains(model.jacobian(points[:, :2], points[:, 2:])).all()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"function": "nowhere:step"}, "cannot import 'nowhere'"),
        ({"function": "mine:stepp"}, "no function 'stepp'"),
        ({"function": "mine:number"}, "no function 'number'"),
        ({"period": "1 kg"}, "positive time"),
        ({"states": {"q": "mm", "v": "m/s"}}, "use m"),
    ],
)
def test_what_cannot_be_used(folder, changes, words):
    with pytest.raises(gc.UsageError, match=words):
        build(folder, **changes)


def test_a_wrong_shape_and_effects_are_refused(folder):
    with pytest.raises(gc.UsageError, match=r"returned shape \(2,\); expected \(2, 2\)"):
        build(folder, function="mine:wrong").step(np.zeros((2, 2)), np.zeros((2, 1)))
    with pytest.raises(gc.UsageError, match="cannot be extended"):
        build(folder).extend([gc.plugin.Extension("viscous-friction", "q", (), force="-{v}")])
    assert build(folder).sites("coordinate") == ()


def test_a_fault_of_the_users_function_is_told_as_theirs(folder):
    with pytest.raises(gc.UsageError, match="mine:failing: raised ValueError: no such regime"):
        build(folder, function="mine:failing").step(np.zeros((2, 2)), np.zeros((2, 1)))


def test_installed_modules_are_found_too(tmp_path):
    model = build(tmp_path, function="numpy:add", parameters={})
    assert model.step(np.ones((1, 2)), np.ones((1, 1))).x.tolist() == [[2.0, 2.0]]
