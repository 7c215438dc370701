"""What loggers, spreadsheets and robots write beside the numbers: read as it is meant, or one sentence with the remedy."""

import shutil

import numpy as np
import pytest
from written_logs import ANGLE, STAMPS, START, TORQUE, columns, joint_state, reader, store, write_lerobot, write_rosbag2

import gapcert as gc
from gapcert_recordings import inspect

N = 30
T = 0.02 * np.arange(N)


def rows(mark=",", time="{:.3f}", end=""):
    return "".join(mark.join([time.format(t), f"{np.sin(9 * t):.5f}", f"{np.cos(9 * t):.5f}"]) + end + "\n" for t in T)


def clock(start):
    """Times of day, as loggers write them: no fraction at whole seconds."""
    seconds = [(start + t) % 86400 for t in T]
    return [f"{int(s // 3600):02d}:{int(s // 60 % 60):02d}:" + f"{s % 60:09.6f}".removesuffix(".000000") for s in seconds]


def clocked(start):
    return "".join(f"{at},{np.sin(9 * t):.5f},{np.cos(9 * t):.5f}\n" for at, t in zip(clock(start), T, strict=True))


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("# t,angle,torque\n" + rows(), "t"),
        ("#t angle torque\n" + rows(" "), "t"),
        ("% rig 7\n%% run 3, cold\n% t\tangle\ttorque\n" + rows("\t"), "t"),
        ("Rig;B 12\nRun;2031-04-05\n\nt;angle;torque\n" + rows(";"), "t"),
        ("Rate [Hz],50\nOperator,none\nChannels,3\nt,angle,torque\n" + rows(), "t"),
        ("t,angle,torque,\n" + rows(end=","), "t"),
        ("time,angle,torque\n" + clocked(3600 * 7 + 12), "time"),
        ("time,angle,torque\n" + clocked(86400 - 0.31), "time"),
    ],
    ids=["hash", "hash-blanks", "percent", "preamble", "preamble-numbers", "trailing", "clock", "midnight"],
)
@pytest.mark.parametrize("suffix", ["csv", "txt", "dat"])
def test_a_dialect_is_read_as_it_is_meant(tmp_path, text, name, suffix):
    (tmp_path / f"log.{suffix}").write_text(text)
    found = reader(tmp_path, "csv", files=[f"log.{suffix}"], time=name).read().trajectories[0]
    assert np.allclose(found.t - found.t[0], T, atol=1e-9)
    assert np.allclose(found.channels["theta"], np.sin(9 * T), atol=1e-5)
    (listed,) = inspect(tmp_path / f"log.{suffix}")
    assert (listed.time, [c.name for c in listed.columns]) == (name, ["angle", "torque"])


@pytest.mark.parametrize("header", [",angle,torque\n", "__time,angle,torque\n", "when,angle,torque\n"])
def test_dates_are_the_times_whatever_they_are_called(tmp_path, header):
    dates = "".join(f"2031-04-05 10:11:{12 + t:09.6f}+00:00,{t},{-t}\n" for t in T)
    (tmp_path / "log.csv").write_text(header + dates)
    (listed,) = inspect(tmp_path / "log.csv")
    assert listed.period == pytest.approx(0.02)
    assert [c.name for c in listed.columns] == ["angle", "torque"]


def test_columns_of_one_name_are_told_apart(tmp_path):
    (tmp_path / "log.csv").write_text("t,angle,torque,angle\n" + rows().replace("\n", ",7\n"))
    with pytest.raises(gc.UsageError, match=r"'angle' is not a column; did you mean 'angle \(\d\)'"):
        reader(tmp_path, "csv").read()
    found = reader(tmp_path, "csv", **columns("angle (2)", "torque")).read()
    assert set(found.trajectories[0].channels["theta"]) == {7.0}
    assert found.units == {}


def test_equal_numbers_are_no_header(tmp_path):
    (tmp_path / "log.csv").write_text("0,0,0\n" + rows())
    with pytest.raises(gc.UsageError, match=r"the first line has numbers \('0,0,0'\); expected a header"):
        inspect(tmp_path / "log.csv")


def test_a_line_that_was_cut_off_is_still_told_below_a_preamble(tmp_path):
    text = "Rig;B 12\nRun;2031-04-05\n\nt;angle;torque\n" + rows(";") + "0.6;1\n"
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(gc.UsageError, match=rf"line {text.count(chr(10))} has 2 values \('0.6;1'\); expected 3"):
        inspect(tmp_path / "log.csv")


@pytest.mark.parametrize("mark", [",", ";", "\t"])
@pytest.mark.parametrize("last", ["0", "", "on"])
def test_rows_that_are_longer_than_the_header_are_told(tmp_path, mark, last):
    text = mark.join(["t", "angle", "torque"]) + "\n" + rows(mark, end=f"{mark}{last}")
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(gc.UsageError, match=r"line 2 has 4 values .*; expected 3, as the header has"):
        inspect(tmp_path / "log.csv")


NAMED = ("turn", "pole", "hand", "m", "deg")


@pytest.mark.parametrize("joint", NAMED)
def test_what_a_joint_is_called_is_no_unit(tmp_path, joint):
    """Each of these is a unit as well, somewhere."""
    from rosbags.rosbag2 import Writer

    kind = "sensor_msgs/msg/JointState"
    with Writer(tmp_path / "log", version=9) as bag:
        connection = bag.add_connection("/joint_states", kind, typestore=store())
        for k in range(len(STAMPS)):
            message = joint_state(k)
            message.name[0] = joint
            bag.write(connection, int(STAMPS[k]), store().serialize_cdr(message, kind))
    given = columns(f"/joint_states.position[{joint}]", f"/joint_states.effort[{joint}]")
    found = reader(tmp_path, "rosbag2", files=["log"], **given).read()
    assert found.units == {}
    assert np.allclose(found.trajectories[0].channels["theta"], ANGLE)
    stated = reader(tmp_path, "rosbag2", files=["log"], units={given["columns"]["theta"]: "deg"}, **given).read()
    assert stated.units == {"theta": "deg"}


def test_what_a_feature_calls_its_elements_is_no_unit(tmp_path):
    options = write_lerobot(tmp_path)
    info = tmp_path / "set" / "meta" / "info.json"
    info.write_text(info.read_text().replace('"elbow"', '"turn"'))
    found = reader(tmp_path, "lerobot", **(options | columns("observation.state[turn]", "action[torque]"))).read()
    assert found.units == {}
    assert np.allclose(found.trajectories[0].channels["theta"], ANGLE)


def with_service(folder, order):
    """Joint states, and calls of a service, whose definition is none of a message, before them or after."""
    from mcap.writer import Writer

    kind = "sensor_msgs/msg/JointState"
    with (folder / "log.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        definition = b"bool data\n---\nbool success\nstring message\n"

        def call(at):
            schema = writer.register_schema("std_srvs/srv/SetBool", "ros2msg", definition)
            channel = writer.register_channel("/enable/_service_event", "cdr", schema)
            writer.add_message(channel, at, b"\x00\x01\x00\x00\x01", at)

        if order == "before":
            call(START - 1)
        schema = writer.register_schema(kind, "ros2msg", store().generate_msgdef(kind, ros_version=2)[0].encode())
        channel = writer.register_channel("/joint_states", "cdr", schema)
        for k in range(len(STAMPS)):
            writer.add_message(channel, int(STAMPS[k]), bytes(store().serialize_cdr(joint_state(k), kind)), int(STAMPS[k]))
        if order == "after":
            call(int(STAMPS[-1]))
        writer.finish()


@pytest.mark.parametrize("order", ["before", "after"])
def test_a_topic_that_cannot_be_decoded_is_told_and_costs_no_other(tmp_path, order):
    with_service(tmp_path, order)
    listed = {table.name: table for table in inspect(tmp_path / "log.mcap")}
    assert set(listed) == {"/joint_states", "/enable/_service_event, which cannot be decoded"}
    assert len(listed["/joint_states"].t) == len(STAMPS)
    given = columns("/joint_states.position[elbow]", "/joint_states.effort[0]")
    found = reader(tmp_path, "mcap", **given).read()
    assert np.allclose(found.trajectories[0].channels["u"], TORQUE)
    with pytest.raises(
        gc.UsageError, match=r"'/enable/_service_event' is encoded as 'cdr' by 'std_srvs/srv/SetBool', which is"
    ):
        reader(tmp_path, "mcap", **columns("/enable/_service_event.data", "/joint_states.effort[0]")).read()


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("path", ["log", "log/{}"])
def test_a_bag_without_its_description_is_told_what_to_do(tmp_path, storage, path):
    options = write_rosbag2(tmp_path, storage)
    (stored,) = [p for p in (tmp_path / "log").iterdir() if p.suffix != ".yaml"]
    where = tmp_path / path.format(stored.name)
    if where.suffix != ".mcap":
        assert [len(t.t) for t in inspect(where)] == [len(STAMPS)]
    (tmp_path / "log" / "metadata.yaml").unlink()
    if where.suffix == ".mcap":
        assert [len(t.t) for t in inspect(where)] == [len(STAMPS)]
        return
    said = rf"there is no metadata.yaml beside what is stored; expected a ROS 2 bag.*; `ros2 bag reindex {tmp_path / 'log'}`"
    with pytest.raises(gc.UsageError, match=said) as error:
        inspect(where)
    assert ("kind: mcap reads" in str(error.value)) == (storage == "MCAP")
    with pytest.raises(gc.UsageError, match=said):
        reader(tmp_path, "rosbag2", **options).read()
    shutil.rmtree(tmp_path / "log")
