"""The tables of faults and attacks are as long as promised, and every row names a test that is there."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def rows():
    pytest.importorskip("sphinx", reason="needs the dev extra")
    sys.path.insert(0, str(ROOT / "docs"))
    try:
        import survived
    finally:
        sys.path.remove(str(ROOT / "docs"))
    return survived.rows


@pytest.mark.parametrize(("marker", "least"), [("fault", 40), ("attack", 20)])
def test_there_are_as_many_as_promised(rows, marker, least):
    found = rows(marker)
    assert len(found) >= least
    assert all(len(row.texts) == 2 and all(row.texts) for row in found)
    assert len({row.texts for row in found}) == len(found)


@pytest.mark.exam
def test_every_row_names_a_test(rows):
    names = {row.test for marker in ("fault", "attack") for row in rows(marker)}
    files = sorted({name.partition("::")[0] for name in names})
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider", *files]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False).stdout.splitlines()
    there = [line.partition("[") for line in listed]
    for name in names:
        test, _, case = name.partition("[")
        assert any(t == test and case.rstrip("]") in c for t, _, c in there), name
