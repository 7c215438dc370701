"""Who finds plans of a design: its program with who solves it, and what is asked of that for a run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Protocol, final

import numpy as np

from gapcert.plugin import Array, Bools
from gapcert_mpc.program.solver import Name, Piqp, QpSolver, solver
from gapcert_mpc.program.tuning import Pieces
from gapcert_mpc.thresholds import THRESHOLDS

from .design import Design, Ends
from .plans import Held, Plan, plan


@final
class Engine:
    """The program with who solves it: pieces, a fast solver, and one that always finishes, and knows what is infeasible."""

    def __init__(self, design: Design, first: Name) -> None:
        self.program = p = design.program()
        tuning = design.tuning
        self.pieces = Pieces(p, tuning.pieces, design.reference[: p.n]) if p.steady else None
        own = {"rho": tuning.rho, "alpha": tuning.alpha} if first == "osqp" else {}
        self.solvers: list[QpSolver] = [solver(first, p.qp, p.tolerance, **own)]
        if first != "piqp":
            self.solvers.append(Piqp(p.qp, p.tolerance))
        self.later = p.shifted()
        self.rest = design.reference[p.n :]

    def solve(self, x: Array, guess: Plan | None, before: Array | None = None) -> Plan | None:
        """A plan from x (frame) after an input, checked row by row; None where there is none. A pure function of all these."""
        first = 0 if guess is None else guess.piece
        if self.pieces is not None and (known := self.pieces(x, first)) is not None:
            return plan(self.program, *known)
        later_z, later_y, z, y = self.later
        if guess is not None:
            z, y = guess.z[later_z], guess.y[later_y]
        return self.found(x, z, y, first, before=before)

    def found(
        self, x: Array, z: Array, y: Array, first: int = 0, varied: bool = False, before: Array | None = None
    ) -> Plan | None:
        """By the first solver that finds one, from a guess; varied: the program has other stages than before."""
        program = self.program
        program.begin(x, before)
        for s in self.solvers:
            s.update(program.qp, varied)
            found = s.solve(z, y)
            last = s is self.solvers[-1]
            if found.status == "infeasible" and last:
                return None
            # Rows decide: a plan that keeps them is one, though it may not be the best.
            if found.status == "solved" or last:
                # Where lines vary, the tube is taken along the lines of the plan.
                kept = found.z if varied or self.pieces is None else self.pieces.least(found.z)
                # NaN compares as False, so that it keeps nothing.
                if program.missed(kept, x, before) <= program.tolerance:
                    return plan(program, kept, found.y, first)
        return None


class Planner(Protocol):
    """Finds the plans of a controller."""

    def solve(self, x: Array, held: Held | None) -> Plan | None:
        """A new plan from x (frame) of a run that holds this, or of one that begins; None where there is none.

        A pure function of both.
        """


@final
class Tracker:
    """Plans that end around a steady pair, drawn to what the design wants, or to a reference of the run's own."""

    def __init__(self, engine: Engine, design: Design) -> None:
        self.engine, self.design = engine, design

    def solve(self, x: Array, held: Held | None) -> Plan | None:
        # What is wanted at each stage, whatever was solved in between.
        n, N, z = self.design.frame.nx, self.design.stages.horizon, self.design.reference[None]
        if held is not None and held.aim is not None:
            z = held.aim[None]
        elif self.design.course is not None:
            z = self.design.course.ahead(0 if held is None else held.step + 1, N + 1)
        self.engine.program.aim(z[:, :n], z[:N, n:])
        return self.engine.solve(x, held and held.plan, held and held.u)


@final
class Landing:
    """Plans of M steps from x with low + E_x s_M ≤ x̄_M ≤ high − E_x s_M for one of the boxes; M is the plan's `arrival`.

    Only bounds of rows differ between boxes and between numbers of steps, so that one program serves them all.
    """

    def __init__(self, engine: Engine, ends: Ends) -> None:
        self.engine, self.boxes, self.horizon = engine, ends.boxes, engine.program.N
        self.low, self.high = engine.program.limits()

    def solve(self, x: Array, held: Held | None) -> Plan | None:
        """A plan of as many steps as there is one, to begin with; then up to the horizon, or what is left of `held` goes on."""
        if held is not None:
            return self._within(x, self.horizon, held.plan, np.ones(len(self.boxes), dtype=bool))
        for steps, low, high in reversed(list(self._reached(x))):
            near = np.asarray(((self.boxes[:, 0] <= high) & (self.boxes[:, 1] >= low)).all(axis=1))
            if near.any() and (made := self._within(x, steps, None, near)) is not None:
                return made
        return None

    def _reached(self, x: Array) -> Iterator[tuple[int, Array, Array]]:
        """(steps, low, high): boxes that hold x̄ of every plan from x, as far as there may be one; they only rule out."""
        p, n, spare = self.engine.program, len(x), 2 * self.engine.program.tolerance
        low, high = self.low + p.off, self.high - p.off
        a = b = x
        for k in range(self.horizon):
            A, B, u = p.stages.A[k], p.stages.B[k], slice(n, n + p.m)
            middle = (A @ (a + b) + B @ (low[k, u] + high[k, u])) / 2 + p.stages.d[k]
            wide = (np.abs(A) @ (b - a) + np.abs(B) @ (high[k, u] - low[k, u])) / 2 + np.abs(B).sum(axis=1) * spare + spare
            a, b = np.maximum(middle - wide, low[k + 1, :n] - spare), np.minimum(middle + wide, high[k + 1, :n] + spare)
            if (a > b).any():
                return
            yield k + 1, a, b

    def _within(self, x: Array, steps: int, guess: Plan | None, tried: Bools) -> Plan | None:
        """To the first of the boxes tried that there is a plan of so many steps to."""
        p = self.engine.program
        after = np.arange(self.horizon + 1)[:, None] >= steps + ~p.driven
        low, high = np.where(after, -THRESHOLDS.loose_bound, self.low), np.where(after, THRESHOLDS.loose_bound, self.high)
        for box in self.boxes[tried]:
            low[steps, : p.n] = np.maximum(self.low[steps, : p.n], box[0])
            high[steps, : p.n] = np.minimum(self.high[steps, : p.n], box[1])
            p.bound(low, high)
            if (found := self.engine.solve(x, guess)) is not None:
                return replace(found, arrival=steps)
        return None
