"""Files become recordings, and broken files one sentence."""

import numpy as np
import pyarrow
import pytest
from pyarrow import csv, parquet

import gapcert as gc
from gapcert.testing import write_csv

T = np.arange(50) * 0.01
TABLE = pyarrow.table({"t": T, "angle": np.sin(T), "torque": np.arange(50)})
WRITE = {"csv": csv.write_csv, "parquet": parquet.write_table}


def reader(folder, kind, **options):
    config = gc.registry().config("reader", kind)
    given = {"kind": kind, "files": [f"log.{kind}"], "columns": {"theta": "angle", "u": "torque"}, **options}
    return gc.registry().build("reader", kind, config.model_validate(given), gc.Context(folder))


@pytest.mark.parametrize("kind", WRITE)
def test_columns_become_channels(tmp_path, kind):
    WRITE[kind](TABLE, tmp_path / f"log.{kind}")
    recording = reader(tmp_path, kind, units={"angle": "deg"}).read()
    (tr,) = recording.trajectories
    assert recording.names == ("theta", "u")
    assert recording.units == {"theta": "deg"}
    assert np.array_equal(tr.t, T)
    assert np.array_equal(tr.channels["theta"], np.sin(T))
    assert tr.channels["u"].dtype == float


@pytest.mark.parametrize("kind", WRITE)
def test_files_are_trajectories(tmp_path, kind):
    for name in ("a", "b"):
        WRITE[kind](TABLE, tmp_path / name)
    assert [tr.name for tr in reader(tmp_path, kind, files=["a", "b"]).read().trajectories] == ["a", "b"]


@pytest.mark.parametrize("kind", WRITE)
def test_a_missing_file_is_named(tmp_path, kind):
    with pytest.raises(gc.UsageError, match=rf"there is no file log\.{kind}"):
        reader(tmp_path, kind).read()


@pytest.mark.parametrize(("kind", "text"), [("csv", b""), ("csv", b"a,b\n1\n"), ("parquet", b"t,angle\n")])
def test_a_broken_file_is_one_sentence(tmp_path, kind, text):
    (tmp_path / f"log.{kind}").write_bytes(text)
    with pytest.raises(gc.UsageError, match=rf"log\.{kind} cannot be read: .*; expected ") as error:
        reader(tmp_path, kind).read()
    assert "\n" not in str(error.value)


def test_an_empty_cell_is_a_missing_number(tmp_path):
    lines = [f"{t},{t},1" for t in T]
    lines[7] = f"{T[7]},,1"
    (tmp_path / "log.csv").write_text("\n".join(["t,angle,torque", *lines]))
    with pytest.raises(gc.UsageError, match="'theta' is nan in row 7"):
        reader(tmp_path, "csv").read()


def test_what_is_written_is_read(tmp_path):
    first = gc.Trajectory(T, {"angle": np.sin(T), "torque": T}, "1")
    second = gc.Trajectory(T, {"angle": np.cos(T), "torque": T}, "2")
    write_csv(gc.Recording((first, second)), tmp_path / "log.csv")
    recording = reader(tmp_path, "csv", trajectory="trajectory").read()
    assert [tr.name for tr in recording.trajectories] == ["1", "2"]
    assert np.allclose(recording.trajectories[1].channels["theta"], np.cos(T), rtol=1e-8)
