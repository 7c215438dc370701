"""What a diagnosis draws: laws that data alone suggest, beside those that were named."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import gapcert as gc
from gapcert.contracts.data.effect import site_units
from gapcert.contracts.data.units import pretty
from gapcert.testing import multisine
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.figure import correlation, figure
from gapcert_diagnosis.fitting.fit import fit
from gapcert_diagnosis.fitting.rollout_error import stretches
from gapcert_diagnosis.results import Correction
from gapcert_diagnosis.search.candidates import Library
from gapcert_diagnosis.testing import equations

PERIOD, SECONDS, NOISE = 0.01, 16.0, 1e-3
PENDULUM = {
    "kind": "equations",
    "coordinates": {"q": "rad"},
    "inputs": {"u": "N*m"},
    "parameters": {"m": {"value": "1 kg", "tolerance": "2 %"}, "l": "1 m", "g": "9.81 m/s^2"},
    "mass_matrix": [["m*l**2/3"]],
    "bias": {"q": "m*g*l/2*sin(q)"},
    "forces": {"q": "u"},
    "integrator": "rk4",
    "period": f"{PERIOD} s",
}


def pendulum():
    config = gc.registry().config("model", "equations").model_validate(PENDULUM)
    return gc.registry().build("model", "equations", config, gc.Context(Path()))


def effect(name):
    return gc.registry().build("effect", name)


def acting(model, name, site, values):
    extension = effect(name).extension(site, model)
    return replace(extension, parameters=tuple(replace(p, value=v) for p, v in zip(extension.parameters, values, strict=True)))


def drawn(hidden, named, correction=None, **parameters):
    """The figure of a fit of `named` to data with `hidden`; both {(effect, site): values}."""
    model = pendulum()
    true = model.extend([acting(model, *key, values) for key, values in hidden.items()]) if hidden else model
    u = multisine(SECONDS, PERIOD, 2.5, (0.2, 1.5), seed=3)
    x = true.rollout(np.array([[0.3, 0.0]]), u[None], parameters=parameters or None).x[0, :-1]
    y = true.output(x, u)[:, 0] + NOISE * np.random.default_rng(2).standard_normal(len(u))
    fitting, held = gc.Recording.of(PERIOD * np.arange(len(u)), {"q": y, "u": u[:, 0]}).split({"last": 0.25})
    measured = Dataset.of(model, fitting)
    library = Library(model, measured, [effect(n) for n, _ in named])
    causes = tuple(next(c for c in library.candidates if c.key == key) for key in named)
    windows = measured.windows(120)

    def fitted(some, base=None):
        h = library.hypothesis(some)
        start = {n: v for c in some for n, v in zip(library.names(c), named[c.key], strict=True)}
        return fit(h, windows, theta=np.array([start.get(n, v) for n, v in zip(h.names, h.value, strict=True)]))

    judge = stretches(replace(Dataset.of(model, held), sigma=measured.sigma, spread=measured.spread), [1.0])[0]
    search = SimpleNamespace(library=library, windows=windows, fit=fitted)
    return figure(search, causes, fitted(causes), judge, correction=correction)


COULOMB, VISCOUS = ("coulomb-friction", "q"), ("viscous-friction", "q")


@pytest.fixture(scope="module")
def right():
    return drawn({COULOMB: (0.1,)}, {COULOMB: (0.1,)})


def test_the_named_law_goes_through_what_the_data_ask_for(right):
    law = right.laws[0]
    assert (law.title, law.x_label, law.y_label) == ("Coulomb friction at q", "q_dot [rad/s]", "missing force [N*m]")
    assert (law.shape, law.lead) == ("line", True)
    moving = np.abs(law.x) > 0.2
    assert moving.sum() >= 12
    assert law.half[moving].mean() < 0.06
    expected = -0.1 * np.sign(law.x[moving])
    inside = np.abs(law.y[moving] - expected) <= law.half[moving]
    assert inside.mean() > 0.8
    assert np.abs(law.law[np.abs(law.at) > 0.2] + 0.1 * np.sign(law.at[np.abs(law.at) > 0.2])).max() < 0.005


def test_a_law_that_is_wrong_misses_what_the_data_ask_for(right):
    """The planted fault: viscous friction drawn through data of dry friction."""
    law = drawn({COULOMB: (0.1,)}, {VISCOUS: (0.1,)}).laws[0]
    assert law.title == "viscous friction at q"

    def missed(one):
        line = np.interp(one.x, one.at, one.law)
        far = np.abs(one.x) > 0.2
        return (np.abs(one.y - line)[far] > one.half[far]).mean()

    assert missed(law) > 0.4 > 0.25 > missed(right.laws[0])
    dry = np.sign(law.x) * law.y
    assert np.median(dry[np.abs(law.x) > 0.2]) == pytest.approx(-0.1, rel=0.2), "the data still ask for dry friction"


def test_what_is_left_is_nothing_against_every_quantity(right):
    left = [law for law in right.laws if law.title == "what is left at q"]
    assert [law.x_label for law in left] == ["q_dot [rad/s]", "q [rad]", "u [N*m]"]
    for law in left:
        assert not law.lead
        assert law.at.size == law.law.size == 0
        assert (np.abs(law.y) <= law.half).mean() > 0.8


def test_the_waterfall_and_the_tests_of_noise(right):
    assert right.waterfall.labels == ("none of the causes", "Coulomb friction at q")
    assert right.waterfall.error[1] < 0.3 * right.waterfall.error[0]
    own, driven = right.correlations
    assert (own.against, driven.against) == ("itself", "u")
    assert np.abs(own.before[0]) > 0.9
    assert (np.abs(own.after) < own.band).mean() > 0.8
    assert driven.lag[0] == -driven.lag[-1]
    (course,) = right.courses
    assert course.after == pytest.approx(np.ones(len(course.t)), abs=0.3)
    assert course.before.max() > 5
    (channel,) = right.channels
    assert len(channel.t) == 100


def test_correlation_follows_its_lag():
    a = np.random.default_rng(0).standard_normal((3, 200))
    late = np.roll(a, 5, axis=1)
    assert np.argmax(correlation(late, a, 10)) == 10 + 5
    assert correlation(a, a, 3)[3] == pytest.approx(1)


def test_a_law_with_memory_is_a_loop_over_position():
    law = drawn({("dahl-friction", "q"): (0.15, 0.1)}, {("dahl-friction", "q"): (0.15, 0.1)}).laws[0]
    assert (law.shape, law.x_label) == ("loop", "q [rad]")
    assert set(law.rising) == {0.0, 1.0}
    assert law.y[law.rising == 1].mean() < -0.05 < 0.05 < law.y[law.rising == 0].mean()
    assert np.isnan(law.at).any()


def test_an_input_is_drawn_against_itself():
    law = drawn({("input-dead-zone", "u"): (0.4,)}, {("input-dead-zone", "u"): (0.4,)}).laws[0]
    assert (law.x_label, law.y_label) == ("u [N*m]", "missing input [N*m]")
    far = law.at > 0.6
    assert law.law[far] == pytest.approx(-0.4, rel=0.1)


def test_a_parameter_is_drawn_where_it_acts():
    law = drawn({}, {("parameter", "m"): (1.3,)}, m=np.array([1.3])).laws[0]
    assert law.title == "parameter m at q"
    assert law.lead
    assert np.ptp(law.law) > 0.2


def test_a_sensor_is_drawn_against_its_reading():
    found = drawn({("sensor-scale", "q"): (1.2,)}, {("sensor-scale", "q"): (1.2,)})
    law = next(one for one in found.laws if one.title == "sensor scale at q")
    assert (law.x_label, law.y_label) == ("q [rad]", "added to the reading [rad]")
    slope = np.polyfit(law.x, law.y, 1)[0]
    assert slope == pytest.approx(0.2, rel=0.15)


def test_where_nothing_is_named_the_correction_goes_through_what_is_left():
    model = pendulum()
    extension = acting(model, "viscous-friction", "q", (0.1,))
    found = drawn({VISCOUS: (0.1,)}, {}, Correction("q", "basis", {"q_dot": -0.1}, 0.9, extension))
    law = found.laws[0]
    assert (law.title, law.named, law.lead) == ("what is left at q", "correction from data", True)
    assert np.polyfit(law.at, law.law, 1)[0] == pytest.approx(-0.1, rel=0.05)
    assert np.polyfit(law.x, law.y, 1)[0] == pytest.approx(-0.1, rel=0.2)
    assert found.waterfall is None
    assert np.array_equal(found.channels[0].before, found.channels[0].after)


def test_where_the_mass_matrix_is_a_number_a_force_is_an_acceleration():
    """In volts per second squared: an electronic oscillator weighs nothing."""
    section = {"kind": "equations", "coordinates": {"y": "V"}, "inputs": {"u": "V"}, "parameters": {"k": "1 1/s^2"}}
    model = equations({**section, "mass_matrix": [["1"]], "bias": {"y": "k*y"}, "forces": {"y": "k*u"}, "period": "1 ms"})
    units = site_units(model, "coordinate", "y")
    (stiffness,) = gc.registry().build("effect", "cubic-spring").parameters
    assert units["force"] == "V/s**2"
    assert pretty(stiffness.unit(units)) == "V/s²/V³"
    assert pretty("kg*m^2/s**5/A") == "kg·m²/s⁵/A"
