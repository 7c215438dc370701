"""Every first-party effect keeps the contract, and the contract catches what it is for."""

from dataclasses import replace
from pathlib import Path
from typing import ClassVar, final

import numpy as np
import pytest

import gapcert as gc
from gapcert.testing import EffectContract
from gapcert_diagnosis.results import ORDER
from gapcert_diagnosis.testing import CARRIER, PAIR, equations
from gapcert_effects.friction import ViscousFriction
from gapcert_effects.plugin import HOMES

NAMES = [name for effects in HOMES.values() for name in effects if not name.startswith("contact-")]
CHECKS = [c for c in dir(EffectContract) if c.startswith("test_")]
VARIANTS = [form for name in NAMES for form in gc.registry().build("effect", name).variants]
ENGINES = {"contact-friction", "contact-restitution", "engine-setting"}


def test_the_page_says_how_late_is_too_late():
    page = " ".join((Path(__file__).parents[2] / "docs" / "effects.md").read_text().split())
    shares = {"a tenth": 0.1, "a twentieth": 0.05, "lags up to all": 1.0}
    late = [gc.registry().build("effect", n).parameters[0] for n in ("input-delay", "sensor-delay", "input-lag")]
    for (said, share), p in zip(shares.items(), late, strict=True):
        assert said in page
        assert p.longest == share
        assert p.high == float("inf") or f"(and {p.high:g} samples)" in page


@pytest.mark.parametrize("period", [0.001, 0.1, 20.0])
@pytest.mark.parametrize("name", ["input-delay", "input-lag", "sensor-delay"])
def test_times_are_looked_for_on_the_scale_of_the_log(name, period):
    effect, scales = gc.registry().build("effect", name), {"period": period, "duration": 800 * period}
    (low, high), tried = effect.parameters[0].bounds(scales), np.array(effect.grid(scales))[:, 0]
    assert low == 0 < tried[0] < period < 40 * period <= high <= 800 * period
    assert tried[-1] < high
    assert (tried[1:] / tried[:-1] < 2).all()


@pytest.mark.contract
@pytest.mark.parametrize("name", [*NAMES, *(form.name for form in VARIANTS)])
def test_keeps_the_contract(name):
    class Contract(EffectContract):
        def effect(self):
            return next((form() for form in VARIANTS if form.name == name), None) or gc.registry().build("effect", name)

    contract = Contract()
    for check in CHECKS:
        getattr(contract, check)()


@pytest.mark.parametrize("name", NAMES)
def test_is_declared_under_its_name(name):
    effect = gc.registry().build("effect", name)
    assert effect.name == name
    assert effect.sentence == gc.registry().get("effect", name).summary
    assert effect.family
    for others in (effect.rivals, effect.contains, effect.equivalent):
        assert set(others) <= set(NAMES) - {name}
        assert all(others.values())


def test_other_forms_of_a_cause_are_named_as_it_is():
    for name in NAMES:
        effect = gc.registry().build("effect", name)
        for form in effect.variants:
            assert form.name not in NAMES
            assert (form.variant_of, form.site, form.stage, form.family) == (name, effect.site, effect.stage, effect.family)
            assert form.sentence == effect.sentence
            assert set(form.rivals) <= set(NAMES)


def test_every_name_of_the_contract_is_there():
    assert set(NAMES) | ENGINES == set(ORDER)


def test_equivalence_is_mutual():
    effects = {n: gc.registry().build("effect", n) for n in NAMES}
    for name, effect in effects.items():
        assert all(effects[other].equivalent[name] == where for other, where in effect.equivalent.items())


@pytest.mark.exam
@pytest.mark.parametrize("section", [CARRIER, PAIR])
def test_all_at_once_are_one_model_that_changes_nothing_while_they_are_off(section):
    model = equations(section)
    effects = sorted((gc.registry().build("effect", n) for n in NAMES), key=lambda e: -e.stage)
    extensions = [e.extension(s, model) for e in effects for s in model.sites(e.site) if e.applies(s, model)]
    extended = model.extend(extensions)
    again = equations(extended.to_spec())
    assert again == extended
    assert len(extended.parameters) == len(model.parameters) + sum(len(e.parameters) for e in extensions)
    x0, u = [[0.4, 0.2, -0.3, 0.1][: model.nx]], [[[1.0, -0.5][: model.nu]] * 40]
    plain = equations({**section, "substeps": extended.substeps})
    assert abs(extended.rollout(x0, u).x - plain.rollout(x0, u).x).max() < 1e-12


class Broken(gc.plugin.Effect):
    """Viscous friction with a fault."""

    name = "viscous-friction"
    site = "coordinate"
    parameters = ViscousFriction.parameters
    sentence = equation = signature = experiment = "something"
    amplitude = "coefficient"

    def extension(self, site, model):
        return ViscousFriction().extension(site, model)

    def changed(self, site, model, **changes):
        return replace(ViscousFriction().extension(site, model), **changes)


@final
class BadName(Broken):
    name = "Viscous_Friction"


@final
class Silent(Broken):
    signature = " "


@final
class BadUnit(Broken):
    def extension(self, site, model):
        (c,) = ViscousFriction().extension(site, model).parameters
        return self.changed(site, model, parameters=(replace(c, unit="furlongs*zorkmid"),))


@final
class BadStart(Broken):
    parameters = (gc.plugin.EffectParameter("coefficient", {"force": 1, "velocity": -1}, (40.0,), 0.0, 30.0),)


@final
class BadGrid(Broken):
    def grid(self, scales):
        return [(1e3 * scales["force"] / scales["velocity"],)]


@final
class BadRelation(Broken):
    contains: ClassVar = {"quadratic-drag": {"coefficient": "factor"}}


@final
class BadAmplitude(Broken):
    amplitude = "factor"


@final
class Mirrored(Broken):
    def canonical(self, values):
        return {k: abs(v) for k, v in values.items()}


@final
class Clash(Broken):
    def extension(self, site, model):
        (c,) = ViscousFriction().extension(site, model).parameters
        return self.changed(site, model, parameters=(replace(c, name=model.parameters[0].name),))


@final
class NeverOff(Broken):
    def extension(self, site, model):
        (c,) = ViscousFriction().extension(site, model).parameters
        return self.changed(site, model, parameters=(replace(c, value=1e-6),))


@final
class Dead(Broken):
    def extension(self, site, model):
        (c,) = ViscousFriction().extension(site, model).parameters
        return self.changed(site, model, force=f"-0*{c.name}*{{v}}")


FAULTS = [
    (BadName, "test_name_is_kebab_case", "expected kebab-case"),
    (Silent, "test_is_described", "signature is empty"),
    (BadUnit, "test_units_parse", "cannot be read"),
    (Clash, "test_names_are_unique", "already a name in the model"),
    (BadStart, "test_starts_lie_within_bounds", "start 40.0 is outside"),
    (BadGrid, "test_grid_lies_within_bounds", "of the grid is outside"),
    (BadRelation, "test_relations_name_parameters", "whose parameters are"),
    (BadAmplitude, "test_relations_name_parameters", "is no parameter"),
    (Mirrored, "test_canonical_means_the_same", "moves the model by"),
    (NeverOff, "test_off_changes_nothing", "switched off, the effect moves the model"),
    (Dead, "test_on_changes_the_motion", "changes nothing"),
    (Dead, "test_planted_value_is_found", "was planted"),
]


@pytest.mark.parametrize(("fault", "check", "says"), FAULTS, ids=[f"{f.__name__}-{c}" for f, c, _ in FAULTS])
def test_a_planted_fault_is_caught(fault, check, says):
    class Contract(EffectContract):
        def effect(self):
            return fault()

    with pytest.raises(AssertionError, match=says):
        getattr(Contract(), check)()


@pytest.mark.parametrize("check", CHECKS)
def test_every_check_has_a_planted_fault(check):
    assert check in {c for _, c, _ in FAULTS}


def plant(unit, mechanical):
    """A plant of one state, or of one coordinate, in a unit."""
    inputs = {"u": f"{unit}/s**2" if mechanical else unit}
    where = {"coordinates": {"q": unit}, "mass_matrix": [["1"]], "bias": {"q": "k*q"}, "parameters": {"k": "2 1/s^2"}}
    rates = {"states": {"q": unit}, "derivative": {"q": "(u - q)/tau"}, "parameters": {"tau": "2 s"}}
    whole = {**where, "forces": {"q": "u"}} if mechanical else rates
    config = (
        gc.registry()
        .config("model", "equations")
        .model_validate({"kind": "equations", "period": "10 ms", "inputs": inputs, **whole})
    )
    return gc.registry().build("model", "equations", config, gc.Context(None))


DRY = {"coulomb-friction", "stribeck-friction", "asymmetric-coulomb-friction", "load-dependent-friction", "cogging"}
WET = {"viscous-friction", "asymmetric-viscous-friction", "quadratic-drag"}


@pytest.mark.parametrize("mechanical", [True, False])
@pytest.mark.parametrize("unit", ["m", "rad", "m/s", "rad/s", "1", "K", "V", "Pa", "C", "m^3"])
def test_what_only_bodies_do_is_offered_only_where_something_moves(unit, mechanical):
    """A level in m is no speed, and stands still as a charge, a pressure and a temperature do."""
    moving = unit in (("m", "rad", "1") if mechanical else ("m/s", "rad/s", "1"))
    model = plant(unit, mechanical)
    offered = {n for n in gc.registry().names("effect") if gc.registry().build("effect", n).site == "coordinate"}
    offered = {n for n in offered if gc.registry().build("effect", n).applies("q", model)}
    named = DRY if mechanical else DRY - {"cogging"}
    assert offered & DRY == (named if moving else set())
    assert offered & WET == (WET if mechanical or moving else set())
    assert {"constant-force", "external-push"} <= offered
