"""When two questions are one: Z, and what f and f̂ answer at fixed points of it, in SI units and whatever the spelling.

Comparing errs towards *same* alone, which costs β and never truth. Names, units, order, texts and files do not count, nor do
states and inputs that nothing depends on.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np

from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.data.units import base
from gapcert.contracts.gaps.lipschitz import Residual
from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.system import Model, System, difference
from gapcert.numerics.arrays import Array, Bools, Ints
from gapcert.numerics.digest import json_digest

Known = Mapping[str, Any]
"""A question in the order of its first spelling, in SI units: `ends` (2, nz) of the box around Z; `inside`, which fixed points
of that box are in Z; points `z` (n, nz), the first `diagonal` of them at one share of every axis; `values` (3, n, nx) of f, of
f̂, and the deviation of f̂'s draws; `e` (3, nx): four make no difference; `content`, hashes of measurements in place of f̂."""


def digest(model: Model, backend: System, domain: Domain) -> str:
    """Identity of a spelling: model, backend and domain alone."""
    return json_digest(model.digest(), backend.digest(), domain.digest_data())


@final
@dataclass(frozen=True)
class Fingerprint:
    """The question how far f̂ is from f on Z, as it is spelled here; `named` stands in place of the three's `digest`."""

    model: Model
    backend: System
    domain: Domain
    content: tuple[int, ...] = ()
    named: str = ""

    @cached_property
    def digest(self) -> str:
        """Of this spelling; the first one's is the name of the question."""
        return self.named or digest(self.model, self.backend, self.domain)

    @cached_property
    def known(self) -> Known:
        """The question, where this is its first spelling."""
        axes, made = self._axes, self._all
        states = axes[: np.count_nonzero(axes < self.domain.nx)]
        kept = {"ends": made["ends"][:, axes], "z": made["z"][:, axes], "values": made["values"][..., states]}
        inside = self._inside(kept["ends"], range(len(axes)))
        return {**kept, "e": made["e"][:, states], "inside": inside, "diagonal": made["diagonal"], "content": self.content}

    def same(self, given: Known) -> bool:
        """Is it the known question? Axes of equal ranges may have any order; where there are too many to try, it is."""
        own, old = self.known, {k: np.asarray(v) for k, v in given.items()}
        alike = bool(self.content) == bool(old["content"].size)
        if not alike or any(own[k].shape[1:] != old[k].shape[1:] for k in ("ends", "e")):
            return False
        if THRESHOLDS.question_shared * len(self.content) > len(set(self.content) & set(old["content"].tolist())):
            return False
        (low, high), nx = old["ends"], old["e"].shape[1]
        room = THRESHOLDS.question_range * (high - low) + 4 * np.spacing(np.maximum(abs(low), abs(high)))
        like = (np.abs(own["ends"][:, :, None] - old["ends"][:, None]) <= room).all(axis=0)
        like[:nx, nx:] = like[nx:, :nx] = False
        if (order := next(_orders(like), None)) is None:
            return False
        if self._agrees(old, order):
            return True
        # At one share of every axis the order does not count: these points show which states are not which.
        like[:nx, :nx] &= ~self._far(old, order, int(old["diagonal"]))
        orders = list(itertools.islice(_orders(like), THRESHOLDS.question_orders))
        return len(orders) == THRESHOLDS.question_orders or any(self._agrees(old, order) for order in orders)

    def _agrees(self, old: Known, order: Sequence[int]) -> bool:
        nx = old["e"].shape[1]
        same = np.array_equal(self._inside(self.known["ends"], order), old["inside"])
        return same and not self._far(old, order, len(old["z"]))[np.arange(nx), list(order[:nx])].any()

    def _far(self, old: Known, order: Sequence[int], rows: int) -> Bools:
        """(nx, nx): at the first points of `old`, whose axis order[i] is axis i, state i is not its state j, by over 4 e."""
        states = self._axes[: old["e"].shape[1]]
        # All points are asked: a draw belongs to its row, and a spread is that of all.
        found = self._answers(self._whole(old["z"][:, list(order)]))[:, :rows, states, None]
        d = found - old["values"][:, :rows, None]
        turns = np.round(d / (2 * np.pi)) * np.array([[self.domain.axes[i].kind == "angle"] for i in states])
        e = np.maximum(self.known["e"][:, None, :, None], old["e"][:, None, None])
        return np.asarray((np.abs(d - 2 * np.pi * turns) > 4 * e).any(axis=(0, 1)))

    @cached_property
    def _all(self) -> dict[str, Any]:
        """`known` with all axes."""
        domain, (low, high) = self.domain, self._ends()
        diagonal = low + (high - low) * np.linspace(0.1, 0.9, THRESHOLDS.question_diagonal)[:, None]
        diagonal = diagonal[domain.zone.related(diagonal / self._unit)]
        z = low + (high - low) * np.random.default_rng(0).random((THRESHOLDS.question_points, len(low)))
        z = np.concatenate([diagonal, domain.reach(domain.centre, z / self._unit) * self._unit])[: len(z)]
        values = self._answers(z)
        e = Residual(self.backend, self.model).resolution(domain) * self._unit[: domain.nx]
        # Another unit rounds the arguments otherwise: what their last bits change is no difference.
        e = e + np.nan_to_num(np.abs(self._answers(z * (1 + 2.0**-50)) - values)[:2].max(axis=(0, 1)))
        noise = values[2, 0]
        e = np.stack([e, e + THRESHOLDS.question_noise * noise, THRESHOLDS.question_spread * noise])
        return {"ends": np.stack([low, high]), "z": z, "values": values, "e": e, "diagonal": len(diagonal)}

    @cached_property
    def _axes(self) -> Ints:
        """Axes that count: no inputs that nothing depends on, nor states that depend on nothing else either and have no gap."""
        z, values, e, nx = *(self._all[k] for k in ("z", "values", "e")), self.domain.nx
        zone, moved = self.domain.zone, np.zeros((z.shape[1], nx), dtype=bool)
        cuts = np.maximum(zone.matrix * zone.low, zone.matrix * zone.high).sum(axis=1) > zone.bounds
        for j in range(len(moved)):
            other = np.where(np.arange(len(moved)) == j, np.roll(z, 1, axis=0), z)
            other = self.domain.reach(z / self._unit, other / self._unit) * self._unit
            moved[j] = (np.abs(self._answers(other) - values) > 4 * e[:, None]).any(axis=(0, 1))
        moved[np.arange(nx), np.arange(nx)] = False
        counts = zone.matrix[cuts].any(axis=0) | moved.any(axis=1)
        counts[:nx] |= moved.any(axis=0) | (np.abs(values[1] - values[0]) > 4 * e[0]).any(axis=0)
        return np.flatnonzero(counts).astype(np.int64)

    def _answers(self, z: Array) -> Array:
        """(3, n, nx): f, f̂ (of its draws the mean), and the deviation of f̂'s draws, at points z (n, nz)."""
        x, u = self.domain.split(z / self._unit)
        seeds = range(THRESHOLDS.question_draws) if "seed" in self.backend.capabilities else (None,)
        drawn = np.stack([self.backend.step(x, u, seed=seed).x for seed in seeds])
        apart = difference(self.model.states, drawn, np.broadcast_to(drawn[:1], drawn.shape))
        noise = np.broadcast_to(np.sqrt(apart.var(axis=0).mean(axis=0)), x.shape)
        return np.stack([self.model.step(x, u).x, drawn[0] + apart.mean(axis=0), noise]) * self._unit[: self.domain.nx]

    @cached_property
    def _unit(self) -> Array:
        return np.array([base(axis.unit) for axis in self.domain.axes])

    def _whole(self, z: Array) -> Array:
        """Points of the axes that count, with the others at the centre."""
        out = np.tile(self.domain.centre * self._unit, (len(z), 1))
        out[:, self._axes] = z
        return out

    def _ends(self) -> Array:
        """(2, nz): the smallest box around Z."""
        zone, ends = self.domain.zone, np.array([self.domain.low, self.domain.high])
        if zone.relations:
            from scipy.optimize import linprog

            rows, box = np.eye(len(zone.low)), list(zip(zone.low, zone.high, strict=True))
            solved = [[linprog(s * row, zone.matrix, zone.bounds, bounds=box).x for row in rows] for s in (1, -1)]
            ends = np.array(solved, dtype=np.float64).diagonal(axis1=1, axis2=2)
        return np.asarray(ends * self._unit)

    def _inside(self, ends: Array, order: Sequence[int]) -> Bools:
        """Which of fixed points of the box Z has, where the shares of axis i are those numbered order[i]."""
        shares = np.random.default_rng(1).random((THRESHOLDS.question_box, len(order)))[:, list(order)]
        return self.domain.zone.related(self._whole(ends[0] + (ends[1] - ends[0]) * shares) / self._unit)


def _orders(like: Bools) -> Iterator[tuple[int, ...]]:
    """All orders in which axis i is one with like[i, order[i]]."""

    def longer(order: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
        if len(order) == len(like):
            yield order
        else:
            for j in np.flatnonzero(like[len(order)]).tolist():
                yield from longer((*order, j)) if j not in order else ()

    return longer(()) if like.any(axis=1).all() else iter(())
