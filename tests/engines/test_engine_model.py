"""Model `engine` in a spec: its section, its period, and what is wrong with it."""

from pathlib import Path

import numpy as np
import pytest

import gapcert as gc

pytestmark = [pytest.mark.contract, pytest.mark.needs("mujoco")]

SPEC = """version: 1
name: rod
model:
  kind: engine
  of: {kind: mujoco, robot: robot.urdf, states: {q: hinge.position, q_dot: hinge.velocity}, inputs: {u: hinge}}
  parameters: {mass.rod: 2 %, armature.hinge: {value: 0.01, tolerance: 0.001}}
recording: {kind: csv, files: [log.csv], time: t, columns: {q: q, u: u}}
diagnose: {effects: [viscous-friction, quadratic-drag, parameter], hold_out: {last: 25 %}, horizons: [0.5 s]}
expect: {verdict: causes, causes: [viscous-friction]}
"""
ROBOT = """<robot name="r"><link name="world"/><link name="rod"><inertial><origin xyz="0 0 -0.5"/><mass value="1"/>
<inertia ixx="0.09" ixy="0" ixz="0" iyy="0.09" iyz="0" izz="0.001"/></inertial></link>
<joint name="hinge" type="continuous"><parent link="world"/><child link="rod"/><axis xyz="0 1 0"/></joint></robot>
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "robot.urdf").write_text(ROBOT)
    (tmp_path / "spec.yaml").write_text(SPEC)
    (tmp_path / "log.csv").write_text("t,q,u\n")
    t = 0.005 * np.arange(2000)
    u = 2 * np.sin(3 * t) + np.sin(7.7 * t)
    spec = gc.load_spec(tmp_path / "spec.yaml")
    truth = gc.registry().build("model", "engine", spec.config.model, gc.Context(folder=tmp_path, period=0.005))
    real = {"damping.hinge": np.array([0.06]), "armature.hinge": np.array([0.01])}
    x = truth.backend.rollout(np.array([[0.3, 0.0]]), u[None, :, None], parameters=real).x[0, :-1, 0]
    y = x + 0.002 * np.random.default_rng(0).standard_normal(len(x))
    np.savetxt(tmp_path / "log.csv", np.stack([t, y, u], axis=1), delimiter=",", header="t,q,u", comments="")
    return tmp_path


@pytest.mark.exam
def test_a_spec_with_an_engine_as_the_simulation(folder):
    run = gc.run(folder / "spec.yaml", out=folder / "runs")
    (cause,) = run.summary["causes"]
    assert (cause["effect"], cause["site"], cause["native"]) == ("viscous-friction", "q", "damping.hinge")
    assert cause["parameters"]["coefficient"]["value"] == pytest.approx(0.06, rel=0.05)
    patched, code = run.summary["files"]
    assert '<dynamics damping="0.0' in Path(patched).read_text()
    # A URDF file has no word for armature.
    names: dict = {}
    exec(Path(code).read_text().replace('"extended.urdf"', repr(patched)), names)
    assert names["model"].dof_armature[0] == pytest.approx(0.01, abs=0.001)
    assert names["model"].dof_damping[0] == pytest.approx(0.06, rel=0.05)
    assert all(e["met"] for e in run.summary["expectations"])
    # The extended model is a spec by itself, of equations.
    model = gc.load_spec(run.summary["extended_model"]).build("model")
    assert {"mass_rod", "armature_hinge"} < {p.name for p in model.parameters}


@pytest.mark.exam
@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("mass.rod: 2 %", "mass.rot: 2 %", "model.parameters: the engine has no 'mass.rot'; did you mean 'mass.rod'"),
        ("mass.rod: 2 %", "mass.rod: -1", "expected 0 or more, such as 2 %"),
        ("kind: mujoco", "kind: mujoko", "did you mean 'mujoco'"),
        ("q_dot: hinge.velocity", "w: hinge.velocity", "call it q_dot"),
        (
            "of: {kind",
            "of: {kind: stochastic, jitter: 1 ms, of: {period: 5 ms, kind",
            "'stochastic' is no physics engine on its own",
        ),
    ],
)
def test_what_is_wrong_with_the_section_is_told(folder, old, new, told):
    (folder / "bad.yaml").write_text(SPEC.replace(old, new).replace("u: hinge}}", "u: hinge}}" + "}" * new.count("stochastic")))
    with pytest.raises(gc.GapcertError) as error:
        gc.run(folder / "bad.yaml", out=folder / "runs")
    assert told in str(error.value)


def test_copies_are_made_when_a_large_query_comes(tmp_path, monkeypatch):
    (tmp_path / "robot.urdf").write_text(ROBOT)
    wires = {"states": {"q": "hinge.position", "q_dot": "hinge.velocity"}, "inputs": {"u": "hinge"}}
    section = gc.registry().config("backend", "mujoco")(robot="robot.urdf", period="5 ms", tiles=8, **wires)
    backend, made = gc.registry().build("backend", "mujoco", section, gc.Context(folder=tmp_path)), []
    opened = type(backend.engine).open
    monkeypatch.setattr(type(backend.engine), "open", lambda self, k, *rest: made.append(k) or opened(self, k, *rest))
    x, u = np.random.default_rng(0).uniform(-1, 1, (8, 2)), np.zeros((8, 1))
    few = np.concatenate([backend.step(x[k : k + 2], u[:2]).x for k in range(0, 8, 2)])
    assert made == [1]
    assert backend.step(x, u).x.tobytes() == few.tobytes()
    assert made == [1, 8]
    assert backend.tiling == "8 copies, bit-equal to one robot"
