"""What is found once, when a controller is made, so that its steps are fast: who solves, with which step sizes, and pieces."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, final

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from scipy.linalg.blas import dtbsv

from gapcert.plugin import Array
from gapcert_mpc.config import Choice
from gapcert_mpc.thresholds import THRESHOLDS

from .program import Program
from .solver import Answer, Name, Osqp, Piqp


@final
class Least:
    """z → z with a_k = |z̄_k − ẑ_k| + ε, s by its recursion, and the least σ ≥ Mσ + |H|(c + G a_s + ε) that holds s_N.

    Rows ask for smaller s, a and σ, so that a trajectory that keeps them with any tube keeps them with this one. Of two such σ
    the pointwise least is another: there is a least one. Policy iteration finds it. The program leaves them free at no cost.
    """

    def __init__(self, program: Program) -> None:
        self.program = p = program
        at, st, on, N, n = p.at, p.stages, p.on, p.N, p.n
        self.xs, self.kappa = int(at["xs"][0]), int(at["size"][0])
        self.inverse = np.linalg.inv(p.terminal[1])
        self.need = p.constant[N] - p.terminal[0] + p.tolerance
        if p.variable:
            last = np.append(at["u"], at["us"])
            columns = np.hstack([at["x"][:, None] + np.arange(n), last[:, None] + np.arange(p.m)])
            columns[N, :n] = self.xs + np.arange(n)
            self.inputs, self.centre = columns[:, on], st.centre[:, on]
            self.band, self.spread = _lower_band(p.grown[1:N]), (p.spread[:N] + p.tolerance).ravel()
            self.spread[: p.p] += p.grown[0] @ p.s0
            self.grows = np.abs(p.section.H) @ st.G[:N][:, :, on]

    def __call__(self, z: Array) -> Array:
        p, z = self.program, z.copy()
        end, xs, kappa = p.N * p.n, self.xs, self.kappa
        need = self.need + np.abs(p.section.H @ (z[end : end + p.n] - z[xs : xs + p.n]))
        if p.variable:
            a = np.abs(z[self.inputs] - self.centre) + p.tolerance
            s = dtbsv(len(self.band) - 1, self.band, self.spread + (self.grows @ a[:-1, :, None]).ravel(), lower=1, diag=1)
            z[kappa + p.p :] = np.concatenate([s, a.ravel()])
            need += s[-p.p :] - p.terminal[2] @ a[-1]
        z[kappa : kappa + p.p] = self._kappa(need)
        return z

    def _kappa(self, need: Array) -> Array:
        """κ ≥ 0 of the least σ = more κ ≥ need, where `more` is the inverse of an M-matrix up to a diagonal."""
        held = need > 0
        if not held.any():
            return np.zeros(len(need))
        kappa, more = np.asarray(self.inverse @ need), self.program.terminal[1]
        # Each round raises σ, so that no set comes twice but by rounding.
        for _ in range(4 * len(need) if kappa.min() < 0 else 0):
            kappa = np.zeros(len(need))
            kappa[held] = np.linalg.solve(more[np.ix_(held, held)], need[held])
            then = np.where(held, kappa > 0, more @ kappa < need - 1e-12)
            if (then == held).all():
                break
            held = then
        return np.asarray(np.maximum(kappa, 0.0))


def _lower_band(blocks: Array) -> Array:
    """I with −blocks (k, p, p) below its diagonal blocks, as the bands that BLAS takes: [i − j, j]."""
    k, p = blocks.shape[:2]
    band = np.zeros((2 * p, (k + 1) * p))
    band[0] = 1.0
    for i, j in np.ndindex(p, p):
        band[p + i - j, j : k * p : p] = -blocks[:, i, j]
    return np.asfortranarray(band)


@final
class Pieces:
    """z and y as affine functions of x̄₀, per set of rows that are equations there while no other row matters.

    Partial enumeration [Pannocchia, Rawlings and Wright, 2007]: an answer is one only if no row is missed by more than half the
    tolerance, and no multiplier has the wrong sign; it is a best one then, as the program is convex. What neither cost nor
    rows determine stays at the middle of the rows when x̄₀ is `aim`, or becomes as small as the trajectory allows.
    """

    def __init__(self, program: Program, kept: Array, aim: Array) -> None:
        """kept (k, rows): −1 at the lower bound, 1 at the upper, 0 where the row does not matter; equations count anyway."""
        self.program, self.least, self.aimed = program, Least(program), program.aimed
        program.begin(aim)
        centre = Piqp(program.qp, program.tolerance).solve()
        made = [self._piece(active, centre.z) for active in (kept if centre.status == "solved" else kept[:0])]
        # What rules a piece out is looked at for all of them at once.
        self.ends = np.cumsum([0] + [len(sure) for _, sure, _ in made])[:-1]
        sure = np.vstack([sure for _, sure, _ in made]) if made else np.zeros((0, program.n + 1))
        self.sure, self.sure_slope = sure[:, 0].copy(), sure[:, 1:].copy()
        self.parts = [(a[:, 0].copy(), a[:, 1:].copy(), b[:, 0].copy(), b[:, 1:].copy()) for a, _, b in made]

    def __len__(self) -> int:
        return len(self.parts)

    def __call__(self, x: Array, first: int = 0) -> tuple[Array, Array, int] | None:
        """(z, y) from x̄₀ = x, and the piece; that which is asked for first where two hold. None where none does."""
        p = self.program
        # With another reference other plans are best.
        if not self.parts or p.aimed != self.aimed:
            return None
        # NaN compares as False, so that it keeps nothing.
        some = np.flatnonzero(np.maximum.reduceat(self.sure + self.sure_slope @ x, self.ends) <= 0.0).tolist()
        for k in sorted(some, key=lambda k: bool(k != first)) if len(some) > 1 else some:
            constant, slope, at, along = self.parts[k]
            found = constant + slope @ x
            z = found[: p.size]
            if p.variable or not (at + along @ x).max(initial=-1.0) <= 0.0:
                z = self.least(z)
                if not p.missed(z, x) <= p.tolerance / 2:
                    continue
            return z, found[p.size :], k
        return None

    def _piece(self, active: Array, centre: Array) -> tuple[Array, Array, Array]:
        """(z, y), what must be negative for it to hold, and what must be so for its tube to be taken as it is: maps of (1, x).

        (z, y) is the limit of the proximal method of multipliers, so that rows may depend on each other.
        """
        p = self.program
        starts = np.arange(p.start[0], p.start[0] + p.n)
        low, high = (np.hstack([b[:, None], np.zeros((len(b), p.n))]) for b in (p.low, p.high))
        for bound in (low, high):
            bound[starts] = np.eye(p.n, p.n + 1, 1)
        equal = p.low == p.high
        on = np.flatnonzero(equal | (active != 0))
        A, wanted = sp.csr_matrix(p.A)[on], np.where((active[on] > 0)[:, None], high[on], low[on])
        P = p.P + sp.triu(p.P, 1).T
        own, rows = sp.identity(p.size), sp.identity(len(on))
        factors = scipy.sparse.linalg.splu(
            sp.bmat([[P + THRESHOLDS.proximal_weight * own, A.T], [A, -THRESHOLDS.proximal_weight * rows]], format="csc")
        )
        z, y = np.hstack([centre[:, None], np.zeros((p.size, p.n))]), np.zeros((len(on), p.n + 1))
        q = np.hstack([p.q[:, None], np.zeros((p.size, p.n))])
        for _ in range(THRESHOLDS.proximal_rounds):
            found = factors.solve(np.vstack([THRESHOLDS.proximal_weight * z - q, wanted - THRESHOLDS.proximal_weight * y]))
            z, y = found[: p.size], found[p.size :]
        dual, unit, value = np.zeros((len(p.low), p.n + 1)), np.eye(1, p.n + 1), p.A @ z
        dual[on] = y
        side = np.flatnonzero(~equal[on])
        signs = -np.sign(active[on[side]])[:, None] * y[side] - THRESHOLDS.multiplier_error * unit
        # Rows of the trajectory alone tell at once; those of its tube may still hold with a smaller one.
        alone = np.diff(sp.csr_matrix(p.A[:, p.at["size"][0] :]).indptr) == 0
        missed = [sign * (value - bound) - p.tolerance / 2 * unit for sign, bound in ((1, high), (-1, low))]
        sure = [signs, *(by[alone & np.isfinite(by[:, 0])] for by in missed)]
        rest = [by[~alone & np.isfinite(by[:, 0])] for by in missed]
        return np.vstack([z, dual]), np.vstack(sure), np.vstack(rest)


def active(program: Program, z: Array, y: Array) -> Array:
    """Which rows hold an exact answer back: those nearer to their bound than their multiplier is to 0; −1, 0 or 1 (rows,)."""
    value = program.A @ z
    near = np.minimum(value - program.low, program.high - value) < np.abs(y)
    return np.where((program.low == program.high) | ~near, 0, np.sign(y)).astype(np.int8)


@final
@dataclass(frozen=True)
class Tuning:
    """Step size ρ and relaxation α of OSQP, fixed, and the rows that hold plans back most often (k, rows): −1, 0, 1."""

    rho: float = 0.1
    alpha: float = 1.6
    pieces: Array = field(default_factory=lambda: np.zeros((0, 0), dtype=np.int8))


class _Seen(NamedTuple):
    """A state that a plan was drawn from, and that of the step before."""

    x: Array
    answer: Answer
    before: Answer | None


def tuned(
    program: Program, aim: Array, asked: Choice, seed: int = 0, tell: Callable[..., None] = lambda *told: None
) -> tuple[Name, Tuning, int]:
    """The solver, what it is set to, and how many states of sample runs this rests on; the same whenever it is asked again.

    Runs begin at random and at the aim, under disturbances at random corners. The solver `auto` is the one that needs less
    work, in iterations, where no piece holds. tell: hears what is tried, and the best of it.
    """
    tell("sample runs")
    seen = _runs(program, aim, np.random.default_rng(seed))
    counts = Counter(active(program, s.answer.z, s.answer.y).tobytes() for s in seen)
    # A piece is affine in the state alone; where rates are limited, the input before matters, too.
    most = 0 if program.rates is not None else THRESHOLDS.piece_count
    often = [key for key, count in counts.most_common(most) if count >= THRESHOLDS.piece_share * len(seen)]
    kept = np.array([np.frombuffer(key, dtype=np.int8) for key in often]).reshape(len(often), len(program.low))
    made = Pieces(program, kept, aim)
    rest = [s for s in seen if made(s.x) is None]
    rest = rest if len(rest) >= THRESHOLDS.tuning_steps else seen
    dear = np.array([THRESHOLDS.interior_cost * s.answer.iterations for s in rest])
    best, found = (float(dear.sum()) if asked == "auto" else np.inf), (Tuning.rho, Tuning.alpha)
    name: Name = "piqp" if asked == "auto" else asked
    for rho in THRESHOLDS.tried_rhos if asked in ("auto", "osqp") else ():
        for alpha in THRESHOLDS.tried_alphas:
            tell(f"solver settings ρ {rho:g}, α {alpha:g}", {"least work": best, "with": name})
            work = _work(program, rest, dear, rho, alpha, best)
            if work < best:
                best, found, name = work, (rho, alpha), "osqp"
    return name, Tuning(*found, kept), len(seen)


def _runs(program: Program, aim: Array, rng: np.random.Generator) -> list[_Seen]:
    st, n, seen, runs = program.stages, program.n, list[_Seen](), 0
    # Which rows hold a plan back shows where it is exact.
    solver = Piqp(program.qp, 1e-11)
    for number in range(THRESHOLDS.tuning_tries):
        if runs == THRESHOLDS.tuning_runs + THRESHOLDS.tuning_still:
            break
        x = aim if number < THRESHOLDS.tuning_still else rng.uniform(st.low[0, :n], st.high[0, :n])
        before = None
        for _ in range(THRESHOLDS.tuning_steps):
            program.begin(x)
            solver.update(program.qp)
            answer = solver.solve()
            if answer.status != "solved":
                break
            seen.append(_Seen(x, answer, before))
            runs, before = runs + (before is None), answer
            z = np.concatenate([x, answer.z[program.at["u"][0] :][: program.m]])
            wide = st.c[0] + st.G[0] @ np.abs(z - st.centre[0])
            x = st.A[0] @ x + st.B[0] @ z[n:] + st.d[0] + wide * rng.choice((-1.0, 1.0), n)
    return seen


def _work(program: Program, seen: list[_Seen], dear: Array, rho: float, alpha: float, most: float) -> float:
    """Iterations over the states seen, each from the plan before; where they are too many, the other method's are added."""
    solver = Osqp(program.qp, program.tolerance, rho=rho, alpha=alpha)
    z, y, *none = program.shifted()
    total = 0.0
    for s, other in zip(seen, dear.tolist(), strict=True):
        program.begin(s.x)
        solver.update(program.qp)
        found = solver.solve(*none) if s.before is None else solver.solve(s.before.z[z], s.before.y[y])
        total += found.iterations + (other if found.status != "solved" else 0.0)
        if total >= most:
            break
    return total
