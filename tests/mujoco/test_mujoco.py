"""Backend `mujoco`: the physics in closed form, purity with contacts, tiling, MuJoCo's traps, and its user's mistakes."""

import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rod import HINGE, TAU, RodContract, query, semi_implicit

from gapcert import Box, Context, Domain, StateSpec, System, UsageError, registry
from gapcert.certification.gates.purity import purity
from gapcert.certification.samples.executors import processes, threads
from gapcert.testing import SystemContract
from gapcert_engines import EngineBackend
from gapcert_mujoco.config import MuJoCoConfig

pytestmark = [pytest.mark.needs("mujoco"), pytest.mark.contract]


ROOT = Path(__file__).parents[2]
ROBOT = ROOT / "specs/models/pendulum.urdf"
PENDULUM = HINGE | {"robot": ROBOT}
ROD = """<mujoco><option{option}/><compiler angle="radian"/>{more}<worldbody>
  <body name="rod"><joint name="hinge" axis="0 1 0" {joint}/>
  <inertial pos="0 0 -0.5" mass="1" diaginertia="0.08333333333333333 0.08333333333333333 0.01"/>
  <body name="tip" pos="0 0 -1">{tip}</body></body></worldbody></mujoco>"""
CHAIN = """<mujoco><worldbody><body name="upper"><joint name="a" axis="0 1 0"/>
  <geom type="capsule" size=".02" fromto="0 0 0 0 0 -1" mass="1"/>
  <body name="lower" pos="0 0 -1"><joint name="b" axis="0 1 0" damping="0.3"/>
  <geom type="capsule" size=".02" fromto="0 0 0 0 0 -1" mass="1"/></body></body></worldbody></mujoco>"""
CRATE = """<mujoco><worldbody><body name="crate" pos="0 0 0.1"><freejoint name="root"/>
  <geom name="hull" type="box" size=".1 .15 .1" mass="2" pos="{at}" {geom}/>{more}</body></worldbody></mujoco>"""
WHEEL = """<body name="{name}" pos="{at}"><joint name="{name}" axis="0 1 0"/>
  <geom type="cylinder" size="0.05 0.02" euler="90 0 0" mass="0.2"/></body>"""
CART = CRATE.format(
    at="0 0 0",
    geom='contype="0" conaffinity="0"',
    more="".join(
        WHEEL.format(name=n, at=f"{x} {y} -0.05")
        for n, x, y in [("fl", 0.1, 0.2), ("fr", 0.1, -0.2), ("rl", -0.1, 0.2), ("rr", -0.1, -0.2)]
    ),
)
PLANAR = {"px": "base.x", "py": "base.y", "vx": "base.vx", "vy": "base.vy"}
FORWARD = {
    n: {"rate": 1.0, "yaw": s, "yaw_rate": 0.1 * s} for n, s in (("fl", 30.0), ("rl", 30.0), ("fr", -30.0), ("rr", -30.0))
}


def pendulum(**options):
    from gapcert_mujoco.engine import MuJoCoEngine

    return EngineBackend(MuJoCoEngine(MuJoCoConfig(**(PENDULUM | options))))


def build(folder, text, **options):
    from gapcert_mujoco.engine import MuJoCoEngine

    path = folder / ("robot.urdf" if "<robot" in text else "robot.xml")
    path.write_text(text)
    return EngineBackend(MuJoCoEngine(MuJoCoConfig(**({"robot": path, "period": "5 ms"} | options))))


def rod(folder, *, option="", joint="", tip="", more="", **options):
    states = {"theta": "hinge.position", "omega": "hinge.velocity"}
    text = ROD.format(option=option, joint=joint, tip=tip, more=more)
    return build(folder, text, **({"states": states, "inputs": {"torque": "hinge"}} | options))


def crate(folder, at="0 0 0", geom="", more="", **options):
    text = CRATE.format(at=at, geom=geom, more=more)
    return build(folder, text, **({"states": PLANAR, "fixed_base": False, "ground": 0.8, "substeps": 5} | options))


def cart(folder, **options):
    drive = {"elements": FORWARD, "gain": 0.1, "limit": 2.0, "every": 5}
    given = {"states": PLANAR, "inputs": {"rate": "drive"}, "drive": drive, "fixed_base": False, "ground": 1.0, "substeps": 20}
    return build(folder, CART, **(given | {"period": "20 ms"} | options))


def belt(folder, **options):
    """A crate whose own surface moves, as a track vehicle's: positive targets drive it backwards."""
    given = {"inputs": {"speed": "drive"}, "drive": {"elements": {"hull": {"speed": 1.0}}}}
    return crate(folder, geom='surfacevel="1 0 0 0 0 0"', **(given | options))


class TestPendulum(RodContract):
    pendulum = staticmethod(pendulum)


class InFolder(SystemContract):
    rows = 8

    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path):
        self.folder = tmp_path


class TestLimitedRod(InFolder):
    def system(self):
        return rod(self.folder, joint='range="-0.5 0.5" limited="true" frictionloss="0.05"', substeps=2)


class TestCrate(InFolder):
    def system(self):
        return crate(self.folder)


class TestCart(InFolder):
    def system(self):
        return cart(self.folder)

    def domain(self, system):
        return Domain(Box(system.states, (-1.0,) * 4, (1.0,) * 4), Box(system.inputs, (-5.0,), (5.0,)))


class TestBelt(InFolder):
    def system(self):
        return belt(self.folder)


# The physics


def test_the_file_and_the_urdf_are_semi_implicit_euler(tmp_path):
    x, u = query(500, scale=3.0)
    expected = semi_implicit(x, u)
    assert np.abs(pendulum().step(x, u).x - expected).max() <= 1e-15
    assert np.abs(rod(tmp_path, gravity=(0, 0, -9.81)).step(x, u).x - expected).max() <= 1e-15


def test_damping_is_implicit_unless_asked():
    x, u = query(50)
    damped = pendulum(joint_damping=0.5)
    assert np.abs(damped.step(x, u).x - semi_implicit(x, u, damping=0.5)).max() <= 1e-15
    explicit = semi_implicit(x, u - 0.5 * x[:, 1:])
    assert np.abs(pendulum(joint_damping=0.5, euler_damping="explicit").step(x, u).x - explicit).max() <= 1e-15
    assert np.abs(damped.step(x, u).x - explicit).max() > 1e-6


def test_integrators_converge_to_one_flow():
    x, u = query(50)
    fine = pendulum(integrator="RK4", substeps=20).step(x, u).x
    assert np.abs(pendulum(integrator="RK4").step(x, u).x - fine).max() < 1e-9
    assert np.abs(pendulum().step(x, u).x - fine).max() > 1e-6


NATIVE = {
    "gravity_z": (-3.0, {"gravity": (0.0, -3.0)}),
    "damping.hinge": (0.7, {"damping": 0.7}),
    "armature.hinge": (0.2, {"armature": 0.2}),
    "mass.rod": (4.0, {"mass": 4.0}),
}


@pytest.mark.parametrize("name", NATIVE)
@pytest.mark.parametrize("tiles", [1, 16])
def test_native_parameters_against_the_closed_form(name, tiles):
    x, u = query(40)
    value, formula = NATIVE[name]
    b = pendulum(tiles=tiles)
    given = np.where(np.arange(40) % 2, value, {p.name: p.value for p in b.parameters}[name])
    y = b.step(x, u, parameters={name: given}).x
    expected = np.where(np.arange(40)[:, None] % 2, semi_implicit(x, u, **formula), semi_implicit(x, u))
    assert np.abs(y - expected).max() <= 2e-15
    assert b.step(x, u).x.tobytes() == pendulum(tiles=1).step(x, u).x.tobytes(), "parameters must not outlive their call"


def test_dry_friction_holds_a_joint_and_slows_another():
    b = pendulum(tiles=16)
    x = np.zeros((20, 2))
    x[:, 1] = np.linspace(0.5, 2.0, 20)
    held = b.step(x * 0, np.full((20, 1), 0.3), parameters={"frictionloss.hinge": 1.0}).x
    assert np.abs(held).max() < 1e-3
    assert np.abs(b.step(x * 0, np.full((20, 1), 0.3)).x[:, 1]).min() > 4e-3
    slid = b.step(x, np.zeros((20, 1)), parameters={"frictionloss.hinge": 1.0}).x
    # ω⁺ = ω − τ F/I, up to the softness of the constraint.
    assert slid[:, 1] == pytest.approx(x[:, 1] - TAU * 3.0, abs=1e-3)
    stated = pendulum(frictionloss=1.0)
    assert stated.tiling.startswith("untiled: copies would solve")
    assert stated.step(x, np.zeros((20, 1))).x.tobytes() == slid.tobytes()


def test_parameters_have_units_and_bounds(tmp_path):
    units = {p.name: (p.value, p.unit, p.low) for p in pendulum().parameters}
    assert units["damping.hinge"] == (0.0, "N*m*s/rad", 0.0)
    assert units["mass.rod"] == (1.0, "kg", 1e-3)
    assert units["gravity_z"] == (-9.81, "m/s^2", -np.inf)
    slide = build(tmp_path, CHAIN.replace('name="a"', 'name="a" type="slide"'), states={"p": "a.position"}, inputs={"f": "a"})
    assert [(s.unit, s.kind) for s in slide.states] == [("m", "real")]
    assert slide.inputs == (StateSpec("f", "N"),)
    assert {p.name: p.unit for p in slide.parameters}["damping.a"] == "N*s/m"
    with pytest.raises(UsageError, match=r"parameter damping.hinge = -0.1; expected a number in \[0.0, inf\]"):
        pendulum().step(*query(2), parameters={"damping.hinge": -0.1})


@pytest.mark.parametrize("tiles", [1, 16])
def test_forces_act_per_substep(tiles):
    x, u = query(20)
    forces = np.zeros((20, 2, 1))
    forces[:, 1] = 1.0
    y = pendulum(substeps=2, tiles=tiles).step(x, u, forces=forces).x
    first = semi_implicit(x, u, tau=TAU / 2)
    assert np.abs(y - semi_implicit(first, u + 1, tau=TAU / 2)).max() <= 1e-15


def test_the_resolution_bounds_the_arithmetic():
    """Against the same recursion in extended precision."""
    x, u = query(500, scale=3.0)
    for substeps in (1, 20, 100):
        b = pendulum(substeps=substeps, tiles=1)
        h, (theta, omega) = np.longdouble(TAU) / substeps, x.T.astype(np.longdouble)
        for _ in range(substeps):
            omega = omega + h * 3 * (u[:, 0] - np.longdouble("4.905") * np.sin(theta))
            theta = theta + h * omega
        y = b.step(x, u).x
        error = np.abs(y - np.stack([theta, omega], axis=1)).max(axis=0)
        assert (error <= b.resolution(np.abs(y).max(axis=0))).all()


def test_the_resolution_covers_what_a_solver_leaves(tmp_path):
    """A translation changes no bit of the physics, so what changes is arithmetic and the solver's last iterate."""
    for solver in ("Newton", "CG"):
        b = cart(tmp_path, solver=solver)
        rest = b.rollout(np.zeros((1, 4)), np.zeros((1, 50, 1))).hidden
        x = np.zeros((200, 4))
        x[:, :2] = np.random.default_rng(0).uniform(-1, 1, (200, 2))
        moved = b.step(x, np.full((200, 1), 0.5), hidden=np.tile(rest, (200, 1))).x - x
        assert (np.ptp(moved, axis=0) <= 2 * b.resolution(np.abs(moved + x).max(axis=0))).all()
    assert b.resolution(np.ones(4)) == pytest.approx(b.period * b.engine.unsolved)
    assert b.engine.unsolved > 1e-8


# The base


def test_a_free_body_moves_and_turns_in_the_worlds_frame(tmp_path):
    """Without gravity its centre of mass goes straight; the base is the frame's origin, 0.3 m away from it."""
    b = crate(tmp_path, at="0.3 0 0", ground=None, gravity=(0, 0, 0), substeps=200, period="200 ms", geom='density="0"')
    rng = np.random.default_rng(0)
    hidden = np.tile(np.asarray(b.hidden_default), (30, 1))
    names = [h.name for h in b.hidden for _ in range(h.size)]
    turn = rng.normal(size=(30, 4))
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    rate = rng.uniform(-3, 3, (30, 3))
    hidden[:, names.index("base.rotation") : names.index("base.rotation") + 4] = turn
    hidden[:, names.index("base.wx") :] = rate
    x = rng.uniform(-1, 1, (30, 4))
    out = b.step(x, np.empty((30, 0)), hidden=hidden)

    def centre(x, hidden):
        r = rotated(hidden[:, names.index("base.rotation") :][:, :4], np.array([0.3, 0, 0]))
        place = np.stack([x[:, 0], x[:, 1], hidden[:, names.index("base.z")]], axis=1)
        speed = np.stack([x[:, 2], x[:, 3], hidden[:, names.index("base.vz")]], axis=1)
        return place + r, speed + np.cross(hidden[:, names.index("base.wx") :], r)

    (place, speed), (place_after, speed_after) = centre(x, hidden), centre(out.x, out.hidden)
    assert place_after == pytest.approx(place + 0.2 * speed, abs=2e-3)
    assert speed_after == pytest.approx(speed, abs=2e-2)


def rotated(quaternion, v):
    w, r = quaternion[:, :1], quaternion[:, 1:]
    v = np.broadcast_to(v, r.shape)
    return v + 2 * (w * np.cross(r, v) + np.cross(r, np.cross(r, v)))


URDF = """<robot name="r"><link name="base"><inertial><mass value="4"/>
  <inertia ixx=".1" ixy="0" ixz="0" iyy=".1" iyz="0" izz=".1"/></inertial>
  <visual><geometry><box size=".2 .2 .1"/></geometry></visual></link>
  <link name="plate"><inertial><mass value="0.16"/>
  <inertia ixx=".1" ixy="0" ixz="0" iyy=".1" iyz="0" izz=".1"/></inertial></link>
  <joint name="fix" type="fixed"><parent link="base"/><child link="plate"/><origin xyz="0 0 0.1"/></joint>
  <link name="wheel"><inertial><mass value="2"/><inertia ixx=".1" ixy="0" ixz="0" iyy=".1" iyz="0" izz=".1"/></inertial></link>
  <joint name="axle" type="continuous"><parent link="plate"/><child link="wheel"/><axis xyz="0 1 0"/></joint></robot>"""


def test_a_urdf_keeps_its_mass_when_its_base_floats(tmp_path):
    from gapcert_mujoco.robot import compiled

    (tmp_path / "robot.urdf").write_text(URDF)

    def mass(**options):
        config = MuJoCoConfig(robot="robot.urdf", states={"a": "axle.position"}, **options)
        return compiled(tmp_path / "robot.urdf", config).body_mass[1:].sum()

    assert mass() == pytest.approx(2.0), "MuJoCo fuses a base that does not move into the world"
    assert mass(fixed_base=False) == pytest.approx(6.16)
    b = build(tmp_path, URDF, states={"a": "axle.position"}, fixed_base=False)
    assert {p.name: p.value for p in b.parameters}["mass.base"] == pytest.approx(4.16)
    out = b.step(np.zeros((1, 1)), np.empty((1, 0)))
    vz = [h.name for h in b.hidden for _ in range(h.size)].index("base.vz")
    assert out.hidden[0, vz] == pytest.approx(-9.81 * TAU)


def test_euler_angles_are_the_same_motion(tmp_path):
    quaternion = crate(tmp_path)
    euler = crate(tmp_path, rotation="euler")
    assert [h.name for h in euler.hidden] == [f"base.{f}" for f in ("z", "roll", "pitch", "yaw", "vz", "wx", "wy", "wz")]
    x, _ = query(20, nx=4)
    u = np.empty((20, 0))
    assert euler.step(x, u).x == pytest.approx(quaternion.step(x, u).x, abs=1e-12)


def test_the_ground_has_the_friction_that_is_asked_for(tmp_path):
    """A sliding crate slows by μ g, whatever the file says of the crate's own friction."""
    x, u = np.array([[0.0, 0.0, 1.0, 0.0]]), np.empty((1, 0))

    def slowed(b, hidden, **parameters):
        return 1 - b.rollout(x, np.empty((1, 20, 0)), hidden=hidden, parameters=parameters).x[0, -1, 2]

    for mu in (0.2, 0.6):
        b = crate(tmp_path, ground=mu, substeps=20, cone="elliptic")
        rest = b.rollout(x * 0, np.empty((1, 100, 0))).hidden
        assert slowed(b, rest) == pytest.approx(mu * 9.81 * 20 * TAU, rel=0.05)
    assert slowed(b, rest, friction=0.5) == pytest.approx(0.3 * 9.81 * 20 * TAU, rel=0.05)
    assert crate(tmp_path, contact=False).step(x, u).x[0, 2] == 1.0


# The drive


def test_motors_follow_their_rate_in_every_substep(tmp_path):
    """ω⁺ = ω + h clip(k (r − ω), ±L)/I, sub-step by sub-step."""
    text = ROD.format(option=' gravity="0 0 0"', joint="", tip="", more="")
    drive = {"elements": {"hinge": {"rate": 2.0}}, "gain": 3.0, "limit": 1.5}
    b = build(tmp_path, text, states=PENDULUM["states"], inputs={"rate": "drive"}, drive=drive, substeps=4)
    x, u = query(50)
    theta, omega = x.T
    for _ in range(4):
        omega = omega + TAU / 4 * np.clip(3.0 * (2 * u[:, 0] - omega), -1.5, 1.5) * 3
        theta = theta + TAU / 4 * omega
    assert np.abs(b.step(x, u).x - np.stack([theta, omega], axis=1)).max() <= 1e-15


def test_a_motor_without_a_gain_is_there_after_one_step(tmp_path):
    drive = {"elements": {"hinge": {"rate": 1.0}}}
    b = rod(tmp_path, option=' gravity="0 0 0"', drive=drive, inputs={"rate": "drive"})
    x, u = query(20)
    assert b.step(x, u).x[:, 1] == pytest.approx(u[:, 0], abs=1e-12)
    weak = rod(tmp_path, option=' gravity="0 0 0"', drive=drive | {"limit": 0.1}, inputs={"rate": "drive"})
    assert np.abs(weak.step(x, u).x[:, 1] - x[:, 1]).max() == pytest.approx(TAU * 0.3)


def test_a_files_defaults_do_not_reach_the_motors(tmp_path):
    more = (
        '<default><general gear="7" ctrlrange="-1e-3 1e-3" dyntype="integrator"/><geom contype="0" conaffinity="0"/></default>'
    )
    drive = {"elements": {"hinge": {"rate": 1.0}}}
    b = rod(tmp_path, option=' gravity="0 0 0"', more=more, drive=drive, inputs={"rate": "drive"}, ground=1.0)
    x, u = query(20)
    assert b.step(x, u).x[:, 1] == pytest.approx(u[:, 0], abs=1e-12)


def test_surfaces_drive_a_crate(tmp_path):
    b = belt(tmp_path, substeps=100, period="500 ms")
    u = np.array([[1.0], [-0.5], [0.0]])
    out = b.step(np.zeros((3, 4)), u)
    for _ in range(3):
        out = b.step(out.x, u, hidden=out.hidden)
    assert out.x[:, 2] == pytest.approx(-u[:, 0], abs=2e-3)
    assert b.engine.drivable() == ("hull",)


def test_the_heading_is_held(tmp_path):
    held = cart(tmp_path)
    loose = cart(tmp_path, drive={"elements": {n: {"rate": 1.0} for n in FORWARD}, "gain": 0.1, "limit": 2.0})
    names = [h.name for h in held.hidden for _ in range(h.size)]
    rotation, turning = names.index("base.rotation"), names.index("base.wz")
    x, u = np.zeros((1, 4)), np.full((1, 1), 4.0)
    yaw = {}
    for name, b in (("held", held), ("loose", loose)):
        hidden = np.asarray(b.hidden_default)[None].copy()
        hidden[0, rotation : rotation + 4] = [np.cos(0.1), 0, 0, np.sin(0.1)]
        out = b.step(x, u, hidden=hidden)
        for _ in range(40):
            out = b.step(out.x, u, hidden=out.hidden)
        yaw[name] = 2 * np.arctan2(out.hidden[0, rotation + 3], out.hidden[0, rotation])
        assert np.abs(out.hidden[0, turning]) < 0.5
    assert np.abs(yaw["held"]) < 0.08 < 0.15 < np.abs(yaw["loose"])


def test_feedback_is_renewed_as_often_as_asked(tmp_path):
    x = np.array([[0.0, 0.0, 0.3, 0.0]])
    u = np.full((1, 1), 4.0)
    drive = {"elements": FORWARD, "gain": 0.1, "limit": 2.0}
    seldom, often = (cart(tmp_path, drive=drive | {"every": k}) for k in (20, 1))
    assert seldom.step(x, u).x.tobytes() != often.step(x, u).x.tobytes()


# Purity


def test_contacts_and_solver_do_not_carry_over(tmp_path):
    b = cart(tmp_path)
    axes = dict.fromkeys(PLANAR, (-1.0, 1.0)) | {"rate": (-5.0, 5.0)}
    domain = Domain.of(b, axes)
    for executor in (threads, processes):
        assert purity("backend", b, domain, executor, 0).endswith("agreed bit for bit")


class Careless(System):
    """What a loop over mj_step does that only writes positions and velocities: the solver starts from the last answer."""

    def __init__(self, path):
        self.states = (StateSpec("z", "m"), StateSpec("vx", "m/s"))
        self.inputs, self.period, self.path = (StateSpec("vz", "m/s"),), 0.005, path
        self._open()

    def _open(self):
        import mujoco

        self.model = mujoco.MjModel.from_xml_path(str(self.path))
        self.data = mujoco.MjData(self.model)

    def __getstate__(self):
        return {k: v for k, v in vars(self).items() if k not in ("model", "data")}

    def __setstate__(self, state):
        vars(self).update(state)
        self._open()

    def _step(self, x, u, **options):
        import mujoco

        out = np.empty_like(x)
        for k in range(len(x)):
            self.data.qpos[:] = self.model.qpos0
            self.data.qvel[:] = [x[k, 1], 0, u[k, 0], 0, 0, 0]
            self.data.qpos[2] += 1e-3 * x[k, 0]
            mujoco.mj_step(self.model, self.data)
            out[k] = self.data.qpos[2], self.data.qvel[0]
        return out


def test_the_warm_start_leak_is_caught(tmp_path):
    (tmp_path / "crate.xml").write_text(
        CRATE.format(at="0 0 0", geom="", more="").replace("<worldbody>", '<worldbody><geom type="plane" size="0 0 1"/>')
    )
    careless = Careless(tmp_path / "crate.xml")
    domain = Domain.of(careless, {"z": (-1.0, 0.0), "vx": (-1.0, 1.0), "vz": (-0.2, 0.0)})
    with pytest.raises(UsageError, match=r"the backend is not a function of .*: the same .* differ by up to"):
        purity("backend", careless, domain, threads, 5)

    class Contract(SystemContract):
        def system(self):
            return Careless(tmp_path / "crate.xml")

        def domain(self, system):
            return domain

    with pytest.raises(AssertionError, match="gave other bits"):
        Contract().test_order_does_not_matter()


def test_the_leak_would_be_ours_without_the_reset(tmp_path, monkeypatch):
    """The rows' solver memory is what the reset is for."""
    from gapcert_mujoco.stepping import Rows

    b = crate(tmp_path)
    whole = Rows._block

    def leaking(self, state, *rest):
        self._clean = self._batch.state[0].copy()
        return whole(self, state, *rest)

    x, _ = query(30, nx=4)
    u, hidden = np.empty((30, 0)), np.tile(b.hidden_default, (30, 1))
    hidden[:, 0] = 0.1 - np.linspace(0, 2e-3, 30)

    def in_both_orders():
        return [b.step(x[o], u, hidden=hidden[o]).x[o].tobytes() for o in (slice(None), slice(None, None, -1))]

    assert len(set(in_both_orders())) == 1
    monkeypatch.setattr(Rows, "_block", leaking)
    assert len(set(in_both_orders())) == 2


def test_threads_change_no_bit(tmp_path):
    x, u = query(700, nx=4, scale=0.5)
    for make in (lambda **o: crate(tmp_path, **o), lambda **o: pendulum(**o)):
        one, two = make(threads=1), make(threads=2)
        args = (x[:, : one.nx], u[:, : one.nu])
        assert one.step(*args).x.tobytes() == two.step(*args).x.tobytes()
        assert one.digest() == two.digest()


def test_a_broken_state_is_named_and_leaves_nothing_behind(tmp_path, capfd, monkeypatch):
    """MuJoCo would answer with the file's pose, at rest; its warning would go to a file in the working folder."""
    import mujoco

    monkeypatch.chdir(tmp_path)
    x, u = query(5)
    for b in (pendulum(tiles=1), pendulum(tiles=1, substeps=4), pendulum(), rod(tmp_path, joint='range="-9 9" limited="true"')):
        good = b.step(x, u).x
        bad = x.copy()
        bad[3, 1] = 1e11
        with pytest.raises(UsageError, match=r"MuJoCo: .* from positions \[.*\], velocities \[100000000000.0\]") as error:
            b.step(bad, u)
        assert "\n" not in str(error.value)
        assert b.step(x, u).x.tobytes() == good.tobytes()
    diverging = pendulum(substeps=3, period="3 s", joint_damping=1e4, euler_damping="explicit")
    with pytest.raises(UsageError, match="use more substeps"):
        diverging.step(x * 1e5, u)
    assert capfd.readouterr() == ("", "")
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()
    assert mujoco.get_mju_user_warning() is None, "the user's own handler is back"


def test_pickling_drops_the_engine_and_keeps_the_models(tmp_path):
    b = build(tmp_path, CHAIN, states={"a": "a.position"}, inputs={"f": "b"}, contact=False)
    x, u = query(40, nx=1)
    y = b.step(x, u).x
    data = pickle.dumps(b)
    (tmp_path / "robot.xml").unlink()
    again = pickle.loads(data)
    assert not again._worlds
    assert again.tiling == "256 copies, bit-equal to one robot"
    assert again.step(x, u).x.tobytes() == y.tobytes()


# Tiling


@pytest.mark.parametrize("n", [1, 5, 20, 21, 256, 300, 513])
@pytest.mark.parametrize("substeps", [1, 2])
def test_tiles_give_the_bits_of_one_robot(n, substeps):
    tiled, single = pendulum(substeps=substeps), pendulum(tiles=1, substeps=substeps)
    assert tiled.tiling == "256 copies, bit-equal to one robot"
    x, u = query(n, scale=3.0)
    assert tiled.step(x, u).x.tobytes() == single.step(x, u).x.tobytes()
    forces = np.random.default_rng(2).normal(size=(n, substeps, 1))
    assert tiled.step(x, u, forces=forces).x.tobytes() == single.step(x, u, forces=forces).x.tobytes()


def test_tiles_of_a_chain(tmp_path):
    four = {"a": "a.position", "da": "a.velocity", "b": "b.position", "db": "b.velocity"}
    options = {"states": four, "inputs": {"f": "b"}, "contact": False}
    tiled, single = build(tmp_path, CHAIN, **options), build(tmp_path, CHAIN, tiles=1, **options)
    assert tiled.tiling == "256 copies, bit-equal to one robot"
    x, u = query(300, 4, scale=3.0)
    given = {"damping.b": 0.1, "mass.lower": 2.0, "armature.a": 0.01}
    for parameters in (None, given, given | {"frictionloss.a": 0.1}):
        y = tiled.step(x, u, parameters=parameters).x
        assert y.tobytes() == single.step(x, u, parameters=parameters).x.tobytes()


def test_rollouts_and_full_states_give_the_same_bits(monkeypatch):
    from gapcert_mujoco.stepping import Rows

    x, u = query(300, scale=3.0)
    fast = pendulum(substeps=3, tiles=1)
    y = fast.step(x, u).x
    monkeypatch.setattr("gapcert_mujoco.world.Rollouts", lambda model, threads: Rows(model, threads, None))
    assert pendulum(substeps=3, tiles=1).step(x, u).x.tobytes() == y.tobytes()


def test_what_is_solved_together_is_not_tiled(tmp_path):
    assert rod(tmp_path, joint='range="-1 1" limited="true"').tiling.startswith("untiled: copies would solve")
    assert crate(tmp_path).tiling.startswith("untiled: copies would solve")
    assert crate(tmp_path, ground=None).tiling == "untiled: copies share a fixed base without a drive"


# Names, files and mistakes


def test_the_digest_is_the_physics(tmp_path):
    (tmp_path / "elsewhere.urdf").write_bytes(ROBOT.read_bytes())
    same = [pendulum(tiles=1), pendulum(threads=2), pendulum(robot=tmp_path / "elsewhere.urdf")]
    assert {b.digest() for b in same} == {pendulum().digest()}
    others = [{"substeps": 2}, {"period": "6 ms"}, {"joint_damping": 0.1}, {"integrator": "RK4"}, {"iterations": 5}]
    assert len({pendulum(**o).digest() for o in [{}, *others]}) == 1 + len(others)
    (tmp_path / "elsewhere.urdf").write_text(ROBOT.read_text().replace('mass value="1"', 'mass value="1.000001"'))
    assert pendulum(robot=tmp_path / "elsewhere.urdf").digest() != pendulum().digest()


def test_included_files_and_meshes_are_part_of_the_digest(tmp_path):
    part = '<body><joint name="a" axis="0 1 0"/><geom type="mesh" mesh="m"/></body>'
    part = f"<mujoco><worldbody>{part}</worldbody></mujoco>"
    text = '<mujoco><asset><mesh name="m" file="m.obj"/></asset><include file="part.xml"/></mujoco>'
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 {top}\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
    (tmp_path / "part.xml").write_text(part)
    (tmp_path / "m.obj").write_text(corners.format(top=1))
    digests = {build(tmp_path, text, states={"a": "a.position"}).digest()}
    (tmp_path / "m.obj").write_text(corners.format(top=2))
    digests.add(build(tmp_path, text, states={"a": "a.position"}).digest())
    (tmp_path / "part.xml").write_text(part.replace("0 1 0", "1 0 0"))
    digests.add(build(tmp_path, text, states={"a": "a.position"}).digest())
    assert len(digests) == 3


def test_a_joint_starts_where_the_file_puts_it(tmp_path):
    b = rod(tmp_path, joint='ref="0.25"', states={"omega": "hinge.velocity"})
    assert b.hidden_default == (0.25,)


def test_the_files_actuators_are_left_out(tmp_path):
    more = '<actuator><position joint="hinge" kp="100"/></actuator><keyframe><key ctrl="1"/></keyframe>'
    x, u = query(10)
    with pytest.raises(
        UsageError, match=r"drives joint 'hinge' by its actuator 'hinge'; give its command, hinge\.ctrl, or say"
    ):
        rod(tmp_path, more=more)
    system = rod(tmp_path, more=more, inputs={"torque": "hinge.effort"})
    assert np.abs(system.step(x, u).x - semi_implicit(x, u)).max() <= 1e-15


BALL = '<body><joint name="eye" type="ball"/><geom size="0.1"/></body>'
FILES = {
    "empty": ("", {}, "MuJoCo cannot load"),
    "broken": ("<mujoco><worldbody>", {}, "MuJoCo cannot load"),
    "refused by the engine": ("<mujoco><worldbdy/></mujoco>", {}, "MuJoCo cannot load .* unrecognized element"),
    "no joint": ("<mujoco><worldbody/></mujoco>", {}, "no movable joint"),
    "a ball by one number": (
        CHAIN.replace("</worldbody>", BALL + "</worldbody>"),
        {"states": {"a": "eye.position"}},
        r"found 'eye.position'; expected one of eye.wx, eye.wy, eye.wz",
    ),
    "fixed and free": (CRATE.format(at="0 0 0", geom="", more=""), {}, "free joint; set fixed_base: false"),
    "no base": (CHAIN, {"fixed_base": False}, "no base that could float"),
    "massless base": (ROBOT.read_text(), {"fixed_base": False}, "no base that could float"),
    "surface with a gain": (
        CRATE.format(at="0 0 0", geom='surfacevel="1 0 0 0 0 0"', more=""),
        {"fixed_base": False, "inputs": {"v": "drive"}, "drive": {"elements": {"hull": {"v": 1}}, "gain": 2}, "ground": 1.0},
        "gain and limit are a motor's",
    ),
    "element": (CHAIN, {"inputs": {"v": "drive"}, "drive": {"elements": {"c": {"v": 1}}}}, "no 'c' to drive"),
    "plastic": (CHAIN.replace('name="a"', 'name="a" stiffness="1" springyield="0.1"'), {}, "has a plastic spring"),
}


@pytest.mark.parametrize("case", FILES, ids=list(FILES))
def test_unusable_robots_are_refused(case, tmp_path, capfd):
    text, options, message = FILES[case]
    states = {"px": "base.x"} if options.get("fixed_base") is False else {"a": "a.position"}
    with pytest.raises(UsageError, match=message) as error:
        build(tmp_path, text, **({"states": states} | options))
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


def test_a_file_that_is_not_there_or_has_changed_is_told(tmp_path):
    with pytest.raises(UsageError, match=r"there is no file .*gone\.xml"):
        pendulum(robot=tmp_path / "gone.xml")
    b = build(tmp_path, CHAIN, states={"a": "a.position"}, contact=False, tiles=1)
    (tmp_path / "robot.xml").write_text(CHAIN.replace('mass="1"', 'mass="2"'))
    with pytest.raises(UsageError, match="has changed since it was read"):
        b.engine.open(4, TAU, None)


def test_a_model_gives_order_units_and_period():
    from gapcert_mujoco.engine import MuJoCoEngine

    class Frame(System):
        states = (StateSpec("omega", "rad/s"), StateSpec("theta", "rad", "angle"))
        inputs, period = (StateSpec("torque", "N*m"),), TAU

        def _step(self, x, u, **options):
            return x

    config = MuJoCoConfig(**{k: v for k, v in (PENDULUM | {"robot": ROBOT.name}).items() if k != "period"})
    b = MuJoCoEngine.from_config(config, Context(folder=ROBOT.parent, model=Frame()))
    x, u = query(10)
    assert (b.step(x, u).x == pendulum().step(x[:, ::-1], u).x[:, ::-1]).all()


def test_settings_are_options_that_change_something():
    config = MuJoCoConfig(**PENDULUM)
    settings = config.settings()
    assert {"substeps", "integrator", "joint_damping", "cone"} <= set(settings)
    for name, values in settings.items():
        assert values
        for value in values:
            assert getattr(MuJoCoConfig(**(PENDULUM | {name: value})), name) == value
    assert "Euler" not in MuJoCoConfig(**(PENDULUM | {"integrator": "Euler"})).settings()["integrator"]


def test_declaration_imports_no_engine():
    code = (
        "import sys, gapcert; r = gapcert.registry(); r.config('backend', 'mujoco'); "
        "sys.exit('mujoco' in sys.modules or 'pint' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    assert registry().get("backend", "mujoco").missing() is None
