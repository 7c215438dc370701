"""Plans that end in the winning set of a controller on cells, which takes over where no plan goes on."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, final

import numpy as np

from gapcert import Array, Context, Controller, Domain, Goal, Model, SynthesisProblem, UsageError, load_controller, registry
from gapcert.plugin import Bools, Ints, Outside, Policy, Synthesizer, of_config
from gapcert_cells import GridController, inside_alone, loaded, write_saved
from gapcert_mpc.config import Terminal
from gapcert_mpc.controller import MpcController
from gapcert_mpc.planning.design import Design, Ends
from gapcert_mpc.planning.plans import Held, Plan
from gapcert_mpc.planning.successive import steady
from gapcert_mpc.program.linearise import Frame, Stages
from gapcert_mpc.program.program import Weights
from gapcert_mpc.program.tube import passing
from gapcert_mpc.task import Task
from gapcert_mpc.thresholds import THRESHOLDS


def _refused(path: str) -> Model:
    raise UsageError("controller.terminal: a growth bound is not taken over from another spec here; leave growth out")


@final
class Ending:
    """What `terminal` asks for: a synthesizer by its kind with its options, and the most boxes of its winning set."""

    def __init__(self, asked: Terminal) -> None:
        known, kind, left = registry(), asked.kind, asked.model_dump()
        self.boxes = left.pop("boxes")
        # A missing plugin is told before its options are.
        component = known.get("synthesizer", kind)
        component.load()
        section = known.config("synthesizer", kind)
        if section is None or kind == "mpc":
            raise UsageError(f"controller.terminal: {kind} makes no controller on cells; use symbolic")
        try:
            config = section.model_validate(left)
        except ValueError as error:
            told = "; ".join(
                f"{'.'.join(map(str, e['loc']))}: {e['msg']}" if e["loc"] else str(e["msg"])
                for e in error.errors()  # type: ignore[attr-defined]
            )
            raise UsageError(f"controller.terminal: {told}") from None
        self.maker: Synthesizer = known.build("synthesizer", kind, config, Context(loader=_refused))
        self.policy: Policy = of_config(config, "headline") or "first"

    def check(self, model: Model, domain: Domain, goal: Goal) -> None:
        self.maker.check(model, domain, goal)

    def controller(self, problem: SynthesisProblem) -> GridController:
        """For the same problem."""
        made = self.maker.synthesize(problem)
        if not isinstance(made, GridController):
            raise UsageError(f"controller.terminal: {made.kind} makes no controller on cells; use symbolic")
        return made


@final
class Box(NamedTuple):
    """Cells first ≤ i < after, per axis."""

    first: Ints
    after: Ints

    @property
    def slices(self) -> tuple[slice, ...]:
        return tuple(slice(a, b) for a, b in zip(self.first.tolist(), self.after.tolist(), strict=True))


@final
class Sums:
    """How many of the cells in a box are winning, by 2ⁿ sums of all cells before a corner."""

    def __init__(self, winning: Bools) -> None:
        self.sums = np.pad(winning.astype(np.int64), [(1, 0)] * winning.ndim)
        for j in range(winning.ndim):
            np.cumsum(self.sums, axis=j, out=self.sums)
        self.corners = [((-1) ** (winning.ndim - sum(c)), c) for c in product((0, 1), repeat=winning.ndim)]

    def whole(self, box: Box) -> bool:
        """Are all of its cells winning?"""
        ends = tuple(zip(box.first.tolist(), box.after.tolist(), strict=True))
        count = sum(sign * int(self.sums[tuple(e[c] for e, c in zip(ends, at, strict=True))]) for sign, at in self.corners)
        return bool(count == np.prod(box.after - box.first))


def inscribed(winning: Bools, room: Ints, most: int) -> list[Box]:
    """At most `most` boxes of winning cells, none part of a larger one, each with more than `room` cells per axis.

    Each grows from a winning cell by layers, as thick ones as fit first, along all axes or along one of them first. Of these
    the boxes are taken one by one that hold most cells no other holds, once half of `room` is left at each edge.
    """
    sums, rng = Sums(winning), np.random.default_rng(0)
    cells = np.argwhere(winning)
    if not len(cells):
        return []
    seeds = cells[np.unique(rng.integers(len(cells), size=THRESHOLDS.inscribed_seeds))]
    orders = [None, *range(winning.ndim)] if winning.ndim > 1 else [None]
    grown = {tuple(np.concatenate(_grown(sums, winning.shape, seed, j)).tolist()) for seed in seeds for j in orders}
    n = winning.ndim
    found = [Box(np.array(b[:n]), np.array(b[n:])) for b in sorted(grown)]
    left = [b for b in found if (b.after - b.first > room).all()]
    covered, out = np.zeros(winning.shape, dtype=bool), list[Box]()
    while left and len(out) < most:
        inner = [Box(b.first + room // 2, b.after - room // 2).slices for b in left]
        gained = [int((~covered[at]).sum()) for at in inner]
        best = int(np.argmax(gained))
        if gained[best] == 0:
            break
        covered[inner[best]] = True
        out.append(left.pop(best))
    return out


def _grown(sums: Sums, counts: tuple[int, ...], seed: Ints, lead: int | None) -> Box:
    """From one cell: along axis `lead` as far as it goes, if one leads, then along all of them in turn."""
    box = Box(seed.copy(), seed + 1)
    for axes in ([lead], range(len(counts))) if lead is not None else (range(len(counts)),):
        step = max(counts) // 4 + 1
        while step:
            moved = False
            for j, up in product(axes, (False, True)):
                first, after = box.first.copy(), box.after.copy()
                if up:
                    after[j] = min(after[j] + step, counts[j])
                else:
                    first[j] = max(first[j] - step, 0)
                then = Box(first, after)
                if (after - first).sum() > (box.after - box.first).sum() and sums.whole(then):
                    box, moved = then, True
            step = step if moved else step // 2
    return box


def states(then: GridController, first: Ints, after: Ints) -> Array:
    """[low, high] (2, n) of the states in cells first ≤ i < after; those without cells are where they are held."""
    box = np.empty((2, len(then.goal.stay.axes)))
    for j, edges, a, b in zip(then.on, then.edges, first, after, strict=True):
        box[:, j] = edges[a], edges[b]
    if then.held is not None:
        others = [j for j in range(box.shape[1]) if j not in then.on]
        box[:, others] = then.held.low, then.held.high
    return box


def lost(then: GridController, box: Array) -> int:
    """How many losing cells a closed box [low, high] (2, n) of states touches; one outside the grid counts as losing."""
    low, high = box[:, then.on]
    cut = []
    for edges, a, b in zip(then.edges, low, high, strict=True):
        if a < edges[0] or b > edges[-1]:
            return 1
        first, last = np.minimum(np.searchsorted(edges, [a, b], "right") - 1, len(edges) - 2)
        cut.append(slice(int(first), int(last) + 1))
    if then.held is not None:
        others = [j for j in range(box.shape[1]) if j not in then.on]
        if (box[0, others] < then.held.low).any() or (box[1, others] > then.held.high).any():
            return 1
    return int((~then.winning[tuple(cut)]).sum())


def ends(then: GridController, frame: Frame, room: Array, wanted: Array, most: int) -> Array:
    """Boxes (k, 2, n) of winning cells in the frame, wider than `room` (n,) there, nearest to `wanted` (n,) first."""
    middle, half = frame.x
    pitch = then.widths / half[list(then.on)]
    found = inscribed(then.winning, np.ceil(room[list(then.on)] / pitch).astype(np.int64), most)
    boxes = [
        (states(then, b.first, b.after) - middle) / half + np.array([[THRESHOLDS.cell_edge], [-THRESHOLDS.cell_edge]])
        for b in found
    ]
    away = [(float(np.abs(np.clip(wanted, *b) - wanted).max()), -float(np.prod(b[1] - b[0]))) for b in boxes]
    kept = [boxes[k] for k in sorted(range(len(boxes)), key=lambda k: away[k]) if (boxes[k][1] - boxes[k][0] > room).all()]
    return np.array(kept).reshape(-1, 2, len(wanted))


@final
@dataclass(frozen=True, eq=False)
class HandedController(Controller):
    """Tube MPC whose plans end in winning cells of another controller, `then`, which takes over N steps after the last plan.

    It contains a state where a plan of at most N steps begins, or that `then` contains. A plan, with `then` after it, is a
    certificate by itself. At each step a new plan is looked for, also where `then` has taken over. A run's memory is the number
    of its plan in `plans`; that of a run in the hands of `then` has no steps left.
    """

    plans: MpcController
    then: GridController
    evidence: Mapping[str, Any]
    policy: Policy = "first"
    kind: str = "mpc"

    def __post_init__(self) -> None:
        middle, half = self.design.frame.x
        for box in self.design.ends.boxes if self.design.ends is not None else ():
            if number := lost(self.then, middle + half * box):
                raise UsageError(f"controller: a box in which plans end touches {number} losing cells; synthesize it again")

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.plans, self.then, self.evidence, self.policy, self.kind)

    @property
    def goal(self) -> Goal:  # type: ignore[override]
        return self.plans.goal

    @property
    def design(self) -> Design:
        assert self.plans.design is not None, "plans that end somewhere are planned"
        return self.plans.design

    @property
    def policies(self) -> tuple[Policy, ...]:
        return ("first",)

    @property
    def resolution(self) -> int:
        return self.plans.resolution

    @property
    def counts(self) -> dict[str, int]:
        """Steps that were solved, and steps that went on with what there was."""
        return self.plans.counts

    @cached_property
    def _none(self) -> Plan:
        """A plan of no steps: `then` has taken over."""
        nx, nu, p = self.design.frame.nx, len(self.design.frame.u[0]), len(self.design.section.H)
        x, s = np.zeros((1, nx)), np.zeros((1, p))
        return Plan(*self.plans.engine.later[2:], x, np.zeros((0, nu)), s, x[0], np.zeros(nu), s[0], arrival=0)

    def _left(self, memory: Ints) -> Ints:
        """(n,): steps of its plan that a run has yet to make; at 0 it is in the hands of `then`. −1: there is no plan."""
        held = self.plans.memory.of(memory)
        return np.array([-1 if h is None else max((h.plan.arrival or 0) - h.age, 0) for h in held], dtype=np.int64)

    def start(self, x: Array) -> Ints:
        x = np.atleast_2d(np.asarray(x, dtype=np.float64))
        numbers, won = self.plans.start(x), self.then.contains(x)
        for i in np.flatnonzero((numbers == 0) & won).tolist():
            numbers[i] = self.plans.memory.add(Held(self._none))
        return numbers

    def contains(self, x: Array) -> Bools:
        x = np.atleast_2d(np.asarray(x, dtype=np.float64))
        out = self.then.contains(x)
        out[~out] = self.plans.contains(x[~out])
        return out

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """As of every controller, of few at a time: programs are solved for some."""
        return super().draw(min(n, 64), rng)

    def advance(self, x: Array, memory: Ints) -> Ints:
        return self.plans.advance(np.atleast_2d(x), memory)

    def keeps(self, x: Array, memory: Ints) -> Bools:
        x = np.atleast_2d(np.asarray(x, dtype=np.float64))
        return np.where(self._left(memory) == 0, self.then.contains(x), self.plans.keeps(x, memory))

    def respond(self, x: Array, memory: Ints, policy: Policy, seed: int = 0, k: int = 0) -> Array:
        x, handed = np.atleast_2d(np.asarray(x, dtype=np.float64)), self._left(memory) == 0
        out = np.empty((len(x), len(self.design.frame.u[0])))
        out[~handed] = self.plans.respond(x[~handed], memory[~handed], policy, seed, k)
        if handed.any():
            own = self.then.start(x[handed])
            out[handed] = self.then.respond(x[handed], own, self.policy, seed, k)
        return out

    def act(self, x: Array, policy: Policy = "first", seed: int = 0, k: int = 0, *, outside: Outside = "raise") -> Array:
        if outside == "nan":
            return inside_alone(self, len(self.design.frame.u[0]), x, policy, seed, k)
        return self.respond(x, self.start(x), policy, seed, k)

    def kept(self, x: Array, u: Array, after: Array, memory: Ints | None = None) -> Bools:
        """(n,): did the step end in the tube of the plan, or where `then` promises? A plan's last one ends in its domain."""
        numbers = self.start(x) if memory is None else memory
        out, left = self.plans.kept(x, u, after, numbers), self._left(numbers)
        handed = left == 0
        out[handed] = self.then.kept(x[handed], u[handed], after[handed])
        return np.asarray(out & ((left > 1) | self.then.contains(after)))

    def fallbacks(self, memory: Ints) -> Ints:
        """(n,): steps of each run that went on with a plan of before, or with `then`."""
        return self.plans.fallbacks(memory)

    def predicted(self, x: Array, memory: Ints | None = None) -> tuple[Array, Array, Array] | None:
        """As far as the plan goes; None where `then` has taken over."""
        numbers = self.start(x[None]) if memory is None else memory
        left, found = int(self._left(numbers)[0]), self.plans.predicted(x, numbers)
        return None if left == 0 or found is None else (found[0][: left + 1], found[1][: left + 1], found[2][: left + 1])

    def tube(self, x: Array, u: Array, memory: Ints | None = None) -> Array | None:
        """Where `then` has taken over, its own."""
        numbers = self.start(x[None]) if memory is None else memory
        return self.then.tube(x, u) if self._left(numbers)[0] == 0 else super().tube(x, u, numbers)

    def digest(self) -> str:
        """SHA-256 of everything that determines the inputs."""
        return hashlib.sha256(f"{self.plans.digest()} {self.then.digest()} {self.policy}".encode()).hexdigest()

    def save(self, folder: Path | str) -> None:
        """As a controller of plans, and `then` in the folder `terminal` there."""
        folder = Path(folder)
        told = {"terminal": self.policy, "digest": self.digest()}
        self.then.save(folder / "terminal")
        write_saved(folder, replace(self.plans, evidence=self.evidence).saved() | told, self.design.arrays())

    @classmethod
    def load(cls, folder: Path | str) -> HandedController:
        """Inverse of `save`."""

        def made(data: Mapping[str, Any], arrays: Mapping[str, Array]) -> HandedController:
            then = load_controller(Path(folder) / "terminal")
            plans = MpcController(Goal.from_data(data["goal"]), Design.of(arrays), {}, data["solver"])
            if not isinstance(then, GridController):
                raise UsageError(f"{folder}: what takes over is no controller on cells; synthesize it again")
            return cls(plans, then, data["evidence"], data["terminal"])

        return loaded(folder, made, "the files of the controller")


def handed(task: Task) -> Controller:
    """Plans with the controller that takes over from them."""
    assert task.options.terminal is not None, "who asks says where plans end"
    terminal = Ending(task.options.terminal)
    problem, options, frame, names = task.problem, task.options, task.frame, task.names
    nx, horizon, tolerance = frame.nx, options.horizon, options.tolerance
    then = terminal.controller(problem)
    if not then.wins:
        return task.nothing(f"the winning set in which plans would end is empty: {then.evidence['reason']}")
    stages, F = task.nominal.featured(task.zone, horizon, frame, options.majorant != "affine")
    if (reason := task.unbounded(stages) or task.unstable(stages)) is not None:
        return task.nothing(reason)
    weights, reference = task.weights(stages), steady(task.nominal, frame, *task.wanted())[0]
    made, half = _planning(task, stages, F, weights, reference)
    if options.majorant == "auto" and not (half < THRESHOLDS.small_tube).all():
        made, half = _planning(task, *task.nominal.featured(task.zone, horizon, frame, False), weights, reference)
    assert made.ends is not None
    boxes = ends(then, frame, 2 * (half[:nx] + tolerance), reference[:nx], terminal.boxes)
    if not len(boxes):
        needed = ", ".join(f"± {h * f:.4g} of {n}" for n, h, f in zip(names, half[:nx], frame.half, strict=False))
        reason = f"after {horizon} steps the tube needs {needed}, and no box of winning cells has it; plan fewer steps"
        return task.nothing(reason)
    design = replace(made, ends=replace(made.ends, boxes=boxes))
    plans = MpcController(problem.goal, design, {}, "piqp" if options.solver == "auto" else options.solver)
    x = task.drawn(np.random.default_rng(problem.seed), task.starts)
    found = HandedController(plans, then, {}, terminal.policy)
    evidence = {
        "horizon": horizon,
        "tube": task.named(half * frame.half),
        "reference": task.named(frame.out(reference)),
        "terminal": {"boxes": len(boxes), "share": float(then.contains(x).mean())},
        "domain_fraction": float(found.contains(x).mean()),
    }
    if "assumptions" in then.evidence:
        evidence["assumptions"] = then.evidence["assumptions"]
    return replace(found, evidence=problem.basis | evidence)


def _planning(task: Task, stages: Stages, F: Array, weights: Weights, reference: Array) -> tuple[Design, Array]:
    """A design that lacks its boxes yet, and the half-widths (n + m,) of its last section, at the middle of the frame.

    No tube is narrower where γ does not grow, and few are where it does.
    """
    frame, section = task.frame, passing(stages, F, task.whole)
    lacking = Ends(np.zeros((0, 2, frame.nx)), F)
    made = Design(frame, stages, section, task.rows, weights, reference, task.options.tolerance, ends=lacking)
    return made, np.asarray(section.support @ made.program().tube()[-1])
