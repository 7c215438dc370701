"""`feedback: disturbance`: at each period a plan whose inputs answer each disturbance on its own; proof: docs/mpc_sls.md."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, final

import numpy as np
import scipy.linalg

from gapcert import Array, Controller, Goal, UsageError
from gapcert.plugin import Bools, Ints, Policy
from gapcert_cells import write_saved
from gapcert_mpc.controller import Design, MpcController
from gapcert_mpc.plans import Memory

from .sls import SlsSolver
from .sls_problem import LtvProblem, SlsPlan

ROUNDING = 1e-9  # in half-ranges: what disturbances may seem larger by, since they are computed from states
INSIDE = 1e-7  # by so much the rows of the terminal set are stricter than those of stages, which are solved a little inside
BYTES = 1 << 29  # of plans that are remembered


@final
class Run(NamedTuple):
    """What a run remembers: its plan and the rows that mattered, the state x at which it is, the disturbances since the plan
    was made (age, n), how many of all its steps went on with a plan, and whether all disturbances were within their bounds.
    """

    plan: SlsPlan
    rows: Bools
    x: Array
    past: Array
    shifted: int
    sound: bool


@final
class Responses:
    """The program of a design under feedback from disturbances, in its frame.

    After the stages 0 … N − 1 one more has "inputs" p = (θ, κ): the steady pair z_s + S θ, where the columns of S span all
    directions in which pairs stay steady, and the terminal size σ = base + more·κ of `Program`. Its rows are
    |H(x_N − x_s)| ≤ σ, κ ≥ 0, and all rows on all of {|H(x − x_s)| ≤ σ}; p may answer disturbances, as every input does.
    """

    def __init__(self, design: Design) -> None:
        flat = design.stages.only(np.zeros(len(design.frame.half), dtype=np.bool_))
        self.stage, self.N, self.section = flat, flat.horizon, design.section
        self.n, self.m = flat.B.shape[1:]
        self.A, self.B, self.d, self.radius = flat.A[0], flat.B[0], flat.d[0], flat.c[0] + ROUNDING
        self.base, self.more, _ = replace(design, stages=flat).program().terminal
        moved = np.hstack([np.eye(self.n) - self.A, -self.B])
        self.steady = design.reference + np.linalg.pinv(moved) @ (self.d - moved @ design.reference)
        self.turn = scipy.linalg.null_space(moved)
        if np.abs(moved @ self.steady - self.d).max() + ROUNDING > design.tolerance:
            raise UsageError(
                f"controller.tolerance: {design.tolerance} is finer than steady pairs are known; choose a larger one"
            )
        self.rows = design.rows
        self.solver = SlsSolver(self._problem(design))

    def solve(self, x: Array, rows: Bools | None) -> tuple[SlsPlan, Bools] | None:
        """A plan from x, and the rows that mattered; None where there is none. A pure function of x and of `rows`, a guess."""
        held = ~self.rows.C[:, self.n :].any(axis=1)
        value = self.rows.C[held, : self.n] @ x
        # NaN compares as False.
        if not (np.abs(x).max() <= 1.0 and (value <= self.rows.high[held]).all() and (value >= self.rows.low[held]).all()):
            return None
        self.solver.update(x0=x)
        # A path of the interior-point method that got stuck begins once more without the rows of before.
        for begun in (rows, None) if rows is not None else (None,):
            self.solver.forget()
            if begun is not None:
                self.solver.working = begun
            found = self.solver.solve()
            if isinstance(found, SlsPlan):
                return found, self.solver.working
            if found.kind == "infeasible":
                break
        return None

    def target(self, p: Array) -> tuple[Array, Array, Array]:
        """(x_s, u_s, σ) of p."""
        q = self.turn.shape[1]
        z = self.steady + self.turn @ p[:q]
        return z[: self.n], z[self.n :], self.base + self.more @ p[q : q + len(self.base)]

    def _problem(self, design: Design) -> LtvProblem:
        N, n, m, st, w = self.N, self.n, self.m, self.stage, design.weights
        q, size = self.turn.shape[1], len(self.base)
        wide = max(m, q + size)
        whole = np.vstack([np.eye(n + m), design.rows.C])
        C, ends = self._end(whole, st.low[N], st.high[N])
        count = max(len(whole), len(C))
        Cx, Cu = np.zeros((N + 1, count, n)), np.zeros((N + 1, count, wide))
        Cx[:N, : len(whole)], Cu[:N, : len(whole), :m] = whole[:, :n], whole[:, n:]
        Cx[N, : len(C)], Cu[N, : len(C), : q + size] = C[:, :n], C[:, n:]
        least, most = np.full((N + 1, count), -np.inf), np.full((N + 1, count), np.inf)
        for out, box, related in ((least, st.low, design.rows.low), (most, st.high, design.rows.high)):
            out[:N, : len(whole)] = np.hstack([box[:N], np.broadcast_to(related, (N, len(related)))])
        # What is asked of x₀ alone is asked of the start, not of the plan.
        least[0, ~Cu[0].any(axis=1)], most[0, ~Cu[0].any(axis=1)] = -np.inf, np.inf
        most[N, : len(C)] = ends
        R = np.tile(np.eye(wide), (N + 1, 1, 1))
        R[:N, :m, :m] = w.R
        # Costs are of size 1: a pair may end away from the reference for little, and small sets are wanted.
        R[N, :q, :q] *= 1e-2
        stages = np.arange(N + 1)[:, None, None] < N
        u_ref = np.zeros((N + 1, wide))
        u_ref[:N, :m] = design.reference[n:]
        B = np.zeros((N + 1, n, wide))
        B[:N, :, :m] = st.B[:N]
        return LtvProblem(
            A=np.where(stages, st.A, 0.0),
            B=B,
            d=np.where(stages[:, 0], st.d, 0.0),
            r=np.where(stages[:, 0], self.radius, 0.0),
            x0=design.reference[:n],
            Q=np.where(stages, w.Q, w.P),
            R=R,
            Q_end=np.zeros((n, n)),
            x_ref=np.vstack([np.tile(design.reference[:n], (N + 1, 1)), np.zeros((1, n))]),
            u_ref=u_ref,
            Cx=Cx,
            Cu=Cu,
            low=least,
            h=most,
        )

    def _end(self, whole: Array, low: Array, high: Array) -> tuple[Array, Array]:
        """C (x_N, θ, κ) ≤ most at the terminal stage."""
        n, sec, base, more = self.n, self.section, self.base, self.more
        low, high = np.concatenate([low, self.rows.low]), np.concatenate([high, self.rows.high])
        H, p, q = sec.H, len(base), self.turn.shape[1]
        at, move = H @ self.steady[:n], H @ self.turn[:n]
        grows = np.abs(whole @ np.vstack([sec.P, sec.K @ sec.P]))
        room, step, none = grows @ base + INSIDE, whole @ self.turn, np.zeros((len(whole), n))
        ends = [[H, -move, -more], [-H, move, -more]]
        held = [[none, step, grows @ more], [none, -step, grows @ more]]
        C = np.block([*ends, *held, [np.zeros((p, n)), np.zeros((p, q)), -np.eye(p)]])
        kept = whole @ self.steady
        return C, np.concatenate([base + at, base - at, high - room - kept, -low - room + kept, np.zeros(p)])


@final
class DisturbanceMpcController(Controller):
    """MPC whose plans answer disturbances: contains a state if one begins there; a run's memory is the number of its `Run`.

    A plan is a certificate by itself: where a solve is refused, the run goes on with its plan, whose inputs follow from the
    disturbances since then, as states have shown them, and after its end with the terminal set's feedback. `fixed` is the
    controller with a fixed gain of the same design, which has all that both share.
    """

    def __init__(self, fixed: MpcController) -> None:
        assert fixed.design is not None, "a controller that wins nowhere plans nothing"
        self.fixed, self.kind, self.design = fixed, fixed.kind, fixed.design
        self.goal: Goal = fixed.goal
        self.evidence: Mapping[str, Any] = fixed.evidence
        self.counts = {"solved": 0, "shifted": 0}

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.fixed,)

    @cached_property
    def responses(self) -> Responses:
        return Responses(self.design)

    @cached_property
    def memory(self) -> Memory[Run]:
        p = self.responses.solver.problem
        N, n, m = p.B.shape
        return Memory(max(1024, BYTES // (8 * (N + 1) * (n + m) * (1 + N * n))))

    @property
    def policies(self) -> tuple[Policy, ...]:
        return self.fixed.policies

    @property
    def resolution(self) -> int:
        return self.fixed.resolution

    def _next(self, x: Array, run: Run | None) -> Run | None:
        """A new plan from a state in the frame, or what is left of the one that is held."""
        if (found := self.responses.solve(x, None if run is None else run.rows)) is not None:
            return Run(*found, x, np.empty((0, len(x))), run.shifted if run else 0, True)
        if run is None:
            return None
        w = x - self._expected(run)
        return Run(run.plan, run.rows, x, np.vstack([run.past, w]), run.shifted + 1, run.sound and self._bounded(w))

    def _bounded(self, w: Array) -> bool:
        return bool((np.abs(w) <= self.responses.radius).all())

    def _expected(self, run: Run) -> Array:
        """The next state where nothing disturbs, in the frame."""
        made = self.responses
        return np.asarray(made.A @ run.x + made.B @ self._input(run) + made.d)

    def _input(self, run: Run) -> Array:
        """In the frame."""
        N, m = self.responses.N, self.responses.m
        if (age := len(run.past)) < N:
            return run.plan.input(age, run.past)[:m]
        x, u, _ = self._ended(run)
        return np.asarray(u + self.design.section.K @ (run.x - x))

    def _ended(self, run: Run) -> tuple[Array, Array, Array]:
        N = self.responses.N
        return self.responses.target(run.plan.input(N, run.past[:N]))

    def contains(self, x: Array) -> Bools:
        return np.asarray(self.start(x) > 0)

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """As of every controller, of few at a time: a program is solved for each."""
        return super().draw(min(n, 64), rng)

    def start(self, x: Array) -> Ints:
        """The number of a run that begins there; 0 where there is no plan."""
        return np.array([self.memory.begin(row, lambda x: self._next(x, None)) for row in self.fixed.framed(x)], dtype=np.int64)

    def advance(self, x: Array, memory: Ints) -> Ints:
        out = np.zeros(len(x), dtype=np.int64)
        for i, (row, number) in enumerate(zip(self.fixed.framed(x), memory.tolist(), strict=True)):
            if (run := self.memory[number]) is not None and (then := self._next(row, run)) is not None:
                out[i] = self.memory.add(then)
                self.counts["shifted" if len(then.past) else "solved"] += 1
        return out

    def keeps(self, x: Array, memory: Ints) -> Bools:
        """(n,): is the run at x, and was every disturbance since its plan within its bounds?"""
        runs = [self.memory[number] for number in memory.tolist()]
        at = zip(self.fixed.framed(x), runs, strict=True)
        return np.array([run is not None and run.sound and np.abs(row - run.x).max() <= ROUNDING for row, run in at], np.bool_)

    def kept(self, x: Array, u: Array, after: Array, memory: Ints | None = None) -> Bools:
        """(n,): was the step's disturbance within its bounds?"""
        numbers = self.start(x) if memory is None else memory
        out = np.zeros(len(after), dtype=np.bool_)
        for i, (row, number) in enumerate(zip(self.fixed.framed(after), numbers.tolist(), strict=True)):
            run = self.memory[number]
            out[i] = run is not None and run.sound and self._bounded(row - self._expected(run))
        return np.asarray(out | self.over(after, numbers))

    def respond(self, x: Array, memory: Ints, policy: Policy, seed: int = 0, k: int = 0) -> Array:
        middle, half = self.design.frame.u
        out = np.empty((len(x), len(half)))
        for i, number in enumerate(memory.tolist()):
            if (run := self.memory[number]) is None:
                raise UsageError(
                    f"controller: row {i}: no plan begins at {np.asarray(x)[i].tolist()}; ask `contains` before `act`"
                )
            out[i] = middle + half * self._input(run)
        return out

    def act(self, x: Array, policy: Policy = "first", seed: int = 0, k: int = 0) -> Array:
        return self.respond(x, self.start(np.atleast_2d(x)), policy, seed, k)

    def fallbacks(self, memory: Ints) -> Ints:
        """(n,): steps of each run that went on with a plan of before, with the one that is about to be made."""
        runs = [self.memory[number] for number in memory.tolist()]
        return np.array([0 if run is None else run.shifted for run in runs], dtype=np.int64)

    def predicted(self, x: Array, memory: Ints | None = None) -> tuple[Array, Array, Array] | None:
        """x̄ after the disturbances so far, and the box of all that may follow; row 0 is x itself."""
        numbers = self.start(x[None]) if memory is None else memory
        if (run := self.memory[int(numbers[0])]) is None:
            return None
        return self.fixed.foreseen(x, *self._foreseen(run))

    def _foreseen(self, run: Run) -> tuple[Array, Array]:
        """Centres and half-widths of the states from now on, in the frame."""
        made, age, N = self.responses, len(run.past), self.responses.N
        if age >= N:
            x, _, size = self._ended(run)
            return np.array([run.x, x]), np.array([np.zeros(len(x)), np.abs(made.section.P) @ size])
        ahead = run.plan.state_response[age : N + 1]
        centre = run.plan.x[age : N + 1] + np.einsum("kjab,jb->ka", ahead[:, :age], run.past)
        return centre, np.einsum("kjab,b->ka", np.abs(ahead[:, age:N]), made.radius)

    def digest(self) -> str:
        """SHA-256 of everything that determines the inputs."""
        return hashlib.sha256(f"disturbance {self.fixed.digest()}".encode()).hexdigest()

    def save(self, folder: Path | str) -> None:
        """Write `controller.npz` and `controller.json`."""
        told = {"feedback": "disturbance", "digest": self.digest()}
        write_saved(Path(folder), self.fixed.saved() | told, self.design.arrays())


def answering(fixed: MpcController, starts: int, seed: int) -> Controller:
    """The controller with feedback from disturbances of the same design; `fixed` itself where that wins nowhere."""
    if fixed.design is None:
        return fixed
    low, high = np.asarray(fixed.goal.stay.low), np.asarray(fixed.goal.stay.high)
    x = low + (high - low) * np.random.default_rng(seed).random((starts, len(low)))
    share = float(DisturbanceMpcController(fixed).contains(x).mean())
    told = dict(fixed.evidence) | {"feedback": "disturbance", "domain_fraction": share}
    return DisturbanceMpcController(replace(fixed, evidence=told))
