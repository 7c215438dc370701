"""Every commit answers a few questions as the one before it did: words, counts and digests equal, numbers within 1e-6."""

import json

import golden
import pytest

STORED = json.loads(golden.STORED.read_text())


@pytest.mark.exam
@pytest.mark.parametrize("question", golden.SHORT)
def test_an_answer_is_still_the_same(question, monkeypatch):
    """`benchmarks/golden.py store` writes them anew, where an answer is meant to change."""
    monkeypatch.chdir(golden.ROOT)
    asked = json.loads(json.dumps(golden.short(golden.ask(question)), default=str))
    assert list(golden.differences(STORED[question], asked, 1e-6)) == []


def test_what_another_answer_is():
    before = {"verdict": "holds", "gamma": [1.0, 0.0], "sites": {"hinge": 3}, "seconds": 1.0}
    assert not list(golden.differences(before, before | {"gamma": [1.0 + 9e-7, 0.0], "seconds": 2.0}, 1e-6))
    changes = {"verdict": "fails", "gamma": [1.0 + 2e-6, 0.0], "sites": {"hinge": 4}, "more": 0}
    for key, value in changes.items():
        (found,) = golden.differences(before, before | {key: value}, 1e-6)
        assert found.startswith(f"/{key}")


def test_where_another_function_was_audited_words_count():
    before = {"verdict": "holds", "states": {"q": {"gap": 1.0}}, "audit": {"violations": 0, "book": {"audited": "a"}}}
    after = {**before, "states": {"q": {"gap": 1.01}}, "audit": {"violations": 1, "book": {"audited": "b"}}}
    assert not list(golden.differences(before, after, 1e-6))
    assert list(golden.differences(before, {**after, "verdict": "fails"}, 1e-6))
    assert list(golden.differences(before, {**after, "states": {}}, 1e-6))
    assert len(list(golden.differences(before, {**after, "audit": before["audit"]}, 1e-6))) == 1


def test_all_that_is_asked_is_stored():
    assert set(STORED) == set(golden.SHORT)
