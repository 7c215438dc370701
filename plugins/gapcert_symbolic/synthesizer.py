"""The synthesizer `symbolic`: from a model, a gap and a goal to a controller that keeps its promise."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal, NamedTuple, final

import numpy as np

from gapcert import Array, Box, Domain, GapFunction, Goal, MissingDependency, Model, Region, SynthesisProblem, UsageError
from gapcert.plugin import Bools, Ints, Policy, Pulse, Synthesizer, magnitude
from gapcert_cells import GROWTH, SEEN, AutomatonController, GridController, Successors, sufficient
from gapcert_symbolic.thresholds import THRESHOLDS

from .cells.abstraction import Windows, check_size, windows
from .cells.bounds import Bound, Enclosed, Grown, inferred
from .cells.gaps import Disturbance, disturbance
from .cells.grid import Grid, combined, multiples, spaced
from .cells.held import Left, invariant, offered
from .games.games import Labels, solve_goal, started, usable
from .games.reason import in_words, tried, why_empty
from .games.refinement import Refined, refined
from .solvers.problem import Dynamics, Problem, Solution

CHUNK = 1 << 20


@final
@dataclass(frozen=True, eq=False)
class Symbolic(Synthesizer):
    """A cell wins under an input if f over the whole cell, plus [l, u] over the whole cell, lies in winning cells.

    cells: number per state; inputs: number of values per input, both ends included. `policy` is the default for closed loops.
    An input is offered in a cell only if the domain's relations hold for all of the cell's states. With `on`, only these states
    have cells: the others stay in a box V0 that no input leads out of, and a cell stands for all of it (see `held.invariant`).
    input_range: [low, high] per input, numbers or quantities; default: the domain's.

    align: `tile` has the cells fill `stay`; `scots` has them where SCOTS 0.2 has them, for comparison: centred at the multiples
    of `eta`, a distance per state and input, and the inputs at such multiples too. growth: a Model of radii, the growth bound
    ρ(r, u), taken on trust; default: the model's own enclosures, rounded outwards. error: with a growth bound, how far a state
    may be from where it was measured. solver: `jax` solves the same games on the device that JAX finds. threads:
    how many the compiled solvers may use (see `games.usable`); what they find does not depend on it. refine: so many times
    cells that lost, but may yet win, are halved along every axis (see `refinement`).
    """

    cells: Mapping[str, int] = field(default_factory=dict)
    inputs: Mapping[str, int] = field(default_factory=dict)
    policy: Policy = "first"
    on: Sequence[str] | None = None
    input_range: Mapping[str, tuple[float | str, float | str]] | None = None
    align: Literal["tile", "scots"] = "tile"
    eta: Mapping[str, float | str] | None = None
    growth: Any = None
    error: Mapping[str, float | str] | None = None
    solver: Literal["compiled", "jax"] = "compiled"
    threads: int | None = None
    refine: int = 0

    name = "symbolic"

    def check(self, model: Model, domain: Domain, goal: Goal) -> None:
        if self.solver == "jax" and importlib.util.find_spec("jax") is None:
            raise MissingDependency(
                "controller.solver: jax needs jax, which is not installed; run: pip install 'gapcert[jax]', or leave solver out"
            )
        plan = self._plan(model, domain, goal, None)
        # A model that knows no range over boxes says so at the first cell.
        self._bound(model, plan.grid).over(*plan.grid.cells(0, 1), np.asarray([[a[0] for a in plan.axes]]))

    def _bound(self, model: Model, grid: Grid) -> Bound:
        if self.growth is None:
            if self.error:
                raise UsageError("controller.error: errors of measurement need a growth bound; add growth")
            return Enclosed(model)
        spare, names = grid.widths / 1e10, [s.name for s in model.states]
        _refuse_unknown("error", self.error or (), names, "no state; expected some of")
        for name, value in (self.error or {}).items():
            j = names.index(name)
            spare[j] = magnitude(value, model.states[j].unit)
            if not 0 <= spare[j] < math.inf:
                raise UsageError(f"controller.error: {name} is {spare[j]:g}; give a distance")
        return Grown(model, self.growth, spare)

    def _plan(self, model: Model, domain: Domain, goal: Goal, gap: GapFunction | None) -> _Plan:
        """Cells of the states, values of each input, and the box of the states without cells."""
        goal.check(domain, model)
        if self.refine and self.align == "scots":
            raise UsageError("controller.refine: align: scots is solved on one grid; leave refine out, or put cells on tiles")
        inputs, names = self._ranges(domain), domain.states.names
        on = self._on(names)
        if self.align == "scots":
            grid, axes = self._scots(goal, inputs)
            check_size(grid, math.prod(len(a) for a in axes), goal.kind != "invariance")
            return _Plan(grid, axes, inputs, None)
        held = None if len(on) == len(names) else invariant(Left(model, gap, domain, goal, on, inputs))
        grid = _grid(goal, on, held, _counts("cells", self.cells, tuple(names[j] for j in on)))
        counts = _counts("inputs", self.inputs, domain.inputs.names)
        check_size(grid, math.prod(counts), goal.kind != "invariance")
        axes = tuple(spaced(a, b, n) for a, b, n in zip(inputs.low, inputs.high, counts, strict=True))
        return _Plan(grid, axes, inputs, held)

    def _scots(self, goal: Goal, inputs: Box) -> tuple[Grid, tuple[Array, ...]]:
        """Cells and inputs at the multiples of `eta`."""
        if self.cells or self.inputs or self.on is not None:
            raise UsageError(
                "controller: align: scots takes distances; give eta for every state and input, and no counts or on"
            )
        names, given, eta = (*goal.stay.names, *inputs.names), self.eta or {}, []
        for axis in (*goal.stay.axes, *inputs.axes):
            if axis.name not in given:
                raise UsageError(
                    f"controller.eta: nothing for '{axis.name}'; add {axis.name}: a distance in {axis.unit or '1'}"
                )
            eta.append(magnitude(given[axis.name], axis.unit))
            if not 0 < eta[-1] < math.inf:
                raise UsageError(f"controller.eta: {axis.name} is {eta[-1]:g}; give a positive distance")
        _refuse_unknown("eta", given, names, "unknown; expected")
        nx = len(goal.stay.axes)
        ranges = zip(inputs.low, inputs.high, eta[nx:], strict=True)
        return Grid.scots(goal.stay, tuple(eta[:nx])), tuple(multiples(a, b, e) for a, b, e in ranges)

    def _on(self, names: tuple[str, ...]) -> tuple[int, ...]:
        _refuse_unknown("on", self.on or (), names, "no state; expected some of")
        return tuple(j for j, name in enumerate(names) if self.on is None or name in self.on)

    def _ranges(self, domain: Domain) -> Box:
        """The inputs in use."""
        given, box = self.input_range or {}, domain.inputs
        _refuse_unknown("input_range", given, box.names, "no input; expected")
        ends = [given.get(a.name, (low, high)) for a, low, high in zip(box.axes, box.low, box.high, strict=True)]
        units = [a.unit for a in box.axes]
        low, high = (tuple(magnitude(e[k], unit) for e, unit in zip(ends, units, strict=True)) for k in (0, 1))
        if not (used := Box(box.axes, low, high)).within(box):
            raise UsageError(
                f"controller.input_range: {dict(zip(box.names, zip(low, high, strict=True), strict=True))} is not inside the "
                f"domain's inputs {dict(zip(box.names, zip(box.low, box.high, strict=True), strict=True))}; narrow it"
            )
        return used

    def synthesize(self, problem: SynthesisProblem) -> GridController | AutomatonController:
        goal, plan = problem.goal, self._plan(problem.model, problem.domain, problem.goal, problem.gap)
        grid, axes = plan.grid, plan.axes

        def tick(part: str) -> Any:
            pulse = Pulse(problem.emit, "controller", part=part)
            return lambda done, total: pulse(done, total=total)

        added = None if problem.gap is None else disturbance(problem.gap, grid, axes, tick=tick("gap over cells"))
        made = self._made(problem, plan, added, tick("successors of cells"))
        found = self._refined(problem, plan, made, tick) if self.refine else made
        evidence = problem.basis | made.facts() | found.facts()
        if added is not None and made.tabled and math.prod(added.r.lo.shape[:2]) > 1:
            evidence["gap_over_cells"] = dict(made.paths().told)
        if plan.held is not None:
            evidence["held"] = {n: [a, b] for n, a, b in zip(plan.held.names, plan.held.low, plan.held.high, strict=True)}
        if self.growth is not None:
            evidence["assumptions"] = [GROWTH, *([SEEN] if inferred(problem.model, grid, axes) else [])]
        if not found.won(1 if made.beyond else 0):
            evidence |= self._reason(problem, plan, added, made)
        points, solution, labels = combined(axes), found.solution, found.labels
        more: dict[str, Any] = {"held": plan.held, "promised": found.promised(), "splits": found.splits}

        def grids(bits: Any, values: Any, evidence: dict[str, Any]) -> GridController:
            return GridController(goal, found.edges, points, bits, values, evidence, lasting=solution.lasting, **more)

        if labels is None:
            return grids(solution.bits, solution.values, evidence)
        parts = tuple(grids(bits, values, {}) for bits, values in zip(solution.bits, solution.values, strict=True))
        return AutomatonController(goal, parts, labels.must, labels.may, evidence)

    def _refined(self, problem: SynthesisProblem, plan: _Plan, made: _Made, tick: Callable[[str], Any]) -> Refined:
        """From the solution on the plan's grid to cells that are halved as often as `refine` says."""

        def windows_on(grid: Grid, cell: Ints) -> Windows:
            added = None if problem.gap is None else disturbance(problem.gap, grid, plan.axes, tick=tick("gap over cells"))
            bound = self._bound(problem.model, grid)
            allowed = offered(problem.domain, grid, plan.axes, cell)
            return windows(bound, grid, plan.axes, added, allowed=allowed, tick=tick("successors of cells"), cell=cell)

        return refined(problem.goal, self.refine, made.solution, made.paths(), windows_on)

    def _made(self, problem: SynthesisProblem, plan: _Plan, added: Disturbance | None, tick: Any = None) -> _Made:
        """The fixpoint on a plan, with [l, u] over its cells."""
        goal, grid, axes = problem.goal, plan.grid, plan.axes
        allowed, bound = offered(problem.domain, grid, axes), self._bound(problem.model, grid)
        paths = cache(lambda: windows(bound, grid, axes, added, tick=tick, allowed=allowed))
        safe = cache(lambda: _safe(grid, goal))
        if plan.held is not None:
            _refuse_held(goal, plan.held)
        labels = Labels.of(grid, goal.regions) if goal.automaton else None
        target = grid.inside(goal.target)
        inputs = math.prod(len(a) for a in plan.axes)
        dynamics = Dynamics(bound, grid, axes, added, allowed) if goal.kind == "invariance" else None
        # What a solver without tables is given it may take for its own.
        own = safe() if dynamics is None else _safe(grid, goal)
        asked = Problem(paths, own, None, dynamics, self.solver, usable(self.threads, grid.size * inputs))
        solution = solve_goal(goal, asked, target, labels)
        Pulse(problem.emit, "controller", 1, part="fixpoint")(1, solution.told)
        return _Made(goal, grid, inputs, paths, safe, target, labels, solution, paths.cache_info().currsize > 0)

    def _reason(self, problem: SynthesisProblem, plan: _Plan, added: Disturbance | None, made: _Made) -> dict[str, Any]:
        """Why nothing wins, and what would have to change."""
        grid = plan.grid
        few = grid.nodes is None and grid.size * made.inputs <= THRESHOLDS.change_pairs
        cause = why_empty(problem, made.labels, added, made.paths, made.safe(), made.target, plan.inputs)

        def wins(scale: float, factor: int) -> bool:
            finer = Grid(grid.box, tuple(n * factor for n in grid.counts), grid.on, grid.frame) if factor > 1 else grid
            over = added if factor == 1 or problem.gap is None else disturbance(problem.gap, finer, plan.axes)
            if over is not None and scale < 1:
                over = over.scaled(scale)
            found = self._made(problem, plan._replace(grid=finer), over)
            return found.won(1 if found.beyond else 0) > 0

        def held(inputs: Box) -> bool:
            axes = tuple(spaced(a, b, len(v)) for a, b, v in zip(inputs.low, inputs.high, plan.axes, strict=True))
            found = self._made(problem, plan._replace(axes=axes, inputs=inputs), None)
            return found.won(1 if found.beyond else 0) > 0

        change = tried(wins, grid, made.inputs, added is not None) if not cause.of else {}
        without = not cause.of and added is not None and few and "gap_scale" not in change
        if few and not change and cause.of != "goal" and (wider := sufficient(held, plan.inputs, cause.needed)) is not None:
            change["inputs"] = wider.bounds
        beyond = "nothing beyond the target: " if made.won() else ""
        told = in_words(change, plan.inputs, without, few and not cause.of)
        return {"reason": beyond + cause.text + told, "change": {**cause.change, **change}}


@final
class _Made(NamedTuple):
    """A fixpoint and what it was made from; not all need `tabled` windows."""

    goal: Goal
    grid: Grid
    inputs: int
    paths: Callable[[], Windows]
    safe: Callable[[], Bools]
    target: Bools
    labels: Labels | None
    solution: Solution
    tabled: bool
    splits: None = None

    @property
    def edges(self) -> tuple[Array, ...]:
        return self.grid.edges

    def promised(self) -> Successors | Callable[[], Successors | None] | None:
        """What a step promises, tabled where it is asked for; None where the tables are too large."""
        if self.tabled:
            return self._tables()
        most = 8 * len(self.grid.counts) * self.grid.size * self.inputs
        return self._tables if most <= Successors.KEPT else None

    def _tables(self) -> Successors | None:
        return self.paths().successors.unless_large()

    def won(self, least: int = 0) -> int:
        """Cells of at least this value, with the memory that a run begins with there."""
        values = self.solution.values
        if self.goal.automaton is not None and self.labels is not None:
            return int(started(self.goal.automaton, self.labels, values >= least).sum())
        return sum(int(np.count_nonzero(values[k : k + CHUNK] >= least)) for k in range(0, len(values), CHUNK))

    def facts(self) -> dict[str, Any]:
        automaton, winning = self.goal.automaton, self.won()
        return {
            "cells": self.grid.size,
            "inputs": self.inputs,
            "winning_cells": winning,
            "winning_fraction": winning / self.grid.size,
            "rounds": self.solution.rounds,
            **({} if automaton is None else {"automaton_states": len(automaton.after)}),
        }

    @property
    def beyond(self) -> bool:
        """Must there be a step, for anything to be won? So it is where the goal ends at a target that leaves other cells."""
        return self.goal.kind == "reach_avoid" and bool((self.safe() & ~self.target).any())


@final
class _Plan(NamedTuple):
    """What a synthesis works on; `held` is V0, where some states have no cells."""

    grid: Grid
    axes: tuple[Array, ...]
    inputs: Box
    held: Box | None


def _safe(grid: Grid, goal: Goal) -> Bools:
    safe = ~grid.touching(goal.avoid)
    return safe if grid.nodes is None else safe & grid.inside(Region((goal.stay,)))


def _grid(goal: Goal, on: tuple[int, ...], held: Box | None, counts: tuple[int, ...]) -> Grid:
    stay = goal.stay
    box = Box(tuple(stay.axes[j] for j in on), tuple(stay.low[j] for j in on), tuple(stay.high[j] for j in on))
    if held is None:
        return Grid(box, counts)
    ranges = dict(zip(held.names, zip(held.low, held.high, strict=True), strict=True))
    ends = zip(stay.names, stay.low, stay.high, strict=True)
    return Grid(box, counts, on, np.array([ranges.get(name, (low, high)) for name, low, high in ends]))


def _refuse_held(goal: Goal, held: Box) -> None:
    """What is to be reached or visited cannot ask for what the cells do not tell apart."""
    names = goal.automaton.propositions if goal.automaton else ()
    regions = [("target", goal.target), *((f"region {name}", region) for name, region in zip(names, goal.regions, strict=True))]
    for what, box in ((what, box) for what, region in regions for box in (region.boxes if region else ())):
        for name, low, high in zip(held.names, held.low, held.high, strict=True):
            j = goal.stay.names.index(name)
            if low < box.low[j] or high > box.high[j]:
                raise UsageError(
                    f"goal: {what} asks for {name} in [{box.low[j]:g}, {box.high[j]:g}], and the controller, which has no "
                    f"cells for it, keeps it in [{low:g}, {high:g}]; leave it out there, or add it to controller.on"
                )


def _refuse_unknown(option: str, given: Iterable[str], names: Sequence[str], told: str) -> None:
    if unknown := [name for name in given if name not in names]:
        raise UsageError(f"controller.{option}: '{unknown[0]}' is {told} {', '.join(names)}")


def _counts(option: str, given: Mapping[str, int], names: tuple[str, ...]) -> tuple[int, ...]:
    least = 1 if option == "cells" else 2
    _refuse_unknown(option, given, names, "unknown; expected")
    for name, number in given.items():
        if number < least:
            raise UsageError(f"controller.{option}: {name} is {number}; give at least {least}")
    if missing := [n for n in names if n not in given]:
        raise UsageError(f"controller.{option}: nothing for '{missing[0]}'; add {missing[0]}: a number")
    return tuple(int(given[n]) for n in names)
