"""The robots of the engines as they are drawn: links where closed forms have them, and shapes as the files state them."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import gapcert as gc

pytestmark = pytest.mark.contract

ARM = Path(__file__).parents[1] / "data" / "arm.urdf"
MODELS = Path(__file__).parents[2] / "specs" / "models"
NEEDS = {"pybullet": "pybullet", "mujoco": "mujoco", "dart": "dartpy"}
ENGINES = [
    pytest.param(kind, marks=pytest.mark.skipif(importlib.util.find_spec(module) is None, reason=f"{module} is not installed"))
    for kind, module in NEEDS.items()
]
SHAPES = """<robot name="shapes"><material name="brass"><color rgba="0.7 0.6 0.2 1"/></material>
<link name="world"/><link name="body">
<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><origin xyz="0 0 1" rpy="0 0 1.5707963267948966"/><geometry><box size="2 1 0.5"/></geometry>
<material name="brass"/></visual>
<visual><geometry><mesh filename="tetra.{suffix}" scale="2 2 2"/></geometry></visual>
{absent}
<collision><geometry><sphere radius="3"/></geometry></collision></link>
<link name="wheel"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><cylinder radius="0.3" length="0.1"/></geometry></collision></link>
<joint name="q" type="continuous"><parent link="world"/><child link="body"/><axis xyz="0 0 1"/></joint>
<joint name="r" type="continuous"><parent link="body"/><child link="wheel"/><origin xyz="1 0 0"/><axis xyz="0 0 1"/></joint>
</robot>"""
ABSENT = '<visual><geometry><mesh filename="absent.stl"/></geometry></visual>'
"""Bullet refuses it."""
TETRA = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def backend(kind, robot, states, inputs=None, **options):
    config = {"kind": kind, "robot": str(robot), "period": "5 ms", "states": states, "inputs": inputs or {}} | options
    return gc.load_spec({"version": 1, "name": "n", "backend": config}).build("backend")


def links(scene, *names):
    return [scene.poses[:, scene.links.index(n)] for n in names]


@pytest.mark.parametrize("kind", ENGINES)
def test_an_arm_is_where_its_closed_form_has_it(kind):
    """Two rods on hinges about y: the elbow at 0.6 m (−sin a, 0, −cos a), the forearm turned by a + b; b is no state."""
    b = backend(kind, ARM, {"a": "shoulder.position", "a_dot": "shoulder.velocity"}, {"u": "shoulder"})
    angles = np.linspace(-3, 3, 7)
    scene = b.scene(np.column_stack([angles, 5.0 + angles]))
    upper, lower = links(scene, "upper", "lower")
    zero = np.zeros(7)
    assert np.allclose(upper[:, :3], 0, atol=1e-6), "Bullet tells places in single precision"
    # q and −q are one rotation.
    turn = np.column_stack([np.cos(angles / 2), zero, np.sin(angles / 2), zero])
    assert np.allclose(np.abs((upper[:, 3:] * turn).sum(axis=1)), 1)
    place = np.column_stack([-0.6 * np.sin(angles), zero, -0.6 * np.cos(angles)])
    assert np.allclose(lower[:, :3], place, atol=1e-6)
    bent = b.scene(np.zeros((1, 2)), np.array([[0.4, 0.0]]))
    assert np.allclose(links(bent, "lower")[0][0, 3:], [np.cos(0.2), 0, np.sin(0.2), 0], atol=1e-6)
    # No shape in the file: each rod is the box of its inertia, thin about its own axis, in its centre of mass.
    boxes = [s for s in scene.shapes if s.kind == "box"]
    assert len(scene.shapes) == len(boxes) == 2
    assert np.allclose(sorted(s.place[2] for s in boxes), [-0.3, -0.2])
    half = 0.5 * np.sqrt(6 * (0.04 + 0.04 - 0.001) / 1.3)
    assert np.isclose(max(s.size.max() for s in boxes), max(half, 0.5 * np.sqrt(6 * (0.02 + 0.02 - 0.001) / 0.6)))


@pytest.mark.parametrize("kind", ENGINES)
def test_a_base_that_floats_is_where_its_state_has_it(kind):
    robot = MODELS / ("cube.xml" if kind == "mujoco" else "cube.urdf")
    states = {n: f"base.{n}" for n in ("x", "y", "z")}
    b = backend(kind, robot, states, fixed_base=False, ground=0.5)
    turn = np.array([0.5, 0.5, -0.5, 0.5])
    hidden = np.array([np.zeros(sum(s.size for s in b.hidden))])
    at = np.cumsum([0, *(s.size for s in b.hidden)])
    k = next(i for i, s in enumerate(b.hidden) if s.kind == "quaternion")
    hidden[0, at[k] : at[k] + 4] = turn
    scene = b.scene(np.array([[0.3, -0.2, 0.7]]), hidden)
    pose = links(scene, "cube")[0][0]
    assert np.allclose(pose[:3], [0.3, -0.2, 0.7], atol=1e-6)
    assert np.isclose(abs(pose[3:] @ turn), 1)
    assert sorted(s.kind for s in scene.shapes) == ["box", "plane"]
    assert np.allclose(next(s.size for s in scene.shapes if s.kind == "box"), 0.0524)


@pytest.mark.parametrize("kind", ENGINES)
def test_what_places_nothing_need_not_be_known(kind):
    b = backend(kind, ARM, {"a": "shoulder.position", "v": "shoulder.velocity"}, {"u": "shoulder"})
    assert b.scene(np.array([[0.1, np.nan]])) is not None
    assert b.scene(np.array([[np.nan, 0.1]])) is None
    assert b.scene(np.zeros((0, 2))) is None


@pytest.mark.outside("gazebo")
def test_a_pendulum_in_gazebo_is_where_its_closed_form_has_it():
    b = backend("gazebo", MODELS / "pendulum.sdf", {"a": "hinge.position", "v": "hinge.velocity"}, {"u": "hinge"})
    angles = np.linspace(-3, 3, 7)
    scene = b.scene(np.column_stack([angles, 9 * angles]))
    assert scene.links == ("rod",)
    turn = np.column_stack([np.cos(angles / 2), 0 * angles, np.sin(angles / 2), 0 * angles])
    assert np.allclose(np.abs((scene.poses[:, 0, 3:] * turn).sum(axis=1)), 1)
    (rod,) = scene.shapes
    assert rod.kind == "box"
    assert np.isclose(rod.size.max(), 0.5, atol=1e-3)
    # The state that was looked at leaves nothing behind.
    x, u = np.array([[0.3, 0.1]]), np.array([[0.2]])
    after = b.step(x, u).x
    b.scene(x + 1)
    assert np.array_equal(b.step(x, u).x, after)


@pytest.mark.parametrize("suffix", ["stl", "obj"])
@pytest.mark.parametrize("kind", ["pybullet", "dart"])
def test_shapes_of_a_file(kind, suffix, tmp_path):
    """What is seen of a link, with its colour and its mesh; what may collide, where nothing is seen; an absent mesh not."""
    pytest.importorskip(NEEDS[kind])
    (tmp_path / "robot.urdf").write_text(SHAPES.format(suffix=suffix, absent=ABSENT if kind == "dart" else ""))
    if suffix == "obj":
        lines = [f"v {x} {y} {z}" for x, y, z in TETRA] + [f"f {a + 1}/1 {b + 1}/1 {c - 4}/1" for a, b, c in FACES]
        (tmp_path / "tetra.obj").write_text("\n".join(lines))
    else:
        record = np.zeros(4, np.dtype([("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")]))
        record["v"] = TETRA[FACES]
        (tmp_path / "tetra.stl").write_bytes(bytes(80) + (4).to_bytes(4, "little") + record.tobytes())
    scene = backend(kind, tmp_path / "robot.urdf", {"q": "q.position"}, {"u": "q"}).scene(np.zeros((2, 1)))
    box, mesh, wheel = scene.shapes
    assert (box.kind, mesh.kind, wheel.kind) == ("box", "mesh", "cylinder")
    assert np.allclose(box.size, [1, 0.5, 0.25])
    assert np.allclose(box.place, [0, 0, 1, np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    assert np.allclose(box.colour, [0.7, 0.6, 0.2, 1])
    corners = mesh.vertices[mesh.faces]
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert np.isclose(volume, 8 / 6)
    assert np.allclose(wheel.size, [0.3, 0.1])
    assert scene.links[wheel.link] == "wheel"


def test_the_geoms_of_a_compiled_model(tmp_path):
    """Each kind of geom with its sizes, its frame and its colour; groups of 3 and above are for collisions alone."""
    pytest.importorskip("mujoco")
    text = """<mujoco><asset><material name="red" rgba="1 0 0 1"/><mesh name="m" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/></asset>
    <worldbody><geom type="plane" size="0 0 1"/><body name="b" pos="0 0 1"><joint name="q" axis="0 1 0"/>
    <geom type="box" size="1 2 3" material="red"/><geom type="sphere" size="0.5"/><geom type="capsule" size="0.1 0.4"/>
    <geom type="cylinder" size="0.2 0.3"/><geom type="ellipsoid" size="1 2 3"/><geom type="mesh" mesh="m"/>
    <geom type="box" size="9 9 9" group="3"/><geom type="box" size="9 9 9" rgba="1 1 1 0"/></body></worldbody></mujoco>"""
    (tmp_path / "r.xml").write_text(text)
    scene = backend("mujoco", tmp_path / "r.xml", {"q": "q.position"}, {"u": "q"}).scene(np.zeros((1, 1)))
    assert scene.links == ("world", "b")
    kinds = [s.kind for s in scene.shapes]
    assert kinds == ["plane", "box", "sphere", "capsule", "cylinder", "ellipsoid", "mesh"]
    sizes = {s.kind: s.size.tolist() for s in scene.shapes[1:-1]}
    expected = {"box": [1, 2, 3], "sphere": [0.5], "capsule": [0.1, 0.8], "cylinder": [0.2, 0.6], "ellipsoid": [1, 2, 3]}
    assert sizes == expected
    assert scene.shapes[1].colour.tolist() == [1, 0, 0, 1]
    # The mesh in its own frame, moved back to where the file has it.
    mesh = scene.shapes[-1]
    w, v = mesh.place[3], mesh.place[4:]
    turned = mesh.vertices + 2 * np.cross(v, np.cross(v, mesh.vertices) + w * mesh.vertices) + mesh.place[:3]
    assert np.allclose(np.sort(turned.sum(axis=1)), [0, 1, 1, 1], atol=1e-6)
    assert (scene.shapes[0].size > 0).all(), "a plane without end gets one"
