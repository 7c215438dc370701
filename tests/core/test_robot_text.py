"""Numbers written into robot files: one attribute changes, and nothing else."""

import pytest

import gapcert as gc

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
    file = gc.RobotText(TEXT)
    joint = file.named("joint", "a")
    assert joint.attributes == {"name": "a", "type": "continuous", "max_effort": "3"}
    assert [t.kind for t in file.inside(joint)] == ["parent", "child"]
    assert [t.kind for t in file.inside(file.tags[0])] == ["joint", "link", "note"]
    assert file.put(joint, max_effort="4").text == TEXT.replace('max_effort = "3"', 'max_effort = "4"')
    assert file.put(joint, effort="4").text == TEXT.replace('max_effort = "3">', 'max_effort = "3" effort="4">')
    assert file.put(joint, name="b").text == TEXT.replace("name='a'", 'name="b"')
    assert file.put(file.named("link", "l"), mass="1").text == TEXT.replace('<link name="l"/>', '<link name="l" mass="1"/>')


def test_elements_are_put_in_with_the_indent_of_their_place():
    file = gc.RobotText(TEXT)
    inner = file.insert(file.named("joint", "a"), '<dynamics damping="0.1"/>')
    assert inner.text == TEXT.replace('"3">\n', '"3">\n    <dynamics damping="0.1"/>\n')
    opened = file.insert(file.named("link", "l"), "<inertial/>")
    assert opened.text == TEXT.replace('<link name="l"/>', '<link name="l">\n    <inertial/>\n  </link>')
    assert [t.kind for t in opened.inside(opened.named("link", "l"))] == ["inertial"]


def test_a_name_that_is_not_there_is_told():
    with pytest.raises(gc.UsageError, match='no <joint name="b">'):
        gc.RobotText(TEXT).named("joint", "b")
