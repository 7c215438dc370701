"""What a controller is made of: a problem in its frame with what is asked of plans, and the answer where there can be none."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np

from gapcert.plugin import Array, Box, Domain, Pulse, SynthesisProblem, UsageError
from gapcert_cells import FAR, ranges, sufficient
from gapcert_mpc.thresholds import THRESHOLDS

from .config import MpcConfig
from .controller import MpcController
from .planning import requirements
from .program.linearise import Frame, Nominal, Stages
from .program.program import Rows, Weights
from .program.tube import riccati, unreached

STARTS = {"once": 400, "successive": 64}
"""By linearisation: how many states are asked for what a controller wins."""


@final
@dataclass(frozen=True)
class Task:
    """A problem, with the options by which its controller is made; `starts` states are asked for what it wins."""

    problem: SynthesisProblem
    options: MpcConfig
    starts: int

    @property
    def box(self) -> Domain:
        """States of the goal, and inputs."""
        return Domain(self.problem.goal.stay, self.problem.domain.inputs)

    @property
    def zone(self) -> Domain:
        """The part of the box that the domain's relations leave."""
        return replace(self.box, relations=self.problem.domain.relations)

    @cached_property
    def frame(self) -> Frame:
        return Frame.of(self.box.low, self.box.high, self.problem.domain.nx)

    @cached_property
    def nominal(self) -> Nominal:
        return Nominal(self.problem.model, self.problem.gap)

    @property
    def names(self) -> tuple[str, ...]:
        return self.problem.domain.states.names + self.problem.domain.inputs.names

    def named(self, values: Array) -> dict[str, float]:
        """(n + m,) of states and inputs, JSON-able."""
        return dict(zip(self.names, values.tolist(), strict=True))

    @cached_property
    def rows(self) -> Rows:
        """The domain's relations a·z ≤ b as rows of the frame, each scaled to coefficients of size 1."""
        relations, frame = self.problem.domain.relations, self.frame
        C = np.array([r.coefficients for r in relations]).reshape(-1, len(frame.half))
        high = np.array([r.bound for r in relations]) - C @ frame.middle
        C = C * frame.half
        size = np.abs(C).max(axis=1, initial=1e-300)
        return Rows(C / size[:, None], np.full(len(C), -np.inf), high / size)

    @property
    def whole(self) -> Array:
        """(r, n + m): the states and inputs of the frame, and its relations, scaled to half-widths of 1."""
        half = (self.rows.high - self.rows.low)[:, None] / 2
        return np.vstack([np.eye(len(self.frame.half)), self.rows.C / np.where(np.isfinite(half), half, 1.0)])

    @cached_property
    def tell(self) -> Callable[..., None]:
        """Tells what is tried next, and the best of what was."""
        pulse, tried = Pulse(self.problem.emit, "controller", unit="designs"), itertools.count(1)
        return lambda text, best=None: pulse(next(tried), best, text=text)

    def wanted(self, step: int = 0) -> tuple[Array, Array]:
        """The reference at a step of a run in the frame, and how much each of it matters."""
        now = requirements.at(self.options.reference, step, self.problem.model.period)
        return requirements.wanted(now, self.problem.domain.axes, self.frame)

    def weights(self, stages: Stages) -> Weights:
        cost = np.array([float(self.options.weights.get(axis.name, 1.0)) for axis in self.problem.domain.axes])
        nx = self.frame.nx
        R = np.maximum(cost[nx:], 1e-6)
        Q = np.maximum(cost[:nx], 1e-6)
        X = riccati(stages.A[-1], stages.B[-1], Q, R)
        # The scale of a cost is free; near 1 the solvers find their step sizes best.
        soft = [max(given.linear, given.quadratic) for given in self.options.soft.values()]
        scale = 1 / max(np.abs(X).max(), Q.max(), R.max(), *soft)
        return Weights(np.diag(Q) * scale, np.diag(R) * scale, X * scale, np.eye(nx) * THRESHOLDS.rest_weight * scale)

    def drawn(self, rng: np.random.Generator, count: int) -> Array:
        """States of the goal."""
        low, high = np.asarray(self.problem.goal.stay.low), np.asarray(self.problem.goal.stay.high)
        return np.asarray(low + (high - low) * rng.random((count, len(low))))

    def nothing(self, reason: str) -> MpcController:
        """The controller that wins nowhere."""
        evidence = self.problem.basis | {"reason": reason, "domain_fraction": 0.0}
        return MpcController(self.problem.goal, None, evidence)

    def weak(self, reason: str, enough: Callable[[Task], bool]) -> MpcController:
        """`nothing`, with what is to blame where that is the inputs: whether γ = 0 would do, else the ranges that then suffice.

        enough: is there a controller for a task that differs in its inputs, and has no gap?
        """
        problem, domain = replace(self.problem, gap=None), self.problem.domain

        def held(inputs: Box) -> bool:
            with suppress(UsageError):  # about wider inputs a line may be one that no gain stabilises
                return enough(replace(self, problem=replace(problem, domain=replace(domain, inputs=inputs))))
            return False

        if held(domain.inputs):
            return self.nothing(reason if self.problem.gap is None else f"{reason}; for γ = 0 there would be a controller")
        if (wider := sufficient(held, domain.inputs)) is None:
            return self.nothing(f"{reason}; for γ = 0, inputs {FAR} times as wide do not help either")
        names = " and ".join(domain.inputs.names)
        told = f"the inputs are too weak, for γ = 0 too, where {ranges(wider, domain.inputs)} suffices"
        made = self.nothing(f"{names}: {told}; {reason}")
        return replace(made, evidence={**made.evidence, "change": {"inputs": wider.bounds}})

    def unbounded(self, stages: Stages) -> str | None:
        """Why there can be no tube at all."""
        known = np.isfinite(stages.c).all(axis=0)
        if known.all():
            return None
        name = self.names[int(np.flatnonzero(~known)[0])]
        return f"what is left of {name} after the nominal model is unbounded over the goal; narrow the goal"

    def unstable(self, stages: Stages) -> str | None:
        """Why no tube can shrink."""
        if (lost := unreached(stages.A[-1], stages.B[-1])) is None:
            return None
        mode = self.names[int(np.argmax(lost[1]))]
        return f"no gain stabilises {mode}: it grows by {lost[0]:.4g} per step, and no input reaches it"
