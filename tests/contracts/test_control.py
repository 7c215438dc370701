"""GridController: which cell a state belongs to, what it may do there, and the saved form."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gapcert import Box, Ellipsoid, Goal, Polytope, Region, StateSpec, UsageError
from gapcert.plugin import Relation
from gapcert_cells import Along, GridController, Successors
from gapcert_cells.grid_controller import depths

AXES = (StateSpec("x", "m"), StateSpec("y", "m"))
M = 11


def controller(goal: Goal | None = None) -> GridController:
    """11 × 11 cells on the unit square; cell i allows inputs i mod 11 … 10; the cells of column y = 5 are losing."""
    goal = goal or Goal("invariance", Box(AXES, (0.0, 0.0), (1.0, 1.0)))
    edges = tuple(np.linspace(a, b, 12) for a, b in zip(goal.stay.low, goal.stay.high, strict=True))
    allowed = np.arange(M) >= (np.arange(121) % M)[:, None]
    losing = np.arange(121) % 11 == 5
    allowed[losing] = False
    values = np.where(losing, -1, 0).astype(np.int32)
    points = np.linspace(-1.0, 1.0, M)[:, None]
    return GridController(goal, edges, points, np.packbits(allowed, axis=1), values, {"cells": 121, "winning_cells": 110})


def test_a_state_belongs_to_one_cell() -> None:
    c = controller()
    lower = np.array([[a, b] for a in c.edges[0][:-1] for b in c.edges[1][:-1]])
    assert c.cells(lower).tolist() == list(range(121))
    rng = np.random.default_rng(0)
    assert c.cells(lower + 0.99 * rng.random(lower.shape) / 11).tolist() == list(range(121))


def test_the_last_cell_has_its_upper_edge() -> None:
    c = controller()
    assert c.cells(np.array([[1.0, 1.0], [1.0, 0.0], [0.0, 1.0]])).tolist() == [120, 110, 10]


@pytest.mark.parametrize(
    "x",
    [
        (np.nextafter(1.0, 2), 0.1),
        (0.1, np.nextafter(1.0, 2)),
        (-5e-324, 0.1),
        (0.1, -5e-324),
        (1.06, 0.5),
        (0.5, 1.06),
        (-3.0, 0.5),
        (np.nan, 0.1),
        (np.inf, 0.1),
    ],
)
def test_outside_is_an_error_and_never_another_cell(x: tuple[float, float]) -> None:
    """An upper bound of n·η + η/2 instead of (n − 1)·η + η/2 maps (1.06, 0.5) into a cell of the next row."""
    c = controller()
    assert c.cells(np.array([x])).tolist() == [-1]
    assert not c.contains(np.array([x])).any()
    with pytest.raises(UsageError, match=r"row 1: x = .*, y = .* is outside its domain"):
        c.act(np.array([[0.1, 0.1], x]), "first")


def test_losing_cells_are_outside() -> None:
    c = controller()
    x = np.array([[0.1, 0.5], [0.1, 0.1]])
    assert c.contains(x).tolist() == [False, True]
    with pytest.raises(UsageError, match=r"row 0: x = 0.1, y = 0.5 is outside"):
        c.act(x, "last")


def test_rows_outside_are_nan_on_request_and_no_other_row_changes() -> None:
    """A random input is that of its row, whoever else is outside."""
    c, rng = controller(), np.random.default_rng(4)
    x = rng.uniform(-0.3, 1.3, (200, 2))
    x[7] = np.nan
    inside = c.contains(x)
    assert 0 < inside.sum() < 200
    for policy in ("first", "random"):
        u = c.act(x, policy, seed=5, k=3, outside="nan")
        assert np.isnan(u[~inside]).all()
        assert np.array_equal(u[inside], c.act(np.where(inside[:, None], x, 0.05), policy, seed=5, k=3)[inside])
    assert np.isnan(c.act(np.full((3, 2), 7.0), "first", outside="nan")).all()
    for state, told in (((0.1, 1.4), r"\(y = 1.4 is outside \[0, 1\] m\)"), ((0.1, 0.5), r"take outside='nan'$|`act`$")):
        with pytest.raises(UsageError, match=told):
            c.act(np.array([state]), "first")


def test_policies_take_allowed_inputs() -> None:
    c = controller()
    x = np.array([[0.05, (j + 0.5) / 11] for j in range(11) if j != 5])
    lowest = np.array([j for j in range(11) if j != 5])
    assert np.array_equal(c.act(x, "first"), c.points[lowest])
    assert np.array_equal(c.act(x, "last"), np.ones((10, 1)))
    assert np.array_equal(c.act(x, "middle"), c.points[lowest + (11 - lowest) // 2])
    for k in range(50):
        assert (c.act(x, "random", seed=3, k=k) >= c.points[lowest]).all()


def test_random_is_pure_in_seed_step_and_row() -> None:
    c = controller()
    x = np.full((500, 2), 0.05)
    drawn = c.act(x, "random", seed=1, k=2)
    assert np.array_equal(drawn, c.act(x, "random", seed=1, k=2))
    assert np.array_equal(drawn[:7], c.act(x[:7], "random", seed=1, k=2))
    assert not np.array_equal(drawn, c.act(x, "random", seed=1, k=3))
    assert not np.array_equal(drawn, c.act(x, "random", seed=2, k=2))
    # Each of 11 inputs is expected 45 times.
    numbers = np.unique(drawn, return_counts=True)[1]
    assert len(numbers) == 11
    assert numbers.min() > 20


def test_unknown_policy() -> None:
    with pytest.raises(UsageError, match="policy 'best' is unknown; use one of first, middle, last, random, least-effort, adv"):
        controller().act(np.array([[0.1, 0.1]]), "best")  # type: ignore[arg-type]


def test_least_effort_counts_in_ranges() -> None:
    c = controller()
    x = np.array([[0.05, 0.05], [0.05, 0.85], [0.05, 0.95]])
    assert np.array_equal(c.act(x, "least-effort"), [[0.0], c.points[9], [1.0]])
    # 3 of a range of 100 is less than 1 of a range of 2, and of equals the first is taken.
    points = np.array([[-50.0, 1.0], [3.0, 1.0], [0.0, -1.0], [50.0, 0.0], [-3.0, 0.0], [3.0, 0.0]])
    points = np.vstack([points, np.tile(points[3], (M - 6, 1))])
    several = replace(c, points=points, bits=np.packbits(np.ones((121, M), dtype=bool), axis=1))
    assert several.act(x[:1], "least-effort").tolist() == [[-3.0, 0.0]]
    some = replace(several, bits=np.packbits(np.tile(np.arange(M) < 3, (121, 1)), axis=1))
    assert some.act(x[:1], "least-effort").tolist() == [[0.0, -1.0]]


def moving(goal: Goal | None = None, wraps: tuple[bool, bool] = (False, False)) -> GridController:
    """Every cell but those of column y = 5 allows all inputs; input j of 11 moves by j − 5 rows and up to a column."""
    c = controller(goal)
    step, none = np.arange(M) - 5, np.arange(M) * 0
    axes = (Along((), True, np.arange(M), step[None], step[None]), Along((), True, none, np.array([[-1]]), np.array([[1]])))
    allowed = np.tile((c.values >= 0)[:, None], M)
    return replace(c, bits=np.packbits(allowed, axis=1), promised=Successors((11, 11), wraps, axes))


def test_adversarial_goes_to_the_edge_of_the_domain() -> None:
    c = moving()
    # From row 6 down by five is row 1, and up by four is row 10, on the edge; from row 5 down by five is row 0.
    assert c.act(np.array([[6.5 / 11, 2.5 / 11]]), "adversarial")[0, 0] == c.points[9, 0]
    assert c.act(np.array([[5.5 / 11, 2.5 / 11]]), "adversarial")[0, 0] == c.points[0, 0]
    assert c.policies[-1] == "adversarial"


def test_adversarial_is_the_largest_height_at_a_corner() -> None:
    """Against a textbook search over all inputs and corners."""
    whole = Box(AXES, (0.0, 0.0), (1.0, 1.0))
    goal = Goal("reach_avoid", whole, Region((Box(AXES, (0.0, 0.0), (0.1, 0.1)),)))
    c = moving(goal)
    values = np.random.default_rng(5).integers(0, 6, 121).astype(np.int32)
    c = replace(c, values=values, bits=np.packbits(np.random.default_rng(6).random((121, M)) < 0.5, axis=1))
    for cell in np.random.default_rng(7).permutation(121)[:60]:
        i, j = divmod(int(cell), 11)
        best, found = None, -1
        for which in np.flatnonzero(c.allowed(np.array([cell]))[0]):
            row = min(max(i + int(which) - 5, 0), 10)
            at = [int(values[row * 11 + min(max(j + d, 0), 10)]) for d in (-1, -1, 1, 1)]
            score = (max(at), sum(at))
            if best is None or score > best:
                best, found = score, int(which)
        if best is not None:
            assert c.act(np.array([[(i + 0.5) / 11, (j + 0.5) / 11]]), "adversarial")[0, 0] == c.points[found, 0]


def test_depths_count_round_an_angle_that_closes() -> None:
    winning = np.ones((8, 5), dtype=bool)
    winning[0, 2] = False
    around = depths(winning, (True, False)).reshape(8, 5)
    assert around[:, 2].tolist() == [0, 1, 2, 3, 3, 3, 2, 1]
    assert depths(winning, (False, False)).reshape(8, 5)[:, 2].tolist() == [0, 1, 2, 3, 3, 3, 2, 1]
    assert depths(np.ones((6, 3), dtype=bool), (False, False)).reshape(6, 3)[:, 1].tolist() == [1, 2, 2, 2, 2, 1]
    assert (depths(np.ones((6, 3), dtype=bool), (True, True)) == 6).all()


def test_adversarial_needs_what_was_promised() -> None:
    assert "adversarial" not in controller().policies
    with pytest.raises(UsageError, match="policy 'adversarial' needs the promised successors"):
        controller().act(np.array([[0.1, 0.1]]), "adversarial")


def test_value_is_that_of_the_cell() -> None:
    c = controller()
    c = replace(c, values=np.where(c.values < 0, -1, np.arange(121)).astype(np.int32))
    x = np.array([[0.05, 0.05], [0.95, 0.95], [0.05, 0.5], [1.06, 0.5], [np.nan, 0.1]])
    assert c.value(x).tolist() == [0, 120, -1, -1, -1]


def test_a_promise_is_broken_by_a_wrong_cell_input_or_value() -> None:
    c = moving()
    middle = (np.arange(11) + 0.5) / 11
    x, u = np.array([[middle[4], middle[2]]]), c.points[6:7]
    assert c.kept(x, u, np.array([[middle[5], middle[3]]])).tolist() == [True]
    for after in ([middle[6], middle[3]], [middle[5], middle[4]], [middle[5], 1.06], [np.nan, middle[2]]):
        assert c.kept(x, u, np.array([after])).tolist() == [False]
    assert c.kept(x, u + 1e-9, np.array([[middle[5], middle[3]]])).tolist() == [False]
    whole = Box(AXES, (0.0, 0.0), (1.0, 1.0))
    goal = Goal("reach_avoid", whole, Region((Box(AXES, (0.0, 0.0), (0.1, 0.1)),)))
    falling = replace(moving(goal), values=(np.arange(121) // 11).astype(np.int32))
    assert falling.kept(x, c.points[4:5], np.array([[middle[3], middle[3]]])).tolist() == [True]
    assert falling.kept(x, c.points[5:6], x).tolist() == [False]
    assert falling.kept(np.array([[0.05, 0.05]]), c.points[5:6], np.array([[5.0, 5.0]])).tolist() == [True]


def test_what_was_promised_is_saved(tmp_path: Path) -> None:
    c = moving()
    c.save(tmp_path)
    again = GridController.load(tmp_path)
    assert again.digest() == c.digest() != replace(c, promised=None).digest()
    x = c.draw(200, np.random.default_rng(1))
    assert np.array_equal(again.act(x, "adversarial"), c.act(x, "adversarial"))
    assert again.promised is not None


def test_draws_are_winning_and_cover_the_domain() -> None:
    c = controller()
    x = c.draw(5000, np.random.default_rng(0))
    assert len(x) == 5000
    assert c.contains(x).all()
    assert len(np.unique(c.cells(x))) == 110
    empty = replace(c, values=np.full(121, -1, dtype=np.int32))
    assert empty.draw(5, np.random.default_rng(0)).shape == (0, 2)


def test_angles_count_modulo_a_turn() -> None:
    axes = (StateSpec("h", "rad", "angle"), AXES[1])
    narrow = controller(Goal("invariance", Box(axes, (3.0, 0.0), (3.5, 1.0))))
    x = np.array([[3.3, 0.1], [3.3 - 2 * np.pi, 0.1], [3.6, 0.1], [2.9 + 4 * np.pi, 0.1]])
    assert narrow.contains(x).tolist() == [True, True, False, False]
    assert narrow.cells(x)[0] == narrow.cells(x)[1]


def test_save_and_load(tmp_path: Path) -> None:
    box = Box(AXES, (0.2, 0.2), (0.4, 0.4))
    whole = Box(AXES, (0.0, 0.0), (1.0, 1.0))
    c = controller(Goal("reach_avoid", whole, Region((box,)), Region((box, whole))))
    c.save(tmp_path / "new" / "folder")
    again = GridController.load(tmp_path / "new" / "folder")
    assert again.digest() == c.digest()
    assert again.goal == c.goal
    assert again.evidence == c.evidence
    x = c.draw(300, np.random.default_rng(1))
    for policy in ("first", "middle", "last", "random"):
        assert np.array_equal(again.act(x, policy), c.act(x, policy))


def test_digest_sees_every_part() -> None:
    c = controller()
    bits, values, points = c.bits.copy(), c.values.copy(), c.points.copy()
    bits[3, 0] ^= 1
    values[3] = 7
    points[0] -= 0.1
    other = Goal("invariance", Box((StateSpec("x", "cm"), AXES[1]), (0.0, 0.0), (1.0, 1.0)))
    changed = [replace(c, bits=bits), replace(c, values=values), replace(c, points=points), replace(c, goal=other)]
    assert len({c.digest(), *(d.digest() for d in changed)}) == 5
    assert replace(c, evidence={}).digest() == c.digest()


@pytest.mark.fault("the files of a controller are exchanged or damaged", shows="synthesize it again")
def test_damaged_files_are_one_sentence(tmp_path: Path) -> None:
    c = controller()
    with pytest.raises(UsageError, match=r"no saved controller \(controller.json is missing\)"):
        GridController.load(tmp_path)
    c.save(tmp_path)
    whole = (tmp_path / "controller.npz").read_bytes()
    for broken in (whole[: len(whole) // 2], b"", b"nothing"):
        (tmp_path / "controller.npz").write_bytes(broken)
        with pytest.raises(UsageError, match="damaged"):
            GridController.load(tmp_path)
    replace(c, values=c.values * 2).save(tmp_path / "other")
    (tmp_path / "controller.npz").write_bytes((tmp_path / "other" / "controller.npz").read_bytes())
    with pytest.raises(UsageError, match="do not belong together"):
        GridController.load(tmp_path)
    (tmp_path / "controller.json").write_text(json.dumps({"goal": 3}))
    with pytest.raises(UsageError, match="damaged"):
        GridController.load(tmp_path)


def test_a_folder_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="cannot be written"):
        controller().save(tmp_path / "file")


@pytest.mark.contract
def test_a_saved_controller_runs_without_its_synthesizer(tmp_path: Path) -> None:
    c = controller()
    c.save(tmp_path)
    code = (
        "import sys, numpy as np\n"
        "from gapcert_cells import GridController\n"
        f"c = GridController.load({str(tmp_path)!r})\n"
        "print(c.act(np.array([[0.05, 0.95]]), 'first')[0, 0])\n"
        "print(sorted({m.split('.')[0] for m in sys.modules if m.startswith('gapcert_')}))\n"
    )
    environment = dict(os.environ, PYTHONWARNINGS="error")
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment).stdout
    assert out.splitlines() == ["1.0", "['gapcert_cells']"]


def test_goal_parts_must_fit() -> None:
    stay = Box(AXES, (0.0, 0.0), (1.0, 1.0))
    wide = Region((Box(AXES, (0.0, 0.0), (2.0, 1.0)),))
    other = Region((Box((AXES[1], AXES[0]), (0.0, 0.0), (1.0, 1.0)),))
    with pytest.raises(UsageError, match="reach_avoid needs a target"):
        Goal("reach_avoid", stay)
    with pytest.raises(UsageError, match="invariance has no target"):
        Goal("invariance", stay, wide)
    with pytest.raises(UsageError, match=r"target asks for x in \[0, 2\] m, but stay is \[0, 1\]"):
        Goal("reach_avoid", stay, wide)
    with pytest.raises(UsageError, match="avoid is over y, x; expected x, y"):
        Goal("invariance", stay, avoid=other)
    with pytest.raises(UsageError, match="kind 'hover' is unknown"):
        Goal("hover", stay)  # type: ignore[arg-type]


def test_goal_holds_and_is_reached() -> None:
    stay = Box(AXES, (0.0, 0.0), (1.0, 1.0))
    left, right = Box(AXES, (0.0, 0.0), (0.5, 1.0)), Box(AXES, (0.4, 0.0), (1.0, 1.0))
    goal = Goal("reach_avoid", stay, Region((left,)), Region((right,)))
    x = np.array([[0.1, 0.5], [0.45, 0.5], [0.9, 0.5], [1.1, 0.5], [np.nan, 0.5]])
    assert goal.holds(x).tolist() == [True, False, False, False, False]
    assert goal.reached(x).tolist() == [True, False, False, False, False]
    assert Goal.from_data(json.loads(json.dumps(goal.to_data()))) == goal


def test_regions_survive_saving_bit_for_bit() -> None:
    stay = Box(AXES, (0.0, 0.0), (1.0, 1.0))
    ball = Ellipsoid(stay, (0, 1), (0.3, 1 / 3), ((30.0, 0.1), (0.1, 20.0)))
    cut = Polytope(stay, (Relation("x + y <= 0.9", (1.0, 1.0), 0.9),))
    goal = Goal("recurrence", stay, Region((stay,), (cut,), (ball,)), Region(ellipsoids=(ball,)))
    assert Goal.from_data(json.loads(json.dumps(goal.to_data()))) == goal


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (((1.0, 2.0), (2.0, 1.0)), "not symmetric and positive definite"),
        (((1.0, 0.0), (0.1, 1.0)), "not symmetric and positive definite"),
        (((1.0,),), "a square matrix"),
    ],
)
def test_no_ellipsoid(matrix: tuple[tuple[float, ...], ...], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        Ellipsoid(Box(AXES, (0.0, 0.0), (1.0, 1.0)), (0, 1), (0.5, 0.5), matrix)


def test_radii_and_cuts_must_fit_the_states() -> None:
    frame = Box(AXES, (0.0, 0.0), (1.0, 1.0))
    name = AXES[0].name
    with pytest.raises(UsageError, match="must name the same states"):
        Ellipsoid.of(frame, {name: 0.5}, {"q": 1.0})
    with pytest.raises(UsageError, match="give a positive number"):
        Ellipsoid.of(frame, {name: 0.5}, {name: 0.0})
    with pytest.raises(UsageError, match="'q <= 1' needs one finite coefficient per state"):
        Polytope(frame, (Relation("q <= 1", (1.0,), 1.0),))
