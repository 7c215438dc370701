"""Plans that arrive: each is adopted only if it arrives no later than what remains of the one before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import final

import numpy as np

from gapcert import Array
from gapcert_mpc.program.corridors import Scene, read
from gapcert_mpc.thresholds import THRESHOLDS

from .engine import Engine
from .plans import Held, Plan, Pool
from .search import Search


@final
class Arrival:
    """Reach-avoid: the corridor and the arrival of each program are read off from the plan before.

    That plan, shifted and brought to the measured state, satisfies the rows of the new program, so that time to go falls by one
    per step at least.
    """

    def __init__(self, engine: Engine, scene: Scene, pool: Pool | None = None) -> None:
        self.engine, self.scene, self.program = engine, scene, engine.program
        self.pool = pool or Pool.of([], self.program)
        self.low, self.high = self.program.limits()
        self.search = Search(self.program, scene, THRESHOLDS.tree_nodes)

    def solve(self, x: Array, held: Held | None) -> Plan | None:
        return self.follow(x, held.plan, held.age) if held else self.begin(x)

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
        for i, k in self.pool.near(x, THRESHOLDS.tried_plans):
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
        low, high = (np.full_like(self.low, b) for b in (-THRESHOLDS.loose_bound, THRESHOLDS.loose_bound))
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

    def explored(self, starts: Array, searches: int, pulse: Callable[..., None]) -> Pool:
        """Plans from which corridors are known: searched from starts (frame) from which none so far leads, so many at most."""
        found, left = list[Plan](), searches
        for x in starts:
            if not left:
                break
            if self.clear(x) and self.known(x) is None:
                left -= 1
                pulse(searches - left, {"corridors": len(found)})
                if (plan := self.searched(x)) is not None:
                    found.append(plan)
                    self.pool = Pool.of(found, self.program)
        return self.pool
