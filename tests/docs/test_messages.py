"""The index of error messages has every place that raises one, and an error that a user meets is found in it by its words."""

import ast
import re
import sys
from pathlib import Path

import pytest

import gapcert

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs"))
import messages  # noqa: E402

CLASSES = ("UsageError", "NoStart", "SpecError", "MissingDependency", "Undecided", "Interrupted", "ExpressionError")


@pytest.fixture(scope="module")
def index():
    return messages.markdown()


def raised(path):
    """The lines at which `raise` is followed by an error of Gapcert's, told by the text alone."""
    text = path.read_text()
    for hit in re.finditer(rf"^ *raise (gc\.)?({'|'.join(CLASSES)})\(", text, re.MULTILINE):
        yield text.count("\n", 0, hit.end()) + 1


def test_every_raise_is_listed(index):
    listed = {(m.path, m.line) for m in messages.messages()}
    sites, shown = 0, set(re.findall(r"`([^`]+)`", index))
    for path in [*ROOT.glob("core/**/*.py"), *ROOT.glob("plugins/**/*.py")]:
        name = path.relative_to(ROOT).as_posix()
        for line in () if "/testing" in name else raised(path):
            sites += 1
            assert (name, line) in listed, f"{name}:{line} raises what the index does not have"
            assert f"{name}:{line}" in shown
    assert sites > 450


def test_every_problem_of_a_spec_is_listed():
    listed = {(m.path, m.line) for m in messages.messages()}
    calls = 0
    for path in (ROOT / "core/gapcert/spec").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Problem" and len(node.args) > 1:
                if isinstance(node.args[1], ast.Starred):
                    continue
                calls += 1
                assert (path.relative_to(ROOT).as_posix(), node.lineno) in listed
    assert calls > 50


def test_a_raise_that_is_new_is_in_the_index(tmp_path):
    (tmp_path / "core").mkdir()
    code = 'def f(name):\n    what = f"fan: no blade {name!r}"\n    raise UsageError(f"{what}; expected four; count again")\n'
    (tmp_path / "core" / "fan.py").write_text(code)
    assert "fan: no blade ⟨name⟩; expected four; count again" in messages.markdown(tmp_path)
    assert messages.find("fan: no blade 'x'; expected four; count again", tmp_path)[0].line == 3


MODEL = {"kind": "equations", "states": {"v": "m/s"}, "inputs": {"u": "m/s"}, "next": {"v": "v + u"}, "period": "0.1 s"}
SPEC = {
    "version": 1,
    "name": "cart",
    "model": MODEL,
    "backend": MODEL,
    "domain": {"v": [-1, 1], "u": [-1, 1]},
    "sampling": {"kind": "adaptive", "budget": 10},
    "gap": {"kind": "envelope"},
    "lipschitz": {"residual": {"kind": "wood-zhang"}},
    "certificate": {"claim": "empirical"},
}
WRONG = {
    "an unknown key": {"domian": {}},
    "a range that is none": {"domain": {"v": [1, -1], "u": [-1, 1]}},
    "an axis without a range": {"domain": {"v": [-1, 1]}},
    "a unit that does not fit": {"domain": {"v": ["-1 kg", "1 m/s"], "u": [-1, 1]}},
    "a kind that nobody has": {"gap": {"kind": "envelop"}},
    "a level that estimates cannot give": {"certificate": {"claim": "deterministic"}},
    "a share above one": {"certificate": {"claim": "statistical", "violation": 2}},
    "a name that is not declared": {"model": {**MODEL, "next": {"v": "v + w"}}},
    "a power in the wrong words": {"model": {**MODEL, "next": {"v": "v^2"}}},
    "a function that is none": {"model": {**MODEL, "next": {"v": "sinh(v)"}}},
    "a goal about an input": {
        "controller": {"kind": "symbolic", "cells": {"v": 9}, "inputs": {"u": 3}, "goal": {"invariance": {"u": [0, 1]}}}
    },
    "a relation that bends": {"relations": ["v*u <= 1"]},
    "an executor that nobody has": {"sampling": {"kind": "adaptive", "budget": 9, "executor": "slurm"}},
    "a robot file that is not there": {"backend": {"kind": "mujoco", "robot": "nowhere.xml", "states": {"v": "a.velocity"}}},
    "no gap": {"gap": None},
}  # fmt: skip


@pytest.mark.exam
@pytest.mark.parametrize("case", WRONG)
def test_a_problem_of_a_spec_is_found_by_its_words(case, index):
    with pytest.raises(gapcert.GapcertError) as caught:
        gapcert.load_spec({**SPEC, **WRONG[case]})
    for problem in caught.value.problems:
        hits = messages.find(problem["message"])
        assert hits, problem
        assert any(
            f"`{hits[0].path}:{hits[0].line}`" in line and _words(hits[0]) in _plain(line) for line in index.splitlines()
        )


def _plain(line):
    return re.sub(r"\\(.)", r"\1", line)


def _words(message):
    return " ".join(message.text.split())


def _no_step():
    model = gapcert.load_spec(SPEC).build("model")
    model.step([[0.0, 1.0]], [[0.0]])


def _outside_the_domain():
    gapcert.Box((gapcert.StateSpec("x"),), (1.0,), (-1.0,))


def _no_plugin():
    gapcert.registry().get("effect", "glue")


CALLS = {f.__name__: f for f in (_no_step, _outside_the_domain, _no_plugin)}


@pytest.mark.parametrize("call", CALLS)
def test_an_error_of_the_library_is_found_by_its_words(call):
    with pytest.raises(gapcert.GapcertError) as caught:
        CALLS[call]()
    assert messages.find(str(caught.value))


def test_the_index_is_searched_from_the_command_line(capsys):
    messages.main("unknown key 'domian'")
    assert "core/gapcert/spec/models.py" in capsys.readouterr().out
