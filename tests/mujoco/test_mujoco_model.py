"""A robot in MuJoCo as the simulation: the engine's own steps, causes in its own terms, and its file written back."""

import difflib

import numpy as np
import pytest

import gapcert as gc
import gapcert_engines
from gapcert.testing import multisine
from gapcert_mujoco.config import MuJoCoConfig

pytestmark = [pytest.mark.needs("mujoco"), pytest.mark.contract]


ROD = """<mujoco>
  <!-- a rod that hangs; <joint name="hinge"/> in a comment is none -->
  <option timestep="0.002" integrator="{integrator}"/>
  <compiler angle="radian"/>
  <worldbody>
    <body name="rod"><joint name="hinge" axis="0 1 0" armature="0.01"/>  <!-- frictionless -->
      <inertial pos="0 0 -0.5" mass="1" diaginertia="0.09 0.09 0.001"/>
    </body>
  </worldbody>
</mujoco>
"""
# Two joints on one body, a slide, joints beside the origin of their bodies, and a body that is welded to another.
TREE = """<mujoco><option gravity="0.4 -0.2 -9.81" timestep="0.001"/><compiler angle="radian"/><worldbody>
  <body name="a" pos="0.1 0 0.2" quat="0.8 0.6 0 0"><joint name="j1" axis="0 1 0.2" pos="0.1 0 0.05" damping="0.3"/>
    <joint name="j2" axis="1 0 0" pos="0 0.02 0" armature="0.02"/>
    <inertial pos="0.1 0 -0.2" quat="0.5 0.5 -0.5 0.5" mass="1.3" diaginertia="0.02 0.03 0.04"/>
    <body name="plate" pos="0 0.1 -0.1" quat="0.6 0 0.8 0"><inertial pos="0.02 0 0" mass="0.4" diaginertia="0.01 0.02 0.015"/>
      <body name="b" pos="0.2 0 -0.3"><joint name="j3" type="slide" axis="0 0.3 1" damping="2"/>
        <inertial pos="0 0.05 -0.1" mass="0.7" diaginertia="0.01 0.01 0.02"/>
        <body name="c" pos="0 0 -0.2"><joint name="j4" axis="0 0 1" pos="0.03 0 0" armature="0.005"/>
          <inertial pos="0.1 0 0" mass="0.5" diaginertia="0.004 0.005 0.006"/></body></body></body></body>
</worldbody></mujoco>"""


def states(joints):
    return {f"{j}{end}": f"{j}.{kind}" for kind, end in (("position", ""), ("velocity", "_dot")) for j in joints}


def backend(folder, text, joints=("hinge",), inputs=None, **options):
    from gapcert_mujoco.engine import MuJoCoEngine

    (folder / "robot.xml").write_text(text)
    section = {"kind": "mujoco", "robot": "robot.xml", "states": states(joints), "inputs": inputs or {"u": joints[0]}}
    config = MuJoCoConfig.model_validate(section | {"period": "4 ms"} | options)
    return gapcert_engines.EngineBackend(MuJoCoEngine(config, folder=folder))


def simulation(system, tolerances=None):
    known = {p.name: p for p in system.parameters}
    loose = [
        gc.Parameter(n, known[n].value, known[n].unit, t, known[n].low, known[n].high) for n, t in (tolerances or {}).items()
    ]
    return gapcert_engines.EngineModel(system, loose)


@pytest.mark.exam
@pytest.mark.parametrize(("integrator", "damping"), [("Euler", None), ("implicitfast", None), ("Euler", "explicit")])
@pytest.mark.parametrize("substeps", [1, 4])
def test_a_tree_moves_as_in_the_engine(tmp_path, integrator, damping, substeps):
    text = TREE.replace("<option ", f'<option integrator="{integrator}" ')
    options = {} if damping is None else {"euler_damping": damping}
    system = backend(tmp_path, text, ("j1", "j2", "j3", "j4"), {"u": "j1", "w": "j3"}, substeps=substeps, **options)
    model = simulation(system)
    rng = np.random.default_rng(0)
    x, u = 0.5 * rng.normal(size=(8, model.nx)), rng.normal(size=(8, 50, model.nu))
    order = [[s.name for s in system.states].index(s.name) for s in model.states]
    at = np.empty_like(x)
    at[:, order] = x
    np.testing.assert_allclose(model.fast_rollout(x, u).x, system.rollout(at, u).x[:, :, order], rtol=0, atol=1e-9)


def test_states_must_be_complete_and_named_alike(tmp_path):
    text = ROD.format(integrator="Euler")
    for named, told in (
        ({"q": "hinge.position", "w": "hinge.velocity"}, "call it q_dot"),
        ({"q": "hinge.position"}, "are in no state"),
    ):
        with pytest.raises(gc.UsageError, match=told):
            simulation(backend(tmp_path, text, states=named))


def test_equations_that_are_not_the_engines_are_noticed(tmp_path, monkeypatch):
    from gapcert_mujoco.engine import MuJoCoEngine

    system, section = backend(tmp_path, ROD.format(integrator="Euler")), MuJoCoEngine.section

    def heavier(engine, *given):
        found = section(engine, *given)
        if found is not None:
            found["bodies"]["rod"]["mass"] = "1.001"
        return found

    model = simulation(system)
    assert any(v.native for v in model.variants())
    monkeypatch.setattr(MuJoCoEngine, "section", heavier)
    for wrong in (lambda: simulation(system), lambda: model.restated({"armature_hinge": 0.02})):
        with pytest.raises(gc.UsageError, match=r"the engine's step differs from that of its bodies by .* in hinge_dot"):
            wrong()
    assert not any(v.native for v in model.variants())


@pytest.mark.exam
def test_models_of_one_robot_share_what_was_recorded_of_it(tmp_path):
    text = TREE.replace("<option ", '<option integrator="implicitfast" ')
    model = simulation(backend(tmp_path, text, ("j1", "j2", "j3", "j4"), {"u": "j1", "w": "j3"}, substeps=2))
    own, stated = model.inner.definition, {p.name: p.value for p in model.parameters}
    restated = model.restated(stated | {"armature_j2": 0.03})
    assert restated.inner.definition.dynamics.tape is own.dynamics.tape
    assert restated.inner.program is model.inner.program
    rng = np.random.default_rng(0)
    x, u = 0.5 * rng.normal(size=(8, model.nx)), rng.normal(size=(8, 50, model.nu))
    assert np.abs(restated.step(x, u[:, 0]).x - model.step(x, u[:, 0]).x).max() > 1e-6
    variants = {(v.setting, v.value): v.model for v in model.variants()}
    assert variants["substeps", 3].inner.definition.dynamics.tape is own.dynamics.tape
    for other in (restated, *variants.values()):
        assert other.inner.definition.recorder is own.recorder
        alone = type(other.inner)(other.inner.config)
        np.testing.assert_array_equal(other.step(x, u[:, 0]).x, alone.step(x, u[:, 0]).x)
        np.testing.assert_array_equal(other.fast_rollout(x, u).x, alone.fast_rollout(x, u).x)


def test_copies_are_set_to_new_values_where_these_are_asked_for_again(tmp_path):
    system = backend(tmp_path, TREE, ("j1", "j2", "j3", "j4"), {"u": "j1"}, tiles=16)
    assert system.tiling.startswith("16 copies")
    x, u, heavier = np.ones((8, system.nx)), np.zeros((8, 1)), {"mass.b": np.full(8, 0.8)}
    blocks, advance = [], system._world(16).advance
    system._world(16).advance = lambda *given: blocks.append(1) or advance(*given)
    once = system.step(x, u, parameters=heavier).x
    assert not blocks
    np.testing.assert_array_equal(system.step(x, u, parameters=heavier).x, once)
    assert blocks


def recorded(system, noise=0.01, **natives):
    u = multisine(10.0, system.period, 2.0, (0.1, 3.0), 3)
    given = {n.replace("_hinge", ".hinge").replace("_rod", ".rod"): np.array([v]) for n, v in natives.items()}
    x = system.rollout(np.array([[0.3, 0.0]]), u[None], parameters=given or None).x[0, :-1]
    y = x[:, 0] + noise * np.std(x[:, 0]) * np.random.default_rng(0).standard_normal(len(x))
    return gc.Recording.of(np.arange(len(u)) * system.period, {"hinge": y, "u": u[:, 0]})


@pytest.mark.exam
def test_causes_have_the_engines_names_and_go_back_into_its_file(tmp_path):
    text = ROD.format(integrator="Euler")
    system = backend(tmp_path, text)
    model = simulation(system, {"mass.rod": 0.02})
    assert gc.diagnose(model, recorded(system), horizons=[0.5]).verdict == "nothing"
    found = gc.diagnose(model, recorded(system, damping_hinge=0.05, mass_rod=1.2), horizons=[0.5])
    assert {(c.effect, c.native) for c in found.causes} == {("viscous-friction", "damping.hinge"), ("parameter", "mass.rod")}
    extended = found.extended_model
    assert extended.natives() == pytest.approx({"damping.hinge": 0.05, "mass.rod": 1.2}, rel=0.05)
    (name, patched), before = *extended.files().items(), (tmp_path / "robot.xml").read_text()
    assert (name, before) == ("extended.xml", text)
    changed = [line for line in difflib.ndiff(text.splitlines(), patched.splitlines()) if line[0] in "+-"]
    assert len(changed) == 4
    assert "<!-- a rod that hangs; <joint" in patched
    folder = tmp_path / "patched"
    folder.mkdir()
    again = backend(folder, patched)
    rng = np.random.default_rng(1)
    x, u = rng.normal(size=(4, 2)), rng.normal(size=(4, 60, 1))
    np.testing.assert_allclose(again.rollout(x, u).x, extended.rollout(x, u).x, rtol=0, atol=1e-9)
    assert np.abs(system.rollout(x, u).x - extended.rollout(x, u).x).max() > 0.01


@pytest.mark.parametrize("damping", ["explicit", "implicit"])
def test_damping_acts_as_the_engine_solves_it(tmp_path, damping):
    system = backend(tmp_path, ROD.format(integrator="Euler"), euler_damping=damping)
    model = simulation(system)
    effect = gc.registry().build("effect", "viscous-friction")
    damped = model.extend([effect.extension("hinge", model)])
    rng = np.random.default_rng(2)
    x, u, level = rng.normal(size=(4, 2)), rng.normal(size=(4, 60, 1)), np.full(4, 0.4)
    own = damped.rollout(x, u, parameters={damped.parameters[-1].name: level}).x
    np.testing.assert_allclose(own, system.rollout(x, u, parameters={"damping.hinge": level}).x, rtol=0, atol=1e-9)


def test_its_digest_tells_models_apart_and_does_not_change_with_use(tmp_path):
    system = backend(tmp_path, ROD.format(integrator="Euler"))
    model = simulation(system)
    before = model.digest()
    system.step(np.zeros((40, 2)), np.zeros((40, 1)))
    assert model.digest() == before == simulation(system).digest()
    drag = gc.registry().build("effect", "quadratic-drag")
    assert model.extend([drag.extension("hinge", model)]).digest() != before


def test_an_effect_that_the_engine_lacks_stays_out_of_its_file(tmp_path):
    model = simulation(backend(tmp_path, ROD.format(integrator="Euler")))
    drag = gc.registry().build("effect", "quadratic-drag")
    extended = model.extend([drag.extension("hinge", model)])
    assert extended.native("quadratic-drag", "hinge") is None
    assert extended.natives() == {}
    ((name, told),) = extended.files().items()
    assert name == "not_in_the_file.txt"
    assert told.startswith("quadratic-drag at hinge: force -quadratic_drag_hinge*{v}*abs({v}); with quadratic_drag_hinge = ")
