"""Games on the circle: an adversary who lands beside the edges of cells and of the turn, up to twenty turns away."""

import functools
import itertools
from typing import Any

import numpy as np
import pytest

import gapcert as gc
from gapcert import Box, Domain, Goal, Region
from gapcert.numerics import circle
from gapcert.numerics.circle import TURN
from gapcert_cells import GridController
from gapcert_cells.testing import Band

AWAY = 20


def plant(h: str, w: str) -> gc.Model:
    section = {"kind": "equations", "states": {"h": {"unit": "rad", "kind": "angle"}, "w": "1"}, "inputs": {"u": "1"}}
    section |= {"next": {"h": h, "w": w}, "period": "0.1 s"}
    return gc.load_spec({"version": 1, "name": "seams", "model": section}).build("model")


def drawn(seed: int) -> tuple[gc.SynthesisProblem, dict[str, Any]]:
    """A plant that repeats, a band, and a goal on a turn that begins anywhere, with a target or an obstacle at its seam."""
    rng = np.random.default_rng(seed)
    a, b, c, d = rng.uniform([-0.2, 0.3, -0.3, 0.4], [0.2, 0.6, 0.3, 0.8])
    sign, m, n = ("", "-")[seed % 5 == 4], *rng.integers(1, 4, 2)
    model = plant(f"{sign}h + {b}*u + {a}*w + {0.1 * c}*sin({m}*h)", f"0.5*w + {c}*cos({n}*h) + {d}*u")
    low = float(rng.choice([0.0, -np.pi, rng.uniform(-7, 7)]))
    domain = Domain.of(model, {"h": (low, low + TURN), "w": (-1.0, 1.0), "u": (-1.0, 1.0)})
    away, half = low + TURN * int(rng.integers(-10, 11)), rng.uniform(0.2, 0.6)
    at = Region((Box(model.states, (away - half, -1.0), (away + half, 1.0)),))
    goals = [Goal("invariance", domain.states, None, at), Goal("reach_avoid", domain.states, at)]
    gamma = rng.uniform(1e-4, 0.02, 2)
    gap = Band(tuple(-gamma), tuple(gamma * rng.uniform(0.5, 1, 2)))
    cells = {"h": int(rng.integers(20, 60)), "w": int(rng.integers(9, 20))}
    return gc.SynthesisProblem(model, gap, domain, goals[seed % 2]), {"cells": cells, "inputs": {"u": int(rng.integers(5, 12))}}


@functools.cache
def made(seed: int) -> tuple[gc.SynthesisProblem, GridController]:
    problem, options = drawn(seed)
    return problem, gc.registry().get("synthesizer", "symbolic").load()(**options).synthesize(problem)


def landings(c: GridController, low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(n, k, nx): corners of boxes that a step may end in, and the cell edges in them, on the turn of the box, ± 1 float."""
    ends = np.stack([low, high])
    found = [np.stack([ends[s, :, j] for j, s in enumerate(side)], axis=1) for side in itertools.product((0, 1), repeat=2)]
    for _ in range(8):
        x = low + (high - low) * rng.random(low.shape)
        for j, edges in enumerate(c.edges):
            turn = TURN * circle.turns(x[:, j], (edges[0] + edges[-1]) / 2) if j == 0 else 0.0
            near = edges[np.abs(x[:, j, None] - turn[:, None] - edges if j == 0 else x[:, j, None] - edges).argmin(axis=1)]
            for edge in (near + turn, np.nextafter(near + turn, rng.choice([-99.0, 99.0], len(x)))):
                there = (low[:, j] <= edge) & (edge <= high[:, j]) & (rng.random(len(x)) < 0.8)
                x[there, j] = edge[there]
        found.append(x)
    return np.stack(found, axis=1)


def begun(c: GridController, rng: np.random.Generator, n: int) -> np.ndarray:
    """Winning states, many of them at edges, on any turn."""
    x = c.draw(8 * n, rng)
    edge = rng.random(len(x)) < 0.5
    x[edge, 0] = rng.choice(c.edges[0], int(edge.sum()))
    x[:, 0] += TURN * rng.integers(-AWAY, AWAY + 1, len(x))
    x[:, 0] += rng.integers(-2, 3, len(x)) * np.spacing(np.abs(x[:, 0]))
    return x[c.contains(x)][:n]


def played(problem: gc.SynthesisProblem, c: GridController, n: int, steps: int, seed: int) -> tuple[int, int]:
    """(steps that were made, steps after which something promised does not hold)."""
    rng, goal, broken, count = np.random.default_rng(seed), problem.goal, 0, 0
    x = begun(c, rng, n)
    for k in range(steps):
        x = x[~goal.reached(x)]
        if not len(x):
            x = begun(c, rng, n)
            x = x[~goal.reached(x)]
        u = c.act(x, "random", seed, k)
        z, f = np.hstack([x, u]), problem.model.step(x, u).x
        low, high = problem.gap.interval(z)
        ends = landings(c, f + low, f + high, rng)
        value = c.value(ends.reshape(-1, 2)).reshape(ends.shape[:2])
        broken += int((value < 0).sum() + (~goal.holds(ends.reshape(-1, 2))).sum())
        if goal.kind == "reach_avoid":
            broken += int((value >= c.value(x)[:, None]).sum())
            broken += int(((value == 0) != goal.visited(ends.reshape(-1, 2)).reshape(value.shape))[value == 0].sum())
        count += value.size
        score = np.where(value < 0, np.inf, value + rng.random(value.shape))
        x = ends[np.arange(len(x)), score.argmax(axis=1)]
        x = x[(score.max(axis=1) < np.inf) & (np.abs(x[:, 0]) < TURN * AWAY)]
    return count, broken


@pytest.mark.exam
@pytest.mark.parametrize("seed", range(10))
def test_nobody_breaks_a_promise_at_a_seam(seed: int) -> None:
    problem, c = made(seed)
    assert c.wraps == (True, False)
    if not c.evidence["winning_cells"]:
        return
    count, broken = played(problem, c, 200, 25, seed)
    assert count > 10_000
    assert broken == 0


def test_most_of_these_games_are_won() -> None:
    """That the test above is about something."""
    won = [made(seed)[1].evidence["winning_cells"] > 0 for seed in range(10)]
    assert sum(won) >= 6


def test_an_adversary_without_bounds_is_caught() -> None:
    """The games do see a promise that is broken: by a plant that answers beyond the band, by one that forgets the turn."""
    for seed in (s for s in range(10) if made(s)[1].evidence["winning_cells"]):
        problem, c = made(seed)
        wide = gc.SynthesisProblem(problem.model, Band((-0.5, -0.5), (0.5, 0.5)), problem.domain, problem.goal)
        assert played(wide, c, 50, 4, seed)[1] > 0


SPRING = {
    "version": 1,
    "name": "spring",
    "model": {
        "kind": "equations",
        "states": {"h": {"unit": "rad", "kind": "angle"}},
        "inputs": {"u": "1"},
        "next": {"h": "0.93*h + 0.25*u"},
        "period": "0.1 s",
    },
}


def test_without_the_gate_a_deterministic_certificate_breaks(tmp_path, monkeypatch) -> None:
    """A spring that counts turns: certified over a turn, and a run that begins on another one leaves the goal for good."""
    f = gc.load_spec(SPRING).build("model")
    domain = Domain.of(f, {"h": (-np.pi, np.pi), "u": (-1.0, 1.0)})
    goal = Goal("invariance", domain.states, None, Region((Box(f.states, (2.6,), (3.6,)),)))
    options = {"lipschitz": gc.registry().build("lipschitz", "interval"), "sampling": gc.AdaptiveSampling(30)}
    options |= {"request": gc.Request("deterministic", 0.1, 0.1)}
    symbolic = gc.registry().get("synthesizer", "symbolic").load()(cells={"h": 60}, inputs={"u": 9})
    with pytest.raises(gc.UsageError, match=r"moves h by 0\.93 turns"):
        gc.certify(f, f, domain, folder=tmp_path / "refused", **options)
    with pytest.raises(gc.UsageError, match=r"moves h by 0\.93 turns"):
        symbolic.synthesize(gc.SynthesisProblem(f, None, domain, goal))
    monkeypatch.setattr("gapcert.certification.certify.repeating", lambda *given: ())
    monkeypatch.setattr(type(f), "repeats", lambda self, angle: "")
    made = gc.certify(f, f, domain, folder=tmp_path / "made", **options)
    assert made.claim.kind == "deterministic"
    c = symbolic.synthesize(gc.SynthesisProblem(f, made.gap, domain, goal))
    x = c.draw(200, np.random.default_rng(0)) + TURN * 3
    assert c.contains(x).all()
    for k in range(40):
        x = x[c.contains(x)]
        x = f.step(x, c.act(x, "first", 0, k)).x
    assert len(x[c.contains(x)]) < 100
