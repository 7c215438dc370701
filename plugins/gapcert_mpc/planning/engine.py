"""Who finds plans of a design: its program with who solves it, and what is asked of that for a run."""

from __future__ import annotations

from typing import Protocol, final

from gapcert import Array
from gapcert_mpc.program.pieces import Pieces
from gapcert_mpc.program.solver import Name, Piqp, QpSolver, solver

from .design import Design
from .plans import Held, Plan, plan


@final
class Engine:
    """The program with who solves it: pieces, a fast solver, and one that always finishes, and knows what is infeasible."""

    def __init__(self, design: Design, first: Name) -> None:
        self.program = p = design.program()
        data, tuning = (p.P, p.q, p.A, p.low, p.high, p.tolerance), design.tuning
        self.pieces = Pieces(p, tuning.pieces, design.reference[: p.n]) if p.steady else None
        own = {"rho": tuning.rho, "alpha": tuning.alpha} if first == "osqp" else {}
        self.solvers: list[QpSolver] = [solver(first, *data, **own)]
        if first != "piqp":
            self.solvers.append(Piqp(*data))
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
        self, x: Array, z: Array, y: Array, first: int = 0, A: Array | None = None, before: Array | None = None
    ) -> Plan | None:
        """By the first solver that finds one, from a guess; A: its new values, if it has any."""
        program = self.program
        program.begin(x, before)
        for s in self.solvers:
            s.update(A=A, q=program.q, low=program.low, high=program.high)
            found = s.solve(z, y)
            last = s is self.solvers[-1]
            if found.status == "infeasible" and last:
                return None
            # Rows decide: a plan that keeps them is one, though it may not be the best.
            if found.status == "solved" or last:
                # Where lines vary, the tube is taken along the lines of the plan.
                kept = found.z if A is not None or self.pieces is None else self.pieces.least(found.z)
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
