"""Backend `pybullet`: the physics in closed form, purity, tiling, PyBullet's traps, and its user's mistakes."""

import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from rod import HINGE, TAU, RodContract, query, semi_implicit

from gapcert import Context, Parameter, StateSpec, System, UsageError, registry
from gapcert.testing import SystemContract
from gapcert_engines import EngineBackend
from gapcert_pybullet.config import PyBulletConfig
from gapcert_pybullet.urdf import RobotFile

pytestmark = [pytest.mark.needs("pybullet"), pytest.mark.contract]


ROOT = Path(__file__).parents[2]
ROBOT = ROOT / "specs/models/pendulum.urdf"
PENDULUM = HINGE | {"robot": ROBOT}
CLEAN = {"linear_damping": 0.0, "angular_damping": 0.0}

ROD = """<link name="{name}"><inertial><origin xyz="0 0 -0.5"/><mass value="1"/>
  <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.01"/></inertial>{shape}</link>"""
JOINT = """<joint name="{name}" type="{type}"><parent link="{parent}"/><child link="{child}"/>
  <origin xyz="{at}"/><axis xyz="0 1 0"/>{more}</joint>"""
ACROBOT = (
    '<robot name="acrobot"><link name="world"/>'
    + ROD.format(name="upper", shape="")
    + ROD.format(name="lower", shape="")
    + JOINT.format(name="shoulder", type="continuous", parent="world", child="upper", at="0 0 0", more="")
    + JOINT.format(
        name="elbow",
        type="continuous",
        parent="upper",
        child="lower",
        at="0 0 -1",
        more='<dynamics damping="0.3" friction="0"/>',
    )
    + "</robot>"
)
FOUR = {"a": "shoulder.position", "b": "elbow.position", "da": "shoulder.velocity", "db": "elbow.velocity"}


def pendulum(**options):
    from gapcert_pybullet.engine import PyBulletEngine

    return EngineBackend(PyBulletEngine(PyBulletConfig(**(PENDULUM | options))))


def build(tmp_path, text, **options):
    from gapcert_pybullet.engine import PyBulletEngine

    path = tmp_path / "robot.urdf"
    path.write_text(text)
    return EngineBackend(PyBulletEngine(PyBulletConfig(**({"robot": path, "period": "5 ms"} | options))))


def acrobot(tmp_path, **options):
    return build(tmp_path, ACROBOT, **({"states": FOUR, "inputs": {"torque": "elbow"}} | options))


def dragged(x, u):
    """By the engine's own damping of 0.04 /s: k (ω + ω|ω|) on the spin, k (v + v|v|) on the centre of mass."""
    omega = x[:, 1:]
    return semi_implicit(x, u - 0.04 / 3 * omega * (1 + 0.625 * np.abs(omega)))


class TestPendulum(RodContract):
    def pendulum(self, **options):
        return pendulum(**CLEAN, **options)

    def system(self):
        return pendulum(substeps=3)


class TestAcrobotWithHiddenElbow(SystemContract):
    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path):
        self.folder = tmp_path

    def system(self):
        return acrobot(self.folder, states={"a": "shoulder.position", "da": "shoulder.velocity"}, inputs={"torque": "shoulder"})


class TestFloating(SystemContract):
    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path):
        self.folder = tmp_path

    def system(self):
        text = ACROBOT.replace('<link name="world"/>', ROD.format(name="world", shape=""))
        return build(self.folder, text, states=FOUR, inputs={"torque": "elbow"}, fixed_base=False)


BALL = """<robot name="crate"><link name="crate"><inertial><origin xyz="{at}"/><mass value="2"/>
  <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"/></inertial>
  <collision><geometry><box size="0.2 0.2 0.2"/></geometry></collision></link>{more}</robot>"""
WHEEL = """<link name="{name}"><inertial><mass value="0.2"/>
  <inertia ixx="1e-4" ixy="0" ixz="0" iyy="2e-4" iyz="0" izz="1e-4"/></inertial>
  <collision><geometry><sphere radius="0.05"/></geometry></collision></link>"""
PLANAR = {"px": "base.x", "py": "base.y", "vx": "base.vx", "vy": "base.vy"}


def crate(tmp_path, at="0 0 0", **options):
    more = {"states": PLANAR, "fixed_base": False, "ground": 0.8, "substeps": 5, **options}
    return build(tmp_path, BALL.format(at=at, more=""), **more)


def cart(tmp_path, **options):
    """A body on four driven wheels."""
    links = "".join(WHEEL.format(name=f"w{k}") for k in range(4))
    joints = "".join(
        JOINT.format(name=f"axle{k}", type="continuous", parent="crate", child=f"w{k}", at=f"{x} {y} -0.08", more="")
        for k, (x, y) in enumerate([(0.15, 0.15), (0.15, -0.15), (-0.15, 0.15), (-0.15, -0.15)])
    )
    text = BALL.format(at="0 0 0", more=links + joints)
    drive = {
        "elements": {f"axle{k}": {"speed": 20.0, "yaw": (-1) ** k * 4.0, "yaw_rate": (-1) ** k * 1.0} for k in range(4)},
        "gain": 0.2,
        "limit": 2.0,
        "every": 5,
    }
    states = {"px": "base.x", "vx": "base.vx"}
    more = {"states": states, "inputs": {"speed": "drive"}, "fixed_base": False, "ground": 1.0, "substeps": 20, "drive": drive}
    return build(tmp_path, text, **(more | {"period": "20 ms"} | options))


def at_height(b, height):
    column = [s.name for s in b.hidden for _ in range(s.size)].index("base.z")
    b.hidden_default = (*b.hidden_default[:column], height, *b.hidden_default[column + 1 :])
    return b


class TestCrateOnTheGround(SystemContract):
    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path):
        self.folder = tmp_path

    def system(self):
        return at_height(crate(self.folder, at="0.02 0 0.01"), 0.1)


class TestCrateWithEulerAngles(SystemContract):
    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path):
        self.folder = tmp_path

    def system(self):
        return at_height(crate(self.folder, rotation="euler", states=PLANAR | {"yaw": "base.yaw"}), 0.1)


@pytest.mark.parametrize("gain", [0.2, None])
class TestCart(SystemContract):
    """Driven by servos, and by Bullet's rate motors."""

    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path, gain):
        self.folder, self.gain = tmp_path, gain

    def system(self):
        drive = cart(self.folder).config.drive.model_dump() | {"gain": self.gain}
        return at_height(cart(self.folder, drive=drive), 0.13)


@pytest.mark.parametrize(("friction", "mu"), [(None, 0.4), (0.25, 0.2)])
def test_crate_slides_with_the_product_of_frictions(tmp_path, friction, mu):
    """v⁺ = v − μ g τ: Bullet multiplies the ground's coefficient by the link's (0.5 where the file says nothing)."""
    drag = {"linear_damping": 0.0, "angular_damping": 0.0}
    b = at_height(crate(tmp_path, friction=friction, period="100 ms", substeps=100, **drag), 0.1)
    x = b.rollout(np.array([[0.0, 0, 2, 0]]), np.zeros((1, 3, 0))).x[0]
    assert (x[2, 2] - x[3, 2]) / 0.1 == pytest.approx(mu * 9.81, rel=2e-2)


def test_tumbling_body_keeps_its_centres_velocity(tmp_path):
    """The base is the link's frame, away from the centre of mass: its velocity is that of the centre plus ω × r."""
    b = crate(tmp_path, at="0.1 0 0", ground=None, gravity=(0.0, 0.0, 0.0), linear_damping=0.0, angular_damping=0.0)
    names = [s.name for s in b.hidden for _ in range(s.size)]
    hidden = np.array(b.hidden_default)
    hidden[names.index("base.wz")] = 3.0
    # Of the origin: the centre's (0.4, 0) less ω × r = (0, 0.3).
    out = b.rollout(np.array([[0, 0, 0.4, -0.3]]), np.zeros((1, 40, 0)), hidden=hidden[None])
    t = b.period * np.arange(41)
    r = 0.1 * np.stack([np.cos(3 * t), np.sin(3 * t)], axis=1)
    assert np.abs(out.x[0, :, :2] - (np.array([0.1, 0]) + np.outer(t, [0.4, 0.0]) - r)).max() < 1e-3


def test_drive_follows_its_command(tmp_path):
    b = at_height(cart(tmp_path), 0.13)
    out = b.rollout(np.zeros((1, 2)), np.full((1, 100, 1), 0.5))
    assert out.x[0, -1, 1] == pytest.approx(0.5, abs=0.02)


DRIVES = [
    ({"elements": {"axel0": {"speed": 1.0}}}, r"drive.elements: .* has no 'axel0' to drive; did you mean 'axle0'"),
    ({"elements": {"axle0": {"sped": 1.0}}}, r"drive.elements.axle0: 'sped' is no input of the drive; did you mean 'speed'"),
    ({"elements": {"axle0": {"speed": 1.0}}, "every": 3}, r"drive.every: 3 is no divisor of the 20 sub-steps"),
    (None, "goes to the drive, and there is none"),
]


@pytest.mark.parametrize(("drive", "message"), DRIVES)
def test_drive_mistakes(tmp_path, drive, message):
    with pytest.raises(UsageError, match=message):
        cart(tmp_path, drive=drive)


# The physics


def test_default_damping_is_linear_plus_quadratic():
    """ω gap −0.04 τ ω − 0.025 τ ω|ω|: drag k(v + v|v|) on the centre of mass and k(ω + ω|ω|) on the spin."""
    x, u = query(2000, scale=3.0)
    y = pendulum().step(x, u).x
    assert np.abs(y - dragged(x, u)).max() <= 1e-15
    gap = y[:, 1] - pendulum(**CLEAN).step(x, u).x[:, 1]
    basis = np.stack([x[:, 1], x[:, 1] * np.abs(x[:, 1])], axis=1)
    fit, *_ = np.linalg.lstsq(basis, gap, rcond=None)
    assert fit == pytest.approx([-0.04 * TAU, -0.025 * TAU], rel=1e-9)
    assert np.abs(gap - basis @ fit).max() <= 1e-12
    linear = basis[:, :1]
    assert np.abs(gap - linear @ np.linalg.lstsq(linear, gap, rcond=None)[0]).max() > 1e-6


def test_joint_damping_is_a_torque():
    x, u = query(50)
    assert np.abs(pendulum(**CLEAN, joint_damping=0.2).step(x, u).x - semi_implicit(x, u - 0.2 * x[:, 1:])).max() <= 1e-15


def test_file_states_joint_damping(tmp_path):
    damping = {p.name: p.value for p in acrobot(tmp_path).parameters}
    assert damping["damping.elbow"] == 0.3
    assert damping["damping.shoulder"] == 0.0
    assert {p.name: p.value for p in acrobot(tmp_path, joint_damping=0.0).parameters}["damping.elbow"] == 0.0


def test_inertia_flag_matters():
    x, u = query(50)
    assert np.abs(pendulum(use_inertia_from_file=False).step(x, u).x - pendulum().step(x, u).x).max() > 1e-3


def test_gravity_is_an_option():
    x, u = query(20)
    free = pendulum(**CLEAN, gravity=(0.0, 0.0, 0.0)).step(x, u).x
    assert free[:, 1] == pytest.approx(x[:, 1] + TAU * 3 * u[:, 0], abs=1e-15)


# Purity


def test_any_order_gives_the_same_bits_past_a_joint_limit(tmp_path):
    """A limit is a constraint with a solver behind it; its impulses must not carry over."""
    limited = ACROBOT.replace('type="continuous"', 'type="revolute"').replace(
        '<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><limit lower="-0.5" upper="0.5" effort="1" velocity="1"/>'
    )
    b = build(tmp_path, limited, states=FOUR, inputs={"torque": "elbow"})
    assert b.tiling.startswith("untiled: joint 'elbow' has limits") or b.tiling.startswith(
        "untiled: joint 'shoulder' has limits"
    )
    x, u = query(200, 4)
    order = np.random.default_rng(1).permutation(len(x))
    y = b.step(x, u).x
    assert (y[order] == b.step(x[order], u[order]).x).all()
    free = acrobot(tmp_path).step(x, u).x
    assert np.abs(y - free).max() > 1e-3


FINGER = (
    '<link name="{0}"><inertial><origin xyz="0 0 0.2"/><mass value="0.5"/><inertia ixx="0.007" iyy="0.007" izz="0.0003" '
    'ixy="0" ixz="0" iyz="0"/></inertial><collision><origin xyz="0 0 0.2"/><geometry><box size="0.03 0.03 0.4"/></geometry>'
    '</collision></link><joint name="{0}" type="continuous"><parent link="palm"/><child link="{0}"/><origin xyz="{1} 0 0"/>'
    '<axis xyz="0 1 0"/></joint>'
)
CLAW = f'<robot name="claw"><link name="palm"/>{FINGER.format("left", -0.15)}{FINGER.format("right", 0.15)}</robot>'


def claw(tmp_path, **options):
    states = {"l": "left.position", "l_dot": "left.velocity", "r": "right.position", "r_dot": "right.velocity"}
    return build(tmp_path, CLAW, states=states, inputs={"torque": "left"}, gravity=(0.0, 0.0, 0.0), **options)


@pytest.mark.parametrize("substeps", [1, 4])
def test_rods_of_one_robot_meet_where_they_may_and_forget_it(tmp_path, substeps):
    closing, still = np.array([[0.0, 0.9, 0.0, -0.7]]), np.zeros((1, 300, 1))
    through = claw(tmp_path, substeps=substeps).rollout(closing, still).x[0]
    assert through[-1, 0] > 1.0
    assert through[-1, 2] < -0.8
    b = claw(tmp_path, substeps=substeps, self_collision=True)
    assert b.tiling == "untiled: collision shapes take part in the physics"
    met = b.rollout(closing, still).x[0]
    # Tips 0.3 m apart at first, of rods of 0.4 m with half a width of 0.015 m: both lean by 0.34 rad where they touch.
    assert (met[:, 0] - met[:, 2]).max() < 0.8
    rng = np.random.default_rng(2)
    x, u = rng.uniform([0.2, -2, -0.6, -2], [0.6, 2, -0.2, 2], (80, 4)), rng.uniform(-1, 1, (80, 1))
    y = b.step(x, u).x
    assert (np.abs(y - claw(tmp_path, substeps=substeps).step(x, u).x).max(axis=1) > 1e-6).sum() > 8
    order = rng.permutation(len(x))
    assert (b.step(x[order], u[order]).x == y[order]).all()
    for close in (1e-1, 1e-3, 1e-6, 1e-10):
        near = x + close * rng.uniform(-1, 1, x.shape)
        pairs = [b.step(np.stack(rows), np.stack([v, v])).x[1] for *rows, v in zip(near, x, u, strict=True)]
        assert (np.array(pairs) == y).all()


def test_threads_share_one_instance():
    b = pendulum()
    work = [query(40, seed=k) for k in range(8)]
    expected = [b.step(*w).x for w in work]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda w: b.step(*w).x, work * 5))
    assert all((f == e).all() for f, e in zip(found, expected * 5, strict=True))


def test_pickling_drops_the_engine():
    b = pendulum()
    x, u = query(30)
    y = b.step(x, u).x
    again = pickle.loads(pickle.dumps(b))
    assert not again._worlds
    assert (again.step(x, u).x == y).all()


def test_closing_disconnects_and_the_next_query_reconnects():
    import pybullet

    b = pendulum()
    clients = [c.id for w in b._worlds.values() for c in w.clients.values()]
    x, u = query(30)
    y = b.step(x, u).x
    b.close()
    assert not any(pybullet.isConnected(c) for c in clients)
    assert (b.step(x, u).x == y).all()
    clients = [c.id for w in b._worlds.values() for c in w.clients.values()]
    del b
    assert not any(pybullet.isConnected(c) for c in clients)


def test_changed_file_is_noticed(tmp_path):
    b = acrobot(tmp_path)
    copy = pickle.dumps(b)
    (tmp_path / "robot.urdf").write_text(ACROBOT.replace('mass value="1"', 'mass value="2"'))
    with pytest.raises(UsageError, match="has changed since"):
        pickle.loads(copy).step(*query(1, 4))


# Tiling


@pytest.mark.parametrize("n", [1, 3, 4, 15, 16, 17, 19, 20, 33])
@pytest.mark.parametrize("substeps", [1, 2])
def test_tiles_give_the_bits_of_one_robot(n, substeps):
    tiled, single = pendulum(substeps=substeps), pendulum(tiles=1, substeps=substeps)
    assert tiled.tiling == "16 copies, bit-equal to one robot"
    assert single.tiling == "untiled: one copy was asked for"
    x, u = query(n, scale=3.0)
    assert tiled.step(x, u).x.tobytes() == single.step(x, u).x.tobytes()
    forces = np.random.default_rng(2).normal(size=(n, substeps, 1))
    assert tiled.step(x, u, forces=forces).x.tobytes() == single.step(x, u, forces=forces).x.tobytes()


def test_tiles_of_a_chain(tmp_path):
    tiled, single = acrobot(tmp_path), acrobot(tmp_path, tiles=1)
    assert tiled.tiling == "16 copies, bit-equal to one robot"
    x, u = query(70, 4, scale=3.0)
    assert tiled.step(x, u).x.tobytes() == single.step(x, u).x.tobytes()


def test_tiles_stop_below_bullets_limit(tmp_path):
    assert acrobot(tmp_path, tiles=120).tiling == "60 copies, bit-equal to one robot"
    with pytest.raises(ValueError, match="less than or equal to 120"):
        pendulum(tiles=121)


def test_copies_that_differ_are_not_used(monkeypatch, tmp_path):
    whole = RobotFile.tiled
    monkeypatch.setattr(RobotFile, "tiled", lambda self, k: whole(self, k).replace('mass value="1"', 'mass value="1.0000001"'))
    b = pendulum()
    assert b.tiling == "untiled: 16 copies differed from one robot"
    x, u = query(40)
    assert np.abs(b.step(x, u).x - dragged(x, u)).max() <= 1e-15


def test_tiles_are_no_part_of_the_digest(tmp_path):
    assert pendulum(tiles=1).digest() == pendulum().digest()
    (tmp_path / "elsewhere.urdf").write_bytes(ROBOT.read_bytes())
    assert pendulum(robot=tmp_path / "elsewhere.urdf").digest() == pendulum().digest()
    others = [CLEAN, {"substeps": 2}, {"period": "6 ms"}, {"gravity": (0, 0, -9.8)}, {"joint_damping": 0.1}]
    assert len({pendulum(**o).digest() for o in [{}, *others]}) == 1 + len(others)
    (tmp_path / "elsewhere.urdf").write_text(ROBOT.read_text() + "\n")
    assert pendulum(robot=tmp_path / "elsewhere.urdf").digest() != pendulum().digest()


# Forces and parameters


@pytest.mark.parametrize("substeps", [1, 4])
def test_forces_add_to_the_torque(substeps):
    b = pendulum(substeps=substeps)
    assert b.coordinates == ("theta",)
    x, u = query(40)
    forces = np.full((40, substeps, 1), 0.25)
    assert b.step(x, u * 0, forces=forces).x.tobytes() == b.step(x, u * 0 + 0.25).x.tobytes()


def test_parameters_per_row_equal_options():
    b = pendulum()
    x, u = query(60)
    k = np.arange(60) % 3
    y = b.step(
        x, u, parameters={"linear_damping": 0.1 * k, "angular_damping": 0.0, "damping.hinge": 0.2, "gravity_z": -1.0 * k}
    ).x
    for i in range(3):
        options = {"linear_damping": 0.1 * i, "angular_damping": 0.0, "joint_damping": 0.2, "gravity": (0, 0, -1.0 * i)}
        assert y[k == i].tobytes() == pendulum(**options).step(x[k == i], u[k == i]).x.tobytes()
    assert b.step(x, u).x.tobytes() == pendulum().step(x, u).x.tobytes(), "parameters must not outlive their call"


def test_negative_damping_is_refused():
    """PyBullet ignores it without a word."""
    with pytest.raises(UsageError, match=r"damping.hinge = -0.1; expected a number in \[0.0, inf\]"):
        pendulum().step(*query(2), parameters={"damping.hinge": -0.1})


# PyBullet's traps, planted by calling it directly


@pytest.fixture
def bare():
    import pybullet

    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0, 0, -9.81, client)
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE
    body = pybullet.loadURDF(str(ROBOT), useFixedBase=True, flags=flags, physicsClientId=client)
    # Bullet's own 0.04 is single precision.
    pybullet.changeDynamics(body, -1, linearDamping=0.04, angularDamping=0.04, physicsClientId=client)
    yield client, body
    pybullet.disconnect(client)


def ask(bare, x, u, steps=1):
    import pybullet

    client, body = bare
    pybullet.resetJointState(body, 0, x[0], x[1], client)
    for _ in range(steps):
        pybullet.setJointMotorControl2(body, 0, pybullet.TORQUE_CONTROL, force=u, physicsClientId=client)
        pybullet.stepSimulation(client)
    return np.array(pybullet.getJointState(body, 0, client)[:2])


def free(bare):
    import pybullet

    client, body = bare
    pybullet.setJointMotorControl2(body, 0, pybullet.VELOCITY_CONTROL, force=0, physicsClientId=client)


def test_trap_default_motor_holds_the_joint(bare):
    import pybullet

    pybullet.setTimeStep(TAU, bare[0])
    assert abs(ask(bare, [0.2, 0.25], 1.0)[1]) < 1e-10
    free(bare)
    assert ask(bare, [0.2, 0.25], 1.0) == pytest.approx(pendulum().step(np.array([[0.2, 0.25]]), np.ones((1, 1))).x[0], abs=0)


def test_trap_default_time_step(bare):
    free(bare)
    x, u = np.array([[0.2, 0.25]]), np.ones((1, 1))
    assert np.abs(ask(bare, x[0], 1.0) - pendulum().step(x, u).x[0]).max() > 5e-5
    assert ask(bare, x[0], 1.0) == pytest.approx(pendulum(period=f"{1 / 240!r} s").step(x, u).x[0], abs=1e-15)


def test_trap_fused_substeps_freeze_joint_damping(bare):
    """PyBullet adds joint damping once per call: its own sub-steps would share it."""
    import pybullet

    client, body = bare
    free(bare)
    pybullet.changeDynamics(body, 0, jointDamping=0.5, physicsClientId=client)
    pybullet.setTimeStep(TAU / 10, client)
    explicit = ask(bare, [0.1, 1.0], 0.0, steps=10)
    pybullet.setTimeStep(TAU, client)
    pybullet.setPhysicsEngineParameter(numSubSteps=10, physicsClientId=client)
    fused = ask(bare, [0.1, 1.0], 0.0)
    assert np.abs(fused - explicit).max() > 1e-6
    b = pendulum(joint_damping=0.5, substeps=10)
    assert b.step(np.array([[0.1, 1.0]]), np.zeros((1, 1))).x[0] == pytest.approx(explicit, abs=0)


def test_trap_fused_substeps_lose_time(bare):
    """0.005 / (0.005 / 55) is a little less than 55, so PyBullet takes 54 steps and keeps the rest for the next query."""
    import pybullet

    from gapcert_pybullet.world import fuses

    client, _ = bare
    free(bare)
    assert fuses(TAU, 10)
    assert not fuses(TAU, 55)
    pybullet.setTimeStep(TAU, client)
    pybullet.setPhysicsEngineParameter(numSubSteps=55, physicsClientId=client)
    first, second = ask(bare, [0.1, 1.0], 0.0), ask(bare, [0.1, 1.0], 0.0)
    assert np.abs(first - second).max() > 1e-6
    b = pendulum(substeps=55)
    x, u = query(10)
    assert b.step(x, u).x.tobytes() == b.step(x, u).x.tobytes()


@pytest.mark.parametrize("substeps", [2, 3, 10])
def test_fused_substeps_equal_explicit_ones(substeps):
    b = pendulum(substeps=substeps)
    x, u = query(40)
    for _ in range(2):  # in both orders: neither path may leave time behind for the other
        fused = b.step(x, u).x
        explicit = b.step(x, u, forces=np.zeros((40, substeps, 1))).x
        assert fused.tobytes() == explicit.tobytes()


# Names, units and files


class Frame(System):
    """A model's axes without a model."""

    def __init__(self, states, inputs, period=TAU):
        self.states, self.inputs, self.period = states, inputs, period

    def _step(self, x, u, **options):
        return x


MODEL = Frame((StateSpec("omega", "rad/s"), StateSpec("theta", "rad", "angle")), (StateSpec("torque", "N*m"),))


def with_model(model=MODEL, **options):
    from gapcert_pybullet.engine import PyBulletEngine

    config = PyBulletConfig(**{k: v for k, v in (PENDULUM | {"robot": ROBOT.name} | options).items() if v is not None})
    return PyBulletEngine.from_config(config, Context(folder=ROBOT.parent, model=model))


def test_model_gives_order_units_kinds_and_period():
    b = with_model(period=None)
    assert b.states == MODEL.states
    assert b.inputs == MODEL.inputs
    assert b.period == TAU
    x, u = query(10)
    assert (b.step(x, u).x == pendulum().step(x[:, ::-1], u).x[:, ::-1]).all()


def test_without_a_model_the_joints_give_them():
    b = pendulum()
    assert [(s.name, s.unit, s.kind) for s in b.states] == [("theta", "rad", "angle"), ("omega", "rad/s", "real")]
    assert b.inputs == (StateSpec("torque", "N*m"),)
    assert Parameter("linear_damping", 0.04, "1/s", low=0.0) in b.parameters


RENAMED = {"states": {"theta": "hinge.position", "omga": "hinge.velocity"}}
MISTAKES = {
    "no file": ({"robot": "pendulm.urdf"}, "there is no file .*pendulm.urdf"),
    "joint": ({"inputs": {"torque": "hing"}}, "inputs.torque: .* has no joint 'hing'; did you mean 'hinge'"),
    "joint of a state": ({"states": {"theta": "elbow.position", "omega": "hinge.velocity"}}, "no joint 'elbow'; it has hinge"),
    "extra state": (RENAMED, "the model has no 'omga'; did you mean 'omega'"),
    "missing state": ({"states": {"theta": "hinge.position"}}, "'omega' of the model is missing; add omega: JOINT"),
    "missing input": ({"inputs": {}}, "'torque' of the model is missing; add torque: JOINT"),
    "unit": (
        {"states": {"theta": "hinge.velocity", "omega": "hinge.position"}},
        "the model gives it in rad/s, but hinge.position is in rad",
    ),
}


@pytest.mark.parametrize("case", MISTAKES, ids=list(MISTAKES))
def test_mistakes_end_in_one_sentence(case):
    options, message = MISTAKES[case]
    with pytest.raises(UsageError, match=message) as error:
        with_model(**options)
    assert "\n" not in str(error.value)


def test_units_of_another_dimension_are_refused():
    degrees = Frame((StateSpec("theta", "deg"), StateSpec("omega", "rad/s")), (StateSpec("torque", "N*m"),))
    with pytest.raises(UsageError, match=r"the model gives it in deg, but hinge\.position is in rad"):
        with_model(degrees)
    force = Frame(MODEL.states, (StateSpec("torque", "N"),))
    with pytest.raises(UsageError, match=r"the model gives it in N, but what drives 'hinge' is in N\*m; use N\*m in the model"):
        with_model(force)


FIXED = ACROBOT.replace('name="elbow" type="continuous"', 'name="elbow" type="fixed"')
FILES = {
    "empty": ("", {}, "is no XML"),
    "broken": ("<robot><link></robot>", {}, "is no XML: mismatched tag: line 1"),
    "not a robot": ("<mujoco/>", {}, "starts with <mujoco>"),
    "an end that is no link": (
        ACROBOT.replace('<child link="lower"/>', '<child link="hand"/>'),
        {},
        r"joint elbow has type continuous and ends \['upper', 'hand'\]; expected .* links of the file",
    ),
    "no joint": ('<robot name="r"><link name="l"/></robot>', {}, "no movable joint"),
    "fixed joint": (FIXED, {}, "joint 'elbow' .* is fixed"),
    "massless floating root": (ACROBOT, {"fixed_base": False}, "root link has no <inertial>"),
    "no period": (ACROBOT, {"period": None}, "no model to take it from"),
}


@pytest.mark.parametrize("case", FILES, ids=list(FILES))
def test_unusable_robots_are_refused(case, tmp_path, capfd):
    text, options, message = FILES[case]
    options = {"states": {"a": "elbow.position"}} | options
    with pytest.raises(UsageError, match=message) as error:
        build(tmp_path, text, **options)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


CONFIGS = [
    ({"states": {"theta": "hinge"}}, "expected JOINT.position, JOINT.velocity or base.FIELD"),
    ({"states": {"theta": "hinge.angle"}}, "expected JOINT.position, JOINT.velocity or base.FIELD"),
    ({"states": {"a": "hinge.position", "b": "hinge.position"}}, "'b' and 'a' are both 'hinge.position'"),
    ({"inputs": {"a": "hinge", "b": "hinge"}}, "'b' and 'a' are both 'hinge'"),
    ({"period": "5 m"}, "unit 'm' does not fit"),
    ({"period": "-5 ms"}, "expected a positive time"),
    ({"substeps": 0}, "greater than or equal to 1"),
    ({"linear_damping": -0.1}, "greater than or equal to 0"),
    ({"gravity": (0, 0, float("nan"))}, "finite number"),
    ({"dampng": 0.1}, "Extra inputs are not permitted"),
]


@pytest.mark.parametrize(("options", "message"), CONFIGS)
def test_config_refuses(options, message):
    with pytest.raises(ValueError, match=message):
        PyBulletConfig(**(PENDULUM | options))


def test_engine_prints_nothing(capfd):
    b = pendulum()
    b.step(*query(5))
    b.close()
    assert capfd.readouterr() == ("", "")
    options = PENDULUM | {"robot": str(ROBOT)}
    code = (
        "from gapcert import registry; from gapcert_pybullet.config import PyBulletConfig; "
        f"registry().build('backend', 'pybullet', PyBulletConfig(**{options!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert (done.stdout, done.stderr) == (b"", b"")


def test_declaration_imports_no_engine():
    code = (
        "import sys, gapcert; r = gapcert.registry(); r.config('backend', 'pybullet'); "
        "sys.exit('pybullet' in sys.modules or 'pint' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    assert registry().get("backend", "pybullet").missing() is None


def test_joints_that_cannot_be_reset_are_refused(tmp_path):
    ball = ACROBOT.replace('<joint name="shoulder" type="continuous">', '<joint name="shoulder" type="spherical">')
    assert ball != ACROBOT
    with pytest.raises(UsageError, match="joint 'shoulder' is spherical; expected revolute"):
        build(tmp_path, ball, states={"a": "elbow.position", "b": "elbow.velocity"}, inputs={"torque": "elbow"})
