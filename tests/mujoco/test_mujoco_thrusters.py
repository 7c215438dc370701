"""Motors of an MJCF file at sites, as propellers are: inputs that turn with their body."""

import numpy as np
import pytest

import gapcert as gc
import gapcert_engines
from gapcert_mujoco.config import MuJoCoConfig

pytestmark = [pytest.mark.needs("mujoco"), pytest.mark.contract]


DRONE = """<mujoco><option timestep="0.004" integrator="implicitfast" density="1.2"/><compiler angle="radian"/>
  <worldbody>
    <body name="frame" pos="0 0 0.4">
      <joint name="x" type="slide" axis="1 0 0" damping="0.2"/><joint name="z" type="slide" axis="0 0 1"/>
      <joint name="tilt" axis="0 1 0"/>
      <inertial pos="0 0 0" mass="0.8" diaginertia="0.01 0.01 0.02"/>
      <geom type="box" size="0.1 0.1 0.05"/>
      <site name="left" pos="-0.2 0 0"/><site name="right" pos="0.2 0 0" euler="0 0.1 0"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="left" site="left" gear="0 0 1.5 0 0 0.02" ctrlrange="0 6" ctrllimited="true"/>
    <motor name="lift" joint="z"/>
    <general name="right" site="right" gear="0 0 2 0 0 -0.02" gainprm="0.5" forcerange="-9 4" forcelimited="true"/>
    <motor name="wheel" site="left" gear="0 0 0 0 1 0"/>
    <position name="servo" site="left" kp="3"/>
  </actuator>
</mujoco>"""
JOINTS = '<joint name="x" type="slide" axis="1 0 0" damping="0.2"/><joint name="z" type="slide" axis="0 0 1"/>'
FREE = DRONE.replace(JOINTS, "<freejoint/>").replace('<joint name="tilt" axis="0 1 0"/>', "")
FREE = FREE.replace('<motor name="lift" joint="z"/>', "")
INPUTS = {"a": "left.ctrl", "b": "right.ctrl"}
X, U = np.array([[0.1, 0.2, 0.3, -0.4, 0.5, 2.0]]), [(3.0, 4.0), (9.0, 1.0), (-2.0, 30.0)]


def backend(folder, text=DRONE, inputs=INPUTS, model=None, **more):
    from gapcert_mujoco.engine import MuJoCoEngine

    (folder / "robot.xml").write_text(text)
    states = {f"{j}{end}": f"{j}.{what}" for what, end in (("position", ""), ("velocity", "_dot")) for j in ("x", "z", "tilt")}
    section = {
        "kind": "mujoco",
        "robot": "robot.xml",
        "states": states,
        "inputs": inputs,
        "period": "20 ms",
        "substeps": 5,
        "tiles": 1,
    }
    engine = MuJoCoEngine(MuJoCoConfig.model_validate(section | more), folder=folder)
    return gapcert_engines.EngineBackend(engine, model=model)


def by_hand(text, x, control, ground=False):
    """Five steps of the file as it is, with all its actuators, of which two have a control."""
    import mujoco

    text = text.replace("<worldbody>", '<worldbody><geom type="plane" size="0 0 1"/>') if ground else text
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = x[: model.nq], x[model.nq :]
    for name, value in zip(("left", "right"), control, strict=True):
        data.ctrl[model.actuator(name).id] = value
    mujoco.mj_step(model, data, 5)
    return np.concatenate([data.qpos, data.qvel])


@pytest.mark.parametrize("u", U)
def test_a_thrust_is_what_the_files_actuator_makes_of_it(tmp_path, u):
    plain = DRONE.replace('<position name="servo" site="left" kp="3"/>', "")
    system = backend(tmp_path)
    assert [s.unit for s in system.inputs] == ["N", "N"]
    np.testing.assert_allclose(system.step(X, np.array([u])).x[0], by_hand(plain, X[0], u), rtol=0, atol=1e-12)


def test_it_turns_with_the_body_inside_a_period(tmp_path):
    """Held in the frame of the first sub-step it would end elsewhere."""
    system, u = backend(tmp_path), np.array([[3.0, 4.0]])
    push = 1.5 * u[0, 0] * np.array([np.sin(X[0, 2]), np.cos(X[0, 2])])
    lean = X[0, 2] + 0.1
    push += u[0, 1] * np.array([np.sin(lean), np.cos(lean)])
    torque = 0.2 * 1.5 * u[0, 0] - 0.2 * u[0, 1] * np.cos(0.1)
    frozen = backend(tmp_path, inputs={"fx": "x", "fz": "z", "t": "tilt"}).step(X, np.array([[*push, torque]])).x
    one = {"substeps": 1, "period": "4 ms"}
    first = backend(tmp_path, inputs={"fx": "x", "fz": "z", "t": "tilt"}, **one).step(X, np.array([[*push, torque]])).x
    np.testing.assert_allclose(first, backend(tmp_path, **one).step(X, u).x, rtol=0, atol=1e-12)
    assert np.abs(frozen - system.step(X, u).x).max() > 1e-4


def test_copies_have_the_bits_of_one_robot_and_forces_go_to_joints(tmp_path):
    system, rng = backend(tmp_path, tiles=256), np.random.default_rng(0)
    assert system.tiling == "256 copies, bit-equal to one robot"
    x, u, forces = rng.uniform(-1, 1, (300, 6)), rng.uniform(0, 5, (300, 2)), rng.uniform(-1, 1, (300, 5, 3))
    alone = backend(tmp_path)
    assert system.step(x, u, forces=forces).x.tobytes() == alone.step(x, u, forces=forces).x.tobytes()
    pushed = backend(tmp_path, inputs={**INPUTS, "f": "z"})
    held = pushed.step(x, np.concatenate([u, forces[:, 0, 1:2]], axis=1)).x
    only = np.zeros_like(forces)
    only[:, :, 1] = forces[:, :1, 1]
    np.testing.assert_allclose(held, alone.step(x, u, forces=only).x, rtol=0, atol=1e-12)


@pytest.mark.parametrize("ground", [False, True])
def test_a_base_that_floats_is_pushed_too_in_the_air_and_on_the_ground(tmp_path, ground):
    states = {"z": "base.z", "vz": "base.vz", "vx": "base.vx", "wy": "base.wy", "wz": "base.wz"}
    more = {"fixed_base": False, "states": states} | ({"ground": 1.0} if ground else {})
    system, u = backend(tmp_path, FREE, **more), (5.0, 8.0)
    height = 0.05 if ground else 0.4
    full = np.array([0, 0, height, 1, 0, 0, 0, *[0.0] * 6])
    plain = FREE.replace('<position name="servo" site="left" kp="3"/>', "")
    expected = by_hand(plain, full, u, ground)
    got = system.step(np.array([[height, 0, 0, 0, 0]]), np.array([u])).x[0]
    np.testing.assert_allclose(got[:3], expected[[2, 9, 7]], rtol=0, atol=1e-6 if ground else 1e-12)


def test_an_input_of_another_unit_and_what_is_no_motor_are_refused(tmp_path):
    assert backend(tmp_path, inputs={"w": "wheel.ctrl"}).inputs[0].unit == "N*m"
    axes = {f"{a}{d}": f"{u}{s}" for a, u in (("x", "m"), ("z", "m"), ("tilt", "rad")) for d, s in (("", ""), ("_dot", "/s"))}
    section = {"kind": "equations", "states": axes, "inputs": {"a": "N*m"}, "next": {s: s for s in axes}, "period": "20 ms"}
    model = gc.registry().build("model", "equations", gc.registry().config("model", "equations")(**section))
    with pytest.raises(gc.UsageError, match=r"inputs\.a: the model gives it in N\*m, but what drives 'left\.ctrl' is in N;"):
        backend(tmp_path, inputs={"a": "left.ctrl"}, model=model)
    with pytest.raises(gc.UsageError, match=r"inputs\.a: .* has no actuator 'swing' without a memory of its own; it has lift"):
        backend(tmp_path, inputs={"a": "swing.ctrl"})
    with pytest.raises(gc.UsageError, match="inputs go to motors at sites and to a drive; expected one of the two"):
        backend(tmp_path, inputs={"a": "left.ctrl", "v": "drive"}, drive={"elements": {"x": {"v": 1}}})


def test_neither_mjx_nor_equations_take_it(tmp_path):
    pytest.importorskip("mujoco.mjx", reason="mujoco-mjx is not installed")
    with pytest.raises(gc.UsageError, match="a motor at a site"):
        backend(tmp_path, DRONE.replace(' density="1.2"', ""), implementation="mjx", contact=False)
    with pytest.raises(gc.UsageError, match="is more than a tree of bodies"):
        gapcert_engines.EngineModel(backend(tmp_path, DRONE.replace(' density="1.2"', "")))


def test_the_digest_knows_the_gear_and_not_other_actuators(tmp_path):
    texts = DRONE, DRONE.replace("1.5", "1.6"), DRONE.replace('kp="3"', 'kp="4"')
    digests = [backend(tmp_path, text).digest() for text in texts]
    assert digests[0] != digests[1]
    assert digests[0] == digests[2]
