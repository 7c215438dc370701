"""The tables of faults and attacks are as long as promised, and every row names a test that is there."""

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


@pytest.mark.exam
@pytest.mark.parametrize(("marker", "least"), [("fault", 40), ("attack", 20)])
def test_there_are_as_many_as_promised(rows, marker, least):
    found = rows(marker)
    assert len(found) >= least
    assert all(len(row.texts) == 2 and all(row.texts) for row in found)
    assert len({row.texts for row in found}) == len(found)


@pytest.mark.exam
def test_every_row_names_a_test(rows, collected):
    there = {name.partition("[")[0]: set() for name in collected[0]}
    for name in collected[0]:
        test, _, case = name.partition("[")
        there[test].add(case)
    rows_of = [row.test.partition("[") for marker in ("fault", "attack") for row in rows(marker)]
    lost = [f"{test}[{case}" for test, _, case in rows_of if not any(case.rstrip("]") in c for c in there.get(test, ()))]
    assert lost == []
