"""What backend `gazebo` makes of texts, SDF's and its shim's: needs none of Gazebo's libraries."""

import math

import pytest

from gapcert import UsageError
from gapcert_gazebo.engine import _nanoseconds
from gapcert_gazebo.sdf import Description, world_text

INF = 1e16  # SDF's default
FACTS = [
    "engine\t5.3.2",
    "model\tarm",
    "link\tupper\t2",
    "link\tlower\t1.5",
    # name, kind, damping, friction, has ends, has a limit of effort, low, high, speed, effort
    f"joint\tshoulder\trevolute\t0.1\t0.2\t1\t0\t-1\t2\t3\t{INF}",
    f"joint\telbow\tprismatic\t0.3\t0.4\t1\t1\t{-INF}\t{INF}\t-1\t-1",
    "gravity\t0\t0\t-9.8",
    "touches\t0",
    # Place and turn of the frame, axis, centre of mass, moment (xx, yy, zz, xy, xz, yz), stiffness and rest of a spring.
    "carried\tshoulder\tworld\tupper\t0\t0\t1\t1\t0\t0\t0\t0\t1\t0\t0\t0\t-0.5\t1\t1\t0.1\t0\t0\t0\t0\t0",
    "carried\telbow\tupper\tlower\t0\t0\t-1\t1\t0\t0\t0\t0\t0\t1\t0\t0\t-0.2\t2\t2\t0.2\t0\t0\t0\t7\t0.3",
]


@pytest.fixture
def arm():
    return Description.parse("\n".join(FACTS))


def test_a_joint_has_the_ends_that_the_file_states_and_no_others(arm):
    shoulder, elbow = arm.joints
    assert (shoulder.ends, shoulder.speeds, shoulder.efforts) == ((-1, 2), (-3, 3), (-math.inf, math.inf))
    # What is as large as the default is no end, and a negative limit means none.
    assert elbow.ends == elbow.speeds == elbow.efforts == (-math.inf, math.inf)
    assert [(j.type, j.damping, j.limited) for j in arm.joints] == [("revolute", 0.1, True), ("prismatic", 0.3, True)]


def test_only_a_joint_with_ends_and_without_a_limit_of_effort_is_stiff(arm):
    assert arm.stiff == ("shoulder",)


def test_the_world_around_the_robot_is_as_it_says(arm):
    assert (arm.friction, arm.masses) == ({"shoulder": 0.2, "elbow": 0.4}, {"upper": 2.0, "lower": 1.5})
    assert (arm.gravity, arm.base, arm.touches) == ((0.0, 0.0, -9.8), (), False)
    assert Description.parse("\n".join([*FACTS, "base\t1\t2\t3"]).replace("touches\t0", "touches\t1")).touches


def test_links_hang_from_each_other_with_the_numbers_of_the_file(arm):
    upper, lower = arm.links({"shoulder": "q1", "elbow": "q2"}, {"mass.lower": 4.0, "damping.elbow": 0.9})
    assert (upper.parent, lower.parent, upper.mass, lower.mass) == (None, "upper", 2.0, 4.0)
    assert (upper.straight, lower.straight, lower.damping, lower.stiffness, lower.rest) == (False, True, 0.9, 7.0, 0.3)


def test_a_sub_step_is_a_whole_number_of_nanoseconds():
    assert _nanoseconds(0.005, 4) == 1_250_000
    with pytest.raises(UsageError, match=r"0\.005 s in 3 sub-steps are 1666666\.67 ns each; Gazebo counts whole nanoseconds"):
        _nanoseconds(0.005, 3)


def test_a_model_gets_a_world_and_the_ground_its_friction(tmp_path):
    path = tmp_path / "robot.sdf"
    path.write_text("<sdf version='1.9'><!-- <include> --><model name='m'/></sdf>")
    assert world_text(path, None) == "<sdf version='1.9'><world name=\"default\"><model name='m'/></world></sdf>"
    assert "<mu>0.25</mu><mu2>0.25</mu2>" in world_text(path, 0.25)
    path.write_text("<sdf version='1.9'><include/></sdf>")
    with pytest.raises(UsageError, match="it includes other files"):
        world_text(path, None)
