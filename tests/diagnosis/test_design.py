"""Experiments that tell rivals apart: designed from the fits alone, played on a system that shares no code with them."""

import itertools
import math
import re
from dataclasses import replace

import numpy as np
import pytest

import gapcert as gc
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.experiment import BACK, Limits, Rivalry, design, shapes
from gapcert_diagnosis.fitting.fit import fit, promising
from gapcert_diagnosis.results import Experiment
from gapcert_diagnosis.search.candidates import Library
from gapcert_diagnosis.search.criterion import better
from gapcert_diagnosis.testing import ROD, equations

PERIOD, FINE = 0.01, 20
NOISE = 2e-3
LOOSE = {**ROD, "parameters": {**ROD["parameters"], "m": {"value": "1 kg", "tolerance": "2 %"}}}


def swing(u, law, seed, x0=(0.0, 0.05), noise=NOISE):
    """A rod of 1.01 kg under a law the hard way: fine explicit steps, and sticking by clamping the velocity."""
    h, m = PERIOD / FINE, 1.01
    q, v = x0
    lag, bristle, path = 0.0, 0.0, np.empty(len(u))
    late = round(law.get("delay", 0.0) / h)
    fine = np.concatenate([np.zeros(late), np.repeat(u, FINE)])
    for k in range(len(u) * FINE):
        if k % FINE == 0:
            path[k // FINE] = q
        command = fine[k]
        if "lag" in law:
            lag += h / law["lag"] * (command - lag)
            command = lag
        force = command - law.get("viscous", 0.0) * v - law.get("quadratic", 0.0) * v * abs(v) + law.get("constant", 0.0)
        if "dahl" in law:
            bristle += h * (v - abs(v) * bristle / law["width"])
            force -= law["dahl"] * bristle / law["width"]
        force -= m * 9.81 / 2 * math.sin(q)
        dry = 3 * h / m * law.get("coulomb", 0.0)
        free = v + 3 * h / m * force
        v = math.copysign(max(abs(free) - dry, 0.0), free)
        q += h * v
    noise = noise * np.random.default_rng(seed).standard_normal(len(path))
    return gc.Recording.of(np.arange(len(u)) * PERIOD, {"q": path + noise, "u": np.asarray(u, dtype=float)})


T = np.arange(1200) * PERIOD
SAME = [("constant-force", "q"), ("input-offset", "u")]
# The truth, (it, its rival), and an input under which they look alike.
CASES = {
    "delay and lag": ({"delay": 0.03}, [("input-delay", "u"), ("input-lag", "u")], 1.5 * np.sin(2 * np.pi * 0.35 * T)),
    "quadratic and viscous": (
        {"quadratic": 0.05},
        [("quadratic-drag", "q"), ("viscous-friction", "q")],
        0.4 * np.sin(2 * np.pi * 0.3 * T) * np.minimum(T / 3, 1),
    ),
    "Coulomb and constant": ({"coulomb": 0.08}, [("coulomb-friction", "q"), ("constant-force", "q")], 0.08 + 0.25 * T),
    "Dahl and Coulomb": (
        {"dahl": 0.1, "width": 0.004},
        [("dahl-friction", "q"), ("coulomb-friction", "q")],
        1.5 * np.sin(2 * np.pi * 0.4 * T),
    ),
}


def fitted(library, windows, key):
    c = next(c for c in library.candidates if c.key == key)
    h, starts = library.hypothesis((c,)), library.starts(c)
    rows = np.tile(h.value, (len(starts), 1))
    rows[:, [h.names.index(n) for n in library.names(c)]] = starts
    theta, start, _ = promising(h, windows, rows, windows.start)
    return fit(h, windows, theta=theta, start=start)


def rivals(recording, keys):
    model = equations(LOOSE)
    measured = Dataset.of(model, recording)
    windows = measured.windows(120)
    library = Library(model, measured, [gc.registry().build("effect", name) for name, _ in keys])
    return model, measured, [fitted(library, windows, key) for key in keys]


def together(*recordings):
    return gc.Recording(tuple(t for r in recordings for t in r.trajectories))


@pytest.mark.exam
@pytest.mark.parametrize("name", CASES)
def test_the_experiment_tells_rivals_apart_that_the_data_do_not(name):
    truth, keys, u = CASES[name]
    log = swing(u, truth, 1)
    model, measured, (right, wrong) = rivals(log, keys)
    limits = Limits.of(model, measured, {"u": [-2, 2], "q": ["-1.5 rad", "1.5 rad"]})
    found, separable, _ = design([Rivalry(*keys, right, wrong)], measured, limits, 120)
    assert separable == (True,)
    again, same = (rivals(together(log, swing(v, truth, 2)), keys)[2] for v in (found.inputs["u"], u))
    assert better(*again) > max(100, 3 * better(*same))
    # It is within the limits on the system itself, which neither rival knows exactly.
    assert np.abs(found.inputs["u"]).max() <= 2
    assert np.abs(swing(found.inputs["u"], truth, 3).trajectories[0].channels["q"]).max() < 1.6
    assert found.separation > 0.1
    assert found.sentence.startswith(
        f"to tell {keys[0][0]} at {keys[0][1]} from {keys[1][0]} at {keys[1][1]}: play {found.name}"
    )
    assert found.name not in found.others


def test_what_no_input_separates_has_no_experiment():
    _, measured, fits = rivals(swing(np.sin(2 * np.pi * 0.35 * T), {"constant": 0.08}, 1), SAME)
    model = fits[0].hypothesis.model
    found = design([Rivalry(*SAME, *fits)], measured, Limits.of(model, measured, {"u": [-3, 3]}), 120)
    assert found == (None, (False,), {})
    nothing_to_play = Limits({}, {"q": (-1.0, 1.0)}, 12.0)
    assert design([Rivalry(*SAME, *fits)], measured, nothing_to_play, 120) == (None, (False,), {})


@pytest.mark.parametrize("delay", [0.04, 0.15])
def test_late_inputs_and_a_late_sensor_are_one_to_every_input(delay):
    """What is promised is what comes: a late sensor is in what its rival has to copy, and what no fit knows does not count."""
    log = swing(0.3 * np.sin(2 * np.pi * 0.5 * T) + 0.2 * np.sin(2 * np.pi * 1.3 * T), {"delay": delay}, 4)
    keys = [("input-delay", "u"), ("sensor-delay", "q")]
    model, measured, fits = rivals(log, keys)
    assert abs(better(*fits)) < 10
    found, separable, besides = design([Rivalry(*keys, *fits)], measured, Limits.of(model, measured, {"u": [-1, 1]}, 4.0), 120)
    assert (found, separable) == (None, (False,))
    # A second sensor, which is not late, shows which it is.
    assert besides == {0: "measure q_dot as well, with noise of 1 % of its deviation or less"}


def test_an_experiment_stays_where_the_recording_was_and_says_how_far_it_goes():
    truth, keys, u = CASES["delay and lag"]
    log = swing(u, truth, 1)
    model, measured, fits = rivals(log, keys)
    recorded = log.trajectories[0].channels["q"]
    found, separable, _ = design([Rivalry(*keys, *fits)], measured, Limits.of(model, measured, seconds=6.0), 120)
    assert separable == (True,)
    went = swing(found.inputs["u"], truth, 3).trajectories[0].channels["q"]
    told = found.travel["q"]
    low, high, room = told.low, told.high, 0.05 * np.ptp(recorded)
    assert told.unit == "rad"
    assert np.allclose(told.recorded, (recorded.min(), recorded.max()), atol=room)
    speed = np.abs(np.diff(went)).max() / PERIOD
    assert told.speed <= told.recorded_speed
    assert abs(speed - told.speed) < 2.5 * NOISE / PERIOD * math.sqrt(2)
    assert recorded.min() - room < went.min()
    assert went.max() < recorded.max() + room
    assert np.allclose((low, high), (went.min(), went.max()), atol=room)


def test_the_pair_that_is_hardest_to_separate_decides_and_the_rest_is_said():
    truth, keys, u = CASES["Coulomb and constant"]
    log = swing(u, truth, 1)
    model, measured, fits = rivals(log, [*keys, ("input-offset", "u")])
    pairs = [Rivalry(keys[1], ("input-offset", "u"), fits[1], fits[2]), Rivalry(*keys, *fits[:2])]
    found, separable, _ = design(pairs, measured, Limits.of(model, measured, {"q": [-3, 3]}, 6.0), 120)
    assert separable == (False, True)
    assert found.rivals == tuple(keys)
    assert len(found.t) == 600


def test_one_input_serves_all_pairs_and_what_is_promised_of_each_is_found_when_it_is_played():
    truth, _, u = CASES["quadratic and viscous"]
    keys = [(name, "q") for name in ("quadratic-drag", "viscous-friction", "coulomb-friction")]
    log = swing(0.5 * u, truth, 1)
    model, measured, fits = rivals(log, keys)
    known = list(zip(keys, fits, strict=True))
    pairs = [Rivalry(a, b, f, g) for (a, f), (b, g) in itertools.combinations(known, 2)]
    found, separable, besides = design(pairs, measured, Limits.of(model, measured, {"u": [-2, 2], "q": [-1.5, 1.5]}), 120)
    assert (separable, besides) == ((True, True, True), {})
    assert [(p.one, p.other) for p in found.apart] == [(p.named, p.other) for p in pairs]
    start = [found.start[n][0] for n in ("q", "q_dot")]
    best, *others = rivals(together(log, swing(found.inputs["u"], truth, 2, start)), keys)[2]
    assert all(better(best, other) > 100 for other in others)
    # As a diagnosis of both logs holds out the last quarter of each.
    both = Dataset.of(model, together(log, swing(found.inputs["u"], truth, 2, start, noise=0.0).split({"last": 0.25})[0]))
    windows = replace(both, sigma=measured.sigma).windows(round(found.window / PERIOD))
    second = windows.place[:, 0] == 1
    for p, (_, rival) in zip(found.apart, known[1:], strict=False):
        left = fit(rival.hypothesis, windows, theta=rival.theta).residual[second]
        assert np.sqrt(np.mean(left**2)) == pytest.approx(p.if_one, rel=0.2)


def test_an_experiment_begins_and_ends_at_rest_where_the_recording_was():
    """It went one way only: at the end of its range there is no room, so it begins farther in, under an input that is held."""
    truth, keys, u = CASES["Coulomb and constant"]
    model, measured, fits = rivals(swing(u, truth, 1), keys)
    found, separable, _ = design([Rivalry(*keys, *fits)], measured, Limits.of(model, measured), 120)
    assert separable == (True,)
    (q, _), (speed, _), (held, unit) = (found.start[n] for n in ("q", "q_dot", "u"))
    assert (speed, unit) == (0.0, "N*m")
    assert abs(held - 1.01 * 9.81 / 2 * math.sin(q)) < 0.1
    low, high = found.travel["q"].recorded
    assert low + 0.05 * (high - low) < q < high - 0.05 * (high - low)
    assert found.inputs["u"][-1] == pytest.approx(held)
    went = (
        swing(np.concatenate([np.full(5, held), found.inputs["u"]]), truth, 3, (q, 0.0), noise=0.0)
        .trajectories[0]
        .channels["q"]
    )
    assert low - 0.01 * (high - low) < went.min() < went.max() < high + 0.01 * (high - low)
    assert np.abs(np.diff(went)).max() / PERIOD < 1.05 * found.travel["q"].recorded_speed


def test_what_only_wider_limits_tell_apart_is_said_with_where_they_lead():
    truth, keys, u = CASES["Coulomb and constant"]
    model, measured, fits = rivals(swing(u, truth, 1), keys)
    narrow = Limits.of(model, measured, {"u": [0.0, 0.02]})
    found, separable, besides = design([Rivalry(*keys, *fits)], measured, narrow, 120)
    assert (found, separable) == (None, (False,))
    assert re.match(
        r"where the machine may, let u go from .* N\*m and q from .* rad \(diagnose.experiment.limits\)", besides[0]
    )


def test_what_drifts_comes_back():
    # A free mass: velocity and place after an input are its sum and its second sum.
    log = swing(np.sin(T), {}, 1)
    inputs = shapes({"u": (-1.0, 1.0)}, 12.0, Dataset.of(equations(LOOSE), log), 0)
    back = [u[:, 0] for name, u in inputs.items() if name.endswith("there and back")]
    assert len(back) == len(BACK)
    for u in back:
        speed = np.cumsum(u)
        assert abs(speed[-1]) < 1e-9 * np.abs(speed).max()
        assert abs(speed.sum()) < 1e-9 * np.abs(np.cumsum(speed)).max()


@pytest.mark.parametrize(("low", "high"), [(-1.0, 1.0), (0.5, 2.5), (-3.0, -1.0), (0.0, 4.0)])
def test_inputs_use_their_limits_and_keep_them(low, high):
    log = swing(np.sin(T), {}, 1)
    made = shapes({"u": (low, high)}, 12.0, Dataset.of(equations(LOOSE), log), 0)
    for name, u in made.items():
        assert low - 1e-12 <= u.min() <= u.max() <= high + 1e-12, name
    assert np.ptp(made["switching"]) == high - low
    assert np.ptp(made["a multisine"]) > 0.7 * (high - low)


def test_the_file_is_played_and_read_again(tmp_path):
    t = np.arange(20) * PERIOD
    made = Experiment((("a", "q"), ("b", "q")), "steps", "", t, {"u": np.sin(t)}, 1.0)
    (tmp_path / "play.csv").write_text(made.csv())
    section = {"kind": "csv", "files": [str(tmp_path / "play.csv")], "time": "t", "columns": {"u": "u"}}
    known = gc.registry()
    recording = known.build("reader", "csv", known.config("reader", "csv").model_validate(section)).read()
    assert np.allclose(recording.trajectories[0].channels["u"], np.sin(t), rtol=1e-8)
    assert np.allclose(recording.trajectories[0].t, t)


@pytest.mark.parametrize(
    ("limits", "says"),
    [
        ({"torque": [-1, 1]}, "'torque' is no input or measured output; there are u, q"),
        ({"u": [1, -1]}, r"limits.u: found \[1, -1\]; expected \[low, high\] with low < high"),
        ({"u": ["-1 m", "1 m"]}, "unit 'm' does not fit"),
    ],
)
def test_limits_that_make_no_sense_are_refused(limits, says):
    model, measured, _ = rivals(swing(np.sin(2 * np.pi * 0.35 * T), {}, 1), [])
    with pytest.raises(gc.UsageError, match=says):
        Limits.of(model, measured, limits)


def test_limits_come_from_the_data_where_none_are_given():
    model, measured, _ = rivals(swing(np.sin(2 * np.pi * 0.35 * T), {}, 1), [])
    limits = Limits.of(model, measured)
    assert np.allclose(limits.inputs["u"], [-1, 1], atol=0.01)
    low, high = (getattr(np.concatenate(measured.outputs), f)() for f in ("min", "max"))
    assert low <= limits.outputs["q"][0] < limits.outputs["q"][1] <= high
