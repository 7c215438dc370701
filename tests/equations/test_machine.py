"""The compiled interpreter against the NumPy step of the same model, and the functions that it brings."""

import gc as garbage
import importlib.util
import pickle

import numpy as np
import pytest

import gapcert as gc
from gapcert_equations.config import EquationsConfig
from gapcert_equations.programs import operations
from gapcert_equations.programs import trace as tracing
from gapcert_equations.programs.machine import run
from gapcert_equations.programs.trace import CODES, SUBSTEP, Graph, table

FLOW = {
    "kind": "equations",
    "states": {"x": "1", "y": "1", "z": "1"},
    "inputs": {"u": "1"},
    "parameters": {"a": 0.7, "T": "1 s"},
    "derivative": {
        "x": "y/T",
        "y": "(tanh(x)*exp(-x**2) + a*cos(3*z)/(2 + sin(y)) - abs(y)*y + min(u, x, 0.5) + sin(z)*cos(z))/T",
        "z": "(sqrt(1 + z**2)*atan(u) - max(x, -z) + log(2 + x**4) + tan(x/4)*asin(sin(y)/2) + sign(y)"
        " - acos(cos(x)/3)**3/7 + (2 + x)**1.3 + round(5*x)/5 + 1/(3 + y))/T",
    },
    "period": 0.02,
}
MAP = {
    "kind": "equations",
    "states": {"x": "1", "y": "1"},
    "inputs": {"u": "1"},
    "parameters": {"a": 0.9},
    "next": {"x": "y", "y": "a*x - 0.1*x**3/2 + u - 1"},
    "period": 0.1,
}
ARM = {
    "kind": "equations",
    "coordinates": {"a": {"unit": "rad", "kind": "angle"}, "b": "rad"},
    "inputs": {"u": "N*m", "w": "N*m"},
    "parameters": {"J": "0.4 kg*m^2", "k": "0.1 kg*m^2", "g": "2 N*m", "f": "0.2 N*m", "c": "0.1 N*m*s"},
    "mass_matrix": [["J", "k*cos(a - b)"], ["k*cos(a - b)", "J/2"]],
    "bias": {"a": "g*sin(a) + k*sin(a - b)*b_dot**2 + c*a_dot", "b": "-k*sin(a - b)*a_dot**2"},
    "forces": {"a": "u", "b": "w"},
    "period": "10 ms",
}
BLOCK = {
    "kind": "equations",
    "coordinates": {"q": "m"},
    "inputs": {"F": "N"},
    "parameters": {"mass": "2 kg", "fc": "1.5 N", "k": "4 1/s", "T": "1 s"},
    "mass_matrix": [["mass"]],
    "forces": {"q": "F - mass*k*q/T"},
    "dry_friction": {"q": "fc"},
    "period": "5 ms",
}

DRY = ARM | {"dry_friction": {"a": "f", "b": "f/2"}}
ONE_DRY = ARM | {"dry_friction": {"b": "f"}}
LATE = ARM | {
    "parameters": {**ARM["parameters"], "d": {"value": "12 ms", "low": "0 s", "high": "45 ms"}},
    "input_delay": {"u": "d", "w": "20 ms"},
}
SLOW = LATE | {
    "parameters": {**LATE["parameters"], "tau": "30 ms"},
    "memory": {"slow": {"unit": "N*m", "next": "slow + (1 - exp(-h/tau))*(u - slow)", "start": 0.2}},
    "forces": {"a": "slow", "b": "w"},
    "substeps": 3,
}
CASES = {"flow": FLOW, "arm": ARM, "block": BLOCK, "dry": DRY, "one_dry": ONE_DRY, "late": LATE, "slow": SLOW}


def build(spec: dict, **changes) -> gc.Model:
    from gapcert_equations.model import EquationsModel

    return EquationsModel(EquationsConfig.model_validate(spec | changes))


def motions(model: gc.Model, n: int, w: int, steps: int = 60):
    rng = np.random.default_rng(1)
    x0, u = rng.uniform(-0.5, 0.5, (n, model.nx)), rng.uniform(-2, 2, (w, steps, model.nu))
    values = {p.name: p.value * rng.uniform(0.9, 1.1, n) for p in model.parameters[::2]}
    hidden = rng.uniform(-1, 1, (n, len(model.hidden))) if model.hidden else None
    return x0, u, values, hidden


def agree(fast: gc.plugin.Step, slow: gc.plugin.Step, rtol=1e-9):
    np.testing.assert_allclose(fast.x, slow.x, rtol=rtol, atol=rtol)
    assert (fast.hidden is None) == (slow.hidden is None)
    if slow.hidden is not None:
        np.testing.assert_allclose(fast.hidden, slow.hidden, rtol=rtol, atol=rtol)


@pytest.mark.parametrize("integrator", ["euler", "semi_implicit", "rk4"])
@pytest.mark.parametrize("spec", CASES.values(), ids=CASES)
def test_equals_the_rollout_within_rounding(spec, integrator):
    model = build(spec, integrator=integrator)
    x0, u, values, hidden = motions(model, 12, 4)
    slow = model.rollout(x0, np.tile(u, (3, 1, 1)), parameters=values, hidden=hidden)
    assert np.abs(slow.x).max() < 100
    agree(model.fast_rollout(x0, u, parameters=values, hidden=hidden), slow)
    thinned = model.fast_rollout(x0, u, parameters=values, hidden=hidden, every=4)
    assert np.array_equal(thinned.x, model.fast_rollout(x0, u, parameters=values, hidden=hidden).x[:, ::4])


def test_states_that_a_map_exchanges_are_not_overwritten():
    model = build(MAP)
    x0, u, values, _ = motions(model, 6, 6)
    agree(model.fast_rollout(x0, u, parameters=values), model.rollout(x0, u, parameters=values), rtol=1e-13)


@pytest.mark.parametrize("n", [1, 15, 129, 300])
def test_rows_do_not_depend_on_the_blocks_they_run_in(n):
    model = build(DRY)
    x0, u, values, _ = motions(model, n, n, steps=5)
    whole = model.fast_rollout(x0, u, parameters=values).x
    agree(gc.plugin.Step(whole), model.rollout(x0, u, parameters=values))
    i = n - 1
    alone = model.fast_rollout(x0[i:], u[i:], parameters={k: v[i:] for k, v in values.items()}).x
    assert np.array_equal(alone[0], whole[i])


def test_a_row_that_blows_up_disturbs_no_other():
    model = build(BLOCK, forces={"q": "F + cubic*q_dot**3"}, parameters=BLOCK["parameters"] | {"cubic": "0 N*s^3/m^3"})
    x0, u = np.array([[0.0, 1.0], [0.0, 1.0]]), np.ones((1, 40, 1))
    values = {"cubic": np.array([1e9, 0.0])}
    fast, slow = model.fast_rollout(x0, u, parameters=values).x, gc.Model.fast_rollout(model, x0, u, parameters=values).x
    for x in (fast, slow):
        assert not np.isfinite(x[0]).all()
        np.testing.assert_allclose(x[1], model.rollout(x0[1:], u).x[0], rtol=1e-12, atol=1e-14)


def test_what_does_not_depend_on_states_is_computed_once():
    prologue, period, substep = (len(c) for c in build(ARM).program.code)
    assert prologue
    assert not period
    fixed = build(ARM, forces={"a": "u + exp(-J/k)*sqrt(J/k)*u*tanh(u/g)", "b": "w"})
    counts = [len(c) for c in fixed.program.code]
    assert counts[0] > prologue
    assert counts[1] > period
    assert counts[2] - substep <= 4  # one sum per stage at most
    # 50 sweeps are one instruction.
    assert len(build(DRY).program.code[SUBSTEP]) < 1.6 * substep


def test_programs_survive_pickling():
    model = build(SLOW)
    x0, u, values, hidden = motions(model, 3, 3)
    before, digest = model.fast_rollout(x0, u, parameters=values, hidden=hidden), model.digest()
    again = pickle.loads(pickle.dumps(model))
    assert again.digest() == digest == build(SLOW).digest()
    assert np.array_equal(again.fast_rollout(x0, u, parameters=values, hidden=hidden).x, before.x)


@pytest.mark.parametrize("spec", [ARM, SLOW])
def test_steps_along_a_given_motion(spec):
    model = build(spec)
    x0, u, values, hidden = motions(model, 4, 4, steps=7)
    x = x0[:, None] + np.random.default_rng(2).normal(size=(4, 7, model.nx)) / 10
    fast = model.along(x, u, parameters=values, hidden=hidden)
    np.testing.assert_allclose(fast, gc.Model.along(model, x, u, parameters=values, hidden=hidden), rtol=1e-12, atol=1e-13)


def test_held_inputs_leave_behind_what_steps_do_and_the_run_ends_once_that_stands_still():
    worn = {"unit": "rad", "next": "worn + h*b_dot"}  # the motion bends it, with or without an input
    rest = {"unit": "N*m", "next": "rest + (1 - exp(-h/tau))*(u + w*cos(b) - rest)"}
    clock = {"unit": "s", "next": "clock + h"}
    model = build(SLOW, memory=SLOW["memory"] | {"worn": worn, "rest": rest, "clock": clock})
    rng = np.random.default_rng(5)
    x, u, tau = rng.normal(size=(2, 4)), rng.normal(size=(2, 2)), np.array([0.02, 0.03, 0.02, 0.05, 0.04, 0.03])
    begun = np.tile(model.hidden_default, (6, 1))
    kept = [n for n, s in enumerate(model.hidden) if s.name in ("slow", "worn", "clock")]  # `slow` fades by itself
    for steps in (3, 40):
        found, now, values = model.held_memories(x, u, steps, {"tau": tau}, begun), begun, {"tau": tau}
        for _ in range(steps):
            now = model.step(np.tile(x, (3, 1)), np.tile(u, (3, 1)), parameters=values, hidden=now).hidden
        np.testing.assert_array_equal(found[:, kept], begun[:, kept])
        np.testing.assert_allclose(np.delete(found, kept, 1), np.delete(now, kept, 1), rtol=1e-12)
    long, longer = (model.held_memories(x, u, steps, {"tau": tau}, begun) for steps in (2000, 10**9))
    np.testing.assert_array_equal(long, longer)
    # A program of memories alone leaves out what they do not rest on.
    alone = build(SLOW).program
    assert (alone.recall.new[:4] == alone.recall.states[:4]).all()
    assert len(alone.recall.code[SUBSTEP]) < len(alone.code[SUBSTEP]) / 5


@pytest.mark.parametrize("spec", [ARM, SLOW])
def test_without_numba_the_answers_are_the_same(spec, monkeypatch):
    model = build(spec)
    x0, u, values, hidden = motions(model, 4, 2, steps=9)
    x = np.random.default_rng(2).normal(size=(4, 9, model.nx)) / 10
    inputs = np.tile(u, (2, 1, 1))
    fast = model.fast_rollout(x0, u, parameters=values, hidden=hidden, every=3), model.along(x, inputs, hidden=hidden)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr("gapcert_equations.programs.machine.run", None)
    model = build(spec)
    agree(fast[0], model.fast_rollout(x0, u, parameters=values, hidden=hidden, every=3))
    np.testing.assert_allclose(fast[1], model.along(x, inputs, hidden=hidden), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"u": np.zeros((2, 5, 2))}, r"u \(2, 5, 2\); expected \(n, 4\) and \(w, T, 2\), w dividing n"),
        ({"parameters": {"J": np.ones(2)}}, r"shape \(2,\); expected a number, or one per row \(3,\)"),
        ({"parameters": {"mass": 1.0}}, r"no parameter 'mass'"),
        ({"hidden": np.zeros((3, 1))}, r"hidden has shape \(3, 1\); expected \(3, 0\)"),
    ],
)
def test_refuses_what_does_not_fit(change, says):
    given = {"u": np.zeros((3, 5, 2)), "parameters": None, "hidden": None} | change
    with pytest.raises(gc.UsageError, match=says):
        build(ARM).fast_rollout(np.zeros((3, 4)), **given)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 50.0, 1e4, 1e7])
def test_sines_and_cosines_are_those_of_the_library(scale):
    x = np.random.default_rng(0).uniform(-scale, scale, 5001)
    sine, cosine, other = np.empty_like(x), np.empty_like(x), np.empty_like(x)
    operations.sines_and_cosines(x, sine, cosine, len(x))
    for ours, theirs in ((sine, np.sin(x)), (cosine, np.cos(x))):
        assert np.abs((ours - theirs) / np.spacing(np.abs(theirs))).max() <= 2
    operations.sines(x, other, len(x), 0)
    assert np.array_equal(other, sine)
    operations.sines(x, other, len(x), 1)
    assert np.array_equal(other, cosine)


def test_exponentials_are_those_of_the_library():
    x = np.concatenate([np.random.default_rng(0).uniform(-700, 700, 5000), [0.0, -0.0, 1e-300, np.nan]])
    out = np.empty_like(x)
    operations.exponentials(x, out, len(x))
    np.testing.assert_allclose(out, np.exp(x), rtol=5e-16)
    far = np.array([709.5, 800.0, -745.0, -800.0, np.inf, -np.inf, 1.0])
    with np.errstate(over="ignore", under="ignore"):
        expected = np.exp(far)
    operations.exponentials(far, far_out := np.empty_like(far), len(far))
    np.testing.assert_allclose(far_out, expected, rtol=5e-16)


def test_hyperbolic_tangents_are_those_of_the_library():
    x = np.concatenate([s * np.random.default_rng(0).uniform(-1, 1, 2000) for s in (1e-12, 0.1, 1.0, 5.0, 400.0)])
    x = np.concatenate([x, [0.0, np.inf, -np.inf, np.nan]])
    out = np.empty_like(x)
    operations.hyperbolic_tangents(x, np.empty_like(x), out, len(x))
    np.testing.assert_allclose(out, np.tanh(x), rtol=5e-16)


def test_equal_values_are_recorded_once_and_numbers_folded():
    graph = Graph()
    operations, x = table(graph), graph.leaf("x", SUBSTEP)
    a, b = graph.leaf("a", 0), operations["number"](1, 2)
    assert (x * a).index == (a * x).index
    assert (b + b).index == graph.number(1.0).index
    assert (x + 0.0).index == x.index == (1.0 * x).index
    quotient = graph.nodes[(x / a).index]
    assert quotient[0] == "mul"  # by 1/a, which is known before
    assert graph.part[quotient[1][1]] == 0 or graph.part[quotient[1][0]] == 0
    assert set(operations) - {"number"} >= set(CODES) - {"sweep", "turn"}


def test_a_program_is_plain_data():
    model = build(ARM)
    late = np.empty((0, 2), dtype=np.int64), np.empty((2, 0)), np.empty((2, 0))
    values = [p.value for p in model.parameters]
    x, last = run(model.program, np.zeros((2, 4)), np.ones((1, 3, 2)), values, late, 1, np.arange(4), 4)
    assert np.array_equal(x[:, -1], last)


@pytest.mark.parametrize("enabled", [True, False])
def test_the_collector_rests_while_a_program_is_traced(monkeypatch, enabled):
    seen = []
    monkeypatch.setattr(tracing, "_traced", lambda *given: seen.append(garbage.isenabled()) or 1 / 0)
    before = garbage.isenabled()
    (garbage.enable if enabled else garbage.disable)()
    try:
        with pytest.raises(ZeroDivisionError):
            tracing.trace(None, 0, 0, 0, 0)
        assert garbage.isenabled() is enabled
    finally:
        (garbage.enable if before else garbage.disable)()
    assert seen == [False]
