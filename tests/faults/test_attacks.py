"""What a stranger gives us, be it a spec, a log, a robot file or a run, runs no code, writes nowhere else and ends.

Every attack has a canary that would sing: each test shows that too, by what Gapcert does not do.
"""

import json
import os
import pickle
import shutil
import subprocess
import sys
import zipfile
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from faults import LINE, TINY, clean, contents, gapcert, soon, told, written
from forgeries import Forger, Forgery

import gapcert as gc
from gapcert.cli.main import main

attack, case = pytest.mark.attack, pytest.param


@pytest.fixture
def canary(tmp_path):
    """A file that is there if foreign code ran; delete it to listen once more."""
    return tmp_path / "canary"


@pytest.fixture
def foreign(tmp_path, canary):
    """A module beside the spec that sings when it is imported, and the model that names it."""
    (tmp_path / "foreign.py").write_text(
        f"from pathlib import Path\nPath({str(canary)!r}).touch()\ndef step(x, u):\n    return 0.5 * x + u\n"
    )
    return {"kind": "python", "function": "foreign:step", "states": {"x": "1"}, "inputs": {"u": "1"}, "period": "1 s"}


# --- specs


@pytest.mark.parametrize(
    "text",
    [
        case(
            "!!python/object/apply:os.mkdir [CANARY]",
            id="apply",
            marks=attack("YAML tag", "`!!python/object/apply` of a function"),
        ),
        case("!!python/object/new:os.mkdir [CANARY]", id="new", marks=attack("YAML tag", "`!!python/object/new` of a class")),
        case("!!python/name:foreign.step ''", id="name", marks=attack("YAML tag", "`!!python/name`, which imports a module")),
    ],
)
def test_tags(tmp_path, capsys, canary, foreign, monkeypatch, text):
    yaml = pytest.importorskip("yaml", reason="PyYAML is what would obey a tag")
    monkeypatch.syspath_prepend(str(tmp_path))
    sys.modules.pop("foreign", None)
    tag = text.replace("CANARY", str(canary))
    spec = tmp_path / "spec.yaml"
    spec.write_text(f"version: 1\nname: {tag}\n")
    told(capsys, "validate", str(spec), says="is not allowed")
    assert not canary.exists()
    assert "foreign" not in sys.modules
    yaml.unsafe_load(spec.read_text())
    assert canary.exists()


PLACES = {
    "model": lambda f: {**TINY, "model": f},
    "backend": lambda f: {**TINY, "backend": f},
    "extends": lambda f: {"extends": "base.yaml"},
    "matrix": lambda f: {**TINY, "matrix": {"backend": [TINY["backend"], f]}},
    "compare": lambda f: {
        **{k: v for k, v in TINY.items() if k not in ("backend", "gap", "lipschitz")},
        "compare": {
            "backends": {"a": TINY["backend"], "b": f},
            "families": [{"kind": "constant"}],
            "lipschitz": [{"kind": "interval"}],
        },
    },
    "of": lambda f: {
        **TINY,
        "backend": {"kind": "stochastic", "of": f, "sensor_noise": {"x": 0.1}},
        "certificate": {"claim": "statistical", "route": "calibrate", "violation": 0.05, "confidence": 0.99},
    },
    "reality": lambda f: {
        **{k: v for k, v in TINY.items() if k in ("version", "name", "model", "domain", "report")},
        "reality": f, "play": {"seconds": "50 s"}, "diagnose": {"hold_out": {"last": "33 %"}, "horizons": ["5 s"]},
    },
}  # fmt: skip


@pytest.mark.exam
@pytest.mark.parametrize(
    "place",
    [
        case("model", id="model", marks=attack("`model`", "a Python function")),
        case("backend", id="backend", marks=attack("`backend`", "a Python function")),
        case("extends", id="extends", marks=attack("`extends`", "a Python function in the file that is extended")),
        case("matrix", id="matrix", marks=attack("`matrix`", "a Python function as one of the values")),
        case("compare", id="compare", marks=attack("`compare.backends`", "a Python function among the backends")),
        case("of", id="of", marks=attack("`backend.of`", "a Python function inside a wrapper")),
        case("reality", id="reality", marks=attack("`reality`", "a Python function that is to be diagnosed")),
    ],
)
def test_code_needs_permission(tmp_path, capsys, canary, foreign, place):
    if place == "extends":
        written(tmp_path, {**TINY, "name": "base"}, model=foreign)
    spec = tmp_path / "spec.yaml"
    spec.write_text(json.dumps(PLACES[place](foreign)))
    main(["validate", str(spec)])
    assert not canary.exists()
    told(capsys, "run", str(spec), "--out", str(tmp_path / "runs"), "--quiet", says="--allow-code")
    assert not canary.exists()
    main(["run", str(spec), "--out", str(tmp_path / "runs"), "--quiet", "--allow-code"])
    assert canary.exists()


@attack("`--set`", "a Python function on the command line, as a script that is passed around may have it")
def test_code_on_the_command_line(tmp_path, capsys, canary, foreign):
    command = [
        "run",
        str(written(tmp_path)),
        "--out",
        str(tmp_path / "runs"),
        "--quiet",
        "--set",
        f"backend={json.dumps(foreign)}",
    ]
    told(capsys, *command, says="--allow-code")
    assert not canary.exists()
    main([*command, "--allow-code"])
    assert canary.exists()


EXPRESSIONS = {
    "call": "__import__('pathlib').Path({!r}).touch() or x",
    "attribute": "().__class__.__base__.__subclasses__() and open({!r}, 'w').close()",
    "lambda": "(lambda: open({!r}, 'w').close())()",
    "comprehension": "[open(p, 'w').close() for p in [{!r}]]",
    "walrus": "(y := open({!r}, 'w').close())",
    "format": "f\"{{open({!r}, 'w').close()}}\"",
    "look-alike": "ｏｐｅｎ({!r}, 'w').close()",
}


@pytest.mark.parametrize(
    "how",
    [
        case("call", id="call", marks=attack("equations", "`__import__`")),
        case("attribute", id="attribute", marks=attack("equations", "attributes up to `__subclasses__`")),
        case("lambda", id="lambda", marks=attack("equations", "a lambda")),
        case("comprehension", id="comprehension", marks=attack("equations", "a comprehension")),
        case("walrus", id="walrus", marks=attack("equations", "an assignment expression")),
        case("format", id="format", marks=attack("equations", "a format string")),
        case("look-alike", id="look-alike", marks=attack("equations", "letters that Python reads as others (ｏｐｅｎ)")),
    ],
)
@pytest.mark.parametrize("place", ["next", "relation", "basis", "unit", "parameter"])
def test_expressions(tmp_path, capsys, canary, how, place):
    text = EXPRESSIONS[how].format(str(canary))
    model = {**LINE, "next": {"x": "0.5*x + u"}, "parameters": {"a": "1"}}
    spec = {
        "next": {"model": {**model, "next": {"x": text}}},
        "relation": {"relations": [f"{text} <= 1"]},
        "basis": {"gap": {"kind": "basis", "functions": [text]}},
        "unit": {"model": {**model, "states": {"x": text}}},
        "parameter": {"model": {**model, "parameters": {"a": text}}},
    }[place]
    told(capsys, "validate", str(written(tmp_path, **spec)), says="error")
    assert not canary.exists()
    eval(text, {"x": 0})
    assert canary.exists()


@attack("equations", "powers and products that take for ever (`9**9**9**9`, `1e9` factors)")
@pytest.mark.parametrize(
    "text", ["9**9**9**9", "x**1e9", "(x + 1)**(10**8)", "+".join(["x"] * 20_000), "(" * 5000 + "x" + ")" * 5000]
)
def test_expressions_that_grow(tmp_path, capsys, text):
    with soon():
        told(capsys, "validate", str(written(tmp_path, model={**LINE, "next": {"x": text}})), says="error")


@pytest.mark.exam
@attack("units", "powers that take for ever (`rad**9**9**9`)")
@pytest.mark.parametrize("text", ["m**9**9**9", "m^99999999999", "9**9**9**9 m", "m " * 5000])
def test_units_that_grow(tmp_path, text):
    clean(
        gapcert("validate", written(tmp_path, model={**LINE, "states": {"x": text}, "next": {"x": "u"}}), limit=30), 2, "error"
    )


@attack("`expect`", "a path of attributes (`__class__.__init__.__globals__`)")
def test_expectations_look_into_the_summary_only(tmp_path, capsys):
    expect = {"certificate.__class__.__init__.__globals__.keys": 1, "name.__class__": "str", "verdict": "holds"}
    assert main(["run", str(written(tmp_path, expect=expect)), "--out", str(tmp_path / "runs"), "--quiet", "--json"]) in (1, 2)
    out = capsys.readouterr()
    assert "internal" not in out.err
    found = {e["text"]: e["met"] for e in json.loads(out.out).get("expectations", [])}
    assert sum(found.values()) <= 1


@pytest.mark.parametrize(
    "name",
    [
        case("../outside", id="parent", marks=attack("`name`", "a folder elsewhere (`../`)")),
        case("/tmp/outside", id="absolute", marks=attack("`name`", "an absolute path")),
        case("a\nb\x1b[2J", id="terminal", marks=attack("`name`", "line breaks and escape sequences")),
    ],
)
def test_names(tmp_path, capsys, name):
    (tmp_path / "in").mkdir()
    spec = tmp_path / "in" / "spec.yaml"
    spec.write_text(json.dumps({**TINY, "name": name}))
    before = set(tmp_path.rglob("*"))
    err = told(capsys, "run", str(spec), "--out", str(tmp_path / "in" / "runs"), says="expected lower-case letters")
    assert "\x1b" not in err
    assert set(tmp_path.rglob("*")) == before
    assert (tmp_path / "in" / "runs" / name).resolve() != tmp_path / "in" / "runs"


@pytest.mark.run
@pytest.mark.parametrize(
    "field",
    [
        case("recording", id="recording", marks=attack("`recording.files`", "a pipe or device, which never ends")),
        case("robot", id="robot", marks=attack("`backend.robot`", "a pipe or device, which never ends")),
        case("extends", id="extends", marks=attack("`extends`", "a pipe or device, which never ends")),
        case("automaton", id="automaton", marks=attack("`goal.automaton`", "a pipe or device, which never ends")),
    ],
)
def test_what_never_ends(tmp_path, capsys, field):
    os.mkfifo(tmp_path / "pipe.csv")
    for name in ("pipe.csv", "/dev/zero", "/proc/self/mem", "/dev/stdin"):
        spec = {
            "recording": {"recording": {"kind": "csv", "files": [name], "columns": {"x": "x", "u": "u"}}, "diagnose": {}},
            "robot": {"backend": {"kind": "mujoco", "robot": name, "states": {"x": "a.position"}, "inputs": {}}},
            "extends": {"extends": name},
            "automaton": {"controller": {"kind": "symbolic", "goal": {"automaton": name, "regions": {}}, "cells": {"x": 4}}},
        }[field]
        with soon():
            told(capsys, "validate", str(written(tmp_path, **spec)), says=Path(name).name)
    with pytest.raises(subprocess.TimeoutExpired):
        subprocess.run(["cat", tmp_path / "pipe.csv"], timeout=0.3, check=False)


@attack("paths", "`~`, `$HOME`, `file://` and `http://`, which another program might follow")
@pytest.mark.parametrize("name", ["~/log.csv", "$HOME/log.csv", "file://HERE/log.csv", "http://127.0.0.1:PORT/log.csv"])
def test_paths_are_paths(tmp_path, capsys, monkeypatch, name):
    import socket

    (tmp_path / "log.csv").write_text("t,x,u\n0,0,0\n1,0,0\n")
    monkeypatch.setenv("HOME", str(tmp_path))
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.2)
        port = str(server.getsockname()[1])
        name = name.replace("HERE", str(tmp_path)).replace("PORT", port)
        (tmp_path / "in").mkdir()
        spec = written(
            tmp_path / "in", recording={"kind": "csv", "files": [name], "columns": {"x": "x", "u": "u"}}, diagnose={}
        )
        told(capsys, "validate", str(spec), says="no file")
        told(capsys, "inspect", name, says="no such file")
        with pytest.raises(TimeoutError):
            server.accept()
        with socket.create_connection(("127.0.0.1", int(port))):
            server.accept()[0].close()


# --- logs


@attack("HDF5", "values in another file (external storage, virtual data), which would come into a report")
def test_logs_name_no_other_file(tmp_path, capsys):
    h5py = pytest.importorskip("h5py", reason="needs the readers extra")
    secret = np.arange(9.0) + 1234.5
    (tmp_path / "secret.bin").write_bytes(secret.tobytes())
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = secret
    for name in ("external", "virtual"):
        with h5py.File(tmp_path / f"{name}.h5", "w") as file:
            file["t"] = np.arange(9.0)
            if name == "external":
                file.create_dataset("x", (9,), "f8", external=[(str(tmp_path / "secret.bin"), 0, 72)])
            else:
                layout = h5py.VirtualLayout((9,), "f8")
                layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "x", (9,))
                file.create_virtual_dataset("x", layout)
        with h5py.File(tmp_path / f"{name}.h5") as file:
            assert (file["x"][()] == secret).all()
        told(capsys, "inspect", str(tmp_path / f"{name}.h5"), "--out", str(tmp_path / "out"), says="in another file")
    assert not (tmp_path / "out").exists()


@pytest.mark.exam
@attack("HDF5", "a file of 2 KB that states 8 TB of values")
def test_logs_state_no_size_that_they_lack(tmp_path):
    h5py = pytest.importorskip("h5py", reason="needs the readers extra")
    with h5py.File(tmp_path / "huge.h5", "w") as file:
        file.create_dataset("t", (10**12,), "f8", chunks=(1000,))
    clean(gapcert("inspect", tmp_path / "huge.h5", "--out", tmp_path / "out"), 2, "states 8,000,000,000,000 bytes")
    with h5py.File(tmp_path / "huge.h5") as file:
        assert file["t"].nbytes == 8 * 10**12


@attack("MCAP", "a definition of messages that is Python")
def test_definitions_of_messages_are_no_code(tmp_path, capsys, canary):
    pytest.importorskip("mcap", reason="needs the readers extra")
    from mcap.writer import Writer

    touch = f"open('{canary}', 'w').close()"
    for text in (f"float64[{touch}] x\n", f"float64 X={touch}\nfloat64 y\n", f"float64 x); {touch} #\n"):
        with (tmp_path / "log.mcap").open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            schema = writer.register_schema("a/B", "ros2msg", text.encode())
            channel = writer.register_channel("/a", "cdr", schema)
            writer.add_message(channel, 0, b"\0\1\0\0" + b"\0" * 8, 0)
            writer.finish()
        capsys.readouterr()
        main(["inspect", str(tmp_path / "log.mcap"), "--out", str(tmp_path / "out")])
        assert "internal" not in capsys.readouterr().err
        assert not canary.exists()
    exec(touch)
    assert canary.exists()


@pytest.mark.exam
@attack("logs", "escape sequences in the names of columns, which a terminal would obey")
def test_columns_do_not_write_to_the_terminal(tmp_path, capsys):
    (tmp_path / "log.csv").write_text("t,\x1b]0;owned\x07\x1b[2Jx\u202e\n0,1\n1,2\n2,3\n")
    told(capsys, "inspect", str(tmp_path / "log.csv"), "--out", str(tmp_path / "out"), code=0)
    main(["inspect", str(tmp_path / "log.csv"), "--out", str(tmp_path / "out")])
    out = capsys.readouterr().out
    assert "owned" in out
    assert not {"\x1b", "\x07", "\u202e"} & set(out)


@attack("logs", "markup and scripts in the names of columns, which a report would show")
def test_columns_do_not_write_into_the_report(tmp_path):
    name = "<img src=x onerror=alert(1)></title><script>alert(2)</script>"
    (tmp_path / "log.csv").write_text(f't,"{name}"\n0,1\n1,2\n2,3\n')
    assert main(["inspect", str(tmp_path / "log.csv"), "--out", str(tmp_path / "out")]) == 0
    page = next((tmp_path / "out").rglob("report.html")).read_text()
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert(2)" in page
    assert "<img" not in page
    assert "&lt;script&gt;" in page


# --- robot files

LIBRARY = '#include <stdio.h>\n__attribute__((constructor)) void sing(void) {{ fclose(fopen("{}", "w")); }}\n'
MODELS = {
    "mjcf plugin": '<mujoco><extension><plugin plugin="LIB"/></extension><worldbody/></mujoco>',
    "mjcf library": '<mujoco><extension><plugin plugin="x" library="LIB"/></extension><worldbody/></mujoco>',
    "sdf plugin": '<sdf version="1.7"><model name="m"><plugin name="p" filename="LIB"/><link name="a"/></model></sdf>',
    "sdf include": '<sdf version="1.7"><world name="w"><include><uri>URL</uri></include></world></sdf>',
    "urdf mesh": '<robot name="r"><link name="a"><collision><geometry><mesh filename="URL/a.obj"/></geometry></collision>'
    "</link></robot>",
    "urdf plugin": '<robot name="r"><link name="a"/><gazebo><plugin name="p" filename="LIB"/></gazebo></robot>',
    "entity": '<!DOCTYPE r [<!ENTITY x SYSTEM "URL/secret">]><robot name="r"><link name="&x;"/></robot>',
}


@pytest.mark.run
@pytest.mark.parametrize(
    "how",
    [
        case("mjcf plugin", id="mjcf plugin", marks=attack("MJCF", "`<extension><plugin>` of a library")),
        case("mjcf library", id="mjcf library", marks=attack("MJCF", "`library` of a plugin")),
        case("sdf plugin", id="sdf plugin", marks=attack("SDF", "`<plugin filename>`, which a simulator would load")),
        case("sdf include", id="sdf include", marks=attack("SDF", "`<include><uri>` of an address")),
        case("urdf mesh", id="urdf mesh", marks=attack("URDF", "a mesh at an address")),
        case("urdf plugin", id="urdf plugin", marks=attack("URDF", "`<gazebo><plugin>` of a library")),
        case("entity", id="entity", marks=attack("XML", "an external entity at an address")),
    ],
)
def test_robot_files(tmp_path, canary, how):
    import ctypes
    import socket

    if shutil.which("cc") is None:
        pytest.skip("needs a C compiler for the library that sings")
    (tmp_path / "sing.c").write_text(LIBRARY.format(canary))
    library = tmp_path / "libsing.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, tmp_path / "sing.c"], check=True)
    engines = {
        "mjcf": ["mujoco"],
        "sdf": ["dart", "gazebo"],
        "urdf": ["pybullet", "mujoco", "dart"],
        "entity": ["pybullet", "mujoco", "dart"],
    }
    suffix = {"mjcf": "xml", "sdf": "sdf"}.get(how.split()[0], "urdf")
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.1)
        url = f"http://127.0.0.1:{server.getsockname()[1]}"
        (tmp_path / f"m.{suffix}").write_text(MODELS[how].replace("LIB", str(library)).replace("URL", url))
        tried = 0
        for engine in engines[how.split()[0]]:
            if gc.registry().get("backend", engine).missing() is not None:
                continue
            given = {"kind": engine, "robot": f"m.{suffix}", "states": {"a": "j.position"}, "inputs": {}}
            given |= {"fixed_base": True} if engine != "mujoco" else {}
            config = gc.registry().config("backend", engine).model_validate(given)
            with pytest.raises(gc.GapcertError):
                gc.registry().build("backend", engine, config, gc.Context(tmp_path))
            tried += 1
        if not tried:
            pytest.skip("none of the engines that read such a file is installed")
        assert not canary.exists()
        with pytest.raises(TimeoutError):
            server.accept()
        with socket.create_connection(server.getsockname()):
            server.accept()[0].close()
    ctypes.CDLL(str(library))
    assert canary.exists()


@pytest.mark.exam
@attack("XML", "entities that stand for 10⁹ others (billion laughs)")
@pytest.mark.parametrize("engine", ["pybullet", "dart", "mujoco"])
def test_entities_do_not_multiply(tmp_path, engine):
    if gc.registry().get("backend", engine).missing() is not None:
        pytest.skip(f"needs {engine}")
    entities = '<!ENTITY a0 "laugh">' + "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 10))
    (tmp_path / "m.urdf").write_text(f'<!DOCTYPE r [{entities}]><robot name="r"><link name="&a9;"/></robot>')
    given = {"kind": engine, "robot": "m.urdf", "states": {"x": "j.position"}, "inputs": {}}
    given |= {"fixed_base": True} if engine != "mujoco" else {}
    clean(gapcert("run", written(tmp_path, backend=given), "--out", tmp_path / "runs", limit=30), 2, "m.urdf")


# --- run folders and controllers


class Sing:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def with_pickle(path: Path, canary: Path) -> None:
    """Put a pickled object where an array is expected."""
    stream = BytesIO()
    np.lib.format.write_array(stream, np.array([Sing(canary)], dtype=object), allow_pickle=True)
    if path.suffix == ".npy":
        path.write_bytes(stream.getvalue())
        return
    with zipfile.ZipFile(path) as old:
        names = old.namelist()
    with zipfile.ZipFile(path, "w") as new:
        for name in names:
            new.writestr(name, stream.getvalue())


@pytest.mark.parametrize(
    ("name", "command"),
    [
        case("certificate.npz", "verify", id="certificate", marks=attack("certificate.npz", "a pickled object for an array")),
        case("figures.npz", "report", id="figures", marks=attack("figures.npz", "a pickled object for an array")),
        case(
            "controller/with_gamma/controller.npz",
            "export",
            id="controller",
            marks=attack("controller.npz", "a pickled object"),
        ),
        case("samples/bound-0/points.npy", "verify", id="points", marks=attack("points.npy", "a pickled object for an array")),
        case(
            "samples/bound-0/chunk-000000.npy", "verify", id="shard", marks=attack("a shard", "a pickled object for an array")
        ),
    ],
)
def test_pickles(run_folder, tmp_path, capsys, canary, name, command):
    with_pickle(run_folder / name, canary)
    more = ["--to", "numpy", "--out", str(tmp_path / "out")] if command == "export" else []
    assert main([command, str(run_folder), *more]) in (1, 2)
    assert "internal" not in capsys.readouterr().err
    assert not canary.exists()
    loaded = np.load(run_folder / name, allow_pickle=True)
    assert loaded is not None
    if name.endswith("npz"):
        [loaded[n] for n in loaded.files]
        loaded.close()
    assert canary.exists()


@attack("a run folder", "a pickled object in a shard of a run that is resumed, named by its manifest")
def test_pickles_in_a_run_that_goes_on(tiny_folder, tmp_path, capsys, canary):
    import hashlib

    folder = tiny_folder / "samples" / "bound-0"
    with_pickle(folder / "chunk-000000.npy", canary)
    lines = [json.loads(line) for line in (folder / "manifest.jsonl").read_text().splitlines()]
    for line in lines[1:]:
        if line["chunk"] == 0:
            line["sha256"] = hashlib.sha256((folder / "chunk-000000.npy").read_bytes()).hexdigest()
    (folder / "manifest.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    told(capsys, "run", str(written(tmp_path)), "--out", str(tmp_path / "runs"), "--quiet", says="is no shard of this round")
    assert not canary.exists()
    np.load(folder / "chunk-000000.npy", allow_pickle=True)
    assert canary.exists()


@pytest.mark.parametrize(
    ("inside", "victim"),
    [
        case("run.lock", "file", id="lock", marks=attack("a run folder", "a link for the lock, which would empty its target")),
        case("summary.json", "file", id="summary", marks=attack("a run folder", "a link for a file that is written")),
        case("samples", "folder", id="samples", marks=attack("a run folder", "a link for a folder, to write elsewhere")),
    ],
)
def test_links(tiny_folder, tmp_path, capsys, inside, victim):
    target = tmp_path / "victim"
    target.write_text("precious") if victim == "file" else target.mkdir()
    path = tiny_folder / inside
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    path.symlink_to(target)
    told(capsys, "run", str(written(tmp_path)), "--out", str(tmp_path / "runs"), says="is a link, through which")
    assert target.read_text() == "precious" if victim == "file" else list(target.iterdir()) == []
    (path / "x" if victim == "folder" else path).write_text("through")
    assert "through" in [p.read_text() for p in (target.iterdir() if victim == "folder" else [target])]


@pytest.mark.exam
@attack("a run folder", "a link where a temporary file of a report will be")
def test_links_for_temporary_files(run_folder, tmp_path, capsys):
    target = tmp_path / "victim"
    target.write_text("precious")
    (run_folder / f"report.html.{os.getpid()}.tmp").symlink_to(target)
    told(capsys, "report", str(run_folder), code=0)
    assert target.read_text() == "precious"
    assert (run_folder / "report.html").stat().st_size > 1000


@attack(
    "a saved controller", "a class that deletes a file when it is let go (`tempfile`'s), reached through a module of Gapcert"
)
def test_classes_that_are_reached_through_modules(tmp_path):
    pytest.importorskip("clarabel", reason="needs the mpc extra")
    import gc as garbage
    import tempfile

    from gapcert_mpc.saved_models import again

    victim = tmp_path / "victim"
    victim.touch()
    has = {"file": {"object": "io:BytesIO", "has": {}}, "name": str(victim), "delete": True}
    for name in (
        "gapcert_engines.silence:tempfile._TemporaryFileCloser",
        "tempfile:_TemporaryFileCloser",
        "gapcert.certification.samples.store:os",
    ):
        with pytest.raises(ValueError, match="it names"):
            again({"object": name, "has": {**has, "file": None}}, {})
    garbage.collect()
    assert victim.exists()
    closer = object.__new__(tempfile._TemporaryFileCloser)
    vars(closer).update({**has, "file": BytesIO()})
    del closer
    garbage.collect()
    assert not victim.exists()


@pytest.mark.parametrize(
    "kind",
    [
        case("foreign:step", id="module", marks=attack("a saved controller", "its `kind` names a module")),
        case("../../foreign", id="path", marks=attack("a saved controller", "its `kind` is a path")),
    ],
)
def test_kinds_of_controllers(run_folder, tmp_path, capsys, canary, foreign, monkeypatch, kind):
    monkeypatch.syspath_prepend(str(tmp_path))
    sys.modules.pop("foreign", None)
    place = run_folder / "controller" / "with_gamma"
    data = json.loads((place / "controller.json").read_text())
    (place / "controller.json").write_text(json.dumps({**data, "kind": kind}))
    capsys.readouterr()
    assert main(["export", str(run_folder), "--to", "c", "--out", str(tmp_path / "c")]) in (2, 3)
    assert "internal" not in capsys.readouterr().err
    assert not canary.exists()
    __import__("foreign")
    assert canary.exists()


@pytest.mark.run
@attack("a saved controller", "a state's name that ends the comment in the C program and is C")
def test_names_in_a_program(run_folder, tmp_path, capsys):
    from dataclasses import replace

    if shutil.which("cc") is None:
        pytest.skip("needs a C compiler")
    made = gc.load_controller(run_folder / "controller" / "with_gamma")
    evil = "x */ int owned = 1; /*"
    stay = made.goal.stay
    axes = (replace(stay.axes[0], name=evil), *stay.axes[1:])
    goal = replace(made.goal, stay=replace(stay, axes=axes))
    replace(made, goal=goal).save(run_folder / "controller" / "with_gamma")
    told(capsys, "export", str(run_folder), "--to", "c", "--out", str(tmp_path / "c"), code=0)
    header = (tmp_path / "c" / "controller.h").read_text()
    assert "owned" in header
    command = ["cc", "-fpreprocessed", "-dD", "-E", "-P"]
    for text, found in ((header, False), (header.replace("* /", "*/").replace("/ *", "/*"), True)):
        (tmp_path / "one.c").write_text(text)
        left = subprocess.run([*command, tmp_path / "one.c"], capture_output=True, text=True, check=True).stdout
        assert ("owned" in left) is found


@attack("a saved run", "its model is Python, and a log is checked against it")
def test_a_run_whose_model_is_code(run_folder, tmp_path, capsys, canary, foreign):
    data = json.loads((run_folder / "spec.json").read_text())
    # It has the names of the model that it replaces: what is refused is that it is code.
    of = {k: data["model"][k] for k in ("states", "inputs", "period")}
    (run_folder / "spec.json").write_text(json.dumps({**data, "model": {**foreign, **of}}))
    mark = json.loads((run_folder / "run.json").read_text())
    (run_folder / "run.json").write_text(json.dumps({**mark, "folder": str(tmp_path)}))
    Forger(np.random.default_rng(0)).mend(run_folder, Forgery("spec.json:model"))
    assert not canary.exists()
    (tmp_path / "log.csv").write_text("t,x,u\n0,0,0\n1,0,0\n")
    told(capsys, "check", str(run_folder), str(tmp_path / "log.csv"), says="--allow-code")
    assert not canary.exists()
    main(["check", str(run_folder), str(tmp_path / "log.csv"), "--allow-code"])
    assert canary.exists()


@pytest.mark.exam
@attack("a saved run", "markup and scripts in its summary, which a report would show")
def test_summaries_do_not_write_into_the_report(run_folder, capsys):
    path = run_folder / "summary.json"
    script = "<script>alert(1)</script>"
    text = path.read_text()
    summary = json.loads(text)
    summary |= {"name": script, "reason": script}
    summary["certificate"]["assumptions"] = [script]
    path.write_text(json.dumps(summary))
    told(capsys, "report", str(run_folder), code=0)
    page = (run_folder / "report.html").read_text()
    assert "alert(1)" in page
    assert "<script>alert(1)" not in page


@pytest.mark.exam
@attack("a saved run", "an .npz of 1 KB whose array states 8 TB")
def test_archives_state_no_size_that_they_lack(run_folder):
    stream = BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    with zipfile.ZipFile(run_folder / "certificate.npz", "w") as file:
        file.writestr("gap.z.npy", stream.getvalue())
    clean(gapcert("verify", run_folder), 2, "the certificate cannot be read")


UNSAFE = ("pickle.load", "allow_pickle=True", "joblib.load", "torch.load", "shelve.", "marshal.")


@attack("pickles", "what workers get travels between processes; of files, only what was compiled for this user")
def test_no_file_of_a_stranger_is_unpickled():
    root = Path(gc.__file__).parents[1]
    loads = [
        f"{path.relative_to(root)}:{n}"
        for path in (*root.rglob("*.py"), *root.parent.glob("plugins/**/*.py"))
        for n, line in enumerate(path.read_text().splitlines(), 1)
        if "testing" not in path.parts and any(word in line for word in UNSAFE)
    ]
    assert sorted(name.rpartition(":")[0] for name in loads) == [
        *["gapcert/certification/gates/purity.py"] * 2,
        "gapcert/certification/samples/store.py",
        "gapcert/numerics/kernels.py",  # test_kernels: from a folder and a file that this user owns and nobody else can write
    ]
    assert pickle.loads(pickle.dumps(1)) == 1


def test_nothing_else_was_changed_by_what_was_refused(run_folder, tmp_path, capsys):
    before = contents(run_folder)
    told(capsys, "verify", str(run_folder), code=0)
    assert contents(run_folder) == before
