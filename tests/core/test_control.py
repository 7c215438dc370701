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

from gapcert import Box, Ellipsoid, Goal, GridController, Polytope, Region, Relation, StateSpec, UsageError

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
    with pytest.raises(UsageError, match="policy 'best' is unknown; use one of first, middle, last, random"):
        controller().act(np.array([[0.1, 0.1]]), "best")  # type: ignore[arg-type]


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


def test_a_saved_controller_runs_without_its_synthesizer(tmp_path: Path) -> None:
    c = controller()
    c.save(tmp_path)
    code = (
        "import sys, numpy as np\n"
        "from gapcert import GridController\n"
        f"c = GridController.load({str(tmp_path)!r})\n"
        "print(c.act(np.array([[0.05, 0.95]]), 'first')[0, 0])\n"
        "print(sorted(m for m in sys.modules if m.startswith('gapcert_')))\n"
    )
    environment = dict(os.environ, PYTHONWARNINGS="error")
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment).stdout
    assert out.splitlines() == ["1.0", "[]"]


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
