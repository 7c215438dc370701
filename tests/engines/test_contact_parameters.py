"""Native parameters of contacts: what they do, in each engine that has them, and that stated values change nothing."""

from pathlib import Path

import numpy as np
import pytest

import gapcert as gc

pytestmark = pytest.mark.contract

MODELS = Path(__file__).parents[2] / "specs" / "models"
STATES = {n: f"base.{n}" for n in ("x", "z", "vx", "vz", "wz")}
NOTHING = np.empty((1, 0))


def cube(kind, robot=None, **options):
    pytest.importorskip({"dart": "dartpy"}.get(kind, kind))
    robot = robot or MODELS / ("cube.xml" if kind == "mujoco" else "cube.urdf")
    given = {"robot": robot, "fixed_base": False, "ground": 1.0, "states": STATES, "substeps": 40, "period": "40 ms", **options}
    return gc.registry().build("backend", kind, gc.registry().config("backend", kind)(**given))


def dropped(b, **parameters):
    """Speed after a flat impact at 1 m/s."""
    return float(b.step(np.array([[0, 0.06, 0, -1.0, 0]]), NOTHING, parameters=parameters or None).x[0, 3])


@pytest.mark.parametrize(
    ("kind", "other", "value"),
    [
        ("mujoco", "contact_damping", 0.3),
        ("pybullet", "restitution", 0.3),
        ("pybullet", "contact_time", 0.005),
        ("dart", "restitution", 0.3),
    ],
)
def test_stated_values_change_no_bit(kind, other, value):
    b = cube(kind)
    x = np.array([[0, 0.06, 1.0, -1.0, 3.0]])
    moved = b.step(x, NOTHING).x
    stated = {p.name: p.value for p in b.parameters}
    assert b.step(x, NOTHING, parameters={other: value}).x.tobytes() != moved.tobytes()
    assert b.step(x, NOTHING, parameters=stated).x.tobytes() == moved.tobytes()
    assert b.step(x, NOTHING).x.tobytes() == moved.tobytes()


@pytest.mark.parametrize("restitution", [0.2, 0.6])
def test_restitution_is_the_speed_that_is_left(restitution):
    b = cube("dart", gravity=(0.0, 0.0, 0.0))
    assert dropped(b) == pytest.approx(0, abs=0.05)
    assert dropped(b, restitution=restitution) == pytest.approx(restitution, abs=0.05)


def test_bullet_bounces_with_the_product_of_restitutions():
    """It takes the corners of a box one after another, which leaves less than the coefficient says."""
    b = cube("pybullet", gravity=(0.0, 0.0, 0.0), linear_damping=0.0)
    assert dropped(b) == pytest.approx(0, abs=0.05)
    low, high = (dropped(b, restitution=r) / r for r in (0.2, 0.6))
    assert 0.5 < min(low, high) <= max(low, high) < 1.0


def test_darts_parameter_is_its_option():
    assert dropped(cube("dart"), restitution=0.4) == dropped(cube("dart", restitution=0.4))


def test_a_weakly_damped_contact_bounces():
    """A spring of damping ratio ζ returns about exp(−π ζ/√(1 − ζ²)) of the speed."""
    b = cube("mujoco", gravity=(0.0, 0.0, 0.0), period="80 ms", substeps=800)
    assert dropped(b, contact_damping=2.0) < 0.15
    assert dropped(b, contact_damping=0.2, contact_time=0.01) > 0.4


def test_a_stiffer_contact_yields_less():
    b = cube("mujoco", period="400 ms", substeps=400)
    x = np.array([[0, 0.0524, 0, 0, 0]])
    depth = [0.0524 - b.step(x, NOTHING, parameters={"contact_time": t}).x[0, 1] for t in (0.02, 0.01)]
    assert 0 < depth[1] < 0.5 * depth[0]


def test_bullets_springs_yield_to_the_weight():
    """Springs of mass / time² under the corners, of which one to four share the weight."""
    b = cube("pybullet", period="400 ms", substeps=800)
    x, times = np.array([[0, 0.0524, 0, 0, 0]]), np.array([0.005, 0.01])
    depth = np.array([0.0524 - b.step(x, NOTHING, parameters={"contact_time": t}).x[0, 1] for t in times])
    shared = 9.81 * times**2 / depth
    assert ((shared > 0.9) & (shared < 4.1)).all()
    assert depth[1] > 2 * depth[0]


def test_mujoco_offers_no_spring_where_the_file_has_several(tmp_path):
    text = (MODELS / "cube.xml").read_text().replace('condim="3"', 'condim="3" solref="0.01 1"')
    (tmp_path / "cube.xml").write_text(text)
    names = {p.name for p in cube("mujoco", tmp_path / "cube.xml").parameters}
    assert "friction" in names
    assert not {"contact_time", "contact_damping", "spinning_friction"} & names


@pytest.mark.parametrize(("condim", "more"), [(4, {"spinning_friction"}), (6, {"spinning_friction", "rolling_friction"})])
def test_mujoco_offers_the_frictions_that_contacts_have(tmp_path, condim, more):
    (tmp_path / "cube.xml").write_text((MODELS / "cube.xml").read_text().replace('condim="3"', f'condim="{condim}"'))
    b = cube("mujoco", tmp_path / "cube.xml")
    assert {p.name for p in b.parameters} & {"spinning_friction", "rolling_friction"} == more
    x = np.array([[0, 0.0524, 0, 0, 5.0]])
    free, held = (b.step(x, NOTHING, parameters={"friction": 0.02, "spinning_friction": f}).x[0, 4] for f in (0.1, 50.0))
    assert abs(held) < abs(free)


def test_spinning_friction_brakes_in_bullet():
    b = cube("pybullet", friction=0.0, angular_damping=0.0)
    x = np.array([[0, 0.0524, 0, 0, 5.0]])
    free, held = (b.step(x, NOTHING, parameters={"spinning_friction": f}).x[0, 4] for f in (0.0, 0.05))
    assert held < free - 0.1
