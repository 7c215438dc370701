"""A controller without cells, from the spec to the report: what it wins, how it loads, its steps, what it foresees."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tasks
from feedback import FEEDBACK, SPEC, Feedback, FeedbackController, declared

import gapcert as gc
import gapcert_cells
from gapcert.cli.main import main
from gapcert.run.verdict import beside_nominal
from gapcert.testing.toys import Drift
from gapcert_cells.testing import Band, Rod, rod_problem
from gapcert_closed_loop.prediction import Foreseen, foreseen
from gapcert_figures.data import Figures, loop_figure, winning_figure
from gapcert_report.pages.diagnosis import _controllers
from gapcert_report.pages.page import _policies
from gapcert_report.pictures.control import foresight_pictures
from gapcert_report.words.diagnosis import won, won_sentence
from gapcert_report.words.summary import in_words
from gapcert_report.words.words import loop_sentence
from gapcert_symbolic.synthesizer import Symbolic

BAND = Band((-0.002, -0.002), (0.002, 0.002))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> gc.Run:
    with pytest.MonkeyPatch.context() as patch:
        declared(patch, FEEDBACK)
        return gc.run(SPEC, out=tmp_path_factory.mktemp("runs"))


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    declared(monkeypatch, FEEDBACK)


def problem(gamma: float) -> gc.SynthesisProblem:
    model = Drift(2)
    domain = gc.Domain.of(model, {"x0": (0.0, 1.0), "x1": (0.0, 1.0), "u0": (-1.0, 1.0), "u1": (-1.0, 1.0)})
    stay = gc.Box(model.states, (0.1, 0.2), (0.9, 0.6))
    return gc.SynthesisProblem(
        model, Band([-gamma] * 2, [gamma] * 2), domain, gc.Goal("invariance", stay), certificate="ab" * 32
    )


# --- what it wins


@pytest.mark.exam
def test_its_domain_is_told_as_a_share(run: gc.Run) -> None:
    told = run.summary["controller"]
    assert run.summary["verdict"] == "holds"
    assert told["domain_fraction"] == 1.0
    assert not {"cells", "winning_cells"} & set(told)
    # γ is below what its gain allows for: it costs nothing.
    assert told["domain_of_nominal"] == 1.0
    words = "  controller: starts from 100.0% of the set to stay in (100.0% of what it would be without γ)"
    assert words in list(in_words(run.summary))
    assert "the controller's domain with γ is 100 % of that without" in loop_sentence(run.summary)
    assert run.controller is not None
    assert run.controller.wins


def test_an_empty_domain_gives_its_own_reason(tmp_path: Path, known: None) -> None:
    weak = SPEC | {"controller": SPEC["controller"] | {"gain": 0.2}, "report": {"rerun": False, "html": False}}
    run = gc.run(weak, out=tmp_path)
    assert run.exit_code == 1
    assert run.summary["reason"].startswith("γ of x is ")
    assert "cell" not in run.summary["reason"]
    assert "closed_loop" not in run.summary
    assert run.summary["controller"]["domain_fraction"] == 0.0


def test_a_share_that_the_evidence_leaves_out_is_measured() -> None:
    made = Feedback(gain=8.0).synthesize(problem(0.01))
    exact = made.evidence["domain_fraction"]
    assert exact == pytest.approx(0.125 / 0.4 * 0.125 / 0.2)
    silent = replace(made, evidence={})
    assert silent.facts()["domain_fraction"] == pytest.approx(exact, abs=4 * (exact / 24**2) ** 0.5)
    assert silent.wins
    assert not replace(made, evidence={"reason": "none"}).wins
    assert not replace(made, evidence={"domain_fraction": 0.0}).wins


def test_shares_before_and_after_a_diagnosis() -> None:
    both = {"before": {"controller": {"domain_fraction": 0.25}}, "after": {"controller": {"domain_fraction": 0.5}}}
    summary = {"recertified": both}
    assert won(summary) == (0.25, 0.5)
    assert won_sentence(summary) == "The controller wins from 25 % of the set to stay in before, and from 50 % after."
    shown = str(_controllers(both))
    assert "starts from this share" in shown
    assert "winning cells" not in shown


def test_what_gamma_costs_is_a_ratio(tmp_path: Path, known: None) -> None:
    """Of the domains with and without γ, which a spec may ask for; no ratio where nothing is without γ either."""
    asked = {"controller.domain_of_nominal": 0.0}
    weak = SPEC | {"controller": SPEC["controller"] | {"gain": 0.2}, "report": {"rerun": False}, "expect": asked}
    found = gc.run(weak, out=tmp_path)
    assert [e["met"] for e in found.summary["expectations"]] == [True]
    page = (found.folder / "report.html").read_text()
    assert re.search("domain with γ over that without.{0,80}>0<", page)
    assert beside_nominal({"domain_fraction": 0.3}, {"domain_fraction": 0.6}) == {"domain_of_nominal": 0.5}
    cells = {"cells": 40, "winning_cells": 10}
    assert beside_nominal(cells, cells | {"winning_fraction": 0.5}) == {"domain_of_nominal": 0.5}
    assert beside_nominal(cells, cells | {"winning_cells": 0}) == {}
    assert beside_nominal({"reason": "none"}, cells) == {}


# --- how it loads


def test_it_loads_by_its_kind(run: gc.Run, known: None) -> None:
    folder = run.folder / "controller" / "with_gamma"
    loaded = gc.load_controller(folder)
    assert isinstance(loaded, FeedbackController)
    assert dict(loaded.evidence) == dict(run.controller.evidence)
    x = run.controller.draw(50, np.random.default_rng(0))
    assert np.array_equal(loaded.act(x, "first"), run.controller.act(x, "first"))


def test_controllers_on_cells_load_without_their_synthesizer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Symbolic({"theta": 20, "omega": 20}, {"torque": 5}).synthesize(rod_problem())
    made.save(tmp_path)
    declared(monkeypatch, replace(FEEDBACK, name="symbolic", controller="", requires=("no_such_module",)))
    loaded = gc.load_controller(tmp_path)
    assert isinstance(loaded, gapcert_cells.GridController)
    assert loaded.digest() == made.digest()


@pytest.mark.parametrize(
    ("change", "components", "error", "message"),
    [
        (
            {},
            (),
            gc.MissingDependency,
            r"by synthesizer 'feedback', which no installed plugin provides \(there are .*symbolic",
        ),
        (
            {},
            (replace(FEEDBACK, requires=("no_such_solver",), extra="mpc"),),
            gc.MissingDependency,
            r"needs no_such_solver, which is not installed; run: pip install 'gapcert\[mpc\]'",
        ),
        ({}, (replace(FEEDBACK, controller=""),), gc.UsageError, "does not say how its controllers are loaded"),
        ({"kind": ["feedback"]}, (FEEDBACK,), gc.UsageError, "damaged"),
        ({"kind": "os:system", "loader": "os:system"}, (FEEDBACK,), gc.MissingDependency, "no installed plugin provides"),
        ({"goal": None}, (FEEDBACK,), gc.UsageError, "damaged"),
        (None, (FEEDBACK,), gc.UsageError, "damaged"),
    ],
)
def test_what_cannot_be_loaded_is_one_sentence(
    run: gc.Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    change: dict[str, Any] | None,
    components: tuple[gc.Component, ...],
    error: type[Exception],
    message: str,
) -> None:
    known = [c for key, c in gc.registry().components.items() if key != ("synthesizer", "feedback")]
    declared(monkeypatch, *known, *components)
    saved = run.folder / "controller" / "with_gamma"
    data = json.loads((saved / "controller.json").read_text())
    (tmp_path / "controller.json").write_text(json.dumps([] if change is None else data | change))
    (tmp_path / "controller.npz").write_bytes((saved / "controller.npz").read_bytes())
    with pytest.raises(error, match=message) as told:
        gc.load_controller(tmp_path)
    assert "\n" not in str(told.value)


def test_no_files_at_all(tmp_path: Path) -> None:
    with pytest.raises(gc.UsageError, match=r"no saved controller \(controller.json is missing\)"):
        gc.load_controller(tmp_path)


def test_it_has_no_export(run: gc.Run, tmp_path: Path, known: None, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(run.folder), "--to", "c", "--out", str(tmp_path / "c")]) == 2
    assert "a controller of kind 'feedback' has no form without Gapcert" in capsys.readouterr().err
    assert not (tmp_path / "c").exists()


# --- what it says of a step


def test_the_certificate_is_named_by_its_digest(run: gc.Run, known: None) -> None:
    digest = hashlib.sha256((run.folder / "certificate.json").read_bytes()).hexdigest()
    assert run.summary["controller"]["certificate"] == digest
    both = [gc.load_controller(run.folder / "controller" / name) for name in ("with_gamma", "without_gamma")]
    x = both[0].goal.stay.low
    assert [c.step(np.add(x, 0.05))[1].certificate for c in both] == [digest, None]


def test_a_step_says_where_its_input_comes_from() -> None:
    made = Feedback(gain=2.0).synthesize(problem(0.01))
    x = np.array([0.3, 0.5])
    seen, memory = [], None
    for _ in range(4):
        u, info = made.step(x, memory)
        memory = info.memory
        assert np.array_equal(u, made.act(x[None], "first")[0])
        assert info.solve_seconds > 0
        seen.append((info.source, info.fallback, len(info.tube)))
    assert seen == [("solved", False, 6), ("shifted", True, 5), ("shifted", True, 4), ("solved", False, 6)]
    u, info = made.step(np.array([0.95, 0.5]))
    assert (u, info.feasible, info.source, info.fallback, info.tube) == (None, False, "refused", False, None)


def test_at_the_target_there_is_nothing_to_do() -> None:
    stay = Rod().states
    target = gc.Region((gc.Box(stay, (0.05, -0.1), (0.15, 0.1)),))
    goal = gc.Goal("reach_avoid", gc.Box(stay, (-0.2, -0.25), (0.2, 0.25)), target)
    made = Symbolic({"theta": 30, "omega": 30}, {"torque": 5}).synthesize(rod_problem(goal))
    u, info = made.step(np.array([0.1, 0.0]))
    assert (u, info.feasible, info.source, info.left) == (None, True, "reached", 0)
    x = next(x for x in made.draw(100, np.random.default_rng(0)) if not goal.reached(x[None])[0])
    u, info = made.step(x)
    assert u is not None
    assert info.left == made.value(x[None])[0] > 0


@pytest.mark.parametrize("refine", [0, 1])
def test_the_tube_of_cells_holds_every_successor(refine: int) -> None:
    """With the gap at its corners too; a tube that is a cell narrower at each end would be left."""
    gap, cells = Band((-1.5e-4, -6e-5), (1.5e-4, 6e-5)), 60 >> refine
    made = Symbolic({"theta": cells, "omega": cells}, {"torque": 9}, refine=refine).synthesize(rod_problem(gap=gap))
    corners = np.array([[a, b] for a in (gap.low[0], gap.high[0]) for b in (gap.low[1], gap.high[1])])
    model, left = Rod(), 0
    for x in made.draw(100, np.random.default_rng(5)):
        u, info = made.step(x)
        after = model.step(np.tile(x, (4, 1)), np.tile(u, (4, 1))).x + corners
        low, high = info.tube[0].T
        assert ((after >= low) & (after <= high)).all()
        left += int(((after < low + made.widths) | (after > high - made.widths)).any())
    assert left > 50


def test_the_tube_goes_round_with_an_angle_and_over_held_states() -> None:
    axes = (gc.StateSpec("h", "rad", "angle"), gc.StateSpec("v", "m/s"))
    goal = gc.Goal("invariance", gc.Box(axes, (-np.pi, -1.0), (np.pi, 1.0)))
    edges = np.linspace(-np.pi, np.pi, 9)
    # One cell on, from the last one round to the first.
    along = gapcert_cells.Along((), True, np.zeros(1, dtype=np.int64), np.array([[1]]), np.array([[2]]))
    promised = gapcert_cells.Successors((8,), (True,), (along,))
    bits, values = np.full((8, 1), 128, dtype=np.uint8), np.zeros(8, dtype=np.int32)
    held = gc.Box(axes[1:], (-0.5,), (0.25,))
    made = gapcert_cells.GridController(goal, (edges,), np.zeros((1, 1)), bits, values, {}, held=held, promised=promised)
    _, info = made.step(np.array([3.0, 0.0]))
    width = np.pi / 4
    assert np.allclose(info.tube, [[[np.pi, np.pi + 2 * width], [-0.5, 0.25]]])
    assert info.left is None
    # Where a cell beyond the grid is promised, nothing is said.
    beyond = replace(made, promised=gapcert_cells.Successors((8,), (False,), (along,)), goal=goal, held=held)
    beyond = replace(beyond, goal=replace(goal, stay=gc.Box(axes, (-3.0, -1.0), (3.0, 1.0))), edges=(np.linspace(-3, 3, 9),))
    assert beyond.step(np.array([2.9, 0.0]))[1].tube is None


@pytest.mark.exam
def test_a_run_goes_on_with_what_it_remembers() -> None:
    """Online to the end of a task in two parts: fewer steps are left each time, and the next state is in its tube."""
    automaton = gapcert_cells.automaton_of("F (a & F b)")
    made = Symbolic({"x0": 20, "x1": 20}, {"u0": 5, "u1": 5}).synthesize(tasks.problem(automaton, tasks.REGIONS, BAND))
    rng, x, memory, left = np.random.default_rng(0), np.array([0.5, 0.9]), None, []
    for _ in range(100):
        u, info = made.step(x, memory)
        if u is None:
            break
        left.append(info.left)
        x, memory = tasks.MODEL.step(x[None], u[None]).x[0] + rng.uniform(BAND.low, BAND.high), info.memory
        assert ((x >= info.tube[0, :, 0]) & (x <= info.tube[0, :, 1])).all()
    assert (info.source, info.left) == ("reached", 0)
    assert len(left) > 5
    assert (np.diff(left) < 0).all()
    # A run that has forgotten that it was in the first region is not done.
    assert made.step(x)[1].source == "solved"


def test_a_controller_of_another_certificate_does_not_verify(
    run: gc.Run, tmp_path: Path, known: None, capsys: pytest.CaptureFixture[str]
) -> None:
    """A controller that another run has saved, under γ of another budget, stands in place of this one's."""
    assert main(["verify", str(run.folder)]) == 0
    assert re.search("passed +the controller is of this certificate", capsys.readouterr().out)
    other = SPEC | {"closed_loop": {"steps": 1, "starts": 1}, "sampling": SPEC["sampling"] | {"budget": 150}}
    theirs = gc.run(other | {"report": {"rerun": False, "html": False}}, out=tmp_path / "other").folder
    swapped = tmp_path / "swapped"
    shutil.copytree(run.folder, swapped)
    shutil.rmtree(swapped / "controller")
    shutil.copytree(theirs / "controller", swapped / "controller")
    assert gc.load_controller(swapped / "controller" / "with_gamma").wins
    assert main(["verify", str(swapped), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    failed = [c["detail"] for c in found["checks"] if not c["passed"]]
    assert "controller/with_gamma/controller.json was changed, or is missing" in failed
    own, named = (hashlib.sha256((f / "certificate.json").read_bytes()).hexdigest() for f in (run.folder, theirs))
    assert f"the saved controller rests on certificate {named[:16]}…, and this one is {own[:16]}…; run the spec again" in failed


# --- what it foresees


def test_predictions_stand_in_the_figures_and_in_the_report(run: gc.Run) -> None:
    loop = Figures.load(run.folder).loop
    assert loop is not None
    assert [f.step for f in loop.foreseen] == [0, 6, 12, 18]
    trace = next(r.traces[0] for r in loop.runs if r.gamma)
    for f in loop.foreseen:
        assert f.low.shape == (7, 2)
        assert np.allclose(f.centre[0], trace[f.step])
        then = trace[f.step : f.step + 7]
        assert ((then >= f.low) & (then <= f.high)).all()
    # At every step the next state, relative to its plan.
    assert loop.ahead.kept.tolist() == [True] * 24
    assert np.allclose(loop.ahead.high, run.controller.gamma)
    expected = run.controller.centre + run.controller.shrink * (trace[:24] - run.controller.centre)
    assert np.allclose(loop.ahead.error, trace[1:25] - expected)
    page = (run.folder / "report.html").read_text()
    for text in ("x as it is foreseen", "A run in its tubes", "All of the 24 next states lie in their box"):
        assert text in page


def test_a_tube_without_its_margin_is_told(run: gc.Run) -> None:
    figures, c = Figures.load(run.folder), run.controller
    narrow = replace(c, gamma=0.01 * c.gamma)
    x = run.closed_loop.with_gamma.x[int(np.argsort(~run.closed_loop.without_gamma.violation, kind="stable")[0])]
    told, ahead = foreseen(narrow, x, "first")
    assert (~ahead.kept).sum() > 0
    first, *_ = foresight_pictures(replace(figures.loop, foreseen=told, ahead=ahead), figures.winning)
    assert f"{ahead.kept.sum()} of the {len(ahead.kept)} next states lie in their box" in first.caption
    assert "outside" in [e.name for e in first.legend]


def test_a_tube_that_is_a_line_says_so(run: gc.Run) -> None:
    """Boxes that could not be seen are not drawn over two states; over time the caption has their size."""
    figures = Figures.load(run.folder)
    lines = tuple(Foreseen(f.step, f.centre, f.centre - 1e-4, f.centre + 1e-4) for f in figures.loop.foreseen)
    ahead, over_time = foresight_pictures(replace(figures.loop, foreseen=lines), figures.winning)
    assert ahead.title.endswith("one step ahead")
    assert "Its tube is ± 10⁻⁴ at its widest: a line in this picture." in over_time.caption
    assert "a line in this picture" not in foresight_pictures(figures.loop, figures.winning)[1].caption


def test_it_is_asked_only_as_often_as_it_says(run: gc.Run) -> None:
    asked = []

    class Counting(FeedbackController):
        def contains(self, x: np.ndarray) -> np.ndarray:
            asked.append(len(x))
            return super().contains(x)

    c = run.controller
    counting = Counting(c.goal, c.gain, c.shrink, c.gamma, c.radius, c.evidence)
    figure = winning_figure(counting, counting)
    assert figure.with_gamma.shape == (24, 24)
    assert sum(asked) == 2 * 24**2


def test_who_foresees_nothing_has_no_such_picture(small_run: gc.Run) -> None:
    loop = small_run.closed_loop
    both = [gc.load_controller(small_run.folder / "controller" / name) for name in ("with_gamma", "without_gamma")]
    figure = loop_figure(loop, gc.load_spec(small_run.folder / "spec.json").build("model"), *both)
    assert figure.foreseen == ()
    assert foresight_pictures(figure, Figures.load(small_run.folder).winning) == []
    assert "as it is foreseen" not in (small_run.folder / "report.html").read_text()


def test_who_asks_for_no_policy_asks_for_those_that_are_known(tmp_path: Path, known: None) -> None:
    """Nothing is told of others; what a spec names and no controller knows is."""
    few = {"steps": 3, "starts": 2}
    for asked, skipped in ((few, None), (few | {"policies": ["first", "adversarial"]}, ["adversarial"])):
        found = gc.run(SPEC | {"closed_loop": asked, "report": {"rerun": False, "html": False}}, out=tmp_path)
        assert found.summary["closed_loop"].get("skipped") == skipped


def test_starts_that_are_refused_are_told(run: gc.Run) -> None:
    loop = run.summary["closed_loop"]
    assert (loop["with_gamma"]["refused"], loop["without_gamma"].get("refused")) == (0, None)
    some = json.loads(json.dumps(run.summary))
    for row in (some["closed_loop"]["with_gamma"], some["closed_loop"]["policies"][0]):
        row |= {"starts": 9, "refused": 3}
    assert "0 of 9 runs fail, 3 of the starts drawn are refused" in "\n".join(in_words(some))
    assert "3 further starts, where the controller without γ wins, are refused with γ" in loop_sentence(some)
    shown = str(_policies(some["closed_loop"]["policies"]))
    assert "12 runs of at most 40 steps each" in shown
    assert "refused" in shown


def test_steps_with_a_plan_of_before_are_counted(run: gc.Run) -> None:
    for row in run.summary["closed_loop"]["policies"]:
        # Of 40 steps, 14 are planned afresh.
        assert row["fallbacks"] == 12 * (40 - 14)
    assert "312 steps went on with a plan of before" in "\n".join(in_words(run.summary))
    assert "on an old plan" in (run.folder / "report.html").read_text()
