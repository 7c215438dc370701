"""Targets of fuzzing: one function per kind of file that strangers give us, and mutations of real ones that keep their shape.

A target is given the bytes of one file and holds the rule: success or one sentence (a GapcertError), in time, and nothing
written outside of the folder that it was given.
"""

import contextlib
import io
import json
import os
import random
import re
import shutil
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from faults import LINE, TINY, soon
from odd_logs import drawn

import gapcert as gc
from gapcert.cli.main import main
from gapcert.numerics.errors import INTERNAL
from gapcert_recordings.inspect import inspect

ROOT = Path(__file__).parents[2]
FOUND = ROOT / "tests" / "fuzz" / "found"
SECONDS = 20
TOKENS = (ROOT / "tests" / "fuzz" / "words.txt").read_text().split()
ODD = (
    *(None, True, False, 0, -1, 1, 2, 10**9, 10**30, 0.5, -0.0, 1e308, 1e-308),
    *("", "x", "1 m", "nan", "\0", "\x1b[2J", "../..", "a" * 300, "9**9**9**9"),
    *([], {}, [[]], [None], {"": None}, {"kind": "x"}, {"kind": "equations"}, [1, 2, 3], ["x", "y"], {"a": {"b": {"c": 1}}}),
)

# --- mutations


def mutate(data: bytes, rng: random.Random) -> bytes:
    """A few changes: of a value in the tree where the text is JSON, of words where it is text, and of bytes."""
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        try:
            data = _tree(data, rng) if rng.random() < 0.6 else _text(data, rng)
        except (ValueError, RecursionError):
            data = _text(data, rng) if rng.random() < 0.5 else _bytes(data, rng)
    return data[: 1 << 20]


def _tree(data: bytes, rng: random.Random) -> bytes:
    tree = json.loads(data)
    places: list[tuple[object, object]] = []

    def walk(node: object) -> None:
        keys = node if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
        for key in keys:
            places.append((node, key))
            walk(node[key])

    walk(tree)
    if not places:
        return json.dumps(rng.choice(ODD)).encode()
    node, key = rng.choice(places)
    what = rng.randrange(5)
    if what == 0:
        del node[key]
    elif what == 1 and isinstance(node, dict):
        node[rng.choice(TOKENS)] = node.pop(key)
    elif what == 2:
        other, name = rng.choice(places)
        node[key] = json.loads(json.dumps(other[name]))
    elif what == 3 and isinstance(node[key], str):
        node[key] = _text(node[key].encode(), rng).decode("utf-8", "replace")
    else:
        node[key] = rng.choice(ODD)
    return json.dumps(tree).encode()


def _text(data: bytes, rng: random.Random) -> bytes:
    words = re.split(rb"([^A-Za-z0-9_.]+)", data)
    at = rng.randrange(len(words))
    what = rng.randrange(4)
    if what == 0:
        words[at] = rng.choice(TOKENS).encode()
    elif what == 1:
        words.insert(at, b" " + rng.choice(TOKENS).encode() + b" ")
    elif what == 2:
        del words[at : at + rng.randrange(1, 4)]
    else:
        words[at:at] = words[at : at + rng.randrange(1, 8)] * rng.choice((1, 2, 40))
    return b"".join(words)


def _bytes(data: bytes, rng: random.Random) -> bytes:
    if not data:
        return bytes(rng.randrange(256) for _ in range(8))
    made, at = bytearray(data), rng.randrange(len(data))
    what = rng.randrange(4)
    if what == 0:
        made[at] = rng.randrange(256)
    elif what == 1:
        made[at : at + 4] = rng.choice((b"\xff\xff\xff\xff", b"\0\0\0\0", b"\0\0\0\x80", b"\xff\xff\xff\x7f"))
    elif what == 2:
        del made[at : at + rng.choice((1, 4, 100, len(made)))]
    else:
        made[at:at] = made[: rng.randrange(1, 64)]
    return bytes(made)


# --- the rule


class _Watch:
    """Hears every file that is opened for writing, made or removed, every program and every connection, while it is on."""

    folder: Path | None = None
    heard: list[str]

    def __init__(self) -> None:
        self.heard = []
        sys.addaudithook(self)

    def __call__(self, event: str, arguments: tuple[object, ...]) -> None:
        if self.folder is None:
            return
        if event == "open":
            path, mode, flags = arguments
            writes = bool(set(mode or "") & set("wax+")) or bool(isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR))
            if writes and isinstance(path, str | bytes | os.PathLike):
                self._path(event, path)
        elif event in ("os.remove", "os.rmdir") and not os.path.isabs(os.fsdecode(arguments[0])):
            pass  # below an open folder, as shutil.rmtree does it
        elif event in ("os.mkdir", "os.remove", "os.rmdir", "os.truncate", "os.chmod"):
            self._path(event, arguments[0])
        elif event in ("os.rename", "os.symlink", "os.link"):
            self._path(event, arguments[1])
        elif event == "subprocess.Popen" and arguments[0] in ("pkg-config", "c++", "uname"):
            pass  # how backend gazebo and Python's `platform` look at the machine
        elif event in ("subprocess.Popen", "os.system", "os.exec", "socket.connect", "urllib.Request"):
            self.heard.append(f"{event} {arguments!r:.200}")

    def _path(self, event: str, path: object) -> None:
        text = os.fsdecode(path) if isinstance(path, str | bytes | os.PathLike) else ""
        allowed = ("/dev/null", "__pycache__", "matplotlib", "numba", "gapcert/verify")
        if re.fullmatch(r"[0-9a-f]{40}(\.[0-9a-f]{32})?", text):
            return  # a compiled kernel, below an open folder
        if text and not any(a in text for a in allowed) and not os.path.abspath(text).startswith(str(self.folder)):
            self.heard.append(f"{event} {text}")


_WATCH: list[_Watch] = []


def held(folder: Path, call: Callable[[], object]) -> None:
    """Run a call under the rule. Whatever breaks it is raised."""
    watch = _WATCH[0] if _WATCH else _Watch()
    _WATCH[:] = [watch]
    watch.heard, watch.folder = [], folder
    before, tempfile.tempdir = tempfile.tempdir, str(folder)
    try:
        with soon(SECONDS), contextlib.suppress(gc.GapcertError):
            call()
    finally:
        watch.folder, tempfile.tempdir = None, before
    assert not watch.heard, watch.heard


def command(folder: Path, *arguments: object) -> str:
    """Run a command under the rule: not 70, no traceback, a sentence where it fails. What it printed."""
    out, err = io.StringIO(), io.StringIO()

    def call() -> None:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main([*map(str, arguments), "--debug"])
        said = err.getvalue()
        assert code != INTERNAL, said
        assert code in (0, 1, 5) or said.strip(), f"exit {code} without a word"
        assert len(said) < 100_000, said[:1000]

    held(folder, call)
    return out.getvalue()


# --- targets


@dataclass(frozen=True)
class Target:
    """What is done with the bytes of a file, and real files to begin with."""

    run: Callable[[bytes, Path], None]
    seeds: Callable[[], list[bytes]]


def _spec(data: bytes, folder: Path) -> None:
    (folder / "spec.yaml").write_bytes(data)
    command(folder, "validate", folder / "spec.yaml")


def _specs() -> list[bytes]:
    from ruamel.yaml import YAML

    paths = [p for p in sorted(ROOT.glob("specs/**/*.yaml")) if p.stat().st_size < 6000]
    texts = [p.read_bytes() for p in paths]
    return [*texts, *(json.dumps(YAML(typ="safe").load(t)).encode() for t in texts), json.dumps(TINY).encode()]


def _none(constant: str) -> None:
    raise AssertionError(f"{constant} stands where a number should")


def _diagnosis(data: bytes, folder: Path) -> None:
    """A case of `odd_logs`: also no part of the answer may fail, and no number be none."""
    try:
        case = json.loads(data)
        spec, logs = json.dumps(case["spec"]), dict(case["logs"])
        asked = "inspect" if case["command"] == "inspect" else "diagnose"
    except (ValueError, TypeError, KeyError):
        return
    for name, text in logs.items():
        (folder / Path(str(name)).name[:99]).with_suffix(".csv").write_text(str(text), errors="replace")
    (folder / "spec.yaml").write_text(spec)
    printed = command(folder, asked, folder / "spec.yaml", "--out", folder / "runs", "--json")
    assert "could not be made" not in printed, printed[:3000]
    for text in (printed or "null", *(p.read_text() for p in folder.glob("runs/*/summary.json"))):
        json.loads(text, parse_constant=_none)
    shutil.rmtree(folder / "runs", ignore_errors=True)


def _cases() -> list[bytes]:
    model = gc.load_spec(TINY).build("model")
    model.fast_rollout(np.zeros((1, 1)), np.zeros((1, 2, 1)))  # makes the folder of compiled kernels
    return [json.dumps(drawn(seed)).encode() for seed in range(100)]


def _equation(data: bytes, folder: Path) -> None:
    text = data.decode("utf-8", "replace")

    def call() -> None:
        model = gc.load_spec({**TINY, "model": {**LINE, "parameters": {"a": "2"}, "next": {"x": text}}}).build("model")
        x = u = [[0.3], [-0.7]]
        model.step(x, u)
        model.jacobian(x, u)

    held(folder, call)


def _formula(data: bytes, folder: Path) -> None:
    from gapcert_cells.ltl import automaton_of

    held(folder, lambda: automaton_of(data.decode("utf-8", "replace")))


def _automaton(data: bytes, folder: Path) -> None:
    from gapcert_cells.hoa import read_hoa

    held(folder, lambda: read_hoa(data.decode("utf-8", "replace"), "a.hoa"))


def _unit(data: bytes, folder: Path) -> None:
    text = data.decode("utf-8", "replace")
    held(folder, lambda: gc.load_spec({**TINY, "model": {**LINE, "states": {"x": text}, "next": {"x": "x"}}}))
    held(folder, lambda: gc.load_spec({**TINY, "model": {**LINE, "period": text, "next": {"x": "x"}}}))


def _log(suffix: str) -> Callable[[bytes, Path], None]:
    def run(data: bytes, folder: Path) -> None:
        (folder / f"log.{suffix}").write_bytes(data)
        held(folder, lambda: inspect(folder / f"log.{suffix}"))

    return run


def _logs(suffix: str) -> Callable[[], list[bytes]]:
    def seeds() -> list[bytes]:
        t = np.arange(60) * 0.01
        with tempfile.TemporaryDirectory() as place:
            path = Path(place) / f"log.{suffix}"
            WRITERS[suffix](path, t)
            return [path.read_bytes()]

    return seeds


def _write_csv(path, t):
    path.write_text("t,x\n" + "".join(f"{a},{a * a}\n" for a in t))


def _write_parquet(path, t):
    import pyarrow
    from pyarrow import parquet

    parquet.write_table(pyarrow.table({"t": t, "x": t * t}), path)


def _write_hdf5(path, t):
    import h5py

    with h5py.File(path, "w") as file:
        file["t"], file["x"] = t, t * t


def _write_mat(path, t):
    from scipy.io import savemat

    savemat(path, {"t": t, "x": t * t, "s": {"y": t}})


def _write_mcap(path, t):
    from mcap.writer import CompressionType, Writer

    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start()
        schema = writer.register_schema("a/msg/B", "ros2msg", b"float64 x\nfloat64[2] y\n")
        channel = writer.register_channel("/a", "cdr", schema)
        for k in range(20):
            writer.add_message(channel, k, b"\0\1\0\0" + bytes(24), k)
        writer.finish()


WRITERS = {"csv": _write_csv, "parquet": _write_parquet, "h5": _write_hdf5, "mat": _write_mat, "mcap": _write_mcap}
_RUN: list[Path] = []


def finished() -> Path:
    """The folder of a finished run, made once."""
    if not _RUN:
        from importlib.util import module_from_spec, spec_from_file_location

        found = spec_from_file_location("shared", ROOT / "tests" / "conftest.py")
        shared = module_from_spec(found)
        found.loader.exec_module(shared)
        place = Path(tempfile.mkdtemp(prefix="gapcert-fuzz-"))
        _RUN.append(gc.run({**shared.SMALL, "report": {"rerun": False}}, out=place).folder)
        (place / "log.csv").write_text("t,theta,omega,torque\n" + "".join(f"{0.02 * k},0.1,0,0\n" for k in range(9)))
    return _RUN[0]


def _stored(name: str, *commands: str) -> Callable[[bytes, Path], None]:
    def run(data: bytes, folder: Path) -> None:
        origin, copy = finished(), folder / "run"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(origin, copy)
        (copy / name).write_bytes(data)
        if name == "summary.json":
            (copy / "figures.json").unlink()  # pictures take most of the time, and are looked at with figures.json
        more = {"check": [origin.parent / "log.csv"], "export": ["--to", "c", "--out", folder / "c"]}
        for one in commands:
            command(folder, one, copy, *more.get(one, []))

    return run


def _content(name: str) -> Callable[[], list[bytes]]:
    return lambda: [(finished() / name).read_bytes()]


def _controller(name: str) -> Callable[[bytes, Path], None]:
    def run(data: bytes, folder: Path) -> None:
        origin, copy = finished() / "controller" / "with_gamma", folder / "controller"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(origin, copy)
        (copy / name).write_bytes(data)
        held(folder, lambda: gc.load_controller(copy).act(np.array([[0.1, 0.0]]), "first"))
        command(folder, "export", copy, "--to", "c", "--out", folder / "c")

    return run


def _network(data: bytes, folder: Path) -> None:
    from gapcert_neural.exchange import load_onnx

    (folder / "net.onnx").write_bytes(data)
    held(folder, lambda: load_onnx(folder / "net.onnx"))


def _networks() -> list[bytes]:

    from gapcert_networks.network import Network
    from gapcert_neural.exchange import save_onnx

    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "net.onnx"
        rng = np.random.default_rng(0)
        save_onnx(Network((rng.normal(size=(3, 2)), rng.normal(size=(1, 3))), (np.zeros(3), np.zeros(1))), path)
        return [path.read_bytes()]


def _robot(engine: str, suffix: str) -> Callable[[bytes, Path], None]:
    def run(data: bytes, folder: Path) -> None:
        name = f"robot.{suffix}"
        (folder / name).write_bytes(data)
        joint = "shoulder" if suffix == "xml" else "hinge"
        given = {"kind": engine, "robot": name, "states": {"a": f"{joint}.position", "b": f"{joint}.velocity"}, "inputs": {}}
        given |= {} if engine == "mujoco" else {"fixed_base": True}
        config = gc.registry().config("backend", engine).model_validate(given)
        held(folder, lambda: gc.registry().build("backend", engine, config, gc.Context(folder, period=0.005)))

    return run


def _robots(engine: str, suffix: str) -> Callable[[], list[bytes]]:
    names = {"urdf": ["pendulum.urdf", "cube.urdf"], "xml": ["arm.xml", "cartpole.xml", "arm7.xml"], "sdf": ["pendulum.sdf"]}

    def seeds() -> list[bytes]:
        gc.registry().get("backend", engine).load()  # some engines start a program when they are imported
        return [(ROOT / "specs" / "models" / n).read_bytes() for n in names[suffix]]

    return seeds


def _words(*texts: str) -> Callable[[], list[bytes]]:
    return lambda: [t.encode() for t in texts]


HOA = """HOA: v1
States: 2
Start: 0
AP: 1 "a"
Acceptance: 1 Inf(0)
acc-name: Buchi
properties: deterministic complete
--BODY--
State: 0
[0] 1
[!0] 0
State: 1 {0}
[t] 1
--END--
"""
TARGETS = {
    "spec": Target(_spec, _specs),
    "diagnosis": Target(_diagnosis, _cases),
    "equation": Target(_equation, _words("0.5*x + u", "a*sin(x)**2 - exp(-x**2)/(1 + abs(u))", "min(x, sqrt(x**2 + 1))")),
    "unit": Target(_unit, _words("N*m", "kg*m^2/s^3", "5 ms", "rad/s", "9.81 m/s^2")),
    "formula": Target(_formula, _words("G F a && G F b && G !c", "(!a U b) | X (a -> F b)", "G (a -> F b)")),
    "automaton": Target(_automaton, _words(HOA)),
    **{suffix: Target(_log(suffix), _logs(suffix)) for suffix in WRITERS},
    "certificate": Target(_stored("certificate.json", "verify", "check"), _content("certificate.json")),
    "arrays": Target(_stored("certificate.npz", "verify", "check"), _content("certificate.npz")),
    "summary": Target(_stored("summary.json", "report", "extend"), _content("summary.json")),
    "figures": Target(_stored("figures.json", "report"), _content("figures.json")),
    "run": Target(_stored("run.json", "check"), _content("run.json")),
    "saved-spec": Target(_stored("spec.json", "check"), _content("spec.json")),
    "manifest": Target(_stored("samples/bound-0/manifest.jsonl", "verify"), _content("samples/bound-0/manifest.jsonl")),
    "shard": Target(_stored("samples/bound-0/chunk-000000.npy", "verify"), _content("samples/bound-0/chunk-000000.npy")),
    "controller": Target(_controller("controller.json"), _content("controller/with_gamma/controller.json")),
    "tables": Target(_controller("controller.npz"), _content("controller/with_gamma/controller.npz")),
    "onnx": Target(_network, _networks),
    "pybullet": Target(_robot("pybullet", "urdf"), _robots("pybullet", "urdf")),
    "mujoco": Target(_robot("mujoco", "xml"), _robots("mujoco", "xml")),
    "dart": Target(_robot("dart", "urdf"), _robots("dart", "urdf")),
    "dart-sdf": Target(_robot("dart", "sdf"), _robots("dart", "sdf")),
}
NATIVE = ("pybullet", "mujoco", "dart", "dart-sdf")
"""Parsers in C++, which may end the process: they are run in one of their own."""
