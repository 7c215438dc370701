"""Controllers whose plans end around a steady pair, under one gain, along one straight line or along lines of their own."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from gapcert.plugin import Array, Interval
from gapcert_mpc.controller import MpcController, looked
from gapcert_mpc.planning.design import Course, Design
from gapcert_mpc.planning.requirements import limits, moments, preferred
from gapcert_mpc.planning.successive import Ending
from gapcert_mpc.program.linearise import Frame, Nominal, Stages
from gapcert_mpc.program.program import NotShrinking
from gapcert_mpc.program.solver import Name
from gapcert_mpc.program.tube import Section, taken, tightest
from gapcert_mpc.program.tuning import Tuning, tuned
from gapcert_mpc.task import Task
from gapcert_mpc.thresholds import THRESHOLDS


def regulating(task: Task, like: MpcController | None = None) -> MpcController:
    """For invariance. like: a controller whose gain and solver it has, and what else need not be found again."""
    problem, options, nominal = task.problem, task.options, task.nominal
    design = _planned(task, like)
    if isinstance(design, str):
        return task.nothing(design) if like is not None else task.weak(design, _wins)
    evidence = problem.basis | _evidence(task, design)
    name: Name = "piqp"
    if like is not None and like.design is not None:
        name, design = like.solver, replace(design, tuning=replace(like.design.tuning, pieces=Tuning().pieces))
    elif not design.successive and options.feedback == "fixed":
        aim = design.reference[: task.frame.nx]
        name, tuning, samples = tuned(design.program(), aim, options.solver, problem.seed, task.tell)
        design = replace(design, tuning=tuning)
        evidence["solver"] = {"first": name, "pieces": len(tuning.pieces), "tuned_on": samples}
    elif options.solver != "auto":
        name = options.solver
    made = MpcController(problem.goal, design, {}, name, nominal=nominal if design.successive else None)
    x = task.drawn(np.random.default_rng(problem.seed), task.starts)
    evidence["domain_fraction"] = float(looked(made, x, problem.emit).mean())
    return replace(made, evidence=evidence)


def _wins(task: Task) -> bool:
    """From one of some states at least, without a tuned solver."""
    if isinstance(design := _planned(task), str):
        return False
    made = MpcController(task.problem.goal, design, {}, "piqp", nominal=task.nominal if design.successive else None)
    x = task.drawn(np.random.default_rng(task.problem.seed), min(task.starts, THRESHOLDS.starts))
    return bool(looked(made, x, task.problem.emit).any())


def _planned(task: Task, like: MpcController | None = None) -> Design | str:
    """What plans are made of, with a steady pair around which they can end; or why there is none."""
    problem, options, frame, nominal = task.problem, task.options, task.frame, task.nominal
    box, whole, rates = task.box, task.whole, limits(options.rates, problem.domain, frame.u[1])
    task.tell("successors along the model's lines")
    if options.linearisation == "successive":
        ending = Ending.about(nominal, frame, *task.wanted(), whole[len(task.names) :], options.horizon)
        stages, section, shares = ending.stages, ending.section, ending.shares
    else:
        constant = options.majorant != "affine" if like is None else not _follows(like)
        stages = nominal.straight(box.low, box.high, options.horizon, frame, constant, like is None)
    if (reason := task.unbounded(stages) or task.unstable(stages)) is not None:
        return reason
    if options.linearisation == "once":
        task.tell("gain and section of the tube")
        section, shares = _section(stages, whole, like, rates)
        if like is None and options.majorant == "auto" and not (shares < THRESHOLDS.small_tube).all():
            stages = nominal.straight(box.low, box.high, options.horizon, frame)
            section, shares = _section(stages, whole, like, rates)
    if not (shares < 1).all():
        return _too_wide(task, section, shares)
    task.tell("terminal set and steady state", {"largest share that the tube takes": float(np.max(shares))})
    return _design(task, stages, section, rates)


def _follows(made: MpcController) -> bool:
    """Does its tube follow how γ depends on the plan?"""
    return made.design is not None and bool(made.design.stages.G.any())


def _section(stages: Stages, rows: Array, like: MpcController | None, rates: Array | None) -> tuple[Section, Array]:
    """With the gain of another controller, where one is given."""
    if like is None or like.design is None:
        return tightest(*stages.first, rows, rates=rates)
    A, B, c, G = stages.first
    section = Section.of(A, B, like.design.section.K)
    return section, taken(section, c, G, rows, rates=rates)


def _design(task: Task, stages: Stages, section: Section, rates: Array | None) -> Design | str:
    options, domain, frame = task.options, task.problem.domain, task.frame
    steps = moments(options.reference, task.problem.model.period)
    weights, successive, nowhere = task.weights(stages), options.linearisation == "successive", np.zeros(len(frame.half))
    soft = preferred(options.soft, domain, frame, weights.T[0, 0] / THRESHOLDS.rest_weight)
    design = Design(frame, stages, section, task.rows, weights, nowhere, options.tolerance, successive, rates=rates)
    try:
        program = design.program()
    except NotShrinking as error:
        return f"the tube grows without end: by {error.args[0]:.4g} per step; narrow the goal, or shorten the period"
    found = [program.target(*task.wanted(step)) for step in steps]
    if (first := found[0]) is None:
        reason = "no steady state keeps its tube within the goal; widen the goal, or give the input more authority"
        return reason if successive else f"{reason}, or use {_HINT}"
    course = Course(np.array(steps), np.array(found)) if len(found) > 1 else None
    return replace(design, reference=first, course=course, soft=soft)


def _evidence(task: Task, design: Design) -> dict[str, Any]:
    program, frame = design.program(), task.frame
    base, _, per = program.terminal
    away = np.abs(design.reference - design.stages.centre[-1])
    size = base + per @ away[program.on]
    x, u = design.reference[: frame.nx], design.reference[frame.nx :]
    moves = {} if design.course is None else {"schedule": design.course.shown(frame, task.names, task.problem.model.period)}
    return moves | {
        "horizon": task.options.horizon,
        "terminal_margin": margin(task.nominal, frame, design.section, x, u, size),
        "tube": task.named(design.section.support @ size * frame.half),
        "reference": task.named(frame.out(design.reference)),
    }


def _too_wide(task: Task, section: Section, shares: Array) -> str:
    names, frame, successive = task.names, task.frame, task.options.linearisation == "successive"
    if not np.isfinite(shares).all():
        reason = f"no gain keeps the tube from growing without end (the best spectral radius is {section.radius:.4g})"
        return reason if successive else f"{reason}; {_HINT}"
    j = int(np.argmax(shares))
    if successive:
        named = names[j] if j < len(names) else "a relation"
        return f"at rest the tube needs {shares[j]:.3g} times the room that there is for {named}; a tighter γ would help"
    if (i := j - len(task.whole)) >= 0:
        input_ = names[frame.nx + i]
        return f"the feedback alone takes {shares[j]:.3g} times the rate of {input_}; a tighter γ or a higher rate would help"
    room = f"the tube needs ± {shares[j] * frame.half[j]:.4g} of {names[j]}" if j < len(names) else "the tube breaks a relation"
    goal = f", and the goal leaves ± {frame.half[j]:.4g}" if j < len(names) else ""
    return f"{room}{goal}; a tighter γ, a shorter period or a wider goal would help, or {_HINT}"


_HINT = "`linearisation: successive`, which makes the model straight about each plan alone"


def margin(nominal: Nominal, frame: Frame, section: Section, x: Array, u: Array, size: Array) -> float:
    """min_i 1 − b_i / σ_i; positive proves {|H(ξ − x)| ≤ σ} robustly invariant under u + K(ξ − x), all in the frame.

    With z_s = (x, u), ξ = x + e, the mean value theorem gives F(ξ, ·) − F(z_s) = M e, M in the hull of F′ [I; K] over the set,
    and |H(F − x + g)| ≤ |ΛHe| + |(HM − ΛH) e| + |H(F(z_s) − x)| + |H| γ̄ ≤ b for any Λ: γ̄ bounds what is left over the set.
    Intervals are rounded outwards, and the linearisation that made the set is not trusted.
    """
    H, P, K, n = section.H, section.P, section.K, len(x)
    # |e| ≤ |P||He| + |I − PH||e|: the second is rounding, and solved for.
    defect = (Interval.exact(np.eye(n)) - _product(P, H)).mag.sum(axis=1).max()
    if not defect < 0.5:
        return -np.inf
    wide = _times(P, size)
    spare = np.full(n, wide.max() * (2 * defect + 1e-12))
    e = wide + spare
    # K e = KP He + K (I − PH) e, and |KP||He| may be far below |K||P||He|.
    away = np.concatenate([e, _times(_product(K, P).mag, size) + _times(K, spare)]) * (1 + 1e-12)
    z = np.concatenate([x, u])
    middle, half = Interval.exact(frame.middle), Interval.exact(frame.half)
    box = (middle + half * Interval.around(z, away))[None]
    at = (middle + half * Interval.exact(z))[None]
    x_half, x_middle = Interval.exact(frame.x[1]), Interval.exact(frame.x[0])
    J = nominal.slopes(box)[0] * half / x_half.reshape(n, 1)
    M = J[:, :n] + (J[:, n:, None] * Interval.exact(K)[None]).sum(1)
    lost = (Interval.exact(H)[:, :, None] * M[None]).sum(1)
    moved = section.moved + H @ (M.mid - section.closed) @ P
    rest = (lost - _product(moved, H)).mag
    # Together: what is left may lie on one side, and x be steady with the middle of it.
    off = ((nominal.enclosed(at)[0] + nominal.left(box)[0] - x_middle) / x_half - Interval.exact(x)).mag
    bound = _times(moved, size) + _times(rest, e) + _times(H, off)
    return float((1 - bound / size).min())


def _product(A: Array, B: Array) -> Interval:
    """Contains A B."""
    return (Interval.exact(A)[:, :, None] * Interval.exact(B)[None]).sum(1)


def _times(A: Array, b: Array) -> Array:
    """≥ |A| b."""
    return np.asarray((Interval.exact(np.abs(A)) * Interval.exact(b)).sum(1).hi)
