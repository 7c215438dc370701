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

from gapcert.plugin import Array, Bools, Controller, Goal, UsageError
from gapcert_cells import loaded, write_saved
from gapcert_mpc.controller import MpcController, PlanController
from gapcert_mpc.planning.design import Design
from gapcert_mpc.planning.plans import Memory
from gapcert_mpc.task import Task
from gapcert_mpc.thresholds import THRESHOLDS

from .regulation import regulating
from .sls import LtvProblem, SlsPlan, SlsSolver


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

    @property
    def age(self) -> int:
        return len(self.past)


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
        self.A, self.B, self.d, self.radius = flat.A[0], flat.B[0], flat.d[0], flat.c[0] + THRESHOLDS.computed_disturbance
        self.base, self.more, _ = replace(design, stages=flat).program().terminal
        moved = np.hstack([np.eye(self.n) - self.A, -self.B])
        self.steady = design.reference + np.linalg.pinv(moved) @ (self.d - moved @ design.reference)
        self.turn = scipy.linalg.null_space(moved)
        if np.abs(moved @ self.steady - self.d).max() + THRESHOLDS.computed_disturbance > design.tolerance:
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
        room, step, none = grows @ base + THRESHOLDS.terminal_inside, whole @ self.turn, np.zeros((len(whole), n))
        ends = [[H, -move, -more], [-H, move, -more]]
        held = [[none, step, grows @ more], [none, -step, grows @ more]]
        C = np.block([*ends, *held, [np.zeros((p, n)), np.zeros((p, q)), -np.eye(p)]])
        kept = whole @ self.steady
        return C, np.concatenate([base + at, base - at, high - room - kept, -low - room + kept, np.zeros(p)])


@final
class DisturbanceMpcController(PlanController[Run]):
    """MPC whose plans answer disturbances.

    Where a solve is refused, the inputs of what is left of a plan follow from the disturbances since it was made, as states
    have shown them. `fixed` is the controller with a fixed gain of the same design, which has all that both share.
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
        return Responses(self._design)

    @cached_property
    def memory(self) -> Memory[Run]:  # type: ignore[override]
        p = self.responses.solver.problem
        N, n, m = p.B.shape
        return Memory(max(1024, THRESHOLDS.plan_bytes // (8 * (N + 1) * (n + m) * (1 + N * n))))

    @property
    def resolution(self) -> int:
        return self.fixed.resolution

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """As of every controller, of few at a time: a program is solved for each."""
        return super().draw(min(n, 64), rng)

    def _next(self, x: Array, held: Run | None) -> Run | None:
        if (found := self.responses.solve(x, None if held is None else held.rows)) is not None:
            return Run(*found, x, np.empty((0, len(x))), held.shifted if held else 0, True)
        if held is None:
            return None
        w = x - self._expected(held)
        return Run(held.plan, held.rows, x, np.vstack([held.past, w]), held.shifted + 1, held.sound and self._bounded(w))

    def _bounded(self, w: Array) -> bool:
        return bool((np.abs(w) <= self.responses.radius).all())

    def _expected(self, held: Run) -> Array:
        """The next state where nothing disturbs, in the frame."""
        made = self.responses
        return np.asarray(made.A @ held.x + made.B @ self._input(held.x, held) + made.d)

    def _input(self, x: Array, held: Run) -> Array:
        """Of the state that the run is known to be at."""
        N, m = self.responses.N, self.responses.m
        if held.age < N:
            return held.plan.input(held.age, held.past)[:m]
        x_s, u_s, _ = self._ended(held)
        return np.asarray(u_s + self._design.section.K @ (held.x - x_s))

    def _ended(self, held: Run) -> tuple[Array, Array, Array]:
        N = self.responses.N
        return self.responses.target(held.plan.input(N, held.past[:N]))

    def _held(self, x: Array, held: Run) -> bool:
        """Is the run at x, and was every disturbance since its plan within its bounds?"""
        return bool(held.sound and np.abs(x - held.x).max() <= THRESHOLDS.computed_disturbance)

    def _stepped(self, u: Array, after: Array, held: Run) -> bool:
        """Was the step's disturbance within its bounds?"""
        return held.sound and self._bounded(after - self._expected(held))

    def _foreseen(self, held: Run) -> tuple[Array, Array]:
        """x̄ after the disturbances so far, and the box of all that may follow."""
        made, age, N = self.responses, held.age, self.responses.N
        if age >= N:
            x, _, size = self._ended(held)
            return np.array([held.x, x]), np.array([np.zeros(len(x)), np.abs(made.section.P) @ size])
        ahead = held.plan.state_response[age : N + 1]
        centre = held.plan.x[age : N + 1] + np.einsum("kjab,jb->ka", ahead[:, :age], held.past)
        return centre, np.einsum("kjab,b->ka", np.abs(ahead[:, age:N]), made.radius)

    def digest(self) -> str:
        """SHA-256 of everything that determines the inputs."""
        return hashlib.sha256(f"disturbance {self.fixed.digest()}".encode()).hexdigest()

    def save(self, folder: Path | str) -> None:
        """Write `controller.npz` and `controller.json`."""
        told = {"feedback": "disturbance", "digest": self.digest()}
        write_saved(Path(folder), self.fixed.saved() | told, self._design.arrays())

    @classmethod
    def load(cls, folder: Path | str) -> DisturbanceMpcController:
        """Inverse of `save`."""

        def made(data: Mapping[str, Any], arrays: Mapping[str, Array]) -> DisturbanceMpcController:
            fixed = MpcController.read(Path(folder), data, arrays, None)
            if not fixed.wins:
                raise UsageError(
                    f"{Path(folder)}: controller.npz and controller.json do not belong together; synthesize it again"
                )
            return cls(fixed)

        return loaded(folder, made)


def answering(task: Task) -> Controller:
    """The controller with feedback from disturbances of the design that one gain has; that one itself where it wins nowhere."""
    # What it bounds is a constant, and no quadratic program is solved.
    options = task.options.model_copy(update={"majorant": "constant"})
    if not (fixed := regulating(replace(task, options=options, starts=1))).wins:
        return fixed
    x = task.drawn(np.random.default_rng(task.problem.seed), task.starts)
    share = float(DisturbanceMpcController(fixed).contains(x).mean())
    told = dict(fixed.evidence) | {"feedback": "disturbance", "domain_fraction": share}
    return DisturbanceMpcController(replace(fixed, evidence=told))
