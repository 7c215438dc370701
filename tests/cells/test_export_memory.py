"""Exported controllers with a memory: C and NumPy read the regions, move the memory on and answer as the original does."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from exported import POLICIES, driven, imported, offered, replayed, states

from gapcert import Box, Goal, Region, StateSpec, UsageError
from gapcert.cli.main import main
from gapcert.contracts.controllers.goal import Automaton
from gapcert.contracts.systems.region import Ellipsoid, Polytope
from gapcert.numerics.constraint_zone import Relation
from gapcert_cells import AutomatonController, GridController
from gapcert_cells.export.export import export


def made(n: int = 4) -> AutomatonController:
    """A random automaton over a box, a polytope and an ellipsoid across the seam, and a random table of inputs per state."""
    rng = np.random.default_rng(7)
    axes = (StateSpec("x", "m"), StateSpec("h", "rad", "angle"), StateSpec("v", "m/s"))
    stay = Box(axes, (-0.3, -np.pi, -0.1), (0.7, np.pi, 1.2))
    box = Box(axes, (-0.1, -1.0, -0.1), (0.35, 1.3, 0.9))
    cuts = (Relation("a", (1.0, 0.1, -0.3), 0.1), Relation("b", (0.0, 0.3, 0.7), 0.6))
    disc = Ellipsoid.of(stay, {"x": 0.2, "h": 3.0, "v": 0.4}, {"x": 0.3, "h": 0.8, "v": 0.5})
    tilted = Ellipsoid(stay, (0, 2), (0.3, 0.5), ((11.0, 3.3), (3.3, 7.7)))
    regions = (Region((box,)), Region((), (Polytope(stay, cuts),), (disc,)), Region((), (), (tilted,)))
    after = rng.integers(-1, n, (n, 8))
    after[n - 1], after[0] = n - 1, rng.integers(0, n, 8)
    rows = tuple(tuple(int(q) for q in row) for row in after)
    automaton = Automaton(("a", "b", "c"), rows, (False,) * (n - 1) + (True,), 0, "random")
    goal = Goal("automaton", stay, automaton=automaton, regions=regions)
    counts = (13, 24, 7)
    edges = tuple(np.linspace(a, b, m + 1) for a, b, m in zip(stay.low, stay.high, counts, strict=True))
    cells, points = int(np.prod(counts)), np.stack([np.tile(np.linspace(-1.1, 1.3, 6), 3), np.repeat([-3, 0.1, 40], 6)], axis=1)
    parts = []
    for _ in range(n):
        values = rng.integers(-1, 6, cells).astype(np.int32)
        allowed = rng.random((cells, 18)) < 0.3
        allowed[values < 0] = False
        allowed[values == 0] &= rng.random((int((values == 0).sum()), 1)) < 0.5
        parts.append(GridController(goal, edges, points, np.packbits(allowed, axis=1), values, {}))
    may = rng.integers(0, 8, cells) | rng.integers(0, 8, cells)
    return AutomatonController(goal, tuple(parts), may & rng.integers(0, 8, cells) & rng.integers(0, 8, cells), may, {})


def test_numpy_remembers_as_the_original(tmp_path: Path) -> None:
    c = made()
    facts = export(c, "numpy", tmp_path)
    assert facts["memories"] == 4
    other, x = imported(tmp_path / "controller.py").Controller(), states(c.parts[0])
    assert np.array_equal(other.start(x), c.start(x))
    assert np.array_equal(other.contains(x), c.contains(x))
    memory = np.random.default_rng(3).integers(-1, 4, len(x))
    then = c.advance(x, memory)
    assert set(then.tolist()) == {-1, 0, 1, 2, 3}
    assert np.array_equal(other.advance(x, memory), then)
    assert np.array_equal(other.done(then), (then >= 0) & c.automaton.done[then])
    good = offered(c, x, then)
    assert 1000 < good.sum() < len(x) - 1000
    for policy in (*POLICIES, "random"):
        mine = c.respond(x[good], then[good], policy, 2, 3)  # type: ignore[arg-type]
        assert np.array_equal(other.act(x[good], policy, 2, 3, then[good]), mine)
    with pytest.raises(ValueError, match="outside its domain"):
        other.act(x[:1], memory=np.array([-1]))


@pytest.mark.contract
@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler: `cc` is not on the path")
def test_c_remembers_as_the_original(tmp_path: Path) -> None:
    c = made()
    export(c, "c", tmp_path)
    x = states(c.parts[0])
    rows, mine = driven(tmp_path, x), replayed(c, x)
    assert len(rows) == len(x) == 100_000
    assert set(mine[:, 0].tolist()) == {0.0, 1.0, 2.0}
    assert min(np.bincount(mine[:, 1].astype(int))) > 1000  # every memory
    assert np.array_equal(rows, mine)


@pytest.mark.parametrize("name", ["must", "factors", "bounds", "box"])
def test_a_wrong_table_is_seen(name: str, tmp_path: Path) -> None:
    """With any of them off by a little, the states above would tell."""
    c, x = made(), states(made().parts[0])
    export(c, "numpy", tmp_path)
    other, memory = imported(tmp_path / "controller.py").Controller(), np.zeros(len(x), dtype=np.int64)
    other._tables[name] = c.must * 0 if name == "must" else other._tables[name] * (1 + 1e-3)
    assert not np.array_equal(other.advance(x, memory), c.advance(x, memory))


def test_the_command_exports_a_memory(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    c = made()
    c.save(tmp_path / "run" / "controller" / "with_gamma")
    assert main(["export", str(tmp_path / "run"), "--to", "numpy", "--out", str(tmp_path / "out"), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["digest"], answer["memories"]) == (c.digest(), 4)
    with pytest.raises(UsageError, match="has a memory"):
        GridController.load(tmp_path / "run" / "controller" / "with_gamma")
