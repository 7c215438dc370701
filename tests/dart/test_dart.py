"""Backend `dart`: the physics in closed form, purity, tiling, parameters, and its user's mistakes."""

import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rod import HINGE, TAU, RodContract, query, semi_implicit

from gapcert import Context, UsageError, registry
from gapcert.testing import SystemContract
from gapcert_dart.config import SOLVERS, DartConfig
from gapcert_engines import EngineBackend

pytestmark = [pytest.mark.contract, pytest.mark.needs("dartpy")]

ROOT = Path(__file__).parents[2]
MODELS = ROOT / "specs/models"
PENDULUM = HINGE | {"robot": MODELS / "pendulum.urdf"}
DATA = Path(__file__).parents[1] / "data"
FOUR = {"a": "shoulder.position", "b": "elbow.position", "da": "shoulder.velocity", "db": "elbow.velocity"}
BRICK = """<robot name="brick"><link name="brick"><inertial><origin xyz="0.1 -0.2 0.05"/><mass value="2"/>
  <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.2" iyz="0" izz="0.25"/></inertial></link></robot>"""
INERTIA, CENTRE = np.diag([0.1, 0.2, 0.25]), np.array([0.1, -0.2, 0.05])
SPIN = {f"{k}": f"base.{k}" for k in ("x", "y", "z", "vx", "vy", "vz", "wx", "wy", "wz")}


def pendulum(**options):
    from gapcert_dart.engine import DartEngine

    return EngineBackend(DartEngine(DartConfig(**(PENDULUM | options))))


def build(tmp_path, text, **options):
    from gapcert_dart.engine import DartEngine

    path = tmp_path / ("robot.sdf" if "<sdf" in text else "robot.urdf")
    path.write_text(text)
    return EngineBackend(DartEngine(DartConfig(**({"robot": path, "period": "5 ms"} | options))))


def acrobot(**options):
    from gapcert_dart.engine import DartEngine

    two = {"robot": DATA / "acrobot.urdf", "states": FOUR, "inputs": {"torque": "elbow"}, "period": "5 ms"}
    return EngineBackend(DartEngine(DartConfig(**(two | options))))


class TestPendulum(RodContract):
    pendulum = staticmethod(pendulum)


class TestAcrobotWithHiddenElbowAndLimits(SystemContract):
    def system(self):
        two = {"a": "shoulder.position", "da": "shoulder.velocity"}
        return acrobot(states=two, inputs={"torque": "shoulder"}, joint_limits=True)


class TestFloatingBrick(SystemContract):
    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path):
        self.folder = tmp_path

    def system(self):
        states = {name: target for name, target in SPIN.items() if name not in ("x", "wz")}
        return build(self.folder, BRICK, states=states, fixed_base=False, substeps=2)


# The physics


@pytest.mark.parametrize(
    ("options", "parameters", "law"),
    [
        ({"gravity": (1.0, 5.0, -2.0)}, {"gravity_x": 1.0, "gravity_y": 5.0, "gravity_z": -2.0}, {"gravity": (1.0, -2.0)}),
        ({"joint_damping": 0.4}, {"damping.hinge": 0.4}, {"damping": 0.4}),
        ({}, {"mass.rod": 2.5}, {"mass": 2.5}),
    ],
)
def test_options_and_parameters_follow_their_laws(options, parameters, law):
    x, u = query(150)
    expected = semi_implicit(x, u, **law)
    b = pendulum()
    before = b.step(x, u).x
    by_parameter = b.step(x, u, parameters=parameters).x
    assert np.abs(by_parameter - expected).max() <= 4e-15
    if options:
        assert by_parameter.tobytes() == pendulum(**options).step(x, u).x.tobytes()
    assert before.tobytes() != by_parameter.tobytes()
    assert before.tobytes() == b.step(x, u).x.tobytes(), "parameters must not outlive their call"


def test_dry_friction_slows_and_holds():
    """Coulomb's law as an inequality: F against the motion, or as much as it takes to stand still."""
    x, u = query(60)
    x[:, 1] += 0.2 * np.sign(x[:, 1])
    y = pendulum(coulomb_friction=0.05)
    assert y.tiling == "untiled: joints have dry friction, whose constraints copies would solve together"
    moving = y.step(x, u).x
    assert np.abs(moving - semi_implicit(x, u - 0.05 * np.sign(x[:, 1:]))).max() <= 1e-9
    assert pendulum().step(x, u, parameters={"coulomb_friction.hinge": 0.05}).x.tobytes() == moving.tobytes()
    still = np.abs(y.step(np.zeros((1, 2)), np.full((1, 1), 0.04)).x[0, 1])
    assert still < 1e-10
    assert np.abs(y.step(np.zeros((1, 2)), np.full((1, 1), 0.06)).x[0, 1] - TAU * 3 * 0.01) < 1e-9


def test_limits_are_off_for_a_urdf_until_asked_for():
    x, u = np.array([[0.0, 0.45, 0.0, 30.0]]), np.zeros((1, 1))
    free, limited = acrobot(), acrobot(joint_limits=True)
    assert free.step(x, u).x[0, 1] > 0.55
    assert free.tiling.startswith("128 copies")
    assert limited.tiling == "untiled: joint 'elbow' has limits, whose constraints copies would solve together"
    after = limited.rollout(x, np.zeros((1, 20, 1))).x[0, :, 1]
    assert after[-5:].max() < 0.51


def test_file_states_damping_and_its_effort_limit_is_no_law():
    """An effort beyond the file's `effort` acts in full, as in the other engines."""
    stated = {p.name: p.value for p in acrobot().parameters}
    assert (stated["damping.elbow"], stated["damping.shoulder"]) == (0.3, 0.0)
    b, x = acrobot(gravity=(0.0, 0.0, 0.0)), np.zeros((1, 4))
    small, large = (b.step(x, np.full((1, 1), f)).x[0, 3] for f in (0.05, 5.0))
    assert large / small == pytest.approx(100, rel=1e-9)


def test_pickling_drops_the_engine(tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_bytes((DATA / "acrobot.urdf").read_bytes())
    b = acrobot(robot=path)
    x, u = query(30, 4)
    y = b.step(x, u).x
    again = pickle.loads(pickle.dumps(b))
    path.unlink()
    assert (again.step(x, u).x == y).all(), "the file was read once"
    b.close()
    assert (b.step(x, u).x == y).all()


@pytest.mark.parametrize("solver", SOLVERS)
def test_limits_and_dry_friction_do_not_carry_over(solver):
    """Both are constraints with a solver behind them."""
    b = acrobot(joint_limits=True, coulomb_friction=0.1, lcp_solver=solver, substeps=3)
    x, u = query(60, 4)
    order = np.random.default_rng(1).permutation(len(x))
    y = b.step(x, u).x
    assert y[order].tobytes() == b.step(x[order], u[order]).x.tobytes()
    assert np.abs(y - acrobot(substeps=3).step(x, u).x).max() > 1e-3


# A base that floats


def tumble(tmp_path, substeps):
    """The brick for 0.2 s without weight: (momentum, angular momentum) / (their start) of its centre of mass."""
    b = build(tmp_path, BRICK, states=SPIN, fixed_base=False, gravity=(0, 0, 0), period="200 ms", substeps=substeps)
    x, q = np.array([[1.0, 2.0, 3.0, 0.3, -0.2, 0.5, 2.0, -3.0, 1.5]]), np.array([[0.8, 0.36, -0.48, 0.0]])

    def momenta(x, q):
        r = rotation(q[0])
        rate = x[0, 6:]
        return x[0, 3:6] + np.cross(rate, r @ CENTRE), r @ INERTIA @ r.T @ rate

    after = b.step(x, np.zeros((1, 0)), hidden=q)
    assert after.hidden is not None
    return momenta(x, q), momenta(after.x, after.hidden), x[0, :3] + rotation(q[0]) @ CENTRE, after


def rotation(q):
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_tumbling_body_keeps_its_momenta(tmp_path):
    """World-frame velocities at the frame's origin: constant velocity of the centre of mass, constant angular momentum."""
    errors = []
    for substeps in (50, 100):
        (p0, l0), (p1, l1), start, after = tumble(tmp_path, substeps)
        centre = after.x[0, :3] + rotation(after.hidden[0]) @ CENTRE
        errors.append([np.abs(p1 - p0).max(), np.abs(l1 - l0).max(), np.abs(centre - start - 0.2 * p0).max()])
    coarse, fine = np.array(errors)
    assert (coarse < [0.02, 0.02, 0.004]).all()
    # First order: half the step, half the error.
    assert coarse / fine == pytest.approx([2, 2, 2], rel=0.1)


def test_free_fall(tmp_path):
    b = build(tmp_path, BRICK, states=SPIN, fixed_base=False)
    x = np.array([[0.0, 0.0, 5.0, 1.0, -2.0, 0.5, 0.0, 0.0, 0.0]])
    y = b.step(x, np.zeros((1, 0)), hidden=np.array([[0.6, 0.0, 0.0, 0.8]])).x[0]
    v = np.array([1.0, -2.0, 0.5 - 9.81 * TAU])
    assert y[3:6] == pytest.approx(v, abs=1e-14)
    assert y[:3] == pytest.approx(np.array([0.0, 0.0, 5.0]) + TAU * v, abs=1e-14)


def test_default_pose_and_euler_angles(tmp_path):
    b = build(
        tmp_path, BRICK, states={"yaw": "base.yaw", "wz": "base.wz"}, fixed_base=False, rotation="euler", gravity=(0, 0, 0)
    )
    y = b.step(np.array([[1.0, 2.0]]), np.zeros((1, 0))).x[0]
    assert y[0] == pytest.approx(1.0 + 2.0 * TAU, abs=1e-3)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, np.pi - 1e-9, np.pi])
def test_rotation_vectors_there_and_back(angle):
    from gapcert_dart.world import from_vector, to_vector

    axis = np.array([[0.48, -0.6, 0.64]])
    q = np.concatenate([[[np.cos(angle / 2)]], np.sin(angle / 2) * axis], axis=1)
    assert to_vector(3 * q) == pytest.approx(angle * axis, abs=1e-15)
    assert to_vector(-q) == pytest.approx(angle * axis, abs=4e-15) or angle == pytest.approx(np.pi)
    assert from_vector(to_vector(q)) == pytest.approx(q, abs=1e-15)


# Tiling


@pytest.mark.parametrize("n", [1, 3, 128, 133, 150])
@pytest.mark.parametrize("substeps", [1, 2])
def test_tiles_give_the_bits_of_one_robot(n, substeps):
    tiled, single = pendulum(substeps=substeps), pendulum(tiles=1, substeps=substeps)
    assert tiled.tiling == "128 copies, bit-equal to one robot"
    assert single.tiling == "untiled: one copy was asked for"
    x, u = query(n, scale=3.0)
    assert tiled.step(x, u).x.tobytes() == single.step(x, u).x.tobytes()
    forces = np.random.default_rng(2).normal(size=(n, substeps, 1))
    assert tiled.step(x, u, forces=forces).x.tobytes() == single.step(x, u, forces=forces).x.tobytes()
    mass = {"mass.rod": 1.0 + np.arange(n) % 2, "coulomb_friction.hinge": 0.1 * (np.arange(n) % 3)}
    assert tiled.step(x, u, parameters=mass).x.tobytes() == single.step(x, u, parameters=mass).x.tobytes()


def test_tiles_of_a_chain():
    tiled, single = acrobot(tiles=40), acrobot(tiles=1)
    assert tiled.tiling == "40 copies, bit-equal to one robot"
    x, u = query(90, 4, scale=3.0)
    assert tiled.step(x, u).x.tobytes() == single.step(x, u).x.tobytes()


def test_copies_that_differ_are_not_used(monkeypatch):
    from gapcert_dart import world as dart_world

    whole = dart_world._tiled

    def heavier(single, copies):
        tiled = whole(single, copies)
        tiled.getBodyNode(copies - 1).setMass(1.0000001)
        return tiled

    monkeypatch.setattr(dart_world, "_tiled", heavier)
    b = pendulum()
    assert b.tiling == "untiled: 128 copies differed from one robot"
    x, u = query(40)
    assert np.abs(b.step(x, u).x - semi_implicit(x, u)).max() <= 1e-15


def test_digest_names_the_physics_alone(tmp_path):
    assert pendulum(tiles=1).digest() == pendulum().digest()
    (tmp_path / "elsewhere.urdf").write_bytes(PENDULUM["robot"].read_bytes())
    assert pendulum(robot=tmp_path / "elsewhere.urdf").digest() == pendulum().digest()
    others = [{"substeps": 2}, {"period": "6 ms"}, {"gravity": (0, 0, -9.8)}, {"joint_damping": 0.1}, {"lcp_solver": "pgs"}]
    assert len({pendulum(**o).digest() for o in [{}, *others]}) == 1 + len(others)
    heavier = PENDULUM["robot"].read_text().replace('mass value="1"', 'mass value="1.5"')
    (tmp_path / "elsewhere.urdf").write_text(heavier)
    assert pendulum(robot=tmp_path / "elsewhere.urdf").digest() != pendulum().digest()


def test_motion_that_runs_away_is_refused():
    """DART itself would warn, take the acceleration to be zero, and answer with finite numbers."""
    with pytest.raises(UsageError, match=r"has run away one period after positions \[0.5\]"):
        pendulum().step(np.array([[0.0, 1.0], [0.5, 1e200]]), np.zeros((2, 1)))


def test_settings_are_candidates():
    config = DartConfig(**PENDULUM)
    assert "collision_detector" not in config.settings()
    for name, values in DartConfig(**PENDULUM, ground=0.5).settings().items():
        assert values
        for value in values:
            assert DartConfig(**(PENDULUM | {"ground": 0.5, name: value})) != DartConfig(**PENDULUM, ground=0.5)


def test_plugin_builds_it_and_prints_nothing():
    options = PENDULUM | {"robot": str(PENDULUM["robot"])}
    built = registry().build("backend", "dart", DartConfig(**options), Context())
    assert isinstance(built, EngineBackend)
    code = (
        "import sys, gapcert; r = gapcert.registry(); r.config('backend', 'dart'); assert 'dartpy' not in sys.modules;"
        "from gapcert_dart.config import SOLVERS, DartConfig;"
        f"r.build('backend', 'dart', DartConfig(**{options!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert (done.stdout, done.stderr) == (b"", b"")
