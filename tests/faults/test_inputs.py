"""Specs, logs, robot files and run folders that are not what they should be: one sentence, soon, and nothing changed."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from faults import contents, told, written

import gapcert as gc

fault, case = pytest.mark.fault, pytest.param
ROOT = Path(__file__).parents[2]

# --- specs

BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{c}: &{c} [{','.join(['*' + p] * 9)}]\n" for p, c in zip("abcdefgh", "bcdefghi", strict=True)
)
LONG = {f"domain.{n}": [[-k, k] for k in range(1, 300)] for n in ("x", "u", "w")}


@pytest.mark.exam
@pytest.mark.parametrize(
    ("text", "says"),
    [
        case(
            b"\xff\xfe\x00",
            "is not UTF-8; save the spec as UTF-8 text",
            id="encoding",
            marks=fault("a spec in another encoding", shows="the byte"),
        ),
        case(
            b"version: 1\n\tname: x\n", "cannot start any token", id="tab", marks=fault("a tab in a spec", shows="line, column")
        ),
        case(
            b"version: 1\nname: a\0b\n",
            "not YAML: unacceptable character",
            id="NUL",
            marks=fault("a NUL byte in a spec", shows="where"),
        ),
        case(
            b"version: 1\nversion: 1\n",
            "duplicate key 'version'",
            id="twice",
            marks=fault("a key given twice", shows="both lines"),
        ),
        case(
            b"x: 1\n#" + b"x" * 10_000_000,
            "larger than 1,000,000 bytes",
            id="10 MB",
            marks=fault("a spec of 10 MB", shows="the limit, at once"),
        ),
        case(
            b"x: [" + b"1," * 200_000 + b"1]",
            "more than 20,000 lines or values",
            id="values",
            marks=fault("a spec of 200,000 values", shows="the limit, at once"),
        ),
        case(
            b"x: " + b"[" * 5000, "nested too deeply", id="brackets", marks=fault("5,000 brackets", shows="the limit, at once")
        ),
        case(
            b"- " * 5000 + b"1",
            "nested too deeply",
            id="lists",
            marks=fault("5,000 lists in each other", shows="the limit, at once"),
        ),
        case(
            BOMB.encode(),
            "what aliases repeat included",
            id="aliases",
            marks=fault("aliases that stand for 10⁹ values", shows="the limit, at once"),
        ),
        case(
            b"version: 1\nname: x\nyy: [" + b'"y", ' * 15_000 + b"]",
            "unknown key 'yy'",
            id="long line",
            marks=fault("a line of 100,000 characters", shows="the part around the error"),
        ),
        case(
            json.dumps({"version": 1, "name": "x", "matrix": LONG}).encode(),
            "it stands for more than 10,000 specs",
            id="matrix",
            marks=fault("a matrix of 26 million specs", shows="the limit, at once"),
        ),
        case(b"extends: 'a\\0b'", "no file", id="NUL path", marks=fault("a path that no file can have", shows="the key")),
        case(b"extends: " + b"a" * 5000, "no file", id="long path", marks=fault("a path of 5,000 characters", shows="the key")),
        case(
            b"version: 1\nname: " + b"a" * 300,
            "at most 100",
            id="long name",
            marks=fault("a name longer than a folder's", shows="the limit"),
        ),
    ],
)
def test_specs(tmp_path, capsys, text, says):
    path = tmp_path / "spec.yaml"
    path.write_bytes(text)
    told(capsys, "validate", str(path), says=says)


@fault("a byte order mark before a spec", shows="it is read as if it were not there")
def test_a_byte_order_mark(tmp_path, capsys):
    path = written(tmp_path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    told(capsys, "validate", str(path), code=0)


# --- logs


def logs(folder: Path) -> dict[str, Path]:
    """One log in every format that is read."""
    import h5py
    import pyarrow
    from mcap.writer import Writer
    from pyarrow import csv, parquet
    from rosbags.rosbag2 import Writer as BagWriter
    from rosbags.typesys import Stores, get_typestore
    from scipy.io import savemat

    t = np.arange(400) * 0.01
    table = pyarrow.table({"t": t, "x": np.sin(t)})
    csv.write_csv(table, folder / "log.csv")
    parquet.write_table(table, folder / "log.parquet")
    with h5py.File(folder / "log.h5", "w") as file:
        file["t"], file["x"] = t, np.sin(t)
    savemat(folder / "log.mat", {"t": t, "x": np.sin(t)}, do_compression=True)
    with (folder / "log.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("s", "jsonschema", b"{}")
        channel = writer.register_channel("/a", "json", schema)
        for k, x in zip(t, np.sin(t), strict=True):
            writer.add_message(channel, int(1e9 * k), json.dumps({"x": x}).encode(), int(1e9 * k))
        writer.finish()
    store = get_typestore(Stores.ROS2_HUMBLE)
    with BagWriter(folder / "bag", version=8) as bag:
        topic = bag.add_connection("/a", "std_msgs/msg/Float64", typestore=store)
        kind = store.types["std_msgs/msg/Float64"]
        for k, x in zip(t, np.sin(t), strict=True):
            bag.write(topic, int(1e9 * k), store.serialize_cdr(kind(x), "std_msgs/msg/Float64"))
    return {p.suffix[1:] or p.name: p for p in folder.iterdir()}


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    pytest.importorskip("h5py", reason="needs the readers extra")
    return logs(tmp_path_factory.mktemp("logs"))


@pytest.mark.parametrize(
    "form",
    [
        case("parquet", id="parquet", marks=fault("a Parquet file is cut off", shows="the file, and what was expected")),
        case("h5", id="hdf5", marks=fault("an HDF5 file is cut off", shows="the file, and what was expected")),
        case("mat", id="mat", marks=fault("a .mat file is cut off", shows="the file, and what was expected")),
        case("mcap", id="mcap", marks=fault("an MCAP file is cut off", shows="the file, and what was expected")),
        case("bag", id="bag", marks=fault("the data of a ROS 2 bag are cut off", shows="the file, and what was expected")),
    ],
)
def test_logs_that_are_cut_off(good, tmp_path, capsys, form):
    for share in (0.0, 0.02, 0.3, 0.6, 0.97):
        shutil.rmtree(tmp_path / "log", ignore_errors=True)
        if good[form].is_dir():
            path = Path(shutil.copytree(good[form], tmp_path / "log"))
            damaged = next(path.glob("*.db3"))
        else:
            path = damaged = tmp_path / good[form].name
            path.write_bytes(good[form].read_bytes())
        content = damaged.read_bytes()
        damaged.write_bytes(content[: int(share * len(content))])
        err = told(capsys, "inspect", str(path), "--out", str(tmp_path / "out"))
        assert path.name in err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("form", ["csv", "parquet", "h5", "mat", "mcap", "bag"])
def test_whole_logs_are_read(good, tmp_path, capsys, form):
    told(capsys, "inspect", str(good[form]), "--out", str(tmp_path), code=0)


@fault(
    "a log of one row, of nothing but NaN, of times that stand still or run back", shows="a sentence, or what there is to see"
)
@pytest.mark.parametrize(
    "rows", ["0,1\n", "0,nan\n1,nan\n", "0,1\n0,2\n0,3\n", "3,1\n2,1\n1,1\n", "inf,1\n1e308,1\n-inf,2\n", "", "a,b\n"]
)
def test_odd_logs(tmp_path, capsys, rows):
    from gapcert.cli.main import main

    (tmp_path / "log.csv").write_text("t,x\n" + rows)
    code = main(["inspect", str(tmp_path / "log.csv"), "--out", str(tmp_path / "out")])
    err = capsys.readouterr().err
    assert code in (0, 2)
    assert "internal" not in err
    assert "Traceback" not in err


# --- robot files

ENGINES = {
    "pybullet": ("pybullet", "pendulum.urdf"),
    "mujoco": ("mujoco", "arm.xml"),
    "dart": ("dartpy", "pendulum.urdf"),
}


@pytest.mark.parametrize(
    "engine",
    [
        case(
            "pybullet", id="pybullet", marks=fault("a URDF for PyBullet is cut off anywhere", shows="the file and the reason")
        ),
        case("mujoco", id="mujoco", marks=fault("an MJCF is cut off anywhere", shows="the file and the reason")),
        case("dart", id="dart", marks=fault("a URDF for DART is cut off anywhere", shows="the file and the reason")),
    ],
)
def test_robot_files_that_are_cut_off(tmp_path, engine):
    package, name = ENGINES[engine]
    pytest.importorskip(package, reason=f"needs {package}")
    content = (ROOT / "specs" / "models" / name).read_bytes()
    config = gc.registry().config("backend", engine)
    joint = "hinge" if name.endswith("urdf") else "shoulder"
    given = {"kind": engine, "robot": name, "states": {"a": f"{joint}.position", "b": f"{joint}.velocity"}, "inputs": {}}
    given |= {"fixed_base": True} if engine != "mujoco" else {}
    for share in (0.0, 0.1, 0.5, 0.9, 0.99):
        (tmp_path / name).write_bytes(content[: int(share * len(content))])
        with pytest.raises(gc.UsageError, match=name):
            gc.registry().build("backend", engine, config.model_validate(given), gc.Context(tmp_path))


# --- run folders

READ = {
    "verify": ("certificate.json", "certificate.npz"),
    "report": ("summary.json", "figures.json", "figures.npz"),
    "check": ("certificate.json", "certificate.npz", "run.json", "spec.json"),
    "extend": ("summary.json",),
    "export": ("controller/with_gamma/controller.json", "controller/with_gamma/controller.npz"),
}
WRONG = [b"", b"[1, 2]", b"{}", b"null", b"[" * 50_000, b"PK\x03\x04", b"\xff\xfe", b'{"kind": 3, "claim": 1, "causes": 1}']


@pytest.mark.parametrize(
    "command",
    [
        case(
            "verify",
            id="verify",
            marks=fault("a certificate is cut off or holds something else", shows="the folder; run it again"),
        ),
        case("report", id="report", marks=fault("the summary or figures of a run are cut off", shows="the file; run it again")),
        case(
            "check",
            id="check",
            marks=fault("the files that a log is checked against are damaged", shows="the folder; run it again"),
        ),
        case("extend", id="extend", marks=fault("the summary of a diagnosis is damaged", shows="the folder; run it again")),
        case(
            "export",
            id="export",
            marks=fault("a saved controller is cut off or holds something else", shows="synthesize it again"),
        ),
    ],
)
def test_damaged_runs(run_folder, tmp_path, capsys, command):
    (tmp_path / "log.csv").write_text("t,theta,omega,torque\n" + "".join(f"{0.02 * k},0.1,0,0\n" for k in range(9)))
    more = {"check": [str(tmp_path / "log.csv")], "export": ["--to", "numpy", "--out", str(tmp_path / "program")]}.get(
        command, []
    )
    for name in READ[command]:
        path = run_folder / name
        content = path.read_bytes()
        for wrong in (*WRONG, content[: len(content) // 2]):
            path.write_bytes(wrong)
            before = contents(run_folder)
            if command == "report" and wrong == b"{}":
                continue  # an empty answer is an answer
            told(capsys, command, str(run_folder), *more)
            assert contents(run_folder) == before
        path.write_bytes(content)


@fault("a certificate was edited, or one of another version lies there", shows="verify says which check fails, exit 1")
def test_an_edited_certificate(run_folder, capsys):
    path = run_folder / "certificate.npz"
    content = bytearray(path.read_bytes())
    with np.load(path) as stored:
        arrays = {n: stored[n] for n in stored.files}
    arrays["lipschitz"] = arrays["lipschitz"] / 2
    np.savez(path, **arrays)
    told(capsys, "verify", str(run_folder), code=1)
    path.write_bytes(content)
    told(capsys, "verify", str(run_folder), code=0)
