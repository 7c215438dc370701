"""Models as people write them, divided by an inertia, without dimension, in volts: what `validate` takes can be diagnosed."""

import numpy as np
import pytest
import yaml

import gapcert as gc
from gapcert.plugin import load_spec
from gapcert_equations.text import units

# Coordinates, parameters, mass matrix, bias, units of forces and of viscous friction, inertia, stiffness per inertia.
FORMS = {
    "moments": ({"q": "rad"}, {"J": "0.5 kg*m^2", "k": "4 N*m"}, "J", "k*sin(q)", "N*m", "N*m/(rad/s)", 0.5, 8.0),
    "over the inertia": ({"q": "rad"}, {"k": "8 1/s^2"}, "1", "k*sin(q)", "1/s^2", "1/s", 1.0, 8.0),
    "over the mass": (
        {"q": "rad"},
        {"g": "9.81 m/s^2", "l": "0.7 m"},
        "l**2",
        "g*l*sin(q)",
        "m^2/s^2",
        "m^2/s",
        0.49,
        9.81 / 0.7,
    ),
    "over mass and length": ({"q": "rad"}, {"g": "9.81 m/s^2", "l": "0.7 m"}, "l", "g*sin(q)", "m/s^2", "m/s", 0.7, 9.81 / 0.7),
    "a length over the mass": ({"q": "m"}, {"k": "8 1/s^2"}, "1", "k*sin(q/a)*a", "m/s^2", "1/s", 1.0, 8.0),
    "forces": ({"q": "m"}, {"m": "2 kg", "k": "16 N/m"}, "m", "k*sin(q/a)*a", "N", "N*s/m", 2.0, 8.0),
    "volts": ({"q": "V"}, {"k": "8 1/s^2"}, "1", "k*sin(q/v)*v", "V/s^2", "1/s", 1.0, 8.0),
    "no dimension": ({"q": "1"}, {"k": "8 1/s^2"}, "1", "k*sin(q)", "1/s^2", "1/s", 1.0, 8.0),
}


def section(form):
    coordinates, parameters, mass, bias, force, *_ = FORMS[form]
    whole = {"coordinates": coordinates, "parameters": parameters | {"a": "1 m", "v": "1 V"}, "mass_matrix": [[mass]]}
    return {"kind": "equations", "period": "10 ms", **whole, "bias": {"q": bias}, "inputs": {"u": force}, "forces": {"q": "u"}}


def model_of(data):
    config = gc.registry().config("model", "equations").model_validate(data)
    return gc.registry().build("model", "equations", config, gc.Context(None))


@pytest.mark.parametrize("form", FORMS)
def test_every_effect_fits_the_units_of_the_model_where_it_applies(form):
    model, offered = model_of(section(form)), 0
    for name in gc.registry().names("effect"):
        effect = gc.registry().build("effect", name)
        for site in model.sites(effect.site):
            if effect.applies(site, model):
                again = model.extend([effect.extension(site, model)])
                assert model_of({"kind": "equations", **again.to_spec()}).parameters == again.parameters
                offered += 1
    assert offered > 20


@pytest.mark.exam
@pytest.mark.parametrize("form", FORMS)
def test_what_a_normalised_model_lacks_is_found_and_saved_in_its_units(form, tmp_path):
    """Friction of 0.3 per inertia, in a log from small steps of another integrator."""
    *_, unit, inertia, stiffness = FORMS[form]
    rng, h, samples = np.random.default_rng(3), 1e-3, 2000
    held, q, v, rows = rng.normal(size=samples // 5).repeat(5) * 2.0, 0.6, 0.0, []
    for k, u in enumerate(held):
        rows.append((k * 0.01, q + 1e-3 * rng.normal(), inertia * u))
        for _ in range(10):
            v += h * (u - stiffness * np.sin(q) - 0.3 * v)
            q += h * v
    np.savetxt(tmp_path / "log.csv", rows, "%.7g", ",", header="t,q,u", comments="")
    spec = {
        "version": 1,
        "name": "form",
        "model": {k: v for k, v in section(form).items() if k != "period"},
        "recording": {"kind": "csv", "files": ["log.csv"], "columns": {"q": "q", "u": "u"}, "hold": "zero"},
        "diagnose": {"effects": ["viscous-friction", "constant-force", "input-gain"]},
        "report": {"html": False, "rerun": False},
    }
    (tmp_path / "form.yaml").write_text(yaml.safe_dump(spec))
    found = gc.run(tmp_path / "form.yaml", out=tmp_path / "runs")
    (cause,) = found.diagnosis.causes
    (number,) = cause.parameters.values()
    assert (cause.effect, cause.site) == ("viscous-friction", "q")
    assert number.value == pytest.approx(0.3 * inertia, rel=0.03)
    assert units.unit(number.unit)[0] == units.unit(unit)[0]
    assert load_spec(found.folder / "extended.yaml").config.model is not None


@pytest.mark.parametrize("text", ["0.63 1", "-2.5e-3 1", " 7  1 "])
def test_a_number_without_dimension_may_say_so(text):
    value = float(text.split()[0])
    assert units.quantity(text) == (value, "1")
    data = section("no dimension") | {"parameters": {"k": "8 1/s^2", "n": text}, "bias": {"q": "n*k*q"}}
    assert {p.name: p.value for p in model_of(data).parameters}["n"] == value


@pytest.mark.parametrize("text", ["0.63 2", "0.631x 1", "1 1 1", "0.63 11"])
def test_two_numbers_are_no_quantity(text):
    with pytest.raises(ValueError, match=r"expected a number with a unit|unknown unit"):
        units.unit(units.quantity(text)[1])
