"""The controller: solves one program per step, and goes on with the plan that it has where that fails."""

from __future__ import annotations

import hashlib
import json
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, final

import numpy as np

from gapcert.plugin import Array, Bools, Controller, Event, Goal, Ints, Outside, Policy, Pulse, UsageError, circle
from gapcert_cells import inside_alone, loaded, refusal, write_saved

from .planning.arrival import Arrival
from .planning.design import Design
from .planning.engine import Engine, Landing, Planner, Tracker
from .planning.plans import Held, Memory, Plan
from .planning.requirements import wanted
from .planning.successive import Successive
from .program.linearise import Nominal
from .program.solver import Name
from .saved_models import known, pair

LOOK = 8


class Remembered(Protocol):
    """What a run remembers: the steps since its plan was made, and how many of all its steps went on with a plan."""

    @property
    def age(self) -> int: ...

    @property
    def shifted(self) -> int: ...


R = TypeVar("R", bound=Remembered)


class PlanController(Controller, Generic[R]):
    """Contains a state if a plan begins there; a run's memory is the number of what it remembers.

    A plan is a certificate by itself: where a solve fails, the run goes on with what is left of its plan, and with the terminal
    set's feedback after it, and nothing of the promise is lost.
    """

    design: Design | None
    memory: Memory[R]
    counts: dict[str, int]

    @abstractmethod
    def _next(self, x: Array, held: R | None) -> R | None:
        """At x (frame): with a new plan, or with what is left of the one that is held; None where there is neither."""

    @abstractmethod
    def _input(self, x: Array, held: R) -> Array:
        """(m,) at x, both in the frame."""

    @abstractmethod
    def _held(self, x: Array, held: R) -> bool:
        """Is x (frame) where a run that remembers this may be?"""

    @abstractmethod
    def _stepped(self, u: Array, after: Array, held: R) -> bool:
        """Did a step under u, in the model's units, come to where it may end, `after` (frame)?"""

    @abstractmethod
    def _foreseen(self, held: R) -> tuple[Array, Array]:
        """Centres and half-widths of the states from now on, in the frame."""

    @property
    def _design(self) -> Design:
        assert self.design is not None, "a controller that wins nowhere plans nothing"
        return self.design

    @property
    def policies(self) -> tuple[Policy, ...]:
        return ("first",)

    @cached_property
    def _angles(self) -> Bools:
        return np.array([axis.kind == "angle" for axis in self.goal.stay.axes])

    def framed(self, x: Array) -> Array:
        """States (n, nx) in the frame; angles by the turn that is nearest to its middle."""
        middle, half = self._design.frame.x
        x = np.atleast_2d(np.asarray(x, dtype=np.float64)) - middle
        return np.asarray((circle.near(x, 0.0, self._angles) if self._angles.any() else x) / half)

    def contains(self, x: Array) -> Bools:
        return np.asarray(self.start(x) > 0)

    def start(self, x: Array) -> Ints:
        """The number of what a run that begins there remembers; 0 where there is no plan."""
        if self.design is None:
            return np.zeros(len(x), dtype=np.int64)
        return np.array([self.memory.begin(row, lambda x: self._next(x, None)) for row in self.framed(x)], dtype=np.int64)

    def advance(self, x: Array, memory: Ints) -> Ints:
        out = np.zeros(len(x), dtype=np.int64)
        for i, (row, held) in enumerate(zip(self.framed(x), self.memory.of(memory), strict=True)):
            if held is not None and (then := self._next(row, held)) is not None:
                out[i] = self.memory.add(then)
                self.counts["shifted" if then.age else "solved"] += 1
        return out

    def keeps(self, x: Array, memory: Ints) -> Bools:
        if self.design is None:
            return np.zeros(len(x), dtype=bool)
        at = zip(self.framed(x), self.memory.of(memory), strict=True)
        return np.array([held is not None and self._held(row, held) for row, held in at], np.bool_)

    def respond(self, x: Array, memory: Ints, policy: Policy, seed: int = 0, k: int = 0) -> Array:
        middle, half = self.design.frame.u if self.design is not None else np.empty((2, 0))
        out = np.empty((len(x), len(half)))
        for i, held in enumerate(self.memory.of(memory)):
            if held is None:
                raise refusal(self, x, i, "no plan begins there")
            out[i] = middle + half * self._input(self.framed(x[i])[0], held)
        return out

    def act(self, x: Array, policy: Policy = "first", seed: int = 0, k: int = 0, *, outside: Outside = "raise") -> Array:
        if outside == "nan":
            return inside_alone(self, 0 if self.design is None else len(self.design.frame.u[0]), x, policy, seed, k)
        return self.respond(x, self.start(np.atleast_2d(x)), policy, seed, k)

    def kept(self, x: Array, u: Array, after: Array, memory: Ints | None = None) -> Bools:
        """(n,): did the step end in the tube of the plan that was being kept, after an input that was not far from the last?"""
        numbers = self.start(x) if memory is None else memory
        steps = zip(u, self.framed(after), self.memory.of(numbers), strict=True)
        out = np.array([h is not None and self._stepped(v, row, h) for v, row, h in steps], np.bool_)
        return np.asarray(out | self.over(after, numbers))

    def fallbacks(self, memory: Ints) -> Ints:
        """(n,): steps of each run that went on with a plan of before, with the one that is about to be made."""
        return np.array([0 if held is None else held.shifted for held in self.memory.of(memory)], dtype=np.int64)

    def predicted(self, x: Array, memory: Ints | None = None) -> tuple[Array, Array, Array] | None:
        """Centres and boxes of the steps to come, as far as they are planned, angles by the turn that x is at."""
        numbers = self.start(x[None]) if memory is None else memory
        if (held := self.memory[int(numbers[0])]) is None:
            return None
        centre, wide = self._foreseen(held)
        middle, half = self._design.frame.x
        turn = x - middle - half * self.framed(x[None])[0]
        low, high, at = (middle + turn + half * z for z in (centre - wide, centre + wide, centre))
        at[0] = low[0] = high[0] = x
        return at, low, high


@final
@dataclass(frozen=True, eq=False)
class MpcController(PlanController[Held]):
    """Tube MPC: a plan with a tube about it, kept by one gain."""

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
        return Engine(self._design, self.solver)

    @cached_property
    def planner(self) -> Planner:
        engine, design = self.engine, self._design
        if design.scene is not None:
            return Arrival(engine, design.scene, design.pool)
        if design.ends is not None:
            return Landing(engine, design.ends)
        if not design.successive:
            return Tracker(engine, design)
        assert self.nominal is not None, "plans along their own lines need the model"
        # A plan with its lines takes some ten kilobytes.
        self.memory.most = min(self.memory.most, 1 << 13)
        return Successive(engine, design, self.nominal)

    @property
    def wins(self) -> bool:
        return self.design is not None

    def _next(self, x: Array, held: Held | None) -> Held | None:
        made, before = None, held and held.u
        # NaN compares as False.
        if np.abs(x).max() <= 1.0 and (before is None or np.isfinite(before).all()):
            made = self.planner.solve(x, held)
        then = held and held._replace(age=held.age + 1, shifted=held.shifted + 1, step=held.step + 1)
        if made is not None:
            then = held._replace(plan=made, age=0, step=held.step + 1) if held else Held(made)
        if then is None or self._design.rates is None:
            return then
        return then._replace(u=then.plan.input(x, then.age, self._design.section.K), before=before)

    def aim(self, reference: Mapping[str, float | str], memory: Ints) -> Ints:
        """Memory of the same runs, whose plans are drawn to other states from the next step on; only the cost is another.

        UsageError for what is no state, and where the end of a plan is not free: only plans for invariance, along one straight
        line, that end around a steady state take another reference.
        """
        if self.design is None or self.design.successive or self.design.scene or self.design.ends:
            raise UsageError("aim: only invariance, along one straight line, takes another reference; make another controller")
        axes = self.goal.stay.axes
        if unknown := [name for name in reference if name not in self.goal.stay.names]:
            raise UsageError(f"aim: '{unknown[0]}' is no state; expected some of {', '.join(self.goal.stay.names)}")
        try:
            z = self.engine.program.target(*wanted(reference, axes, self.design.frame))
        except ValueError as error:
            raise UsageError(f"aim: {error}") from None
        assert z is not None, "a controller that wins has a steady pair"
        held = self.memory.of(memory)
        return np.array([0 if h is None else self.memory.add(h._replace(aim=z)) for h in held], dtype=np.int64)

    def respond(self, x: Array, memory: Ints, policy: Policy, seed: int = 0, k: int = 0) -> Array:
        for i, held in enumerate(self.memory.of(memory)):
            if held is not None and held.age == held.plan.arrival:
                raise UsageError(f"controller: row {i}: the goal is reached; ask `goal.reached` before `act`")
        return super().respond(x, memory, policy, seed, k)

    def _input(self, x: Array, held: Held) -> Array:
        return held.plan.input(x, held.age, self._design.section.K)

    def _held(self, x: Array, held: Held) -> bool:
        return self._within(x, held.plan, held.age)

    def _stepped(self, u: Array, after: Array, held: Held) -> bool:
        (middle, half), rates = self._design.frame.u, self._design.rates
        slow = rates is None or held.before is None or (np.abs((u - middle) / half - held.before) <= rates + 1e-9).all()
        return bool(slow) and self._within(after, held.plan, held.age + 1)

    def _within(self, x: Array, plan: Plan, age: int) -> bool:
        if plan.arrival is not None and age > plan.arrival:
            return False
        centre, _, size = plan.stage(age)
        return bool((np.abs(self._design.section.H @ (x - centre)) <= size + 1e-9).all())

    def _foreseen(self, held: Held) -> tuple[Array, Array]:
        """As far as the horizon or arrival goes."""
        plan, age, support = held.plan, held.age, self._design.section.support[: self._design.frame.nx]
        last = len(plan.x) if plan.arrival is None else plan.arrival + 1
        if age >= last:
            return plan.xs[None], plan.sigma[None] @ support.T
        return plan.x[age:last], plan.s[age:last] @ support.T

    @property
    def resolution(self) -> int:
        """A program is solved for each point, or several."""
        return 12 if self.nominal is not None else 40 if self.design is None or self.design.scene is None else 24

    def wanted(self, count: int) -> Array | None:
        if self.design is None or self.design.course is None:
            return None
        return self.design.frame.out(self.design.course.ahead(0, count))[:, : self.design.frame.nx]

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
    def load(cls, folder: Path | str, nominal: Nominal | None = None) -> MpcController:
        """Inverse of `save`; UsageError where the files are absent, damaged or do not belong together.

        A controller that makes the model straight about its plans asks the model and the gap again: its `nominal`, which is
        saved with it but for models that are not equations. One that is part of another is loaded with that.
        """
        return loaded(folder, lambda data, arrays: cls.read(Path(folder), data, arrays, nominal))

    @classmethod
    def read(cls, folder: Path, data: Mapping[str, Any], arrays: Mapping[str, Array], nominal: Nominal | None) -> MpcController:
        """Of what stands in the files of a folder."""
        design = Design.of(arrays) if arrays else None
        if design is not None and design.ends is not None:
            raise UsageError(f"{folder}: where its plans end another controller takes over; load it with load_controller")
        if design is None or not design.successive:
            nominal = None
        elif nominal is None and not data.get("kept"):
            raise UsageError(
                f"{folder}: this controller linearises its model at every step, and its model or gap could not be saved as "
                f"data; give both as MpcController.load(folder, Nominal(model, gap))"
            )
        elif nominal is None:
            told = known(data["kept"], arrays)
            nominal = Nominal(told["model"], told["gap"])
        return cls(Goal.from_data(data["goal"]), design, data["evidence"], data["solver"], nominal=nominal)


def looked(controller: Controller, x: Array, emit: Callable[[Event], None]) -> Bools:
    """Which states (n, nx) it starts from, asked few by few, so that one sees how far it is."""
    out, pulse = np.zeros(len(x), dtype=bool), Pulse(emit, "controller", len(x), "starts", "domain")
    for a in range(0, len(x), LOOK):
        out[a : a + LOOK] = controller.contains(x[a : a + LOOK])
        seen = min(a + LOOK, len(x))
        pulse(seen, {"starts won": f"{out[:seen].mean():.0%}"})
    return out
