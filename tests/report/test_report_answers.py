"""What stands in the answer of a report, which is all that some will read."""

import json
import shutil

import pytest

from gapcert_report.pages.page import write_report
from gapcert_report.words.words import some, symbols

MET = {"text": "verdict == holds", "value": "holds", "met": True}


@pytest.fixture
def answer(small_run, tmp_path):
    """The answer of the small run's report, with other expectations."""

    def of(*expectations):
        folder = shutil.copytree(small_run.folder, tmp_path / "run")
        summary = json.loads((folder / "summary.json").read_text()) | {"expectations": list(expectations)}
        (folder / "summary.json").write_text(json.dumps(summary))
        text = write_report(folder).read_text()
        return text[text.index('aria-label="Answer"') : text.index("</section>")]

    return of


@pytest.mark.exam
def test_what_is_not_as_the_spec_expects_is_part_of_the_answer(answer):
    unmet = [{"text": f"states.x{k}.tightness <= 1.1", "value": 2.15, "met": False} for k in range(5)]
    text = answer(MET, *unmet)
    assert "✗ Not as the spec expects</b>: states.x0.tightness &lt;= 1.1 (found 2.15), states.x1" in text
    assert "states.x2.tightness &lt;= 1.1 (found 2.15) and 2 more.</p>" in text
    assert "verdict == holds" not in text


def test_what_is_as_expected_is_not(answer):
    assert "expects" not in answer(MET)


def test_some_of_many():
    assert some(["a", "b", "c"], 3) == "a, b and c"
    assert some(["a", "b", "c", "d"], 2) == "a, b and 2 more"


def test_the_symbols_are_those_of_the_claim():
    simulated, measured = {"claim": {"kind": "statistical"}}, {"claim": {"kind": "statistical"}, "recording": {}}
    assert "f̂ the simulator" in symbols(simulated)
    assert "x⁺ the one that was measured" in symbols(measured)
    assert "f̂" not in symbols(measured)
