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

Order = Sequence[int]
"""Axis i of this spelling is axis order[i] of another one."""


def digest(model: Model, backend: System, domain: Domain) -> str:
    """Identity of a spelling: model, backend and domain alone."""
    return json_digest(model.digest(), backend.digest(), domain.digest_data())


@final
@dataclass(frozen=True)
class Known:
    """A question as the book has it: the axes that count, in the order of its first spelling; SI units.

    ends (2, nz): the box around Z; inside: which fixed points of that box Z has; z (n, nz), the first `diagonal` of them at one
    share of every axis; values (2, n, nx): f and f̂ there; e (nx,); noise (nx,): standard deviations of f̂'s draws; content:
    hashes of measurements that stand in place of f̂.
    """

    ends: Array
    inside: Bools
    diagonal: int
    z: Array
    values: Array
    e: Array
    noise: Array
    content: tuple[int, ...]

    def to_data(self) -> dict[str, Any]:
        """JSON-able and exact: in hexadecimal where there are many numbers."""
        few = {k: getattr(self, k).tolist() for k in ("ends", "e", "noise")}
        many = {"inside": np.packbits(self.inside), "z": self.z, "values": self.values}
        return {**few, "diagonal": self.diagonal, "content": self.content, **{k: v.tobytes().hex() for k, v in many.items()}}

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> Known:
        """Inverse of `to_data`."""
        bits, z, values = (np.frombuffer(bytes.fromhex(data[k]), np.uint8) for k in ("inside", "z", "values"))
        e, noise, ends = (np.array(data[k], dtype=np.float64) for k in ("e", "noise", "ends"))
        z, values = z.view(np.float64).reshape(-1, ends.shape[1]), values.view(np.float64).reshape(2, -1, len(e))
        inside, content = np.unpackbits(bits).astype(bool), tuple(data["content"])
        return cls(ends, inside, int(data["diagonal"]), z, values, e, noise, content)


@final
@dataclass(frozen=True)
class Fingerprint:
    """The question how far f̂ is from f on Z, as it is spelled here.

    content: see `Known`; named: the spelling's digest, where that is not the one of model, backend and domain.
    """

    model: Model
    backend: System
    domain: Domain
    content: tuple[int, ...] = ()
    named: str = ""

    @cached_property
    def digest(self) -> str:
        """Of this spelling; the first one's is the name of the question."""
        return self.named or digest(self.model, self.backend, self.domain)

    @property
    def known(self) -> Known:
        """The question, where this is its first spelling."""
        return self._measured[0]

    def same(self, old: Known) -> bool:
        """Is it the question known as `old`? Axes of equal ranges may have any order; where there are too many to try, it is."""
        own, nx, nz = self.known, len(old.e), old.ends.shape[1]
        if own.ends.shape != old.ends.shape or len(own.e) != nx or not _shared(own.content, old.content):
            return False
        like = [[(i < nx) == (j < nx) and _alike(own.ends[:, i], old.ends[:, j]) for j in range(nz)] for i in range(nz)]
        if (order := next(_orders(like), None)) is None:
            return False
        if self._agrees(old, order):
            return True
        # At one share of every axis their order does not count, so that it shows which states cannot be which.
        far = self._far(old, order, old.diagonal)
        like = [[like[i][j] and not (i < nx and far[i, j]) for j in range(nz)] for i in range(nz)]
        orders = list(itertools.islice(_orders(like), THRESHOLDS.question_orders))
        return len(orders) == THRESHOLDS.question_orders or any(self._agrees(old, order) for order in orders)

    def _agrees(self, old: Known, order: Order) -> bool:
        nx = len(old.e)
        same = np.array_equal(self._inside(self.known.ends, order), old.inside)
        return same and not self._far(old, order, len(old.z))[np.arange(nx), list(order[:nx])].any()

    def _far(self, old: Known, order: Order, rows: int) -> Bools:
        """(nx, nx): f or f̂ of state i is not that of state j of `old` at its first points, with the axes in this order.

        That is: it differs by more than 4 e and what means of draws differ by, or the draws have another spread.
        """
        own, states = self.known, self._measured[1][: len(old.e)]
        z = np.tile(self._si(self.domain.centre), (len(old.z), 1))
        z[:, self._measured[1]] = old.z[:, list(order)]
        values, noise = self._answers(z)
        values, noise = values[:, :rows, states, None], noise[states, None]
        e, drawn = 4 * np.maximum(own.e[:, None], old.e), np.maximum(noise, old.noise)
        angle = np.array([self.domain.axes[i].kind == "angle" for i in states])[:, None]
        d = values - old.values[:, :rows, None]
        d = np.abs(d - np.where(angle, 2 * np.pi * np.round(d / (2 * np.pi)), 0.0))
        room = np.stack([e, e + THRESHOLDS.question_noise * drawn])[:, None]
        other = np.abs(noise - old.noise) > e + THRESHOLDS.question_spread * drawn
        return np.asarray((d > room).any(axis=(0, 1)) | other)

    @cached_property
    def _measured(self) -> tuple[Known, Ints]:
        """The question, where this is its first spelling, and the numbers of its axes among those of the domain."""
        domain, n, rng = self.domain, THRESHOLDS.question_points, np.random.default_rng(0)
        low, high = ends = self._ends()
        diagonal = low + (high - low) * np.linspace(0.1, 0.9, THRESHOLDS.question_diagonal)[:, None]
        diagonal = diagonal[domain.zone.related(self._own(diagonal))]
        z = self._own(low + (high - low) * rng.random((n, len(low))))
        z = np.concatenate([diagonal, self._si(domain.reach(domain.centre, z))])[:n]
        values, noise = self._answers(z)
        # What the last bits of the arguments change is no difference: another unit rounds them otherwise.
        moved = np.abs(self._answers(z * (1 + 2.0**-50))[0] - values).max(axis=(0, 1), initial=0.0)
        e = Residual(self.backend, self.model).resolution(domain) * self._units[0, : domain.nx] + np.nan_to_num(moved)
        axes = np.flatnonzero(self._counts(z, values, e))
        states, own = axes[axes < domain.nx], ends[:, axes]
        inside = self._inside(own, range(len(axes)), axes)
        content = tuple(sorted(self.content))
        return Known(own, inside, len(diagonal), z[:, axes], values[..., states], e[states], noise[states], content), axes

    def _counts(self, z: Array, values: Array, e: Array) -> Bools:
        """(nz,): does the axis count? One may be added that nothing else depends on, and a state then by itself has no gap.

        Where no state does, all do.
        """
        nx, zone = self.domain.nx, self.domain.zone
        cuts = np.maximum(zone.matrix * zone.low, zone.matrix * zone.high).sum(axis=1) > zone.bounds
        related = zone.matrix[cuts].any(axis=0)
        moved = np.zeros((len(related), nx), dtype=bool)
        for j in range(len(related)):
            other = z.copy()
            other[:, j] = np.roll(z[:, j], 1)
            other = self._si(self.domain.reach(self._own(z), self._own(other)))
            moved[j] = (np.abs(self._answers(other)[0] - values) > 4 * e).any(axis=(0, 1))
        moved[np.arange(nx), np.arange(nx)] = False
        out = related | moved.any(axis=1)
        out[:nx] |= moved.any(axis=0) | (np.abs(values[1] - values[0]) > 4 * e).any(axis=0)
        return np.asarray(out | ~out[:nx].any())

    def _answers(self, z: Array) -> tuple[Array, Array]:
        """(f, f̂) at points z (n, nz), (2, n, nx), and the standard deviation of f̂'s draws (nx,); of draws the mean."""
        x, u = (np.ascontiguousarray(part) for part in self.domain.split(self._own(z)))
        seeds = range(THRESHOLDS.question_draws) if "seed" in self.backend.capabilities else (None,)
        drawn = np.stack([self.backend.step(x, u, seed=seed).x for seed in seeds])
        apart = difference(self.model.states, drawn, np.broadcast_to(drawn[:1], drawn.shape))
        a, b = self._units[:, : self.domain.nx]
        values = np.stack([self.model.step(x, u).x, drawn[0] + apart.mean(axis=0)])
        return values * a + b, np.sqrt(apart.var(axis=0).mean(axis=0)) * a

    @cached_property
    def _units(self) -> Array:
        """(2, nz) a, b: a number v of an axis is a v + b in SI units."""
        return np.array([base(axis.unit) for axis in self.domain.axes]).T

    def _si(self, z: Array) -> Array:
        return np.asarray(z * self._units[0] + self._units[1])

    def _own(self, z: Array) -> Array:
        return np.asarray((z - self._units[1]) / self._units[0])

    def _ends(self) -> Array:
        """(2, nz): the smallest box that holds Z."""
        zone, ends = self.domain.zone, np.array([self.domain.low, self.domain.high])
        if zone.relations:
            from scipy.optimize import linprog

            box = list(zip(zone.low, zone.high, strict=True))
            rows = np.eye(len(box))
            ends = np.array([[s * linprog(s * row, zone.matrix, zone.bounds, bounds=box).fun for row in rows] for s in (1, -1)])
        return self._si(ends)

    def _inside(self, ends: Array, order: Order, axes: Ints | None = None) -> Bools:
        """Which of fixed points of the box Z has, where share k of the box is that of the axis with order[i] = k."""
        shares = np.random.default_rng(1).random((THRESHOLDS.question_box, len(order)))[:, list(order)]
        z = np.tile(self._si(self.domain.centre), (len(shares), 1))
        z[:, self._measured[1] if axes is None else axes] = ends[0] + (ends[1] - ends[0]) * shares
        return self.domain.zone.related(self._own(z))


def _orders(like: Sequence[Sequence[bool]]) -> Iterator[Order]:
    """All orders in which every axis i is one with like[i][order[i]]."""

    def longer(order: tuple[int, ...]) -> Iterator[Order]:
        if len(order) == len(like):
            yield order
            return
        for j, fits in enumerate(like[len(order)]):
            if fits and j not in order:
                yield from longer((*order, j))

    return longer(()) if all(map(any, like)) else iter(())


def _alike(a: Array, b: Array) -> bool:
    """Are two ranges one, to a share of their width and what a change of units rounds?"""
    room = THRESHOLDS.question_range * (b[1] - b[0]) + 4 * np.spacing(np.abs(b).max())
    return bool((np.abs(a - b) <= room).all())


def _shared(a: Sequence[int], b: Sequence[int]) -> bool:
    """Do two lists of the smallest hashes have enough in common, as far as both reach?"""
    if not (a and b):
        return not (a or b)
    most = min(max(a), max(b))
    one, other = ({v for v in values if v <= most} for values in (a, b))
    return len(one & other) >= THRESHOLDS.question_shared * len(one | other)
