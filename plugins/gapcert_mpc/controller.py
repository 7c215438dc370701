"""The controller: solves one program per step, and goes on with the plan that it has where that fails."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np

from gapcert import Array, Controller, Event, Goal, UsageError
from gapcert.plugin import Bools, Ints, Policy, Pulse
from gapcert_cells import write_saved

from .plans import Held, Memory, Plan, plan
from .program.linearise import Nominal
from .program.pieces import Pieces
from .program.solver import Name, Piqp, QpSolver, solver
from .saved.design import Design as Design
from .saved.saved_models import pair
from .tracking import another
from .variants.arrival import Arrival, Pool
from .variants.successive import Successive
from .variants.terminal_boxes import Landing

if TYPE_CHECKING:
    from .variants.adaptive import AdaptiveMpcController
    from .variants.disturbance import DisturbanceMpcController

LOOK = 8


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
        self.arrival: Arrival | Landing | None = None
        if design.scene is not None:
            self.arrival = Arrival(self, design.scene, design.pool or Pool.of([], p))
        elif design.ends is not None:
            self.arrival = Landing(self, design.ends)

    def solve(self, x: Array, guess: Plan | None, before: Array | None = None) -> Plan | None:
        """A plan from x (frame) after an input, checked row by row; None where there is none. A pure function of all these."""
        first = 0 if guess is None else guess.piece
        if self.pieces is not None and (known := self.pieces(x, first)) is not None:
            return plan(self.program, *known)
        return self.found(x, *self._guess(guess), first, before=before)

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

    def _guess(self, guess: Plan | None) -> tuple[Array, Array]:
        if guess is None:
            return self.later[2], self.later[3]
        return guess.z[self.later[0]], guess.y[self.later[1]]


@final
@dataclass(frozen=True, eq=False)
class MpcController(Controller):
    """Tube MPC: contains a state if a plan begins there; a run's memory is the number of its plan.

    A plan is a certificate by itself: where a solve fails, the run goes on with what is left of its plan, and with the terminal
    set's feedback after it, and nothing of the promise is lost.
    """

    goal: Goal
    design: Design | None
    evidence: Mapping[str, Any]
    solver: Name = "osqp"
    kind: str = "mpc"
    nominal: Nominal | None = field(default=None, repr=False)
    memory: Memory[Held] = field(init=False, default_factory=Memory, repr=False)
    counts: dict[str, int] = field(default_factory=lambda: {"solved": 0, "shifted": 0}, repr=False)

    def __reduce__(self) -> tuple[Any, ...]:
        # Another process sets its own solvers up, and begins with no plan.
        return type(self), (self.goal, self.design, self.evidence, self.solver, self.kind, self.nominal)

    @cached_property
    def engine(self) -> Engine:
        assert self.design is not None, "a controller that wins nowhere solves nothing"
        return Engine(self.design, self.solver)

    @cached_property
    def successive(self) -> Successive:
        assert self.design is not None
        assert self.nominal is not None, "plans along their own lines need the model"
        # A plan with its lines takes some ten kilobytes.
        self.memory.most = min(self.memory.most, 1 << 13)
        return Successive(self.engine, self.design, self.nominal)

    @property
    def wins(self) -> bool:
        return self.design is not None

    @property
    def policies(self) -> tuple[Policy, ...]:
        return ("first",)

    @cached_property
    def _turns(self) -> Array | None:
        """2π for angles, and infinity for what never comes back; None where nothing does."""
        turns = np.array([2 * np.pi if axis.kind == "angle" else np.inf for axis in self.goal.stay.axes])
        return turns if np.isfinite(turns).any() else None

    def framed(self, x: Array) -> Array:
        """States (n, nx) in the frame; angles by the turn that is nearest to its middle."""
        assert self.design is not None
        middle, half = self.design.frame.x
        x, turns = np.atleast_2d(np.asarray(x, dtype=np.float64)) - middle, self._turns
        if turns is not None and (np.abs(x) > turns / 2).any():
            some = np.isfinite(turns)
            x[:, some] -= turns[some] * np.round(x[:, some] / turns[some])
        return np.asarray(x / half)

    def _next(self, x: Array, held: Held | None) -> Held | None:
        """A new plan from a state in the frame, guessed from the one that is held, or what is left of that."""
        assert self.design is not None
        made, before = None, held and held.u
        # NaN compares as False.
        if np.abs(x).max() <= 1.0 and (before is None or np.isfinite(before).all()):
            made = self._solved(x, held)
        then = held and held._replace(age=held.age + 1, shifted=held.shifted + 1, step=held.step + 1)
        if made is not None:
            then = held._replace(plan=made, age=0, step=held.step + 1) if held else Held(made)
        if then is None or self.design.rates is None:
            return then
        return then._replace(u=then.plan.input(x, then.age, self.design.section.K), before=before)

    def _solved(self, x: Array, held: Held | None) -> Plan | None:
        assert self.design is not None
        if self.engine.arrival is not None:
            return self.engine.arrival.follow(x, held.plan, held.age) if held else self.engine.arrival.begin(x)
        if self.design.successive:
            return self.successive.solve(x, held)
        self._aim(held)
        return self.engine.solve(x, held and held.plan, held and held.u)

    def _aim(self, held: Held | None) -> None:
        """Before a plan is made: what is wanted at each of its stages, whatever was solved in between."""
        assert self.design is not None
        n, N, z = self.design.frame.nx, self.design.stages.horizon, self.design.reference[None]
        if held is not None and held.aim is not None:
            z = held.aim[None]
        elif self.design.course is not None:
            z = self.design.course.ahead(0 if held is None else held.step + 1, N + 1)
        self.engine.program.aim(z[:, :n], z[:N, n:])

    def aim(self, reference: Mapping[str, float | str], memory: Ints) -> Ints:
        """Memory of the same runs, whose plans are drawn to other states from the next step on; only the cost is another.

        UsageError for what is no state, and where the end of a plan is not free: only plans for invariance, along one straight
        line, that end around a steady state take another reference.
        """
        if self.design is None or self.design.successive or self.design.scene or self.design.ends:
            raise UsageError("aim: only invariance, along one straight line, takes another reference; make another controller")
        held = [self.memory[number] for number in memory.tolist()]
        z = another(self.engine.program, self.design.frame, reference, self.goal.stay.axes)
        return np.array([0 if h is None else self.memory.add(h._replace(aim=z)) for h in held], dtype=np.int64)

    def _input(self, x: Array, plan: Plan, age: int) -> Array:
        assert self.design is not None
        middle, half = self.design.frame.u
        return np.asarray(middle + half * plan.input(x, age, self.design.section.K))

    def contains(self, x: Array) -> Bools:
        return np.asarray(self.start(x) > 0)

    def start(self, x: Array) -> Ints:
        """The number of a plan that begins there; 0 where there is none."""
        out = np.zeros(len(x), dtype=np.int64)
        if self.design is None:
            return out
        for i, row in enumerate(self.framed(x)):
            out[i] = self.memory.begin(row, lambda x: self._next(x, None))
        return out

    def advance(self, x: Array, memory: Ints) -> Ints:
        out = np.zeros(len(x), dtype=np.int64)
        for i, (row, number) in enumerate(zip(self.framed(x), memory.tolist(), strict=True)):
            if (held := self.memory[number]) is not None and (then := self._next(row, held)) is not None:
                out[i] = self.memory.add(then)
                self.counts["shifted" if then.age else "solved"] += 1
        return out

    def keeps(self, x: Array, memory: Ints) -> Bools:
        out = np.zeros(len(x), dtype=bool)
        if self.design is None:
            return out
        for i, (row, number) in enumerate(zip(self.framed(x), memory.tolist(), strict=True)):
            held = self.memory[number]
            out[i] = held is not None and self._within(row, held.plan, held.age)
        return out

    def _within(self, x: Array, plan: Plan, age: int) -> bool:
        assert self.design is not None
        if plan.arrival is not None and age > plan.arrival:
            return False
        centre, _, size = plan.stage(age)
        return bool((np.abs(self.design.section.H @ (x - centre)) <= size + 1e-9).all())

    def _slow(self, u: Array, held: Held) -> bool:
        assert self.design is not None
        if self.design.rates is None or held.before is None:
            return True
        middle, half = self.design.frame.u
        return bool((np.abs((u - middle) / half - held.before) <= self.design.rates + 1e-9).all())

    def respond(self, x: Array, memory: Ints, policy: Policy, seed: int = 0, k: int = 0) -> Array:
        out = np.empty((len(x), 0 if self.design is None else len(self.design.frame.half) - self.design.frame.nx))
        for i, number in enumerate(memory.tolist()):
            if (held := self.memory[number]) is None:
                raise UsageError(
                    f"controller: row {i}: no plan begins at {np.asarray(x)[i].tolist()}; ask `contains` before `act`"
                )
            if held.age == held.plan.arrival:
                raise UsageError(f"controller: row {i}: the goal is reached; ask `goal.reached` before `act`")
            out[i] = self._input(self.framed(x[i])[0], held.plan, held.age)
        return out

    def act(self, x: Array, policy: Policy = "first", seed: int = 0, k: int = 0) -> Array:
        return self.respond(x, self.start(np.atleast_2d(x)), policy, seed, k)

    def kept(self, x: Array, u: Array, after: Array, memory: Ints | None = None) -> Bools:
        """(n,): did the step end in the tube of the plan that was being kept, after an input that was not far from the last?"""
        numbers = self.start(x) if memory is None else memory
        out = np.zeros(len(after), dtype=bool)
        for i, (row, number) in enumerate(zip(self.framed(after), numbers.tolist(), strict=True)):
            held = self.memory[number]
            out[i] = held is not None and self._within(row, held.plan, held.age + 1) and self._slow(u[i], held)
        return np.asarray(out | self.over(after, numbers))

    def restart(self) -> None:
        """The next `step` begins another run."""
        self.counts["online"] = 0

    def fallbacks(self, memory: Ints) -> Ints:
        """(n,): steps of each run that went on with a plan of before, with the one that is about to be made."""
        held = [self.memory[n] for n in memory.tolist()]
        return np.array([0 if h is None else h.shifted for h in held], dtype=np.int64)

    @property
    def resolution(self) -> int:
        """A program is solved for each point, or several."""
        return 12 if self.nominal is not None else 40 if self.design is None or self.design.scene is None else 24

    def predicted(self, x: Array, memory: Ints | None = None) -> tuple[Array, Array, Array] | None:
        """x̄ and its tube for the steps to come, as far as the horizon or arrival goes; row 0 is x itself."""
        numbers = self.start(x[None]) if memory is None else memory
        held = self.memory[int(numbers[0])]
        if held is None or self.design is None:
            return None
        plan, age = held[:2]
        E = self.design.section.support[: len(x)]
        last = len(plan.x) if plan.arrival is None else plan.arrival + 1
        centre, wide = plan.x[age:last], plan.s[age:last] @ E.T
        if not len(centre):
            centre, wide = plan.xs[None], plan.sigma[None] @ E.T
        return self.foreseen(x, centre, wide)

    def wanted(self, count: int) -> Array | None:
        if self.design is None or self.design.course is None:
            return None
        return self.design.frame.out(self.design.course.ahead(0, count))[:, : self.design.frame.nx]

    def foreseen(self, x: Array, centre: Array, wide: Array) -> tuple[Array, Array, Array]:
        """Boxes of states that are foreseen from x (nx,), given in the frame: centre, low, high; row 0 is x itself."""
        assert self.design is not None
        middle, half = self.design.frame.x
        # Of the angles the turn that x is at.
        turn = x - middle - half * self.framed(x[None])[0]
        low, high, at = (middle + turn + half * z for z in (centre - wide, centre + wide, centre))
        at[0] = low[0] = high[0] = x
        return at, low, high

    def arrays(self) -> dict[str, Array]:
        return {} if self.design is None else self.design.arrays()

    def digest(self) -> str:
        """SHA-256 of everything that determines the inputs."""
        out = hashlib.sha256(json.dumps([self.kind, self.solver, self.goal.to_data()]).encode())
        if self.nominal is not None:
            out.update(self.nominal.digest().encode())
        for name, array in self.arrays().items():
            out.update(f"{name}{array.dtype.str}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        return out.hexdigest()

    def save(self, folder: Path | str) -> None:
        """Write `controller.npz` and `controller.json`; with the model and the gap, where steps ask these and they are data."""
        data, arrays = self.saved(), self.arrays()
        if self.nominal is not None:
            data["kept"] = pair(arrays, model=self.nominal.model, gap=self.nominal.gap)
        write_saved(Path(folder), data, arrays)

    def saved(self) -> dict[str, Any]:
        """What `controller.json` says."""
        data = {"format": 1, "kind": self.kind, "goal": self.goal.to_data(), "evidence": dict(self.evidence)}
        return data | {"solver": self.solver, "digest": self.digest()}

    @classmethod
    def load(
        cls, folder: Path | str, nominal: Nominal | None = None
    ) -> MpcController | DisturbanceMpcController | AdaptiveMpcController:
        """Inverse of `save`; UsageError where the files are absent, damaged or do not belong together.

        A controller that makes the model straight about its plans asks the model and the gap again: its `nominal`, which is
        saved with it but for models that are not equations.
        """
        from .saved.loaded import loaded

        return loaded(cls, Path(folder), nominal)


def looked(controller: Controller, x: Array, emit: Callable[[Event], None]) -> Bools:
    """Which states (n, nx) it starts from, asked few by few, so that one sees how far it is."""
    out, pulse = np.zeros(len(x), dtype=bool), Pulse(emit, "controller", len(x), "starts", "domain")
    for a in range(0, len(x), LOOK):
        out[a : a + LOOK] = controller.contains(x[a : a + LOOK])
        seen = min(a + LOOK, len(x))
        pulse(seen, {"starts won": f"{out[:seen].mean():.0%}"})
    return out
