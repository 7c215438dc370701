"""What hidden states remember where a window begins: all of the past, along the measured motion."""

from dataclasses import replace

import numpy as np
import pytest

import gapcert as gc
from gapcert.testing import multisine
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.fitting.fit import fit
from gapcert_diagnosis.fitting.hypothesis import Hypothesis, recalled
from gapcert_diagnosis.search.candidates import Candidate, Library
from gapcert_diagnosis.testing import CART, equations

PERIOD = 0.01


def slow(name, site, **numbers):
    """A cart with one effect, its true hidden states (T, nh), and its windows."""
    model = equations(CART)
    extended = model.extend([gc.registry().build("effect", name).extension(site, model)])
    u = multisine(8.0, PERIOD, 2.0, (0.1, 2.0), 3)
    x, hidden, states, memories = np.array([[0.2, 0.0]]), None, [], []
    values = {p.name: numbers[p.name.rpartition(f"_{site}")[2].lstrip("_") or "value"] for p in extended.parameters[2:]}
    for row in u:
        memories.append(extended.hidden_default if hidden is None else hidden[0])
        states.append(x[0])
        step = extended.step(x, row[None], hidden=hidden, parameters=values)
        x, hidden = step.x, step.hidden
    channels = {"q": np.array(states)[:, 0], "q_dot": np.array(states)[:, 1], "u": u[:, 0]}
    measured = Dataset.of(model, gc.Recording.of(np.arange(len(u)) * PERIOD, channels))
    windows = measured.windows(100)
    first = windows.place[:, 1] - measured.history
    return extended, values, windows, np.array(memories)[first]


@pytest.mark.parametrize(
    ("name", "site", "numbers"),
    [
        ("input-lag", "u", {"value": 0.7}),
        ("supply-sag", "u", {"sag": 0.2, "time_constant": 3.0}),
        ("backlash", "q", {"value": 0.9}),
        ("dahl-friction", "q", {"level": 0.3, "displacement": 0.05}),
    ],
)
def test_memories_are_those_of_the_motion_since_its_beginning(name, site, numbers):
    model, values, windows, truth = slow(name, site, **numbers)
    found = recalled(model, windows, values, 1)
    scale = np.abs(truth).max()
    np.testing.assert_allclose(found, truth, atol=0.01 * scale)
    forgetful = np.abs(np.asarray(model.hidden_default) - truth).max()
    assert forgetful > 0.3 * scale


def test_a_clock_needs_no_past_and_rows_keep_their_order():
    model, values, windows, truth = slow("external-push", "q", force=1.0, time=2.0, duration=0.3)
    assert not model.remembers
    np.testing.assert_allclose(recalled(model, windows, values, 1), truth, atol=1e-9)
    lag, _, windows, _ = slow("input-lag", "u", value=0.7)
    rows = recalled(lag, windows, {"input_lag_u": np.array([0.1, 0.7])}, 2).reshape(2, len(windows), -1)
    np.testing.assert_array_equal(rows[1], recalled(lag, windows, {"input_lag_u": 0.7}, 1))


def test_a_late_input_is_known_however_late_it_comes():
    model = equations(CART)
    u = multisine(8.0, PERIOD, 2.0, (0.1, 2.0), 3)
    measured = Dataset.of(model, gc.Recording.of(np.arange(len(u)) * PERIOD, {"q": np.sin(u[:, 0]), "u": u[:, 0]}))
    late = Candidate(gc.registry().build("effect", "input-delay"), "u")
    extended = Library(model, measured, [late.effect]).extended((late,), {})
    windows = measured.windows(100)
    found = recalled(extended, windows, {}, 1)
    first = windows.place[:, 1] - measured.history
    assert found.shape[1] == 80  # a tenth of eight seconds
    for k in (1, 7, 80):
        np.testing.assert_array_equal(found[:, k - 1], u[np.maximum(first - k, 0), 0])


@pytest.mark.parametrize(
    "effects",
    [[("supply-sag", "u")], [("backlash", "q")], [("dahl-friction", "q")], [("input-delay", "u"), ("input-lag", "u")]],
)
def test_the_fast_way_is_that_of_rollouts_from_mark_to_mark(effects, monkeypatch):
    # Two pieces of unequal length, several rows, a channel that nothing shows.
    model = equations(CART)
    extended = model.extend([gc.registry().build("effect", name).extension(site, model) for name, site in effects])
    t, rng = np.arange(900) * PERIOD, np.random.default_rng(0)
    parts = [
        gc.Recording.of(t[:n], {"q": np.sin(3 * t[:n] + n), "u": multisine(n * PERIOD, PERIOD, 2.0, (0.1, 2.0), n)[:, 0]})
        for n in (900, 500)
    ]
    measured = Dataset.of(model, gc.Recording(tuple(r.trajectories[0] for r in parts)))
    windows = measured.windows(90)
    added = [p for p in extended.parameters if p.name not in {k.name for k in model.parameters}]
    numbers = {p.name: p.value * rng.uniform(0.5, 1.5, 3) for p in added}
    fast = recalled(extended, windows, numbers, 3)
    monkeypatch.setattr(type(extended), "fast_memories", gc.Model.fast_memories)
    np.testing.assert_allclose(fast, recalled(extended, windows, numbers, 3), rtol=1e-9, atol=1e-12)
    assert np.ptp(fast, axis=0).max() > 0


def test_what_is_known_of_the_past_is_not_found_again_and_counts():
    extended, values, windows, _ = slow("backlash", "q", value=0.9)
    h = Hypothesis(extended, fixed=values)
    known = h.remembering(windows, h.value)
    theta, starts = np.empty((2, 0)), np.stack([windows.start, windows.start + 0.01])
    half = np.arange(0, len(windows), 2)
    whole = h.simulate(windows, theta, starts)
    np.testing.assert_allclose(h.simulate(known, theta, starts), whole, atol=1e-12)
    np.testing.assert_allclose(h.simulate(known.take(half), theta, starts[:, half]), whole[:, half], atol=1e-12)
    forgotten = replace(known, memory=np.zeros_like(known.memory))
    assert np.abs(h.simulate(forgotten, theta, starts) - whole).max() > 1e-3


def test_memories_lean_with_the_numbers_as_differences_of_passes_say():
    extended, values, windows, _ = slow("supply-sag", "u", sag=0.2, time_constant=3.0)
    names = ("supply_sag_u_sag", "supply_sag_u_time_constant")
    theta = np.array([values[n] for n in names])
    h = Hypothesis(extended, names, theta, 0.1 * theta, 10 * theta, 0.05 * theta, np.full(2, np.inf))
    near, moved = h.leaning(windows, theta), theta * [1.01, 0.98]
    apart = np.abs(h.hidden(windows, moved[None]) - h.hidden(windows, theta[None])).max()
    off = np.abs(h.remembering(near, moved).memory - h.hidden(windows, moved[None])).max()
    assert 0 < off < 0.05 * apart
    half, starts = np.arange(0, len(windows), 2), np.stack([windows.start] * 2)
    whole = h.simulate(near, np.stack([theta, moved]), starts)
    np.testing.assert_allclose(h.simulate(near.take(half), np.stack([theta, moved]), starts[:, half]), whole[:, half])
    np.testing.assert_allclose(whole[0], h.simulate(windows, theta[None], windows.start[None])[0], atol=1e-12)


def test_leaning_memories_end_a_fit_where_whole_passes_do(monkeypatch):
    extended, values, windows, _ = slow("dahl-friction", "q", level=0.3, displacement=0.05)
    windows = replace(windows, measured=replace(windows.measured, sigma=1e-3 * windows.measured.spread))
    names = ("dahl_friction_q_level", "dahl_friction_q_displacement")
    theta = np.array([values[n] for n in names])
    h = Hypothesis(extended, names, theta * [1.2, 0.8], 0.1 * theta, 10 * theta, 0.05 * theta, np.full(2, np.inf))
    passes = []
    own = Hypothesis.hidden
    monkeypatch.setattr(Hypothesis, "hidden", lambda h, w, rows: passes.append(len(rows)) or own(h, w, rows))
    found = fit(h, windows)
    few, passes[:] = sum(passes), []
    monkeypatch.setattr("gapcert_diagnosis.fitting.fit._leaning", lambda h, windows, theta: windows)
    slower = fit(h, windows)
    assert few < 0.7 * sum(passes)
    np.testing.assert_allclose(found.theta, slower.theta, atol=0.02 * slower.interval().max())
    assert found.chi[0] == pytest.approx(slower.chi[0], abs=1e-3)
