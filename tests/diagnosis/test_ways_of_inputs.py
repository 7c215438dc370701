"""What happens to an input on its way, as it is told: on ovens, valves and carts, simulated by hand in fine steps."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import gapcert as gc
from gapcert_diagnosis import diagnose
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.fitting.fit import fit
from gapcert_diagnosis.search.candidates import Library
from gapcert_diagnosis.testing import equations

FINE = 20
AIR = {"Ta": "290 K"}
OVEN = (
    {"states": {"T": "K"}, "inputs": {"P": "W"}, "period": "4 s"}
    | {
        "parameters": {
            "C": {"value": "11.2 J/K", "tolerance": "4 %"},
            "G": {"value": "0.052 W/K", "tolerance": "4 %"},
            "Ta": "290 K",
        }
    }
    | {"derivative": {"T": "(P - G*(T - Ta))/C"}},
    lambda x, u: np.array([(u - 0.0525 * (x[0] - 290)) / 11.1]),
    290.0,
)
VALVE = (
    {"states": {"y": "V"}, "inputs": {"u": "V"}, "period": "50 ms", "derivative": {"y": "k*u"}}
    | {"parameters": {"k": {"value": "1.72 1/s", "tolerance": "5 %"}}},
    lambda x, u: np.array([1.7 * u]),
    0.0,
)
CART = (
    {"coordinates": {"x": "m"}, "inputs": {"f": "N"}, "period": "10 ms", "mass_matrix": [["m"]]}
    | {"parameters": {"m": {"value": "1.31 kg", "tolerance": "1 %"}, "b": {"value": "2.6 N*s/m", "tolerance": "2 %"}}}
    | {"bias": {"x": "b*x_dot"}, "forces": {"x": "f"}},
    lambda x, u: np.array([x[1], (u - 2.62 * x[1]) / 1.3]),
    0.0,
)

TANKS = (
    {"states": {"low": "m", "high": "m"}, "inputs": {"q": "m^3/s"}, "period": "4 s", "outputs": {"seen": "low"}}
    | {"parameters": {"A": {"value": "0.0515 m^2", "tolerance": "3 %"}, "a": {"value": "1.02e-3 m^2.5/s", "tolerance": "3 %"}}}
    | {"derivative": {"low": "a*(sqrt(abs(high)) - sqrt(abs(low)))/A", "high": "(q - a*sqrt(abs(high)))/A"}},
    lambda x, u: np.array([1e-3 * (np.sqrt(abs(x[1])) - np.sqrt(abs(x[0]))), u - 1e-3 * np.sqrt(abs(x[1]))]) / 0.05,
    0.0,
)
"""One above the other; only the lower one has a gauge."""


def commands(count, hold, seed, low=-1.0):
    """Levels that are held, and a wave on them."""
    rng = np.random.default_rng(seed)
    steps = np.repeat(rng.uniform(low, 1, count // hold + 1), hold)[:count]
    return 0.8 * steps + 0.2 * np.sin(np.arange(count) * 2.1 / hold + seed) * (low < 0)


def delayed(u, seconds, h):
    return np.concatenate([np.full(round(seconds / h), u[0]), u])[: len(u)]


def lagged(u, seconds, h):
    out, z = np.empty_like(u), 0.0
    for k, level in enumerate(u):
        new = level + (z - level) * np.exp(-h / seconds)
        out[k], z = (z + new) / 2, new
    return out


def told(plant, u, way, shown=1.0, effects="all", noise=(0, 0.004, 0.0)):
    """The diagnosis of a plant which the input u (T,) reaches by way(fine input, fine step); noise: draw, share, colour."""
    section, slope, rest = plant
    model = equations({"kind": "equations", "integrator": "rk4", **section})
    h = model.period / FINE
    x, path = np.full(1, rest) if model.nx == 1 else np.zeros(model.nx), []
    acting = way(np.repeat(u, FINE), h).reshape(len(u), FINE)
    for levels in acting:
        path.append(x[0])
        for level in levels:
            x = x + h * slope(x + h / 2 * slope(x, level), level)
    y = shown * np.array(path)
    draw, share, colour = noise
    white = np.random.default_rng(draw).standard_normal(len(y))
    y = y + share * np.std(y) * lfilter([np.sqrt(1 - colour**2)], [1, -colour], white)
    names = model.outputs[0].name, model.inputs[0].name
    recording = gc.Recording.of(np.arange(len(u)) * model.period, dict(zip(names, (y, u), strict=True)), hold="zero")
    return diagnose(model, recording, effects)


def only(found, name):
    """The numbers of the one cause that is named."""
    assert [c.effect for c in found.causes] == [name]
    assert not any(g == ((name, found.causes[0].site),) for g in found.ambiguous_with)
    return {n: p.value for n, p in found.causes[0].parameters.items()}


@pytest.mark.parametrize(
    ("name", "number"), [pytest.param("input-lag", "time_constant", marks=pytest.mark.exam), ("input-delay", "delay")]
)
def test_an_oven_may_be_late_by_minutes(name, number):
    late = delayed if name == "input-delay" else lagged
    found = told(OVEN, 9 * commands(600, 50, 1, low=0.0), lambda u, h: late(u, 80.0, h))
    assert only(found, name) == {number: pytest.approx(80, rel=0.05)}


def rated(u, h, rate, reached=0.0):
    out = np.empty_like(u)
    for k, level in enumerate(u):
        moved = np.clip(level - reached, -rate * h, rate * h)
        out[k], reached = reached + moved / 2, reached + moved
    return out


@pytest.mark.exam
def test_what_acts_at_the_first_samples_only_is_not_nothing():
    """A condenser is switched on, and its amplifier reaches the command within 30 ms; later none is as fast."""
    section = {"states": {"v": "V"}, "inputs": {"u": "V"}, "period": "1 ms", "derivative": {"v": "(u - v)/T"}}
    section |= {"parameters": {"T": {"value": "8.1 ms", "tolerance": "3 %"}}}
    t, circuit = 0.001 * np.arange(900), (section, lambda x, u: np.array([(u - x[0]) / 0.008]), 0.0)
    u = 3 * np.cos(21 * t) + np.sin(34 * t + 0.3)
    some = ["input-rate-limit", "input-saturation", "parameter"]
    found = only(told(circuit, u, lambda u, h: rated(u, h, 110.0), effects=some), "input-rate-limit")
    assert found == {"rate": pytest.approx(110, rel=0.03)}
    assert told(circuit, u, lambda u, h: u, effects=some).verdict == "nothing"


@pytest.mark.parametrize(
    ("name", "number", "held"),
    [
        ("input-lag", 90.0, 8.0),
        *(
            pytest.param(*case, marks=pytest.mark.exam)
            for case in (("input-lag", 90.0, None), ("input-rate-limit", 0.06, None), ("input-delay", 22.0, 3.0))
        ),
    ],
)
def test_a_log_may_begin_at_an_input_that_was_held(name, number, held):
    """At its first input, or at another one that nothing in the log shows."""

    def late(u, h):
        before = u[0] if held is None else held
        if name == "input-delay":
            return delayed(np.concatenate([[before], u]), number, h)[1:]
        return rated(u, h, number, before) if name == "input-rate-limit" else before + lagged(u - before, number, h)

    u = 6 + 5 * commands(600, 30, 12)
    section, slope, _ = OVEN
    found = only(told((section, slope, 290 + (u[0] if held is None else held) / 0.0525), u, late), name)
    assert list(found.values()) == [pytest.approx(number, rel=0.05)]


def test_a_log_may_begin_at_rest_under_an_input_that_it_does_not_show():
    """The heat that holds the first temperature acted before, and not the first one that is logged."""
    u, before = 5 + 4 * commands(500, 30, 4), 5.0
    section, slope, _ = OVEN

    def late(u, h):
        gone = round(120.0 / h)
        return np.concatenate([np.full(gone, before), u])[: len(u)]

    found = told((section, slope, 290 + before / 0.0525), u, late)
    assert abs(u[0] - before) > 0.4
    assert only(found, "input-delay") == {"delay": pytest.approx(120.0, rel=0.02)}


@pytest.mark.exam
@pytest.mark.parametrize("second", ["input-delay", "input-rate-limit"])
def test_what_a_lag_blunts_is_found_behind_it(second):
    def limited(u, h):
        out, reached = np.empty_like(u), 0.0
        for k, level in enumerate(u):
            moved = np.clip(level - reached, -4 * h, 4 * h)
            out[k], reached = reached + moved / 2, reached + moved
        return out

    def way(u, h):
        return lagged(limited(u, h) if second == "input-rate-limit" else delayed(u, 0.21, h), 0.4, h)

    found = told(VALVE, commands(1200, 25, 5), way)
    assert {c.effect for c in found.causes} == {"input-lag", second}


@pytest.mark.exam
def test_a_curve_is_no_answer_where_two_plain_laws_are():
    def way(u, h):
        return 0.7 * np.tanh((u - np.clip(u, -0.03, 0.08)) / 0.7)

    found = told(VALVE, commands(700, 25, 9), way)
    assert {c.effect for c in found.causes} == {"input-dead-zone", "input-saturation"}


def test_two_lags_are_one_of_second_order():
    found = only(told(VALVE, commands(1500, 25, 2), lambda u, h: lagged(lagged(u, 0.3, h), 0.17, h)), "input-lag")
    assert found == {"time_constant": pytest.approx(0.3, rel=0.1), "second": pytest.approx(0.17, rel=0.15)}


def test_a_valve_opens_on_one_side_first():
    found = only(told(VALVE, commands(1500, 25, 3), lambda u, h: u - np.clip(u, -0.05, 0.3)), "input-dead-zone")
    assert found == {"minus": pytest.approx(0.05, abs=0.01), "plus": pytest.approx(0.3, abs=0.01)}


def test_a_valve_opens_wider_to_one_side():
    def acting(u, h):
        return np.maximum(u - 0.2, 0) + 0.6 * np.minimum(u + 0.05, 0)

    found = only(told(VALVE, commands(1500, 25, 6), acting), "input-dead-zone")
    assert (found["minus"], found["plus"]) == (pytest.approx(0.05, abs=0.01), pytest.approx(0.2, abs=0.01))
    assert found["ratio"] == pytest.approx(0.6, rel=0.03)


def test_an_amplifier_bends():
    found = only(told(CART, 5 * commands(1500, 60, 7), lambda u, h: u + 0.02 * u**3), "input-nonlinearity")
    assert found == {"square": pytest.approx(0.0, abs=0.003), "cube": pytest.approx(0.02, rel=0.05)}


@pytest.mark.exam
def test_any_curve_is_drawn_through_the_data():
    levels, bent = np.linspace(-1, 1, 7), np.array([-0.9, -0.75, -0.15, 0.0, 0.4, 0.45, 1.1])
    found = told(VALVE, commands(1500, 25, 8), lambda u, h: np.interp(u, levels, bent))
    numbers = only(found, "input-nonlinearity")
    assert list(numbers) == [f"at_{k}" for k in range(1, len(numbers) + 1)]
    assert all(m.after < 1.5 * m.noise_floor for m in found.residual.values())


def played(u, width):
    out, w = np.empty_like(u), 0.0
    for k, level in enumerate(u):
        out[k] = w = min(max(w, level - width), level + width)
    return out


@pytest.mark.exam
def test_play_of_an_input_is_hysteresis_and_of_the_only_force_as_well_backlash():
    found = only(told(VALVE, commands(1500, 25, 9), lambda u, h: played(u, 0.12)), "input-hysteresis")
    assert found == {"width": pytest.approx(0.12, rel=0.05)}
    cart = told(CART, 5 * commands(1500, 60, 10), lambda u, h: played(u, 0.6))
    assert only(cart, "backlash") == {"width": pytest.approx(0.6, rel=0.05)}
    assert cart.ambiguous_with == ((("input-hysteresis", "f"),),)


@pytest.mark.exam
@pytest.mark.parametrize("bends", [True, False])
def test_a_valve_that_bends_and_plays_is_found_though_it_rumbles(bends):
    """Its levels are held for so long that the free starts of windows hide the play, and its noise grows with what it does."""
    steps = np.linspace(0, 6, 8)
    u = np.repeat(np.concatenate([steps, steps[-2::-1], steps[1:] - 0.1, steps[-2::-1]]), 150)
    x, path = 0.0, []
    for level in 0.7 * np.tanh(played(u, 0.12) / 3.6) * 3.6 if bends else 0.7 * u:
        path.append(x)
        x = level + (x - level) * np.exp(-0.05 / 0.2)
    rumble = np.random.default_rng(3).standard_normal(len(u)) * (0.003 + 0.004 * np.array(path))
    model = equations(
        {"kind": "equations", "integrator": "rk4", "states": {"y": "V"}, "inputs": {"u": "V"}, "period": "50 ms"}
        | {"parameters": {"k": {"value": "0.65", "tolerance": "20 %"}, "tau": {"value": "0.2 s", "tolerance": "50 %"}}}
        | {"derivative": {"y": "(k*u - y)/tau"}}
    )
    recording = gc.Recording.of(np.arange(len(u)) * 0.05, {"y": np.array(path) + rumble, "u": u}, hold="zero")
    found = diagnose(model, recording, horizons=[2.0, 10.0])
    named = {c.effect: c for c in found.causes}
    if not bends:
        assert found.verdict == "nothing"
        return
    assert found.verdict == "causes"
    assert set(named) - {"input-nonlinearity", "input-saturation"} == {"input-hysteresis"}
    assert named["input-hysteresis"].parameters["width"].value == pytest.approx(0.12, rel=0.3)
    assert found.gain["10"]["y"].after < 0.03 * np.std(path)


@pytest.mark.exam
@pytest.mark.parametrize(("plant", "peak", "rate"), [(OVEN, 9.0, 0.06), (VALVE, 1.0, 1.5)])
def test_a_rate_is_looked_for_on_the_scale_of_the_log(plant, peak, rate):
    def acting(u, h):
        out, r = np.empty_like(u), 0.0
        for k, level in enumerate(u):
            new = r + np.clip(level - r, -rate * h, rate * h)
            out[k], r = (r + new) / 2, new
        return out

    u = peak * commands(1000, 50, 14, low=-1.0 if plant is VALVE else 0.0)
    assert only(told(plant, u, acting), "input-rate-limit") == {"rate": pytest.approx(rate, rel=0.05)}


def test_the_edge_of_a_force_moves_out_and_that_of_a_time_does_not():
    model = equations({"kind": "equations", "integrator": "rk4", **CART[0]})
    u = commands(400, 40, 15)
    recording = gc.Recording.of(np.arange(400) * 0.01, {"x": np.cumsum(u) * 1e-4, "f": u}, hold="zero")
    effects = [gc.registry().build("effect", n) for n in ("constant-force", "input-lag", "input-saturation")]
    library = Library(model, Dataset.of(model, recording), effects)
    windows = library.measured.windows(40)
    for c in library.candidates:
        h = library.hypothesis((c,))
        i = [h.names.index(n) for n in library.names(c)]
        at_edge = replace(fit(h, windows, iterations=0), theta=h.high)
        further = library.further((c,), at_edge)
        if c.effect.name == "constant-force":
            assert further.high[i] == pytest.approx(10 * h.high[i])
        else:  # a time is limited by the log, and above its highest level nothing saturates
            assert further is None or (further.high[i] == h.high[i]).all()


@pytest.mark.parametrize("hard", [True, False])
def test_a_limit_is_one_cause_hard_or_soft(hard):
    found = told(CART, 5 * commands(1500, 60, 4), lambda u, h: np.clip(u, -2, 2) if hard else 2.4 * np.tanh(u / 2.4))
    assert only(found, "input-saturation") == {"level": pytest.approx(2.0 if hard else 2.4, rel=0.03)}
    assert found.ambiguous_with == (() if hard else ((("wheel-slip", "x"),),))


def test_nothing_is_found_where_the_input_arrives_as_it_was_sent():
    for plant, low in ((OVEN, 0.0), (VALVE, -1.0), (CART, -1.0)):
        assert told(plant, 5 * commands(1200, 40, 5, low), lambda u, h: u).verdict == "nothing"


@pytest.mark.exam
@pytest.mark.parametrize(
    ("factor", "units"), [(180 / np.pi, "deg/rad"), (0.001, "1000"), (9.80665, "g"), (2.3, None), (0.1, None)]
)
def test_a_gain_may_be_a_slip_of_units(factor, units):
    found = told(CART, 5 * commands(1200, 60, 11), lambda u, h: factor * u)
    (cause,) = found.causes
    assert cause.effect == "input-gain"
    assert cause.parameters["gain"].value == pytest.approx(factor, rel=0.01)
    assert found.summary()["causes"][0].get("unit_slip") == units
    assert [f for f in cause.flags if "slip of units" in f] == [f for f in cause.flags if units]
    assert any("implausible" in f for f in cause.flags) == (factor == 0.1)


def test_a_sensor_may_show_millimetres():
    """Where the motion is linear, that is the same as an input which acts a thousand times as much."""
    (cause,) = told(CART, 5 * commands(1200, 60, 12), lambda u, h: u, 1000.0).causes
    assert cause.effect in ("sensor-scale", "input-gain")
    assert cause.unit_slip == "1000"


def test_a_thermometer_may_show_thousands_of_kelvin():
    """From there to 300 K no slope leads, and a heat that is not there would make up for some of it."""
    (cause,) = told(OVEN, 9 * commands(600, 50, 13, low=0.0), lambda u, h: u, 0.001).causes
    assert (cause.effect, cause.unit_slip) == ("sensor-scale", "1000")


@pytest.mark.exam
@pytest.mark.parametrize(("factor", "noise"), [(57.2958, (1, 0.02, 0.8)), (9.80665, (0, 0.004, 0.0)), (0.001, (0, 0.004, 0.0))])
def test_a_gauge_may_show_another_unit_where_a_level_is_not_seen(factor, noise):
    """The unseen level begins elsewhere, too, once the gauge is read rightly."""
    (cause,) = told(TANKS, 1e-3 * (0.6 + 0.3 * commands(1200, 60, 14)), lambda u, h: u, factor, noise=noise).causes
    assert cause.effect == "sensor-scale"
    assert cause.unit_slip is not None
    assert cause.parameters["scale"].value == pytest.approx(factor, rel=0.05)  # the level goes with the square of a


@pytest.mark.exam
@pytest.mark.parametrize("slow", [True, False])
def test_one_of_two_sensors_may_lag(slow):
    """What both show late would be late before it moves; the one that lags alone does so itself."""
    section = {"kind": "equations", "states": {"v": "V"}, "inputs": {"u": "V"}, "period": "10 ms", "integrator": "rk4"}
    section |= {"parameters": {"T": {"value": "0.2 s", "tolerance": "3 %"}}, "derivative": {"v": "(u - v)/T"}}
    section |= {"outputs": {"near": "v", "far": "0.5*v"}}
    u, rng, h = commands(900, 25, 21), np.random.default_rng(3), 0.01 / FINE
    v, z, rows = 0.0, 0.0, []
    for level in u:
        rows.append((v, 0.5 * z if slow else 0.5 * v))
        for _ in range(FINE):
            before, v = v, level + (v - level) * np.exp(-h / 0.2)
            z += ((before + v) / 2 - z) * -np.expm1(-h / 0.04)
    near, far = (np.array(rows) + 0.002 * rng.standard_normal((len(u), 2))).T
    log = gc.Recording.of(0.01 * np.arange(len(u)), {"near": near, "far": far, "u": u}, hold="zero")
    found = diagnose(equations(section), log, ["sensor-lag", "sensor-delay", "sensor-scale", "input-lag"])
    assert [(c.effect, c.site) for c in found.causes] == ([("sensor-lag", "far")] if slow else [])
    assert not slow or found.causes[0].parameters["time_constant"].value == pytest.approx(0.04, rel=0.05)
