"""The quadratic program of one step: nominal trajectory, tube and terminal set in one matrix whose pattern never changes."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
import scipy.sparse as sp

from gapcert.plugin import Array, Ints
from gapcert_mpc.thresholds import THRESHOLDS

from .linearise import Stages
from .solver import Piqp, Qp
from .tube import Section


@final
class NotShrinking(Exception):
    """The tube grows without end: the spectral radius of M."""


@final
@dataclass(frozen=True)
class Weights:
    """Σ|x̄_k − x_r|²_Q + |ū_k − u_r|²_R + |x̄_N − x_r|²_P + |x_s − x_r|²_T, in the frame."""

    Q: Array
    R: Array
    P: Array
    T: Array


@final
@dataclass(frozen=True)
class Rows:
    """low ≤ C z ≤ high at every stage, in the frame; C (r, n + m)."""

    C: Array
    low: Array
    high: Array


@final
@dataclass(frozen=True)
class Preferred:
    """low ≤ z_j ≤ high is preferred for the j in `axis`, each (q,), in the frame; an excess e costs linear·e + quadratic·e²."""

    axis: Array
    low: Array
    high: Array
    linear: Array
    quadratic: Array


@final
class Table:
    """Rows that are filled in block by block: name → first rows (k,), first columns (k,), stacks (k, r, c)."""

    def __init__(self) -> None:
        self.blocks: dict[str, tuple[Ints, Ints, Array]] = {}
        self.stepped: list[Ints] = []
        self._low: list[Array] = []
        self._high: list[Array] = []
        self._next = 0

    def rows(self, low: Array, high: Array) -> Ints:
        """Makes room for rows with these bounds (k, r); the first of each k."""
        self._low.append(low.ravel())
        self._high.append(np.broadcast_to(high, low.shape).ravel())
        start = np.asarray(self._next + low.shape[1] * np.arange(len(low)))
        self._next += low.size
        if len(start) > 2:
            self.stepped.append(start)
        return start

    def put(self, name: str, first: Ints, columns: Ints, stack: Array) -> None:
        """Stacks (k, r, c), or one (r, c) for all k, at these rows and columns."""
        self.blocks[name] = first, columns, np.broadcast_to(stack, (len(first), *stack.shape[-2:]))

    def bounds(self) -> tuple[Array, Array]:
        return np.concatenate(self._low), np.concatenate(self._high)

    def matrix(self, columns: int, full: Collection[str] = ()) -> tuple[sp.csc_matrix, dict[str, Array]]:
        """In CSC; and which entries of each block are in the pattern: those that are not 0 at every k, of `full` ones all."""
        kept = {name: (b != 0).any(axis=0) | (name in full) for name, (_, _, b) in self.blocks.items()}
        i, j = [], []
        for name, (first, start, _) in self.blocks.items():
            r, c = np.nonzero(kept[name])
            i.append((first[:, None] + r).ravel())
            j.append((start[:, None] + c).ravel())
        rows, cols = np.concatenate(i), np.concatenate(j)
        where = sp.csc_matrix((np.arange(1, len(rows) + 1), (rows, cols)), shape=(self._next, columns))
        order = np.asarray(where.data) - 1
        made = sp.csc_matrix((self.values(kept)[order], where.indices, where.indptr), shape=where.shape)
        return made, kept | {"": order}

    def values(self, kept: dict[str, Array]) -> Array:
        """Entries of the pattern, block by block."""
        parts = [b[:, kept[name]].ravel() for name, (_, _, b) in self.blocks.items()]
        return np.asarray(np.concatenate(parts))


@final
class Program:
    """minimise ½ zᵀP z + qᵀz subject to low ≤ A z ≤ high, z = (x̄₀…x̄_N, ū₀…ū_{N−1}, x_s, u_s, κ[, s₁…s_N, a₀…a_N]).

    The tube s_{k+1} ≥ |Λ_k| s_k + |H|(c_k + G_k(a_k + E s_k) + ε), a_k ≥ |z̄_k − ẑ_k|, s₀ = |H| ε, is part of z where G is not
    0, otherwise computed once, and only tightens. Each row that the solver must keep is tightened by ε, and each equation
    may be missed by ε: an answer that misses no row by more is a certificate. Terminal: a steady pair (x_s, u_s) and a size
    σ = (I − M)⁻¹(|H|(c + G a_s + ε) + D κ) with M = |Λ| + |H|G E, a diagonal D > 0 and κ ≥ 0 (p,), so that
    σ ≥ Mσ + |H|(c + G a_s + ε): {|H(x − x_s)| ≤ σ} is robustly invariant. All rows hold on all of it, and it holds the last
    section, |H(x̄_N − x_s)| + s_N ≤ σ. Where the stages are `varying` before the terminal one, `update` takes new ones.

    With `steady` False there is no terminal set: x_s, u_s and κ are left out, and rows of the states hold at stage N too.
    `bound` moves the bounds of all rows, stage by stage. F (f, n+m): what the uncertainty depends on, z where it is not given;
    G is (N+1, n, f) and a_k ≥ |F(z̄_k − ẑ_k)|. rates (m,): by how much inputs may change per step, where that is limited. soft:
    ranges that may be left, with slacks e_0…e_N between u_s and κ.
    """

    VARYING = ("A", "B", "tube-s", "tube-a")

    def __init__(
        self,
        stages: Stages,
        section: Section,
        rows: Rows,
        weights: Weights,
        tolerance: float,
        varying: bool = False,
        steady: bool = True,
        F: Array | None = None,
        rates: Array | None = None,
        soft: Preferred | None = None,
    ) -> None:
        self.steady, self.rates, self.soft = steady, rates, soft
        self.section, self.rows, self.weights, self.tolerance = section, rows, weights, tolerance
        self.N = stages.horizon
        self.n, self.m, self.p = stages.B.shape[1], stages.B.shape[2], len(section.H)
        self.F = np.eye(self.n + self.m) if F is None else F
        self.on = np.flatnonzero(stages.G.any(axis=(0, 1)))
        self.stages, self.aimed = stages, b""
        table = self._assembled()
        self.low, self.high = table.bounds()
        self.stepped = table.stepped
        self.A, self._pattern = table.matrix(self.size, self.VARYING if varying else ())
        self.P, self.q = self._cost()

    def update(self, stages: Stages) -> None:
        """Other stages before the terminal one, whose G is 0 wherever that of the first ones was at all stages; in place."""
        self.stages = stages
        table = self._assembled()
        self.low, self.high = table.bounds()
        self.A.data[:] = table.values(self._pattern)[self._pattern[""]]

    # -- where things are -------------------------------------------------------------------------------------------------

    @property
    def variable(self) -> bool:
        """Does the tube depend on the plan?"""
        return bool(len(self.on))

    @cached_property
    def at(self) -> dict[str, Ints]:
        """First column of each stage's part of z."""
        N, n, m, p, q = self.N, self.n, self.m, self.p, len(self.on)
        sizes = [("x", N + 1, n), ("u", N, m)]
        sizes += [("xs", 1, n), ("us", 1, m)] if self.steady else []
        sizes += [("e", N + 1, len(self.soft.axis))] if self.soft else []
        sizes += [("size", 1, p)] if self.steady else []
        sizes += [("s", N, p), ("a", N + self.steady, q)] if self.variable else []
        out, total = {}, 0
        for name, count, size in sizes:
            out[name] = total + size * np.arange(count)
            total += size * count
        out["end"] = np.array([total])
        return out

    @cached_property
    def s0(self) -> Array:
        """s₀ (p,): x̄₀ is the state to within ε, as every equation is kept."""
        return np.asarray(np.abs(self.section.H).sum(axis=1) * self.tolerance)

    @property
    def qp(self) -> Qp:
        """As a solver takes it: for the start, the reference and the bounds that were set last."""
        return Qp(self.P, self.q, self.A, self.low, self.high)

    @property
    def size(self) -> int:
        return int(self.at["end"][0])

    # -- rows -------------------------------------------------------------------------------------------------------------

    def _assembled(self) -> Table:
        """All rows with their values, from the stages that hold now."""
        N, n, st, sec, eps = self.N, self.n, self.stages, self.section, self.tolerance
        size = np.abs(sec.H)
        # Each equation of the dynamics may be missed by ε, which is as much more of w.
        grown = sec.moved_by(st.A, st.B) + size @ st.G @ np.abs(self.F @ sec.feedback)
        spread = (size @ (st.c + eps)[..., None])[..., 0]
        self.grown, self.spread = grown, spread
        # The tube where it does not depend on the plan, else 0 but for s₀.
        self.constant = np.vstack([self.s0, np.zeros((N, self.p))])
        if not self.variable:
            self.constant = self.tube()
        table, at = Table(), self.at
        self.start = table.rows(np.zeros((1, n)), np.zeros((1, n)))
        table.put("start", self.start, at["x"][:1], np.eye(n))
        dynamics = table.rows(st.d[:N], st.d[:N])
        table.put("next", dynamics, at["x"][1:], np.eye(n))
        table.put("A", dynamics, at["x"][:-1], -st.A[:N])
        table.put("B", dynamics, at["u"], -st.B[:N])
        whole = np.vstack([np.eye(n + self.m), self.rows.C])
        grows = np.abs(whole @ sec.feedback)
        # What is asked of x̄₀ alone is asked of the start, not of the plan.
        self.whole, self.grows, self.driven = whole, grows, np.asarray(whole[:, n:].any(axis=1))
        self.upper, self.lower = (np.full((N + 1, len(whole)), -1) for _ in range(2))
        self.off = np.full((N + 1, len(whole)), eps)
        self._kept(table, "first", slice(0, 1), np.flatnonzero(self.driven))
        self._kept(table, "stage", slice(1, N), np.arange(len(whole)))
        if not self.steady:
            self._kept(table, "last", slice(N, N + 1), np.flatnonzero(~self.driven))
        if self.variable:
            self._variable_tube(table, grown, spread)
        if self.steady:
            self.terminal = self._invariant(grown[N], spread[N], size)
            self._terminal(table, whole, grows)
        if self.rates is not None:
            self.changes = self._rates(table, self.rates)
        if self.soft is not None:
            self._soft(table, self.soft)
        return table

    def _kept(self, table: Table, name: str, k: slice, take: Ints) -> None:
        """low ≤ W z ≤ high on the whole section of the stages k, for the rows W that are taken."""
        at, W, grows = self.at, self.whole[take], self.grows[take]
        low, high = (bound[k][:, take] for bound in self.limits())
        if not self.variable or name == "first":
            self.off[k] += self.constant[k] @ self.grows.T
        off = self.off[k][:, take]
        free = np.full_like(low, -np.inf)
        sides = [("above", 1.0, free, high - off), ("below", -1.0, free, -low - off)]
        sides = sides if self.variable else [("within", 1.0, low + off, high - off)]
        for word, sign, least, most in sides:
            first = table.rows(least, most)
            for kept in {"within": (self.upper, self.lower), "above": (self.upper,), "below": (self.lower,)}[word]:
                kept[k][:, take] = first[:, None] + np.arange(len(take))
            self._put(table, f"{name}-{word}", first, sign * W, at["x"][k], at["u"][k])
            if self.variable and name != "first":
                table.put(f"{name}-{word}-s", first, at["s"][slice(k.start - 1, k.stop - 1)], grows)

    def _put(self, table: Table, name: str, first: Ints, W: Array, x: Ints, u: Ints) -> None:
        """W z, of the states and the inputs at these columns, in as many of the rows as there are of each."""
        table.put(f"{name}-x", first[: len(x)], x, W[..., : self.n])
        table.put(f"{name}-u", first[: len(u)], u, W[..., self.n :])

    def bound(self, low: Array, high: Array) -> None:
        """New bounds low, high (N+1, n+m+r) of what `whole` reads, at each stage that has rows; those of `final` stay."""
        up, down = self.upper >= 0, self.lower >= 0
        self.high[self.upper[up]] = np.minimum(high, THRESHOLDS.loose_bound)[up] - self.off[up]
        if self.variable:
            self.high[self.lower[down]] = np.minimum(-low, THRESHOLDS.loose_bound)[down] - self.off[down]
        else:
            self.low[self.lower[down]] = np.maximum(low, -THRESHOLDS.loose_bound)[down] + self.off[down]

    def tube(self, away: Array | None = None) -> Array:
        """s (N+1, p) of a plan with a_k = away (≥ N, f), by default 0: of one at rest where G has its centre."""
        away = np.zeros((self.N, len(self.F))) if away is None else away
        s = np.vstack([self.s0, np.zeros((self.N, self.p))])
        for k in range(self.N):
            s[k + 1] = self.grown[k] @ s[k] + self.spread[k] + np.abs(self.section.H) @ self.stages.G[k] @ away[k]
        return s

    def _variable_tube(self, table: Table, grown: Array, spread: Array) -> None:
        N, at, st, on = self.N, self.at, self.stages, self.on
        F, M, q, eps = self.F[on], N + self.steady, len(on), self.tolerance
        first = np.vstack([grown[0] @ self.s0, np.zeros((N - 1, self.p))])
        tube = table.rows(spread[:N] + first + eps, np.full((N, self.p), np.inf))
        table.put("tube-next", tube, at["s"], np.eye(self.p))
        table.put("tube-s", tube[1:], at["s"][:-1], -grown[1:N])
        table.put("tube-a", tube, at["a"][:N], -(np.abs(self.section.H) @ st.G[:N][:, :, on]))
        self.tubes = tube[:, None] + np.arange(self.p)
        self.sizes = np.empty(0, dtype=np.int64)
        for sign, word in ((1.0, "above"), (-1.0, "below")):
            first = table.rows(-sign * st.centre[:M] @ F.T + eps, np.full((M, q), np.inf))
            self.sizes = np.concatenate([self.sizes, first])
            table.put(f"size-{word}", first, at["a"], np.eye(q))
            self._put(table, f"size-{word}", first, -sign * F, at["x"][:N], at["u"])
            if self.steady:
                self._put(table, f"size-{word}-steady", first[N:], -sign * F, at["xs"], at["us"])

    def _invariant(self, M: Array, spread: Array, size: Array) -> tuple[Array, Array, Array]:
        """Terminal sizes σ = base + per · a_s + more · κ: base (p,), more (p, p), per (p, q)."""
        radius = float(np.abs(np.linalg.eigvals(M)).max())
        if not radius < 1 - 1e-9:
            raise NotShrinking(radius)
        inverse = np.maximum(np.linalg.inv(np.eye(self.p) - M), 0.0)
        return inverse @ spread, inverse / inverse.max(axis=0), inverse @ size @ self.stages.G[self.N][:, self.on]

    def _terminal(self, table: Table, whole: Array, grows: Array) -> None:
        N, n, p, at, st, H, eps = self.N, self.n, self.p, self.at, self.stages, self.section.H, self.tolerance
        base, more, per = self.terminal
        low, high = self.limits()
        sides = np.array([1.0, -1.0])[:, None, None]
        steady = table.rows(st.d[N:], st.d[N:])
        table.put("steady-x", steady, at["xs"], np.eye(n) - st.A[N:])
        table.put("steady-u", steady, at["us"], -st.B[N:])
        ends = table.rows(np.full((2, len(whole)), -np.inf), np.vstack([high[N], -low[N]]) - eps - grows @ base)
        self._put(table, "set", ends, sides * whole, np.repeat(at["xs"], 2), np.repeat(at["us"], 2))
        table.put("set-size", ends, np.repeat(at["size"], 2), grows @ more)
        positive = table.rows(np.zeros((1, p)), np.full((1, p), np.inf))
        table.put("positive", positive, at["size"], np.eye(p))
        self.final = np.arange(steady[0], positive[0] + p)
        above = table.rows(np.full((2, p), -np.inf), np.tile(base - eps, (2, 1)) - self.constant[N])
        table.put("end-x", above, np.repeat(at["x"][N:], 2), sides * H)
        table.put("end-xs", above, np.repeat(at["xs"], 2), -sides * H)
        table.put("end-size", above, np.repeat(at["size"], 2), -more)
        if self.variable:
            table.put("end-s", above, np.repeat(at["s"][-1:], 2), np.eye(p))
            table.put("end-a", above, np.repeat(at["a"][-1:], 2), -per)
            table.put("set-a", ends, np.repeat(at["a"][-1:], 2), grows @ per)

    def _rates(self, table: Table, rates: Array) -> Ints:
        """Rows that keep |u_k − u_{k−1}| ≤ r on the tubes; those of them that the input before asks of ū₀.

        With W_k = c + G(a_k + |E| s_k) and ū_N = u_s + K(x̄_N − x_s): |ū_{k+1} − ū_k| + D s_k + |K| W_k ≤ r for k < N, and
        Dσ + |K| W_s ≤ r; each tightened by ε.
        """
        on = np.flatnonzero(np.isfinite(rates))
        N, at, st, sec, eps = self.N, self.at, self.stages, self.section, self.tolerance
        K, one = sec.K[on], np.eye(self.m)[on]
        size = np.abs(K)
        # Each equation of the dynamics may be missed by ε, which is as much more of w.
        room = rates[on] - eps - (st.c + eps) @ size.T
        spread = size @ st.G
        D, far = sec.turning(st.A + st.B @ sec.K)[:, on] + spread @ np.abs(self.F @ sec.feedback), spread[:, :, self.on]
        start = table.rows(-rates[on][None], rates[on][None])
        table.put("rate-start", start, at["u"][:1], one)
        base, more, per = self.terminal
        for sign, word in ((1.0, "above"), (-1.0, "below")):
            high = room[:N] - (D[:N] @ self.constant[:N, :, None])[..., 0]
            first = table.rows(np.full_like(high, -np.inf), high)
            table.put(f"rate-{word}", first, at["u"], -sign * one)
            table.put(f"rate-{word}-next", first[: N - 1], at["u"][1:], sign * one)
            table.put(f"rate-{word}-us", first[N - 1 :], at["us"], sign * one)
            table.put(f"rate-{word}-x", first[N - 1 :], at["x"][N:], sign * K)
            table.put(f"rate-{word}-xs", first[N - 1 :], at["xs"], -sign * K)
            if self.variable:
                table.put(f"rate-{word}-a", first, at["a"][:N], far[:N])
                table.put(f"rate-{word}-s", first[1:], at["s"][: N - 1], D[1:N])
        high = (room[N] - D[N] @ base)[None]
        ends = table.rows(np.full_like(high, -np.inf), high)
        table.put("rate-set-size", ends, at["size"], D[N] @ more)
        if self.variable:
            table.put("rate-set-a", ends, at["a"][-1:], D[N] @ per + far[N])
        self.final = np.append(self.final, ends[0] + np.arange(len(on)))
        return np.asarray(start[0] + np.arange(len(on)))

    def _soft(self, table: Table, soft: Preferred) -> None:
        """Rows e_k ≥ 0, z̄_k − high, low − z̄_k for k < N; e_N holds what both x̄_N and the steady pair exceed."""
        n, N, at, q = self.n, self.N, self.at, len(soft.axis)
        W = np.eye(n + self.m)[soft.axis]
        slack = np.append(at["e"], at["e"][-1])
        for sign, word, bound in ((1.0, "above", soft.high), (-1.0, "below", soft.low)):
            least = np.tile(-sign * bound, (N + 2, 1))
            # There is no input at stage N.
            least[N, soft.axis >= n] = -np.inf
            first = table.rows(least, np.full_like(least, np.inf))
            table.put(f"soft-{word}", first, slack, np.eye(q))
            self._put(table, f"soft-{word}", first, -sign * W, at["x"], at["u"])
            self._put(table, f"soft-{word}-steady", first[N + 1 :], -sign * W, at["xs"], at["us"])
        table.put("soft-positive", table.rows(np.zeros((N + 1, q)), np.full((N + 1, q), np.inf)), at["e"], np.eye(q))

    def limits(self) -> tuple[Array, Array]:
        """low, high (N+1, n+m+r) of the box of each stage, and of the rows."""
        st, shape = self.stages, (self.N + 1, len(self.rows.C))
        return (
            np.hstack([st.low, np.broadcast_to(np.maximum(self.rows.low, -THRESHOLDS.loose_bound), shape)]),
            np.hstack([st.high, np.broadcast_to(np.minimum(self.rows.high, THRESHOLDS.loose_bound), shape)]),
        )

    def target(self, z: Array, weights: Array) -> Array | None:
        """The steady pair (n + m,) whose terminal set keeps all rows, nearest to z in |weights · ·|, if there is one."""
        at, n, m = self.at, self.n, self.m
        columns = np.concatenate([np.arange(at[k][-1], at[k][-1] + w) for k, w in (("xs", n), ("us", m), ("size", self.p))])
        kept = self.final
        if self.variable:
            q = len(self.on)
            columns = np.concatenate([columns, np.arange(at["a"][-1], at["a"][-1] + q)])
            last = self.sizes[-1] + np.arange(q)
            kept = np.concatenate([kept, self.sizes[self.N] + np.arange(q), last])
        A = self.A[kept][:, columns]
        goal, weight = np.zeros(len(columns)), np.full(len(columns), 1e-9)
        goal[: n + m], weight[: n + m] = z, np.maximum(weights, 1e-6)
        qp = Qp(sp.diags(weight, format="csc"), -weight * goal, A, self.low[kept], self.high[kept])
        found = Piqp(qp, 1e-8).solve()
        return found.z[: n + m] if found.status == "solved" else None

    # -- cost -------------------------------------------------------------------------------------------------------------

    def _cost(self) -> tuple[sp.csc_matrix, Array]:
        n, m, N, w, at = self.n, self.m, self.N, self.weights, self.at
        P = np.zeros((self.size, self.size))
        for k in range(N + 1):
            x = slice(int(at["x"][k]), int(at["x"][k]) + n)
            P[x, x] = 2 * (w.Q if k < N else w.P)
        for u in at["u"]:
            P[u : u + m, u : u + m] = 2 * w.R
        if self.steady:
            xs = int(at["xs"][0])
            P[xs : xs + n, xs : xs + n] = 2 * w.T
        q = np.zeros(self.size)
        if self.soft is not None:
            e = at["e"][:, None] + np.arange(len(self.soft.axis))
            P[e, e], q[e] = 2 * self.soft.quadratic, self.soft.linear
        return sp.csc_matrix(np.triu(P)), q

    def aim(self, x: Array, u: Array) -> None:
        """Set the reference (x_r, u_r), in the frame: one for all stages, or x (N+1, n) and u (N, m)."""
        x, u = np.broadcast_to(x, (self.N + 1, self.n)), np.broadcast_to(u, (self.N, self.m))
        if (aimed := x.tobytes() + u.tobytes()) == self.aimed:
            return
        w, parts, at, self.aimed = self.weights, self.q, self.at, aimed
        for k in range(self.N):
            parts[at["x"][k] :][: self.n] = -2 * w.Q @ x[k]
            parts[at["u"][k] :][: self.m] = -2 * w.R @ u[k]
        parts[at["x"][-1] :][: self.n] = -2 * w.P @ x[-1]
        if self.steady:
            parts[at["xs"][0] :][: self.n] = -2 * w.T @ x[-1]

    def begin(self, x: Array, before: Array | None = None) -> None:
        """Set x̄₀, and the input u (m,) of the step before if there was one, in the frame: |ū₀ − u| + W s₀ ≤ r."""
        first = int(self.start[0])
        self.low[first : first + self.n] = x
        self.high[first : first + self.n] = x
        if self.rates is not None:
            on = np.flatnonzero(np.isfinite(self.rates))
            middle, room = 0.0 if before is None else before[on], np.full(len(on), THRESHOLDS.loose_bound)
            if before is not None:
                room = self.rates[on] - self.tolerance - self.section.support[self.n :][on] @ self.s0
            self.low[self.changes], self.high[self.changes] = middle - room, middle + room

    def missed(self, z: Array, x: Array, before: Array | None = None) -> float:
        """By how much the worst row is missed when x̄₀ = x; NaN where that is no number."""
        self.begin(x, before)
        value = self.A @ z
        return float(np.maximum(self.low - value, value - self.high).max())

    def shifted(self) -> tuple[Ints, Ints, Array, Array]:
        """Where z and y of the next step are found in those of this one; and a guess for a first step."""
        z, y = np.arange(self.size), np.arange(len(self.low))
        for name in ("x", "u", "e", "s", "a"):
            if name in self.at and len(first := self.at[name]) > 1:
                width = int(first[1] - first[0])
                z[first[0] : first[-1]] += width
        for first in self.stepped:
            width = int(first[1] - first[0])
            y[first[0] : first[-1]] += width
        return z, y, np.zeros(self.size), np.zeros(len(self.low))
