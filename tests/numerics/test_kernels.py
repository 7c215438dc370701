"""What Numba compiles is kept for the next process, by text, versions and processor, and only where nobody else can write."""

import ast
import importlib
import io
import os
import re
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

import gapcert
from gapcert.cli.terminal import Terminal
from gapcert.numerics import kernels

CALLEE = (
    "from gapcert.plugin import compiler\n\nSCALE = 3\ncompiled = compiler(nogil=True)\n\n"
    "@compiled\ndef scaled(x):\n    return SCALE * x\n"
)
CALLER = "from .callee import compiled, scaled\n\n@compiled\ndef answer(x):\n    return scaled(x) + 1\n"


@pytest.fixture
def made(tmp_path, monkeypatch):
    """Imports a package of two kernels as a new process would, and computes with it: (the answer, whether it was compiled)."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.syspath_prepend(tmp_path)
    package = tmp_path / "kernels_of_a_test"
    package.mkdir()
    for name, text in (("__init__", ""), ("callee", CALLEE), ("caller", CALLER)):
        (package / f"{name}.py").write_text(text)

    def compute(x=2):
        for name in [n for n in sys.modules if n.startswith(package.name)]:
            monkeypatch.delitem(sys.modules, name)
        for known in (kernels._digest, kernels._folder):
            known.cache_clear()
        answer = importlib.import_module(f"{package.name}.caller").answer
        return answer(x), not answer.stats.cache_hits

    return compute


@pytest.fixture
def folders(tmp_path):
    """The folders of what is kept, of all texts."""
    return lambda: sorted((tmp_path / "cache" / "gapcert" / "kernels").iterdir())


def test_what_is_compiled_once_is_not_compiled_again(made, folders):
    assert [made(), made()] == [(7, True), (7, False)]
    assert made(2.0) == (7.0, True)
    (folder,) = folders()
    assert {oct(f.stat().st_mode & 0o777) for f in (folder, folder.parent, folder.parent.parent)} == {"0o700"}
    assert [oct(f.stat().st_mode & 0o777) for f in folder.iterdir()] == ["0o600"] * 4


def test_one_serves_all_numbers_that_its_callers_write():
    compiled = kernels.compiler()

    @compiled
    def times(x, k):
        return x * k

    @compiled
    def five(x):
        return times(x, 2) + times(x, 3)

    assert five(1.5) == 7.5
    assert times.signatures == [(numba.float64, numba.int64)]


def test_one_that_asks_for_the_number_gets_it():
    compiled = kernels.compiler()

    @compiled
    def entry(pair, k):
        return pair[numba.literally(k)]

    @compiled
    def total(pair):
        return entry(pair, 0) + entry(pair, 1)

    assert total((1, 2.5)) == 3.5


def test_a_kernel_goes_by_the_text_of_what_it_calls_whatever_the_clock_says(made, folders, tmp_path):
    assert made() == (7, True)
    callee = tmp_path / "kernels_of_a_test" / "callee.py"
    before = callee.stat()
    callee.write_text(CALLEE.replace("SCALE = 3", "SCALE = 5"))
    os.utime(callee, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert callee.stat().st_size == before.st_size
    assert made() == (11, True)
    assert len(folders()) == 2
    callee.write_text(CALLEE)
    assert made() == (7, False)


def test_a_module_that_is_imported_again_with_another_text_is_compiled_again(made, tmp_path):
    assert made() == (7, True)
    module = sys.modules["kernels_of_a_test.callee"]
    (tmp_path / "kernels_of_a_test" / "callee.py").write_text(CALLEE.replace("SCALE = 3", "SCALE = 11"))
    assert importlib.reload(module).scaled(2) == 22


@pytest.mark.parametrize("package", [numba, np])
def test_a_kernel_goes_by_the_versions(made, folders, monkeypatch, package):
    made()
    monkeypatch.setattr(package, "__version__", "0.0.1")
    assert made() == (7, True)
    assert len(folders()) == 2


def test_a_kernel_goes_by_processor_signature_and_options(made):
    class Other:
        def magic_tuple(self):
            return "x86_64-unknown-linux-gnu", "another", "+sse2"

    made()
    answer = sys.modules["kernels_of_a_test.caller"].answer
    (signature,), codegen = answer.overloads, answer.targetctx.codegen()
    other = kernels.compiler(nogil=False)(answer.py_func)
    keys = [
        answer._cache._key(signature, codegen),
        answer._cache._key(signature, Other()),
        answer._cache._key((numba.float64,), codegen),
        other._cache._key(signature, codegen),
    ]
    assert len(set(map(kernels._named, keys))) == 4


@pytest.mark.parametrize("depth", [0, 1, 2])
@pytest.mark.parametrize("mode", [0o770, 0o707])
def test_where_others_can_write_nothing_is_read_or_written(made, folders, depth, mode):
    made()
    (folder,) = folders()
    files = {f: f.read_bytes() for f in folder.iterdir()}
    (folder, folder.parent, folder.parent.parent)[depth].chmod(mode)
    with pytest.warns(RuntimeWarning, match="compiled in every run .*others can write it"):
        assert made() == (7, True)
    assert {f: f.read_bytes() for f in folder.iterdir()} == files


def test_what_belongs_to_somebody_else_is_not_read(made, monkeypatch):
    made()
    own = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: own + 1)
    with pytest.warns(RuntimeWarning, match="belongs to somebody else"):
        assert made() == (7, True)


def test_a_file_that_others_can_write_is_not_read(made, folders):
    made()
    for file in folders()[0].iterdir():
        file.chmod(0o666)
    assert made() == (7, True)
    assert made() == (7, False)  # it was written anew


def test_a_link_is_not_followed(made, folders, tmp_path):
    made()
    (folder,) = folders()
    folder.rename(tmp_path / "elsewhere")
    folder.symlink_to(tmp_path / "elsewhere")
    with pytest.warns(RuntimeWarning, match="compiled in every run"):
        assert made() == (7, True)


@pytest.mark.parametrize("home", ["file", "/proc/none"])
def test_where_nothing_can_be_written_the_answer_is_the_same(made, tmp_path, monkeypatch, home):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / home))
    with pytest.warns(RuntimeWarning, match="compiled in every run .*; let XDG_CACHE_HOME name a folder") as told:
        assert made() == (7, True)
    assert len(told) == 1


@pytest.mark.parametrize(
    "damage",
    [lambda data: b"", lambda data: data[:40], lambda data: data[:-1] + bytes([data[-1] ^ 1]), lambda data: b"\0" * 90],
)
def test_a_damaged_file_is_made_again(made, folders, damage):
    made()
    for file in folders()[0].iterdir():
        file.write_bytes(damage(file.read_bytes()))
    assert [made(), made()] == [(7, True), (7, False)]


def test_a_folder_that_goes_while_it_is_used_is_missed_by_nobody(made, folders):
    made()
    (folder,) = folders()
    for file in folder.iterdir():
        file.unlink()
    folder.rmdir()
    assert sys.modules["kernels_of_a_test.caller"].answer(2.0) == 7.0
    assert made() == (7, True)


def test_the_newest_folders_stay(made, folders, tmp_path):
    for k in range(kernels.THRESHOLDS.kept_folders + 2):
        (tmp_path / "kernels_of_a_test" / "more.py").write_text(f"K = {k}")
        made()
        newest = max(folders(), key=lambda f: f.stat().st_mtime_ns)
        for folder in folders():
            os.utime(folder, ns=(0, folder.stat().st_mtime_ns - 10**10))
    assert len(folders()) == kernels.THRESHOLDS.kept_folders
    assert newest in folders()


def test_a_cold_start_says_so_once_and_a_warm_one_nothing(made):
    shown = []
    for _ in range(2):
        with Terminal(stream := io.StringIO()):
            made()
        shown.append(stream.getvalue())
    assert re.fullmatch(r"\[  0:0\d\] compiling for this machine, some seconds, once \.\.\.\n", shown[0])
    assert shown[1] == ""
    assert kernels.LISTENERS == []


@pytest.mark.exam
def test_two_processes_at_once(made, folders, tmp_path):
    made()
    for file in folders()[0].iterdir():
        file.unlink()
    script = "from kernels_of_a_test.caller import answer; print(answer(2), bool(answer.stats.cache_hits))"
    path = os.pathsep.join([str(tmp_path), *sys.path])

    def start():
        command = [sys.executable, "-W", "error", "-c", script]
        return subprocess.Popen(command, env=os.environ | {"PYTHONPATH": path}, stdout=subprocess.PIPE, text=True)

    both = [start() for _ in range(2)]
    assert [p.communicate()[0].split()[0] for p in both] == ["7", "7"]
    assert start().communicate()[0].split() == ["7", "True"]
    assert [f.name for f in folders()[0].iterdir() if "." in f.name] == []


def test_without_numba_a_function_stays_as_it_is(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)

    def plain(x):
        return x

    assert kernels.compiler(nogil=True)(plain) is plain


ROOT = Path(gapcert.__file__).parents[2]
MODULES = [
    p
    for folder in ("core", "plugins", "benchmarks/exams")
    for p in sorted((ROOT / folder).rglob("*.py"))
    if "compiler(" in p.read_text()
]


def compiled_ones(tree):
    """Functions under a decorator that compiles."""
    names = {"compiled", "kernels.compiled", "inner", "inlined", "borrowing", "small"}
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)]
    return [f for f in functions if names & {ast.unparse(d) for d in f.decorator_list}]


def test_kernels_hold_nothing_of_another_package():
    """A folder goes by the text of one package: what is compiled in from elsewhere would change unseen."""
    packages = {next(q for q in p.parents if q.parent.name in ("core", "plugins", "benchmarks")) for p in MODULES}
    packages -= {Path(gapcert.__file__).parent}
    count = 0
    assert {"gapcert_equations", "gapcert_mpc", "gapcert_symbolic", "exams"} <= {p.name for p in packages}
    for path in sorted(p for package in packages for p in package.rglob("*.py")):
        tree = ast.parse(path.read_text())
        foreign = {
            alias.asname or alias.name
            for node in tree.body
            if isinstance(node, ast.ImportFrom) and node.level == 0 and (node.module or "").startswith("gapcert")
            for alias in node.names
            if (node.module or "").split(".")[0] not in path.parts
        }
        for function in compiled_ones(tree):
            names = {n.id for statement in function.body for n in ast.walk(statement) if isinstance(n, ast.Name)}
            assert not names & foreign, (path.name, function.name)
            count += 1
    assert count > 80
