"""Backend `gazebo`: the physics in closed form, purity with contacts, Gazebo's traps, its drive, and its user's mistakes."""

import os
import pickle
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from rod import HINGE, TAU, RodContract, query, semi_implicit

from gapcert import Context, UsageError
from gapcert.testing import SystemContract
from gapcert_gazebo import shim
from gapcert_gazebo.config import GazeboConfig
from gapcert_gazebo.engine import GazeboEngine

pytestmark = [pytest.mark.contract, pytest.mark.outside("gazebo")]

ROOT = Path(__file__).parents[2]
ROBOT = ROOT / "specs/models/pendulum.sdf"
PENDULUM = HINGE | {"robot": ROBOT}
INERTIA = "<inertial><mass>{mass}</mass><inertia><ixx>{i}</ixx><iyy>{i}</iyy><izz>{i}</izz></inertia></inertial>"
GROUND = """<model name="ground"><static>true</static><link name="l"><collision name="c">
  <geometry><plane><normal>0 0 1</normal></plane></geometry></collision></link></model>"""
WHEEL = """<link name="{name}"><pose relative_to="base">{at} 0 0 0</pose>{inertia}<collision name="sphere">
  <geometry><sphere><radius>0.05</radius></sphere></geometry>
  <surface><friction><ode><mu>1</mu><mu2>{mu2}</mu2>
  <fdir1 ignition:expressed_in="base">{fdir}</fdir1></ode></friction></surface>
  </collision></link>
  <joint name="{name}_axle" type="revolute"><parent>base</parent><child>{name}</child><axis><xyz>0 1 0</xyz></axis></joint>"""
PLACES = {
    "fl": ("0.2 0.15 0", "1 -1 0"),
    "fr": ("0.2 -0.15 0", "1 1 0"),
    "rl": ("-0.2 0.15 0", "1 1 0"),
    "rr": ("-0.2 -0.15 0", "1 -1 0"),
}
AXLES = [f"{w}_axle" for w in PLACES]


def world(*models, gravity="0 0 -9.81"):
    return f'<sdf version="1.9"><world name="w"><gravity>{gravity}</gravity>{"".join(models)}</world></sdf>'


def inertial(mass=1.0, i=0.01):
    return INERTIA.format(mass=mass, i=i)


def car(mu2=0.0):
    wheels = [WHEEL.format(name=w, at=at, fdir=fdir, mu2=mu2, inertia=inertial(0.54, 5e-4)) for w, (at, fdir) in PLACES.items()]
    return world(
        GROUND,
        f'<model name="car"><pose>0 0 0.05 0 0 0</pose><link name="base">{inertial(4, 0.05)}</link>{"".join(wheels)}</model>',
    )


TUMBLER = world(
    GROUND,
    f"""<model name="tumbler"><pose>0 0 0.25 0 0 0</pose>
    <link name="body">{inertial(2, 0.05)}
    <collision name="c"><geometry><box><size>0.4 0.6 0.5</size></box></geometry></collision>
    </link><link name="arm"><pose>0.3 0 0 0 0 0</pose>{inertial(0.5)}
    <collision name="c"><geometry><sphere><radius>0.26</radius></sphere></geometry></collision></link>
    <joint name="elbow" type="revolute"><parent>body</parent><child>arm</child><axis><xyz>0 1 0</xyz></axis></joint></model>""",
)
TUMBLING = {
    "fixed_base": False,
    "states": {n: f"base.{n}" for n in ("x", "y", "z", "vx", "vy", "vz", "wx", "wy", "wz")} | {"q": "elbow.position"},
    "inputs": {"torque": "elbow"},
    "period": "3 ms",
    "substeps": 3,
}
DRIVING = {
    "fixed_base": False,
    "states": {n: f"base.{n}" for n in ("x", "y", "vx", "vy", "yaw")},
    "inputs": {"ux": "drive", "uy": "drive"},
    "rotation": "euler",
    "period": "20 ms",
    "substeps": 20,
    "drive": {
        "elements": {
            axle: {"ux": 20.0, "uy": 20.0 * side, "yaw": -20.0 * turn, "yaw_rate": -5.0 * turn}
            for axle, side, turn in zip(AXLES, (-1, 1, 1, -1), (-0.35, 0.35, -0.35, 0.35), strict=True)
        },
        "every": 2,
    },
}


def build(config, folder=None):
    return GazeboEngine.from_config(GazeboConfig(**config), Context(folder=folder or Path()))


def pendulum(**options):
    return build(PENDULUM | options)


def robot(folder, text, **options):
    (folder / "robot.sdf").write_text(text)
    return build({"robot": "robot.sdf", "period": "5 ms"} | options, folder)


def rod(joint='type="revolute"', axis="<xyz>0 1 0</xyz>", shape="", more=""):
    """The pendulum with another joint, or a shape, or something beside it."""
    text = ROBOT.read_text().replace('type="revolute"', joint).replace("<xyz>0 1 0</xyz>", axis)
    return text.replace("</inertial>", f"</inertial>{shape}").replace("</world>", f"{more}</world>")


class TestPendulum(RodContract):
    rows, substeps = 9, 2
    pendulum = staticmethod(pendulum)


class OfFile(SystemContract):
    rows = 5

    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path):
        self.folder = tmp_path


class TestTumblerWithContacts(OfFile):
    def system(self):
        return robot(self.folder, TUMBLER, **TUMBLING)

    def points(self, system):
        x, u = super().points(system)
        x[:, 2] = np.linspace(0.2, 0.3, len(x))
        return x, u


class TestDriveByRateMotors(OfFile):
    def system(self):
        return robot(self.folder, car(), **DRIVING)


# The physics


def test_joint_damping_is_implicit():
    x, u = query(50)
    assert np.abs(pendulum(joint_damping=0.2).step(x, u).x - semi_implicit(x, u, damping=0.2)).max() <= 1e-15


def test_dry_friction_holds_the_joint():
    x = np.array([[0.1, 0.0]])
    assert pendulum(coulomb_friction=1.0).step(x, np.zeros((1, 1))).x == pytest.approx(x, abs=1e-9)
    assert abs(pendulum(coulomb_friction=0.1).step(x, np.zeros((1, 1))).x[0, 1]) > 1e-4


def test_gravity_is_the_worlds_or_the_options(tmp_path):
    x, u = query(20)
    silent = robot(tmp_path, ROBOT.read_text().replace("<gravity>0 0 -9.81</gravity>", ""), **HINGE)
    assert np.abs(silent.step(x, u).x - semi_implicit(x, u, gravity=(0.0, -9.8))).max() <= 1e-15
    assert (pendulum(gravity=(0, 0, -9.8)).step(x, u).x == silent.step(x, u).x).all()


def test_a_continuous_joint_turns(tmp_path):
    """This version of Gazebo welds it."""
    b = robot(tmp_path, rod('type="continuous"'), **HINGE)
    x, u = query(20)
    assert (b.step(x, u).x == pendulum().step(x, u).x).all()


def test_a_model_without_a_world_gets_one(tmp_path):
    text = ROBOT.read_text()
    model = text[text.index("<model") : text.index("</world>")]
    b = robot(tmp_path, f'<sdf version="1.9">{model}</sdf>', gravity=(0, 0, -9.81), **HINGE)
    x, u = query(20)
    assert (b.step(x, u).x == pendulum().step(x, u).x).all()


def test_a_free_body_keeps_its_velocities_of_the_world(tmp_path):
    """A ball turned by any angle flies straight and spins evenly; how DART adds up turns is within the resolution."""
    text = world(f'<model name="ball"><link name="ball">{inertial(1, 0.1)}</link></model>', gravity="0 0 0")
    names = ("x", "y", "z", "yaw", "vx", "vy", "vz", "wx", "wy", "wz")
    b = robot(tmp_path, text, states={n: f"base.{n}" for n in names}, rotation="euler", fixed_base=False)
    x, _ = query(40, 10)
    x[:, 3], x[:, 7:9] = np.linspace(-np.pi, np.pi, 40), 0.0
    y = b.step(x, np.zeros((40, 0))).x
    expected = x.copy()
    expected[:, :3] += TAU * x[:, 4:7]
    expected[:, 3] += TAU * x[:, 9]
    error = y - expected
    error[:, 3] -= 2 * np.pi * np.round(error[:, 3] / (2 * np.pi))
    assert np.abs(error[:, :3]).max() <= 1e-15
    assert np.abs(error[:, 4:]).max() <= 1e-12
    assert 1e-15 < np.abs(error[:, 3]).max() <= b.resolution(np.ones(10))[3]
    assert pendulum().resolution(np.ones(2)).max() < 1e-15


def test_fdir1_slides_freely_in_one_direction_and_holds_in_the_other(tmp_path):
    """μ = 1 along the stated direction and 0 across it; expressed in the base, so it turns with it."""
    b = robot(
        tmp_path,
        car()
        .replace("1 -1 0</fdir1>", "1 0 0</fdir1>")
        .replace("1 1 0</fdir1>", "1 0 0</fdir1>")
        .replace('"revolute"', '"fixed"'),
        **(TUMBLING | {"states": {n: f"base.{n}" for n in ("x", "y", "yaw", "vx", "vy")}, "inputs": {}, "rotation": "euler"}),
        gravity=(0, 0, -9.81),
    )
    for yaw in (0.0, 0.7):
        along, across = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
        x = np.zeros((2, 5))
        x[:, 2], x[0, 3:], x[1, 3:] = yaw, along, across
        hidden = np.tile(b.hidden_default, (2, 1))
        end = b.rollout(x, np.zeros((2, 30, 0)), hidden=hidden).x[:, -1, 3:]
        lost = 9.81 * 30 * 0.003
        assert end[0] @ along == pytest.approx(1 - lost, abs=0.02)
        assert end[1] @ across == pytest.approx(1.0, abs=1e-9)


def test_ground_is_a_plane_with_friction(tmp_path):
    text = world(
        f"""<model name="puck"><pose>0 0 0.1 0 0 0</pose><link name="puck">{inertial()}<collision name="c">
        <geometry><box><size>1 1 0.2</size></box></geometry></collision></link></model>"""
    )
    options = {"fixed_base": False, "states": {"vx": "base.vx", "z": "base.z"}, "substeps": 5}
    x, u = np.array([[2.0, 0.1]]), np.zeros((1, 0))
    for mu in (0.1, 0.5):
        assert robot(tmp_path, text, ground=mu, **options).step(x, u).x[0, 0] == pytest.approx(2 - mu * 9.81 * TAU, rel=1e-4)
    assert robot(tmp_path, text, **options).step(x, u).x[0, 1] < 0.0999


# Purity


@pytest.mark.parametrize("detector", ["ode", "bullet", "dart", "fcl"])
def test_contacts_do_not_carry_over(tmp_path, detector):
    b = robot(tmp_path, TUMBLER, **TUMBLING, collision_detector=detector)
    x, u = query(40, 10)
    x[:, 2] = np.random.default_rng(1).uniform(0.2, 0.3, 40)
    order = np.random.default_rng(2).permutation(40)
    y = b.step(x, u)
    again = b.step(x[order], u[order])
    assert y.x[order].tobytes() == again.x.tobytes()
    assert y.hidden[order].tobytes() == again.hidden.tobytes()
    flying = robot(tmp_path, TUMBLER.replace(GROUND, ""), **TUMBLING).step(x, u).x
    assert (np.abs(y.x - flying).max(axis=1) > 1e-3).sum() > 10


def test_another_process_gives_the_same_bits_in_another_order(tmp_path):
    b = robot(tmp_path, TUMBLER, **TUMBLING)
    x, u = query(30, 10, seed=4)
    x[:, 2] = np.linspace(0.2, 0.3, 30)
    job = """import pickle, sys
b, x, u = pickle.load(sys.stdin.buffer)
sys.stdout.buffer.write(b.step(x[::-1], u[::-1]).x.tobytes())"""
    done = subprocess.run([sys.executable, "-c", job], input=pickle.dumps((b, x, u)), capture_output=True, check=True)
    assert np.frombuffer(done.stdout).reshape(x.shape)[::-1].tobytes() == b.step(x, u).x.tobytes()


def test_a_detector_that_is_kept_remembers(tmp_path):
    """Why every query gets a new one: the bare loop keeps Bullet's, with its pairs of shapes and their contacts."""
    capsule = "<geometry><capsule><radius>0.1</radius><length>0.8</length></capsule></geometry>"
    text = rod(
        shape=f"<collision name='c'><pose>0 0 -0.5 0 0 0</pose>{capsule}</collision>",
        more=GROUND.replace("<link", "<pose>0 0 -0.9 0 0 0</pose><link"),
    )
    b = robot(tmp_path, text, **HINGE, collision_detector="bullet")
    x, u = query(50, scale=0.02)
    order = np.random.default_rng(1).permutation(50)
    assert (b.step(x, u).x[order] == b.step(x[order], u[order]).x).all()

    def bare(x, u):
        x, u, after = np.ascontiguousarray(x), np.ascontiguousarray(u), np.empty_like(x)
        shim.shim().bare(b._worlds[1]._handle, len(x), 1, x.ctypes.data, u.ctypes.data, after.ctypes.data)
        return after

    assert np.abs(bare(x, u)[order] - bare(x[order], u[order])).max() > 1e-3


def test_any_order_gives_the_same_bits_past_a_joint_limit(tmp_path):
    text = rod(axis="<xyz>0 1 0</xyz><limit><lower>-0.5</lower><upper>0.5</upper></limit>")
    b = robot(tmp_path, text, **HINGE)
    x, u = query(200)
    order = np.random.default_rng(1).permutation(len(x))
    y = b.step(x, u).x
    assert (y[order] == b.step(x[order], u[order]).x).all()
    assert np.abs(y - pendulum().step(x, u).x).max() > 1e-3


def test_threads_share_one_instance_and_may_have_their_own(tmp_path):
    shared = robot(tmp_path, TUMBLER, **TUMBLING)
    work = [query(10, 10, seed=k) for k in range(6)]
    expected = [shared.step(*w).x for w in work]
    own = [pickle.loads(pickle.dumps(shared)) for _ in work]
    with ThreadPoolExecutor(4) as pool:
        for found in (pool.map(lambda w: shared.step(*w).x, work), pool.map(lambda b, w: b.step(*w).x, own, work)):
            assert all((f == e).all() for f, e in zip(found, expected, strict=True))


def test_a_closed_backend_opens_again():
    b = pendulum()
    x, u = query(5)
    y = b.step(x, u).x
    b.close()
    assert not b._worlds
    assert (b.step(x, u).x == y).all()


def test_the_digest_names_the_world_and_the_options(tmp_path):
    (tmp_path / "elsewhere.sdf").write_bytes(ROBOT.read_bytes())
    assert pendulum(robot=tmp_path / "elsewhere.sdf").digest() == pendulum().digest()
    others = [{"substeps": 2}, {"period": "6 ms"}, {"gravity": (0, 0, -9.8)}, {"solver": "pgs"}, {"collision_detector": "dart"}]
    assert len({pendulum(**o).digest() for o in [{}, *others]}) == 1 + len(others)
    (tmp_path / "elsewhere.sdf").write_text(rod().replace("<mass>1<", "<mass>2<"))
    assert pendulum(robot=tmp_path / "elsewhere.sdf").digest() != pendulum().digest()


# Gazebo's traps


def test_trap_a_time_step_within_a_microsecond_of_the_old_one_is_ignored():
    """Gazebo starts with 1 ms and keeps it when it is told 1.0005 ms."""
    x, u = query(20)
    assert np.abs(pendulum(period="1.0005 ms").step(x, u).x - semi_implicit(x, u, tau=0.0010005)).max() <= 1e-15


def test_trap_time_is_counted_in_whole_nanoseconds():
    with pytest.raises(UsageError, match=r"0.005 s in 3 sub-steps are 1666666.67 ns each; Gazebo counts whole nanoseconds"):
        pendulum(substeps=3)


# Forces and parameters


def test_parameters_per_row_equal_options(tmp_path):
    b = pendulum()
    x, u = query(60)
    k = np.arange(60) % 3
    y = b.step(x, u, parameters={"damping.hinge": 0.1 * k, "coulomb_friction.hinge": 0.02 * k, "gravity_z": -1.0 * k}).x
    for i in range(3):
        options = {"joint_damping": 0.1 * i, "coulomb_friction": 0.02 * i, "gravity": (0, 0, -1.0 * i)}
        assert y[k == i].tobytes() == pendulum(**options).step(x[k == i], u[k == i]).x.tobytes()
    assert b.step(x, u).x.tobytes() == pendulum().step(x, u).x.tobytes(), "parameters must not outlive their call"
    heavy = (
        rod().replace("<mass>1<", "<mass>2<").replace("0.08333333333333333", "0.16666666666666666").replace("0.0001", "0.0002")
    )
    assert b.step(x, u, parameters={"mass.rod": 2.0}).x == pytest.approx(
        robot(tmp_path, heavy, **HINGE).step(x, u).x, abs=1e-15
    )


def test_friction_is_a_factor_on_all_contacts(tmp_path):
    options = {"fixed_base": False, "states": {"vx": "base.vx"}, "substeps": 5}
    text = world(
        f"""<model name="puck"><pose>0 0 0.1 0 0 0</pose><link name="puck">{inertial()}<collision name="c">
        <geometry><box><size>1 1 0.2</size></box></geometry></collision></link></model>"""
    )
    b = robot(tmp_path, text, ground=0.5, **options)
    y = b.step(np.full((3, 1), 2.0), np.zeros((3, 0)), parameters={"friction": [0.0, 1.0, 0.4]}).x[:, 0]
    assert 2 - y == pytest.approx(np.array([0.0, 0.5, 0.2]) * 9.81 * TAU, rel=1e-3, abs=1e-9)
    assert "friction" not in {p.name for p in pendulum().parameters}


# The drive


def test_the_car_goes_where_it_is_told_and_keeps_its_heading(tmp_path):
    b = robot(tmp_path, car(), **DRIVING)
    goals = np.array([[0.5, 0.0], [0.0, 0.5], [-0.3, 0.4]])
    x = np.zeros((3, 5))
    x[:, 4] = 0.05
    end = b.rollout(x, np.repeat(goals[:, None], 100, axis=1)).x[:, -1]
    assert np.abs(end[:, 2:4] - goals).max() < 0.02
    assert np.abs(end[:, 4]).max() < 0.015
    free = DRIVING["drive"] | {
        "elements": {a: {k: v for k, v in e.items() if k[0] == "u"} for a, e in DRIVING["drive"]["elements"].items()}
    }
    end = robot(tmp_path, car(), **(DRIVING | {"drive": free})).rollout(x, np.repeat(goals[:, None], 100, axis=1)).x[:, -1]
    assert np.abs(end[:, 4]).min() > 0.02


def test_a_rate_motor_reaches_its_rate_in_one_step_within_its_limit():
    drive = {"elements": {"hinge": {"rate": 2.0}}}
    x, u = query(20)
    options = {"inputs": {"rate": "drive"}}
    held = pendulum(**options, drive=drive).step(x, u).x
    assert held[:, 1] == pytest.approx(2 * u[:, 0], abs=1e-8)
    weak = pendulum(**options, drive=drive | {"limit": 0.5}).step(x, u).x
    push = semi_implicit(x, 0.5 * np.sign(2 * u - x[:, 1:]))
    assert weak == pytest.approx(push, abs=1e-8)


def test_torques_of_a_drive_are_renewed_in_every_substep():
    drive = {"elements": {"hinge": {"rate": 2.0}}, "gain": 0.3, "limit": 0.4}
    x, u = query(40)
    y = pendulum(inputs={"rate": "drive"}, drive=drive, substeps=5).step(x, u).x
    for _ in range(5):
        x = semi_implicit(x, np.clip(0.3 * (2 * u - x[:, 1:]), -0.4, 0.4), tau=TAU / 5)
    assert np.abs(y - x).max() <= 1e-15


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_forces_act_beside_a_rate_motor(tmp_path, kind):
    """The motor owns the joint's command, so they go to the links; a motor without strength shows them alone."""
    text = world(
        f"""<model name="arm"><link name="a"><pose>0 0 -0.5 0 0 0</pose>{inertial()}</link>
        <link name="b"><pose>0 0 -1.2 0 0.3 0</pose>{inertial(0.5)}</link>
        <joint name="upper" type="revolute"><pose>0 0 0.5 0 0 0</pose><parent>world</parent><child>a</child>
        <axis><xyz>0 1 0</xyz></axis></joint>
        <joint name="lower" type="{kind}"><parent>a</parent><child>b</child><axis><xyz>0.6 0.8 0</xyz></axis></joint></model>"""
    )
    options = {"states": {f"{j}.{f}": f"{j}.{f}" for j in ("upper", "lower") for f in ("position", "velocity")}, "substeps": 5}
    x, u = query(20, 4)
    forces = np.random.default_rng(3).normal(size=(20, 5, 2))
    plain = robot(tmp_path, text, **options).step(x, u[:, :0], forces=forces).x
    drive = {"elements": {j: {"rate": 1.0} for j in ("upper", "lower")}, "limit": 1e-12}
    driven = robot(tmp_path, text, **options, inputs={"rate": "drive"}, drive=drive).step(x, u, forces=forces).x
    assert driven == pytest.approx(plain, abs=1e-12)
    assert np.abs(plain - robot(tmp_path, text, **options).step(x, u[:, :0]).x).max() > 1e-3


def test_a_motor_without_limit_on_a_joint_with_stops_is_refused(tmp_path):
    text = rod(axis="<xyz>0 1 0</xyz><limit><lower>-0.5</lower><upper>0.5</upper></limit>")
    options = {"states": PENDULUM["states"], "inputs": {"rate": "drive"}}
    with pytest.raises(UsageError, match=r"joint 'hinge' has limits, which Gazebo's rate motor heeds only where its effort"):
        robot(tmp_path, text, **options, drive={"elements": {"hinge": {"rate": 1.0}}})
    robot(tmp_path, text, **options, drive={"elements": {"hinge": {"rate": 1.0}}, "limit": 5.0})


# The user's mistakes

BALL = f'<model name="ball"><link name="ball">{inertial()}</link></model>'
TWO = f'<model name="two"><link name="a">{inertial()}</link><link name="b">{inertial()}</link></model>'
MESH = "<collision name='c'><geometry><mesh><uri>rod.dae</uri></mesh></geometry></collision>"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot/>", "found no <sdf> element; expected an SDF file with a world or a model"),
        ("<sdf version='1.9'><world name='w'></sdf>", "robot.sdf: mismatched tag: line 1, column 37; expected well-formed XML"),
        (world("<include><uri>model://car</uri></include>"), "it includes other files; write it out as one"),
        (world(GROUND), "it has no model that is not static"),
        (rod(more=BALL), "its models pendulum, ball can move; expected one robot"),
        (rod('type="ball"'), "joint 'hinge' is neither revolute, continuous, prismatic nor fixed"),
        (rod(more="").replace("<child>rod<", "<child>stick<"), "stick"),
        (rod().replace("<mass>1<", "<mass>-1<"), "inertia"),
        (rod(shape=MESH), "[Mm]esh"),
        (world(TWO), "links 'a' and 'b' are not connected; join them"),
        (world(BALL), "its base floats; set fixed_base: false, or join it to the world"),
        (rod('type="fixed"'), "has no movable joint"),
    ],
)
def test_a_file_that_cannot_be_used_is_one_sentence(tmp_path, capfd, text, message):
    with pytest.raises(UsageError, match=message) as caught:
        robot(tmp_path, text, states=PENDULUM["states"], inputs=PENDULUM["inputs"])
    assert "\n" not in str(caught.value)
    assert "\x1b" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(UsageError, match=r"nowhere.sdf: No such file or directory; expected an SDF file"):
        pendulum(robot=tmp_path / "nowhere.sdf")


def test_the_robot_is_named_where_others_could_be_it(tmp_path):
    still = rod(more=GROUND.replace("ground", "table"))
    x, u = query(5)
    assert (robot(tmp_path, still, model="pendulum", **HINGE).step(x, u).x == pendulum().step(x, u).x).all()
    with pytest.raises(UsageError, match="it has no model 'cart'; it has pendulum"):
        robot(tmp_path, still, model="cart", **HINGE)
    with pytest.raises(UsageError, match="its model 'table' is static; expected one that moves"):
        robot(tmp_path, still.replace("<static>true</static>", "<static>true</static>", 1), model="table", **HINGE)
    with pytest.raises(UsageError, match="its base is joined to the world; set fixed_base: true"):
        robot(tmp_path, still, fixed_base=False, **HINGE)


def test_numbers_that_run_away_name_their_row_and_end_no_process(tmp_path):
    """Debian's DART asserts that its numbers are finite."""
    x = np.array([[0.0, 0.0], [1e308, 1e308]])
    message = "row {} goes beyond 1e12, where Gazebo cannot follow; take shorter sub-steps"
    with pytest.raises(UsageError, match=message.format(1)):
        pendulum().step(x, np.zeros((2, 1)))
    with pytest.raises(UsageError, match=message.format(0)):
        pendulum(period="1 s", substeps=10).step(x[:1], np.full((1, 1), 1e12))
    ball = world(f'<model name="ball"><link name="ball">{inertial()}</link></model>')
    b = robot(tmp_path, ball, states={"z": "base.z"}, fixed_base=False, gravity=(0, 0, -1e15))
    with pytest.raises(UsageError, match=message.format(0)):
        b.step(np.zeros((1, 1)), np.zeros((1, 0)))


# What the operating system lacks

SPEC = """version: 1
name: p
model: {kind: equations, states: {theta: rad, omega: rad/s}, inputs: {torque: N*m}, parameters: {J: 1 kg*m^2},
  derivative: {theta: omega, omega: torque/J}, integrator: euler, period: 5 ms}
backend: {kind: gazebo, robot: pendulum.sdf, states: {theta: hinge.position, omega: hinge.velocity}, inputs: {torque: hinge}}
domain: {theta: [-1, 1], omega: [-1, 1], torque: [-1, 1]}
"""


def command(*arguments, **environment):
    code = [sys.executable, "-m", "gapcert", *arguments]
    return subprocess.run(code, capture_output=True, text=True, env=os.environ | environment, check=False)


def test_missing_packages_are_one_sentence_and_exit_code_3(tmp_path):
    (tmp_path / "p.yaml").write_text(SPEC)
    (tmp_path / "pendulum.sdf").write_bytes(ROBOT.read_bytes())
    nowhere = {"PKG_CONFIG_LIBDIR": str(tmp_path), "PKG_CONFIG_PATH": ""}
    sentence = "backend 'gazebo' needs libeigen3-dev, libignition-physics-core-dev, libignition-physics-sdf-dev"
    install = "run: apt-get install -y --no-install-recommends g++ pkg-config libignition-physics-core-dev"
    done = command("run", str(tmp_path / "p.yaml"), "--out", str(tmp_path / "runs"), **nowhere)
    assert done.returncode == 3
    told = " ".join(done.stderr.split())
    assert sentence in told
    assert install in told
    listed = command("plugins", "--json", **nowhere).stdout
    assert sentence in listed
    assert install in listed
    assert sentence in command("doctor", "--json", **nowhere).stdout
    tools = tmp_path / "tools"
    tools.mkdir()
    (tools / "pkg-config").symlink_to("/usr/bin/pkg-config")
    assert "backend 'gazebo' needs g++, which is not installed" in command("plugins", "--json", PATH=str(tools)).stdout


# The compiled shim


@pytest.fixture
def compiler(tmp_path, monkeypatch):
    """A compiler that counts its calls, and an empty cache."""
    real, calls = shim.compiled(), tmp_path / "calls"
    script = tmp_path / "g++"
    script.write_text(
        f"""#!/bin/sh
        if [ "$1" = --version ]; then echo 1.0; exit; fi
        echo call >> {calls}
        while [ "$1" != -o ]; do shift; done
        cp {real} "$2"
        """
    )
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    calls.touch()
    return script, calls


def test_it_is_compiled_once_and_again_for_another_compiler(compiler):
    script, calls = compiler
    path = shim.compiled()
    assert shim.compiled() == path
    assert calls.read_text().count("call") == 1
    assert [p.name for p in path.parent.iterdir()] == [path.name], "nothing else is left behind"
    script.write_text(script.read_text().replace("1.0", "2.0"))
    assert shim.compiled() != path
    assert calls.read_text().count("call") == 2


def test_processes_that_compile_at_once_do_not_collide(compiler):
    code = "from gapcert_gazebo.shim import shim; print(shim().failure())"
    jobs = [subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) for _ in range(3)]
    assert [j.communicate()[0].strip() for j in jobs] == ["b''"] * 3


def test_a_compiler_that_fails_says_why(compiler):
    script, _ = compiler
    script.write_text(
        "#!/bin/sh\n[ \"$1\" = --version ] && exit\necho 'shim.cpp:1: fatal error: World.hh: no such file' >&2; exit 1\n"
    )
    with pytest.raises(UsageError, match=r"g\+\+ cannot compile the shim: shim.cpp:1: fatal error: World.hh: no such file"):
        shim.compiled()


def test_a_cache_that_cannot_be_written_is_named(compiler, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(UsageError, match=r"file/gapcert/gazebo cannot be written: .*; let XDG_CACHE_HOME name a folder"):
        shim.compiled()
