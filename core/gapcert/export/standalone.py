"""A controller exported from Gapcert. It needs NumPy, and the .npz file of the same name beside it.

controller = Controller()
controller.act([[0.1, 0.0]])            # (n, inputs), one allowed input per state; ValueError outside the domain
controller.act(x, "least-effort")       # or first, middle, last, random
controller.contains(x)                  # (n,) booleans
controller.value(x)                     # (n,) steps to the target at most (0 for invariance), -1 outside the domain
controller.allowed(x)                   # (n, points) booleans over controller.points, all inputs that keep the promise
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

TURN = 2 * np.pi


class Controller:
    """All inputs that keep the promise, per cell of a grid.

    A cell contains its lower edges, the last one of an axis its upper edge too; angles count modulo a turn.
    """

    def __init__(self, file: str | Path | None = None) -> None:
        with np.load(Path(__file__).with_suffix(".npz") if file is None else file, allow_pickle=False) as tables:
            self._tables: dict[str, Any] = {name: tables[name] for name in tables.files}
        self.states, self.points = self._tables["states"].tolist(), self._tables["points"]
        self._edges = [self._tables[f"edges{j}"] for j in range(len(self._tables["on"]))]

    def cells(self, x: Any) -> Any:
        """(n,): flat cell of each state (n, states), -1 outside the grid."""
        x, t = np.atleast_2d(np.asarray(x, dtype=np.float64)), self._tables
        if x.shape[1] != len(self.states):
            raise ValueError(f"controller: states have {x.shape[1]} numbers; expected {', '.join(self.states)}")
        x = _turned(x, t["stay"][0], t["stay"][1], t["angle"])
        others = np.setdiff1d(np.arange(len(self.states)), t["on"])
        low, high = t["held"]
        held = _turned(x[:, others], low, high, t["angle"][others])
        inside = ((held >= low) & (held <= high)).all(axis=1)
        index = np.zeros(len(x), dtype=np.int64)
        for j, edges in zip(t["on"], self._edges, strict=True):
            inside &= (x[:, j] >= edges[0]) & (x[:, j] <= edges[-1])
            part = np.minimum(np.searchsorted(edges, x[:, j], "right") - 1, len(edges) - 2)
            index = index * (len(edges) - 1) + part
        return np.where(inside, index, -1)

    def value(self, x: Any) -> Any:
        cell = self.cells(x)
        return np.where(cell < 0, np.int32(-1), self._tables["values"][cell])

    def contains(self, x: Any) -> Any:
        return self.value(x) >= 0

    def allowed(self, x: Any) -> Any:
        rows = np.unpackbits(self._tables["bits"][self.cells(x)], axis=1, count=len(self.points)) > 0
        return rows & self.contains(x)[:, None]

    def act(self, x: Any, policy: str = "first", seed: int = 0, k: int = 0) -> Any:
        """(n, inputs). `random` is a pure function of (seed, k, row), k the number of the step."""
        lost, allowed = np.flatnonzero(~self.contains(x)), self.allowed(x)
        if lost.size:
            raise ValueError(f"controller: row {lost[0]}: {np.atleast_2d(x)[lost[0]].tolist()} is outside its domain")
        number = allowed.sum(axis=1)
        if not number.all():
            raise ValueError(f"controller: row {number.argmin()}: the goal is reached, and no input is promised there")
        if policy == "least-effort":
            return self.points[np.where(allowed, self._tables["efforts"], np.inf).argmin(axis=1)]
        if policy == "random":
            share = np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, k]))).random(len(number))
            rank = np.minimum((share * number).astype(np.int64), number - 1)
        elif policy in ("first", "middle", "last"):
            rank = {"first": number * 0, "middle": number // 2, "last": number - 1}[policy]
        else:
            raise ValueError(f"controller: policy '{policy}' is unknown; use first, middle, last, random or least-effort")
        return self.points[(np.cumsum(allowed, axis=1) > rank[:, None]).argmax(axis=1)]


def _turned(x: Any, low: Any, high: Any, angle: Any) -> Any:
    """x with every angle outside [low, high] moved by whole turns to the one nearest to the middle."""
    out = angle & ((x < low) | (x > high)) & np.isfinite(x)
    with np.errstate(invalid="ignore"):
        return np.where(out, x + TURN * np.round(((low + high) / 2 - x) / TURN), x)
