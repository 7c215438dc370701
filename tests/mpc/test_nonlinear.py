"""Lines about each plan: nothing that they leave out is missed, on nonlinear models far from where one line would do."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gapcert import Domain, GapFunction, Goal, SynthesisProblem, UsageError, closed_loop, load_controller, registry
from gapcert_cells.testing import Band
from gapcert_equations.config import EquationsConfig
from gapcert_mpc import controller, task
from gapcert_mpc.controller import MpcController
from gapcert_mpc.planning import successive
from gapcert_mpc.planning.plans import Held
from gapcert_mpc.planning.successive import Successive
from gapcert_mpc.program.linearise import Frame, Nominal, Stages
from gapcert_mpc.program.program import Program
from gapcert_mpc.program.solver import SOLVERS
from gapcert_mpc.synthesizer import Mpc
from gapcert_mpc.variants.regulation import margin

Array = np.ndarray
CARTPOLE = {
    "kind": "equations",
    "coordinates": {"x": "m", "theta": {"unit": "rad", "kind": "angle"}},
    "inputs": {"force": "N"},
    "parameters": {"M": "0.8 kg", "m": "0.2 kg", "l": "0.3 m", "g": "9.81 m/s^2"},
    "mass_matrix": [["M + m", "m*l*cos(theta)"], ["m*l*cos(theta)", "4/3*m*l**2"]],
    "bias": {"x": "-m*l*sin(theta)*theta_dot**2", "theta": "-m*g*l*sin(theta)"},
    "forces": {"x": "force"},
    "integrator": "euler",
    "period": "50 ms",
}
QUADROTOR = {
    "kind": "equations",
    "states": {"x": "m", "z": "m", "pitch": {"unit": "rad", "kind": "angle"}, "vx": "m/s", "vz": "m/s", "rate": "rad/s"},
    "inputs": {"rear": "N", "front": "N"},
    "parameters": {"m": "0.8 kg", "J": "0.01 kg*m^2", "arm": "0.17 m", "g": "9.81 m/s^2"},
    "derivative": {
        "x": "vx",
        "z": "vz",
        "pitch": "rate",
        "vx": "(rear + front)/m*sin(pitch)",
        "vz": "(rear + front)/m*cos(pitch) - g",
        "rate": "arm*(rear - front)/J",
    },
    "integrator": "euler",
    "period": "50 ms",
}
CARTPOLE_Z = {"x": (-1.0, 1.0), "theta": (-0.3, 0.3), "x_dot": (-2.0, 2.0), "theta_dot": (-3.0, 3.0), "force": (-8.0, 8.0)}
QUADROTOR_Z = dict.fromkeys(("x", "z"), (-2.0, 2.0)) | {"pitch": (-0.4, 0.4)} | dict.fromkeys(("vx", "vz"), (-2.0, 2.0))
QUADROTOR_Z |= {"rate": (-3.0, 3.0), "rear": (2.0, 6.0), "front": (2.0, 6.0)}
CARTPOLE_GAP = np.array([3e-4, 3e-4, 3e-3, 5e-3])
QUADROTOR_GAP = np.array([3e-4, 3e-4, 3e-4, 3e-3, 3e-3, 3e-3])


@pytest.fixture(autouse=True)
def few_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(task.STARTS, "successive", 12)


def problem(gap: GapFunction | None, spec: dict = CARTPOLE, ranges: dict = CARTPOLE_Z) -> SynthesisProblem:
    from gapcert_equations.model import EquationsModel

    model = EquationsModel(EquationsConfig.model_validate(spec))
    domain = Domain.of(model, ranges)
    return SynthesisProblem(model, gap, domain, Goal("invariance", domain.states))


def band(gamma: Array) -> Band:
    return Band(list(-gamma), list(gamma))


def made(gap: GapFunction | None, **options: object) -> MpcController:
    return Mpc(**{"horizon": 15, "linearisation": "successive", "solver": "piqp", **options}).synthesize(problem(gap))


@pytest.fixture(scope="module")
def cartpole() -> Iterator[MpcController]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(task.STARTS, "successive", 16)
        yield made(band(CARTPOLE_GAP))


@pytest.fixture(scope="module")
def nominal() -> Iterator[MpcController]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(task.STARTS, "successive", 16)
        yield made(None)


def framed() -> tuple[Frame, Nominal]:
    p = problem(band(CARTPOLE_GAP))
    return Frame.of(np.array(p.domain.low), np.array(p.domain.high), p.model.nx), Nominal(p.model, p.gap)


def missed(frame: Frame, nominal: Nominal, st: Stages, rng: np.random.Generator) -> float:
    """By how much f ± γ lies beyond c + G|z − ẑ| at worst, at corners, edges and inner points of the boxes."""
    worst = -np.inf
    for _ in range(400):
        share = np.clip(rng.uniform(-1.5, 1.5, st.low.shape), -1, 1)
        z = st.centre + np.where(share > 0, share * (st.high - st.centre), share * (st.centre - st.low))
        at = frame.out(z)
        after = nominal.model.step(at[:, :4], at[:, 4:]).x + CARTPOLE_GAP * rng.choice([-1, 1], (len(z), 4))
        line = (st.A @ z[:, :4, None] + st.B @ z[:, 4:, None])[..., 0] + st.d
        bound = st.c + (st.G @ np.abs(z - st.centre)[..., None])[..., 0]
        worst = max(worst, float((np.abs((after - frame.x[0]) / frame.x[1] - line) - bound).max()))
    return worst


def test_lines_bound_what_they_leave_out() -> None:
    frame, nominal = framed()
    rng = np.random.default_rng(0)
    z = rng.uniform(-0.8, 0.8, (12, 5))
    low, high = np.maximum(z - rng.uniform(0, 0.6, z.shape), -1), np.minimum(z + rng.uniform(0, 0.6, z.shape), 1)
    st = nominal.along(frame, z, low, high)
    assert missed(frame, nominal, st, rng) <= 1e-12
    on = np.array([False, True, False, True, True])
    assert missed(frame, nominal, st.only(on), rng) <= 1e-12
    assert not st.only(on).G[..., ~on].any()
    assert missed(frame, nominal, dataclasses.replace(st, G=0.4 * st.G), rng) > 1e-6
    assert missed(frame, nominal, dataclasses.replace(st, c=0.9 * st.c), rng) > 1e-6


def test_the_bound_is_of_second_order() -> None:
    frame, nominal = framed()
    z = np.full((1, 5), 0.3)
    wide, half = (nominal.along(frame, z, z - r, z + r).G for r in (0.2, 0.1))
    assert wide.any()
    assert half.sum() < 0.55 * wide.sum()


def test_tangents_are_the_lines_of_empty_boxes() -> None:
    frame, nominal = framed()
    z = np.random.default_rng(1).uniform(-1, 1, (5, 5))
    a, b = nominal.along(frame, z, z, z), nominal.tangents(frame, z, z, z, np.zeros(4))
    for name in ("A", "B", "d"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-9)


def test_one_line_does_not_do() -> None:
    found = made(None, linearisation="once")
    assert not found.wins
    assert "`linearisation: successive`" in found.evidence["reason"]


def test_gamma_costs_little_of_the_domain(cartpole: MpcController, nominal: MpcController) -> None:
    assert nominal.evidence["domain_fraction"] > 0.3
    assert cartpole.evidence["domain_fraction"] >= 0.5 * nominal.evidence["domain_fraction"]


def test_the_terminal_set_is_kept_and_not_for_twice_the_gap(cartpole: MpcController) -> None:
    design, program = cartpole.design, cartpole.engine.program
    base, _, per = program.terminal
    size = base + per @ np.abs(design.reference - design.stages.centre[-1])[program.on]
    x, u = design.reference[:4], design.reference[4:]
    assert cartpole.evidence["terminal_margin"] > 0
    for factor, kept in ((1, True), (2, False)):
        wider = Nominal(cartpole.nominal.model, band(factor * CARTPOLE_GAP))
        assert (margin(wider, design.frame, design.section, x, u, size) > 0) is kept


def follow(controller: MpcController, gamma: Array, starts: int, steps: int, solves: float) -> tuple[int, int, int]:
    """Runs at corners of ±γ drawn afresh at each step, on f itself; `solves`: how often a plan may be made again.

    (runs, moments outside the goal, steps outside the tube).
    """
    rng = np.random.default_rng(2)
    assert controller.nominal is not None
    model, x = controller.nominal.model, controller.draw(3 * starts, rng)[:starts]
    memory = controller.start(x)
    out = broken = 0
    for _ in range(steps):
        u = controller.respond(x, memory, "first")
        after = model.step(x, u).x + gamma * rng.choice([-1, 1], x.shape)
        broken += int((~controller.kept(x, u, after, memory)).sum())
        x = after
        if rng.random() < solves:
            memory = controller.advance(x, memory)
        else:
            held = [controller.memory[k] for k in memory.tolist()]
            memory = np.array([controller.memory.add(Held(h.plan, h.age + 1, h.shifted + 1)) for h in held if h])
        out += int((~controller.goal.holds(x)).sum())
    return len(x), out, broken


def test_corners_of_the_gap_break_nothing(cartpole: MpcController) -> None:
    assert follow(cartpole, CARTPOLE_GAP, 3, 40, 1.0) == (3, 0, 0)
    assert follow(cartpole, CARTPOLE_GAP, 6, 100, 0.1) == (6, 0, 0)


def test_a_plan_is_kept_without_solving_again(cartpole: MpcController) -> None:
    """Past its horizon too, where the terminal set takes over."""
    assert follow(cartpole, CARTPOLE_GAP, 8, 120, 0.0) == (8, 0, 0)


@pytest.mark.parametrize("bounded", [True, False])
def test_any_iterate_is_sound_and_none_without_the_remainder(
    nominal: MpcController, monkeypatch: pytest.MonkeyPatch, bounded: bool
) -> None:
    """Plans after one program about a straight line to the target, which no motion follows, in wide boxes."""
    monkeypatch.setattr(successive, "THRESHOLDS", replace(successive.THRESHOLDS, linearisation_rounds=1))
    monkeypatch.setattr(successive, "THRESHOLDS", replace(successive.THRESHOLDS, move_floors=(0.3, 0.2)))
    along = Nominal.along

    def careless(self: Nominal, *args: Array) -> Stages:
        st = along(self, *args)
        return dataclasses.replace(st, G=0 * st.G)

    if not bounded:
        monkeypatch.setattr(Nominal, "along", careless)
    runs, _, broken = follow(dataclasses.replace(nominal), np.zeros(4), 8, 20, 0.0)
    assert runs > 2
    assert (broken == 0) is bounded


@pytest.mark.exam
def test_adopted_plans_keep_their_boxes(cartpole: MpcController) -> None:
    rng = np.random.default_rng(4)
    section, program = cartpole.design.section, cartpole.engine.program
    x = cartpole.draw(12, rng)[:3]
    memory = cartpole.start(x)
    u = cartpole.respond(x, memory, "first")
    after = cartpole.framed(cartpole.nominal.model.step(x, u).x + CARTPOLE_GAP)
    for row, then, number in zip(cartpole.framed(x), after, memory.tolist(), strict=True):
        for x0, held in ((row, None), (then, cartpole.memory[number])):
            plan = cartpole.planner.solve(x0, held)
            assert plan is not None
            st, wide = program.stages, plan.s[:-1] @ section.support.T
            z = np.hstack([plan.x[:-1], plan.u])
            assert (z - wide >= st.low[:-1] - 1e-9)[1:].all()
            assert (z + wide <= st.high[:-1] + 1e-9)[1:].all()
            assert (np.abs(section.H @ (plan.x[-1] - plan.xs)) + plan.s[-1] <= plan.sigma + 1e-9).all()


def test_lines_are_kept_where_they_hold(cartpole: MpcController, monkeypatch: pytest.MonkeyPatch) -> None:
    """And made again where a state leaves their boxes."""
    along, made = Nominal.along, []

    def counted(self: Nominal, *args: Array) -> Stages:
        made.append(1)
        return along(self, *args)

    rng, frame = np.random.default_rng(8), cartpole.design.frame
    x = frame.x[0] + frame.x[1] * cartpole.design.reference[None, :4]
    memory = cartpole.start(x)
    monkeypatch.setattr(Nominal, "along", counted)
    for _ in range(30):
        u = cartpole.respond(x, memory, "first")
        after = cartpole.nominal.model.step(x, u).x + CARTPOLE_GAP * rng.choice([-1, 1], x.shape)
        assert cartpole.kept(x, u, after, memory).all()
        memory, x = cartpole.advance(after, memory), after
    assert 0 < len(made) < 25
    plan = cartpole.memory[int(memory[0])].plan
    z = np.hstack([plan.x[:-1], plan.u])
    lines, away = cartpole.planner.lines, plan.x[0] + [0.0, 0.5, 0.0, 0.0]
    radius = lines.radius(plan.s[:-1], 0.02)
    assert lines.again(plan.x[0], z, radius, dataclasses.replace(plan.lines, low=-1 + 0 * plan.lines.low), 0) is None
    assert lines.again(away, z, radius, plan.lines, 0) is None


def test_updates_equal_a_fresh_program(cartpole: MpcController) -> None:
    design, program = cartpole.design, cartpole.engine.program
    x = cartpole.draw(8, np.random.default_rng(5))[:1]
    assert cartpole.planner.solve(cartpole.framed(x)[0], None)
    fresh = Program(program.stages, design.section, design.rows, design.weights, design.tolerance, varying=True)
    fresh.begin(cartpole.framed(x)[0])
    program.begin(cartpole.framed(x)[0])
    for name in ("indices", "indptr", "data"):
        assert (getattr(program.A, name) == getattr(fresh.A, name)).all()
    assert (program.low == fresh.low).all()
    assert (program.high == fresh.high).all()
    for solver in (SOLVERS["piqp"], SOLVERS["clarabel"]):
        first = design.program()
        used, now = solver(first.qp, 1e-6), program.qp._replace(P=first.P, q=first.q)
        used.update(now, varied=True)
        a, b = used.solve(), solver(now, 1e-6).solve()
        assert a.status == b.status == "solved"
        np.testing.assert_allclose(a.z[program.at["u"]], b.z[program.at["u"]], atol=1e-3)


def test_a_failed_solve_goes_on_with_the_plan(cartpole: MpcController, monkeypatch: pytest.MonkeyPatch) -> None:
    x = cartpole.draw(8, np.random.default_rng(6))[:1]
    memory = cartpole.start(x)
    held = cartpole.memory[int(memory[0])]
    monkeypatch.setattr(Successive, "_certified", lambda *_: None)
    later = cartpole.memory[int(cartpole.advance(x, memory)[0])]
    assert later.plan is held.plan
    assert (later.age, later.shifted) == (held.age + 1, held.shifted + 1)


def test_saved_and_loaded_with_its_model(cartpole: MpcController, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cartpole.save(tmp_path)
    again = load_controller(tmp_path)
    assert again.digest() == cartpole.digest()
    x = cartpole.draw(8, np.random.default_rng(7))[:1]
    plant = cartpole.nominal.model
    runs = [closed_loop(plant, c, x, 4) for c in (cartpole, again)]
    assert np.array_equal(runs[0].x, runs[1].x)
    assert np.array_equal(runs[0].u, runs[1].u)
    # What is no data has to be given.
    monkeypatch.setattr(controller, "pair", lambda *_, **__: None)
    cartpole.save(tmp_path)
    with pytest.raises(UsageError, match="could not be saved as data; give both as MpcController"):
        MpcController.load(tmp_path)
    other = Nominal(cartpole.nominal.model, band(2 * CARTPOLE_GAP))
    with pytest.raises(UsageError, match="do not belong together"):
        MpcController.load(tmp_path, other)
    assert MpcController.load(tmp_path, cartpole.nominal).digest() == cartpole.digest()


def test_the_option_is_one_of_a_spec() -> None:
    config = registry().config("synthesizer", "mpc")
    assert registry().build("synthesizer", "mpc", config(linearisation="successive")).options.linearisation == "successive"


@pytest.mark.exam
@pytest.mark.parametrize(
    ("spec", "ranges", "gamma"), [(CARTPOLE, CARTPOLE_Z, CARTPOLE_GAP), (QUADROTOR, QUADROTOR_Z, QUADROTOR_GAP)]
)
def test_robots_for_hundreds_of_steps(spec: dict, ranges: dict, gamma: Array) -> None:
    found = Mpc(horizon=15, linearisation="successive", solver="piqp").synthesize(problem(band(gamma), spec, ranges))
    assert follow(found, gamma, 8, 300, 1.0) == (8, 0, 0)
    assert follow(found, gamma, 16, 300, 0.2) == (16, 0, 0)
