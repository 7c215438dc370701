"""Files of every format become the same recording, and broken files one sentence."""

import sqlite3

import numpy as np
import pytest
import written_logs
from pydantic import ValidationError
from written_logs import (
    ANGLE,
    FORMATS,
    STAMPS,
    START,
    TABLES,
    TORQUE,
    T,
    columns,
    reader,
    table,
    write_lerobot,
    write_mcap_json,
    write_rosbag2,
    write_table,
)

import gapcert as gc
from gapcert.testing import multisine, write_csv
from gapcert_diagnosis.testing import ROD, equations


@pytest.mark.parametrize("form", FORMATS)
def test_every_format_holds_the_same_recording(tmp_path, form):
    kind, write = FORMATS[form]
    found = reader(tmp_path, kind, hold="zero", every="20 ms", units={}, **write(tmp_path)).read()
    (tr,) = found.trajectories
    assert np.allclose(tr.t, T, rtol=0, atol=1e-9)
    assert np.allclose(tr.channels["theta"], ANGLE, rtol=0, atol=1e-12)
    assert np.allclose(tr.channels["u"], TORQUE, rtol=0, atol=1e-12)
    assert (found.hold, found.every) == ("zero", 0.02)


@pytest.fixture(scope="module")
def swing():
    """12 s of a pendulum with friction that its model lacks."""
    model = equations(ROD)
    hidden = model.extend([gc.registry().build("effect", "viscous-friction").extension("q", model)])
    u = multisine(12.0, 0.01, 2.0, (0.2, 2.5), 3)
    x = hidden.rollout(np.array([[0.3, 0.0]]), u[None], parameters={"viscous_friction_q": 0.15}).x[0, :-1]
    return model, x[:, 0] + 1e-3 * np.random.default_rng(0).standard_normal(len(u)), u[:, 0]


@pytest.mark.exam
@pytest.mark.parametrize("form", FORMATS)
def test_the_same_cause_is_found_from_every_format(tmp_path, monkeypatch, swing, form):
    model, angle, torque = swing
    t = np.arange(len(angle)) * 0.01
    stamps = START + np.round(t * 1e9).astype(np.int64)
    for name, value in {"T": t, "ANGLE": angle, "TORQUE": torque, "STAMPS": stamps}.items():
        monkeypatch.setattr(written_logs, name, value)
    kind, write = FORMATS[form]
    given = write(tmp_path)
    given = given | {"columns": {"q": given["columns"]["theta"], "u": given["columns"]["u"]}}
    found = gc.diagnose(model, reader(tmp_path, kind, hold="zero", **given).read())
    assert [(c.effect, c.site) for c in found.causes] == [("viscous-friction", "q")]
    assert found.causes[0].parameters["coefficient"].value == pytest.approx(0.15, rel=0.03)


@pytest.mark.parametrize("form", FORMATS)
def test_a_listing_shows_every_column(tmp_path, form):
    kind, write = FORMATS[form]
    options = write(tmp_path)
    implementation = gc.registry().get("reader", kind).load()
    path = tmp_path / options["files"][0]
    assert path.suffix in implementation.suffixes
    tables = implementation.tables(path)
    there = {column for _, table in tables for column in table}
    wanted = {c.replace("[elbow]", "[0]") for c in options["columns"].values()}
    assert wanted <= there


@pytest.mark.parametrize("kind", ["rosbag2", "lerobot"])
def test_a_folder_of_another_kind_is_not_listed(tmp_path, kind):
    assert list(gc.registry().get("reader", kind).load().tables(tmp_path)) == []


def test_topics_meet_at_the_times_of_the_first(tmp_path):
    rare = STAMPS[::5] + 2_000_000
    options = write_mcap_json(tmp_path, rare, np.arange(10.0))
    straight = reader(tmp_path, "mcap", **options).read().trajectories[0].channels["u"]
    assert np.isnan(straight[0])
    assert straight[3] == pytest.approx((0.03 - 0.002) / 0.05)
    held = reader(tmp_path, "mcap", held=["u"], **options).read().trajectories[0].channels["u"]
    assert np.isnan(held[0])
    assert held[1:6].tolist() == [0, 0, 0, 0, 0]
    assert held[6] == 1
    assert held[-1] == 9


def test_the_time_of_logging_can_be_used(tmp_path):
    options = write_rosbag2(tmp_path)
    with sqlite3.connect(next((tmp_path / "log").glob("*.db3"))) as data:
        data.execute("UPDATE messages SET timestamp = timestamp + 5000000 WHERE rowid = 2")
    by_stamp, by_log = (reader(tmp_path, "rosbag2", clock=c, **options).read().trajectories[0].t for c in ("message", "log"))
    assert by_stamp[1] == pytest.approx(0.01)
    assert by_log[1] == pytest.approx(0.015)


def test_elements_go_by_the_names_of_their_feature(tmp_path):
    options = write_lerobot(tmp_path) | columns("observation.state[wrist]", "action[torque]")
    channels = reader(tmp_path, "lerobot", **options).read().trajectories[0].channels
    np.testing.assert_array_equal(channels["theta"], 0 * T)
    np.testing.assert_array_equal(channels["u"], TORQUE)


def test_episodes_are_trajectories(tmp_path):
    options = write_lerobot(tmp_path, 3)
    assert [tr.name for tr in reader(tmp_path, "lerobot", **options).read().trajectories] == ["0", "1", "2"]
    (tr,) = reader(tmp_path, "lerobot", episodes=[2], **options).read().trajectories
    assert tr.channels["theta"][0] == pytest.approx(2)
    with pytest.raises(gc.UsageError, match="has no episode 7; there are 0 to 2"):
        reader(tmp_path, "lerobot", episodes=[7], **options).read()


def test_groups_are_trajectories(tmp_path):
    import h5py

    with h5py.File(tmp_path / "log.h5", "w") as file:
        for i in (10, 2):
            file[f"data/demo_{i}/t"] = T
            file[f"data/demo_{i}/angle"] = ANGLE + i
    options = {"files": ["log.h5"], "columns": {"theta": "angle"}}
    found = reader(tmp_path, "hdf5", groups="data/demo_*", **options).read()
    assert [tr.name for tr in found.trajectories] == ["data/demo_2", "data/demo_10"]
    assert found.trajectories[1].channels["theta"][0] == 10
    with pytest.raises(gc.UsageError, match="no group matches 'run_\\*'"):
        reader(tmp_path, "hdf5", groups="run_*", **options).read()


def test_rows_without_times_are_counted(tmp_path):
    from pyarrow import csv

    csv.write_csv(table().drop_columns("t"), tmp_path / "log.csv")
    assert np.allclose(reader(tmp_path, "csv", period="10 ms").read().trajectories[0].t, T)


def test_rows_have_times_or_are_counted(tmp_path):
    write_table("csv", tmp_path / "log.csv")
    with pytest.raises(ValidationError, match="found time: t and a period; expected one of them"):
        reader(tmp_path, "csv", time="t", period="10 ms")


ROWS = "".join(f"{10 * k},{0.1 * k:.1f},{k % 3}\n" for k in range(30))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            "t,angle,torque\n" + ROWS + "300,0.",
            "line 32 has 2 values ('300,0.'); expected 3, as the header has; mend it, or remove",
        ),
        ("# a\n\nt,angle,torque\n" + ROWS + "\n300\n", "line 35 has 1 value ('300'); expected 3"),
        (ROWS.replace("0,0.0", "0.5,0.0", 1), "the first line has numbers ('0.5,0.0,0'); expected a header"),
        ("t,angle,torque\nms,deg,\n" + ROWS, "line 2 has no numbers ('ms,deg,'); expected values; if these are units, write"),
        ("t,angle,torque\nms,deg,N\n" + ROWS, "into the header, 't [ms]'"),
    ],
)
def test_what_loggers_leave_is_told_with_its_line(tmp_path, text, told):
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(gc.UsageError) as error:
        reader(tmp_path, "csv").read()
    assert str(error.value).startswith("recording: log.csv")
    assert told in str(error.value)


@pytest.mark.parametrize(
    "text",
    ["t,0,1\n" + ROWS, "t,angle,torque\nNaN,,\n" + ROWS, "t,angle,mode\n0,NA,on\n" + ROWS, "t,angle,mode\n,NA,on\n0,NA,off\n"],
)
def test_a_table_is_left_alone(tmp_path, text):
    (tmp_path / "log.csv").write_text(text)
    names, rows = text.splitlines()[0].split(","), text.count("\n") - 1
    ((_, found),) = gc.registry().components["reader", "csv"].load().tables(tmp_path / "log.csv")
    assert list(found) == names
    assert {len(v) for v in found.values()} == {rows}


@pytest.mark.parametrize("state", ["run", "läuft"])
def test_text_that_is_not_utf_8_is_read_as_it_was_written(tmp_path, state):
    text = "t;Winkel [°];mode\n" + "".join(f"{0.01 * k};{0.1 * k};{state}\n" for k in range(30))
    for coding in ("latin-1", "utf-8", "utf-8-sig"):
        (tmp_path / "log.csv").write_text(text.replace(".", ","), encoding=coding)
        found = reader(tmp_path, "csv", columns={"theta": "Winkel [°]"}).read()
        assert found.units == {"theta": "°"}
        assert found.trajectories[0].channels["theta"][-1] == pytest.approx(2.9)
    (tmp_path / "log.csv").write_text(text, encoding="utf-16")
    with pytest.raises(gc.UsageError, match=r"log\.csv is in UTF-16; expected text in UTF-8; save it as"):
        reader(tmp_path, "csv").read()


@pytest.mark.parametrize("kind", TABLES)
def test_columns_become_channels(tmp_path, kind):
    write_table(kind, tmp_path / f"log.{kind}")
    recording = reader(tmp_path, kind, units={"angle": "deg"}).read()
    (tr,) = recording.trajectories
    assert recording.names == ("theta", "u")
    assert recording.units == {"theta": "deg"}
    assert np.array_equal(tr.t, T)
    assert np.array_equal(tr.channels["theta"], np.sin(T))
    assert tr.channels["u"].dtype == float


@pytest.mark.parametrize("kind", TABLES)
def test_files_are_trajectories(tmp_path, kind):
    for name in ("a", "b"):
        write_table(kind, tmp_path / f"{name}.log")
    for files in (["a.log", "b.log"], ["*.log"]):
        assert [tr.name for tr in reader(tmp_path, kind, files=files).read().trajectories] == ["a.log", "b.log"]


@pytest.mark.parametrize("kind", [*TABLES, "hdf5", "mat", "mcap", "rosbag2", "lerobot"])
def test_a_missing_file_is_named(tmp_path, kind):
    with pytest.raises(gc.UsageError, match=rf"there is no file log\.{kind}"):
        reader(tmp_path, kind).read()


@pytest.mark.fault("a log that is of another format than its name says", shows="the file, and what was expected")
@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("csv", b""),
        ("csv", b"a,b\n1\n"),
        ("parquet", b"t,angle\n"),
        ("hdf5", b"not HDF5"),
        ("mat", b"not MATLAB, but long enough to be looked at" * 10),
        ("mcap", b"not MCAP, but long enough to be looked at"),
        ("rosbag2", b"not a folder"),
        ("lerobot", b"not a folder"),
    ],
)
def test_a_broken_file_is_one_sentence(tmp_path, kind, text):
    (tmp_path / f"log.{kind}").write_bytes(text)
    with pytest.raises(gc.UsageError, match=rf"log\.{kind} cannot be read: .*; expected ") as error:
        reader(tmp_path, kind).read()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("column", "says"),
    [
        ("/joint_state.position[0]", r"no topic for '/joint_state.position\[0\]'; .* there are /joint_states"),
        ("/joint_states.position[knee]", r"'/joint_states.position\[knee\]' is in no message; there are \.position\[0\]"),
        ("/joint_states.torque", r"'/joint_states.torque' is in no message"),
    ],
)
def test_a_wrong_column_of_a_message_is_named(tmp_path, column, says):
    options = {**write_rosbag2(tmp_path), **columns("/joint_states.position[elbow]", column)}
    with pytest.raises(gc.UsageError, match=says):
        reader(tmp_path, "rosbag2", **options).read()


def test_an_empty_cell_is_a_missing_number(tmp_path):
    lines = [f"{t},{t},1" for t in T]
    lines[7] = f"{T[7]},,1"
    (tmp_path / "log.csv").write_text("\n".join(["t,angle,torque", *lines]))
    assert np.flatnonzero(np.isnan(reader(tmp_path, "csv").read().trajectories[0].channels["theta"])).tolist() == [7]


def test_what_is_written_is_read(tmp_path):
    first = gc.Trajectory(T, {"angle": np.sin(T), "torque": T}, "1")
    second = gc.Trajectory(T, {"angle": np.cos(T), "torque": T}, "2")
    write_csv(gc.Recording((first, second)), tmp_path / "log.csv")
    recording = reader(tmp_path, "csv", trajectory="trajectory").read()
    assert [tr.name for tr in recording.trajectories] == ["1", "2"]
    assert np.allclose(recording.trajectories[1].channels["theta"], np.cos(T), rtol=1e-8)


def separated(path, mark, number=str, header="t,angle,torque"):
    rows = [mark.join(map(number, row)) for row in zip(T, np.sin(T), np.cos(T), strict=True)]
    path.write_text("\n".join([header.replace(",", mark), *rows]) + "\n")


@pytest.mark.parametrize("mark", [",", ";", "\t", " ", "   "])
def test_the_mark_between_values_is_seen(tmp_path, mark):
    separated(tmp_path / "log.csv", mark)
    (tr,) = reader(tmp_path, "csv").read().trajectories
    assert np.allclose(tr.channels["theta"], np.sin(T))


@pytest.mark.parametrize("mark", [";", "\t"])
def test_a_decimal_comma_is_seen(tmp_path, mark):
    separated(tmp_path / "log.csv", mark, lambda v: f"{v:.7f}".replace(".", ","))
    (tr,) = reader(tmp_path, "csv").read().trajectories
    assert np.allclose(tr.channels["theta"], np.sin(T), atol=1e-6)


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        ("{i};0,5;1.5", r"log.csv: 'angle' has numbers with a decimal comma, 'torque' with a point; expected one decimal sign"),
        ("{i};1,500;2", r"log.csv: '1,500' in 'angle' is 1.500 or 1500; expected a decimal sign that cannot be mistaken"),
        ("{i};0,5;", r"'u' holds no finite number"),
        ("{i};0,5;off", r"column 'torque' holds 'off' in line 2; expected a number in every row"),
    ],
)
def test_what_separated_text_leaves_open_is_asked(tmp_path, rows, says):
    (tmp_path / "log.csv").write_text("t;angle;torque\n" + "".join(rows.format(i=i) + "\n" for i in range(40)))
    with pytest.raises(gc.UsageError, match=says) as error:
        reader(tmp_path, "csv").read()
    assert "; " in str(error.value)


@pytest.mark.parametrize("comma", ["0.5", "0,5"])
def test_the_line_of_a_text_late_in_a_long_file_is_named(tmp_path, comma):
    rows = [f"{i};{comma};1" for i in range(200_000)]  # more than Arrow looks at to choose a type
    rows[150_000] = f"150000;{comma};oops"
    (tmp_path / "log.csv").write_text("\r\n".join(["t;angle;torque", *rows]))
    with pytest.raises(gc.UsageError, match="column 'torque' holds 'oops' in line 150002"):
        reader(tmp_path, "csv").read()


def test_blanks_around_the_names_of_columns_do_not_count(tmp_path):
    separated(tmp_path / "log.csv", ",", header="t, angle , torque")
    assert np.allclose(reader(tmp_path, "csv").read().trajectories[0].channels["u"], np.cos(T))


@pytest.mark.parametrize("mark", [",", " "])
@pytest.mark.parametrize("said", ["# rig 7, run 3\n", "% a; b\n\n#\n# done\n"])
def test_remarks_above_the_header_are_passed_over(tmp_path, said, mark):
    separated(tmp_path / "log.csv", mark)
    text = (tmp_path / "log.csv").read_text()
    (tmp_path / "log.csv").write_text(said + text)
    assert np.allclose(reader(tmp_path, "csv").read().trajectories[0].channels["u"], np.cos(T))
    lines = (said + text).splitlines()
    lines[said.count("\n") + 9] = mark.join(["1.0", "oops", "1.0"])
    (tmp_path / "log.csv").write_text("\n".join(lines))
    with pytest.raises(gc.UsageError, match=f"'oops' in line {said.count(chr(10)) + 10}"):
        reader(tmp_path, "csv").read()
