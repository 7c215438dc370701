"""Adaptive tube MPC: what is not known of the parameters shrinks with every step, and the tubes with it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, final

import numpy as np

from gapcert.plugin import Array, Bools, Controller, Goal, Interval, Ints, Outside, Policy, SynthesisProblem
from gapcert_cells import inside_alone, loaded, write_saved
from gapcert_mpc.controller import MpcController
from gapcert_mpc.planning.plans import Memory
from gapcert_mpc.program.linearise import Nominal
from gapcert_mpc.saved_models import known, pair
from gapcert_mpc.task import Task
from gapcert_mpc.thresholds import THRESHOLDS

from .parameters import Family, Membership

Key = tuple[tuple[int, int, int], ...]
Maker = Callable[[SynthesisProblem, MpcController | None], MpcController]
"""Of the controller for one box of parameters, in what it need not find again like another."""


@final
class Held(NamedTuple):
    """What a run remembers: its level and its memory there, Θ (nθ,), the state at which it was, whether Θ was refuted, and how
    many steps went on with a plan of before.
    """

    key: Key
    number: int
    theta: Interval
    x: Array
    refuted: bool = False
    shifted: int = 0


@final
class Levels:
    """Controllers for boxes of parameters, made when they are asked for: the first is for the whole range Θ₀.

    At level ℓ of a parameter the box is between a width of 2^−ℓ of the range and 1 + 2 / `box_shares` times as much, on a
    lattice, so that runs which have learned the same share a controller, and nothing depends on the order of what was asked.
    """

    def __init__(self, family: Family, options: Mapping[str, Any], depth: int, make: Maker) -> None:
        self.family, self.options, self.depth, self.make = family, options, depth, make
        self.first: Key = ((0, 0, THRESHOLDS.box_shares),) * len(family.parameters)
        self.made: dict[Key, MpcController] = {}

    def __getitem__(self, key: Key) -> MpcController:
        if key not in self.made:
            like = None if key == self.first else self[self.first]
            self.made[key] = self.make(self.family.within(self.box(key)), like)
        return self.made[key]

    def told(self) -> dict[str, Any]:
        """What they are made by besides the problem, JSON-able."""
        ends = zip(self.family.range.lo.tolist(), self.family.range.hi.tolist(), strict=True)
        ranges = dict(zip(self.family.names, map(list, ends), strict=True))
        return {"range": ranges, "levels": self.depth, "options": dict(self.options)}

    def box(self, key: Key) -> Interval:
        """Θ of a level, (nθ,)."""
        whole = self.family.range
        pitch = (whole.hi - whole.lo) / THRESHOLDS.box_shares / 2.0 ** np.array([level for level, _, _ in key])
        low, high = (whole.lo + pitch * np.array([part[k] for part in key]) for k in (1, 2))
        at_end = np.array([b == THRESHOLDS.box_shares << level for level, _, b in key])
        return Interval(low, np.where(at_end, whole.hi, np.minimum(high, whole.hi)))

    def key(self, theta: Interval, now: Key) -> Key:
        """The level for Θ, whose box contains it; `now` unless some parameter is known twice as well as there."""
        whole, out = self.family.range, []
        share = (theta.hi - theta.lo) / (whole.hi - whole.lo)
        levels = np.clip(np.floor(-np.log2(np.maximum(share, 2.0**-60))), 0, self.depth).astype(int)
        if all(level <= old for level, (old, _, _) in zip(levels, now, strict=True)):
            return now
        for j, level in enumerate(np.maximum(levels, [old for old, _, _ in now]).tolist()):
            pitch = (whole.hi[j] - whole.lo[j]) / THRESHOLDS.box_shares / 2.0**level
            first, last = np.floor((theta.lo[j] - whole.lo[j]) / pitch), np.ceil((theta.hi[j] - whole.lo[j]) / pitch)
            # Outwards, whatever was rounded.
            first, last = first - (whole.lo[j] + pitch * first > theta.lo[j]), last + (whole.lo[j] + pitch * last < theta.hi[j])
            out.append((level, max(int(first), 0), min(int(last), THRESHOLDS.box_shares << level)))
        return tuple(out)


@final
@dataclass(frozen=True, eq=False)
class AdaptiveMpcController(Controller):
    """Begins where the controller for Θ₀ does; a run's memory is the number of what it holds: a plan, its level and Θ.

    After each step Θ loses what cannot have made it. Where Θ is half as wide as the level that the run's plan is of, a plan for
    the level of Θ is looked for; where there is none, the plan of before goes on, whose promise holds for all of its own box,
    and Θ is a part of that. A step that no θ ∈ Θ makes refutes the gap or the range: Θ stays from there on, and `told` says so.
    """

    goal: Goal
    levels: Levels
    evidence: Mapping[str, Any]
    kind: str = "mpc"
    runs: Memory[Held] = field(default_factory=Memory, repr=False)

    @property
    def first(self) -> MpcController:
        """The controller for the whole range."""
        return self.levels[self.levels.first]

    @property
    def policies(self) -> tuple[Policy, ...]:
        return self.first.policies

    def contains(self, x: Array) -> Bools:
        return self.first.contains(x)

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        return self.first.draw(n, rng)

    @property
    def resolution(self) -> int:
        return self.first.resolution

    def start(self, x: Array) -> Ints:
        """The number of what a run holds that begins there, with all of Θ₀; 0 where none can."""
        x = np.atleast_2d(np.asarray(x, dtype=np.float64))
        key, whole = self.levels.first, self.levels.family.range
        numbers = zip(x, self.first.start(x).tolist(), strict=True)
        return np.array([self.runs.add(Held(key, n, whole, row)) if n else 0 for row, n in numbers], dtype=np.int64)

    def advance(self, x: Array, memory: Ints) -> Ints:
        x = np.atleast_2d(np.asarray(x, dtype=np.float64))
        out, rows = np.zeros(len(x), dtype=np.int64), [*self._held(memory)]
        for i, held in zip(rows, self._learned(x[rows], memory[rows]) if rows else (), strict=True):
            out[i] = self.runs.add(self._planned(x[i], held))
        return out

    def _held(self, memory: Ints) -> dict[int, Held]:
        """Of the rows whose runs are known."""
        return {i: held for i, held in enumerate(self.runs.of(memory)) if held is not None}

    def _learned(self, after: Array, memory: Ints) -> list[Held]:
        """What the step to `after` says of Θ."""
        held = [*self._held(memory).values()]
        x = np.array([h.x for h in held])
        u, theta = self.respond(x, memory, "first"), self.theta(memory)
        new, refuted = Membership(self.levels.family).updated(x, u, after, theta)
        return [h if h.refuted else h._replace(theta=new[i], refuted=bool(refuted[i])) for i, h in enumerate(held)]

    def _planned(self, x: Array, held: Held) -> Held:
        """A plan for the level of Θ, else what goes on at the level of before."""
        key = self.levels.key(held.theta, held.key)
        if key != held.key and (level := self.levels[key]).wins:
            number = int(level.start(x[None])[0])
            if number:
                return held._replace(key=key, number=number, x=x)
        level, before = self.levels[held.key], np.array([held.number])
        now = level.advance(x[None], before)
        shifted = int(level.fallbacks(now)[0] - level.fallbacks(before)[0])
        return held._replace(number=int(now[0]), x=x, shifted=held.shifted + shifted)

    def _grouped(self, memory: Ints) -> Iterator[tuple[MpcController, Ints, Ints]]:
        """(controller, rows, their memory there), level by level."""
        held = self._held(memory)
        for key in dict.fromkeys(h.key for h in held.values()):
            rows = [i for i, h in held.items() if h.key == key]
            yield self.levels[key], np.array(rows), np.array([held[i].number for i in rows])

    def keeps(self, x: Array, memory: Ints) -> Bools:
        out = np.zeros(len(x), dtype=bool)
        for level, rows, numbers in self._grouped(memory):
            out[rows] = level.keeps(x[rows], numbers)
        return out

    def respond(self, x: Array, memory: Ints, policy: Policy, seed: int = 0, k: int = 0) -> Array:
        x = np.atleast_2d(np.asarray(x, dtype=np.float64))
        if len(self._held(memory)) < len(memory):
            # What is told of a state outside the domain is told by the first level.
            return self.first.respond(x, np.zeros(len(x), dtype=np.int64), policy, seed, k)
        out = np.empty((len(x), self.levels.family.problem.model.nu))
        for level, rows, numbers in self._grouped(memory):
            out[rows] = level.respond(x[rows], numbers, policy, seed, k)
        return out

    def act(self, x: Array, policy: Policy = "first", seed: int = 0, k: int = 0, *, outside: Outside = "raise") -> Array:
        if outside == "nan":
            return inside_alone(self, self.levels.family.problem.model.nu, x, policy, seed, k)
        return self.respond(x, self.start(x), policy, seed, k)

    def kept(self, x: Array, u: Array, after: Array, memory: Ints | None = None) -> Bools:
        """(n,): did the step end in the tube of the plan that was being kept?"""
        numbers, out = self.start(x) if memory is None else memory, np.zeros(len(after), dtype=bool)
        for level, rows, own in self._grouped(numbers):
            out[rows] = level.kept(x[rows], u[rows], after[rows], own)
        return out

    def fallbacks(self, memory: Ints) -> Ints:
        """(n,): steps of each run that went on with a plan of before."""
        return np.array([0 if held is None else held.shifted for held in self.runs.of(memory)], dtype=np.int64)

    def predicted(self, x: Array, memory: Ints | None = None) -> tuple[Array, Array, Array] | None:
        """As the controller of the run's level has it; it holds for all of the level's box."""
        for level, _, own in self._grouped(self.start(x[None]) if memory is None else memory):
            return level.predicted(x, own)
        return None

    def theta(self, memory: Ints) -> Interval:
        """Θ of each run, (n, nθ)."""
        held = [self._held(memory)[i].theta for i in range(len(memory))]
        return Interval(np.array([t.lo for t in held]), np.array([t.hi for t in held]))

    def learned(self, memory: Ints) -> dict[str, Array]:
        """Θ of each run by name, (n, 2); NaN from where it was refuted. A run that has not begun knows the whole range."""
        whole, out = self.levels.family.range, np.empty((len(memory), len(self.levels.family.names), 2))
        for i, held in enumerate(self.runs.of(memory)):
            theta = whole if held is None else held.theta
            out[i] = np.nan if held is not None and held.refuted else np.stack([theta.lo, theta.hi], axis=1)
        return {name: out[:, j] for j, name in enumerate(self.levels.family.names)}

    def told(self, number: int) -> dict[str, Any]:
        """What a run has learned: Θ by name, the box of its plan's level, and a sentence where the claim was refuted."""
        held, names = self.runs.kept[number], self.levels.family.names

        def shown(theta: Interval) -> dict[str, list[float]]:
            return {n: [float(a), float(b)] for n, a, b in zip(names, theta.lo, theta.hi, strict=True)}

        why = (
            f"no value of {', '.join(names)} in its range makes a step that was seen, so that the gap or the range is wrong; "
            f"the promise, which rests on both, is void, and nothing more is learned: certify the gap again, or widen the range"
        )
        told = {"parameters": shown(held.theta), "level": shown(self.levels.box(held.key))}
        return told | ({"refuted": why} if held.refuted else {})

    def save(self, folder: Path | str) -> None:
        """The controller for the whole range, and what all others follow from.

        Where the gap is no data (`kept`), what is loaded promises the same, and learns nothing.
        """
        problem, arrays = self.levels.family.problem, self.first.arrays()
        known = pair(arrays, model=problem.model, gap=problem.gap, domain=problem.domain, seed=problem.seed)
        first = replace(self.first, evidence=self.evidence)
        if known is None:
            first.save(folder)
        else:
            more = {"adapt": self.levels.told(), "kept": known, "digest": self.digest()}
            write_saved(Path(folder), first.saved() | more, arrays)

    def digest(self) -> str:
        """SHA-256 of everything that determines the inputs."""
        problem = self.levels.family.problem
        parts = self.first.digest(), Nominal(problem.model, problem.gap).digest(), problem.domain.digest_data(), problem.seed
        return hashlib.sha256(json.dumps([*parts, self.levels.told()], sort_keys=True).encode()).hexdigest()

    @classmethod
    def load(cls, folder: Path | str, maker: Callable[[Mapping[str, Any]], Maker]) -> AdaptiveMpcController:
        """Inverse of `save`, where it has what the others follow from; maker: makes of options who makes them."""

        def made(data: Mapping[str, Any], arrays: Mapping[str, Array]) -> AdaptiveMpcController:
            of, told = known(data["kept"], arrays), data["adapt"]
            problem = SynthesisProblem(of["model"], of["gap"], of["domain"], Goal.from_data(data["goal"]), of["seed"])
            levels = Levels(Family.of(problem, told["range"]), told["options"], told["levels"], maker(told["options"]))
            # The first controller's model is the one in the middle of the range.
            own = levels.family.within(levels.family.range)
            first = MpcController.read(Path(folder), data, arrays, Nominal(own.model, own.gap))
            levels.made[levels.first] = first
            return cls(first.goal, levels, first.evidence)

        return loaded(folder, made)


def adaptive(task: Task, of_boxes: Mapping[str, Any], make: Maker) -> Controller:
    """For parameters in the ranges that are asked for; of_boxes: the options by which `make` makes controllers.

    Without a gap the model is trusted as it is, at the middle of the ranges: nothing is learned then.
    """
    problem, options = task.problem, task.options
    levels = Levels(family := Family.of(problem, options.adapt), of_boxes, options.levels, make)
    first = levels[levels.first]
    if problem.gap is None or not first.wins:
        return first
    ends = list(zip(family.parameters, family.range.lo.tolist(), family.range.hi.tolist(), strict=True))
    names = ", ".join(f"{p.name} in [{low:g}, {high:g}] {p.unit}" for p, low, high in ends)
    assumptions = [
        *first.evidence.get("assumptions", ()),
        f"The plant's parameters are constant, with {names}.",
        "The gap holds around the model with the plant's own parameters, whatever they are in this range.",
    ]
    ranges = {p.name: [low, high] for p, low, high in ends}
    return AdaptiveMpcController(problem.goal, levels, {**first.evidence, "adapt": ranges, "assumptions": assumptions})
