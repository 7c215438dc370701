"""Plans that arrive: each is adopted only if it arrives no later than what remains of the one before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from gapcert import Array
from gapcert_mpc.plans import Plan
from gapcert_mpc.program.corridors import Scene, read
from gapcert_mpc.program.program import LOOSE, Program
from gapcert_mpc.search import Search

if TYPE_CHECKING:
    from gapcert_mpc.controller import Engine

TRIED = 6  # known plans whose corridors a start tries
NODES = 500  # of the tree of a search: a start from which nothing is found in so many is taken as one without a plan


@final
@dataclass(frozen=True)
class Pool:
    """Known plans: x (k, N+1, n), s (k, N+1, p), and the step at which each arrives, (k,)."""

    x: Array
    s: Array
    arrival: Array

    @classmethod
    def of(cls, plans: list[Plan], program: Program) -> Pool:
        x = np.array([q.x for q in plans]).reshape(-1, program.N + 1, program.n)
        s = np.array([q.s for q in plans]).reshape(-1, program.N + 1, program.p)
        return cls(x, s, np.array([q.arrival for q in plans], dtype=np.int64))

    def near(self, x: Array, most: int) -> list[tuple[int, int]]:
        """(plan, stage) pairs whose stage is nearest to x, one per plan, nearest first, and not yet at its target."""
        if not len(self.x):
            return []
        away = np.abs(self.x - x).max(axis=2)
        away[np.arange(self.x.shape[1]) >= self.arrival[:, None]] = np.inf
        stage, nearest = away.argmin(axis=1), away.min(axis=1)
        return [(int(i), int(stage[i])) for i in np.argsort(nearest, kind="stable")[:most] if np.isfinite(nearest[i])]


@final
class Arrival:
    """Reach-avoid: the corridor and the arrival of each program are read off from the plan before.

    That plan, shifted and brought to the measured state, satisfies the rows of the new program, so that time to go falls by one
    per step at least.
    """

    def __init__(self, engine: Engine, scene: Scene, pool: Pool, nodes: int = NODES) -> None:
        self.engine, self.scene, self.pool = engine, scene, pool
        self.program = engine.program
        self.low, self.high = self.program.limits()
        self.search = Search(self.program, scene, nodes)

    def clear(self, x: Array) -> bool:
        """Is x (frame) outside all obstacles?"""
        return bool(self.scene.clear(*read(self.program, x[None], np.zeros((1, self.program.p))))[0])

    def begin(self, x: Array) -> Plan | None:
        """A plan from x (frame): in one of the nearest corridors of the pool, else in one that is searched for briefly."""
        p = self.program
        if not self.clear(x):
            return None
        if self.scene.inside(*read(p, x[None], np.zeros((1, p.p)))).max() >= 0:
            none = np.zeros(0)
            return Plan(none, none, x[None], np.zeros((0, p.m)), p.s0[None], x, np.zeros(p.m), p.s0, arrival=0)
        return self.known(x) or self.searched(x, brief=True)

    def known(self, x: Array) -> Plan | None:
        """A plan from x (frame) in one of the nearest corridors of the pool."""
        for i, k in self.pool.near(x, TRIED):
            found = self._along(x, self.pool.x[i, k:], self.pool.s[i, k:], int(self.pool.arrival[i]) - k, None)
            if found is not None:
                return found
        return None

    def searched(self, x: Array, brief: bool = False) -> Plan | None:
        """A plan along a corridor that mixed-integer programs find from x (frame)."""
        tried = (self._along(x, *found, None) for found in self.search(x, brief))
        return next((plan for plan in tried if plan is not None), None)

    def follow(self, x: Array, plan: Plan, age: int) -> Plan | None:
        """The next plan of a run at x that has kept to `plan` for `age` steps and one more; it arrives no later."""
        assert plan.arrival is not None
        left, first = plan.arrival - age - 1, age + 1
        return None if left <= 0 else self._along(x, plan.x[first:], plan.s[first:], left, plan)

    def _along(self, x: Array, at: Array, s: Array, arrival: int, guess: Plan | None) -> Plan | None:
        """A plan from x in the corridor of the stages (at, s) that arrives at stage `arrival` of these."""
        p = self.program
        value, reach = read(p, at[: arrival + 1], s[: arrival + 1])
        t = int(self.scene.inside(value[-1:], reach[-1:])[0].argmax())
        between = self.scene.corridor(value, reach)
        low, high = (np.full_like(self.low, b) for b in (-LOOSE, LOOSE))
        k, states = arrival + 1, ~p.driven
        low[:k, states] = np.maximum(self.low[:k], between[0])[:, states]
        high[:k, states] = np.minimum(self.high[:k], between[1])[:, states]
        low[arrival] = np.maximum(low[arrival], self.scene.low[t])
        high[arrival] = np.minimum(high[arrival], self.scene.high[t])
        low[:arrival, p.driven], high[:arrival, p.driven] = self.low[:arrival, p.driven], self.high[:arrival, p.driven]
        p.bound(low, high)
        p.aim((self.scene.low[t, : p.n] + self.scene.high[t, : p.n]) / 2, self.engine.rest)
        found = self.engine.solve(x, guess)
        return None if found is None else replace(found, arrival=self._arrives(found, arrival))

    def _arrives(self, plan: Plan, arrival: int) -> int:
        """The first stage, at `arrival` at the latest, whose tube lies in a target."""
        value, reach = read(self.program, plan.x[: arrival + 1], plan.s[: arrival + 1])
        early = np.asarray((self.scene.inside(value, reach) >= 0).any(axis=1))
        early[0] = False
        return int(early.argmax()) if early.any() else arrival


def explored(engine: Engine, starts: Array, searches: int, pulse: Callable[..., None] = lambda *told: None) -> Pool:
    """Plans from which corridors are known: searched from starts (frame) from which none so far leads, so many at most."""
    arrival, found, most = engine.arrival, list[Plan](), searches
    assert isinstance(arrival, Arrival)
    for x in starts:
        if not searches:
            break
        if arrival.clear(x) and arrival.known(x) is None:
            searches -= 1
            pulse(most - searches, {"corridors": len(found)})
            if (plan := arrival.searched(x)) is not None:
                found.append(plan)
                arrival.pool = Pool.of(found, arrival.program)
    return arrival.pool
