"""The suite itself: kinds of tests, what each costs, what a machine lacks, random orders."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import durations
import pytest
from durations import BUDGET, LIST, REFERENCE, Durations

SUPPORT = Path(__file__).parent / "support"
TESTS = '''
import multiprocessing, subprocess, sys, time
import pytest

def test_alone():
    """0.3 s of CPU, at least."""
    start = time.process_time()
    while time.process_time() - start < 0.3:
        pass

@pytest.mark.parametrize("n", [1, 2])
def test_starts_a_process(n):
    subprocess.run([sys.executable, "-c", ""], check=True)

@pytest.mark.contract
def test_may_start_one():
    subprocess.run([sys.executable, "-c", ""], check=True)

@pytest.mark.exam
@pytest.mark.run
def test_is_an_exam():
    subprocess.run([sys.executable, "-c", "sum(range(10**7))"], check=True)

@pytest.mark.outside("chromium")
def test_looks_at_a_page():
    raise AssertionError("there is no Chromium here")
'''


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    """A folder of tests, and what a run of them with these options says."""
    folder = tmp_path_factory.mktemp("suite")
    (folder / "test_it.py").write_text(TESTS)
    (folder / "pytest.ini").write_text(
        "[pytest]\nmarkers =\n unit:\n contract:\n run:\n exam:\n outside:\naddopts = -p tiers -p outside -p durations\n"
    )
    nowhere = folder / "bin"
    nowhere.mkdir()

    def go(*options):
        command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *options]
        env = os.environ | {"PYTHONPATH": os.pathsep.join([str(SUPPORT), *sys.path]), "PATH": str(nowhere)}
        return subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False).stdout

    return folder, go


@pytest.mark.exam
@pytest.mark.parametrize("workers", ["0", "2"])
def test_a_run_is_recorded_and_unit_tests_start_no_program(suite, workers):
    folder, go = suite
    said = go("-n", workers, "--record", "cost.tsv")
    assert "3 passed" in said
    assert "2 failed" in said
    assert "test_starts_a_process[2]: a unit test, and it starts a program" in said
    assert "skipped, since Chromium is not on this machine (apt-get install chromium): 1 of test_it.py" in said
    rows = Durations.of((folder / "cost.tsv").read_text()).rows
    assert {n.split("::")[1]: tier for tier, n in rows} == {
        "test_alone": "unit", "test_starts_a_process": "unit", "test_may_start_one": "contract", "test_is_an_exam": "exam",
        "test_looks_at_a_page": "unit",
    }  # fmt: skip
    seconds = {n.split("::")[1]: s for (_, n), s in rows.items()}
    assert seconds["test_alone"] >= 0.3
    assert seconds["test_is_an_exam"] > seconds["test_may_start_one"] > 0, "children count"


@pytest.mark.exam
def test_a_seed_is_an_order(suite):
    _, go = suite
    orders = [go("-v", "--shuffle", seed, "-m", "not exam").split("::")[1:6] for seed in ("1", "1", "2", "3")]
    assert orders[0] == orders[1]
    assert len({tuple(o) for o in orders}) > 1


def test_options_of_the_suites_own_are_one_word_each():
    """Before it knows them, pytest takes a second word that is a file, as the last record is, for where the tests are."""
    root = SUPPORT.parents[1]
    texts = [(root / name).read_text() for name in ("Makefile", ".ci/run", ".ci/stable")]
    assert sum(text.count("--record=") + text.count("--shuffle=") for text in texts) == 3
    assert not [text for text in texts if "--record " in text or "--shuffle " in text]


ROWS = {("unit", "a.py::test_a"): 3.0, ("exam", "a.py::test_b"): 5.0}
KNOWN = Durations(REFERENCE, ROWS)


def test_the_list_and_a_run_must_have_the_same_tests():
    assert list(durations.problems(KNOWN, KNOWN)) == []
    more = replace(KNOWN, rows=ROWS | {("run", "a.py::test_c"): 1.0})
    assert list(durations.problems(more, KNOWN)) == ["tests/durations.tsv: add the line\n1.00\trun\ta.py::test_c"]
    assert "a.py::test_c did not run as run" in next(durations.problems(KNOWN, more))


def test_only_the_daily_part_has_a_budget_and_a_slow_machine_does_not_break_it(tmp_path):
    over = {("run", "a.py::test_a"): BUDGET + 1, ("exam", "a.py::test_b"): BUDGET}
    assert "the daily part took" in next(durations.problems(Durations(REFERENCE, over), Durations(REFERENCE, over)))
    for loop, factor in ((REFERENCE, 1), (2 * REFERENCE, 1.9)):
        (tmp_path / f"{factor}").write_text(Durations(loop, {("run", "a.py::test_a"): factor * (BUDGET - 1)}).text())
        run = durations.merged([str(tmp_path / f"{factor}")], KNOWN)
        assert list(durations.problems(run, run)) == []
    # Most tests took longer by one factor: the machine; by more than machines differ, or in a few tests alone: ours.
    known = Durations(REFERENCE, {("run", f"a.py::test_{k}"): (BUDGET - 1) / 9 for k in range(9)})
    for slower, tests, fails in ((1.8, 9, False), (3.0, 9, True), (1.8, 3, True)):
        rows = {row: seconds * (slower if k < tests else 1) for k, (row, seconds) in enumerate(known.rows.items())}
        (tmp_path / "run").write_text(Durations(REFERENCE, rows).text())
        assert bool(list(durations.problems(durations.merged([str(tmp_path / "run")], known), known))) is fails


def test_a_test_that_one_run_skipped_costs_what_the_other_says(tmp_path):
    for name, seconds in (("bare", 0.0), ("rest", 4.0)):
        (tmp_path / name).write_text(Durations(REFERENCE, {("run", "a.py::test_a"): seconds}).text())
    assert durations.merged([str(tmp_path / "bare"), str(tmp_path / "rest")], Durations(REFERENCE, {})).rows == {
        ("run", "a.py::test_a"): 4.0
    }


def test_the_daily_part_is_within_its_budget():
    assert Durations.of(LIST.read_text()).daily() <= BUDGET
