"""States that an exported controller is asked about, and its Python file as a module."""

from __future__ import annotations

import importlib.util
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from gapcert_cells import AutomatonController, GridController

POLICIES = ("first", "middle", "last", "least-effort")
ODD = (np.nan, np.inf, -np.inf, 1e300, -1e300, 0.0, -0.0, 5e-324)

LENGTH = 20
DRIVER = """
#include "controller.h"
#include <stdio.h>
int main(void) {
  double x[CONTROLLER_STATES], u[CONTROLLER_INPUTS];
  int memory = 0, k, code, n = 0;
  long steps;
  for (; fread(x, sizeof(double), CONTROLLER_STATES, stdin) == CONTROLLER_STATES; n++) {
    if (n % 20 == 0) controller_init(&memory);
    for (k = 0; k < CONTROLLER_INPUTS; k++) u[k] = 99.0;
    code = controller_step(x, n % 4, &memory, u);
    printf("%d %d %d", code, memory, controller_done(memory));
    for (k = 0; k < CONTROLLER_INPUTS; k++) printf(" %.17g", u[k]);
    steps = -1;
    code = controller_value(x, memory, &steps);
    printf(" %ld\\n", steps);
  }
  return 0;
}
"""


def states(c: GridController, n: int = 100_000) -> np.ndarray:
    """Uniform beyond the grid; a third of all numbers on cell edges or next to them, some turned, some odd; a tenth of the
    angles within 400 floats of where the box begins and ends, twenty turns away at most.
    """
    rng = np.random.default_rng(1)
    low, high = np.array(c.goal.stay.low), np.array(c.goal.stay.high)
    x = low - 0.1 * (high - low) + 1.2 * (high - low) * rng.random((n, 3))
    for j, edges in zip(c.on, c.edges, strict=True):
        on = rng.random(n) < 0.33
        at = rng.choice(edges, n)
        at = np.where(rng.random(n) < 0.5, at, np.nextafter(at, rng.choice([-9.0, 9.0], n)))
        x[on, j] = at[on]
    turn = rng.random(n) < 0.5
    x[turn, 1] += 2 * np.pi * rng.integers(-3, 4, n)[turn]
    seam = rng.random(n) < 0.1
    end = rng.choice([low[1], high[1]], n) + 2 * np.pi * rng.integers(-20, 21, n)
    x[seam, 1] = (end.view(np.int64) + rng.integers(-400, 401, n)).view(np.float64)[seam]
    odd = rng.random(n) < 0.01
    x[odd, rng.integers(3)] = rng.choice(ODD, odd.sum())
    return x


def imported(file: Path) -> Any:
    spec = importlib.util.spec_from_file_location("exported", file)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    assert spec.loader is not None
    spec.loader.exec_module(module)
    return module


def offered(c: AutomatonController, x: np.ndarray, memory: np.ndarray) -> np.ndarray:
    """Where there is an input."""
    out, cell = c.keeps(x, memory), c.parts[0].cells(x)
    for q, part in enumerate(c.parts):
        mine = out & (memory == q)
        out[mine] = part.allowed(cell[mine]).any(axis=1)
    return np.asarray(out)


def replayed(c: AutomatonController, x: np.ndarray) -> np.ndarray:
    """What the driver prints, by the original."""
    runs = x.reshape(-1, LENGTH, x.shape[1])
    out = np.full((len(runs), LENGTH, 6), 99.0)
    memory = np.full(len(runs), c.automaton.start)
    for k in range(LENGTH):
        now = runs[:, k]
        then = c.advance(now, memory)
        good = offered(c, now, then)
        out[:, k, 0] = np.where(good, 0, np.where(c.keeps(now, then), 2, 1))
        if good.any():
            out[good, k, 3:5] = c.respond(now[good], then[good], POLICIES[k % 4])  # type: ignore[arg-type]
        memory = np.where(good, then, memory)
        out[:, k, 1], out[:, k, 2], out[:, k, 5] = memory, c.automaton.done[memory], c._value(now, memory)
    return out.reshape(-1, 6)


def driven(folder: Path, x: np.ndarray) -> np.ndarray:
    """What the driver prints, compiled with the program in the folder, for runs of LENGTH states each."""
    (folder / "driver.c").write_text(DRIVER)
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-O2"]
    subprocess.run(["cc", *flags, "driver.c", "controller.c", "-o", "driver", "-lm"], cwd=folder, check=True)
    out = subprocess.run([folder / "driver"], input=x.tobytes(), capture_output=True, check=True).stdout
    return np.array([line.split() for line in out.decode().splitlines()], dtype=np.float64)
