"""A rod 30 % heavier than its data sheet, in PyBullet: what adaptive MPC learns of its mass, and what that is worth.

Peer: the same controller without learning, robust against all of the range. Then plants f ± γ whose γ is a random corner of the
gap, or hides the mass as well as it can; `lost` counts the steps at which the true mass lies outside of what was learned.
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import harness
import numpy as np

import gapcert as gc
from gapcert.contracts.plugins.events import silent
from gapcert.run.build import Build
from gapcert_cells.testing import Band
from gapcert_mpc.synthesizer import Mpc
from gapcert_mpc.variants.parameters import Membership

SPEC = Path(__file__).parents[1] / "specs" / "pendulum_adaptive.yaml"
TRUE = 1.3
WIDE = np.array([1e-4, 3e-3])
Plant = Callable[[np.ndarray, np.ndarray], np.ndarray]


def made(folder: Path) -> tuple[gc.System, gc.SynthesisProblem, Mpc]:
    spec = gc.load_spec(SPEC, ["certificate.attack=0", "sampling.executor=threads"])
    build = Build(spec, None, folder, False)
    model = build.make("model")
    backend, domain = build.against(model)
    gap = build.certify(model, backend, domain, folder, silent).gap
    synthesizer = build.make("controller")
    assert isinstance(synthesizer, Mpc)
    return backend, gc.SynthesisProblem(model, gap, domain, spec.goal(domain)), synthesizer


def played(c: gc.Controller, x: np.ndarray, steps: int, plant: Plant) -> tuple[np.ndarray, list[gc.Interval], int]:
    """(x (n, steps + 1, nx), Θ per step, steps that broke the promise)."""
    memory, seen, thetas, broken = c.start(x), [x], [], 0
    for k in range(steps):
        memory = c.advance(x, memory) if k else memory
        broken += int((~c.keeps(x, memory) | ~c.goal.holds(x)).sum())
        thetas.append(c.theta(memory))
        u = c.respond(x, memory, "first")
        after = plant(x, u)
        broken += int((~c.kept(x, u, after, memory)).sum())
        x = after
        seen.append(x)
    return np.stack(seen, axis=1), thetas, broken


def bullet(options: argparse.Namespace) -> list[harness.Row]:
    with tempfile.TemporaryDirectory() as folder:
        backend, problem, synthesizer = made(Path(folder))
    ours = synthesizer.synthesize(problem)
    fixed = gc.registry().build("synthesizer", "mpc", gc.registry().config("synthesizer", "mpc")(
        horizon=synthesizer.options.horizon, reference=synthesizer.options.reference, adapt=synthesizer.options.adapt, levels=0
    ))  # fmt: skip
    other = fixed.synthesize(problem)
    n, steps = (10, 40) if options.quick else (50, 150)
    x = ours.draw(4 * n, np.random.default_rng(0))[:n]

    def plant(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return backend.step(x, u).x

    traces, learned, broken = played(ours, x, steps, plant)
    still, _, failed = played(other, x, steps, plant)
    width = [float((t.hi - t.lo).max()) for t in learned]
    name = "the range at the start"
    out = [
        harness.row("PyBullet", f"widest m after {k} steps", "kg", width[k], width[0], name) for k in (1, 2, 5, 20, steps - 1)
    ]
    lost = sum(int(((t.lo > TRUE) | (t.hi < TRUE)).sum()) for t in learned)
    out.append(harness.row("PyBullet", f"lost, of {n} × {steps} steps", "steps", lost, None, "–"))
    out.append(harness.row("PyBullet", f"broken promises, of {n} × {steps} steps", "steps", broken, None, "–"))
    assert failed == 0, "the robust controller broke its promise"
    far = [float(np.abs(t[:, steps // 2 :, 0] - 0.05).mean()) for t in (traces, still)]
    out.append(harness.row("PyBullet", "mean distance from the reference, second half", "rad", *far, "no learning"))
    return out + domains(synthesizer, problem, options)


def domains(synthesizer: Mpc, problem: gc.SynthesisProblem, options: argparse.Namespace) -> list[harness.Row]:
    """What is won where less is unknown from the start; and what a level, and an update, cost."""
    ours = synthesizer.synthesize(problem)
    family, plain = ours.levels.family, Mpc(horizon=synthesizer.options.horizon, reference=synthesizer.options.reference)
    whole, out, x = float(ours.evidence["domain_fraction"]), [], ours.draw(64, np.random.default_rng(1))
    for half in (0.2, 0.1, 0.05, 0.01):
        box = gc.Interval(np.array([TRUE - half]), np.array([min(TRUE + half, 1.4)]))
        share = float(plain.synthesize(family.within(box)).evidence["domain_fraction"])
        text = f"domain, of the goal, for m in [{box.lo[0]:g}, {box.hi[0]:g}] kg"
        out.append(harness.row("domain", text, "share", share, whole, "[0.6, 1.4] kg", less_is_better=False))
    begin = time.process_time()
    keys = [((level, 0, 8),) for level in (1, 2, 3)]
    for key in keys:
        ours.levels[key]
    each = (time.process_time() - begin) / len(keys)
    u = ours.act(x)
    after = problem.model.step(x, u).x
    theta = gc.Interval(np.full((len(x), 1), 0.6), np.full((len(x), 1), 1.4))
    membership, memory = Membership(family), ours.first.start(x)
    update, solve = harness.alternate(
        lambda: membership.updated(x, u, after, theta), lambda: ours.first.advance(x, memory), repeats=3
    )
    out.append(harness.row("time", "a level, once", "s", each, None, "–"))
    out.append(harness.row("time", f"an update, each of {len(x)} at once", "s", update / len(x), solve / len(x), "a plan"))
    return out


def adversaries(options: argparse.Namespace) -> list[harness.Row]:
    with tempfile.TemporaryDirectory() as folder:
        _, problem, synthesizer = made(Path(folder))
    problem = replace(problem, gap=Band(-WIDE, WIDE))
    c = Mpc(
        horizon=synthesizer.options.horizon, reference=synthesizer.options.reference, adapt=synthesizer.options.adapt
    ).synthesize(problem)
    model, rng, n = problem.model, np.random.default_rng(2), 20 if options.quick else 100
    truth = rng.choice([0.6, 0.8, 1.0, 1.2, 1.3, 1.4], size=n)

    def f(x: np.ndarray, u: np.ndarray, m: np.ndarray) -> np.ndarray:
        return model.step(x, u, parameters={"m": m}).x

    def corners(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return f(x, u, truth) + (1 - 1e-12) * WIDE * rng.choice((-1.0, 1.0), x.shape)

    def hiding(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return f(x, u, truth) + (1 - 1e-12) * np.clip(f(x, u, np.full(n, 0.95)) - f(x, u, truth), -WIDE, WIDE)

    x, out, steps = np.empty((0, 2)), [], 20 if options.quick else 60
    while len(x) < n:
        x = np.concatenate([x, c.draw(200, rng)])[:n]
    for name, plant in (("corners of γ", corners), ("γ that hides m", hiding)):
        _, thetas, broken = played(c, x, steps, plant)
        lost = sum(int(((t.lo[:, 0] > truth) | (t.hi[:, 0] < truth)).sum()) for t in thetas)
        width = [float(np.median(t.hi - t.lo)) for t in thetas]
        start = "the range at the start"
        out += [
            harness.row(name, f"median width of m after {k} steps", "kg", width[k], width[0], start) for k in (1, 5, steps - 1)
        ]
        out.append(harness.row(name, f"lost, of {n} × {steps} steps", "steps", lost, None, "–"))
        out.append(harness.row(name, f"broken promises, of {n} × {steps} steps", "steps", broken, None, "–"))
    return out


def measure(options: argparse.Namespace) -> list[harness.Row]:
    return bullet(options) + adversaries(options)


if __name__ == "__main__":
    harness.main(measure, argparse.ArgumentParser(description=__doc__))
