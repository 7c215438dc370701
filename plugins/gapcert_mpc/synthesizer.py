"""The synthesizer `mpc`: from a model, a gap and a goal to a program that is solved at every step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal, final

import numpy as np

from gapcert import Domain, Goal, Model, SynthesisProblem, Synthesizer, UsageError, magnitude

from .controller import Design, MpcController
from .linearise import Frame, Nominal, Stages
from .program import NotShrinking, Program, Rows, Weights
from .solver import Choice
from .tube import Section, riccati, tightest
from .tuning import tuned

Array = np.ndarray
STARTS = 400


@final
class Mpc(Synthesizer):
    """Tube MPC for x⁺ ∈ f(x, u) + [l, u](x, u); see `gapcert_mpc.config` for the options.

    f + p is made straight over the whole goal, and the error of that is added to the tube.
    """

    name = "mpc"

    def __init__(
        self,
        horizon: int = 20,
        reference: Mapping[str, float | str] | None = None,
        weights: Mapping[str, float] | None = None,
        solver: Choice = "auto",
        tolerance: float = 1e-5,
        majorant: Literal["affine", "constant"] = "affine",
    ) -> None:
        self.horizon, self.reference, self.weights = horizon, dict(reference or {}), dict(weights or {})
        self.solver: Choice = solver
        self.tolerance, self.majorant = tolerance, majorant

    def check(self, model: Model, domain: Domain, goal: Goal) -> None:
        goal.check(domain)
        if goal.kind != "invariance" or goal.avoid is not None:
            raise UsageError(f"controller: mpc knows the goal invariance; found {goal.kind}")
        names = domain.states.names + domain.inputs.names
        for field, given in (("reference", self.reference), ("weights", self.weights)):
            if unknown := [n for n in given if n not in names]:
                raise UsageError(f"controller.{field}: '{unknown[0]}' is unknown; expected some of {', '.join(names)}")

    def synthesize(self, problem: SynthesisProblem) -> MpcController:
        model, domain, goal = problem.model, problem.domain, problem.goal
        self.check(model, domain, goal)
        low, high = (
            np.concatenate([a, b]) for a, b in ((goal.stay.low, domain.inputs.low), (goal.stay.high, domain.inputs.high))
        )
        frame = Frame.of(low, high, model.nx)
        stages = Nominal(model, problem.gap).straight(low, high, self.horizon, frame, self.majorant == "constant")
        names = domain.states.names + domain.inputs.names

        def nothing(reason: str) -> MpcController:
            return MpcController(goal, None, {"reason": reason, "domain_fraction": 0.0})

        if not np.isfinite(stages.c).all():
            i = int(np.flatnonzero(~np.isfinite(stages.c[0]))[0])
            return nothing(f"what is left of {names[i]} after the nominal model is unbounded over the goal; narrow the goal")
        A, B = stages.A[0], stages.B[0]
        section, shares = tightest(A, B, stages.c[0], stages.G[0], _whole(frame, domain)[0])
        if not (shares < 1).all():
            return nothing(_too_wide(names, frame, stages, section, shares))
        rows = _related(domain, frame)
        design = self._design(frame, stages, section, rows, domain)
        if isinstance(design, str):
            return nothing(design)
        name, tuning, samples = tuned(design.program(), design.reference[: model.nx], self.solver, problem.seed)
        design = replace(design, tuning=tuning)
        made = MpcController(goal, design, {}, name)
        rng = np.random.default_rng(problem.seed)
        x = low[: model.nx] + (high - low)[: model.nx] * rng.random((STARTS, model.nx))
        evidence = self._evidence(design, names) | {"domain_fraction": float(made.contains(x).mean())}
        evidence["solver"] = {"first": name, "pieces": len(tuning.pieces), "tuned_on": samples}
        return MpcController(goal, design, evidence, name)

    def _design(self, frame: Frame, stages: Stages, section: Section, rows: Rows, domain: Domain) -> Design | str:
        names = domain.states.names + domain.inputs.names
        nx, nz = frame.nx, len(names)
        cost = np.array([float(self.weights.get(n, 1.0)) for n in names])
        R = np.maximum(cost[nx:], 1e-6)
        Q = np.maximum(cost[:nx], 1e-6)
        X = riccati(stages.A[0], stages.B[0], Q, R)
        # The scale of a cost is free; near 1 the solvers find their step sizes best.
        scale = 1 / max(np.abs(X).max(), Q.max(), R.max())
        weights = Weights(np.diag(Q) * scale, np.diag(R) * scale, X * scale, np.eye(nx) * 1e-3 * scale)
        try:
            program = Program(stages, section, rows, weights, self.tolerance)
        except NotShrinking as error:
            return f"the tube grows without end: by {error.args[0]:.4g} per step; narrow the goal, or shorten the period"
        wanted, matter = np.zeros(nz), np.full(nz, 1e-3)
        for j, axis in enumerate(domain.axes):
            if axis.name in self.reference:
                at = magnitude(self.reference[axis.name], axis.unit)
                wanted[j], matter[j] = (at - frame.middle[j]) / frame.half[j], 1.0
        found = program.target(wanted[:nx], wanted[nx:], matter)
        if found is None:
            return "no steady state keeps its tube within the goal; widen the goal, or give the input more authority"
        return Design(frame, stages, section, rows, weights, np.concatenate(found), self.tolerance)

    def _evidence(self, design: Design, names: tuple[str, ...]) -> dict[str, Any]:
        program = design.program()
        base, _, per = program.terminal
        away = np.abs(design.reference - design.stages.centre[-1])
        half = design.section.support @ (base + per @ away[program.on]) * design.frame.half
        at = design.frame.out(design.reference)
        return {
            "horizon": self.horizon,
            "tube": dict(zip(names, half.tolist(), strict=True)),
            "reference": dict(zip(names, at.tolist(), strict=True)),
        }


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


def _too_wide(names: tuple[str, ...], frame: Frame, stages: Stages, section: Section, shares: Array) -> str:
    if not np.isfinite(shares).all():
        return f"no gain keeps the tube from growing without end (the best spectral radius is {section.radius:.4g})"
    j = int(np.argmax(shares))
    room = f"the tube needs ± {shares[j] * frame.half[j]:.4g} of {names[j]}" if j < len(names) else "the tube breaks a relation"
    return f"{room}, and the goal leaves ± {frame.half[j]:.4g}; a tighter γ, a shorter period or a wider goal would help"
