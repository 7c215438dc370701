"""What backend `dart` makes of URDF and SDF files, and of mistakes in them."""

from pathlib import Path

import numpy as np
import pytest

from gapcert import UsageError
from gapcert_dart.config import DartConfig
from gapcert_engines import EngineBackend

pytestmark = [pytest.mark.needs("dartpy"), pytest.mark.contract]


MODELS = Path(__file__).parents[2] / "specs/models"
PENDULUM, SDF = (MODELS / "pendulum.urdf").read_text(), (MODELS / "pendulum.sdf").read_text()
ACROBOT = (Path(__file__).parents[1] / "data/acrobot.urdf").read_text()
HINGE = {"states": {"theta": "hinge.position", "omega": "hinge.velocity"}, "inputs": {"torque": "hinge"}}
FOUR = {"a": "shoulder.position", "b": "elbow.position", "da": "shoulder.velocity", "db": "elbow.velocity"}


def build(tmp_path, text, **options):
    from gapcert_dart.engine import DartEngine

    path = tmp_path / ("robot.sdf" if "<sdf" in text else "robot.urdf")
    path.write_text(text)
    return EngineBackend(DartEngine(DartConfig(**({"robot": path, "period": "5 ms"} | options))))


def acrobot(tmp_path, text=ACROBOT, **options):
    return build(tmp_path, text, **({"states": FOUR, "inputs": {"torque": "elbow"}} | options))


def query(n, nx=2):
    rng = np.random.default_rng(0)
    return rng.uniform(-1, 1, (n, nx)), rng.uniform(-1, 1, (n, 1))


def test_link_without_inertial_has_no_mass(tmp_path):
    """DART would give it one kilogram."""
    weld = '<link name="tip"/><joint name="weld" type="fixed"><parent link="rod"/><child link="tip"/></joint>'
    with_tip, without = (
        build(tmp_path, PENDULUM.replace("</robot>", weld + "</robot>"), **HINGE),
        build(tmp_path, PENDULUM, **HINGE),
    )
    x, u = query(40)
    assert np.abs(with_tip.step(x, u).x - without.step(x, u).x).max() <= 1e-15
    assert [p.name for p in with_tip.parameters if p.name.startswith("mass.")] == ["mass.rod"]


def test_sdf_is_the_urdf(tmp_path):
    """The rod of one file hangs in a world of the other, whose gravity is the world's."""
    x, u = query(60)
    urdf, moon = build(tmp_path, PENDULUM, **HINGE), build(tmp_path, PENDULUM, **HINGE, gravity=(0, 0, -1.62))
    assert np.abs(build(tmp_path, SDF, **HINGE).step(x, u).x - urdf.step(x, u).x).max() <= 1e-15
    text = SDF.replace("<gravity>0 0 -9.81", "<gravity>0 0 -1.62")
    assert build(tmp_path, text, **HINGE).step(x, u).x.tobytes() == moon.step(x, u).x.tobytes()


def test_sdf_chain_with_poses_is_the_urdf_chain(tmp_path):
    rod = """<link name="{name}"><pose>0 0 {z} 0 0 0</pose><inertial><pose>0 0 -0.5 0 0 0</pose><mass>1</mass>
      <inertia><ixx>0.1</ixx><iyy>0.1</iyy><izz>0.01</izz></inertia></inertial></link>"""
    hinge = """<joint name="{name}" type="revolute"><parent>{parent}</parent><child>{child}</child>
      <axis><xyz>0 1 0</xyz>{more}</axis></joint>"""
    text = (
        '<sdf version="1.6"><model name="other"/><model name="acrobot"><pose>1 2 3 0 0 0</pose>'
        + rod.format(name="upper", z=0)
        + rod.format(name="lower", z=-1)
        + hinge.format(name="shoulder", parent="world", child="upper", more="")
        + hinge.format(name="elbow", parent="upper", child="lower", more="<dynamics><damping>0.3</damping></dynamics>")
        + "</model></sdf>"
    )
    x, u = query(60, 4)
    expected = acrobot(tmp_path).step(x, u).x
    assert np.abs(acrobot(tmp_path, text, model="acrobot").step(x, u).x - expected).max() < 1e-14
    with pytest.raises(UsageError, match=r"has no model 'arm' of its own; it has other, acrobot"):
        acrobot(tmp_path, text, model="arm")


def shaped(geometry, link="</inertial>"):
    """The acrobot with this collision shape on its rods."""
    return ACROBOT.replace(link, f"{link}<collision><geometry>{geometry}</geometry></collision>")


MASSLESS = ACROBOT[: ACROBOT.index('<link name="lower">')] + '<link name="lower"/>' + ACROBOT[ACROBOT.index("<joint") :]
MIMIC = ACROBOT.replace('<dynamics damping="0.3"', '<mimic joint="shoulder"/><dynamics damping="0.3"')
NEWER = '<sdf version="1.9"><model name="m"><link name="a"><pose relative_to="b"/></link></model></sdf>'
MISTAKES = {
    "a file": ({"robot": "no.urdf"}, ACROBOT, "there is no file .*no.urdf"),
    "XML": ({}, "<robot", "is no XML"),
    "a robot": ({}, "<html/>", "starts with <html>; expected <robot>"),
    "a whole robot": ({}, ACROBOT.replace('<child link="lower"/>', '<child link="none"/>'), "DART cannot load .*none"),
    "a scalar joint": ({}, ACROBOT.replace('"continuous"', '"floating"'), "'shoulder' of .* is free; expected revolute"),
    "an own joint": ({}, MIMIC, "'elbow' of .* mimics another"),
    "a free root": ({"fixed_base": False}, ACROBOT.replace('"stand"', '"world"'), "joined to the world, so it cannot float"),
    "mass": ({}, MASSLESS, "joint 'elbow' moves no mass"),
    "one robot": ({"model": "a"}, ACROBOT, "is a URDF file, which has one robot"),
    "a model": ({}, '<sdf version="1.6"/>', "has no model of its own; it has none"),
    "old SDF": ({}, NEWER, "relative_to=.* in <pose>; DART's reader knows SDF 1.4 to 1.6"),
    "gravity": ({}, SDF.replace("0 0 -9.81", "down"), "<gravity>down</gravity>; expected three numbers"),
    "motion": ({}, SDF.replace("<link name", "<static>1</static><link name"), "is static; expected one that moves"),
    "a known joint": ({}, SDF.replace('"revolute"', '"gearbox"'), "left out link 'rod'.*gearbox"),
    "a mesh": ({"ground": 0.5}, shaped('<mesh filename="no.stl"/>'), "there is no mesh .*no.stl"),
    "a path": (
        {"self_collision": True},
        shaped('<mesh filename="package://a/b.stl"/>'),
        "expected a path relative to the file",
    ),
    "a known shape": ({"ground": 0.5}, shaped('<capsule radius="1" length="1"/>'), "shape <capsule>; expected one of box"),
    "a body": (
        {"ground": 0.5},
        shaped('<sphere radius="1"/>', link='<link name="stand">').replace('"stand"', '"world"'),
        "left out a collision shape of link 'world'",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_named(tmp_path, name):
    options, text, message = MISTAKES[name]
    with pytest.raises(UsageError, match=message):
        build(tmp_path, text, **({"states": FOUR} | options))


def test_mesh_that_takes_no_part_may_be_missing(tmp_path):
    picture = '</inertial><visual><geometry><mesh filename="package://a/b.stl"/></geometry></visual>'
    b = acrobot(tmp_path, ACROBOT.replace("</inertial>", picture + picture[11:].replace("visual", "collision")))
    x, u = query(5, 4)
    assert b.step(x, u).x.tobytes() == acrobot(tmp_path).step(x, u).x.tobytes()
