"""What a plugin's own code does wrong is told as its own: the shape of an answer, a signature, an exception."""

from __future__ import annotations

import importlib.metadata
import pickle
import sys
from concurrent.futures import ProcessPoolExecutor
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import gapcert as gc
from gapcert.certification.samples.executors import processes
from gapcert.certification.samples.store import Store
from gapcert.cli import doctor
from gapcert.cli.main import main
from gapcert.contracts.plugins import fault_owner as blame
from gapcert.contracts.plugins import registry as components
from gapcert.contracts.systems.domain import Points
from gapcert.testing.toys import Drift

PLUGIN = """
import gapcert as gc
import numpy as np

@gc.hookimpl
def gapcert_components():
    return [gc.Component(kind="backend", name="vessel", summary="a vessel", target="vessel_plugin:Vessel")]


class Vessel(gc.Backend):
    def __init__(self):
        self.states, self.inputs, self.period = (gc.StateSpec("x0", "m"),), (gc.StateSpec("u0", "m/s"),), 0.1

    def _step(self, x, u, **options):
        def solve():
            raise RuntimeError("my solver diverged")
        if (x > 0.5).any():
            solve()
        return np.linalg.solve(np.zeros((1, 1)), x) if (x < -0.5).any() else x + 0.1 * u
"""


@pytest.fixture
def vessel(tmp_path, monkeypatch):
    """A third party's plugin, installed as an entry point of a distribution."""
    (tmp_path / "vessel_plugin.py").write_text(PLUGIN)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "vessel_plugin", raising=False)
    mine = SimpleNamespace(
        name="vessel", dist=SimpleNamespace(name="acme-vessel", version="2.1"), load=lambda: __import__("vessel_plugin")
    )
    found = components.discover([*importlib.metadata.entry_points(group="gapcert"), mine])
    monkeypatch.setattr(components, "installed", lambda: found)
    return found.build("backend", "vessel")


def raised(function: Any, *arguments: Any) -> BaseException:
    with pytest.raises(BaseException) as caught:  # noqa: PT011 (whatever it is)
        function(*arguments)
    return caught.value


def failing(x: float, vessel: gc.Backend) -> Any:
    return vessel.step(np.array([[x]]), np.zeros((1, 1)))


def test_an_exception_of_a_plugin_names_plugin_file_and_method(vessel, monkeypatch, capsys):
    error = raised(failing, 1.0, vessel)
    where = r"acme-vessel 2.1 (vessel_plugin.py:16, Vessel._step.solve)"
    assert blame.told(error) == f"error in plugin {where}: RuntimeError: my solver diverged"
    # What a library raises is of whoever asked it.
    assert "vessel_plugin.py:19, Vessel._step): LinAlgError" in str(blame.told(raised(failing, -1.0, vessel)))

    def command(*_: Any) -> Any:
        raise error

    monkeypatch.setattr(doctor, "examine", command)
    assert main(["doctor", "--json"]) == 70
    out = capsys.readouterr()
    assert f"error in plugin {where}: RuntimeError: my solver diverged; --debug shows all of it" in out.err
    assert "report it" not in out.err
    assert "my solver diverged; --debug shows all of it" in out.out


def test_what_is_not_a_plugins_fault_is_not_blamed_on_one(vessel):
    assert blame.told(ZeroDivisionError("1/0")) is None
    assert blame.told(raised(lambda: 1 / 0)) is None
    assert blame.told(raised(components.load, "gapcert.contracts.systems.system:Nothing")) is None


@pytest.mark.contract
def test_a_worker_process_tells_where_too(vessel):
    with processes(1) as pool:
        assert isinstance(pool, ProcessPoolExecutor)
        error = raised(pool.submit(vessel.step, np.array([[1.0]]), np.zeros((1, 1))).result)
    assert "acme-vessel 2.1 (vessel_plugin.py:16, Vessel._step.solve): RuntimeError" in str(blame.told(error))


def test_samples_that_fail_name_the_plugin(vessel, tmp_path):
    store = Store(tmp_path / "samples", gc.plugin.Residual(vessel, Drift(1)), "key")
    with pytest.raises(gc.UsageError, match=r"plugin acme-vessel 2.1 \(vessel_plugin.py:16, .*\) failed \(RuntimeError"):
        store.collect("bound-0", Points(np.array([[1.0, 0.0]])))


class Answers(gc.Backend):
    """Two states, and whatever answer is wanted."""

    def __init__(self, answer: Any, hidden: bool = False) -> None:
        self.states, self.inputs, self.period = (gc.StateSpec("a"), gc.StateSpec("b")), (gc.StateSpec("u"),), 0.1
        self.answer = answer
        if hidden:
            self.capabilities, self.hidden = frozenset({"hidden"}), (gc.StateSpec("h"),)
            self.hidden_default = (0.0,)

    def _step(self, x: np.ndarray, u: np.ndarray, **options: Any) -> Any:
        return self.answer


class Narrow(Answers):
    def _step(self, x: np.ndarray, u: np.ndarray) -> Any:  # type: ignore[override]
        return x


@pytest.mark.parametrize(
    ("system", "sentence"),
    [
        (
            Answers(np.zeros((4, 1))),
            r"Answers\._step returned \(4, 1\); expected \(4, 2\): one row per sample, one column per state",
        ),
        (Answers(np.zeros((3, 2))), r"returned \(3, 2\); expected \(4, 2\)"),
        (Answers(np.zeros(2)), r"returned \(2,\); expected \(4, 2\)"),
        (Answers(None), r"returned \(\); expected \(4, 2\)"),
        (Answers(np.zeros((4, 2), np.float32)), r"Answers\._step returned numbers of type float32; expected float64"),
        (Answers([[0.0, 0.0]] * 4), "returned numbers of type list; expected float64"),
        (Answers(gc.plugin.Step(np.zeros((4, 2)), np.zeros((4, 3))), True), r"returned hidden \(4, 3\); expected \(4, 1\)"),
        (Narrow(None, True), r"Narrow: .*unexpected keyword argument 'hidden'; expected _step\(self, x, u, \*\*options\)"),
    ],
)
def test_answers_of_another_shape_or_type_are_refused(system, sentence):
    with pytest.raises(gc.UsageError, match=sentence):
        system.step(np.zeros((4, 2)), np.zeros((4, 1)))


def test_a_type_error_within_a_step_stays_what_it_is():
    class Wrong(Answers):
        def _step(self, x: np.ndarray, u: np.ndarray, **options: Any) -> Any:
            return pickle.dumps()  # type: ignore[call-arg]

    with pytest.raises(TypeError, match="dumps"):
        Wrong(None).step(np.zeros((1, 2)), np.zeros((1, 1)))
