"""What a model predictive controller stores is proved again: lines, the tube, its sections, and where plans end."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from controlled import everything_wins, planned

import gapcert as gc
from gapcert.plugin import Interval
from gapcert_cells import GridController
from gapcert_verify import verify_run
from gapcert_verify.controllers.lines import SPARE, Line
from gapcert_verify.controllers.saved import controlled
from gapcert_verify.evidence import load

ASKED = "goal and horizon of the controller are those of the spec"
FRAME = "plans are made in the box of the goal and of the inputs"
TUBE = "the tube counts at least the gap over X × U"
SECTIONS = "sections of the tube are kept by its gain"
END = "where plans end is kept"


class Runs(dict):
    """Folders by name, each made when it is asked for."""

    def __missing__(self, name):
        self[name] = gc.run(planned()[name], out=self.out).folder
        return self[name]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    found = Runs()
    found.out = tmp_path_factory.mktemp("planned")
    return found


def failures(run):
    return {c["check"]: c["detail"] for c in verify_run(run)["checks"] if not c["passed"]}


@pytest.mark.exam
@pytest.mark.parametrize("name", planned())
def test_honest_plans_are_proved(runs, name):
    answer = verify_run(runs[name])
    assert answer["verdict"] == "holds", [c for c in answer["checks"] if not c["passed"]]
    ends = [] if name in ("arriving", "relative") else [END]  # plans that end in a target have no set of their own
    assert [c["check"] for c in answer["checks"]][-5 + (not ends) :] == [ASKED, FRAME, TUBE, SECTIONS, *ends]
    assert any("Lines about plans" in t for t in answer["trusted"]) == (name in ("along", "bent"))


def edited(run, **changes):
    """Arrays of the controller by name, `__` for a dot, through a function."""
    path = run / "controller" / "with_gamma" / "controller.npz"
    with np.load(path) as stored:
        arrays = dict(stored)
    for name, change in changes.items():
        key = name.replace("__", ".")
        arrays[key] = np.asarray(change(arrays[key]))
    np.savez(path, **arrays)


def retold(run, **changes):
    path = run / "controller" / "with_gamma" / "controller.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def wider(run):
    data = json.loads((run / "controller" / "with_gamma" / "controller.json").read_text())
    retold(run, goal={**data["goal"], "stay": {n: [a * 0.5, b * 1.5] for n, (a, b) in data["goal"]["stay"].items()}})


def winning(run):
    folder = run / "controller" / "with_gamma" / "terminal"
    c = GridController.load(folder)
    shutil.rmtree(folder)
    everything_wins(c).save(folder)


def elsewhere(run):
    """The controller that takes over has another goal, which it keeps."""
    folder = run / "controller" / "with_gamma" / "terminal"
    c = GridController.load(folder)
    low, high = c.goal.stay.low, c.goal.stay.high
    goal = replace(c.goal, stay=replace(c.goal.stay, low=(low[0] - 0.1, *low[1:]), high=high))
    shutil.rmtree(folder)
    replace(c, goal=goal).save(folder)


FORGERIES = {
    "a smaller gap": ("tracking", lambda r: edited(r, stages__c=lambda a: a * 0.9, stages__G=lambda a: a * 0.9), TUBE),
    "a smaller gap at a late stage": (
        "tracking",
        lambda r: edited(r, stages__c=lambda a: a * np.linspace(1, 0.7, len(a))[:, None]),
        TUBE,
    ),
    "another line": ("tracking", lambda r: edited(r, stages__A=lambda a: a * 0.98), TUBE),
    "another start of the line": ("arriving", lambda r: edited(r, stages__d=lambda a: a + 0.02), TUBE),
    "bounds of a part": ("tracking", lambda r: edited(r, stages__high=lambda a: a * 0.5), TUBE),
    "a negative bound": ("arriving", lambda r: edited(r, stages__c=lambda a: -a), TUBE),
    "a smaller gap at the end": ("along", lambda r: edited(r, stages__c=lambda a: a * 0.5, stages__G=lambda a: a * 0.5), TUBE),
    "a smaller gap beside motion": ("relative", lambda r: edited(r, stages__G=lambda a: a * 0.6), TUBE),
    "a smaller gap where motion bends": ("bent", lambda r: edited(r, stages__c=lambda a: a * 0.4), TUBE),
    "sections that shrink faster": ("tracking", lambda r: edited(r, section__moved=lambda a: a * 0.5), SECTIONS),
    "thinner sections": ("arriving", lambda r: edited(r, section__P=lambda a: a * 0.9), SECTIONS),
    "another gain": ("tracking", lambda r: edited(r, section__K=lambda a: a * 1.1), SECTIONS),
    "a state that does not rest": ("tracking", lambda r: edited(r, reference=lambda a: a + np.array([0.0, 0.2, 0.0])), END),
    "rest at the edge": ("tracking", lambda r: edited(r, reference=lambda a: a + np.array([0.99, 0.0, 0.0])), END),
    "a wider frame": ("arriving", lambda r: edited(r, frame__half=lambda a: a * 1.2), FRAME),
    "solvers that may do anything": ("tracking", lambda r: edited(r, tolerance=lambda a: a * 0), FRAME),
    "plans that end anywhere": (
        "handed",
        lambda r: edited(r, ends__boxes=lambda a: np.stack([a[:, 0] - 0.5, a[:, 1] + 0.5], 1)),
        END,
    ),
    "cells that all win": ("handed", winning, END),
    "another goal at the end": ("handed", elsewhere, END),
    "a wider goal": ("tracking", wider, ASKED),
    "shorter plans": (
        "arriving",
        lambda r: edited(r, **{f"stages__{n}": lambda a: a[:-2] for n in ("A", "B", "d", "c", "G", "centre", "low", "high")}),
        ASKED,
    ),
}


@pytest.mark.exam
@pytest.mark.parametrize("name", FORGERIES)
def test_changed_plans_fail(runs, tmp_path, name):
    of, change, check = FORGERIES[name]
    run = shutil.copytree(runs[of], tmp_path / of)
    change(run)
    assert check in failures(run)


@pytest.mark.exam
def test_of_an_unknown_kind_the_promise_is_trusted_by_name(runs, tmp_path):
    run = shutil.copytree(runs["tracking"], tmp_path / "other")
    retold(run, kind="somebody's")
    assert any("somebody's" in t for t in verify_run(run)["trusted"])


def plans(run):
    """What `verify` knows of the controller with γ of a run."""
    found = []
    controlled(load(run), lambda event: None)._plan(lambda p: found.append(p) or "")
    return found[0]


def test_no_plan_is_made_where_no_gap_is_known(runs):
    p = plans(runs["bent"])
    assert p.framed() == ""
    low, high = ((0.9 * ends[0], *ends[1:]) for ends in (p.zone.low, p.zone.high))
    assert "beyond the certificate's domain" in replace(p, zone=replace(p.zone, low=low, high=high)).framed()


@pytest.mark.parametrize("name", ["bent", *(pytest.param(name, marks=pytest.mark.exam) for name in ("tracking", "relative"))])
def test_what_is_left_out_is_bounded_where_nobody_looked(runs, name):
    """Where less than the stored bound is asked for, some boxes are no longer proved; what is proved holds at random points."""
    p, rng, least = plans(runs[name]), np.random.default_rng(5), []
    model = gc.load_spec(planned()[name]).build("model")
    nx, (middle, half) = model.nx, (p.arrays["frame.middle"], p.arrays["frame.half"])
    s = {n: p.arrays[f"stages.{n}"][-1] for n in ("A", "B", "d", "c", "G", "centre", "low", "high")}
    whole = p.gap.boxes(Interval((middle + half * s["low"])[None], (middle + half * s["high"])[None]))
    for share in (0.3, 0.6, 0.8, 0.9, 1.0):
        line = Line({**s, "c": s["c"] * share, "G": s["G"] * share}, (middle, half), p.features, p.zone, p.model, p.gap)
        low = whole.lo + (whole.hi - whole.lo) * rng.uniform(0, 1, (300, len(half)))
        high = np.minimum(low + (whole.hi - whole.lo) * rng.uniform(0, 0.15, low.shape), whole.hi)
        wrong, _ = line._wrong(Interval(low, high))
        y = (low + (high - low) * rng.random((60, *low.shape)))[:, ~wrong].reshape(-1, len(half))
        z = line._inputs(Interval.exact(y))[0].mid
        z = z[p.zone.related(z) & (z >= line.box.lo).all(axis=1) & (z <= line.box.hi).all(axis=1)]
        zeta, ends = (z - middle) / half, p.gap.at(z)
        f = model.step(z[:, :nx], z[:, nx:]).x
        room = share * (s["c"] + np.abs((zeta - s["centre"]) @ p.features.T) @ s["G"].T)
        at = zeta @ np.concatenate([s["A"], s["B"]], axis=1).T + s["d"]
        for end in (ends[0].lo, ends[1].hi):
            w = (f + end - middle[:nx]) / half[:nx] - at
            assert (np.abs(w) <= room + 2 * SPARE).all()
        least.append((~wrong).mean())
    assert least == sorted(least)
    assert least[0] < least[-1] - 0.1
    assert least[-1] > 0.2
