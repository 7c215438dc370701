"""The synthesizer under relations: inputs are offered where they hold for a whole cell, and states may go without cells."""

from itertools import product

import numpy as np
import pytest

import gapcert as gc
import gapcert_symbolic.synthesizer as synthesizer
from gapcert import Box, Domain, Goal, Interval, Region, SynthesisProblem, UsageError
from gapcert_cells import GridController
from gapcert_cells.testing import Band
from gapcert_closed_loop.closed_loop import closed_loop
from gapcert_symbolic.cells.abstraction import windows
from gapcert_symbolic.cells.bounds import Enclosed
from gapcert_symbolic.cells.gaps import disturbance
from gapcert_symbolic.cells.grid import Grid
from gapcert_symbolic.cells.held import offered

POLICIES = ("first", "middle", "last", "random")
BASE = {
    "kind": "equations",
    "states": {"px": "m", "py": "m", "vx": "m/s", "vy": "m/s"},
    "inputs": {"ux": "m/s", "uy": "m/s"},
    "parameters": {"tau": "0.3 s", "T": "1 s"},
    "next": {"px": "px + tau*ux", "py": "py + tau*uy", "vx": "ux", "vy": "uy"},
    "period": "300 ms",
}
RANGES = {"px": (0, 3), "py": (0, 3), "vx": (-1, 1), "vy": (-1, 1), "ux": (-1, 1), "uy": (-1, 1)}
CUT = ("abs(ux - vx) <= 0.5 m/s", "abs(uy - vy) <= 0.5 m/s")
GAMMA = 0.02
SLOW = {"ux": (-0.2, 0.2), "uy": ("-20 cm/s", 0.2)}


def equations(**changes):
    registry = gc.registry()
    return registry.build("model", "equations", registry.config("model", "equations")(**{**BASE, **changes}))


@pytest.fixture(scope="module")
def base():
    return equations()


@pytest.fixture(scope="module")
def real():
    """A base that lags: the position misses by 0.04 s of each change of velocity, the velocity by 4 % of it."""
    lag = {
        "px": "px + tau*ux - 0.04*T*(ux - vx)",
        "py": "py + tau*uy - 0.04*T*(uy - vy)",
        "vx": "ux - 0.04*(ux - vx)",
        "vy": "uy - 0.04*(uy - vy)",
    }
    return equations(next=lag)


def room(domain, **bounds):
    def box(**ranges):
        ends = [ranges.get(n, e) for n, *e in zip(domain.states.names, domain.states.low, domain.states.high, strict=True)]
        return Box(domain.states.axes, tuple(float(e[0]) for e in ends), tuple(float(e[1]) for e in ends))

    target, wall = box(px=(2.2, 3.0), py=(2.2, 3.0), **bounds), box(px=(1.0, 1.6), py=(0.9, 3.0))
    return Goal("reach_avoid", domain.states, Region((target,)), Region((wall,)))


def symbolic(**options):
    given = {"cells": {"px": 100, "py": 100}, "inputs": {"ux": 7, "uy": 7}, "on": ["px", "py"], "input_range": SLOW}
    return synthesizer.Symbolic(**{**given, **options})


def problem(base, gap=None, *relations, **bounds):
    domain = Domain.of(base, RANGES, relations or CUT)
    return SynthesisProblem(base, gap, domain, room(domain, **bounds))


BAND = Band((-GAMMA,) * 4, (GAMMA,) * 4)


@pytest.fixture(scope="module")
def careful(base):
    return symbolic().synthesize(problem(base, BAND))


class Line(gc.Model):
    """p⁺ = p + u, v⁺ = u, on a line."""

    def __init__(self):
        self.states = self.outputs = (gc.StateSpec("p", "m"), gc.StateSpec("v", "m/s"))
        self.inputs, self.period = (gc.StateSpec("u", "m/s"),), 1.0

    def _step(self, x, u, **options):
        return np.stack([x[:, 0] + u[:, 0], u[:, 0]], axis=1)

    def jacobian(self, x, u):
        return np.broadcast_to([[1.0, 0, 1], [0, 0, 1]], (len(x), 2, 3))

    def enclosure(self, z):
        return Interval.stack([z[:, 0] + z[:, 2], z[:, 2]], axis=1)

    def jacobian_enclosure(self, z):
        return Interval.exact(self.jacobian(z.lo, z.lo))

    def extend(self, extensions):
        raise NotImplementedError

    def equations(self):
        return ""

    def to_spec(self):
        return {}

    def sites(self, kind):
        return ()


def brute(grid, inputs, band, allowed, good):
    """Winning cells of invariance (`good`: where to stay), cell by cell and by the definition."""
    p, v = grid.edges
    alive = good.copy()
    while True:
        before = alive.copy()
        for i, k in np.argwhere(before):
            wins = False
            for u in inputs:
                ends = (p[i] + u - band, p[i + 1] + u + band), (u - band, u + band)
                inside = ends[0][0] >= p[0] and ends[0][1] <= p[-1] and ends[1][0] >= v[0] and ends[1][1] <= v[-1]
                touched = [
                    before[a, b]
                    for a, b in product(range(len(p) - 1), range(len(v) - 1))
                    if p[a] <= ends[0][1] and p[a + 1] >= ends[0][0] and v[b] <= ends[1][1] and v[b + 1] >= ends[1][0]
                ]
                wins = wins or (inside and all(touched) and allowed(u, v[k], v[k + 1]))
            alive[i, k] = wins
        if (alive == before).all():
            return alive


@pytest.mark.parametrize("limit", [0.331, 0.361, 2.0])
def test_the_same_cells_as_by_the_definition(limit):
    model = Line()
    domain = Domain.of(model, {"p": (0, 2), "v": (-0.6, 0.6), "u": (-0.55, 0.55)}, [f"abs(u - v) <= {limit} m/s"])
    made = synthesizer.Symbolic({"p": 23, "v": 9}, {"u": 6}).synthesize(
        SynthesisProblem(model, Band((-0.013, -0.013), (0.013, 0.013)), domain, Goal("invariance", domain.states))
    )
    grid, inputs = Grid(domain.states, (23, 9)), np.linspace(-0.55, 0.55, 6)
    twin = brute(grid, inputs, 0.013, lambda u, a, b: max(abs(u - a), abs(u - b)) <= limit, np.ones((23, 9), bool))
    assert np.array_equal(made.winning, twin)
    assert 0 < twin.sum() <= 23 * 9
    for i, k in np.argwhere(twin):
        for u in made.points[made.allowed(np.array([i * 9 + k]))[0].astype(bool)][:, 0]:
            assert max(abs(u - grid.edges[1][k]), abs(u - grid.edges[1][k + 1])) <= limit


def test_offered_inputs_keep_relations_everywhere_in_the_cell(base):
    """And no input is withheld that keeps them everywhere, but for rounding at equality."""
    domain = Domain.of(base, RANGES, ["abs(ux - vx) <= 0.5", "px + 0.3 s*ux <= 2.9 m"])
    grid, axes = Grid(domain.states, (6, 1, 8, 2)), (np.linspace(-1, 1, 9), np.linspace(-1, 1, 3))
    allowed = offered(domain, grid, axes)
    low, high = grid.cells(0, grid.size)
    points = np.stack([m.ravel() for m in np.meshgrid(*axes, indexing="ij")], axis=1)
    rng = np.random.default_rng(0)
    for share in [np.zeros(4), np.ones(4), *rng.random((20, 4)), *rng.integers(0, 2, (20, 4))]:
        x = low + (high - low) * share
        z = np.concatenate([x.repeat(27, 0), np.tile(points, (len(x), 1))], axis=1)
        assert domain.zone.related(z)[allowed.ravel()].all()
    far = np.maximum(np.abs(points[:, 0] - low[:, 2:3]), np.abs(points[:, 0] - high[:, 2:3]))
    also = (far <= 0.5 - 1e-9) & (high[:, :1] + 0.3 * points[:, 0] <= 2.9 - 1e-9)
    assert allowed[also].all()
    assert 0 < allowed.mean() < 0.6


def test_nothing_offered_has_its_reason(base):
    stay = Goal("invariance", problem(base).domain.states)
    made = symbolic(on=None, cells={"px": 4, "py": 4, "vx": 1, "vy": 1}).synthesize(
        SynthesisProblem(base, None, problem(base).domain, stay)
    )
    assert not made.contains(made.draw(10, np.random.default_rng(0))).any()
    assert "no input keeps the relations (abs(ux - vx) <= 0.5 m/s" in made.evidence["reason"]


class TestSomeStates:
    def test_the_box_is_what_inputs_and_gap_reach(self, careful):
        assert careful.held.names == ("vx", "vy")
        assert np.allclose(careful.held.high, 0.2 + GAMMA, atol=1e-3)
        assert np.allclose(careful.held.low, -0.2 - GAMMA, atol=1e-3)
        assert (np.asarray(careful.held.high) >= 0.2 + GAMMA).all(), "outwards"
        assert careful.evidence["held"]["vx"] == [careful.held.low[0], careful.held.high[0]]

    def test_without_a_gap_the_box_is_the_largest_that_is_left(self, base):
        made = symbolic().synthesize(problem(base))
        assert np.allclose(made.held.high, 0.3, atol=1e-6)
        assert (np.asarray(made.held.high) <= 0.3).all()

    def test_it_acts_inside_the_box_alone(self, careful):
        x = careful.draw(500, np.random.default_rng(0))
        assert careful.contains(x).all()
        assert np.ptp(x[:, 2:], axis=0).min() > 0.4
        u = careful.act(x, "random")
        assert (np.abs(u) <= 0.2).all()
        out = x.copy()
        out[:, 3] = 0.25
        assert not careful.contains(out).any()
        with pytest.raises(UsageError, match="outside its domain"):
            careful.act(out, "first")

    def test_saved_and_loaded(self, careful, tmp_path):
        careful.save(tmp_path)
        loaded = GridController.load(tmp_path)
        assert loaded.held == careful.held
        assert loaded.digest() == careful.digest()
        x = careful.draw(200, np.random.default_rng(1))
        assert np.array_equal(loaded.act(x, "middle"), careful.act(x, "middle"))
        assert np.array_equal(loaded.draw(20, np.random.default_rng(2)), careful.draw(20, np.random.default_rng(2)))

    @pytest.mark.parametrize("policy", POLICIES)
    def test_runs_arrive_and_never_break_a_relation(self, careful, real, policy):
        """Under the lag, which the band contains on V0, and under the worst of the band itself."""
        domain = Domain.of(real, RANGES, CUT)
        x0 = careful.draw(100, np.random.default_rng(5))
        trace = closed_loop(real, careful, x0, 120, policy, domain=domain)
        assert not trace.violation.any()
        assert trace.reached.all()
        ran = np.isfinite(trace.u[:, :, 0])
        assert (np.abs(trace.u - trace.x[:, :-1, 2:])[ran] <= 0.5).all()

    @pytest.mark.parametrize("seed", range(3))
    def test_the_worst_of_the_band_changes_nothing(self, careful, base, seed):
        rng = np.random.default_rng(seed)
        x = careful.draw(300, rng)
        corner = rng.choice((-GAMMA, GAMMA), x.shape)
        for k in range(150):
            x, corner = (a[~careful.goal.reached(x)] for a in (x, corner))
            if not len(x):
                break
            assert careful.contains(x).all()
            assert careful.goal.holds(x).all()
            u = careful.act(x, "random", seed, k)
            assert (np.abs(u - x[:, 2:]) <= 0.5).all()
            x = base.step(x, u).x + corner
        assert not len(x)

    def test_a_gap_that_depends_on_the_box_is_taken_over_all_of_it(self, base):
        class Steep(Band):
            """γ_px = 0.01 + 0.1 |vx|, γ_v = 0.01."""

            __init__ = object.__init__

            def interval(self, z):
                size = np.full((len(z), 4), 0.01)
                size[:, 0] += 0.1 * np.abs(z[:, 2])
                return -size, size

            def interval_over(self, boxes):
                size = np.full((len(boxes), 4), 0.01)
                size[:, 0] += 0.1 * boxes[:, 2].mag
                return Interval(-size, size)

            def lipschitz(self, boxes):
                slope = np.zeros((len(boxes), 4, 6))
                slope[:, 0, 2] = 0.1
                return slope

        made = symbolic().synthesize(problem(base, Steep()))
        assert made.held.high == pytest.approx((0.21, 0.21), abs=1e-3)
        whole = Grid(
            Box(made.goal.stay.axes[:2], (0, 0), (3, 3)), (10, 10), (0, 1), np.array([[0, 3]] * 2 + [[-0.21, 0.21]] * 2)
        )
        axes = (np.linspace(-0.2, 0.2, 3),) * 2
        added = disturbance(Steep(), whole, axes)
        assert added.r.hi[..., 0] == pytest.approx(0.01 + 0.021)
        assert len(windows(Enclosed(base), whole, axes, added).axes) == 2

    @pytest.mark.parametrize("wide", [1.0, 0.245])
    def test_inputs_that_could_break_a_relation_are_refused_with_the_largest_that_cannot(self, base, wide):
        ranges = {"ux": (-wide, wide), "uy": (-wide, wide)}
        with pytest.raises(UsageError, match=r"controller.input_range: .* abs\(ux - vx\) <= 0.5 m/s does not hold") as caught:
            symbolic(input_range=ranges).synthesize(problem(base, BAND))
        # |u| ≤ 0.25 − γ/2, so that no two consecutive commands leave the relation.
        assert "{ux: [-0.2399, 0.2399], uy: [-0.2399, 0.2399]}" in str(caught.value)
        most = {"ux": (-0.2399, 0.2399), "uy": (-0.2399, 0.2399)}
        assert symbolic(input_range=most).synthesize(problem(base, BAND)).evidence["winning_cells"]

    def test_it_is_refused_before_a_gap_is_paid_for(self, base):
        p = problem(base)
        with pytest.raises(UsageError, match=r"the largest admissible range of this shape is \{ux: \[-0.2499, 0.2499\]"):
            symbolic(input_range=None).check(p.model, p.domain, p.goal)

    def test_a_gap_too_large_for_any_input(self, base):
        with pytest.raises(UsageError, match="no inputs around these middles are admissible"):
            symbolic().synthesize(problem(base, Band((-0.6,) * 4, (0.6,) * 4)))

    def test_an_unbounded_state_is_refused(self):
        drifting = equations(next={**BASE["next"], "vx": "1.3*vx + ux"})
        with pytest.raises(UsageError, match=r"vx leaves \[-1, 1\]|does not hold|no box holds"):
            symbolic().synthesize(problem(drifting, BAND))

    def test_a_target_about_states_without_cells_is_refused(self, base):
        with pytest.raises(UsageError, match=r"target asks for vx in \[-0.1, 0.1\].*add it to controller.on"):
            symbolic().synthesize(problem(base, BAND, vx=(-0.1, 0.1)))

    @pytest.mark.parametrize(
        ("options", "says"),
        [
            ({"on": ["px", "pz"]}, "'pz' is no state"),
            ({"input_range": {"uz": (0, 1)}}, "'uz' is no input"),
            ({"input_range": {"ux": (-3, 1)}}, "is not inside the domain"),
            ({"cells": {"px": 9, "py": 9, "vx": 9}}, "'vx' is unknown; expected px, py"),
        ],
    )
    def test_options_that_do_not_fit(self, base, options, says):
        p = problem(base)
        with pytest.raises(UsageError, match=says):
            symbolic(**options).check(p.model, p.domain, p.goal)


def test_an_input_that_breaks_a_relation_is_caught(base, real, monkeypatch):
    """Without its handling in the synthesizer, a closed loop says so instead of going on."""
    monkeypatch.setattr(synthesizer, "offered", lambda *_: None)
    domain = Domain.of(base, RANGES, CUT)
    full = symbolic(on=None, cells={"px": 20, "py": 20, "vx": 3, "vy": 3}, inputs={"ux": 5, "uy": 5}, input_range=None)
    made = full.synthesize(SynthesisProblem(base, None, domain, Goal("invariance", domain.states)))
    with pytest.raises(UsageError, match=r"the controller breaks the relation abs\(u[xy] - v[xy]\) <= 0.5 m/s"):
        closed_loop(real, made, made.draw(20, np.random.default_rng(0)), 20, "random", domain=domain)


SPEC = """\
version: 1
name: room
model: {kind: equations, states: {px: m, vx: m/s}, inputs: {ux: m/s}, parameters: {tau: 0.3 s}, next: {px: px + tau*ux, vx: ux},
  period: 300 ms}
backend: {kind: equations, states: {px: m, vx: m/s}, inputs: {ux: m/s}, parameters: {tau: 0.3 s, lag: 0.02 s},
  next: {px: px + tau*ux - lag*(ux - vx), vx: ux}, period: 300 ms}
domain: {px: [0, 3], vx: [-1, 1], ux: [-1, 1]}
relations: [abs(ux - vx) <= 0.5 m/s]
symmetries: {translation: [px]}
sampling: {kind: adaptive, budget: 60}
lipschitz: {residual: {kind: interval}}
gap: {kind: envelope}
certificate: {claim: deterministic, violation: 1e-2, confidence: 0.999}
controller: {kind: symbolic, on: [px], cells: {px: 200}, inputs: {ux: 9}, input_range: {ux: [-0.2, 20 cm/s]},
  goal: {reach_avoid: {target: {px: [2.5, 3]}, avoid: [{px: [0, 0.2]}]}}}
closed_loop: {steps: 100, starts: 20}
report: {rerun: false}
"""


@pytest.mark.exam
def test_a_whole_run(tmp_path):
    run = gc.run(gc.load_spec(SPEC), out=tmp_path)
    assert run.summary["verdict"] == "holds"
    assert run.summary["controller"]["held"]["vx"] == pytest.approx([-0.2, 0.2], abs=1e-3)
    assert run.summary["closed_loop"]["with_gamma"]["violations"] == 0
    assert run.summary["certificate"]["samples"]["symmetry"] == 1000
    assert (run.folder / "report.html").stat().st_size > 10_000
    for path in ("input_range={uy: [0, 1]}", "on=[px, q]", "cells={px: 9, vx: 9}", "input_range={ux: [0 kg, 1]}"):
        with pytest.raises(gc.SpecError):
            gc.load_spec(SPEC, [f"controller.{path}"])
