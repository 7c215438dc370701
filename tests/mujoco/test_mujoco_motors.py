"""Motors of an MJCF file: inputs that are their controls, and gains that are their gears."""

import difflib

import numpy as np
import pytest

import gapcert as gc
import gapcert_engines
from gapcert.testing import multisine
from gapcert_diagnosis.native.candidates import native_candidates
from gapcert_engines.native_model import NativeModel
from gapcert_mujoco.config import MuJoCoConfig

pytestmark = [pytest.mark.needs("mujoco"), pytest.mark.contract]


CRANE = """<mujoco><option timestep="0.004"/><compiler angle="radian"/>
  <default><motor gear="20 0 0"/></default>
  <worldbody>
    <body><joint name="trolley" type="slide" axis="1 0 0" damping="3"/><inertial pos="0 0 0" mass="4" diaginertia="1 1 1"/>
      <body><joint name="rope" axis="0 1 0" damping="0.1"/>
        <inertial pos="0 0 -0.6" mass="1" diaginertia="0.05 0.05 0.01"/></body>
    </body>
  </worldbody>
  <actuator>
    <motor name="winch" joint="trolley" ctrlrange="-2 3" ctrllimited="true"/>  <!-- 1:20 -->
    <motor joint="rope" gear="-1.5"/>
  </actuator>
</mujoco>"""
TARGETS = {"joints": {"u": "trolley", "w": "rope"}, "controls": {"u": "winch.ctrl", "w": "rope.ctrl"}}


def backend(folder, text=CRANE, inputs="joints"):
    from gapcert_mujoco.engine import MuJoCoEngine

    (folder / "robot.xml").write_text(text)
    states = {f"{j}{end}": f"{j}.{what}" for what, end in (("position", ""), ("velocity", "_dot")) for j in ("trolley", "rope")}
    named = TARGETS[inputs] if isinstance(inputs, str) else inputs
    section = {"kind": "mujoco", "robot": "robot.xml", "states": states, "inputs": named, "period": "4 ms"}
    return gapcert_engines.EngineBackend(MuJoCoEngine(MuJoCoConfig.model_validate(section), folder=folder))


def by_hand(text, x, control):
    """One step of the file as it is, actuators included."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = x[:2], x[2:], control
    mujoco.mj_step(model, data)
    return np.concatenate([data.qpos, data.qvel])


@pytest.mark.parametrize("control", [(0.7, -0.4), (2.9, 5.0), (3.5, 0.1), (-2.5, 0.0)])
def test_a_control_is_what_the_files_actuator_makes_of_it(tmp_path, control):
    x = np.array([[0.1, 0.4, -0.2, 0.3]])
    system = backend(tmp_path, inputs="controls")
    np.testing.assert_allclose(system.step(x, np.array([control])).x[0], by_hand(CRANE, x[0], control), rtol=0, atol=1e-12)
    cut = np.clip(control, [-2, -np.inf], [3, np.inf])
    effort = backend(tmp_path).step(x, np.array([cut * np.array([20, -1.5])])).x
    np.testing.assert_allclose(effort[0], by_hand(CRANE, x[0], control), rtol=0, atol=1e-12)


@pytest.mark.parametrize("inputs", ["joints", "controls"])
def test_a_gear_is_a_native_parameter(tmp_path, inputs):
    system = backend(tmp_path, inputs=inputs)
    assert {p.name: p.value for p in system.parameters if p.name.startswith("gear")} == {"gear.winch": 20, "gear.rope": -1.5}
    x, u = np.array([[0.1, 0.4, -0.2, 0.3]] * 2), np.array([[0.5, -0.3]] * 2)
    given = {"gear.winch": np.array([20.0, 16.0]), "gear.rope": np.array([-1.5, -3.0])}
    changed = system.step(x, u, parameters=given).x
    np.testing.assert_array_equal(changed[0], system.step(x, u).x[0])
    np.testing.assert_array_equal(changed[1], system.step(x, u * [0.8, 2]).x[1])


@pytest.mark.exam
@pytest.mark.parametrize("inputs", ["joints", "controls"])
def test_a_gain_goes_into_the_gear(tmp_path, inputs):
    system = backend(tmp_path, inputs=inputs)
    model = gapcert_engines.EngineModel(system)
    assert (model.native("input-gain", "u"), model.native("input-gain", "w")) == ("gear.winch", "gear.rope")
    size = [20.0, 1.5] if inputs == "joints" else [1.0, 1.0]
    u = np.concatenate([multisine(8.0, 4e-3, s, (0.2, 3.0), k) for k, s in enumerate(size, 3)], axis=1)
    x = system.rollout(np.array([[0.0, 0.3, 0, 0]]), u[None], parameters={"gear.winch": np.array([16.0])}).x[0, :-1]
    noise = 2e-4 * np.random.default_rng(0).standard_normal((len(x), 2))
    channels = {"trolley": x[:, 0] + noise[:, 0], "rope": x[:, 1] + noise[:, 1], "u": u[:, 0], "w": u[:, 1]}
    found = gc.diagnose(model, gc.Recording.of(4e-3 * np.arange(len(u)), channels), ["input-gain", "viscous-friction"])
    assert [(c.effect, c.site, c.native) for c in found.causes] == [("input-gain", "u", "gear.winch")]
    extended = found.extended_model
    assert extended.natives() == pytest.approx({"gear.winch": 16.0}, rel=0.01)
    ((name, patched),) = extended.files().items()
    assert name == "extended.xml"
    lost = [line for line in difflib.ndiff(CRANE.splitlines(), patched.splitlines()) if line[0] in "+-"]
    assert len(lost) == 2
    assert 'gear="15.9' in lost[1] or 'gear="16.0' in lost[1]
    x, u = np.array([[0.1, 0.4, -0.2, 0.3]]), np.array([[0.5, -0.3]])
    control = u[0] / ([20, -1.5] if inputs == "joints" else 1)
    np.testing.assert_allclose(extended.step(x, u).x[0], by_hand(patched, x[0], control), rtol=0, atol=1e-9)


def test_in_contact_a_gear_is_tried_as_a_gain(tmp_path):
    (tmp_path / "robot.xml").write_text(CRANE)
    states = {f"{j}{end}": f"{j}.{what}" for what, end in (("position", ""), ("velocity", "_dot")) for j in ("trolley", "rope")}
    config = {"kind": "mujoco", "robot": "robot.xml", "ground": 1.0, "states": states, "inputs": {"u": "winch.ctrl"}}
    model = NativeModel(MuJoCoConfig.model_validate(config | {"period": "4 ms"}), gc.Context(folder=tmp_path))
    (found,) = native_candidates(model, {"input-gain"}, simulated=False)[:1]
    assert (found.key, found.native, found.factor * 16.0) == (("input-gain", "u"), "gear.winch", pytest.approx(0.8))
    x, u = np.array([[0.1, 0.4, -0.2, 0.3]]), np.array([[0.5]])
    np.testing.assert_array_equal(model.restated({"gear.winch": 16.0}).step(x, u).x, model.step(x, 0.8 * u).x)


@pytest.mark.parametrize("inputs", ["joints", "controls"])
def test_a_gear_may_have_a_tolerance(tmp_path, inputs):
    system = backend(tmp_path, inputs=inputs)
    model = gapcert_engines.EngineModel(system, [gc.Parameter("gear.winch", 17.0, tolerance=1.0)])
    x, u = np.array([[0.1, 0.4, -0.2, 0.3]]), np.array([[0.5, -0.3]])
    (own,) = [p.name for p in model.parameters if p.name.startswith("gear")]
    for gear in (17.0, 25.0):
        engine = system.step(x, u, parameters={"gear.winch": np.array([gear])}).x
        np.testing.assert_allclose(model.step(x, u, parameters={own: np.array([gear])}).x, engine, rtol=0, atol=1e-12)


def test_a_gear_that_stands_in_an_included_file_is_set_by_code(tmp_path):
    head, rest = CRANE.split("  <actuator>")
    (tmp_path / "motors.xml").write_text("<mujoco><actuator>" + rest)
    system = backend(tmp_path, head + '<include file="motors.xml"/></mujoco>')
    files = system.engine.patched({"gear.winch": 16.0, "gear.rope": -2.0})
    (tmp_path / "extended.xml").write_text(files["extended.xml"])
    names: dict = {}
    code = files["extended.py"].replace('"extended.xml"', repr(str(tmp_path / "extended.xml")))
    exec(compile(code, "extended.py", "exec"), names)
    assert names["model"].actuator_gear[:, 0].tolist() == [16.0, -2.0]


@pytest.mark.parametrize(
    "actuator",
    [
        '<position joint="rope" kp="3"/>',
        '<motor joint="rope"/><motor joint="rope"/>',
        '<general joint="rope" dyntype="filter" dynprm="0.1"/>',
        '<motor joint="rope" gear="0"/>',
    ],
)
def test_what_is_more_than_a_motor_is_none(tmp_path, actuator):
    text = CRANE.replace('<motor joint="rope" gear="-1.5"/>', actuator)
    model = gapcert_engines.EngineModel(backend(tmp_path, text, {"u": "trolley", "w": "rope.effort"}))
    assert (model.native("input-gain", "u"), model.native("input-gain", "w")) == ("gear.winch", None)
    if "filter" in actuator or actuator.count("<") == 2:
        with pytest.raises(gc.UsageError, match=r"inputs\.w: .* has no actuator 'rope' without a memory .*; it has winch"):
            backend(tmp_path, text, "controls")


def test_one_joint_has_one_input(tmp_path):
    with pytest.raises(gc.UsageError, match="u and w both drive joint 'trolley'"):
        backend(tmp_path, inputs={"u": "trolley", "w": "winch.ctrl"})


def test_controls_beyond_their_range_are_refused_and_not_the_ends(tmp_path):
    system = backend(tmp_path, inputs="controls")
    model = gapcert_engines.EngineModel(system)
    assert model.within == {"u": (-2.0, 3.0)}
    u = np.concatenate([np.clip(3 * multisine(8.0, 4e-3, 1.0, (0.2, 3.0), 3), -2, 3), np.zeros((2000, 1))], axis=1)
    x = system.rollout(np.array([[0.0, 0.3, 0, 0]]), u[None]).x[0, :-1]
    for beyond in (0.0, 0.01):
        channels = {"trolley": x[:, 0], "rope": x[:, 1], "u": (1 + beyond) * u[:, 0], "w": u[:, 1]}
        log = gc.Recording.of(4e-3 * np.arange(len(u)), channels)
        if beyond:
            with pytest.raises(gc.UsageError, match=r"u comes to 0 N from .*, where the robot file ends its range"):
                gc.diagnose(model, log, ["input-gain"])
        else:
            assert gc.diagnose(model, log, ["input-gain"]).verdict == "nothing"
