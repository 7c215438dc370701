"""Every first-party effect keeps the contract, and the contract catches what it is for."""

from dataclasses import replace
from typing import final

import pytest

import gapcert as gc
from gapcert.testing import EffectContract
from gapcert_effects import laws
from gapcert_effects.plugin import NAMES


class TestViscousFriction(EffectContract):
    def effect(self):
        return laws.ViscousFriction()


class TestCoulombFriction(EffectContract):
    def effect(self):
        return laws.CoulombFriction()


class TestQuadraticDrag(EffectContract):
    def effect(self):
        return laws.QuadraticDrag()


class TestConstantForce(EffectContract):
    def effect(self):
        return laws.ConstantForce()


class TestInputGain(EffectContract):
    def effect(self):
        return laws.InputGain()


class TestInputDelay(EffectContract):
    def effect(self):
        return laws.InputDelay()


@pytest.mark.parametrize("name", NAMES)
def test_is_declared_under_its_name(name):
    effect = gc.registry().build("effect", name)
    assert effect.name == name
    assert set(effect.rivals) <= set(NAMES) - {name}


class Broken(gc.Effect):
    """Viscous friction with a fault."""

    name = "viscous-friction"
    site = "coordinate"
    parameters = laws.ViscousFriction.parameters
    sentence = signature = experiment = "something"

    def extension(self, site, model):
        return laws.ViscousFriction().extension(site, model)

    def changed(self, site, model, **changes):
        return replace(laws.ViscousFriction().extension(site, model), **changes)


@final
class BadName(Broken):
    name = "Viscous_Friction"


@final
class Silent(Broken):
    signature = " "


@final
class BadUnit(Broken):
    def extension(self, site, model):
        (c,) = laws.ViscousFriction().extension(site, model).parameters
        return self.changed(site, model, parameters=(replace(c, unit="furlongs*zorkmid"),))


@final
class BadStart(Broken):
    parameters = (gc.EffectParameter("coefficient", {"force": 1, "velocity": -1}, (40.0,), 0.0, 30.0),)


@final
class Clash(Broken):
    def extension(self, site, model):
        (c,) = laws.ViscousFriction().extension(site, model).parameters
        return self.changed(site, model, parameters=(replace(c, name=model.parameters[0].name),))


@final
class NeverOff(Broken):
    def extension(self, site, model):
        (c,) = laws.ViscousFriction().extension(site, model).parameters
        return self.changed(site, model, parameters=(replace(c, value=1e-6),))


@final
class Dead(Broken):
    def extension(self, site, model):
        (c,) = laws.ViscousFriction().extension(site, model).parameters
        return self.changed(site, model, force=f"-0*{c.name}*{{v}}")


FAULTS = [
    (BadName, "test_name_is_kebab_case", "expected kebab-case"),
    (Silent, "test_is_described", "signature is empty"),
    (BadUnit, "test_units_parse", "cannot be read"),
    (BadStart, "test_starts_lie_within_bounds", "start 40.0 is outside"),
    (Clash, "test_names_are_unique", "already a name in the model"),
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


@pytest.mark.parametrize("check", [c for c in dir(EffectContract) if c.startswith("test_")])
def test_every_check_has_a_planted_fault(check):
    assert check in {c for _, c, _ in FAULTS}
