"""Backend `dart` on the ground and under a drive: purity with contacts, laws of friction, and DART's traps planted by hand."""

from pathlib import Path

import numpy as np
import pytest

from gapcert import UsageError
from gapcert.testing import SystemContract
from gapcert_dart.config import DETECTORS, SOLVERS, DartConfig
from gapcert_engines import EngineBackend

pytestmark = [pytest.mark.needs("dartpy"), pytest.mark.contract]


PENDULUM = Path(__file__).parents[2] / "specs/models/pendulum.urdf"
HINGE = {"states": {"theta": "hinge.position", "omega": "hinge.velocity"}, "period": "10 ms", "substeps": 10}
LINK = """<link name="{name}"><inertial><mass value="{mass}"/><inertia ixx="{i}" ixy="0" ixz="0" iyy="{i}" iyz="0" izz="{i}"/>
  </inertial><collision><origin xyz="{at}"/><geometry>{shape}</geometry></collision></link>"""
JOINT = """<joint name="{name}" type="{type}"><parent link="base"/><child link="{child}"/><origin xyz="{at}"/>
  <axis xyz="{axis}"/></joint>"""
PLANAR = {"x": "base.x", "vx": "base.vx", "z": "base.z", "vz": "base.vz"}


def link(name, shape, mass=1.0, i=0.01, at="0 0 0"):
    return LINK.format(name=name, shape=shape, mass=mass, i=i, at=at)


def joint(name, child, at, axis="0 1 0", kind="continuous"):
    return JOINT.format(name=name, child=child, at=at, axis=axis, type=kind)


def robot(*parts):
    return '<robot name="r">' + "".join(parts) + "</robot>"


SPHERE, BOX = '<sphere radius="0.1"/>', '<box size="0.4 0.4 0.2"/>'
CRATE = robot(link("base", BOX, i=10.0))
CRAB = robot(
    link("base", '<box size="0.5 0.3 0.1"/>', mass=2, i=0.03),
    *(link(f"leg{k}", '<sphere radius="0.03"/>', mass=0.1, i=0.001, at="0 0 -0.11") for k in range(8)),
    *(
        joint(f"hip{k}", f"leg{k}", f"{0.3 * np.cos(k):.3f} {0.2 * np.sin(k):.3f} 0", f"{np.sin(k):.3f} {-np.cos(k):.3f} 0")
        for k in range(8)
    ),
)
CART = robot(
    link("base", '<box size="0.2 0.1 0.05"/>', mass=4, i=0.05),
    *(link(name, SPHERE, mass=0.3, i=0.0012) for name in ("left", "right", "caster")),
    joint("left_axle", "left", "0 0.2 0"),
    joint("right_axle", "right", "0 -0.2 0"),
    joint("swivel", "caster", "-0.3 0 0"),
)


def build(tmp_path, text, **options):
    from gapcert_dart.engine import DartEngine

    path = tmp_path / "robot.urdf"
    path.write_text(text)
    base = {"robot": path, "states": PLANAR, "period": "5 ms", "substeps": 5, "fixed_base": False, "ground": 0.5}
    return EngineBackend(DartEngine(DartConfig(**(base | options))))


def crab(tmp_path, **options):
    return build(tmp_path, CRAB, **({"ground": 0.8} | options))


def poses(b, n, seed=0, low=0.09, high=0.13):
    """Random states close to the ground: (x, u, hidden)."""
    rng = np.random.default_rng(seed)
    hidden = np.tile(b.hidden_default, (n, 1)) + rng.uniform(-0.3, 0.3, (n, len(b.hidden_default)))
    z, v = rng.uniform(low, high, n), rng.uniform(-0.3, 0.3, (n, 3))
    return np.stack([v[:, 0], v[:, 1], z, v[:, 2]], axis=1), np.zeros((n, b.nu)), hidden


class TestCrabOnTheGround(SystemContract):
    rows = 9

    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path):
        self.folder = tmp_path

    def system(self):
        return crab(self.folder, self_collision=True, coulomb_friction=0.01, substeps=3)

    def points(self, system):
        return poses(system, self.rows)[:2]


class TestDrivenCart(SystemContract):
    rows = 9

    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path):
        self.folder = tmp_path

    def system(self):
        return cart(self.folder, gain=0.2, limit=1.0)

    def points(self, system):
        x, u, _ = poses(system, self.rows, low=0.098, high=0.1)
        return x, u + np.linspace(-1, 1, self.rows)[:, None]


def cart(tmp_path, gain=None, limit=None, every=2, **options):
    wheels = {
        "left_axle": {"forward": 10, "yaw": 4, "yaw_rate": 0.5},
        "right_axle": {"forward": 10, "yaw": -4, "yaw_rate": -0.5},
    }
    drive = {"elements": wheels, "gain": gain, "limit": limit, "every": every}
    base = {"inputs": {"forward": "drive"}, "drive": drive, "ground": 1.0, "substeps": 4, "rotation": "euler"}
    return build(tmp_path, CART, **(base | options))


# Purity


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("detector", DETECTORS)
def test_contacts_do_not_carry_over(tmp_path, detector, solver):
    b = crab(tmp_path, collision_detector=detector, lcp_solver=solver)
    assert b.tiling == "untiled: copies share a fixed base"
    x, u, hidden = poses(b, 8)
    order = np.random.default_rng(1).permutation(len(x))
    first, permuted = b.step(x, u, hidden=hidden), b.step(x[order], u, hidden=hidden[order])
    assert first.x[order].tobytes() == permuted.x.tobytes()
    assert first.hidden[order].tobytes() == permuted.hidden.tobytes()
    lifted = np.where(np.arange(4) == 2, 5.0, x)
    assert np.abs(first.x - b.step(lifted, u, hidden=hidden).x)[:, 3].max() > 1e-2, "no contact was tested"


def bare(tmp_path, detector, *, asleep=False, text=CRAB):
    """What a user would write: the robot on a box, with DART's own options."""
    import dartpy

    path = tmp_path / "bare.urdf"
    path.write_text(text)
    robot = dartpy.utils.DartLoader().parseSkeleton(str(path))
    ground = dartpy.dynamics.Skeleton("ground")
    _, body = ground.createWeldJointAndBodyNodePair()
    node = body.createShapeNode(dartpy.dynamics.BoxShape([100, 100, 1]))
    node.createCollisionAspect()
    node.createDynamicsAspect()
    node.setRelativeTranslation([0, 0, -0.5])
    world = dartpy.simulation.World()
    # Not by name: once Gazebo's DART is in the process too, DART's factory of detectors is shared, and it fails.
    makers = {"FCL": dartpy.collision.FCLCollisionDetector, "BULLET": dartpy.collision.BulletCollisionDetector}
    world.getConstraintSolver().setCollisionDetector(makers[detector]())
    options = world.getDeactivationOptions()
    options.mEnabled = asleep
    world.setDeactivationOptions(options)
    world.addSkeleton(ground)
    world.addSkeleton(robot)
    return world, robot


def ask(world, robot, state, steps):
    robot.setPositions(state[: robot.getNumDofs()])
    robot.setVelocities(state[robot.getNumDofs() :])
    for _ in range(steps):
        world.step()
    return np.concatenate([robot.getPositions(), robot.getVelocities()])


@pytest.mark.parametrize(("detector", "text", "leak"), [("FCL", CRAB, 0.0), ("BULLET", CRATE, 1e-3)])
def test_trap_detectors_remember_earlier_queries(tmp_path, detector, text, leak):
    """The order of contacts in FCL's tree, Bullet's manifolds: with all positions and velocities set, other queries show."""
    rng = np.random.default_rng(5)
    world, robot = bare(tmp_path, detector, text=text)
    n = robot.getNumDofs()
    states = np.concatenate([rng.uniform(-0.3, 0.3, (60, n)), rng.uniform(-1, 1, (60, n))], axis=1)
    states[:, 5] = rng.uniform(0.03, 0.2, 60)
    first = np.array([ask(world, robot, s, 20) for s in states])
    order = rng.permutation(60)
    permuted = np.array([ask(world, robot, s, 20) for s in states[order]])
    assert np.abs(first[order] - permuted).max() > leak


def test_trap_sleep_is_a_state_that_no_number_shows(tmp_path):
    """A crate that rested for a second is frozen where one in the same place at the same velocity still settles, by 2e-6."""
    found = {}
    for asleep in (True, False):
        world, robot = bare(tmp_path, "FCL", asleep=asleep, text=CRATE)
        rested = ask(world, robot, np.array([0, 0, 0, 0, 0, 0.0999, *np.zeros(6)]), 1000)
        for _ in range(100):
            world.step()
        after = np.concatenate([robot.getPositions(), robot.getVelocities()])
        world, robot = bare(tmp_path, "FCL", asleep=asleep, text=CRATE)
        found[asleep] = np.abs(after - ask(world, robot, rested, 100)).max()
    assert found[False] == 0
    assert 1e-7 < found[True] < 1e-5


def test_nothing_falls_asleep(tmp_path):
    """After a second at rest a tiny force moves the crate as it does at once, bit for bit."""
    b = build(
        tmp_path, CRATE.replace("</robot>", link("mast", SPHERE, mass=1e-3) + joint("pivot", "mast", "0 0 1") + "</robot>")
    )
    worlds = [b.engine.open(1, b.period, None) for _ in range(2)]
    assert not worlds[0].world.getDeactivationOptions().mEnabled
    base = np.array([[0, 0, 0.1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0]], dtype=float)
    joints, push = np.zeros((1, 1, 2)), np.full((1, 1, 1), 1e-9)
    for world in worlds:
        world.set({p.name: p.value for p in b.parameters})
    for _ in range(200):
        worlds[0].advance(joints, 0 * push, base)
    rested, fresh = (world.advance(joints, push, base) for world in worlds)
    assert rested[0].tobytes() == fresh[0].tobytes()
    assert rested[1].tobytes() == fresh[1].tobytes()
    assert fresh[0][0, 0, 1] > 0


def test_trap_a_urdf_floats_by_default():
    import dartpy

    from gapcert_dart.engine import DartEngine

    loader = dartpy.utils.DartLoader()
    text = PENDULUM.read_text().replace('"world"', '"stand"')
    loose = loader.parseSkeletonString(text, "")
    assert loose.getNumDofs() == 7
    assert EngineBackend(DartEngine(DartConfig(robot=PENDULUM, **HINGE))).hidden == ()


# Laws of contact


@pytest.mark.parametrize(
    ("options", "mu"), [({"ground": 0.3}, 0.3), ({"ground": 0.9, "friction": 0.2}, 0.2), ({"ground": 3.0}, 1.0)]
)
def test_sliding_friction(tmp_path, options, mu):
    """Deceleration μ g, with the smaller of the two coefficients; a shape's own is 1."""
    b = build(tmp_path, CRATE, **options, period="100 ms", substeps=100)
    x = np.array([[0.0, 3.0, 0.1, 0.0]])
    assert b.step(x, np.zeros((1, 0))).x[0, 1] == pytest.approx(3 - mu * 9.81 * 0.1, abs=2e-3)
    named = {"friction": options.get("friction", 1.0), "ground": options["ground"]}
    other = build(tmp_path, CRATE, ground=0.0, period="100 ms", substeps=100)
    assert other.step(x, np.zeros((1, 0)), parameters=named).x.tobytes() == b.step(x, np.zeros((1, 0))).x.tobytes()
    assert other.step(x, np.zeros((1, 0))).x[0, 1] == pytest.approx(3.0, abs=1e-9)


def test_a_coarse_cone_slides_as_far(tmp_path):
    """What a search may try with: another digest, as bits differ, and nearly the same motion; dantzig has nothing to spare."""
    fine = build(tmp_path, CRATE, ground=0.3, lcp_solver="nsgs", period="100 ms", substeps=100)
    options = fine.config.coarse()
    coarse = build(tmp_path, CRATE, ground=0.3, lcp_solver="nsgs", period="100 ms", substeps=100, **options)
    x = np.array([[0.0, 3.0, 0.1, 0.0]])
    assert coarse.digest() != fine.digest()
    assert not coarse.config.coarse()
    np.testing.assert_allclose(coarse.step(x, np.zeros((1, 0))).x, fine.step(x, np.zeros((1, 0))).x, atol=2e-3)
    assert not build(tmp_path, CRATE, ground=0.3).config.coarse()


@pytest.mark.parametrize("restitution", [0.0, 0.5, 0.8])
def test_restitution(tmp_path, restitution):
    b = build(tmp_path, robot(link("base", SPHERE)), restitution=restitution, gravity=(0, 0, 0), substeps=5)
    y = b.step(np.array([[0.0, 0.0, 0.0995, -2.0]]), np.zeros((1, 0))).x[0, 3]
    assert y == pytest.approx(2 * restitution, abs=0.06)


@pytest.mark.parametrize("mesh", [False, True])
def test_crate_rests_on_the_ground(tmp_path, mesh):
    """Shapes given by a mesh take part too; the digest follows the mesh, not its folder."""
    corners = "".join(f"v {x} {y} {z}\n" for x in (-0.2, 0.2) for y in (-0.2, 0.2) for z in (-0.1, 0.1))
    faces = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"]
    (tmp_path / "crate.obj").write_text(corners + "".join(f"f {face}\n" for face in faces))
    text = CRATE.replace(BOX, '<mesh filename="crate.obj"/>') if mesh else CRATE
    b = build(tmp_path, text, period="10 ms", substeps=10)
    y = b.rollout(np.array([[0.0, 0.0, 0.1, 0.0]]), np.zeros((1, 40, 0))).x[0, -1]
    assert y[2] == pytest.approx(0.1, abs=1e-4)
    if mesh:
        before = b.digest()
        (tmp_path / "crate.obj").write_text(corners + "".join(f"f {face}\n" for face in faces[:5]))
        b.close()
        with pytest.raises(UsageError, match=r"crate\.obj has changed since it was read"):
            b.step(np.array([[0.0, 0.0, 0.1, 0.0]]), np.zeros((1, 0)))
        assert build(tmp_path, text, period="10 ms", substeps=10).digest() != before


# The drive


def spun(gain=None, limit=None, **options):
    from gapcert_dart.engine import DartEngine

    drive = {"elements": {"hinge": {"rate": 1.0}}, "gain": gain, "limit": limit}
    config = {"robot": PENDULUM, **HINGE, "inputs": {"rate": "drive"}, "drive": drive, "gravity": (0, 0, 0), **options}
    return EngineBackend(DartEngine(DartConfig(**config)))


@pytest.mark.parametrize("limit", [None, 0.5])
def test_gain_is_an_effort_per_substep(limit):
    y = spun(gain=2.0, limit=limit).step(np.zeros((1, 2)), np.ones((1, 1))).x[0]
    omega = theta = 0.0
    for _ in range(10):
        omega += 1e-3 * 3 * min(2.0 * (1.0 - omega), limit or np.inf)
        theta += 1e-3 * omega
    assert y == pytest.approx([theta, omega], abs=1e-14)


def test_own_motor_keeps_the_limit():
    x, u = np.zeros((1, 2)), np.ones((1, 1))
    assert spun().step(x, u).x[0, 1] == pytest.approx(1.0, abs=1e-15)
    assert spun(limit=1e4).step(x, u).x[0, 1] == pytest.approx(1.0, abs=1e-6)
    assert spun(limit=0.5).step(x, u).x[0, 1] == pytest.approx(3 * 0.5 * 0.01, rel=1e-4)
    with pytest.raises(UsageError, match="'hinge' follows DART's own motor, which takes no force"):
        spun(limit=0.5).step(x, u, forces=np.ones((1, 10, 1)))
    pushed = spun(gain=2.0).step(x, 0 * u, forces=np.ones((1, 10, 1))).x[0, 1]
    assert 0 < pushed < 3 * 0.01


@pytest.mark.parametrize("law", [{"gain": 0.2, "limit": 1.0}, {"limit": 1.0}, {}])
def test_heading_is_fed_back(tmp_path, law):
    """The cart that looks away turns back; renewed less often, the heading differs a little."""
    states = {"yaw": "base.yaw", "wz": "base.wz"}
    ends = []
    for every in (1, 50):
        b = cart(tmp_path, **law, every=every, states=states, period="500 ms", substeps=500)
        hidden = np.array([b.hidden_default])
        hidden[0, [s.name for s in b.hidden].index("base.z")] = 0.1
        ends.append(b.step(np.array([[0.5, 0.0]]), np.zeros((1, 1)), hidden=hidden).x[0])
    assert abs(ends[0][0]) < 0.42
    assert ends[0] == pytest.approx(ends[1], abs=0.1)
    assert (ends[0] != ends[1]).any()
