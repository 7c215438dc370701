"""The synthesizer `mpc`: from a model, a gap and a goal to a program that is solved at every step."""

from __future__ import annotations

from pathlib import Path
from typing import Any, final

from gapcert.plugin import Controller, Domain, Goal, Model, Problem, SynthesisProblem, Synthesizer, UsageError, validate
from gapcert_cells import loading

from .config import MpcConfig
from .controller import MpcController
from .planning.requirements import check_reference, limits, moments, preferred
from .task import STARTS, Task
from .variants.adaptive import AdaptiveMpcController, adaptive
from .variants.parameters import named, ranged
from .variants.reaching import reaching
from .variants.regulation import regulating
from .variants.terminal import Ending, HandedController, handed


@final
class Mpc(Synthesizer):
    """Tube MPC for x⁺ ∈ f(x, u) + [l, u](x, u); see `gapcert_mpc.config` for the options.

    f + p is made straight over the whole goal, or at each step about the plan; the error of that is added to the tube.
    """

    name = "mpc"

    def __init__(self, **options: Any) -> None:
        problems: list[Problem] = []
        given = {name: option for name, option in options.items() if option is not None}
        made = validate(MpcConfig, given, ("controller",), problems)
        if problems:
            raise UsageError("; ".join(f"{'.'.join(map(str, p.path))}: {p.message}" for p in problems))
        self.options: MpcConfig = made
        self.starts = STARTS[self.options.linearisation]

    @property
    def _of_boxes(self) -> dict[str, Any]:
        """Options of the controllers for boxes of parameters, JSON-able."""
        return dict(sorted(self.options.model_dump(exclude={"kind", "adapt", "levels", "terminal"}).items()))

    def check(self, model: Model, domain: Domain, goal: Goal) -> None:
        goal.check(domain, model)
        asked = self.options
        if goal.kind != "reach_avoid" and (goal.kind != "invariance" or goal.avoid is not None):
            found = goal.kind if goal.avoid is None else f"{goal.kind} with obstacles"
            raise UsageError(f"controller: mpc knows the goals invariance, reach and reach_avoid; found {found}")
        if goal.kind == "reach_avoid" and (asked.adapt or asked.linearisation != "once"):
            raise UsageError("controller: mpc reaches a target along one straight line only; leave adapt and linearisation out")
        if asked.terminal is not None:
            if goal.kind != "invariance" or asked.adapt or asked.linearisation != "once":
                raise UsageError(
                    "controller.terminal: plans end in a winning set for invariance, along one straight line; leave adapt and "
                    "linearisation out, or terminal"
                )
            Ending(asked.terminal).check(model, domain, goal)
        plain = goal.kind == "invariance" and not asked.adapt and asked.linearisation == "once" and asked.terminal is None
        if asked.feedback == "disturbance" and not plain:
            raise UsageError(
                "controller.feedback: disturbance keeps invariance along one straight line only; leave adapt, terminal and "
                "linearisation out, or use `feedback: fixed`"
            )
        names = domain.states.names + domain.inputs.names
        for field, given in (("reference", [*asked.reference]), ("weights", [*asked.weights])):
            if unknown := [n for n in given if n not in names]:
                raise UsageError(f"controller.{field}: '{unknown[0]}' is unknown; expected some of {', '.join(names)}")
        check_reference(asked.reference, domain.axes, model.period)
        limits(asked.rates, domain)
        preferred(asked.soft, domain, Task(SynthesisProblem(model, None, domain, goal), asked, 0).frame, 1.0)
        moves = len(moments(asked.reference, model.period)) > 1
        for field, used, what in (
            ("reference", moves, "what is wanted moves"),
            ("rates", bool(asked.rates), "inputs are limited in how fast they change"),
            ("soft", bool(asked.soft), "ranges are preferred"),
        ):
            if used and not (plain and asked.feedback == "fixed"):
                raise UsageError(
                    f"controller.{field}: {what} for invariance only, along one straight line and under one gain; leave adapt, "
                    f"terminal, linearisation and feedback out, or {field}"
                )
        for p in named(model, asked.adapt) if asked.adapt else ():
            ranged(p, asked.adapt[p.name])

    def synthesize(self, problem: SynthesisProblem) -> Controller:
        self.check(problem.model, problem.domain, problem.goal)
        task, asked = Task(problem, self.options, self.starts), self.options
        if asked.feedback == "disturbance":
            # Its programs are compiled: nobody else waits for that.
            from .variants.disturbance import answering

            return answering(task)
        if asked.adapt:
            return adaptive(task, self._of_boxes, Mpc(**self._of_boxes).for_box)
        if asked.terminal is None and problem.goal.kind != "reach_avoid":
            return regulating(task)
        variant = reaching if asked.terminal is None else handed
        made = variant(task)
        return made if made.wins else task.weak(str(made.evidence["reason"]), lambda other: variant(other).wins)

    def for_box(self, problem: SynthesisProblem, like: MpcController | None) -> MpcController:
        """For one box of the parameters; those after the first have its gain and its solver, and are made as a run goes on."""
        return regulating(Task(problem, self.options, self.starts if like is None else 1), like)

    @staticmethod
    def load(folder: Path | str) -> Controller:
        """Inverse of `save`, of all controllers that this makes."""
        with loading(folder) as (data, _):
            pass
        if "terminal" in data:
            return HandedController.load(folder)
        if "adapt" in data:
            return AdaptiveMpcController.load(folder, lambda options: Mpc(**options).for_box)
        if "feedback" in data:
            from .variants.disturbance import DisturbanceMpcController

            return DisturbanceMpcController.load(folder)
        return MpcController.load(folder)
