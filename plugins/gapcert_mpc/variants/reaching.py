"""Controllers that reach a target: corridors are searched for once, and each step solves one quadratic program."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gapcert import Array, Domain, SynthesisProblem
from gapcert.plugin import Pulse
from gapcert_mpc.controller import Design, Engine, MpcController, looked
from gapcert_mpc.program.corridors import scene
from gapcert_mpc.program.features import featured, passing
from gapcert_mpc.program.linearise import Frame, Nominal, Stages
from gapcert_mpc.program.program import Rows, Weights
from gapcert_mpc.program.solver import Choice, Name

from .arrival import explored

STARTS = 64


def reaching(
    problem: SynthesisProblem,
    frame: Frame,
    nominal: Nominal,
    whole: Array,
    rows: Rows,
    horizon: int,
    constant: bool,
    weights: Callable[[Stages, Domain], Weights],
    tolerance: float,
    choice: Choice,
    searches: int,
    starts: int,
) -> MpcController:
    """For reach-avoid; what is known of corridors is part of the design."""
    goal, domain, nx = problem.goal, problem.domain, frame.nx
    names = domain.states.names + domain.inputs.names
    zone = Domain(goal.stay, domain.inputs, domain.relations)
    stages, F = featured(nominal, zone, horizon, frame, constant)

    def nothing(reason: str) -> MpcController:
        return MpcController(goal, None, problem.basis | {"reason": reason, "domain_fraction": 0.0})

    if (lost := np.flatnonzero(~np.isfinite(stages.c[0]))).size:
        name = names[int(lost[0])]
        return nothing(f"what is left of {name} after the nominal model is unbounded over the goal; narrow the goal")
    rows, areas = scene(goal, frame, rows, F)
    # A tube has to pass into a target, which may be much smaller than the room that it is in.
    room = np.minimum((areas.high - areas.low)[:, :nx].max(axis=0, initial=0.0) / 2, 1.0)
    tight = np.flatnonzero((room > 0) & (room < 1))
    whole = np.vstack([whole, np.eye(len(names))[tight] / room[tight, None]])
    section = passing(stages.A[0], stages.B[0], stages.c[0], stages.G[0], F, whole, horizon)
    rest = np.clip(frame.into(np.zeros(len(names))), -1.0, 1.0)
    design = Design(frame, stages, section, rows, weights(stages, domain), rest, tolerance, scene=areas)
    rng = np.random.default_rng(problem.seed)
    solver: Name = "osqp" if choice == "auto" else choice
    engine = Engine(design, solver)
    design = replace(
        design,
        pool=explored(
            engine,
            rng.uniform(-1.0, 1.0, (4 * searches, nx)),
            searches,
            Pulse(problem.emit, "controller", searches, "searches", "corridors"),
        ),
    )
    if not len(design.pool.arrival):  # type: ignore[union-attr]
        return nothing(f"from none of {searches} starts a plan of {horizon} steps reaches the target with its whole tube")
    made = MpcController(goal, design, {}, solver)
    low, high = np.asarray(goal.stay.low), np.asarray(goal.stay.high)
    fraction = float(looked(made, low + (high - low) * rng.random((min(starts, STARTS), nx)), problem.emit).mean())
    tube = half_widths(made.design)  # type: ignore[arg-type]
    evidence = problem.basis | {
        "horizon": horizon,
        "corridors": len(design.pool.arrival),  # type: ignore[union-attr]
        "domain_fraction": fraction,
        "tube": dict(zip(names, tube.max(axis=0).tolist(), strict=True)),
        "tube_at_end": dict(zip(names, tube[-1].tolist(), strict=True)),
    }
    return replace(made, evidence=evidence)


def half_widths(design: Design) -> Array:
    """(N + 1, n + m), in the model's units: the tube around a plan at rest, before γ of a motion widens it."""
    assert design.scene is not None, "who reaches a target knows its scene"
    size = design.program().tube(np.zeros((design.stages.horizon + 1, len(design.scene.F))))
    return np.asarray(size @ design.section.support.T * design.frame.half)
