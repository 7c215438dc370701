"""Numbers written into robot files: one attribute changes, and nothing else."""

import pytest

import gapcert as gc
import gapcert_engines

TEXT = """<?xml version="1.0"?>
<robot name="r">  <!-- <joint name="a" type="none"/> -->
  <joint   name='a' type="continuous"
           max_effort = "3">
    <parent link="world"/><child link="l"/>
  </joint>
  <link name="l"/>
  <note text="1 > 0, and /> ends nothing"/>
</robot>
"""


def test_what_is_changed_and_what_is_not():
    file = gapcert_engines.RobotText(TEXT)
    joint = file.named("joint", "a")
    assert joint.attributes == {"name": "a", "type": "continuous", "max_effort": "3"}
    assert [t.kind for t in file.inside(joint)] == ["parent", "child"]
    assert [t.kind for t in file.inside(file.tags[0])] == ["joint", "link", "note"]
    assert file.put(joint, max_effort="4").text == TEXT.replace('max_effort = "3"', 'max_effort = "4"')
    assert file.put(joint, effort="4").text == TEXT.replace('max_effort = "3">', 'max_effort = "3" effort="4">')
    assert file.put(joint, name="b").text == TEXT.replace("name='a'", 'name="b"')
    assert file.put(file.named("link", "l"), mass="1").text == TEXT.replace('<link name="l"/>', '<link name="l" mass="1"/>')


def test_elements_are_put_in_with_the_indent_of_their_place():
    file = gapcert_engines.RobotText(TEXT)
    inner = file.insert(file.named("joint", "a"), '<dynamics damping="0.1"/>')
    assert inner.text == TEXT.replace('"3">\n', '"3">\n    <dynamics damping="0.1"/>\n')
    opened = file.insert(file.named("link", "l"), "<inertial/>")
    assert opened.text == TEXT.replace('<link name="l"/>', '<link name="l">\n    <inertial/>\n  </link>')
    assert [t.kind for t in opened.inside(opened.named("link", "l"))] == ["inertial"]


def test_a_name_that_is_not_there_is_told():
    with pytest.raises(gc.UsageError, match='no <joint name="b">'):
        gapcert_engines.RobotText(TEXT).named("joint", "b")


SDF = """<sdf version="1.9"><world name="w"><!-- <gravity>1</gravity> -->
  <model name="a"><link name="l"/></model>
  <model name="r">
    <link name="l">
      <inertial>
        <mass> 2 </mass> <!-- kg -->
        <inertia><ixx>0.5</ixx></inertia>
      </inertial>
    </link>
    <joint name="j" type="revolute">
      <axis><xyz>0 1 0</xyz></axis>
    </joint>
  </model>
</world></sdf>
"""
URDF = """<robot name="r">
  <transmission name="t"><joint name="j"/></transmission>
  <joint name="j" type="continuous"/>
  <link name="l"><inertial><mass value="2"/><inertia ixx="0.5" iyy="1"/></inertial></link>
  <link name="m"/>
</robot>
"""


def test_the_text_of_an_element_is_replaced():
    file = gapcert_engines.RobotText(SDF)
    mass = file.named("link", "l", file.named("model", "r"))
    mass = file.inside(file.inside(mass)[0])[0]
    assert file.content(mass) == "2"
    assert file.fill(mass, "3").text == SDF.replace("<mass> 2 </mass>", "<mass>3</mass>")
    assert (
        gapcert_engines.RobotText("<a><b/></a>").fill(gapcert_engines.RobotText("<a><b/></a>").tags[1], "1").text
        == "<a><b>1</b></a>"
    )
    assert gapcert_engines.RobotText("<a><b/></a>").content(gapcert_engines.RobotText("<a><b/></a>").tags[1]) == ""


def test_numbers_of_an_sdf_file():
    values = {"mass.l": 4.0, "damping.j": 0.1, "coulomb_friction.j": 0.2, "gravity_x": 0.5, "mass.no": 1.0, "friction": 2.0}
    text, unsaid = gapcert_engines.patched_sdf(SDF, values, [0.0, 0.0, -9.8], "r")
    assert unsaid == {"mass.no": 1.0, "friction": 2.0}
    # What the file leaves to SDF's defaults, one for each of the other moments, is in proportion as well.
    new = SDF.replace("<mass> 2 </mass>", "<mass>4.0</mass>").replace("<ixx>0.5</ixx>", "<ixx>1.0</ixx>")
    new = new.replace("<inertia>", "<inertia>\n          <izz>2.0</izz>\n          <iyy>2.0</iyy>")
    dynamics = "<axis>\n        <dynamics>\n          <friction>0.2</friction><damping>0.1</damping></dynamics><xyz>"
    new = new.replace("<axis><xyz>", dynamics)
    new = new.replace('<world name="w">', '<world name="w">\n  <gravity>0.5 0.0 -9.8</gravity>')
    assert "".join(text.split()) == "".join(new.split())
    assert gapcert_engines.patched_sdf('<sdf><model name="r"/></sdf>', {"gravity_x": 1.0}, [0, 0, -9.8])[1] == {
        "gravity_x": 1.0
    }


def test_numbers_of_a_urdf_file():
    values = {"mass.l": 4.0, "damping.j": 0.1, "mass.m": 1.0, "damping.no": 1.0, "gravity_x": 0.5}
    text, unsaid = gapcert_engines.patched_urdf(URDF, values, {"damping": "damping"})
    assert unsaid == {"mass.m": 1.0, "damping.no": 1.0, "gravity_x": 0.5}
    new = URDF.replace('<mass value="2"/><inertia ixx="0.5" iyy="1"/>', '<mass value="4.0"/><inertia ixx="1.0" iyy="2.0"/>')
    opened = '<joint name="j" type="continuous">\n    <dynamics damping="0.1"/>\n  </joint>'
    assert text == new.replace('<joint name="j" type="continuous"/>', opened)
