"""Mutated files of every kind, through the public entry points: success or one sentence, in time, nothing written elsewhere."""

import random
import subprocess
import sys
from pathlib import Path

import pytest
from fuzzing import FOUND, NATIVE, TARGETS, held, mutate
from hypothesis import given, settings
from hypothesis import strategies as st

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")
ROOT = Path(__file__).parents[2]
NEEDS = {"parquet": "pyarrow", "h5": "h5py", "mcap": "mcap", "onnx": "onnx", "pybullet": "pybullet", "mujoco": "mujoco"}
NEEDS |= {"dart": "dartpy", "dart-sdf": "dartpy", "mat": "h5py"}
QUICK = {
    "spec": 25,
    "equation": 25,
    "unit": 25,
    "formula": 60,
    "automaton": 60,
    "csv": 25,
    "mat": 8,
    "h5": 5,
    "mcap": 8,
    "run": 5,
}
SLOW = dict.fromkeys(TARGETS, 8) | {"diagnosis": 30, "figures": 2}


def fuzzed(name: str, examples: int, folder: Path) -> None:
    if name in NEEDS:
        pytest.importorskip(NEEDS[name], reason=f"needs {NEEDS[name]}")
    target = TARGETS[name]
    seeds = target.seeds()

    @settings(max_examples=examples, database=None)
    @given(st.integers(0, 2**32), st.integers(0, len(seeds) - 1))
    def check(seed, number):
        target.run(mutate(seeds[number], random.Random(seed)), folder)

    for data in seeds[:3]:
        target.run(data, folder)
    check()


@pytest.mark.exam
@pytest.mark.parametrize("name", list(QUICK))
def test_a_few(name, tmp_path):
    fuzzed(name, QUICK[name], tmp_path)


@pytest.mark.exam
@pytest.mark.parametrize("name", [n for n in TARGETS if n not in QUICK and n not in NATIVE])
def test_more(name, tmp_path):
    fuzzed(name, SLOW[name], tmp_path)


@pytest.mark.exam
@pytest.mark.parametrize("name", NATIVE)
def test_engines(name):
    """In a process of their own: these parsers are C++."""
    pytest.importorskip(NEEDS[name], reason=f"needs {NEEDS[name]}")
    command = [sys.executable, ROOT / "tests" / "fuzz" / "fuzz.py", "--random", name, "2"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]


@pytest.mark.exam
@pytest.mark.parametrize("name", ["spec", "formula"])
def test_by_coverage(name):
    """Atheris takes the same targets."""
    pytest.importorskip("atheris", reason="needs Atheris, which is no dependency")
    command = [sys.executable, ROOT / "tests" / "fuzz" / "fuzz.py", name, "-max_total_time=3"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]
    assert "DONE" in done.stderr or "Done" in done.stderr


CASES = [pytest.param(path, id=f"{path.parent.name}-{path.name}") for path in sorted(FOUND.glob("*/*")) if path.is_file()]


@pytest.mark.exam
@pytest.mark.parametrize("path", CASES)
def test_what_was_found(path, tmp_path):
    """Every input that once broke the rule."""
    name = path.parent.name
    if name in NEEDS:
        pytest.importorskip(NEEDS[name], reason=f"needs {NEEDS[name]}")
    TARGETS[name].run(path.read_bytes(), tmp_path)


@pytest.mark.run
@pytest.mark.parametrize(
    "break_it",
    [
        lambda folder: (folder.parent / "elsewhere").write_text("x"),
        lambda folder: (folder.parent / "elsewhere").mkdir(),
        lambda folder: subprocess.run(["true"], check=True),
        lambda folder: 1 / 0,
    ],
    ids=["a file elsewhere", "a folder elsewhere", "a program", "another exception"],
)
def test_the_rule_can_be_broken(tmp_path, break_it):
    (tmp_path / "in").mkdir()
    with pytest.raises((AssertionError, ZeroDivisionError)):
        held(tmp_path / "in", lambda: break_it(tmp_path / "in"))


def test_what_hangs_is_noticed(tmp_path, monkeypatch):
    import time

    import fuzzing

    monkeypatch.setattr(fuzzing, "SECONDS", 1)
    with pytest.raises(TimeoutError):
        held(tmp_path, lambda: time.sleep(30))
