"""Robot files with more than bodies on bare joints: by equations where these are exact, by MuJoCo's own steps where not."""

import json

import numpy as np
import pytest

import gapcert as gc
import gapcert_engines
from gapcert_engines import EngineModel, NativeModel
from gapcert_mujoco.config import MuJoCoConfig

pytestmark = [pytest.mark.needs("mujoco"), pytest.mark.contract]

ARM = """<mujoco><option timestep="0.002" gravity="0.3 0 -9.81" {option}>{flag}</option><compiler angle="radian"/>
<default><geom contype="0" conaffinity="0"/></default>
<asset><texture name="sky" type="skybox" builtin="gradient" width="64" height="384"/>
  <texture name="plate" type="2d" builtin="checker" width="64" height="64"/><material name="plate" texture="plate"/>
  <mesh name="hull" vertex="0 0 0  0.1 0 0  0 0.1 0  0 0 0.1"/></asset>
<worldbody>
  <light pos="0 0 2"/><camera name="eye" pos="0 -1 1"/>
  {floor}
  <body name="upper" pos="0 0 1" {upper}><joint name="a" axis="0 1 0.1" damping="0.2" {a}/>
    <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="1"/>
    <body name="lower" pos="0 0 -0.3" {lower}><joint name="b" axis="0 1 0" pos="0 0 0.01" armature="0.01" {b}/>
      <geom type="mesh" mesh="hull" material="plate" mass="0.6" {hand}/></body></body>
  {more}
</worldbody>{end}</mujoco>"""
FREE = '<body name="cube" pos="0.3 0.1 0.5"><freejoint/><geom type="box" size="0.03 0.04 0.05" mass="0.2" {cube}/></body>'
EQUATIONS = {
    "springs": {"a": 'stiffness="3" springref="0.4"', "b": 'stiffness="1.5"'},
    "weight that is carried": {"lower": 'gravcomp="1"', "upper": 'gravcomp="0.3"'},
    "gravity off": {"flag": '<flag gravity="disable"/>'},
    "an equality that rests": {"end": '<equality><joint joint1="a" joint2="b" active="false"/></equality>'},
    "a tendon that pulls nothing": {"end": '<tendon><fixed name="f"><joint joint="b" coef="1"/></fixed></tendon>'},
    "shapes that no other meets": {"hand": 'contype="1"'},
    "springs, solved otherwise": {"option": 'integrator="implicitfast"', "a": 'stiffness="3"', "b": 'damping="0.1"'},
    "springs by Runge and Kutta": {"option": 'integrator="RK4"', "a": 'stiffness="3"'},
}
STEPS = {
    "integrator implicit": {"option": 'integrator="implicit"'},
    "a medium": {"option": 'density="1.2" viscosity="1.8e-5"'},
    "geoms that may touch": {"floor": '<geom type="plane" size="1 1 1" pos="0 0 0.6" contype="1"/>', "hand": 'conaffinity="1"'},
    "equality e": {"end": '<equality><joint name="e" joint1="a" joint2="b"/></equality>'},
    "tendon f": {"end": '<tendon><fixed name="f" stiffness="2"><joint joint="b" coef="1"/></fixed></tendon>'},
    "springs that the file switches off": {"flag": '<flag spring="disable"/>', "a": 'stiffness="3"'},
    "springs or dampers that bend": {"a": 'stiffness="1 2 0"'},
}


PARTS = ("option", "flag", "floor", "upper", "a", "lower", "b", "hand", "more", "end")


def text(**parts):
    return ARM.format(**dict.fromkeys(PARTS, "") | parts)


def section(folder, robot, **more):
    (folder / "robot.xml").write_text(robot)
    states = {f"{j}{end}": f"{j}.{what}" for j in "ab" for end, what in (("", "position"), ("_dot", "velocity"))}
    known = {"kind": "mujoco", "robot": "robot.xml", "states": states | more, "inputs": {"u": "a"}}
    return known | {"period": "4 ms", "substeps": 2}


def model(folder, robot, **more):
    """As a spec has it."""
    spec = {"version": 1, "name": "robot", "model": {"kind": "engine", "of": section(folder, robot, **more)}}
    (folder / "robot.yaml").write_text(json.dumps(spec))
    return gc.load_spec(folder / "robot.yaml").build("model")


def stepped(robot, q, v, torque, steps=2):
    """MuJoCo alone."""
    import mujoco

    raw = mujoco.MjModel.from_xml_string(robot)
    data = mujoco.MjData(raw)
    data.qpos[:], data.qvel[:] = q, v
    data.qfrc_applied[0] = torque
    mujoco.mj_step(raw, data, steps)
    return data.qpos.copy(), data.qvel.copy()


def followed(model, robot, within):
    rng, names = np.random.default_rng(1), [s.name for s in model.states]
    for _ in range(20):
        q, v, torque = rng.uniform(-1, 1, 2), rng.normal(size=2), rng.normal()
        known = {"a": q[0], "b": q[1], "a_dot": v[0], "b_dot": v[1]}
        after = model.step(np.array([[known[n] for n in names]]), np.array([[torque]])).x[0]
        q, v = stepped(robot, q, v, torque)
        expected = {"a": q[0], "b": q[1], "a_dot": v[0], "b_dot": v[1]}
        np.testing.assert_allclose(after, [expected[n] for n in names], rtol=0, atol=within)


@pytest.mark.parametrize("case", EQUATIONS)
def test_equations_where_they_are_exact(tmp_path, case):
    robot = text(**EQUATIONS[case])
    made = model(tmp_path, robot)
    assert isinstance(made, EngineModel)
    followed(made, robot, 1e-9)


@pytest.mark.parametrize("case", STEPS)
def test_the_engines_own_steps_where_equations_are_not(tmp_path, case):
    robot = text(**STEPS[case])
    made = model(tmp_path, robot)
    assert isinstance(made, NativeModel)
    followed(made, robot, 1e-12)
    with pytest.raises(gc.UsageError, match=rf"{case}.* is known by its steps alone, without derivatives"):
        made.jacobian(np.zeros((1, 4)), np.zeros((1, 1)))


BALL = """<body name="lamp" pos="-0.4 0 1"><joint name="eye" type="ball" damping="0.01"/>
  <geom size="0.05" pos="0 0 -0.2"/></body>"""


def test_a_body_that_lies_about_and_a_ball_move_as_in_the_engine(tmp_path):
    import mujoco

    floor = '<geom type="plane" size="1 1 1" contype="1" conaffinity="1"/>'
    robot = text(floor=floor, more=FREE.format(cube='contype="1" conaffinity="1"') + BALL)
    beside = {f"cube_{f}": f"cube.{f}" for f in ("x", "y", "z", "vx", "vy", "vz", "wx", "wy", "wz")}
    backend = built(section(tmp_path, robot, **beside, **{f"eye_w{a}": f"eye.w{a}" for a in "xyz"}), tmp_path)
    assert [s.name for s in backend.hidden] == ["cube.rotation", "eye.rotation"]
    assert [s.unit for s in backend.states[-6:]] == ["rad/s"] * 6
    np.testing.assert_allclose(backend.hidden_default, [1, 0, 0, 0, 1, 0, 0, 0])
    rng = np.random.default_rng(2)
    turned = np.array([0.5, 0.5, -0.5, 0.5])
    for low in (0.5, 0.045):  # in the air, and on the floor
        q, v, torque = rng.uniform(-1, 1, 2), rng.normal(size=2), rng.normal()
        place, speed, spin, rate = np.array([0.3, 0.1, low]), *rng.normal(size=(2, 3)), rng.normal(size=3)
        x = np.concatenate([[q[0], v[0], q[1], v[1]], place, speed, spin, rate])
        order = [["a", "a_dot", "b", "b_dot", *beside, "eye_wx", "eye_wy", "eye_wz"].index(s.name) for s in backend.states]
        hidden = np.concatenate([turned, [1, 0, 0, 0]])[None]
        after = backend.step(x[order][None], np.array([[torque]]), hidden=hidden)
        # MuJoCo has a free body's rate in its own frame.
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, turned)
        body = rotation.reshape(3, 3)
        raw_q, raw_v = stepped(robot, [*q, *place, *turned, 1, 0, 0, 0], [*v, *speed, *(body.T @ spin), *rate], torque)
        got = dict(zip((s.name for s in backend.states), after.x[0], strict=True))
        np.testing.assert_allclose([got["a"], got["b"]], raw_q[:2], rtol=0, atol=1e-9)
        np.testing.assert_allclose([got[f"cube_{a}"] for a in "xyz"], raw_q[2:5], rtol=0, atol=1e-9)
        np.testing.assert_allclose(after.hidden[0], raw_q[5:], rtol=0, atol=1e-9)
        np.testing.assert_allclose([got[f"cube_v{a}"] for a in "xyz"], raw_v[2:5], rtol=0, atol=1e-9)
        mujoco.mju_quat2Mat(rotation, raw_q[5:9])
        np.testing.assert_allclose([got[f"cube_w{a}"] for a in "xyz"], rotation.reshape(3, 3) @ raw_v[5:8], rtol=0, atol=1e-9)
        np.testing.assert_allclose([got[f"eye_w{a}"] for a in "xyz"], raw_v[8:], rtol=0, atol=1e-9)
    assert backend.scene(x[order][None], hidden) is not None


def built(options, folder):
    from gapcert_mujoco.engine import MuJoCoEngine

    return gapcert_engines.EngineBackend(MuJoCoEngine(MuJoCoConfig.model_validate(options), folder=folder))


def test_what_floats_is_the_robot_and_not_what_lies_about(tmp_path):
    """Of two free bodies the base is the one that carries joints, in whatever order they stand."""
    walker = '<body name="trunk" pos="0 0 2"><freejoint/><geom size="0.1"/><body><joint/><geom size="0.05"/></body></body>'
    (tmp_path / "robot.xml").write_text(f"<mujoco><worldbody>{FREE.format(cube='')}{walker}</worldbody></mujoco>")
    options = {"kind": "mujoco", "robot": "robot.xml", "states": {"z": "base.z"}, "period": "2 ms", "fixed_base": False}
    backend = built(options, tmp_path)
    assert "cube.x" in [s.name for s in backend.hidden]
    with pytest.raises(gc.UsageError, match="free joint; set fixed_base: false"):
        built(options | {"fixed_base": True}, tmp_path)


def test_copies_hold_neither_shapes_nor_pictures(tmp_path):
    from gapcert_mujoco.robot import compiled

    robot = text(hand='contype="1"')
    config = MuJoCoConfig.model_validate(section(tmp_path, robot) | {"robot": tmp_path / "robot.xml"})
    one, many = compiled(tmp_path / "robot.xml", config), compiled(tmp_path / "robot.xml", config, 8)
    assert one.ntex == many.ntex == many.nmesh == many.ngeom == 0
    assert one.nmesh == 1
    for part in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        np.testing.assert_array_equal(np.concatenate([getattr(one, part)[1:]] * 8), getattr(many, part)[1:])
    backend = built(section(tmp_path, robot), tmp_path)
    assert backend.tiling.endswith("copies, bit-equal to one robot")


SERVOS = {
    "position": '<position name="s" joint="a" kp="30" kv="2" gear="1.5" forcerange="-4 4" ctrlrange="-1 1"/>',
    "position without limits": '<position name="s" joint="a" kp="30"/>',
    "velocity": '<velocity name="s" joint="a" kv="3" forcerange="-2 5"/>',
    "general": '<general name="s" joint="a" gainprm="7" biastype="affine" biasprm="0.3 -2 -0.4" gear="-2" ctrlrange="-0.5 2"/>',
    "general, an effort": '<general name="s" joint="a" gainprm="7" forcerange="-1 1"/>',
}


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
@pytest.mark.parametrize("case", SERVOS)
def test_a_servo_of_the_file_follows_its_command(tmp_path, case, integrator):
    """By equations, and in the engine; also where its effort is cut, which frees its damping from the step."""
    import mujoco

    robot = text(option=f'integrator="{integrator}"', end=f"<actuator>{SERVOS[case]}</actuator>")
    (tmp_path / "robot.xml").write_text(robot)
    of = section(tmp_path, robot) | {"inputs": {"u": "s.ctrl"}}
    (tmp_path / "robot.yaml").write_text(json.dumps({"version": 1, "name": "r", "model": {"kind": "engine", "of": of}}))
    made = gc.load_spec(tmp_path / "robot.yaml").build("model")
    assert isinstance(made, EngineModel)
    assert made.inputs[0].unit == {"p": "rad", "v": "rad/s", "g": "1"}[case[0]]
    raw, rng = mujoco.MjModel.from_xml_string(robot), np.random.default_rng(3)
    order, cut = [s.name for s in made.states], set[bool]()
    for u in np.linspace(-2.5, 2.5, 21):
        data = mujoco.MjData(raw)
        data.qpos[:], data.qvel[:], data.ctrl[0] = rng.uniform(-1, 1, 2), rng.normal(size=2), u
        known = {"a": data.qpos[0], "b": data.qpos[1], "a_dot": data.qvel[0], "b_dot": data.qvel[1]}
        x = np.array([[known[n] for n in order]])
        mujoco.mj_step(raw, data, 2)
        cut.add(abs(data.actuator_force[0]) >= 1)
        after = {"a": data.qpos[0], "b": data.qpos[1], "a_dot": data.qvel[0], "b_dot": data.qvel[1]}
        expected = [after[n] for n in order]
        np.testing.assert_allclose(made.step(x, [[u]]).x[0], expected, rtol=0, atol=1e-10)
        backwards = [[s.name for s in made.backend.states].index(n) for n in order]
        at = np.empty_like(x)
        at[:, backwards] = x
        np.testing.assert_allclose(made.backend.step(at, [[u]]).x[0, backwards], expected, rtol=0, atol=1e-12)
    assert cut == ({True} if "without" in case else {False, True})
