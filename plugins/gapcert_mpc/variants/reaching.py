"""Controllers that reach a target: corridors are searched for once, and each step solves one quadratic program."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gapcert.plugin import Array, Pulse
from gapcert_mpc.controller import MpcController, looked
from gapcert_mpc.planning.arrival import Arrival
from gapcert_mpc.planning.design import Design
from gapcert_mpc.planning.engine import Engine
from gapcert_mpc.program.corridors import scene
from gapcert_mpc.program.solver import Name
from gapcert_mpc.program.tube import passing
from gapcert_mpc.task import Task
from gapcert_mpc.thresholds import THRESHOLDS


def reaching(task: Task) -> MpcController:
    """For reach-avoid; what is known of corridors is part of the design."""
    problem, options, frame = task.problem, task.options, task.frame
    goal, nx, searches, horizon = problem.goal, frame.nx, options.searches, options.horizon
    task.tell("successors along the model's lines")
    stages, F = task.nominal.featured(task.zone, horizon, frame, options.majorant == "constant")
    if (reason := task.unbounded(stages)) is not None:
        return task.nothing(reason)
    rows, areas = scene(goal, frame, task.rows, F)
    # A tube has to pass into a target, which may be much smaller than the room that it is in.
    room = np.minimum((areas.high - areas.low)[:, :nx].max(axis=0, initial=0.0) / 2, 1.0)
    tight = np.flatnonzero((room > 0) & (room < 1))
    whole = np.vstack([task.whole, np.eye(len(frame.half))[tight] / room[tight, None]])
    section = passing(stages, F, whole)
    rest = np.clip(frame.into(np.zeros(len(frame.half))), -1.0, 1.0)
    design = Design(frame, stages, section, rows, task.weights(stages), rest, options.tolerance, scene=areas)
    rng = np.random.default_rng(problem.seed)
    solver: Name = "osqp" if options.solver == "auto" else options.solver
    arrival, tell = Arrival(Engine(design, solver), areas), Pulse(problem.emit, "controller", searches, "searches", "corridors")
    pool = arrival.explored(rng.uniform(-1.0, 1.0, (4 * searches, nx)), searches, tell)
    if not len(pool.arrival):
        return task.nothing(f"from none of {searches} starts a plan of {horizon} steps reaches the target with its whole tube")
    made = MpcController(goal, replace(design, pool=pool), {}, solver)
    fraction = float(looked(made, task.drawn(rng, min(task.starts, THRESHOLDS.starts)), problem.emit).mean())
    tube = half_widths(design)
    evidence = {
        "horizon": horizon,
        "corridors": len(pool.arrival),
        "domain_fraction": fraction,
        "tube": task.named(tube.max(axis=0)),
        "tube_at_end": task.named(tube[-1]),
    }
    return replace(made, evidence=problem.basis | evidence)


def half_widths(design: Design) -> Array:
    """(N + 1, n + m), in the model's units: the tube around a plan at rest, before γ of a motion widens it."""
    return np.asarray(design.program().tube() @ design.section.support.T * design.frame.half)
