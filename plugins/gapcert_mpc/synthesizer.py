"""The synthesizer `mpc`: from a model, a gap and a goal to a program that is solved at every step."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import replace
from inspect import signature
from typing import Any, Literal, final

import numpy as np

from gapcert import Array, Controller, Domain, Goal, Model, SynthesisProblem, UsageError
from gapcert.plugin import Pulse, Synthesizer

from . import tracking
from .config import Soft, Terminal
from .controller import Design, MpcController, looked
from .invariant import margin
from .program.linearise import Frame, Nominal, Stages
from .program.program import NotShrinking, Program, Rows, Weights
from .program.rates import limits
from .program.soft_constraints import preferred
from .program.solver import Choice, Name
from .program.tube import Section, riccati, taken, tightest, unreached
from .program.tuning import Tuning, tuned
from .variants.adaptive import adaptive
from .variants.parameters import named, ranged
from .variants.reaching import reaching
from .variants.successive import Ending
from .variants.terminal import Ending as Last
from .variants.terminal import handed

Linearisation = Literal["once", "successive"]
SMALL = 0.05  # of each range: a tube that takes less is not worth the variables that follow γ
REST = 1e-3  # what it costs that a plan ends away from the reference, besides the plan itself
STARTS: dict[Linearisation, int] = {"once": 400, "successive": 64}


@final
class Mpc(Synthesizer):
    """Tube MPC for x⁺ ∈ f(x, u) + [l, u](x, u); see `gapcert_mpc.config` for the options.

    f + p is made straight over the whole goal, or at each step about the plan; the error of that is added to the tube.
    """

    name = "mpc"

    def __init__(
        self,
        horizon: int = 20,
        reference: Mapping[str, Any] | None = None,
        weights: Mapping[str, float] | None = None,
        solver: Choice = "auto",
        tolerance: float = 1e-5,
        majorant: Literal["auto", "affine", "constant"] = "auto",
        linearisation: Linearisation = "once",
        adapt: Mapping[str, Any] | None = None,
        levels: int = 4,
        searches: int = 30,
        rates: Mapping[str, float | str] | None = None,
        soft: Mapping[str, Any] | None = None,
        terminal: Any = None,
        feedback: Literal["fixed", "disturbance"] = "fixed",
    ) -> None:
        self.rates, self.soft = dict(rates or {}), {n: Soft.model_validate(v) for n, v in (soft or {}).items()}
        self.horizon, self.reference, self.weights = horizon, tracking.stated(reference or {}), dict(weights or {})
        self.solver: Choice = solver
        self.tolerance, self.majorant, self.linearisation = tolerance, majorant, linearisation
        self.searches, self.terminal = searches, None if terminal is None else Terminal.model_validate(terminal)
        self.feedback = feedback
        self.adapt, self.levels, self.starts = dict(adapt or {}), levels, STARTS[linearisation]

    def check(self, model: Model, domain: Domain, goal: Goal) -> None:
        goal.check(domain)
        if goal.kind != "reach_avoid" and (goal.kind != "invariance" or goal.avoid is not None):
            asked = goal.kind if goal.avoid is None else f"{goal.kind} with obstacles"
            raise UsageError(f"controller: mpc knows the goals invariance, reach and reach_avoid; found {asked}")
        if goal.kind == "reach_avoid" and (self.adapt or self.linearisation != "once"):
            raise UsageError("controller: mpc reaches a target along one straight line only; leave adapt and linearisation out")
        if self.terminal is not None:
            if goal.kind != "invariance" or self.adapt or self.linearisation != "once":
                raise UsageError(
                    "controller.terminal: plans end in a winning set for invariance, along one straight line; leave adapt and "
                    "linearisation out, or terminal"
                )
            Last(self.terminal).check(model, domain, goal)
        plain = goal.kind == "invariance" and not self.adapt and self.linearisation == "once" and self.terminal is None
        if self.feedback == "disturbance" and not plain:
            raise UsageError(
                "controller.feedback: disturbance keeps invariance along one straight line only; leave adapt, terminal and "
                "linearisation out, or use `feedback: fixed`"
            )
        names = domain.states.names + domain.inputs.names
        for field, given in (("reference", [*self.reference]), ("weights", [*self.weights])):
            if unknown := [n for n in given if n not in names]:
                raise UsageError(f"controller.{field}: '{unknown[0]}' is unknown; expected some of {', '.join(names)}")
        tracking.check(self.reference, domain.axes, model.period)
        limits(self.rates, domain)
        preferred(self.soft, domain, Frame.of(*_ranges(goal, domain), model.nx), 1.0)
        moves = len(tracking.moments(self.reference, model.period)) > 1
        for field, used, what in (
            ("reference", moves, "what is wanted moves"),
            ("rates", bool(self.rates), "inputs are limited in how fast they change"),
            ("soft", bool(self.soft), "ranges are preferred"),
        ):
            if used and not (plain and self.feedback == "fixed"):
                raise UsageError(
                    f"controller.{field}: {what} for invariance only, along one straight line and under one gain; leave adapt, "
                    f"terminal, linearisation and feedback out, or {field}"
                )
        for p in named(model, self.adapt) if self.adapt else ():
            ranged(p, self.adapt[p.name])

    def synthesize(self, problem: SynthesisProblem) -> Controller:
        if self.feedback == "disturbance":
            from .variants.disturbance import answering

            plain = copy(self)
            # What it bounds is a constant, and no quadratic program is solved.
            plain.majorant, plain.starts = "constant", 1
            return answering(plain._synthesized(problem), self.starts, problem.seed)
        if not self.adapt and self.terminal is None:
            return self._synthesized(problem)
        self.check(problem.model, problem.domain, problem.goal)
        if self.terminal is not None:
            frame = Frame.of(*_ranges(problem.goal, problem.domain), problem.model.nx)
            (whole, rows), wanted = _whole(frame, problem.domain), self._wanted(problem, frame)
            cost = self._weights, wanted, self.tolerance, self.solver, self.starts
            return handed(problem, Last(self.terminal), frame, whole, rows, self.horizon, self.majorant, *cost)
        return adaptive(problem, self.adapt, self.options, self.levels)

    @property
    def options(self) -> dict[str, Any]:
        """Those of the controllers for boxes of parameters, JSON-able."""
        names = signature(Mpc).parameters.keys() - {"adapt", "levels", "terminal"}
        return {name: getattr(self, name) for name in sorted(names)}

    def for_box(self, problem: SynthesisProblem, like: MpcController | None) -> MpcController:
        """For one box of the parameters; those after the first have its gain and its solver, and are made as a run goes on."""
        plain = copy(self)
        plain.starts = self.starts if like is None else 1
        return plain._synthesized(problem, like)

    def _synthesized(self, problem: SynthesisProblem, like: MpcController | None = None) -> MpcController:
        model, domain, goal = problem.model, problem.domain, problem.goal
        self.check(model, domain, goal)
        low, high = _ranges(goal, domain)
        frame = Frame.of(low, high, model.nx)
        nominal = Nominal(model, problem.gap)
        names = domain.states.names + domain.inputs.names

        def nothing(reason: str) -> MpcController:
            return MpcController(goal, None, problem.basis | {"reason": reason, "domain_fraction": 0.0})

        whole, rows = _whole(frame, domain)
        tell = _teller(problem)
        tell("successors along the model's lines")
        if goal.kind == "reach_avoid":
            constant = self.majorant == "constant"
            cost = self._weights, self.tolerance, self.solver, self.searches, self.starts
            return reaching(problem, frame, nominal, whole, rows, self.horizon, constant, *cost)
        if self.linearisation == "successive":
            ending = Ending.about(nominal, frame, *self._wanted(problem, frame), whole[len(names) :], self.horizon)
            stages, section, shares = ending.stages, ending.section, ending.shares
        else:
            constant = self.majorant != "affine" if like is None else not _follows(like)
            stages = nominal.straight(low, high, self.horizon, frame, constant, like is None)
        if not np.isfinite(stages.c).all():
            i = int(np.flatnonzero(~np.isfinite(stages.c).all(axis=0))[0])
            return nothing(f"what is left of {names[i]} after the nominal model is unbounded over the goal; narrow the goal")
        if (lost := unreached(stages.A[-1], stages.B[-1])) is not None:
            mode = names[int(np.argmax(lost[1]))]
            return nothing(f"no gain stabilises {mode}: it grows by {lost[0]:.4g} per step, and no input reaches it")
        if self.linearisation == "once":
            asked = whole, like, limits(self.rates, domain, frame.u[1])
            tell("gain and section of the tube")
            section, shares = _section(stages, *asked)
            if like is None and self.majorant == "auto" and not (shares < SMALL).all():
                stages = nominal.straight(low, high, self.horizon, frame)
                section, shares = _section(stages, *asked)
        if not (shares < 1).all():
            return nothing(_too_wide(names, frame, whole, section, shares, self.linearisation))
        tell("terminal set and steady state", {"largest share that the tube takes": float(np.max(shares))})
        design = self._design(frame, stages, section, rows, problem)
        if isinstance(design, str):
            return nothing(design)
        evidence = problem.basis | self._evidence(design, names, nominal)
        name: Name = "piqp"
        if like is not None and like.design is not None:
            name, design = like.solver, replace(design, tuning=replace(like.design.tuning, pieces=Tuning().pieces))
        elif not design.successive and self.feedback == "fixed":
            name, tuning, samples = tuned(design.program(), design.reference[: model.nx], self.solver, problem.seed, tell)
            design = replace(design, tuning=tuning)
            evidence["solver"] = {"first": name, "pieces": len(tuning.pieces), "tuned_on": samples}
        elif self.solver != "auto":
            name = self.solver
        made = MpcController(goal, design, {}, name, nominal=nominal if design.successive else None)
        rng = np.random.default_rng(problem.seed)
        x = low[: model.nx] + (high - low)[: model.nx] * rng.random((self.starts, model.nx))
        evidence["domain_fraction"] = float(looked(made, x, problem.emit).mean())
        return replace(made, evidence=evidence)

    def _weights(self, stages: Stages, domain: Domain) -> Weights:
        cost = np.array([float(self.weights.get(axis.name, 1.0)) for axis in domain.axes])
        nx = domain.nx
        R = np.maximum(cost[nx:], 1e-6)
        Q = np.maximum(cost[:nx], 1e-6)
        X = riccati(stages.A[-1], stages.B[-1], Q, R)
        # The scale of a cost is free; near 1 the solvers find their step sizes best.
        soft = [max(given.linear, given.quadratic) for given in self.soft.values()]
        scale = 1 / max(np.abs(X).max(), Q.max(), R.max(), *soft)
        return Weights(np.diag(Q) * scale, np.diag(R) * scale, X * scale, np.eye(nx) * REST * scale)

    def _wanted(self, problem: SynthesisProblem, frame: Frame, step: int = 0) -> tuple[Array, Array]:
        """The reference at a step of a run in the frame, and how much each of it matters."""
        return tracking.wanted(tracking.at(self.reference, step, problem.model.period), problem.domain.axes, frame)

    def _design(self, frame: Frame, stages: Stages, section: Section, rows: Rows, problem: SynthesisProblem) -> Design | str:
        domain, moments = problem.domain, tracking.moments(self.reference, problem.model.period)
        weights, rates = self._weights(stages, domain), limits(self.rates, domain, frame.u[1])
        successive = self.linearisation == "successive"
        try:
            program = Program(stages, section, rows, weights, self.tolerance, successive, rates=rates)
        except NotShrinking as error:
            return f"the tube grows without end: by {error.args[0]:.4g} per step; narrow the goal, or shorten the period"
        found = [tracking.steady(program, *self._wanted(problem, frame, step)) for step in moments]
        if (first := found[0]) is None:
            reason = "no steady state keeps its tube within the goal; widen the goal, or give the input more authority"
            return reason if successive else f"{reason}, or use {_HINT}"
        course = tracking.Course(np.array(moments), np.array(found)) if len(found) > 1 else None
        soft = preferred(self.soft, domain, frame, weights.T[0, 0] / REST)
        design = Design(frame, stages, section, rows, weights, first, self.tolerance, successive)
        return replace(design, rates=rates, course=course, soft=soft)

    def _evidence(self, design: Design, names: tuple[str, ...], nominal: Nominal) -> dict[str, Any]:
        program = design.program()
        base, _, per = program.terminal
        away = np.abs(design.reference - design.stages.centre[-1])
        size = base + per @ away[program.on]
        half = design.section.support @ size * design.frame.half
        nx = design.frame.nx
        x, u = design.reference[:nx], design.reference[nx:]
        at = design.frame.out(design.reference)
        moves = {} if design.course is None else {"schedule": design.course.shown(design.frame, names, nominal.model.period)}
        return moves | {
            "horizon": self.horizon,
            "terminal_margin": margin(nominal, design.frame, design.section, x, u, size),
            "tube": dict(zip(names, half.tolist(), strict=True)),
            "reference": dict(zip(names, at.tolist(), strict=True)),
        }


def _teller(problem: SynthesisProblem) -> Callable[..., None]:
    """Tells what is tried next, and the best of what was."""
    pulse, tried = Pulse(problem.emit, "controller", unit="designs"), itertools.count(1)
    return lambda text, best=None: pulse(next(tried), best, text=text)


def _ranges(goal: Goal, domain: Domain) -> tuple[Array, Array]:
    box, inputs = goal.stay, domain.inputs
    return np.concatenate([box.low, inputs.low]), np.concatenate([box.high, inputs.high])


def _follows(made: MpcController) -> bool:
    """Does its tube follow how γ depends on the plan?"""
    return made.design is not None and bool(made.design.stages.G.any())


def _section(stages: Stages, rows: Array, like: MpcController | None, rates: Array | None) -> tuple[Section, Array]:
    """With the gain of another controller, where one is given."""
    A, B, c, G = stages.A[0], stages.B[0], stages.c[0], stages.G[0]
    if like is None or like.design is None:
        return tightest(A, B, c, G, rows, rates=rates)
    section = Section.of(A, B, like.design.section.K)
    return section, taken(section, c, G, rows, rates=rates)


def _whole(frame: Frame, domain: Domain) -> tuple[Array, Rows]:
    related = _related(domain, frame)
    half = (related.high - related.low)[:, None] / 2
    return np.vstack([np.eye(len(frame.half)), related.C / np.where(np.isfinite(half), half, 1.0)]), related


def _related(domain: Domain, frame: Frame) -> Rows:
    """The domain's relations a·z ≤ b as rows of the frame, each scaled to coefficients of size 1."""
    C = np.array([r.coefficients for r in domain.relations]).reshape(-1, len(frame.half))
    high = np.array([r.bound for r in domain.relations]) - C @ frame.middle
    C = C * frame.half
    size = np.abs(C).max(axis=1, initial=1e-300)
    return Rows(C / size[:, None], np.full(len(C), -np.inf), high / size)


def _too_wide(
    names: tuple[str, ...], frame: Frame, whole: Array, section: Section, shares: Array, linearisation: Linearisation
) -> str:
    if not np.isfinite(shares).all():
        reason = f"no gain keeps the tube from growing without end (the best spectral radius is {section.radius:.4g})"
        return reason if linearisation == "successive" else f"{reason}; {_HINT}"
    j = int(np.argmax(shares))
    if linearisation == "successive":
        named = names[j] if j < len(names) else "a relation"
        return f"at rest the tube needs {shares[j]:.3g} times the room that there is for {named}; a tighter γ would help"
    if (i := j - len(whole)) >= 0:
        input_ = names[frame.nx + i]
        return f"the feedback alone takes {shares[j]:.3g} times the rate of {input_}; a tighter γ or a higher rate would help"
    room = f"the tube needs ± {shares[j] * frame.half[j]:.4g} of {names[j]}" if j < len(names) else "the tube breaks a relation"
    goal = f", and the goal leaves ± {frame.half[j]:.4g}" if j < len(names) else ""
    return f"{room}{goal}; a tighter γ, a shorter period or a wider goal would help, or {_HINT}"


_HINT = "`linearisation: successive`, which makes the model straight about each plan alone"
