"""A controller exported from Gapcert. It needs NumPy, and the .npz file of the same name beside it.

controller = Controller()
controller.act([[0.1, 0.0]])            # (n, inputs), one allowed input per state; ValueError outside the domain
controller.act(x, "least-effort")       # or first, middle, last, random
controller.contains(x)                  # (n,) booleans
controller.value(x)                     # (n,) steps to the target at most (0 for invariance), -1 outside the domain
controller.allowed(x)                   # (n, points) booleans over controller.points, all inputs that keep the promise

A goal with an automaton has a memory, which every state that a run comes to moves on:
memory = controller.start(x)            # of runs that begin at x; without it, each call is the first of a run
u = controller.act(x, memory=memory)
memory = controller.advance(x, memory)  # at the next state, before the next act; -1 where the goal is lost
controller.done(memory)                 # the goal is reached, and the promise ends
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

TURN = 2 * np.pi


class Controller:
    """All inputs that keep the promise, per cell of a grid, some of which may be halved.

    A cell contains its lower edges, the last one of an axis its upper edge too; angles count modulo a turn.
    """

    def __init__(self, file: str | Path | None = None) -> None:
        with np.load(Path(__file__).with_suffix(".npz") if file is None else file, allow_pickle=False) as tables:
            self._tables: dict[str, Any] = {name: tables[name] for name in tables.files}
        self.states, self.points = self._tables["states"].tolist(), self._tables["points"]
        self._edges = [self._tables[f"edges{j}"] for j in range(len(self._tables["on"]))]

    def cells(self, x: Any) -> Any:
        """(n,): number of the cell of each state (n, states), -1 outside the grid."""
        x, t = np.atleast_2d(np.asarray(x, dtype=np.float64)), self._tables
        if x.shape[1] != len(self.states):
            raise ValueError(f"controller: states have {x.shape[1]} numbers; expected {', '.join(self.states)}")
        x = _turned(x, t["stay"], t["angle"])
        others = np.setdiff1d(np.arange(len(self.states)), t["on"])
        held = _turned(x[:, others], t["held"], t["angle"][others])
        inside = ((held >= t["held"][0]) & (held <= t["held"][1])).all(axis=1)
        index, parts, left = np.zeros(len(x), dtype=np.int64), [], int(t.get("halvings", 0))
        for j, edges in zip(t["on"], self._edges, strict=True):
            inside &= (x[:, j] >= edges[0]) & (x[:, j] <= edges[-1])
            parts.append(np.clip(np.searchsorted(edges, x[:, j], "right") - 1, 0, len(edges) - 2))
            index = index * ((len(edges) - 1) >> left) + (parts[-1] >> left)
        for shift in range(left)[::-1]:
            child = sum(((part >> shift) & 1) << (len(parts) - 1 - k) for k, part in enumerate(parts))
            first = t["splits"][index]
            index = np.where(first > 0, first + child, index)
        return np.where(inside, index, -1)

    def start(self, x: Any) -> Any:
        """(n,): the memory of runs that begin at x; 0 where the goal needs none."""
        return self.advance(x, np.full(len(np.atleast_2d(x)), self._tables.get("start", 0)))

    def advance(self, x: Any, memory: Any) -> Any:
        """(n,): the memory of runs that have come to x."""
        memory, t = np.asarray(memory), self._tables
        if "after" not in t:
            return memory
        cell, letter = self.cells(x), self._letter(x)
        letter = np.where(cell >= 0, (letter | t["must"][cell]) & t["may"][cell], letter)
        return np.where(memory < 0, -1, t["after"][memory, letter])

    def done(self, memory: Any) -> Any:
        memory = np.asarray(memory)
        return (memory >= 0) & self._tables["done"][memory] if "done" in self._tables else memory < 0

    def _letter(self, x: Any) -> Any:
        """(n,): the regions that the states are in, bit p for region p."""
        x, t = np.atleast_2d(np.asarray(x, dtype=np.float64)), self._tables
        x, letter = _turned(x, t["stay"], t["angle"]), np.zeros(len(x), dtype=np.int64)
        for k, region in enumerate(t["region"]):
            box = t["box"][k].T
            y = _turned(x, box, t["angle"])
            inside = ((y >= box[0]) & (y <= box[1])).all(axis=1)
            y, rows = y[inside], np.flatnonzero(inside)
            good = np.ones(len(y), dtype=bool)
            for a, bound in zip(t["cuts"][t["cut_of"] == k], t["bounds"][t["cut_of"] == k], strict=True):
                good &= sum(y[:, j] * a[j] for j in np.flatnonzero(a)) <= bound
            d, mine = y - t["centres"][k], t["term_of"] == k
            good &= sum(d[:, i] * d[:, j] * f for (i, j), f in zip(t["terms"][mine], t["factors"][mine], strict=True)) <= 1
            letter[rows[good]] |= 1 << region
        return letter

    def value(self, x: Any, memory: Any = None) -> Any:
        cell, memory = self.cells(x), self.start(x) if memory is None else np.asarray(memory)
        return np.where((cell < 0) | (memory < 0), np.int32(-1), self._tables["values"][memory, cell])

    def contains(self, x: Any, memory: Any = None) -> Any:
        return self.value(x, memory) >= 0

    def allowed(self, x: Any, memory: Any = None) -> Any:
        memory = self.start(x) if memory is None else np.asarray(memory)
        rows = np.unpackbits(self._tables["bits"][memory, self.cells(x)], axis=1, count=len(self.points)) > 0
        return rows & self.contains(x, memory)[:, None]

    def act(self, x: Any, policy: str = "first", seed: int = 0, k: int = 0, memory: Any = None) -> Any:
        """(n, inputs). `random` is a pure function of (seed, k, row), k the number of the step."""
        lost, allowed = np.flatnonzero(~self.contains(x, memory)), self.allowed(x, memory)
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


def _turned(x: Any, box: Any, angle: Any) -> Any:
    """x with every angle on the turn of the box: within its ends if and only if x lies on the nearest copy of it."""
    low, high, middle, full = box
    out = angle & ((x < low) | (x > high)) & np.isfinite(x)
    with np.errstate(invalid="ignore", over="ignore"):
        moved = TURN * np.round((x - middle) / TURN)
        back = x - moved
        on = ((x >= low + moved) | (back >= low)) & ((x <= high + moved) | (back <= high))
        return np.where(out, np.where((full > 0) | on, np.clip(back, low, high), back), x)
