"""Plans that arrive: each is adopted only if it arrives no later than what remains of the one before."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import final

import numpy as np
import scipy.optimize
import scipy.sparse as sp

from gapcert.plugin import Array, Ints
from gapcert_engines import muted
from gapcert_mpc.program.corridors import Scene, read
from gapcert_mpc.program.program import Program
from gapcert_mpc.thresholds import THRESHOLDS

from .engine import Engine
from .plans import Held, Plan, Pool, plan


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
        for found in self.search(x, brief):
            assert found.arrival is not None, "what is searched arrives"
            if (made := self._along(x, found.x, found.s, found.arrival, None)) is not None:
                return made
        return None

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


def optimum(
    cost: Array, A: sp.csr_matrix, low: Array, high: Array, kind: Array, bounds: scipy.optimize.Bounds, nodes: int
) -> Array | None:
    """arg min cost · z with low ≤ A z ≤ high, z_j whole where kind_j is 1; None where none was found in so many nodes."""
    # Where an answer breaks a row once presolve is undone, HiGHS 1.12 prints a line on stdout, whatever its options say.
    with muted():
        found = scipy.optimize.milp(
            cost,
            integrality=kind.astype(np.int64),
            bounds=bounds,
            constraints=scipy.optimize.LinearConstraint(A, low, high),
            options={"node_limit": nodes, "mip_rel_gap": 0.05},
        )
    return None if found.x is None else np.asarray(found.x)


@final
class Search:
    """minimise arrival + `effort_weight` Σ|ū| over the plans of a program, tubes included.

    Binaries: y_kt, the plan arrives at stage k in target t, Σ y = 1; δ_kf, the tube of stage k is beyond face f, at least one
    of each obstacle up to arrival. Their rows are those of the program with other bounds, loosened where the binary is 0 by as
    much as the rows of the goal allow. A search ends after `nodes` nodes at the latest.
    """

    def __init__(self, program: Program, scene: Scene, nodes: int) -> None:
        self.program, self.scene, self.nodes = program, scene, nodes
        p, self.N, self.T, self.F = program, program.N, len(scene.low), len(scene.row)
        self.columns = p.size + self.N * (self.T + self.F) + self.N * p.m
        self.y0, self.d0 = p.size, p.size + self.N * self.T
        self.e0 = self.d0 + self.N * self.F
        kept = np.ones(len(p.low), dtype=bool)
        for rows in (p.upper, p.lower):
            kept[rows[rows >= 0]] = False
        self.plain = np.flatnonzero(kept)
        low, high = p.limits()
        self.low, self.high = np.maximum(low, -THRESHOLDS.loose_bound), np.minimum(high, THRESHOLDS.loose_bound)
        # What rows reach at most: those of the goal, or, where these ask nothing, those of the frame.
        most = np.minimum(self.high, np.abs(p.whole).sum(axis=1)), np.maximum(self.low, -np.abs(p.whole).sum(axis=1))
        self.most = {1: most[0], -1: -most[1]}
        self.stack: list[tuple[sp.csr_matrix, Array]] = []
        self._inequalities()

    def _at(self, k: Ints, row: Ints, side: int) -> tuple[sp.csr_matrix, Array]:
        """L, off with L z ≤ bound − off for side · W x ≤ bound on the whole tube."""
        p = self.program
        index = (p.upper if side > 0 else p.lower)[k, row]
        sign = -1.0 if side < 0 and not p.variable else 1.0
        return sp.csr_matrix(sign * p.A[index]), p.off[k, row]

    def _before(self, k: Ints) -> sp.csr_matrix:
        """1 where the plan has arrived before stage k, as columns of all binaries."""
        at = [self.y0 + j * self.T + t for j in range(self.N) for t in range(self.T)]
        stage = np.repeat(np.arange(1, self.N + 1), self.T)
        i, j = np.nonzero(stage[None] < k[:, None])
        return sp.csr_matrix((np.ones(len(i)), (i, np.array(at)[j])), shape=(len(k), self.columns))

    def _add(self, k: Ints, row: Ints, side: int, bound: Array, binary: Ints | None, free: Ints) -> None:
        """side · W_row x̄_k on the tube ≤ bound, loosened where the binary is 0, and beyond stage `free` of arrival."""
        if not len(k):
            return
        L, off = self._at(k, row, side)
        loose = np.maximum(self.most[side][k, row] - bound, 0.0)
        M = sp.hstack([L, sp.csr_matrix((len(k), self.columns - L.shape[1]))], format="csr")
        M = M - THRESHOLDS.after_arrival * self._before(free)
        if binary is not None:
            M = M + sp.csr_matrix((loose, (np.arange(len(k)), binary)), shape=M.shape)
            bound = bound + loose
        self.stack.append((M, bound - off))

    def _inequalities(self) -> None:
        p, scene, N = self.program, self.scene, self.N
        for side, rows, limit in ((1, p.upper, self.high), (-1, p.lower, -self.low)):
            k, row = np.argwhere((rows >= 0) & (limit < THRESHOLDS.loose_bound)).T
            self._add(k, row, side, limit[k, row], None, k + p.driven[row])
            for t in range(self.T):
                bound = scene.high[t] if side > 0 else -scene.low[t]
                row = np.flatnonzero(np.isfinite(bound))
                k = np.repeat(np.arange(1, N + 1), len(row))
                row = np.tile(row, N)
                self._add(k, row, side, bound[row], self.y0 + (k - 1) * self.T + t, k)
            f = np.flatnonzero(scene.side == -side)
            k, f = np.repeat(np.arange(1, N + 1), len(f)), np.tile(f, N)
            self._add(k, scene.row[f], side, side * scene.bound[f], self.d0 + (k - 1) * self.F + f, k)
        stages = np.arange(1, N + 1)
        for o in range(scene.obstacles):
            own = np.flatnonzero(scene.obstacle == o)
            column = self.d0 + (stages[:, None] - 1) * self.F + own
            pick = sp.csr_matrix((np.ones(column.size), (np.repeat(stages - 1, len(own)), column.ravel())), (N, self.columns))
            self.stack.append((-pick - self._before(stages), np.full(N, -1.0)))
        u, unit = (p.at["u"][:, None] + np.arange(p.m)).ravel(), sp.identity(self.columns, format="csr")
        for sign in (1.0, -1.0):
            self.stack.append((sign * unit[u] - unit[self.e0 + np.arange(len(u))], np.zeros(len(u))))

    def model(self, tube: Array | None = None) -> tuple[Array, sp.csr_matrix, Array, Array, Array, scipy.optimize.Bounds]:
        """c, A, low, high, integrality and bounds of the variables, for the state that the program begins at."""
        p, N, T = self.program, self.N, self.T
        once = sp.csr_matrix((np.ones(N * T), (np.zeros(N * T, dtype=int), self.y0 + np.arange(N * T))), (1, self.columns))
        plain = sp.hstack([p.A[self.plain], sp.csr_matrix((len(self.plain), self.columns - p.size))])
        A = sp.csr_matrix(sp.vstack([plain, once, *(M for M, _ in self.stack)]))
        above = np.concatenate([b for _, b in self.stack])
        low = np.concatenate([p.low[self.plain], [1.0], np.full(len(above), -np.inf)])
        high = np.concatenate([p.high[self.plain], [1.0], above])
        cost, kind = np.zeros(self.columns), np.zeros(self.columns)
        cost[self.y0 : self.d0] = np.repeat(np.arange(1, N + 1), T)
        cost[self.e0 :] = THRESHOLDS.effort_weight
        kind[self.y0 : self.e0] = 1
        least, most = np.full(self.columns, -np.inf), np.full(self.columns, np.inf)
        least[self.y0 : self.e0], most[self.y0 : self.e0] = 0, 1
        if tube is not None:
            s = slice(int(p.at["s"][0]), int(p.at["s"][0]) + N * p.p)
            least[s] = most[s] = tube[1:].ravel()
            low[: len(self.plain)][np.isin(self.plain, p.tubes)] = -np.inf
        return cost, A, low, high, kind, scipy.optimize.Bounds(least, most)

    def __call__(self, x: Array, brief: bool = False) -> Iterator[Plan]:
        """Plans from x (frame), candidates whose tubes may be too small; the last are exact where there is one.

        A tube that depends on the plan makes the program hard, one that is given does not. So it is that of a plan at rest
        first, where none is if there is none for it, then that of the plan that was found, and halfway back.
        """
        p = self.program
        tube = last = p.tube() if p.variable else p.constant
        for i in range(THRESHOLDS.tube_rounds if p.variable else 0):
            if (found := self.solved(x, tube)) is not None:
                yield found
                away = (np.hstack([found.x[: p.N], found.u]) - p.stages.centre[: p.N]) @ p.F.T
                last, tube = tube, p.tube(np.abs(away))
            elif not i:
                return
            else:
                tube = (last + tube) / 2
        # A tube that does not depend on the plan is exact, and found at once.
        if (not brief or not p.variable) and (exact := self.solved(x, None)) is not None:
            yield exact

    def solved(self, x: Array, tube: Array | None) -> Plan | None:
        """With this tube, (N+1, p), or with its own; None where nothing was found in time."""
        self.program.begin(x)
        if (z := optimum(*self.model(tube), self.nodes)) is None:
            return None
        arrival = 1 + int(z[self.y0 : self.d0].reshape(self.N, self.T).sum(axis=1).argmax())
        return replace(plan(self.program, z, np.zeros(0)), arrival=arrival)
