"""Halved cells for goals with an automaton: the positions that win are those of the fine grid, and runs keep the promise."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import touched
from exported import driven, imported, replayed
from halving import nested
from tasks import AGAIN, REGIONS, ROCS, SPEC, problem

import gapcert
from gapcert import Box, Goal, Region, UsageError, closed_loop
from gapcert.plugin import Automaton
from gapcert.testing.toys import Drift
from gapcert_cells import AutomatonController, automaton_of, read_hoa
from gapcert_cells.export.export import export
from gapcert_cells.testing import Band
from gapcert_symbolic.cells.abstraction import Windows
from gapcert_symbolic.games import refinement
from gapcert_symbolic.games.games import Labels, leads_of, product, started
from gapcert_symbolic.games.refinement import Refined, refined
from gapcert_symbolic.solvers.problem import Solution
from gapcert_symbolic.synthesizer import Symbolic
from gapcert_symbolic.thresholds import THRESHOLDS

AUTOMATA = [*map(automaton_of, ("F (a & F b)", "F a & F b", "!a U b", "F (a & X b)")), read_hoa(AGAIN)]


def goal_of(box: Box, automaton: Automaton, rng: np.random.Generator) -> Goal:
    def part(width: float) -> Region:
        span = np.asarray(box.high)
        low = rng.random(len(span)) * span * (1 - width)
        return Region((Box(box.axes, tuple(low.tolist()), tuple((low + width * span).tolist())),))

    avoid = part(0.3) if rng.random() < 0.5 else None
    return Goal("automaton", box, None, avoid, automaton, tuple(part(0.5) for _ in automaton.propositions))


def solved(windows: Windows, goal: Goal) -> tuple[Solution, Labels]:
    assert goal.automaton is not None
    safe = ~windows.grid.touching(goal.avoid)
    labels = Labels.of(windows.grid, goal.regions)
    return product(windows, safe, goal.automaton, labels), labels


def drawn(rng: np.random.Generator) -> tuple[list[Windows], Goal, Refined, np.ndarray]:
    """A random game on nested windows, what is found, and the node of each cell of the finest grid."""
    levels, automaton = int(rng.integers(1, 4)), AUTOMATA[rng.integers(len(AUTOMATA))]
    made = nested(int(rng.integers(1, 3)), int(rng.integers(1, 4)), levels, rng)
    goal, by_grid = goal_of(made[0].grid.box, automaton, rng), {w.grid.counts: w for w in made}
    coarse = solved(made[0], goal)[0]
    found = refined(goal, levels, coarse, made[0], lambda grid, _: by_grid[grid.counts])
    return made, goal, found, replace(found.splits, levels=levels).painted()


@pytest.mark.exam
def test_positions_win_as_on_the_fine_grid() -> None:
    rng, more, fewer = np.random.default_rng(2), 0, 0
    for _ in range(150):
        made, goal, found, painted = drawn(rng)
        fine, labels = solved(made[-1], goal)
        assert goal.automaton is not None
        assert found.wins is not None
        assert np.array_equal(found.solution.values[:, painted] >= 0, fine.values >= 0)
        won = started(goal.automaton, labels, fine.values >= 0)
        assert np.array_equal(found.wins[painted], won)
        assert found.levels[-1]["winning_fraction"] == pytest.approx(won.mean(), abs=1e-12)
        more += found.levels[-1]["winning_fraction"] > found.levels[0]["winning_fraction"] > 0
        fewer += (found.splits.first == 0).sum() < made[-1].grid.size and won.any()
    assert more > 15
    assert fewer > 40


def kept(made: list[Windows], goal: Goal, found: Refined, painted: np.ndarray) -> bool:
    """Every kept input leads into nodes that can be entered, however they are read, in fewer steps."""
    automaton, values = goal.automaton, found.solution.values
    assert automaton is not None
    assert found.labels is not None
    leads, kind = leads_of(automaton, found.labels)
    bits = np.unpackbits(found.solution.bits, axis=2, count=made[0].inputs).astype(bool)
    fine = made[-1].grid
    for q, node in np.argwhere((values >= 0) & (found.splits.first == 0)):
        if automaton.done[q]:
            continue
        level = int(found.splits.level(np.array([node]))[0])
        windows, left = made[level], len(made) - 1 - level
        cell = np.ravel_multi_index(tuple(found.splits.index[node]), windows.grid.counts)
        inputs = np.flatnonzero(bits[q, node])
        if not len(inputs):
            return False
        for j in inputs:
            first, last = (e[0] for e in touched.ends(windows, np.array([cell]), np.array([j])))
            sides = zip(first << left, (last + 1) << left, fine.counts, fine.wraps, strict=True)
            ranges = [np.arange(a, b) % c if w else np.arange(a, b) for a, b, c, w in sides]
            if any(r[0] < 0 or r[-1] >= c for r, c in zip(ranges, fine.counts, strict=True)):
                return False
            after = painted.reshape(fine.counts)[np.ix_(*ranges)].ravel()
            steps = [values[t, n] for n in after for t in np.flatnonzero(leads[q, kind[n], :-1])]
            most = np.inf if values[q, node] == 0 else values[q, node] - 1
            if leads[q, kind[after], -1].any() or min(steps) < 0 or max(steps) > most:
                return False
    return True


def test_each_input_leads_to_what_can_be_entered_in_fewer_steps() -> None:
    """And planted faults: a losing input more, a position that loses."""
    rng, broken = np.random.default_rng(3), 0
    for _ in range(60):
        game = drawn(rng)
        made, goal, found, painted = game
        assert kept(*game)
        bits = np.where((found.solution.values >= 0)[:, :, None], np.uint8(0xFF << (8 - made[0].inputs) & 0xFF), np.uint8(0))
        broken += not kept(made, goal, found._replace(solution=replace(found.solution, bits=bits)), painted)
    assert broken > 8


def test_without_the_borders_of_regions_cells_are_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Planted fault: cells are halved only for the positions that lose there, not for the readings of their parts."""
    monkeypatch.setattr(refinement, "_in_part", lambda leads, kind, *given: np.zeros(len(kind), dtype=bool))
    rng, lost = np.random.default_rng(2), 0
    for _ in range(80):
        made, goal, found, painted = drawn(rng)
        fine = solved(made[-1], goal)[0].values >= 0
        assert not ((found.solution.values[:, painted] >= 0) & ~fine).any()
        lost += not np.array_equal(found.solution.values[:, painted] >= 0, fine)
    assert lost


@cache
def drift(text: str, refine: int) -> AutomatonController:
    automaton = read_hoa(AGAIN) if text == AGAIN else automaton_of(text)
    given = problem(automaton, REGIONS, Band((-0.01, -0.01), (0.01, 0.02)))
    side = 10 if refine else 40
    made = Symbolic({"x0": side, "x1": side}, {"u0": 3, "u1": 3}, refine=refine).synthesize(given)
    assert isinstance(made, AutomatonController)
    return made


@pytest.mark.exam
@pytest.mark.parametrize("text", [ROCS, AGAIN])
def test_runs_on_halved_cells_keep_the_promise(text: str) -> None:
    ours, fine = drift(text, 2), drift(text, 0)
    x = np.random.default_rng(1).random((4000, 2))
    assert np.array_equal(ours.contains(x), fine.contains(x))
    assert ours.evidence["cells"] < fine.evidence["cells"]
    assert ours.evidence["winning_fraction"] == pytest.approx(fine.evidence["winning_fraction"], abs=1e-12)
    start = ours.draw(40, np.random.default_rng(2))
    rng = np.random.default_rng(3)

    class Blown(Drift):
        def _step(self, x: Any, u: Any, **options: Any) -> Any:
            return super()._step(x, u) - 0.01 + np.array([0.02, 0.03]) * rng.random(x.shape).round(1)

    for policy in ours.policies:
        trace = closed_loop(Blown(2), ours, start, 150, policy)
        assert not trace.violation.any()
        assert not trace.broken.any()
        assert (trace.counted > 2).all() if text == AGAIN else trace.reached.all()


def test_saved_and_exported_halved_cells_answer_as_before(tmp_path: Path) -> None:
    made = drift(ROCS, 2)
    made.save(tmp_path / "c")
    again = AutomatonController.load(tmp_path / "c")
    x = np.random.default_rng(1).random((3000, 2))
    assert again.digest() == made.digest()
    assert again.parts[0].splits is not None
    assert np.array_equal(again.value(x), made.value(x))
    facts = export(made, "numpy", tmp_path / "n")
    assert facts["cells"] == made.evidence["cells"]
    other = imported(tmp_path / "n" / "controller.py").Controller()
    assert np.array_equal(other.contains(x), made.contains(x))
    x = x[made.contains(x)]
    memory = made.start(x)
    assert np.array_equal(other.start(x), memory)
    offered = np.array([made.parts[q].allowed(made.parts[q].cells(p[None]))[0].any() for p, q in zip(x, memory, strict=True)])
    x, memory = x[offered], memory[offered]
    for policy in ("first", "last", "random"):
        expected = made.respond(x, memory, policy, 2, 3)  # type: ignore[arg-type]
        assert np.array_equal(again.respond(x, memory, policy, 2, 3), expected)  # type: ignore[arg-type]
        assert np.array_equal(other.act(x, policy, 2, 3, memory), expected)


@pytest.mark.contract
@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler: `cc` is not on the path")
def test_c_on_halved_cells_remembers_as_the_original(tmp_path: Path) -> None:
    made = drift(ROCS, 2)
    export(made, "c", tmp_path)
    x = np.random.default_rng(4).uniform(-0.1, 1.1, (20_000, 2))
    rows, mine = driven(tmp_path, x), replayed(made, x)
    assert set(mine[:, 0].tolist()) >= {0.0, 1.0}
    assert np.array_equal(rows, mine)


def test_a_spec_with_a_formula_runs_on_halved_cells(tmp_path: Path) -> None:
    changed = ["controller.cells={x: 13, y: 13}", "controller.refine=1", "report.html=false"]
    run = gapcert.run(gapcert.load_spec(SPEC, changed), out=tmp_path)
    assert run.summary["verdict"] == "holds"
    first, last = (level["winning_fraction"] for level in run.summary["controller"]["levels"])
    assert first < last == run.summary["controller"]["winning_fraction"]
    row = run.summary["closed_loop"]["with_gamma"]
    assert (row["violations"], row["broken_promises"], row["reached"]) == (0, 0, 20)
    assert AutomatonController.load(run.folder / "controller" / "with_gamma").digest() == run.controller.digest()


def test_too_many_positions_are_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gapcert_symbolic.games.refinement.THRESHOLDS", replace(THRESHOLDS, memory=1e5))
    given = problem(automaton_of(ROCS), REGIONS)
    with pytest.raises(UsageError, match=r"on level \d need .* GB \(limit 0\); use a smaller number"):
        Symbolic({"x0": 10, "x1": 10}, {"u0": 3, "u1": 3}, refine=2).synthesize(given)
