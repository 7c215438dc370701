"""The contract that every Effect keeps, as named checks."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from gapcert.components import registry
from gapcert.effect import Effect
from gapcert.measured import Measured
from gapcert.recording import Recording
from gapcert.search import Candidate, Library, Search
from gapcert.system import Array, Model
from gapcert.testing.hide import multisine

ROD: Mapping[str, Any] = {
    "kind": "equations",
    "coordinates": {"q": {"unit": "rad", "kind": "angle"}},
    "inputs": {"u": "N*m"},
    "parameters": {"m": "1 kg", "l": "1 m", "g": "9.81 m/s^2"},
    "mass_matrix": [["m*l**2/3"]],
    "bias": {"q": "m*g*l/2*sin(q)"},
    "forces": {"q": "u"},
    "integrator": "rk4",
    "period": "10 ms",
}
PLAIN: Mapping[str, Any] = {
    "kind": "equations",
    "states": {"q": "m/s"},
    "inputs": {"u": "m/s^2"},
    "parameters": {"k": "0.5 Hz"},
    "derivative": {"q": "u - k*q"},
    "integrator": "rk4",
    "period": "10 ms",
}


def equations(section: Mapping[str, Any]) -> Model:
    """A model from its section, through whatever plugin provides `equations`."""
    known = registry()
    config: Any = known.config("model", section["kind"])
    model: Model = known.build("model", section["kind"], config.model_validate(dict(section)))
    return model


class EffectContract(ABC):
    """Subclass in a test module as `Test…` and supply `effect`: pytest then runs every `test_…` below on it.

    Override `models` where the effect needs other sites than those of a rod under torque and of a first-order lag.
    """

    seconds = 5.0

    @abstractmethod
    def effect(self) -> Effect:
        """A new Effect."""

    def models(self) -> tuple[Model, ...]:
        """The models that it is tried on."""
        return equations(ROD), equations(PLAIN)

    def test_name_is_kebab_case(self) -> None:
        e = self.effect()
        _check(re.fullmatch(r"[a-z]+(-[a-z0-9]+)*", e.name) is not None, f"name is '{e.name}'; expected kebab-case")

    def test_is_described(self) -> None:
        e = self.effect()
        for name in ("sentence", "signature", "experiment"):
            _check(bool(getattr(e, name).strip()), f"{name} is empty; a report has to say it")
        _check(bool(e.parameters), "there is no parameter; expected at least one number that turns the effect on")

    def test_units_parse(self) -> None:
        import pint

        e = self.effect()
        units: Any = pint.application_registry
        for model in self.models():
            for site in model.sites(e.site):
                for p in e.extension(site, model).parameters:
                    try:
                        units.parse_units(p.unit)
                    except (pint.errors.PintError, AttributeError) as error:
                        raise AssertionError(f"unit '{p.unit}' of {p.name} cannot be read: {error}") from None

    def test_starts_lie_within_bounds(self) -> None:
        for p in self.effect().parameters:
            _check(p.low <= p.off <= p.high, f"{p.name}: off = {p.off} is outside [{p.low}, {p.high}]")
            _check(bool(p.starts), f"{p.name} has no start")
            for start in p.starts:
                _check(p.low < start < p.high, f"{p.name}: start {start} is outside ({p.low}, {p.high})")
                _check(start != p.off, f"{p.name}: start {start} is `off`")

    def test_names_are_unique(self) -> None:
        e = self.effect()
        for model in self.models():
            taken = {s.name for s in (*model.states, *model.inputs)} | {p.name for p in model.parameters}
            for site in model.sites(e.site):
                names = [p.name for p in e.extension(site, model).parameters]
                _check(len(names) == len(e.parameters), f"the extension has parameters {names}; expected {len(e.parameters)}")
                _check(not taken & set(names), f"{taken & set(names)} is already a name in the model")
                taken |= set(names)

    def test_off_changes_nothing(self) -> None:
        for model, site, extended in self._extended(on=False):
            gap = np.abs(self._path(extended, model) - self._path(model, model)).max()
            _check(gap <= 1e-12, f"at {site}, switched off, the effect moves the model by {gap:.3g}")

    def test_on_changes_the_motion(self) -> None:
        for model, site, extended in self._extended(on=True):
            gap = np.abs(self._path(extended, model) - self._path(model, model)).max()
            _check(gap > 1e-6, f"at {site}, switched on, the effect changes nothing")

    def test_planted_value_is_found(self) -> None:
        for model, site, extended in self._extended(on=True):
            search, candidate = self._search(model, extended, site)
            fitted = search.settled((candidate,), ((), search.nothing))
            planted = self._values(model, site)
            for name, found in zip(fitted.hypothesis.names, fitted.theta, strict=True):
                near = abs(found - planted[name]) <= 0.01 * abs(planted[name])
                _check(near, f"at {site}: {name} = {planted[name]:.6g} was planted, {found:.6g} was found")

    def _extended(self, on: bool) -> list[tuple[Model, str, Model]]:
        e, out = self.effect(), []
        for model in self.models():
            for site in model.sites(e.site):
                extension = e.extension(site, model)
                values = self._values(model, site) if on else {}
                numbers = tuple(replace(p, value=values.get(p.name, p.value)) for p in extension.parameters)
                out.append((model, site, model.extend([replace(extension, parameters=numbers)])))
        _check(bool(out), f"no model has a site of kind '{e.site}'")
        return out

    def _values(self, model: Model, site: str) -> dict[str, float]:
        """Nearly the last start, in units of the nominal motion."""
        search, candidate = self._search(model, model, site)
        library, parameters = search.library, candidate.effect.parameters
        scales = library.scales(candidate)
        return {n: 0.9 * p.starts[-1] * p.scale(scales) for n, p in zip(library.names(candidate), parameters, strict=True)}

    def _search(self, model: Model, truth: Model, site: str) -> tuple[Search, Candidate]:
        """Noiseless data of `truth`, every output measured, seen by `model`."""
        path, u, e = self._path(truth, model), self._input(model), self.effect()
        channels = {s.name: path[:, i] for i, s in enumerate(model.outputs)}
        channels |= {s.name: u[:, i] for i, s in enumerate(model.inputs)}
        measured = Measured.of(model, Recording.of(np.asarray(np.arange(len(u)) * model.period), channels))
        return Search(Library(model, measured, [e]), measured.windows(measured.samples(1.0))), Candidate(e, site)

    def _input(self, model: Model) -> Array:
        return np.repeat(multisine(self.seconds, model.period, 2.0, (0.3, 4.0), 3), model.nu, axis=1)

    def _path(self, model: Model, nominal: Model) -> Array:
        x0 = np.linspace(0.6, 0.3, nominal.nx)[None]
        return np.asarray(model.rollout(x0, self._input(nominal)[None, :-1]).x[0])


def _check(holds: bool, message: str) -> None:
    if not holds:
        raise AssertionError(message)
