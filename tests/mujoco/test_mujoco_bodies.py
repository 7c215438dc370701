"""Centres of mass and moments of inertia of a MuJoCo robot as native parameters."""

import numpy as np
import pytest

import gapcert as gc
import gapcert_engines
from gapcert.testing import multisine
from gapcert_mujoco.config import MuJoCoConfig

pytestmark = [pytest.mark.needs("mujoco"), pytest.mark.contract]


# Joints beside the origins of their bodies, askew inertias, one body with two joints, one without an inertial element, whose
# centre of mass is its origin.
ARM = """<mujoco><option timestep="0.002"/><compiler angle="radian"/><worldbody>
  <body name="a" pos="0.1 0 0.2" quat="0.8 0.6 0 0"><joint name="j1" axis="0 1 0.2" pos="0.1 0 0.05" damping="0.3"/>
    <joint name="j2" axis="1 0 0" pos="0 0.02 0" armature="0.02"/>
    <inertial pos="0.1 0 -0.2" quat="0.5 0.5 -0.5 0.5" mass="1.3" diaginertia="0.02 0.03 0.04"/>
    <body name="b" pos="0 0.1 -0.1" quat="0.6 0 0.8 0"><joint name="j3" axis="0 0.3 1" pos="0.01 0 0"/>
      <inertial pos="0.02 0.03 -0.1" mass="0.4" fullinertia="0.01 0.02 0.015 0.002 -0.001 0.003"/>
      <body name="c" pos="0 0 -0.3"><joint name="j4" axis="0 1 0"/>
        <geom type="box" size="0.02 0.03 0.1" mass="0.3" contype="0" conaffinity="0"/>
      </body></body></body></worldbody></mujoco>"""
ROD = """<mujoco><option timestep="0.002"/><compiler angle="radian"/><worldbody>
  <body name="rod"><joint name="hinge" axis="0 1 0"/>
    <inertial pos="0 0 -0.5" mass="1" diaginertia="0.09 0.09 0.001"/></body></worldbody></mujoco>"""
CHANGED = {"mass.b": 0.5, "inertia.b": 0.03, "com_x.b": -0.04, "com_y.b": 0.05}
CHANGED |= {"inertia.a": 0.06, "com_z.a": -0.1, "com_x.c": 0.04}


def backend(folder, text, joints, **options):
    from gapcert_mujoco.engine import MuJoCoEngine

    (folder / "robot.xml").write_text(text)
    states = {f"{j}{end}": f"{j}.{what}" for what, end in (("position", ""), ("velocity", "_dot")) for j in joints}
    section = {
        "kind": "mujoco",
        "robot": "robot.xml",
        "states": states,
        "inputs": {"u": joints[0]},
        "period": "4 ms",
        **options,
    }
    return gapcert_engines.EngineBackend(MuJoCoEngine(MuJoCoConfig.model_validate(section | options), folder=folder))


def simulation(system, tolerances, **values):
    known = {p.name: p for p in system.parameters}
    every = [(known[n], t) for n, t in tolerances.items()]
    return gapcert_engines.EngineModel(
        system, [gc.Parameter(p.name, values.get(p.name, p.value), p.unit, t, p.low, p.high) for p, t in every]
    )


def arm(folder, text=ARM, **options):
    return backend(folder, text, ("j1", "j2", "j3", "j4"), **options)


@pytest.mark.parametrize("tiles", [1, 3])
def test_the_engine_and_the_equations_move_alike(tmp_path, tiles):
    system = arm(tmp_path, tiles=tiles)
    model = simulation(system, dict.fromkeys(CHANGED, 0.01), **CHANGED)  # which is checked against the engine
    rng = np.random.default_rng(0)
    x, u = 0.5 * rng.normal(size=(6, model.nx)), rng.normal(size=(6, 30, 1))
    given = {n: np.full(6, v) for n, v in CHANGED.items()}
    changed = system.rollout(x, u, parameters=given).x
    np.testing.assert_allclose(model.rollout(x, u).x, changed, rtol=0, atol=1e-9)
    # The same numbers as parameters of equations that stand for others.
    stated = simulation(system, dict.fromkeys(CHANGED, 0.01))
    named = {n.replace(".", "_"): np.full(6, v) for n, v in CHANGED.items()}
    np.testing.assert_allclose(stated.rollout(x, u, parameters=named).x, changed, rtol=0, atol=1e-9)
    for name in CHANGED:
        less = {n: v for n, v in given.items() if n != name}
        assert np.abs(system.rollout(x, u, parameters=less).x - changed).max() > 1e-5, name


def test_they_go_into_the_file(tmp_path):
    import mujoco

    system = arm(tmp_path)
    values = CHANGED | {"inertia.c": 0.002, "com_z.c": -0.12, "mass.c": 0.4}
    files = system.engine.patched(values)
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    names: dict = {}
    code = files["extended.py"].replace('"extended.xml"', repr(str(tmp_path / "extended.xml")))
    exec(compile(code, "extended.py", "exec"), names)
    model, data = names["model"], mujoco.MjData(names["model"])
    x = np.array([[0.3, -0.2, 0.5, 0.4, 0.1, -0.3, 0.2, 0.6]])
    data.qpos[:], data.qvel[:], data.qfrc_applied[0] = x[0, :4], x[0, 4:], 0.7
    mujoco.mj_step(model, data, 1)
    mujoco.mj_step(model, data, 1)
    after = arm(tmp_path, substeps=2).step(x, np.array([[0.7]]), parameters={n: np.array([v]) for n, v in values.items()})
    np.testing.assert_allclose(np.concatenate([data.qpos, data.qvel]), after.x[0], rtol=0, atol=1e-12)
    assert 'pos="-0.04 0.05 -0.1"' in files["extended.xml"]


def test_no_inertia_is_one_that_no_body_has(tmp_path):
    system = arm(tmp_path)
    bounds = {p.name: (p.low, p.value, p.high) for p in system.parameters if p.name.startswith("inertia.")}
    assert sorted(bounds) == ["inertia.a", "inertia.b", "inertia.c"]
    model = simulation(system, dict.fromkeys(bounds, 0.01))
    bodies = model.text()["bodies"]
    for name, (low, value, high) in bounds.items():
        assert 0 < low < value < high
        for at in (low, high):
            mass = next(p.value for p in system.parameters if p.name == f"mass.{name[-1]}")
            known = {name.replace(".", "_"): at, f"mass_{name[-1]}": mass, "kilogram": 1.0}
            xx, yy, zz, xy, xz, yz = (eval(e, known) for e in bodies[name[-1]]["inertia"])
            moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            assert moments[0] > 0
            assert moments[2] == pytest.approx(at)
            assert moments[2] <= (1 + 1e-9) * (moments[0] + moments[1])
        with pytest.raises(gc.UsageError, match=f"parameter {name} = "):
            system.step(np.zeros((1, 8)), np.zeros((1, 1)), parameters={name: np.array([-value])})


def recorded(system, **natives):
    u = multisine(12.0, system.period, 3.0, (0.1, 3.0), 3)
    given = {n.replace("__", "."): np.array([v]) for n, v in natives.items()}
    x = system.rollout(np.array([[0.3, 0.0]]), u[None], parameters=given).x[0, :-1]
    y = x[:, 0] + 2e-3 * np.random.default_rng(0).standard_normal(len(x))
    return gc.Recording.of(np.arange(len(u)) * system.period, {"hinge": y, "u": u[:, 0]})


def named(found):
    return [(c.effect, c.native) for c in found.causes]


@pytest.mark.exam
@pytest.mark.parametrize(
    ("true", "value"), [("com_z__rod", -0.6), ("inertia__rod", 0.13), ("com_x__rod", 0.06), ("mass__rod", 1.2)]
)
def test_one_that_is_wrong_is_named(tmp_path, true, value):
    system = backend(tmp_path, ROD, ("hinge",))
    tolerances = {"com_z.rod": 0.005, "com_x.rod": 0.005, "inertia.rod": 0.002, "mass.rod": 0.01}
    model = simulation(system, tolerances)
    found = gc.diagnose(model, recorded(system, **{true: value}), ["parameter"], horizons=[0.5])
    assert named(found) == [("parameter", true.replace("__", "."))]
    assert found.causes[0].flags == ()
    assert found.extended_model.natives()[true.replace("__", ".")] == pytest.approx(value, rel=0.05)


@pytest.mark.exam
def test_what_the_data_do_not_tell_apart_is_no_confident_answer(tmp_path):
    """A joint feels m c and I + m c² alone: where the inertia is hardly known, the mass may be wrong as well as the centre."""
    system = backend(tmp_path, ROD, ("hinge",))
    model = simulation(system, {"com_z.rod": 0.005, "inertia.rod": 0.05, "mass.rod": 0.01})
    found = gc.diagnose(model, recorded(system, com_z__rod=-0.6), ["parameter"], horizons=[0.5])
    sets = [{(c.effect, c.site) for c in found.causes}, *map(set, found.ambiguous_with)]
    assert {("parameter", "com_z_rod")} in sets
    assert {("parameter", "mass_rod")} in sets
