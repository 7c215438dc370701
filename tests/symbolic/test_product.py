"""Games on cells × automaton states against textbook fixpoints on explicit positions, and the controllers with memory."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tasks import AGAIN, MODEL, REGIONS, ROCS, SPEC, box, problem

import gapcert
from gapcert import Box, Domain, Ellipsoid, Goal, Region, SynthesisProblem, UsageError, closed_loop
from gapcert.plugin import Automaton
from gapcert.testing.toys import Drift
from gapcert_cells import AutomatonController, GridController, automaton_of, read_hoa
from gapcert_cells.testing import Band
from gapcert_closed_loop.closed_loop import compare_loops
from gapcert_symbolic.cells.abstraction import windows
from gapcert_symbolic.cells.bounds import Enclosed
from gapcert_symbolic.cells.grid import Grid, combined
from gapcert_symbolic.games.games import Labels, product
from gapcert_symbolic.synthesizer import Symbolic

SIDE = 11


def explicit(given: SynthesisProblem, side: int) -> tuple[set[tuple[int, int]], dict[Any, set[int]], Any, Any]:
    """Winning positions (cell, q), and per position the inputs whose successors all win; positions by pure set iteration."""
    automaton = given.goal.automaton
    assert automaton is not None
    grid = Grid(given.goal.stay, (side, side))
    axes = (np.linspace(-1, 1, 3),) * 2
    gap = given.gap.interval(np.zeros((1, 4))) if given.gap is not None else None
    lower, upper = grid.cells(0, grid.size)
    points = combined(axes)
    edges = grid.edges[0]

    def read(cell: int) -> list[int]:
        letters = [0]
        for p, region in enumerate(given.goal.regions):
            whole = any((lower[cell] >= b.low).all() and (upper[cell] <= b.high).all() for b in region.boxes)
            some = any((lower[cell] <= b.high).all() and (upper[cell] >= b.low).all() for b in region.boxes)
            letters = [n | bit << p for n in letters for bit in ([1] if whole else [0, 1] if some else [0])]
        return letters

    def post(cell: int, u: Any) -> set[int] | None:
        low, high = lower[cell] + 0.1 * u - 1e-11, upper[cell] + 0.1 * u + 1e-11
        if gap is not None:
            low, high = low + gap[0][0], high + gap[1][0]
        if (low < 0).any() or (high > 1).any():
            return None
        rows = [[i for i in range(side) if edges[i] <= b and edges[i + 1] >= a] for a, b in zip(low, high, strict=True)]
        return {i * side + j for i, j in itertools.product(*rows)}

    avoid = given.goal.avoid.boxes if given.goal.avoid else ()
    safe = {c for c in range(grid.size) if not any((lower[c] <= b.high).all() and (upper[c] >= b.low).all() for b in avoid)}
    letters = [read(c) for c in range(grid.size)]
    after = {c: [post(c, u) for u in points] for c in range(grid.size)}
    leads = {(q, c): {automaton.after[q][n] for n in letters[c]} for q in range(len(automaton.after)) for c in safe}

    def wins(q: int, cells: set[int] | None, good: set[tuple[int, int]]) -> bool:
        return cells is not None and cells <= safe and all((c, t) in good for c in cells for t in leads[q, c])

    def inputs(position: tuple[int, int], good: set[tuple[int, int]]) -> set[int]:
        return {j for j, cells in enumerate(after[position[0]]) if wins(position[1], cells, good)}

    positions = {(c, q) for c in safe for q in range(len(automaton.after))}
    z = positions
    while True:
        x = {(c, q) for c, q in positions if automaton.done[q]}
        x |= {(c, q) for c, q in positions if automaton.accepting[q] and not automaton.done[q] and inputs((c, q), z)}
        while more := {p for p in positions - x if not automaton.accepting[p[1]] and inputs(p, x)}:
            x |= more
        if x == z:
            return x, {p: inputs(p, x) for p in x}, after, leads
        z = x


def synthesized(given: SynthesisProblem, side: int = SIDE) -> AutomatonController:
    made = Symbolic({"x0": side, "x1": side}, {"u0": 3, "u1": 3}).synthesize(given)
    assert isinstance(made, AutomatonController)
    return made


CASES = [
    (automaton_of("F a"), None, None),
    (automaton_of("F (a & F b)"), Band((-0.01, -0.02), (0.0, 0.01)), None),
    (automaton_of("!b U a"), None, Region((box(MODEL, (0.44, 0.6), (0.5, 1.0)),))),
    (automaton_of(ROCS), Band((-0.005, -0.005), (0.005, 0.005)), None),
    (automaton_of("F (a & X (X b)) | (F c & F b)"), None, None),
    (read_hoa(AGAIN), Band((-0.005, -0.005), (0.005, 0.005)), Region((box(MODEL, (0.44, 0.0), (0.5, 0.3)),))),
    (read_hoa('HOA: v1 States: 1 Start: 0 AP: 1 "c" Acceptance: 0 t --BODY-- State: 0 [!0] 0 --END--'), None, None),
]


@pytest.mark.exam
@pytest.mark.parametrize(("automaton", "gap", "avoid"), CASES)
def test_positions_equal_the_textbook_fixpoint(automaton: Automaton, gap: Any, avoid: Any) -> None:
    given = problem(automaton, REGIONS, gap, avoid)
    made = synthesized(given)
    won, valid, after, leads = explicit(given, SIDE)
    values = np.stack([part.values for part in made.parts])
    assert {(int(c), int(q)) for q, c in np.argwhere(values >= 0)} == won
    assert 0 < len(won) <= values.size
    for c, q in won:
        chosen = set(np.flatnonzero(made.parts[q].allowed(np.array([c]))[0]).tolist())
        if automaton.done[q]:
            assert len(chosen) == 9
        elif automaton.accepting[q]:
            assert chosen == valid[c, q]
        else:
            # Exactly the inputs that get nearer, and by one step if all goes badly.
            last = {j: [values[t, d] for d in after[c][j] for t in leads[q, d]] for j in valid[c, q]}
            assert chosen == {j for j, found in last.items() if 0 <= max(found) < values[q, c]}
            assert values[q, c] == 1 + min(max(found) for found in last.values())


def test_one_region_for_ever_is_invariance_and_one_to_come_is_reach() -> None:
    safety = read_hoa('HOA: v1 States: 1 Start: 0 AP: 1 "b" Acceptance: 0 t --BODY-- State: 0 [!0] 0 --END--')
    given = problem(safety, REGIONS)
    made = synthesized(given)
    plain = replace(given, goal=Goal("invariance", given.goal.stay, avoid=REGIONS["b"]))
    other = Symbolic({"x0": SIDE, "x1": SIDE}, {"u0": 3, "u1": 3}).synthesize(plain)
    x = np.random.default_rng(0).random((2000, 2))
    sure = other.contains(x)
    assert made.contains(x)[sure].all()
    assert made.evidence["winning_cells"] == other.evidence["winning_cells"] > 0
    # Beside the obstacle there are cells at its border, which win only for points outside it.
    assert not REGIONS["b"].contains(x[made.contains(x)]).any()
    given = problem(automaton_of("F a"), REGIONS)
    plain = replace(given, goal=Goal("reach_avoid", given.goal.stay, REGIONS["a"]))
    other = Symbolic({"x0": SIDE, "x1": SIDE}, {"u0": 3, "u1": 3}).synthesize(plain)
    assert (synthesized(given).contains(x) >= other.contains(x)).all()


def worded(controller: AutomatonController, x: np.ndarray) -> list[set[str]]:
    named = zip(controller.automaton.propositions, controller.goal.regions, strict=True)
    inside = {name: region.contains(x) for name, region in named}
    return [{name for name, column in inside.items() if column[k]} for k in range(len(x))]


def test_runs_keep_the_word() -> None:
    """First a, later b, later c with no b from then on until a again."""
    made = synthesized(problem(automaton_of(ROCS), REGIONS, Band((-0.005,) * 2, (0.005,) * 2)), 25)
    x0 = made.draw(60, np.random.default_rng(0))
    assert len(x0) > 30
    for policy in ("first", "last", "middle", "random"):
        trace = closed_loop(Drift(2), made, x0, 200, policy)
        assert trace.reached.all()
        assert not trace.violation.any()
        for run in trace.x:
            word = worded(made, run[np.isfinite(run).all(axis=1)])
            a, b, c = ([k for k, holds in enumerate(word) if name in holds] for name in "abc")
            tails = [(k, min(m for m in a if m >= k)) for k in c if a and max(a) >= k]
            fine = [k for k, end in tails if not any(k <= m < end for m in b) and any(m <= k and a[0] <= m for m in b)]
            assert fine, word


def test_steps_keep_the_promise_and_others_do_not() -> None:
    made = synthesized(problem(automaton_of(ROCS), REGIONS, Band((-0.005,) * 2, (0.005,) * 2)), 25)
    x0 = made.draw(60, np.random.default_rng(0))
    assert made.policies == ("first", "middle", "last", "random", "least-effort")
    for policy in made.policies:
        assert not closed_loop(Drift(2), made, x0, 60, policy).broken.any()
    u, memory = made.act(x0, "first"), made.start(x0)
    after = Drift(2).step(x0, u).x
    assert made.kept(x0, u, after, memory).all()
    # To stay where one is takes no step off the value, and another cell was not promised.
    on = ~made.over(x0, memory)
    assert on.sum() > 20
    assert not made.kept(x0, u, x0, memory)[on].any()
    assert not made.kept(x0, u, after[::-1], memory)[on].all()


def test_runs_visit_both_again_and_again() -> None:
    made = synthesized(problem(read_hoa(AGAIN), REGIONS, Band((-0.005,) * 2, (0.005,) * 2)), 25)
    x0 = made.draw(20, np.random.default_rng(0))
    trace = closed_loop(Drift(2), made, x0, 200, "random")
    assert not trace.violation.any()
    assert not trace.reached.any()
    assert (trace.counted >= 5).all()
    loops = compare_loops(Drift(2), made, made, starts=10, steps=100, policies=("first",))
    row = loops.count("with_gamma")
    assert row.visits is not None
    assert row.visits >= 2
    assert (row.reached, row.settled) == (None, None)
    ended = synthesized(problem(automaton_of("F (a & F b)"), REGIONS), 25)
    row = compare_loops(Drift(2), ended, ended, starts=10, steps=100, policies=("first",)).count("with_gamma")
    assert (row.reached, row.visits, row.violations) == (10, None, 0)


def line(low: float, high: float) -> Region:
    return Region((Box(Drift(1).states, (low,), (high,)),))


def test_a_border_cell_is_not_trusted() -> None:
    """b is met from the left only through a cell that a touches. Read at its centre, it lets runs through that meet a."""
    model = Drift(1)
    automaton = automaton_of("!a U b")
    goal_regions = {"a": line(0.46, 0.47), "b": line(0.72, 1.0)}
    domain = Domain.of(model, {"x0": (0.0, 1.0), "u0": (-1.0, 1.0)})
    grid, axes = Grid(domain.states, (20,)), (np.linspace(-1, 1, 9),)
    paths = windows(Enclosed(model), grid, axes, None)
    regions = tuple(goal_regions[n] for n in automaton.propositions)
    sound = Labels.of(grid, regions)
    touched = np.flatnonzero(sound.may >> automaton.propositions.index("a") & 1)
    assert touched.tolist() == [9]
    assert not (sound.must >> automaton.propositions.index("a") & 1).any()
    middles = np.concatenate([(a + b) / 2 for a, b in [grid.cells(0, 20)]])
    centre = sum(r.contains(middles).astype(np.int64) << p for p, r in enumerate(regions))
    goal = Goal("automaton", domain.states, None, None, automaton, regions)
    points = combined(axes)

    def made(labels: Labels) -> AutomatonController:
        solution = product(paths, np.ones(20, dtype=bool), automaton, labels)
        parts = tuple(
            GridController(goal, grid.edges, points, b, v, {}) for b, v in zip(solution.bits, solution.values, strict=True)
        )
        # The true regions are read at run time; only the game was solved with other labels.
        return AutomatonController(goal, parts, np.zeros(20, np.int64), np.full(20, 3), {})

    x0 = np.linspace(0.005, 0.995, 400)[:, None]
    trusting, wary = made(Labels(centre, centre)), made(sound)
    start = x0[trusting.contains(x0)]
    assert start.min() < 0.1
    ran = [closed_loop(model, trusting, start, 60, policy).violation.any() for policy in ("first", "last", "middle", "random")]
    assert any(ran)
    start = x0[wary.contains(x0)]
    # Points right beside a, in the cell that it touches, may start; no run comes into that cell.
    assert 0.45 < start.min() < 0.46
    assert not wary.contains(np.array([[0.465]]))[0]
    for policy in ("first", "last", "middle", "random"):
        assert not closed_loop(model, wary, start, 60, policy).violation.any()


def test_labels_of_cells() -> None:
    grid = Grid(box(MODEL, (0.0, 0.0), (1.0, 1.0)), (10, 10))
    ball = Region(ellipsoids=(Ellipsoid.of(grid.box, {"x0": 0.5, "x1": 0.5}, {"x0": 0.31, "x1": 0.31}),))
    labels = Labels.of(grid, (ball, REGIONS["a"]))
    assert ((labels.must & ~labels.may) == 0).all()
    border = labels.must != labels.may
    assert 10 < border.sum() < 60
    letters, kind = labels.kinds()
    for cell in range(grid.size):
        some = letters[kind[cell]]
        assert all((n | labels.must[cell]) & labels.may[cell] == n for n in some)
        assert len(some) == 2 ** int(labels.may[cell] & ~labels.must[cell]).bit_count()


def test_saved_and_loaded_bit_for_bit(tmp_path: Path) -> None:
    made = synthesized(problem(automaton_of(ROCS), REGIONS))
    made.save(tmp_path / "c")
    again = AutomatonController.load(tmp_path / "c")
    assert (again.goal, again.digest(), dict(again.evidence)) == (made.goal, made.digest(), dict(made.evidence))
    x = np.random.default_rng(1).random((500, 2))
    assert np.array_equal(again.contains(x), made.contains(x))
    x = x[made.contains(x)]
    assert np.array_equal(again.act(x, "random", 3), made.act(x, "random", 3))
    with pytest.raises(UsageError, match="has a memory; load it with AutomatonController"):
        GridController.load(tmp_path / "c")
    data = json.loads((tmp_path / "c" / "controller.json").read_text())
    data["goal"]["automaton"]["after"][0][0] = 1
    (tmp_path / "c" / "controller.json").write_text(json.dumps(data))
    with pytest.raises(UsageError, match="do not belong together"):
        AutomatonController.load(tmp_path / "c")
    with pytest.raises(UsageError, match="no saved controller"):
        AutomatonController.load(tmp_path / "d")
    plain = replace(problem(automaton_of("F a"), REGIONS), goal=Goal("invariance", box(MODEL, (0.0, 0.0), (1.0, 1.0))))
    Symbolic({"x0": 5, "x1": 5}, {"u0": 3, "u1": 3}).synthesize(plain).save(tmp_path / "e")
    with pytest.raises(UsageError, match=r"has no memory; load it with GridController"):
        AutomatonController.load(tmp_path / "e")


def test_outside_is_an_error_and_lost_stays_lost() -> None:
    made = synthesized(problem(automaton_of("!b U a"), REGIONS))
    x = np.array([[0.8, 0.2]])
    assert made.start(x).tolist() == [-1]
    assert not made.contains(x)[0]
    assert made.advance(np.array([[0.1, 0.1]]), np.array([-1])).tolist() == [-1]
    with pytest.raises(UsageError, match="outside its domain; ask `keeps`"):
        made.act(x, "first")


def test_a_region_without_cells_is_named() -> None:
    given = problem(automaton_of("F (a & F b)"), REGIONS | {"b": Region((box(MODEL, (0.51, 0.51), (0.52, 0.52)),))})
    made = synthesized(given)
    assert made.evidence["winning_cells"] == 0
    assert made.evidence["reason"].startswith("no cell lies wholly inside region b")


def test_parts_of_the_goal_must_fit() -> None:
    stay = box(MODEL, (0.0, 0.0), (1.0, 1.0))
    with pytest.raises(UsageError, match="one per proposition"):
        Goal("automaton", stay, automaton=automaton_of("F a"))
    with pytest.raises(UsageError, match="one per proposition"):
        Goal("invariance", stay, automaton=automaton_of("F a"), regions=(REGIONS["a"],))
    with pytest.raises(UsageError, match="region a is over x0"):
        Goal("automaton", stay, automaton=automaton_of("F a"), regions=(line(0.0, 0.5),))


@pytest.mark.run
def test_a_whole_run(tmp_path: Path) -> None:
    run = gapcert.run(gapcert.load_spec(SPEC), out=tmp_path)
    assert run.summary["verdict"] == "holds"
    assert run.summary["controller"]["automaton_states"] == 4
    row = run.summary["closed_loop"]["with_gamma"]
    assert (row["violations"], row["reached"]) == (0, 20)
    assert (run.folder / "report.html").stat().st_size > 10_000
    saved = AutomatonController.load(run.folder / "controller" / "with_gamma")
    assert saved.evidence["winning_cells"] == run.summary["controller"]["winning_cells"] > 300
    turns = 'AP: 2 "left" "right" Acceptance: 1 Inf(0) --BODY-- State: 0 {0} [!1] 1 [1] 1 State: 1 [!1] 1 [1&!0] 2 [1&0] 2'
    (tmp_path / "turns.hoa").write_text(f"HOA: v1 States: 3 Start: 1 {turns} State: 2 [!0] 2 [0] 0 --END--")
    goal = f"controller.goal={{automaton: {tmp_path}/turns.hoa, regions: {{left: {{x: [0, 0.3]}}, right: {{x: [0.7, 1]}}}}}}"
    again = gapcert.run(gapcert.load_spec(SPEC, [goal, "name=turns"]), out=tmp_path)
    row = again.summary["closed_loop"]["with_gamma"]
    assert (again.summary["verdict"], row["violations"]) == ("holds", 0)
    assert "reached" not in row
    assert row["visits"] >= 5


@pytest.mark.exam
def test_a_car_with_a_task_of_several_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = gapcert.load_spec(Path(__file__).parents[2] / "specs" / "benchmarks" / "car.yaml")
    model = spec.build("model")
    domain = Domain.of(model, dict(spec.config.domain or {}))
    goal = spec.goal(domain)
    made = spec.build("controller").synthesize(SynthesisProblem(model, None, domain, goal))
    assert (made.evidence["cells"], made.evidence["winning_cells"]) == (
        93_636,
        74_994,
    )  # as many as ROCS 2, which finds the same cells
    with monkeypatch.context() as patched:
        # Were a heading that stays to touch the cells beside, fewer would win.
        patched.setattr(type(model), "unmoved", lambda self, u: np.zeros((len(u), 3), dtype=bool))
        touching = spec.build("controller").synthesize(SynthesisProblem(model, None, domain, goal))
    assert touching.evidence["winning_cells"] == 74_900
    x0 = made.draw(40, np.random.default_rng(0))
    trace = closed_loop(model, made, x0, 400, "random")
    assert trace.reached.all()
    # Values bound the number of steps, from the first on.
    first = made.start(x0)
    worst = np.array([made.parts[q].values[made.parts[q].cells(x[None])[0]] for q, x in zip(first, x0, strict=True)])
    assert (np.isfinite(trace.x[:, :, 0]).sum(axis=1) - 1 <= worst).all()


@pytest.mark.exam
def test_a_courier_goes_to_and_fro(tmp_path: Path) -> None:
    """specs/courier.yaml: a formula for ever, with drag that the model lacks; some runs break without γ, none with it."""
    run = gapcert.run(gapcert.load_spec(Path(__file__).parents[2] / "specs/courier.yaml"), out=tmp_path)
    assert run.exit_code == 0, run.summary["expectations"]
    assert run.summary["controller"]["winning_cells"] == 273_748
