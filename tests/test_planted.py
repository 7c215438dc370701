"""The table of planted faults stays true of the code: what `benchmarks/planted.py` plants is still there to be changed."""

import ast
import importlib
from collections import Counter
from functools import cache
from pathlib import Path

import pytest
import rooms

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def planted():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "benchmarks"))
        return importlib.import_module("planted")


def test_every_fault_changes_what_one_place_of_its_file_does(planted):
    parsed = cache(ast.parse)
    for fault in planted.faults():
        text = (ROOT / fault.file).read_text()
        before, after = parsed(text).body, ast.parse(fault.planted(text)).body
        line = text[: text.index(fault.old)].count("\n") + 1
        k = next(i for i, node in enumerate(before) if node.end_lineno >= line)
        assert ast.dump(before[k]) != ast.dump(after[k]), fault.broken


def test_every_room_has_two_faults_or_more_in_its_own_files(planted):
    table = planted.faults()
    counts = Counter(f.area for f in table)
    assert set(counts) == {*(room.removeprefix("core.").removeprefix("gapcert_") for room in rooms.ORDER), "exams"}
    assert min(counts.values()) >= 2
    for fault in table:
        module = ".".join(Path(fault.file).with_suffix("").parts[1:])
        own = "exams" if module.startswith("exams.") else rooms.room(module)
        assert own.removeprefix("core.").removeprefix("gapcert_") == fault.area, fault.broken


def test_no_two_faults_are_one_and_their_tests_are_there(planted):
    table = planted.faults()
    assert len({f.broken for f in table}) == len({(f.file, f.old, f.new) for f in table}) == len(table)
    assert {t for f in table for t in f.tests if not (ROOT / t.partition("::")[0]).is_file()} == set()
    assert any(f.quick for f in table)


def test_an_anchor_that_is_not_there_once_is_named_with_its_file_and_count(planted):
    fault = planted.Fault("contracts", "a sign", "core/gapcert/sign.py", "-x", "x", ("tests/test_layout.py",))
    assert fault.planted("y = -x\n") == "y = x\n"
    for text, count in (("y = x\n", 0), ("y = -x - -x\n", 2)):
        with pytest.raises(ValueError, match=rf"core/gapcert/sign\.py: the text that 'a sign' changes occurs {count} times"):
            fault.planted(text)
