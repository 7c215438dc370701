"""Two Systems whose numbers are compared carry the same units."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import gapcert as gc
from gapcert.certification.compatibility import unpaired
from gapcert.contracts.data.recording import Recording
from gapcert.contracts.data.units import same_unit
from gapcert.testing.toys import Drift
from gapcert_cells.testing import rod_problem
from gapcert_closed_loop.closed_loop import closed_loop
from gapcert_compare.laboratory import misfit


class Said(gc.Backend):
    """A drift whose first state and input are declared otherwise."""

    def __init__(self, state: str = "m", speed: str = "m/s", kind: Any = "real") -> None:
        self.states, self.inputs, self.period = (gc.StateSpec("x0", state, kind),), (gc.StateSpec("u0", speed),), 0.1

    def _step(self, x: np.ndarray, u: np.ndarray, **options: Any) -> np.ndarray:
        return x + 0.1 * u


def asked(backend: gc.Backend, tmp_path, **options: Any) -> gc.Certificate:
    model = Drift(1)
    domain = gc.Domain.of(model, {"x0": (-1, 1), "u0": (-1, 1)})
    return gc.certify(model, backend, domain, folder=tmp_path / "run", **options)


@pytest.mark.parametrize(
    ("backend", "sentence"),
    [
        (
            Said("degC"),
            "certify: the backend does not fit the model: its state 'x0' is in 'degC', the model's in 'm'; .*declare",
        ),
        (Said("mm"), "its state 'x0' is in 'mm', the model's in 'm'"),
        (Said(speed="m"), "its input 'u0' is in 'm', the model's in 'm/s'"),
        (Said(kind="quaternion"), "its state 'x0' is of kind quaternion, the model's of kind real"),
    ],
)
def test_a_backend_in_other_units_is_refused_before_a_sample(tmp_path, backend, sentence):
    with pytest.raises(gc.UsageError, match=sentence):
        asked(backend, tmp_path)
    assert not (tmp_path / "run").exists()
    assert unpaired(Drift(1), backend) == misfit(Drift(1), backend) != ""


def test_units_that_are_written_otherwise_are_the_same(tmp_path):
    assert unpaired(Drift(1), Said("meter", "m s^-1")) == ""
    assert asked(Said("meter", "m*1/s"), tmp_path, sampling=gc.GridSampling((3, 3))).holds
    for a, b in [("N*m", "N m"), ("N*m", "newton*meter"), ("1/s", "s^-1"), ("kg*m/s^2", "N"), ("1", "rad")]:
        assert same_unit(a, b)
        assert same_unit(b, a)
    for a, b in [("degC", "K"), ("deg", "rad"), ("m", "K"), ("%", "1"), ("K", "widgets")]:
        assert not same_unit(a, b)
        assert not same_unit(b, a)


def test_an_angle_may_meet_a_number_in_the_same_unit():
    assert unpaired(Drift(1), Said(kind="angle")) == ""


def test_a_predictor_in_other_units_is_refused(tmp_path):
    other = Drift(1)
    other.states = (gc.StateSpec("x0", "mm"),)
    with pytest.raises(gc.UsageError, match="the predictor's model does not fit the model: its state 'x0' is in 'mm'"):
        asked(Said(), tmp_path, predictor=other, sampling=gc.GridSampling((3, 3)))


def test_a_controller_meets_no_system_in_other_units():
    problem = rod_problem()

    class Degrees(gc.Backend):
        states = tuple(gc.StateSpec(s.name, s.unit.replace("rad", "deg"), s.kind) for s in problem.model.states)
        inputs, period = problem.model.inputs, problem.model.period

        def _step(self, x: np.ndarray, u: np.ndarray, **options: Any) -> np.ndarray:
            return x

    from gapcert_symbolic.synthesizer import Symbolic

    controller = Symbolic({"theta": 12, "omega": 12}, {"torque": 3}).synthesize(problem)
    with pytest.raises(gc.UsageError, match="the system does not fit the controller: its state 'theta' is in 'deg'"):
        closed_loop(Degrees(), controller, np.zeros((1, 2)), 3)


def test_a_unit_whose_zero_lies_elsewhere_is_no_factor():
    log = Recording.of(np.arange(20.0), {"T": np.full(20, 20.0)}, {"T": "degC"})
    with pytest.raises(gc.UsageError, match=r"'T' is in degC, whose zero is 273\.15 K"):
        log.converted({"T": "K"})
