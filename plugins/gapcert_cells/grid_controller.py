"""A controller on cells: all inputs that keep the promise, in a saved form that runs without its maker."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import (
    POLICIES,
    TURN,
    Array,
    Bools,
    Box,
    Controller,
    Goal,
    Ints,
    Outside,
    Policy,
    UsageError,
    circle,
    known,
    turned,
)

from .files import loaded, write_saved
from .outside import inside_alone, refusal
from .successors import Splits, Successors, SuccessorsByLevel

Promised = Successors | SuccessorsByLevel


@final
@dataclass(frozen=True, eq=False)
class GridController(Controller):
    """All inputs that keep the promise, per cell of a grid that tiles `goal.stay`: a uniform one, or one with `splits`.

    edges: per state, the count + 1 cell edges; a cell contains its lower edges, the last cell of an axis its upper one too.
    points (m, nu): the inputs. bits (cells, ⌈m/8⌉) uint8: which inputs a cell allows, first input in the highest bit.
    values (cells,): steps to the target (0 inside it, and for invariance), −1 where the cell is losing. held: where only
    some states have cells, the box that the others must be in: a cell stands for all of it. promised: the cells in which a step
    from a cell may end, or what makes them when they are asked for; policy `adversarial` and `kept` look at them. splits: where
    some cells are halved; `edges` are those of the smallest then, and cells are numbered as its nodes are. lasting: values, in
    rising order, that need not fall. For reach-and-stay their cells are in the target, and a value is the most moments that a
    run may yet be outside; at 0 the target is kept for ever. A run remembers how many of them it has come down to.
    """

    goal: Goal
    edges: tuple[Array, ...]
    points: Array
    bits: npt.NDArray[np.uint8]
    values: npt.NDArray[np.int32] | npt.NDArray[np.int8]
    evidence: Mapping[str, Any]
    kind: str = "symbolic"
    held: Box | None = None
    promised: Promised | Callable[[], Promised | None] | None = None
    splits: Splits | None = None
    lasting: tuple[int, ...] = (0,)

    @property
    def on(self) -> tuple[int, ...]:
        """The states that have cells, by number."""
        names = self.goal.stay.names
        return tuple(j for j, name in enumerate(names) if self.held is None or name not in self.held.names)

    @property
    def _others(self) -> list[int]:
        return [j for j in range(len(self.goal.stay.axes)) if j not in self.on]

    @property
    def counts(self) -> tuple[int, ...]:
        return tuple(len(e) - 1 for e in self.edges)

    @property
    def widths(self) -> Array:
        return np.asarray([(e[-1] - e[0]) / (len(e) - 1) for e in self.edges])

    @property
    def winning(self) -> Bools:
        """Shape `counts`: the cells of the domain."""
        return self._painted(self.values >= 0).reshape(self.counts)

    def _painted(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """What is given per cell, per place."""
        return values if self.splits is None else values[self.splits.painted()]

    def cells(self, x: Array) -> npt.NDArray[np.int64]:
        """Cell of each state (n, nx) by its number, −1 outside the grid. Angles count modulo a turn."""
        return self.places(x) if self.splits is None else self.splits.nodes(self.places(x))

    def places(self, x: Array) -> npt.NDArray[np.int64]:
        """Flat index between the edges of each state (n, nx), −1 outside the grid; without splits, the cell."""
        x = turned(self.goal.stay, np.atleast_2d(np.asarray(x, dtype=np.float64)))
        index = np.zeros(len(x), dtype=np.int64)
        inside = np.ones(len(x), dtype=bool)
        if self.held is not None:
            inside &= self.held.contains(turned(self.held, x[:, self._others]))
        for j, edges in zip(self.on, self.edges, strict=True):
            inside &= (x[:, j] >= edges[0]) & (x[:, j] <= edges[-1])
            part = np.minimum(np.searchsorted(edges, x[:, j], "right") - 1, len(edges) - 2)
            index = index * (len(edges) - 1) + part
        return np.where(inside, index, -1)

    def contains(self, x: Array) -> Bools:
        cell = self.cells(x)
        return np.asarray((cell >= 0) & (self.values[cell] >= 0))

    def allowed(self, cell: npt.NDArray[np.int64]) -> npt.NDArray[np.uint8]:
        """(n, m) zeros and ones: the inputs that each cell allows."""
        return np.unpackbits(self.bits[cell], axis=1, count=len(self.points))

    def value(self, x: Array) -> npt.NDArray[np.int32]:
        """(n,) value function: in at most so many steps the target is reached (0 for invariance); −1 outside the domain."""
        cell = self.cells(x)
        return np.where(cell < 0, np.int32(-1), self.values[cell])

    @cached_property
    def successors(self) -> Promised | None:
        """What is promised of a step, cell by cell; None where it was too much to be kept."""
        return self.promised() if callable(self.promised) else self.promised

    @property
    def policies(self) -> tuple[Policy, ...]:
        small = self.splits is None or math.prod(self.counts) <= Splits.PAINTED
        return tuple(p for p in POLICIES if p != "adversarial" or (self.successors is not None and small))

    def act(self, x: Array, policy: Policy, seed: int = 0, k: int = 0, *, outside: Outside = "raise") -> Array:
        """One allowed input per state, chosen as `policies` says; UsageError outside the domain, or NaN."""
        known(policy)
        if outside == "nan":
            return inside_alone(self, self.points.shape[1], x, policy, seed, k)
        x = np.atleast_2d(np.asarray(x, dtype=np.float64))
        cell = self.cells(x)
        lost = np.flatnonzero((cell < 0) | (self.values[cell] < 0))
        if lost.size:
            raise refusal(self, x, int(lost[0]))
        allowed = self.allowed(cell)
        number = allowed.sum(axis=1, dtype=np.int64)
        if not number.all():
            state = x[int(np.argmin(number))].tolist()
            raise UsageError(
                f"controller: at {state} the goal is reached, and no input keeps the relations; ask `goal.reached`"
            )
        if policy == "least-effort":
            chosen = np.where(allowed, efforts(self.points), np.inf).argmin(axis=1)
        elif policy == "adversarial":
            chosen = self._adversarial(cell)
        else:
            chosen = by_order(policy, allowed, number, seed, k)
        return np.asarray(self.points[chosen])

    def start(self, x: Array) -> Ints:
        return self.advance(x, np.zeros(len(x), dtype=np.int64))

    def advance(self, x: Array, memory: Ints) -> Ints:
        return np.maximum(memory, self._come(self.value(x))) if self.goal.kind == "reach_and_stay" else memory

    def keeps(self, x: Array, memory: Ints) -> Bools:
        value = self.value(x)
        return np.asarray((value >= 0) & (self._come(value) >= memory))

    def _come(self, value: npt.NDArray[np.int32]) -> Ints:
        """(n,): how many lasting values a run that has such a value never exceeds again."""
        return np.asarray(((value[:, None] >= 0) & (value[:, None] <= np.array(self.lasting))).sum(axis=1))

    def counted(self, x: Array, memory: Ints) -> Bools:
        return np.isin(self.value(x), self.lasting) if self.goal.kind == "reach_and_stay" else self.goal.visited(x)

    def left(self, x: Array, memory: Ints) -> Ints | None:
        return None if self.goal.kind == "invariance" else self.value(x).astype(np.int64)

    def tube(self, x: Array, u: Array, memory: Ints | None = None) -> Array | None:
        """(1, nx, 2): the box of cells that one step promises; None where that is not known, or reaches beyond the grid."""
        cell, same = self.cells(x[None]), (self.points == u).all(axis=1)
        if self.successors is None or cell[0] < 0 or not same.any():
            return None
        first, last = (end[0] for end in self.successors.ends(cell, np.array([same.argmax()])))
        out = np.empty((1, len(self.goal.stay.axes), 2))
        for j, edges, wraps, a, b in zip(self.on, self.edges, self.wraps, first.tolist(), last.tolist(), strict=True):
            n = len(edges) - 1
            if not wraps and (a < 0 or b >= n):
                return None
            # On an axis that closes on itself, cells beyond its end are a turn away.
            out[0, j] = edges[a % n] + TURN * (a // n), edges[b % n + 1] + TURN * (b // n)
        if self.held is not None:
            out[0, self._others] = np.column_stack([self.held.low, self.held.high])
        return out

    def _adversarial(self, cell: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """(n,): of the allowed inputs of each cell the one with the greatest height at any corner of its successors.

        Ties go to the greatest mean over the corners, then to the first.
        """
        if self.successors is None or "adversarial" not in self.policies:
            raise UsageError(
                "controller: policy 'adversarial' needs the promised successors, which were too many to be kept; use fewer "
                "cells or inputs, or another policy"
            )
        fresh = np.unique(cell[self._worst[cell] < 0])
        row, which = np.nonzero(allowed := self.allowed(fresh))
        heights = self._height[corners(*self.successors.ends(fresh[row], which), self.counts, self.wraps)]
        top, score = heights.max(axis=1), np.full(allowed.shape, -np.inf)
        # The mean lies below the top by less than the range, so that it decides between equals only.
        score[row, which] = top + (heights.mean(axis=1) - top) / (1.0 + float(np.ptp(self._height)))
        self._worst[fresh] = score.argmax(axis=1)
        return self._worst[cell].astype(np.int64)

    @cached_property
    def _worst(self) -> npt.NDArray[np.int32]:
        """The adversarial input of each cell that was asked for so far, −1 of the others."""
        return np.full(len(self.values), -1, dtype=np.int32)

    @cached_property
    def _height(self) -> Array:
        """(places,): whole numbers, the greater the nearer to losing."""
        values = self._painted(self.values)
        height = values.astype(np.float64)
        if self.goal.kind in ("invariance", "reach_and_stay"):
            height[values == 0] = -depths((values == 0).reshape(self.counts), self.wraps)[values == 0]
        return height

    @property
    def wraps(self) -> tuple[bool, ...]:
        """Axes of cells that close on themselves: angles over a full turn."""
        kinds = [self.goal.stay.axes[j].kind for j in self.on]
        return tuple(kind == "angle" and circle.spans(e[0], e[-1]) for kind, e in zip(kinds, self.edges, strict=True))

    def kept(self, x: Array, u: Array, after: Array, memory: Ints | None = None) -> Bools:
        """(n,): is `after` in a cell of the domain, of smaller value on the way to a target, and in one that was promised?

        A lasting value need not fall; from value 0 on, what is to be met again may be anywhere in the domain; and nothing is
        promised beyond a target that ends the goal.
        """
        x, after, cell = np.atleast_2d(x), np.atleast_2d(after), self.cells(x)
        value, left = self.value(x), self.value(after)
        most = np.where(np.isin(value, self.lasting), value, value - 1)
        if self.goal.kind == "recurrence":
            most[value == 0] = np.iinfo(np.int32).max
        good = (left >= 0) & (left <= most)
        good &= self.promising(cell, u, after)
        return np.asarray((good & (value >= 0)) | self.goal.reached(x))

    def promising(self, cell: Ints, u: Array, after: Array) -> Bools:
        """(n,): is `after` where a step from `cell` under u may end? Where that is not known, anything is."""
        if self.successors is None:
            return np.ones(len(cell), dtype=bool)
        same = (self.points[None] == np.atleast_2d(u)[:, None]).all(axis=2)
        return np.asarray(
            same.any(axis=1) & self.successors.contain(np.maximum(cell, 0), same.argmax(axis=1), self.places(after))
        )

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """Winning cells by their volume, then uniform in the cell; nothing where the domain is empty."""
        wins = np.flatnonzero(self.values >= 0)
        if not len(wins):
            return np.empty((0, len(self.goal.stay.axes)))
        if self.splits is None:
            first = np.stack(np.unravel_index(wins[rng.integers(len(wins), size=n)], self.counts), axis=1)
            after = first + 1
        else:
            part = self.splits.shares()[wins]
            first, after = self.splits.ends(rng.choice(wins, size=n, p=part / part.sum()))
        share = rng.random((n, len(self.edges)))
        low = np.stack([e[i] for e, i in zip(self.edges, first.T, strict=True)], axis=1)
        high = np.stack([e[i] for e, i in zip(self.edges, after.T, strict=True)], axis=1)
        x = low + (high - low) * share
        # Rounding may put a share near 1 on the upper edge, which is the next cell's.
        x = np.where(x < high, x, low)
        if self.held is None:
            return np.asarray(x)
        whole, start = np.empty((n, len(self.goal.stay.axes))), np.asarray(self.held.low)
        whole[:, self.on] = x
        whole[:, self._others] = start + (np.asarray(self.held.high) - start) * rng.random((n, len(start)))
        return whole

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """What `controller.npz` holds."""
        edges: dict[str, npt.NDArray[Any]] = {f"edges{j}": e for j, e in enumerate(self.edges)}
        promised = {} if self.successors is None else self.successors.arrays()
        promised |= {} if self.splits is None else {"splits": self.splits.first, "halvings": np.array(self.splits.levels)}
        promised |= {} if self.lasting == (0,) else {"lasting": np.array(self.lasting)}
        return edges | {"points": self.points, "bits": self.bits, "values": self.values} | promised

    def told(self) -> dict[str, Any]:
        """What `controller.json` says, but for the digest."""
        data = {"format": 1, "kind": self.kind, "goal": self.goal.to_data(), "evidence": dict(self.evidence)}
        return data | ({"held": held} if (held := self._held_data()) else {})

    def digest(self) -> str:
        """SHA-256 of everything that determines the inputs."""
        held = self._held_data()
        out = hashlib.sha256(json.dumps([self.kind, self.goal.to_data(), *([held] if held else [])]).encode())
        for name, array in self.arrays().items():
            out.update(f"{name}{array.dtype.str}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        return out.hexdigest()

    def _held_data(self) -> dict[str, list[float]]:
        """The bounds of `held`, by name."""
        box = self.held
        return {} if box is None else {n: [a, b] for n, a, b in zip(box.names, box.low, box.high, strict=True)}

    def save(self, folder: Path | str) -> None:
        """Write `controller.npz` and `controller.json` into `folder`; `load` needs nothing but this module."""
        write_saved(folder, self.told() | {"digest": self.digest()}, self.arrays())

    @classmethod
    def load(cls, folder: Path | str) -> GridController:
        """Inverse of `save`; UsageError where the files are absent, damaged or do not belong together."""

        def made(data: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> GridController:
            if "automaton" in data["goal"]:
                raise UsageError(f"{folder}: the saved controller has a memory; load it with AutomatonController.load")
            return cls.read(data, arrays)

        return loaded(folder, made)

    @classmethod
    def read(cls, data: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> GridController:
        """Inverse of `told` and `arrays`."""
        goal, held = Goal.from_data(data["goal"]), data.get("held", {})
        edges = tuple(arrays[f"edges{j}"] for j in range(len(goal.stay.axes) - len(held)))
        points, bits, values = arrays["points"], arrays["bits"], arrays["values"]
        box = Box.among(goal.stay.axes, held)
        lasting = tuple(arrays["lasting"].tolist()) if "lasting" in arrays else (0,)
        controller = cls(goal, edges, points, bits, values, data["evidence"], data["kind"], box, lasting=lasting)
        counts, wraps = controller.counts, controller.wraps
        if "halvings" not in arrays:
            return replace(controller, promised=Successors.from_arrays(counts, wraps, arrays))
        halvings = int(arrays["halvings"])
        splits = Splits(tuple(n >> halvings for n in counts), halvings, arrays["splits"])
        return replace(controller, splits=splits, promised=SuccessorsByLevel.from_arrays(splits, wraps, arrays))


def by_order(
    policy: Policy, allowed: npt.NDArray[np.uint8], number: npt.NDArray[np.int64], seed: int, k: int
) -> npt.NDArray[np.int64]:
    """Which input each row takes, under a policy that only counts: allowed (n, m), number (n,) of them."""
    if policy == "first":
        rank = np.zeros_like(number)
    elif policy == "last":
        rank = number - 1
    elif policy == "middle":
        rank = number // 2
    else:
        share = np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, k]))).random(len(number))
        rank = np.minimum((share * number).astype(np.int64), number - 1)
    return np.asarray((np.cumsum(allowed, axis=1) > rank[:, None]).argmax(axis=1))


def efforts(points: Array) -> Array:
    """(m,): ‖u / s‖₂ of each input, s the range of each component; 1 where it does not vary."""
    span = np.ptp(points, axis=0)
    return np.asarray(np.sqrt(((points / np.where(span > 0, span, 1.0)) ** 2).sum(axis=1)))


def depths(winning: Bools, wraps: tuple[bool, ...]) -> npt.NDArray[np.int32]:
    """(cells,): how many cells away, along the axis where it is farthest, the nearest cell is that does not win; 0 for those.

    Beyond the grid nothing wins.
    """
    from scipy.ndimage import distance_transform_cdt

    field = winning
    for k, (n, round_) in enumerate(zip(winning.shape, wraps, strict=True)):
        widths = [(0, 0)] * winning.ndim
        widths[k] = (n, n) if round_ else (1, 1)
        field = np.pad(field, widths, mode="wrap" if round_ else "constant")
    if field.all():
        return np.full(winning.size, max(winning.shape), dtype=np.int32)
    found = distance_transform_cdt(field, metric="chessboard")
    inner = tuple(slice(n, 2 * n) if w else slice(1, n + 1) for n, w in zip(winning.shape, wraps, strict=True))
    return np.asarray(found[inner], dtype=np.int32).ravel()


def corners(first: Ints, last: Ints, counts: tuple[int, ...], wraps: tuple[bool, ...]) -> Ints:
    """(n, 2^axes): flat cells at the corners of boxes, from first to last (n, axes); those outside moved to the grid's edge."""
    ends = np.stack([first, last])
    for k, (n, round_) in enumerate(zip(counts, wraps, strict=True)):
        ends[:, :, k] = ends[:, :, k] % n if round_ else np.clip(ends[:, :, k], 0, n - 1)
    sides = product((0, 1), repeat=len(counts))
    return np.stack([np.ravel_multi_index([ends[s, :, k] for k, s in enumerate(side)], counts) for side in sides], axis=1)
