"""Robust MPC: one step against the same program in CVXPY with Clarabel and in solvers alone; runs at once; multi-stage MPC.

Each case is run in closed loop under disturbances anywhere in its gap, from random starts, and the states of each run are
given to all in turn. Ours is what a run asks of a controller at each state: `advance` (pieces, else the solver; rows checked;
the plan taken out of the answer), `keeps` and `respond`. CVXPY is given x̄₀ as a parameter of a problem compiled before (DPP),
its rows written from the formulas, all stages at once. A solver alone is given the rows and the tolerance of ours, and its
bounds are updated in place; OSQP starts from the answer before, shifted. Times are seconds of CPU of one thread; medians, and
the 99th percentile over the median. `--do-mpc FOLDER`, the site-packages of an environment with do-mpc 5.1.2 and casadi, adds
its multi-stage controller.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import statistics
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"

import harness
import numpy as np
import osqp

sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))
from peers.mpc_multistage import MultiStage
from tube_designs import mecanum, with_pieces
from tube_program import twin

import gapcert as gc
from gapcert_cells.testing import Band, Rod, rod_problem
from gapcert_mpc.controller import MpcController
from gapcert_mpc.planning.design import Design
from gapcert_mpc.planning.engine import Engine
from gapcert_mpc.program.solver import solver
from gapcert_mpc.synthesizer import Mpc

Array = np.ndarray
GAP = Band((-1.5e-4, -6e-5), (1.5e-4, 6e-5))
DIGITS = 1e-4  # to which first inputs and costs must agree


@dataclass(frozen=True)
class Case:
    """A controller, and a plant of its own in its frame: x⁺ = Ax + Bu + d + w."""

    name: str
    controller: MpcController
    every: int

    @property
    def design(self) -> Design:
        assert self.controller.design is not None
        return self.controller.design

    def moved(self, x: Array, u: Array, rng: np.random.Generator) -> Array:
        st, z = self.design.stages, np.concatenate([x, u])
        wide = st.c[0] + st.G[0] @ np.abs(z - st.centre[0])
        return np.asarray(st.A[0] @ x + st.B[0] @ u + st.d[0] + wide * rng.uniform(-1, 1, len(x)))


def pendulum() -> Case:
    made = Mpc(horizon=40, reference={"theta": 0.15}, majorant="constant")
    controller = made.synthesize(rod_problem(gap=GAP))
    assert isinstance(controller, MpcController)
    return Case("pendulum, N = 40, constant tube", controller, 20)


def square() -> Case:
    design = with_pieces(mecanum())
    axes = tuple(gc.StateSpec(name, "m") for name in "xy")
    goal = gc.Goal("invariance", gc.Box(axes, (-1.0, -1.0), (1.0, 1.0)))
    return Case("mecanum, N = 15, variable tube", MpcController(goal, design, {}), 20)


def without_pieces(controller: MpcController) -> MpcController:
    design = controller.design
    assert design is not None
    none = replace(design.tuning, pieces=design.tuning.pieces[:0])
    return replace(controller, design=replace(design, tuning=none))


class Ours:
    """A run of a controller, state by state."""

    def __init__(self, controller: MpcController) -> None:
        self.controller, self.memory = controller, np.zeros(1, dtype=np.int64)
        self.middle, self.half = controller.design.frame.x if controller.design else (0.0, 1.0)

    def begin(self, x: Array) -> None:
        self.memory = self.controller.start(self.middle + self.half * x[None])

    def step(self, x: Array) -> Array:
        rows = self.middle + self.half * x[None]
        self.memory = self.controller.advance(rows, self.memory)
        if not self.controller.keeps(rows, self.memory)[0]:
            raise SystemExit(f"mpc: the promise was broken at {x}")
        return self.controller.respond(rows, self.memory, "first")[0]

    def plan(self) -> Array:
        held = self.controller.memory[int(self.memory[0])]
        assert held is not None
        return held[0].z


class Alone:
    """A solver with the rows of ours and no more: bounds updated in place, and solved."""

    def __init__(self, design: Design, name: Any, *, plain: bool = False) -> None:
        self.program = p = design.program()
        self.later, self.last = p.shifted(), None
        own = {"rho": design.tuning.rho, "alpha": design.tuning.alpha} if name == "osqp" else {}
        self.solver = solver(name, p.qp, p.tolerance, **own)
        if plain:
            made = self.solver.osqp = osqp.OSQP()
            made.setup(*p.qp, verbose=False, eps_abs=p.tolerance / 2, eps_rel=0.0)
        elif name == "osqp":
            self.solver.osqp.update_settings(max_iter=4000)

    def begin(self, x: Array) -> None:
        self.last = None
        self.step(x)

    def step(self, x: Array) -> Array:
        p = self.program
        p.begin(x)
        self.solver.update(p.qp)
        guess = self.later[2:] if self.last is None else (self.last.z[self.later[0]], self.last.y[self.later[1]])
        self.last = self.solver.solve(*guess)
        return self.last.z


def met(case: Case, runs: int, steps: int) -> list[Array]:
    """States (steps, n) of each run in the frame, under our controller."""
    ours, rng, out = Ours(case.controller), np.random.default_rng(7), []
    n, (middle, half) = case.design.frame.nx, case.design.frame.u
    while len(out) < runs:
        x = rng.uniform(-0.9, 0.9, n)
        ours.begin(x)
        if not ours.memory[0]:
            continue
        seen = [x]
        for _ in range(steps - 1):
            seen.append(case.moved(seen[-1], (ours.step(seen[-1]) - middle) / half, rng))
        out.append(np.array(seen))
    return out


def timed(call: Callable[[Array], Any], x: Array) -> tuple[Any, float]:
    start = time.thread_time()
    out = call(x)
    return out, time.thread_time() - start


def cost(design: Design, z: Array) -> float:
    p, w, n = design.program(), design.weights, design.frame.nx
    x, u = design.reference[:n], design.reference[n:]
    fixed = p.N * (x @ w.Q @ x + u @ w.R @ u) + x @ w.P @ x + x @ w.T @ x
    return float(z @ p.P @ z - 0.5 * z @ (p.P.diagonal() * z) + p.q @ z + fixed)


def apart(case: Case, u: Array, z: Array, first: Array, best: float) -> float:
    """By how much a step differs from the peer's in its input, in the frame, or its cost."""
    middle, half = case.design.frame.u
    off = max(float(np.abs((u - middle) / half - first).max()), abs(cost(case.design, z) - best))
    if off > DIGITS:
        raise SystemExit(f"mpc: {case.name}: first input or cost is off by {off:.3g}; expected at most {DIGITS}")
    return off


def stepped(case: Case, quick: bool) -> Iterator[harness.Row]:
    """All in turn on each run."""
    program = twin(case.design)
    _, first_call = timed(program.solve, case.design.reference[: case.design.frame.nx])
    start = time.thread_time()
    Engine(case.design, case.controller.solver)
    set_up = time.thread_time() - start
    who: dict[str, Any] = {"ours": Ours(case.controller), "ours, no pieces": Ours(without_pieces(case.controller))}
    who |= {name: Alone(case.design, name) for name in ("osqp", "piqp", "clarabel")}
    who["osqp plain"] = Alone(case.design, "osqp", plain=True)
    spent: dict[str, list[float]] = {name: [] for name in (*who, "cvxpy")}
    off, held = 0.0, list[bool]()
    for states in met(case, 10 if quick else 25, 100 if quick else 200):
        answers: dict[int, tuple[Array, Array]] = {}
        for name, one in who.items():
            one.begin(states[0])
            for k, x in enumerate(states[1:]):
                u, seconds = timed(one.step, x)
                spent[name].append(seconds)
                if name == "ours":
                    held.append(case.controller.engine.pieces(x) is not None)
                    if k % case.every == 0:
                        answers[k] = u, one.plan()
        for k, (u, z) in answers.items():
            (first, best), seconds = timed(program.solve, states[1 + k])
            spent["cvxpy"].append(seconds)
            off = max(off, apart(case, u, z, first, best))
    mid = {name: statistics.median(times) * 1e6 for name, times in spent.items()}
    peers = (
        ("cvxpy", "CVXPY, Clarabel"),
        ("osqp", "OSQP alone, with our step sizes"),
        ("osqp plain", "OSQP alone, its defaults"),
    )
    for key, peer in (*peers, ("piqp", "PIQP alone"), ("clarabel", "Clarabel alone")):
        yield harness.row(case.name, "step", "µs", mid["ours"], mid[key], peer)
    for key, peer in peers[:2]:
        yield harness.row(case.name, "step without pieces", "µs", mid["ours, no pieces"], mid[key], peer)
    for key, of in (("ours", ""), ("ours, no pieces", " without pieces")):
        p99, theirs = (np.percentile(spent[name], 99) / np.median(spent[name]) for name in (key, "cvxpy"))
        yield harness.row(case.name, f"99th percentile{of}, of the median", "1", float(p99), float(theirs), peers[0][1])
    yield harness.row(
        case.name, "99th percentile", "µs", *(float(np.percentile(spent[n], 99)) * 1e6 for n in ("ours", "osqp")), peers[1][1]
    )
    yield harness.Row(case.name, "steps that a piece answers", "%", 100 * statistics.mean(held), None, "", None)
    yield harness.row(case.name, "set-up", "ms", set_up * 1e3, first_call * 1e3, "CVXPY, its first call")
    yield harness.Row(case.name, "first input and cost, off by at most", "1", off, DIGITS, "what is allowed", None)


class Watch(threading.Thread):
    """Seconds that worker processes spend on a processor, and in the queue for one that others hold: Linux, schedstat."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.seen: dict[int, tuple[float, float]] = {}
        self.over = threading.Event()

    def run(self) -> None:
        while not self.over.wait(0.02):
            for process in multiprocessing.active_children():
                with contextlib.suppress(OSError):
                    spent, waited, _ = Path(f"/proc/{process.pid}/schedstat").read_text().split()
                    self.seen[process.pid or 0] = int(spent) * 1e-9, int(waited) * 1e-9

    def stopped(self) -> tuple[float, float]:
        self.over.set()
        self.join()
        return sum(s for s, _ in self.seen.values()), sum(w for _, w in self.seen.values())


def at_once(case: Case, quick: bool) -> Iterator[harness.Row]:
    """Runs of the pendulum in as many processes as there are processors."""
    runs, steps, cores = (200 if quick else 1000), 200, len(os.sched_getaffinity(0))
    x = case.controller.draw(4000, np.random.default_rng(3))
    x = np.resize(x, (runs, x.shape[1]))
    alone, bare = Alone(case.design, "osqp"), list[float]()
    for states in met(case, 5, 100):
        alone.begin(states[0])
        bare += [timed(alone.step, state)[1] for state in states[1:]]

    watch = Watch()
    watch.start()
    wall = time.perf_counter()
    trace = gc.closed_loop(Rod(), case.controller, x, steps, workers=cores)
    wall = time.perf_counter() - wall
    busy, waited = watch.stopped()
    if trace.violation.any():
        raise SystemExit("mpc: a run broke its promise")
    name, peer = f"pendulum, {runs:,} runs × {steps} steps, {cores} processes", "OSQP alone, with our step sizes"
    per = busy / (runs * steps) * 1e6
    yield harness.row(name, "CPU per step of the loop", "µs", per, statistics.median(bare) * 1e6, peer)
    yield harness.Row(name, "processors busy, of all time", "%", 100 * busy / (cores * wall), None, "", None)
    free = 100 * busy / (cores * wall - waited)
    yield harness.Row(name, "processors busy, of the time that others left", "%", free, None, "", None)
    yield harness.Row(name, "steps per second", "1/s", runs * steps / wall, None, "", None)


@dataclass(frozen=True)
class Scenario:
    """What the multi-stage controller is told, in the units of the rod but for the frame's weights."""

    frame: Any
    period: float
    weights: Any
    reference: Array
    low: Array
    high: Array


def multistage(case: Case, quick: bool, folder: Path | None) -> Iterator[harness.Row]:
    """From the same starts under the same corners of the gap: seconds per step, and what comes of the runs."""
    runs, steps, name = (20 if quick else 60), 60, "pendulum, N = 40, corners of the gap"
    x0 = np.random.default_rng(5).uniform((0.0, -0.25), (0.2, 0.25), (runs, 2))
    corners = np.where(np.random.default_rng(6).random((steps, 2)) < 0.5, GAP.low, GAP.high)
    controller, plant = case.controller, Rod()
    mine = controller.contains(x0)
    safe, spent = 0, []
    for x in x0[mine]:
        memory, x, kept = controller.start(x[None]), x[None], True
        for w in corners:
            start = time.thread_time()
            memory = controller.advance(x, memory)
            u = controller.respond(x, memory, "first")
            spent.append(time.thread_time() - start)
            x = plant.step(x, u).x + w
            kept &= bool(controller.goal.holds(x)[0])
        safe += kept
    peer: dict[str, float | None] = dict.fromkeys(("step", "first", "begins", "kept"))
    if folder is not None:
        sys.path.append(str(folder))
        peer |= _multistage(case, x0, corners)
    label = "do-mpc 5.1.2, multi-stage"
    yield harness.row(name, "step", "ms", statistics.median(spent) * 1e3, peer["step"], label)
    yield harness.row(name, "set-up and first step", "ms", _begun(case, x0[mine][0]) * 1e3, peer["first"], label)
    yield harness.Row(name, "starts for which it finds an input", "%", 100 * float(mine.mean()), peer["begins"], label, None)
    yield harness.Row(
        name, "of these, runs that keep to the goal", "%", 100 * safe / max(int(mine.sum()), 1), peer["kept"], label, None
    )


def _begun(case: Case, x: Array) -> float:
    start = time.thread_time()
    fresh = replace(case.controller)
    fresh.respond(x[None], fresh.start(x[None]), "first")
    return time.thread_time() - start


def _multistage(case: Case, x0: Array, corners: Array) -> dict[str, float]:
    start, plant = time.thread_time(), Rod()
    d = case.design
    them = MultiStage(Scenario(d.frame, plant.period, d.weights, d.reference, GAP.low, GAP.high), 40)
    them.begin(x0[0])
    them.step(x0[0])
    first, spent, begins, kept = time.thread_time() - start, list[float](), 0, 0
    for x in x0:
        them.begin(x)
        u, _ = them.step(x)
        begins += u is not None
        good = u is not None
        for w in corners if good else ():
            u, seconds = them.step(x)
            spent.append(seconds)
            good &= u is not None
            if not good:
                break
            x = (plant.step(x[None], u[None]).x + w)[0]
            good &= bool(case.controller.goal.holds(x[None])[0])
        kept += good
    shares = {"begins": 100 * begins / len(x0), "kept": 100 * kept / max(begins, 1)}
    return shares | {"step": statistics.median(spent) * 1e3, "first": first * 1e3}


def measure(options: argparse.Namespace) -> list[harness.Row]:
    rod, moving = pendulum(), square()
    rows = [row for case in (rod, moving) for row in stepped(case, options.quick)]
    return [*rows, *at_once(rod, options.quick), *multistage(rod, options.quick, options.do_mpc)]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--do-mpc", type=Path, metavar="FOLDER", help="site-packages with do-mpc and casadi")
    harness.main(measure, parser)
