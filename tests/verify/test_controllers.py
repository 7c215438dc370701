"""`verify` proves saved controllers on cells again: honest ones of every kind pass, and no forged one does."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from controlled import bands, bit_more, broken, everything_wins, others, recounted, reforged, relinked, specs

import gapcert as gc
from gapcert.certification.coordinates import Coordinates, RelativeGap
from gapcert.cli.main import main
from gapcert.plugin import Box, Region
from gapcert_cells import AutomatonController, Splits, load_controller
from gapcert_verify import verify_run
from gapcert_verify.controllers import grid_proof, saved, successors

ASKED = "goal, cells and inputs of the controller are those of the spec"
KEPT = "every input that the controller allows keeps its promise"


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Name → what a run has made, made where it is asked for."""
    out, made = tmp_path_factory.mktemp("controlled"), {}

    class Runs:
        def __getitem__(self, name):
            if name not in made:
                made[name] = gc.run({**specs(), **bands(), **others(out)}[name], out=out)
            return made[name]

    return Runs()


@pytest.fixture
def forged(runs, tmp_path):
    """A copy of a run to be changed."""

    def copied(name):
        return shutil.copytree(runs[name].folder, tmp_path / name)

    return copied


def failures(run):
    return {c["check"]: c["detail"] for c in verify_run(run)["checks"] if not c["passed"]}


@pytest.mark.exam
@pytest.mark.parametrize("name", [*specs(), *bands(), "beside", "grown", "extended"])
def test_honest_controllers_are_proved(runs, name):
    answer = verify_run(runs[name].folder)
    assert answer["verdict"] == "holds", [c for c in answer["checks"] if not c["passed"]]
    assert [c["check"] for c in answer["checks"]][-2:] == [ASKED, KEPT]
    told = " ".join(answer["trusted"])
    assert ("growth bound" in told and "tau*c*k*h*fast" in told) == (name == "grown")
    assert "was not bounded" not in told


def shifted(c):
    return replace(c, edges=(c.edges[0] + 0.3 * np.diff(c.edges[0])[0], *c.edges[1:]))


def enlarged(c):
    box = c.goal.target.boxes[0]
    wide = Region((Box(box.axes, (box.low[0] - 0.5, *box.low[1:]), box.high),))
    inside = c.edges[0][np.unravel_index(np.arange(len(c.values)), c.counts)[0]] >= box.low[0] - 0.5
    values = np.where(inside & (c.values > 0), 0, c.values).astype(np.int32)
    return recounted(replace(c, goal=replace(c.goal, target=wide), values=values))


def nearer(c):
    return recounted(replace(c, values=np.where(c.values > 1, c.values - 1, c.values).astype(np.int32)))


def halved_otherwise(c):
    """Two nodes exchange their parts."""
    first = c.splits.first.copy()
    a, b = np.flatnonzero(first)[:2]
    first[a], first[b] = first[b], first[a]
    return replace(c, splits=Splits(c.splits.counts, c.splits.levels, first), promised=None)


def read_otherwise(c):
    """Cells beside a region are said to lie in it."""
    return replace(c, must=c.may.copy())


def accepted(c):
    """A state before the last visit is said to be the end."""
    automaton = replace(c.automaton, accepting=tuple(True for _ in c.automaton.accepting))
    goal = replace(c.goal, automaton=automaton)
    return replace(c, goal=goal, parts=tuple(replace(p, goal=goal) for p in c.parts))


def drifted(c):
    held = Box(c.held.axes, tuple(v / 3 for v in c.held.low), tuple(v / 3 for v in c.held.high))
    return replace(c, held=held, evidence={**c.evidence, "held": held.bounds})


def turned(c):
    axes = tuple(replace(a, kind="real") for a in c.goal.stay.axes)
    boxes = [Box(axes, b.low, b.high) for b in (c.goal.stay, *c.goal.target.boxes, *c.goal.avoid.boxes)]
    goal = replace(c.goal, stay=boxes[0], target=Region((boxes[1],)), avoid=Region(tuple(boxes[2:])))
    return replace(c, goal=goal, promised=None)


def resting(c):
    """Cells outside of the target are said to be where it is kept for ever."""
    return replace(c, lasting=(*c.lasting, int(c.values.max())))


CHANGES = {
    "all cells and inputs a thousand times as large": ("staying", everything_wins, ASKED),
    "an input changed": ("staying", lambda c: replace(c, points=c.points + np.eye(len(c.points))[2][:, None] * 0.01), ASKED),
    "cells shifted": ("staying", shifted, ASKED),
    "a target enlarged": ("circle", enlarged, ASKED),
    "steps hidden": ("circle", nearer, KEPT),
    "an angle that is a number": ("circle", turned, ASKED),
    "another tree": ("refined", halved_otherwise, KEPT),
    "letters invented": ("tour", read_otherwise, KEPT),
    "accepted at once": ("tour", accepted, ASKED),
    "a smaller box of what has no cells": ("held", drifted, KEPT),
    "kept where it is not": ("affine", resting, KEPT),
    "more cells in words": ("staying", lambda c: replace(c, evidence={**c.evidence, "winning_cells": 10**6}), ASKED),
    "nothing assumed": (
        "grown",
        lambda c: replace(c, evidence={k: v for k, v in c.evidence.items() if k != "assumptions"}),
        ASKED,
    ),
}


@pytest.mark.parametrize("name", CHANGES)
def test_changed_controllers_fail(forged, name):
    of, change, check = CHANGES[name]
    run = forged(of)
    reforged(run, change)
    assert check in failures(run)


@pytest.mark.parametrize("change", [everything_wins, shifted, enlarged])
def test_without_a_spec_the_promise_itself_fails(forged, change):
    """What is asked cannot be compared then, and is named; what is promised is proved from the model alone."""
    run = forged("circle")
    spec = json.loads((run / "spec.json").read_text())
    (run / "spec.json").write_text(json.dumps({"model": spec["model"]}))
    assert KEPT not in failures(run)
    assert "the spec is the one that was run" in failures(run)
    assert any("those that were asked for" in t for t in verify_run(run)["trusted"])
    reforged(run, change)
    # Enlarged, and said to be asked for, the target is another question, and the answer to it is right.
    assert (KEPT in failures(run)) == (change is not enlarged)


def bolder(run):
    """The controller that knows no γ in place of the other."""
    shutil.rmtree(run / "controller" / "with_gamma")
    shutil.copytree(run / "controller" / "without_gamma", run / "controller" / "with_gamma")
    relinked(run)


@pytest.mark.parametrize("name", ["refined", "circle", "tour", "held", "sled"])
def test_a_controller_for_a_smaller_gap_fails(forged, name, monkeypatch):
    run = forged(name)
    bolder(run)
    assert KEPT in failures(run)
    # It is γ that it fails for.
    monkeypatch.setattr(successors.Flow, "over", lambda self, *a, own=successors.Flow.over: own(replace(self, gap=None), *a))
    monkeypatch.setattr(
        successors.Flow, "certain", lambda self, *a, own=successors.Flow.certain: own(replace(self, gap=None), *a)
    )
    monkeypatch.setattr(successors, "spread", lambda *a: None)
    assert KEPT not in failures(run)


@pytest.mark.parametrize(
    ("name", "part", "value"), [("staying", "c", "0.1 1/s"), ("circle", "s", "1.9 m/s"), ("sled", "mu", 0.3)]
)
def test_the_model_of_the_spec_is_what_it_is_proved_for(forged, name, part, value):
    run = forged(name)
    spec = json.loads((run / "spec.json").read_text())
    spec["model"]["parameters"][part] = value
    (run / "spec.json").write_text(json.dumps(spec))
    assert KEPT in failures(run)


@pytest.mark.exam
@pytest.mark.parametrize("name", ["staying", "refined", "circle", "again", "forever", "finer", "held", "beside"])
def test_drawn_bits_are_caught(runs, forged, name):
    found, rng = runs[name], np.random.default_rng(len(name))
    flow, honest = (
        (found.artifacts["model"], found.artifacts["certificate"].gap),
        load_controller(found.folder / "controller" / "with_gamma"),
    )
    run, lies = forged(name), 0
    if name == "beside":
        flow = flow[0], RelativeGap(flow[1], Coordinates.of(flow[0], {"d": "u - v", "e": "w"}))
    while lies < 4:
        if (change := bit_more(honest, rng)) is not None and broken(*change, flow, rng):
            reforged(run, lambda _, c=change[0]: c)
            assert KEPT in failures(run), change[1:]
            lies += 1


def test_a_proof_goes_on_where_it_was_stopped(forged, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(grid_proof, "PAIRS", 500)
    run, told = forged("staying"), list[int]()

    def stop(event):
        told.append(event.data["done"])
        if len(told) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr("gapcert.contracts.plugins.events.BEAT", 0.0)
    monkeypatch.setattr(saved, "PAUSE", 0.0)
    with pytest.raises(KeyboardInterrupt):
        verify_run(run, stop)
    done, told = told[-1], []
    assert verify_run(run, lambda event: told.append(event.data["done"]))["verdict"] == "holds"
    assert told[0] > done
    assert told[-1] == 31 * 40
    assert not list((tmp_path / "cache").rglob("*.tmp"))
    # What is finished is forgotten, and another controller is another question.
    assert not [p for p in (tmp_path / "cache").rglob("*") if p.is_file()]


def test_what_was_proved_of_another_controller_is_not_believed(forged, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(grid_proof, "PAIRS", 500)
    monkeypatch.setattr(saved, "PAUSE", 0.0)

    def stop(event):
        raise KeyboardInterrupt

    run = forged("staying")
    with pytest.raises(KeyboardInterrupt):
        verify_run(run, stop)
    (kept,) = [p for p in (tmp_path / "cache").rglob("*") if p.is_file()]
    reforged(run, lambda c: replace(c, bits=np.where(c.values[:, None] >= 0, np.uint8(0b11111000), c.bits)))
    assert KEPT in failures(run)
    assert kept.is_file()


CODE = """
import numpy as np
from gapcert import Interval


def step(x, u, *, tau):
    parts = [x[:, 0] + tau * u[:, 0], x[:, 1] + tau * u[:, 1]]
    return Interval.stack(parts, axis=1) if isinstance(x, Interval) else np.stack(parts, axis=1)


def slopes(x, u, *, tau):
    out = np.zeros((len(x), 2, 4))
    out[:, 0, 0] = out[:, 1, 1] = 1.0
    out[:, 0, 2] = out[:, 1, 3] = tau
    return Interval(out, out) if isinstance(x, Interval) else out
"""


def test_a_model_that_is_no_text_is_trusted_by_name(tmp_path, monkeypatch):
    (tmp_path / "walked.py").write_text(CODE)
    monkeypatch.syspath_prepend(tmp_path)
    model = {"kind": "python", "function": "walked:step", "jacobian": "walked:slopes", "intervals": True, "period": "0.5 s"}
    model |= {"states": {"x": "m", "y": "m"}, "inputs": {"u": "m/s", "w": "m/s"}, "parameters": {"tau": "0.5 s"}}
    found = gc.run({**specs()["tour"], "model": model}, out=tmp_path / "runs", allow_code=True)
    answer = verify_run(found.folder)
    assert answer["verdict"] == "holds", [c for c in answer["checks"] if not c["passed"]]
    assert any("a model of kind python was not bounded" in t for t in answer["trusted"])
    # What is stored of its successors is taken for true, and the game is played again on it.
    honest, rng = load_controller(found.folder / "controller" / "with_gamma"), np.random.default_rng(3)
    assert isinstance(honest, AutomatonController)
    flow, change = (found.artifacts["model"], found.artifacts["certificate"].gap), None
    while change is None or not broken(*change, flow, rng):
        change = bit_more(honest, rng)
    reforged(found.folder, lambda _: change[0])
    assert KEPT in failures(found.folder)


def test_the_command_says_how_far_it_is(runs, capsys):
    assert main(["verify", str(runs["circle"].folder), "--quiet"]) == 0
    assert KEPT in capsys.readouterr().out
