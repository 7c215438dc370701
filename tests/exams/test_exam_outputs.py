"""Misfits of outputs alone: plants that move as a model of their text does, and cases that are what they say."""

import numpy as np
import pytest
from exams import outputs

from gapcert_diagnosis.testing import equations


@pytest.mark.parametrize("name", outputs.NAMES)
def test_plants_move_as_their_equations_say(name):
    p, rng = outputs.plant(name, np.random.default_rng(5)), np.random.default_rng(6)
    values = {n: f"{v!r} {unit}" for n, (v, unit, _) in p.values.items()}
    said = {"states": dict(p.states), "inputs": dict(p.inputs), "parameters": values, "derivative": dict(p.derivative)}
    model = equations({**said, "kind": "equations", "outputs": p.outputs, "substeps": 8, "period": f"{p.slow / 20!r} s"})
    u = p.middle + 0.5 * p.peak * rng.uniform(-1, 1, 10).repeat(20)
    true = [v for v, _, _ in p.values.values()]
    x = outputs.motion(p, true, u, p.slow / 20, False, {0: np.array(p.rest)})
    again = model.rollout(np.array([p.rest]), u[None, :-1, None]).x[0]
    assert (np.abs(x - again).max(axis=0) < 1e-3 * np.ptp(x, axis=0)).all()
    y = outputs.shown(p, list(p.outputs), true, again, u)
    assert np.allclose(model.output(again, u[:, None]), y, rtol=1e-9, atol=1e-9 * np.abs(y).max())


def test_a_misfit_changes_its_output_alone_and_cannot_hide():
    for index in range(3):
        c, again = (outputs.case("t", 1, index, True) for _ in range(2))
        assert c.remains > outputs.LOUD
        assert c.site in c.view
        assert np.array_equal(c.y, again.y)
    calm = outputs.case("t", 1, 0, False)
    assert not calm.kind
    assert len(calm.recording().trajectories) == 1


@pytest.mark.exam
def test_an_answer_gives_way_to_a_tie_of_which_more_than_one_cause_differs():
    said = outputs.ask("outputs", 6203, 147, 300.0, True)
    assert "error" not in said
    assert said["verdict"] == "unexplained"
