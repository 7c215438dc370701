"""Exported controllers: C and NumPy answer as the original does, on cell edges, round a turn and outside."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exported import POLICIES, imported, states

from gapcert import Box, Goal, Region, StateSpec, UsageError
from gapcert.cli.main import main
from gapcert_cells import GridController, Splits
from gapcert_cells.export.export import export, find

DRIVER = """
#include "controller.h"
#include <stdio.h>
int main(void) {
  double x[CONTROLLER_STATES], u[CONTROLLER_INPUTS];
  unsigned char allowed[CONTROLLER_POINTS];
  long steps;
  int policy, code, k, set;
  while (fread(x, sizeof(double), CONTROLLER_STATES, stdin) == CONTROLLER_STATES) {
    steps = -1;
    code = controller_value(x, &steps);
    printf("%d %ld", code, steps);
    set = controller_allowed(x, allowed) ? 0 : 1;
    for (k = 0, steps = 0; set && k < CONTROLLER_POINTS; k++) steps += allowed[k] * (k + 1L);
    printf(" %ld", steps);
    for (policy = 0; policy < 4; policy++) {
      for (k = 0; k < CONTROLLER_INPUTS; k++) u[k] = 99.0;
      printf(" %d", controller_act(x, policy, u));
      for (k = 0; k < CONTROLLER_INPUTS; k++) printf(" %.17g", u[k]);
    }
    printf(" %d\\n", controller_act(x, 7, u));
  }
  return 0;
}
"""


def made(kind: str) -> GridController:
    """Random sets of inputs, over ranges that are no binary fractions."""
    rng = np.random.default_rng(len(kind))
    axes = (StateSpec("x", "m"), StateSpec("h", "rad", "angle"), StateSpec("v", "m/s"))
    low, high = (-0.3, 2.9, -0.1), (0.7, 3.7, 1.2)
    if kind == "turn":
        low, high = (-0.3, -np.pi, -0.1), (0.7, np.pi, 1.2)
    stay = Box(axes, low, high)
    held, states = None, (0, 1, 2)
    if kind == "held":
        held, states = Box((axes[1], axes[2]), (3.0, 0.0), (3.6, 1.1)), (0,)
    counts = [(13, 24, 7)[j] for j in states]
    splits = halved((4, 6, 3), rng) if kind == "split" else None
    counts = counts if splits is None else list(splits.finest)
    edges = tuple(np.linspace(low[j], high[j], n + 1) for j, n in zip(states, counts, strict=True))
    cells, m = int(np.prod(counts)) if splits is None else len(splits.first), 18
    values = rng.integers(-1, 400, cells).astype(np.int32)
    allowed = rng.random((cells, m)) < 0.3
    allowed[values < 0] = False
    allowed[values > 0, 5] = True
    values[4::6], allowed[4::6] = 0, False
    if splits is not None:
        values[splits.first > 0], allowed[splits.first > 0] = -1, False
    goal = Goal("reach_avoid", stay, Region((Box(axes, low, tuple(a + 0.1 for a in low)),)))
    points = np.stack([np.tile(np.linspace(-1.1, 1.3, 6), 3), np.repeat([-3.0, 0.1, 40.0], 6)], axis=1)
    return GridController(goal, edges, points, np.packbits(allowed, axis=1), values, {"cells": cells}, held=held, splits=splits)


def halved(counts: tuple[int, ...], rng: np.random.Generator) -> Splits:
    """A third of the cells are halved, and a third of these again."""
    first, begin = np.zeros(int(np.prod(counts)), dtype=np.int32), 0
    for _ in range(2):
        split = begin + np.flatnonzero(rng.random(len(first) - begin) < 0.33)
        first[split], begin = len(first) + 8 * np.arange(len(split)), len(first)
        first = np.append(first, np.zeros(8 * len(split), dtype=np.int32))
    return Splits(counts, 2, first)


def answered(c: GridController, x: np.ndarray) -> np.ndarray:
    """States that get an input."""
    return np.asarray(c.contains(x) & (c.allowed(c.cells(x)).sum(axis=1) > 0))


@pytest.mark.parametrize("kind", ["plain", "turn", "held", "split"])
def test_numpy_answers_as_the_original(kind: str, tmp_path: Path) -> None:
    c = made(kind)
    export(c, "numpy", tmp_path)
    other = imported(tmp_path / "controller.py").Controller()
    x = states(c)
    assert np.array_equal(other.cells(x), c.cells(x))
    assert np.array_equal(other.value(x), c.value(x))
    good = answered(c, x)
    assert 1000 < good.sum() < len(x) - 1000
    assert np.array_equal(other.allowed(x[good]), c.allowed(c.cells(x[good])))
    for policy in (*POLICIES, "random"):
        assert np.array_equal(other.act(x[good], policy, seed=2, k=3), c.act(x[good], policy, seed=2, k=3))
    for row in np.flatnonzero(~good)[:50]:
        with pytest.raises(ValueError, match=r"is outside its domain|no input is promised"):
            other.act(x[row])
    with pytest.raises(ValueError, match="policy 'best' is unknown"):
        other.act(x[good][:1], "best")


@pytest.mark.contract
def test_numpy_runs_without_gapcert(tmp_path: Path) -> None:
    c = made("plain")
    export(c, "numpy", tmp_path / "robot")
    x = states(c)
    x = x[answered(c, x)][0]
    code = (
        "import sys; sys.modules['gapcert'] = None\n"
        "from controller import Controller\n"
        f"print(Controller().act({x.tolist()!r}).tolist())\n"
    )
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    where = tmp_path / "robot"
    out = subprocess.run([sys.executable, "-c", code], cwd=where, capture_output=True, text=True, check=True, env=environment)
    assert json.loads(out.stdout) == c.act(x[None], "first").tolist()


@pytest.mark.contract
@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler: `cc` is not on the path")
@pytest.mark.parametrize("kind", ["plain", "turn", "held", "split"])
def test_c_answers_as_the_original(kind: str, tmp_path: Path) -> None:
    c = made(kind)
    export(c, "c", tmp_path)
    (tmp_path / "driver.c").write_text(DRIVER)
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-O2"]
    subprocess.run(["cc", *flags, "driver.c", "controller.c", "-o", "driver", "-lm"], cwd=tmp_path, check=True)
    x = states(c)
    out = subprocess.run([tmp_path / "driver"], input=x.tobytes(), capture_output=True, check=True).stdout
    rows = np.array([line.split() for line in out.decode().splitlines()], dtype=np.float64)
    assert len(rows) == len(x)
    value, good = c.value(x), answered(c, x)
    code = np.where(good, 0, np.where(c.contains(x), 2, 1))
    assert set(code.tolist()) == {0, 1, 2}
    assert np.array_equal(rows[:, 0], np.where(value < 0, 1, 0))
    assert np.array_equal(rows[:, 1], value)
    numbered = c.allowed(c.cells(x)) * np.arange(1, len(c.points) + 1)
    assert np.array_equal(rows[:, 2], np.where(value < 0, 0, numbered.sum(axis=1)))
    for k, policy in enumerate(POLICIES):
        part = rows[:, 3 + 3 * k : 6 + 3 * k]
        assert np.array_equal(part[:, 0], code)
        assert np.array_equal(part[good, 1:], c.act(x[good], policy))  # type: ignore[arg-type]
        assert (part[~good, 1:] == 99.0).all()
    assert np.array_equal(rows[:, -1], np.where(good, 3, code))


@pytest.mark.run
def test_the_command_writes_what_it_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    c = made("plain")
    c.save(tmp_path / "run" / "controller" / "with_gamma")
    out = tmp_path / "out"
    assert main(["export", str(tmp_path / "run"), "--to", "numpy", "--out", str(out), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert [Path(f).name for f in answer["files"]] == ["controller.py", "controller.npz"]
    assert all(Path(f).is_file() for f in answer["files"])
    assert answer["digest"] == c.digest() == str(np.load(out / "controller.npz")["digest"])
    assert (answer["cells"], answer["inputs"]) == (len(c.values), 18)
    folder = tmp_path / "run" / "controller" / "with_gamma"
    assert main(["export", str(folder), "--to", "c", "--out", str(out)]) == 0
    assert capsys.readouterr().out.split() == [str(out / "controller.h"), str(out / "controller.c")]


def test_what_cannot_be_exported_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UsageError, match="no controller 'with_gamma'; give the folder of a run"):
        find(tmp_path)
    c = made("plain")
    empty = replace(c, values=np.full_like(c.values, -1), evidence={"reason": "the gap is too large"})
    with pytest.raises(UsageError, match=r"domain is empty \(the gap is too large\); nothing was written"):
        export(empty, "c", tmp_path / "new")
    assert not (tmp_path / "new").exists()
    with pytest.raises(UsageError, match="'rust' is unknown; use one of c, numpy"):
        export(c, "rust", tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="cannot be made"):
        export(c, "c", tmp_path / "file")
    c.save(tmp_path / "run" / "controller" / "with_gamma")
    assert main(["export", str(tmp_path / "run"), "--to", "c", "--out", str(tmp_path), "--without-gamma"]) == 2
    assert "no controller 'without_gamma'" in capsys.readouterr().err
    large = replace(c, values=np.zeros(20_000_000, dtype=np.int32), bits=np.zeros((1, 3), dtype=np.uint8))
    with pytest.raises(UsageError, match="use --to numpy, or fewer cells"):
        export(large, "c", tmp_path)


@pytest.mark.contract
@pytest.mark.parametrize("low", [-np.pi, 0.0, 1.7])
def test_a_full_turn_has_no_outside(low: float, tmp_path: Path) -> None:
    """The controller and its program in Python, where every cell wins; C answers as both, as is tested above."""
    h = StateSpec("h", "rad", "angle")
    edges = np.linspace(low, low + 2 * np.pi, 12)
    bits = np.packbits(np.eye(11, dtype=bool), axis=1)
    c = GridController(
        Goal("invariance", Box((h,), (low,), (low + 2 * np.pi,))),
        (edges,),
        np.arange(11.0)[:, None],
        bits,
        np.zeros(11, np.int32),
        {},
    )
    export(c, "numpy", tmp_path)
    ends = (low + 2 * np.pi * np.arange(-20, 21))[:, None]
    x = (ends + np.arange(-400, 401) * np.spacing(np.abs(ends))).reshape(-1, 1)
    x = np.concatenate([x, np.random.default_rng(0).uniform(-130, 130, (20_000, 1))])
    assert c.contains(x).all()
    assert np.array_equal(imported(tmp_path / "controller.py").Controller().act(x), c.act(x, "first"))
    # What the cell says is where the angle is, but for what 20 turns round by.
    inside = np.mod(x[:, 0] - low, 2 * np.pi)
    off = np.abs(inside - 2 * np.pi / 11 * (c.act(x, "first")[:, 0] + 0.5))
    assert (np.minimum(off, 2 * np.pi - off) <= np.pi / 11 + 1e-13).all()
