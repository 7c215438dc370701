"""Backend `drake`: the physics in closed form and against other engines, purity, parameters, and its user's mistakes."""

from pathlib import Path

import numpy as np
import pytest
from rod import HINGE, TAU, RodContract, query, semi_implicit

import gapcert as gc
import gapcert_engines
from gapcert import Context, UsageError, registry
from gapcert.testing import SystemContract
from gapcert_drake.config import DrakeConfig
from gapcert_drake.robot import RobotFile
from gapcert_engines import EngineBackend

pytestmark = [pytest.mark.contract, pytest.mark.needs("pydrake")]

ROOT = Path(__file__).parents[2]
MODELS = ROOT / "specs/models"
DATA = Path(__file__).parents[1] / "data"
PENDULUM = HINGE | {"robot": MODELS / "pendulum.urdf"}
FOUR = {"a": "shoulder.position", "b": "elbow.position", "da": "shoulder.velocity", "db": "elbow.velocity"}
ENDS = (("", "position"), ("_dot", "velocity"))
SPIN = {f"{k}": f"base.{k}" for k in ("x", "y", "z", "vx", "vy", "vz", "wx", "wy", "wz")}
MJCF = """<mujoco><compiler angle="radian"/><option timestep="0.01" gravity="0 0 -9.7" {option}/>
<default><joint armature="0.07"/></default>
<worldbody><light/><body name="rod"><joint name="hinge" axis="0 1 0" damping="0.1" {joint}/>
<inertial pos="0 0 -0.5" mass="1" diaginertia="0.0833333 0.0833333 0.001"/></body></worldbody>
<actuator><motor joint="hinge" gear="7"/></actuator></mujoco>"""
URDF = """<robot name="rod"><link name="world"/><link name="rod"><inertial><origin xyz="0 0 -0.5"/><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="hinge" type="{type}">
<parent link="world"/><child link="rod"/><axis xyz="0 1 0"/>
<dynamics damping="0.1" friction="{friction}"/>{more}</joint></robot>"""


def backend(**options):
    from gapcert_drake.engine import DrakeEngine

    return EngineBackend(DrakeEngine(DrakeConfig(**(PENDULUM | options))))


def build(tmp_path, text, suffix=".urdf", **options):
    path = tmp_path / f"robot{suffix}"
    path.write_text(text)
    return backend(robot=path, **options)


def acrobot(**options):
    return backend(**({"robot": DATA / "acrobot.urdf", "states": FOUR, "inputs": {"torque": "elbow"}} | options))


class TestPendulum(RodContract):
    pendulum = staticmethod(backend)


@pytest.mark.exam
class TestContinuousAcrobotWithHiddenElbow(SystemContract):
    rows = 9

    def system(self):
        two = {"a": "shoulder.position", "da": "shoulder.velocity"}
        return acrobot(states=two, inputs={"torque": "shoulder"}, integrator="runge_kutta3", substeps=2)


@pytest.mark.exam
class TestLimitedAcrobot(SystemContract):
    rows = 9

    def system(self):
        return acrobot()


class TestCubeThatTouchesGround(SystemContract):
    rows = 9

    def system(self):
        states = {name: target for name, target in SPIN.items() if name not in ("x", "wz")}
        return backend(robot=MODELS / "cube.urdf", states=states, inputs={}, fixed_base=False, ground=0.3, substeps=2)

    def points(self, system):
        x, u = query(self.rows, 7, 1)
        x[:, 1] = 0.05 + 0.01 * x[:, 1]
        return x, u[:, :0]


# The physics


def test_discrete_plant_is_semi_implicit_euler():
    x, u = query(300)
    for b in (backend(), backend(tiles=1)):
        assert np.abs(b.step(x, u).x - semi_implicit(x, u)).max() <= 1e-15
    assert backend().tiling == "64 copies, bit-equal to one robot"


def test_continuous_plant_is_the_flow():
    """Against Runge–Kutta with steps so short that its own error is rounding."""
    from scipy.integrate import solve_ivp

    x, u = query(5)
    b = backend(integrator="runge_kutta3", accuracy=1e-12)
    found = b.step(x, u).x
    for k in range(len(x)):
        exact = solve_ivp(
            lambda _, y, t=u[k, 0]: (y[1], -14.715 * np.sin(y[0]) + 3 * t), (0, TAU), x[k], "DOP853", rtol=1e-13, atol=1e-15
        )
        assert np.abs(found[k] - exact.y[:, -1]).max() <= 1e-12
    assert (b.resolution(np.ones(2)) >= 1e-12).all()
    assert b.tiling.startswith("untiled: an integrator")


@pytest.mark.parametrize("integrator", ["explicit_euler", "runge_kutta2", "implicit_euler"])
def test_other_integrators_have_their_order(integrator):
    x, u = query(4)
    flow = backend(integrator="runge_kutta3", accuracy=1e-12).step(x, u).x
    accuracy = {"accuracy": 1e-6} if integrator == "implicit_euler" else {}
    gap = np.abs(backend(integrator=integrator, **accuracy).step(x, u).x - flow).max()
    if integrator == "explicit_euler":
        assert np.abs(backend(integrator=integrator).step(x, u).x[:, 0] - x[:, 0] - TAU * x[:, 1]).max() < 1e-15
    assert 0 < gap < {"explicit_euler": 3e-4, "runge_kutta2": 1e-5, "implicit_euler": 3e-5}[integrator]


@pytest.mark.parametrize(
    ("options", "parameters", "law"),
    [
        ({"gravity": (1.0, 5.0, -2.0)}, {"gravity_x": 1.0, "gravity_y": 5.0, "gravity_z": -2.0}, {"gravity": (1.0, -2.0)}),
        ({"joint_damping": 0.4}, {"damping.hinge": 0.4}, {"damping": 0.4}),
        ({}, {"mass.rod": 2.5}, {"mass": 2.5}),
        ({}, {"armature.hinge": 0.2}, {"armature": 0.2}),
    ],
)
def test_options_and_parameters_follow_their_laws(options, parameters, law):
    x, u = query(70)
    expected = semi_implicit(x, u, **law)
    b = backend()
    before = b.step(x, u).x
    by_parameter = b.step(x, u, parameters=parameters).x
    assert np.abs(by_parameter - expected).max() <= 4e-15
    if options:
        assert by_parameter.tobytes() == backend(**options).step(x, u).x.tobytes()
    assert before.tobytes() != by_parameter.tobytes()
    assert before.tobytes() == b.step(x, u).x.tobytes(), "parameters must not outlive their call"


def test_moments_and_centres_move_the_arm():
    b = backend(robot=DATA / "arm.urdf", states=FOUR, inputs={"torque": "elbow"})
    x, u = query(20, 4)
    plain = b.step(x, u).x
    stated = {p.name: p.value for p in b.parameters}
    body = next(n for n in stated if n.startswith("inertia.")).partition(".")[2]
    for name in (f"inertia.{body}", f"com_x.{body}", f"com_z.{body}"):
        assert np.abs(b.step(x, u, parameters={name: 1.3 * stated[name] + 1e-3}).x - plain).max() > 1e-6, name


def test_an_arm_moves_as_in_other_engines():
    """Two joints, damping and rotors: semi-implicit steps of the same equations, to rounding."""
    pytest.importorskip("dartpy", reason="dartpy is not installed")
    options = {"robot": DATA / "arm.urdf", "states": FOUR, "inputs": {"torque": "elbow"}, "period": "5 ms", "substeps": 3}
    rng, forces = np.random.default_rng(0), np.random.default_rng(1).uniform(-1, 1, (20, 3, 2))
    x, u = rng.uniform(-1, 1, (20, 4)) * [2, 2, 3, 3], rng.uniform(-1, 1, (20, 1))
    config = registry().config("backend", "dart")(**options)
    dart = registry().build("backend", "dart", config)
    ours = backend(**options)
    assert ours.coordinates == dart.coordinates == ("a", "b")
    assert np.abs(ours.step(x, u, forces=forces).x - dart.step(x, u, forces=forces).x).max() <= 1e-12


def test_limits_hold_in_the_discrete_plant_alone():
    x, u = np.array([[0.0, 0.45, 0.0, 30.0]]), np.zeros((1, 1))
    free, limited = acrobot(joint_limits=False), acrobot()
    assert free.step(x, u).x[0, 1] > 0.55
    assert free.tiling.startswith("64 copies")
    assert limited.tiling == "untiled: joint 'elbow' has limits, whose constraints copies would solve together"
    assert limited.rollout(x, np.zeros((1, 40, 1))).x[0, -5:, 1].max() < 0.51
    assert acrobot(integrator="runge_kutta3").step(x, u).x[0, 1] > 0.55


def test_a_floating_base_falls_and_turns():
    b = backend(robot=MODELS / "cube.urdf", states=SPIN, inputs={}, fixed_base=False, period="0.1 s", substeps=100)
    x = np.array([[0.0, 0, 5, 1, 2, 3, 0, 0, 4.0]])
    out = b.step(x, np.zeros((1, 0)))
    assert out.x[0, 5] == pytest.approx(3 - 0.981, abs=1e-12)
    assert out.x[0, :2] == pytest.approx([0.1, 0.2], abs=1e-12)
    assert out.hidden[0] == pytest.approx([np.cos(0.2), 0, 0, np.sin(0.2)], abs=1e-4)
    assert np.linalg.norm(out.hidden[0]) == pytest.approx(1, abs=1e-15)


def test_a_box_slides_on_the_ground_and_stops():
    """It loses 2 a b / (a + b) g per second."""
    states = {"x": "base.x", "z": "base.z", "vx": "base.vx"}
    options = {"robot": MODELS / "cube.urdf", "states": states, "inputs": {}, "fixed_base": False, "period": "0.1 s"}
    b = backend(**options, ground=0.4, friction=0.4, substeps=100, contact_approximation="tamsi")
    x = np.array([[0.0, 0.0524, 2.0]])
    along = b.rollout(x, np.zeros((1, 4, 0))).x[0, :, 2]
    assert np.diff(along)[:3] == pytest.approx(-0.1 * 0.4 * 9.81, rel=0.01)
    halved = b.step(x, np.zeros((1, 0)), parameters={"ground": 0.1}).x[0, 2]
    assert halved == pytest.approx(2.0 - 0.1 * 9.81 * 2 * 0.1 * 0.4 / 0.5, rel=0.01)


# Files


@pytest.mark.parametrize("name", ["pendulum.sdf", "arm.xml"])
def test_the_same_robot_from_other_files(name):
    if name == "pendulum.sdf":
        x, u = query(20)
        assert np.abs(backend(robot=MODELS / name).step(x, u).x - semi_implicit(x, u)).max() < 1e-9
    else:
        b = backend(robot=MODELS / name, states=FOUR, inputs={"torque": "elbow"})
        assert {"armature.elbow", "damping.elbow"} <= {p.name for p in b.parameters}


def test_an_mjcf_keeps_gravity_damping_and_every_rotor(tmp_path):
    """Drake reads the inertia of rotors only of joints with a motor; the gear of that motor is not the spec's business."""
    b = build(tmp_path, MJCF.format(option="", joint=""), ".xml")
    stated = {p.name: p.value for p in b.parameters}
    assert (stated["gravity_z"], stated["damping.hinge"], stated["armature.hinge"]) == (-9.7, 0.1, 0.07)
    x, u = query(20)
    expected = semi_implicit(x, u, gravity=(0.0, -9.7), damping=0.1, armature=0.07)
    assert np.abs(b.step(x, u).x - expected).max() < 1e-7


def test_patched_files_load_with_their_values(tmp_path):
    b = backend()
    files = b.engine.patched({"mass.rod": 2.0, "damping.hinge": 0.3, "gravity_z": -9.0, "armature.hinge": 0.1})
    (tmp_path / "robot.urdf").write_text(files["extended.urdf"])
    (tmp_path / "extended.urdf").write_text(files["extended.urdf"])
    x, u = query(20)
    expected = semi_implicit(x, u, gravity=(0.0, -9.0), mass=2.0, damping=0.3)
    found = backend(robot=tmp_path / "robot.urdf", gravity=(0.0, 0.0, -9.0)).step(x, u).x
    assert np.abs(found - expected).max() < 1e-14
    scope: dict[str, object] = {}
    code = files["extended.py"].replace('"extended.urdf"', repr(str(tmp_path / "extended.urdf")))
    exec(compile(code, "extended.py", "exec"), scope)
    matrix = scope["plant"].CalcMassMatrix(scope["context"])
    assert matrix[0, 0] == pytest.approx(2 / 3 + 0.1)
    assert scope["plant"].gravity_field().gravity_vector()[2] == -9.0


# As the simulation


@pytest.mark.exam
def test_a_diagnosis_names_what_was_hidden(tmp_path):
    """The equations of the plant's bodies pass the engine's own check, and carry damping and a rotor."""
    states = {f"{q}{end}": f"{j}.{field}" for q, j in (("a", "shoulder"), ("b", "elbow")) for end, field in ENDS}
    model = gapcert_engines.EngineModel(
        backend(robot=str(DATA / "arm.urdf"), states=states, inputs={"torque": "elbow"}, substeps=2)
    )
    assert model.native("viscous-friction", "a") == "damping.shoulder"
    hinge = {"q": "hinge.position", "q_dot": "hinge.velocity"}
    reality = backend(states=hinge, joint_damping=0.05)
    log = gc.play(reality, {"torque": (-1.5, 1.5), "q": (-0.5, 0.5)}, seconds=4.0, trajectories=2, seed=1)
    found = gc.diagnose(
        gapcert_engines.EngineModel(backend(states=hinge)), log, ["coulomb-friction", "viscous-friction"], horizons=[0.5]
    )
    assert [(c.effect, c.native) for c in found.causes] == [("viscous-friction", "damping.hinge")]
    assert found.causes[0].parameters["coefficient"].value == pytest.approx(0.05, rel=1e-6)


@pytest.mark.exam
def test_example_runs(tmp_path):
    spec = gc.load_spec(ROOT / "specs/pendulum_drake.yaml", ("report.html=false", "report.rerun=false"))
    summary = gc.run(spec, out=tmp_path).summary
    assert all(e["met"] for e in summary["expectations"]), summary["expectations"]


# Mistakes


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        (URDF.format(type="continuous", friction=0.3, more=""), {}, "friction.*backend.coulomb_friction: 0 leaves"),
        (URDF.format(type="continuous", friction=0, more='<mimic joint="hinge"/>'), {}, "mimic"),
        (URDF.format(type="floating", friction=0, more=""), {}, "type floating which is not supported"),
        (URDF.format(type="continuous", friction=0, more=""), {"fixed_base": False}, "joined to the world"),
        (URDF.format(type="continuous", friction=0, more=""), {"inputs": {"torque": "hing"}}, "did you mean 'hinge'"),
        (URDF.format(type="continuous", friction=0, more=""), {"model": "rod"}, "leave out model"),
        ("<robot name='x'><link name='a'/><joint/></robot>", {}, "Drake cannot load .*joint tag is missing name"),
        ("<robot", {}, "is no XML"),
        ("<html/>", {}, "starts with <html>"),
        ("<robot name='x'><include/></robot>", {}, "expected one file"),
    ],
)
def test_mistakes_are_told(tmp_path, text, options, message):
    with pytest.raises(UsageError, match=f"(?s){message}"):
        build(tmp_path, text, **options)


SDF = """<sdf version="1.7"><model name="p"><link name="rod"><inertial><mass>1</mass></inertial></link>
<joint name="hinge" type="revolute"><parent>world</parent><child>rod</child><axis><xyz>0 1 0</xyz>
<dynamics>{law}</dynamics></axis>
</joint></model></sdf>"""


def test_friction_of_an_sdf_over_which_drake_passes_silently_is_told(tmp_path):
    text = SDF.format(law="<friction>0.3</friction>")
    with pytest.raises(UsageError, match=r"no dry friction in joints.*coulomb_friction: 0"):
        build(tmp_path, text, ".sdf")
    assert build(tmp_path, text, ".sdf", coulomb_friction=0).coordinates == ("theta",)


def test_springs_act_and_are_no_equations(tmp_path):
    law = "<spring_stiffness>2</spring_stiffness><spring_reference>0.5</spring_reference>"
    hinge = {"states": {"q": "hinge.position", "q_dot": "hinge.velocity"}, "inputs": {"u": "hinge"}}
    b = build(tmp_path, SDF.format(law=law), ".sdf", **hinge)
    assert b.step(np.zeros((1, 2)), np.zeros((1, 1))).x[0, 1] == pytest.approx(TAU * 2 * 0.5, rel=1e-3)
    with pytest.raises(UsageError, match=r"model\.of"):
        gapcert_engines.EngineModel(b)


def test_friction_may_be_left_out(tmp_path, capfd):
    b = build(tmp_path, URDF.format(type="continuous", friction=0.3, more=""), coulomb_friction=0)
    assert "damping.hinge" in {p.name for p in b.parameters}
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("option", "joint", "message"),
    [
        ("", 'frictionloss="0.3"', "frictionloss"),
        ("", 'stiffness="3"', "stiffness"),
        ('wind="1 0 0"', "", "wind"),
        ("", 'ref="0.1"', "passes over"),
    ],
)
def test_what_drake_passes_over_in_an_mjcf_is_told(tmp_path, option, joint, message):
    with pytest.raises(UsageError, match=message):
        build(tmp_path, MJCF.format(option=option, joint=joint), ".xml")


def test_base_of_an_mjcf_says_what_the_spec_says(tmp_path):
    with pytest.raises(UsageError, match="set fixed_base: false"):
        backend(robot=MODELS / "cube.xml", states={"x": "base.x"}, inputs={})


def test_options_that_exclude_each_other_are_told():
    for options in ({"contact_approximation": "sap"}, {"joint_limits": True}):
        with pytest.raises(ValueError, match="leave"):
            DrakeConfig(**PENDULUM, integrator="runge_kutta3", **options)
    drive = {"elements": {"hinge": {"torque": 1.0}}}
    with pytest.raises(UsageError, match="no rate motor"):
        backend(inputs={"torque": "drive"}, drive=drive).step(*query(1))


def test_a_drive_is_a_clipped_effort():
    drive = {"elements": {"hinge": {"rate": 1.0}}, "gain": 2.0, "limit": 0.5}
    x, u = query(30)
    torque = np.clip(2.0 * (u[:, 0] - x[:, 1]), -0.5, 0.5)[:, None]
    found = backend(inputs={"rate": "drive"}, drive=drive).step(x, u).x
    assert np.abs(found - semi_implicit(x, torque)).max() <= 1e-15


def test_the_digest_knows_the_file_and_the_settings(tmp_path):
    assert backend().digest() == backend(tiles=3).digest()
    assert backend().digest() != backend(integrator="runge_kutta3").digest()
    copy = tmp_path / "p.urdf"
    copy.write_text((MODELS / "pendulum.urdf").read_text().replace('mass value="1"', 'mass value="2"'))
    assert RobotFile(copy).digest() != RobotFile(MODELS / "pendulum.urdf").digest()


def test_missing_package_is_told_in_one_line(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(gc.MissingDependency, match=r"needs pydrake.*pip install 'gapcert\[drake\]'"):
        registry().build("backend", "drake", DrakeConfig(**PENDULUM), Context())
