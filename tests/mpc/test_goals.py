"""Reach-avoid with whole tubes: from wherever a plan begins, runs under the worst of γ arrive in time and touch nothing."""

from __future__ import annotations

import dataclasses
import itertools
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.optimize

from gapcert import Box, Domain, GapFunction, Goal, Interval, Region, StateSpec, SynthesisProblem, UsageError
from gapcert.contracts.systems.region import Ellipsoid, Polytope
from gapcert.numerics.constraint_zone import Relation
from gapcert_bounds.testing.fields import Field
from gapcert_cells.testing import Band
from gapcert_mpc.controller import MpcController
from gapcert_mpc.planning.plans import Plan
from gapcert_mpc.program.corridors import Scene, parts, within
from gapcert_mpc.program.linearise import Frame
from gapcert_mpc.synthesizer import Mpc
from gapcert_mpc.variants.reaching import half_widths

Array = np.ndarray
SLOPES = np.array([[1.0, 0, 0.3, 0], [0, 1.0, 0, 0.3]])


class Cart(Field):
    """p⁺ = p + 0.3 u in the plane."""

    def __init__(self) -> None:
        super().__init__(2, 2)

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        return np.hstack([x, u]) @ SLOPES.T

    def enclosure(self, z: Interval) -> Interval:
        return Interval.dot(z.reshape(len(z), 1, 4), SLOPES)

    def jacobian_enclosure(self, z: Interval) -> Interval:
        return Interval.exact(np.tile(SLOPES, (len(z), 1, 1)))


class Slip(GapFunction):
    """|r| ≤ a + b |u|: a base that slips the more the faster it is told to go."""

    family, kind = "slip", "slip"

    def __init__(self, a: float = 0.004, b: float = 0.06) -> None:
        self.a, self.b = a, b

    def interval(self, z: Array) -> tuple[Array, Array]:
        size = self.a + self.b * np.abs(z[:, 2:])
        return -size, size

    def interval_over(self, boxes: Interval) -> Interval:
        size = self.a + self.b * boxes[:, 2:].mag
        return Interval(-size, size)

    def lipschitz(self, boxes: Interval) -> Array:
        raise NotImplementedError

    @property
    def form(self) -> dict[str, Any]:
        return {"family": self.family}

    def arrays(self) -> dict[str, Array]:
        return {"a": np.array(self.a), "b": np.array(self.b)}


AXES = Cart().states
ROOM = Box(AXES, (0.0, 0.0), (3.0, 3.0))


def box(x: tuple[float, float], y: tuple[float, float]) -> Box:
    return Box(AXES, (x[0], y[0]), (x[1], y[1]))


def goal(*avoid: Box, target: Region | None = None) -> Goal:
    aim = target or Region((box((2.5, 2.9), (0.3, 0.7)),))
    return Goal("reach_avoid", ROOM, aim, Region(avoid) if avoid else None)


WALLS = (box((1.4, 1.75), (0.0, 1.9)), box((0.5, 0.8), (1.2, 1.5)))


def problem(asked: Goal, gap: GapFunction | None) -> SynthesisProblem:
    return SynthesisProblem(Cart(), gap, Domain(ROOM, Box(Cart().inputs, (-1.0, -1.0), (1.0, 1.0))), asked)


def made(asked: Goal, gap: GapFunction | None, **options: Any) -> MpcController:
    found = Mpc(**{"horizon": 12, "searches": 5, **options}).synthesize(problem(asked, gap))
    assert isinstance(found, MpcController)
    return found


def starts(controller: MpcController, count: int) -> Array:
    rng = np.random.default_rng(4)
    x = controller.draw(24, rng)
    return x[~controller.goal.reached(x)][:count]


NONE = {"hit": 0, "late": 0, "broken": 0, "forced": 0}


def attacked(controller: MpcController, gap: GapFunction, x: Array, seed: int) -> dict[str, int]:
    """Runs at corners of γ, fixed ones (seed 0) or drawn at each step: who hit, was late, broke a promise, or used too much."""
    rng = np.random.default_rng(seed)
    memory, x = controller.start(x), x.copy()
    due = np.array([controller.memory[i][0].arrival for i in memory])  # type: ignore[index]
    fixed = rng.choice([-1.0, 1.0], x.shape)
    out = dict.fromkeys(NONE, 0)
    alive = np.ones(len(x), dtype=bool)
    for k in range(1, int(due.max()) + 2):
        i = np.flatnonzero(alive)
        if not len(i):
            break
        u = controller.respond(x[i], memory[i], "first")
        out["forced"] += int((np.abs(u) > 1).sum())
        sign = fixed[i] if seed == 0 else rng.choice([-1.0, 1.0], x[i].shape)
        after = controller_step(x[i], u) + sign * gap.interval(np.hstack([x[i], u]))[1]
        out["broken"] += int((~controller.kept(x[i], u, after, memory[i])).sum())
        x[i], memory[i] = after, controller.advance(after, memory[i])
        over, safe = controller.goal.reached(after), controller.goal.holds(after)
        out["hit"] += int((~safe).sum())
        out["late"] += int((~over & safe & (k >= due[i])).sum())
        alive[i] = ~over & safe & (k < due[i])
    return out


def controller_step(x: Array, u: Array) -> Array:
    return np.asarray(np.hstack([x, u]) @ SLOPES.T)


@pytest.fixture(scope="module")
def careful() -> MpcController:
    return made(goal(*WALLS), Slip())


@pytest.mark.exam
def test_every_run_arrives_in_time_and_touches_nothing(careful: MpcController) -> None:
    assert careful.evidence["domain_fraction"] > 0.5
    x = starts(careful, 12)
    for seed in range(2):
        assert attacked(careful, Slip(), x, seed) == NONE


def across(*controllers: MpcController) -> Array:
    """Starts to the left of the wall, where all of these win."""
    x = np.random.default_rng(6).uniform((0.2, 0.2), (1.35, 1.8), (12, 2))
    return x[np.all([c.contains(x) for c in controllers], axis=0)][:10]


@pytest.mark.exam
def test_without_the_tube_they_collide(careful: MpcController) -> None:
    careless = made(goal(*WALLS), None)
    x = across(careful, careless)
    found = attacked(careless, Slip(), x, 1)
    assert found["hit"] > 0
    assert found["broken"] > 0
    assert attacked(careful, Slip(), x, 1) == NONE


def test_a_corridor_that_is_not_shifted_is_found_out(careful: MpcController, monkeypatch: pytest.MonkeyPatch) -> None:
    """Programs become infeasible that are not else; plans in hand keep the promise all the same."""
    arrival = careful.planner
    assert arrival is not None

    def unshifted(x: Array, plan: Plan, age: int) -> Plan | None:
        left = (plan.arrival or 0) - age - 1
        return arrival._along(x, plan.x[age:], plan.s[age:], left, plan) if left > 0 else None

    x, counts = across(careful), []
    for _ in range(2):
        before = careful.counts["shifted"]
        assert attacked(careful, Slip(), x, 1)["hit"] == 0
        counts.append(careful.counts["shifted"] - before)
        monkeypatch.setattr(arrival, "follow", unshifted)
    # Only on arrival is there nothing to solve.
    assert counts[0] == len(x)
    assert counts[1] > len(x)


@pytest.mark.exam
def test_rows_that_are_not_tightened_are_found_out(careful: MpcController) -> None:
    design = careful.design
    assert design is not None
    thin = dataclasses.replace(design.stages, c=design.stages.c / 4, G=design.stages.G / 4)
    broken = MpcController(careful.goal, dataclasses.replace(design, stages=thin), {})
    assert attacked(broken, Slip(), starts(careful, 12), 1)["broken"] > 0


def test_time_to_go_falls_at_every_step(careful: MpcController) -> None:
    rng = np.random.default_rng(0)
    for x in starts(careful, 6)[:, None]:
        memory = careful.start(x)
        left = careful.memory[memory[0]][0].arrival  # type: ignore[index]
        assert left is not None
        while not careful.goal.reached(x)[0]:
            u = careful.respond(x, memory, "first")
            x = controller_step(x, u) + rng.choice([-1.0, 1.0], x.shape) * Slip().interval(np.hstack([x, u]))[1]
            memory = careful.advance(x, memory)
            plan, age = careful.memory[memory[0]][:2]  # type: ignore[index]
            assert plan.arrival is not None
            assert plan.arrival - age <= left - 1
            left = plan.arrival - age
        assert left >= 0


@pytest.mark.exam
def test_a_plan_goes_on_where_no_program_is_solved(careful: MpcController, monkeypatch: pytest.MonkeyPatch) -> None:
    engine = careful.engine
    x = starts(careful, 12)
    memory = careful.start(x)
    monkeypatch.setattr(engine, "found", lambda *a, **k: None)
    rng = np.random.default_rng(2)
    due = [careful.memory[i][0].arrival for i in memory]  # type: ignore[index]
    for i, row in enumerate(x):
        at, number = row[None], memory[i : i + 1]
        for _ in range(due[i] or 0):
            u = careful.respond(at, number, "first")
            at = controller_step(at, u) + rng.choice([-1.0, 1.0], at.shape) * Slip().interval(np.hstack([at, u]))[1]
            number = careful.advance(at, number)
            if careful.goal.reached(at)[0]:
                break
            assert careful.keeps(at, number)[0]
            assert careful.goal.holds(at)[0]
        assert careful.goal.reached(at)[0]


def test_what_is_foreseen_ends_in_the_target(careful: MpcController) -> None:
    x = starts(careful, 1)
    memory = careful.start(x)
    foreseen = careful.predicted(x[0], memory)
    assert foreseen is not None
    at, low, high = foreseen
    assert len(at) == (careful.memory[memory[0]][0].arrival or 0) + 1  # type: ignore[index]
    assert careful.goal.reached(np.array([low[-1], high[-1]])).all()


def test_at_the_target_nothing_is_left_to_do(careful: MpcController) -> None:
    x = np.array([[2.7, 0.5]])
    assert careful.contains(x)[0]
    with pytest.raises(UsageError, match="the goal is reached"):
        careful.act(x)
    assert not careful.contains(np.array([[1.5, 1.0]]))[0], "inside an obstacle"


def test_saved_and_loaded_it_acts_alike(careful: MpcController, tmp_path: Path) -> None:
    careful.save(tmp_path)
    again = MpcController.load(tmp_path)
    x = starts(careful, 5)
    assert np.allclose(again.act(x), careful.act(x), atol=1e-4)
    assert again.digest() == careful.digest()
    assert np.array_equal(half_widths(again.design), half_widths(careful.design))


@pytest.mark.exam
def test_the_tube_at_rest_is_narrower_than_with_a_constant() -> None:
    """γ is 0.004 at rest and 0.064 at full speed."""
    both = [made(goal(), Slip(), majorant=m, searches=1, horizon=6) for m in ("affine", "constant")]
    rest, whole = (half_widths(c.design) for c in both)
    assert rest.shape == (7, 4)
    assert (whole[1, :2] > 5 * rest[1, :2]).all()
    # The evidence has where it is widest, and how wide it is at the end.
    for c, tube in zip(both, (rest, whole), strict=True):
        assert list(c.evidence["tube"].values()) == tube.max(axis=0).tolist()
        assert list(c.evidence["tube_at_end"].values()) == tube[-1].tolist()


def brute(controller: MpcController, x: Array) -> int | None:
    """The first arrival over all choices of a face of each obstacle at each stage, by linear programs."""
    engine = controller.engine
    arrival, p = controller.planner, engine.program
    assert arrival is not None
    scene, (low0, high0) = arrival.scene, p.limits()
    for steps in range(1, p.N + 1):
        faces = [np.flatnonzero(scene.obstacle == o) for o in range(scene.obstacles)]
        for choice in itertools.product(itertools.product(*faces), repeat=steps):
            low, high = (np.full_like(low0, s * 1e3) for s in (-1, 1))
            low[: steps + 1], high[: steps + 1] = low0[: steps + 1], high0[: steps + 1]
            low[steps, p.driven], high[steps, p.driven] = -1e3, 1e3
            for k, chosen in enumerate(choice, start=1):
                for f in chosen:
                    side = low if scene.side[f] > 0 else high
                    (low if scene.side[f] > 0 else high)[k, scene.row[f]] = (max if scene.side[f] > 0 else min)(
                        side[k, scene.row[f]], scene.bound[f]
                    )
            low[steps], high[steps] = np.maximum(low[steps], scene.low[0]), np.minimum(high[steps], scene.high[0])
            p.begin(x)
            p.bound(low, high)
            found = scipy.optimize.linprog(
                np.zeros(p.size), np.vstack([p.A.toarray(), -p.A.toarray()]), np.r_[p.high, -p.low], bounds=(None, None)
            )
            if found.status == 0:
                return steps
    return None


def test_the_search_arrives_as_soon_as_every_side_tried() -> None:
    controller = made(goal(box((1.4, 1.6), (0.0, 2.0))), Band((-0.02, -0.02), (0.02, 0.02)), horizon=4, searches=1)
    arrival = controller.planner if controller.design else None
    assert arrival is not None
    frame = controller.design.frame  # type: ignore[union-attr]
    found = []
    for x in ((1.8, 0.5), (2.3, 0.9), (1.2, 2.3), (1.3, 0.5), (2.1, 1.5)):
        at = frame.into(np.array([*x, 0.0, 0.0]))[:2]
        wanted = brute(controller, at)
        plan = arrival.searched(at)
        assert (plan.arrival if plan else None) == wanted
        found.append(wanted)
    assert None in found
    assert len(set(found)) > 2


@pytest.mark.exam
def test_polytopes_are_exact_and_ellipsoids_become_boxes() -> None:
    cut = Polytope(box((1.0, 1.8), (0.5, 2.5)), (Relation("x0 + x1 <= 3", (1.0, 1.0), 3.0),))
    round_ = Ellipsoid.of(ROOM, {AXES[0].name: 1.0, AXES[1].name: 0.4}, {AXES[0].name: 0.3, AXES[1].name: 0.2})
    inner = within(round_)
    corners = np.array(list(itertools.product(*zip(inner.low, inner.high, strict=True))))
    assert round_.contains(corners).all()
    frame = Frame(np.array([1.5, 1.5, 0, 0]), np.array([1.5, 1.5, 1, 1]), 2)
    assert len(parts(Region(polytopes=(cut,)), ROOM, frame, outer=True)[0].cuts) == 1
    asked = Goal("reach_avoid", ROOM, Region((box((2.5, 2.9), (0.3, 0.7)),)), Region(polytopes=(cut,), ellipsoids=(round_,)))
    controller = made(asked, Slip(), searches=6)
    x = starts(controller, 16)
    assert len(x) == 16
    assert attacked(controller, Slip(), x, 1) == NONE
    # The corner that the cut leaves free is passed through by somebody.
    assert controller.contains(np.array([[1.7, 2.0]]))[0]
    assert not controller.contains(np.array([[1.1, 1.2]]))[0]


def test_obstacles_at_other_turns_of_an_angle() -> None:
    axes = (StateSpec("a", "rad", "angle"), StateSpec("b"))
    stay = Box(axes, (2.0, -1.0), (5.0, 1.0))
    there = Box(axes, (3.0 - 2 * np.pi, -0.5), (3.5 - 2 * np.pi, 0.5))
    frame = Frame(np.array([3.5, 0.0]), np.array([1.5, 1.0]), 2)
    found = parts(Region((there,)), stay, frame, outer=True)
    assert len(found) == 1
    assert found[0].low[0] * 1.5 + 3.5 == pytest.approx(3.0)


def test_the_side_of_most_room_is_kept_to() -> None:
    one = Scene(np.zeros((0, 2)), np.zeros((0, 2)), *(np.array(c) for c in ([0, 0], [0, 1], [-1, 1], [0.0, 0.5])), np.eye(2))
    low, high = one.corridor(np.array([[-0.3, 0.7], [0.2, 0.9]]), np.zeros((2, 2)))
    assert high[0, 0] == 0.0
    assert low[1, 1] == 0.5
    assert one.clear(np.array([[0.1, 0.4]]), np.zeros((1, 2))).tolist() == [False]


def test_what_is_not_known_is_refused() -> None:
    asked = Goal("recurrence", ROOM, Region((box((2.5, 2.9), (0.3, 0.7)),)))
    with pytest.raises(UsageError, match="mpc knows the goals invariance, reach and reach_avoid; found recurrence"):
        Mpc().synthesize(problem(asked, None))
    with pytest.raises(UsageError, match="along one straight line only"):
        Mpc(linearisation="successive").synthesize(problem(goal(), None))


def test_what_cannot_be_reached_has_a_reason() -> None:
    controller = made(goal(*WALLS), Band((-0.25, -0.25), (0.25, 0.25)), searches=2)
    assert not controller.contains(np.array([[2.0, 2.0]]))[0]
    assert "target" in str(controller.evidence["reason"])


PRINTS = """
import json
import numpy as np, scipy.optimize
from gapcert_mpc.planning.arrival import optimum
rng = np.random.default_rng(6)
for _ in range(40):
    n, m = int(rng.integers(4, 10)), int(rng.integers(2, 6))
    A, x, kind = rng.normal(size=(m, n)) * 10.0 ** rng.integers(-4, 5, size=(m, n)), rng.normal(size=n), np.zeros(n)
    kind[: n // 2], x[: n // 2] = 1, np.round(x[: n // 2])
    above = A @ x
    model = rng.normal(size=n), A, above - 1e-6, above, kind, scipy.optimize.Bounds(-10, 10)
    optimum(*model, 500)
print(json.dumps({"done": True}))
"""
"""Rows of very different sizes: some of these programs make HiGHS speak."""


@pytest.mark.contract
def test_nothing_is_printed_but_what_a_program_prints() -> None:
    done = subprocess.run([sys.executable, "-c", PRINTS], capture_output=True, text=True, timeout=100, check=True)
    assert json.loads(done.stdout) == {"done": True}
