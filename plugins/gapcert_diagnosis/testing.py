"""The contract that every Effect keeps, as named checks."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np
from scipy.interpolate import CubicSpline

from gapcert.plugin import PLAIN, Array, Effect, Model, Recording, expect, multisine, registry

from .data.dataset import Dataset
from .fitting.fit import fit, promising
from .fitting.hypothesis import memories, shows_memory
from .fitting.step_size import built as equations
from .fitting.step_size import stepped
from .search.candidates import Candidate, Library

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
CARRIER: Mapping[str, Any] = {
    **ROD,
    "parameters": {**ROD["parameters"], "m": {"value": "1 kg", "tolerance": "2 %"}},
    "points": {"q": ["l*sin(q)", "-l*cos(q)"]},
}
CART: Mapping[str, Any] = {
    "kind": "equations",
    "coordinates": {"q": "m"},
    "inputs": {"u": "N"},
    "parameters": {"mass": "1 kg", "c": "0.5 N*s/m"},
    "mass_matrix": [["mass"]],
    "bias": {"q": "c*q_dot"},
    "forces": {"q": "u"},
    "integrator": "rk4",
    "period": "10 ms",
}
PAIR: Mapping[str, Any] = {
    "kind": "equations",
    "coordinates": {"q": {"unit": "rad", "kind": "angle"}, "p": {"unit": "rad", "kind": "angle"}},
    "inputs": {"u": "N*m", "w": "N*m"},
    "parameters": {"J": "0.5 kg*m^2", "I": "0.2 kg*m^2", "k": "4 N*m"},
    "mass_matrix": [["J", "0.1*J"], ["0.1*J", "I"]],
    "bias": {"q": "k*sin(q)", "p": "k/2*sin(p)"},
    "forces": {"q": "u", "p": "w"},
    "integrator": "rk4",
    "period": "10 ms",
}
BASE: Mapping[str, Any] = {
    "kind": "equations",
    "states": {"x": "m", "y": "m", "theta": "rad"},
    "inputs": {"v": "m/s", "w": "rad/s"},
    "derivative": {"x": "v*cos(theta)", "y": "v*sin(theta)", "theta": "w"},
    "integrator": "rk4",
    "period": "10 ms",
}


class EffectContract(ABC):
    """Subclass in a test module as `Test…` and supply `effect`: pytest then runs every `test_…` below on it.

    Override `models` where the effect needs other sites than those of a rod under torque, a first-order lag, a rod that can
    carry something, a cart, two coupled joints, and a base on wheels: of these it is tried on the first two where it applies.
    """

    seconds = 5.0
    window = 1.0

    @abstractmethod
    def effect(self) -> Effect:
        """A new Effect."""

    def models(self) -> tuple[Model, ...]:
        """The models that it is tried on."""
        return tuple(map(equations, (ROD, PLAIN, CARRIER, CART, PAIR, BASE)))

    def test_name_is_kebab_case(self) -> None:
        e = self.effect()
        expect(re.fullmatch(r"[a-z]+(-[a-z0-9]+)*", e.name) is not None, f"name is '{e.name}'; expected kebab-case")

    def test_is_described(self) -> None:
        e = self.effect()
        for name in ("sentence", "equation", "signature", "experiment"):
            expect(bool(getattr(e, name).strip()), f"{name} is empty; a report has to say it")
        expect(bool(e.parameters), "there is no parameter; expected at least one number that turns the effect on")

    def test_units_parse(self) -> None:
        import pint

        e = self.effect()
        units: Any = pint.application_registry
        for model, site in self._places():
            for p in e.extension(site, model).parameters:
                try:
                    units.parse_units(p.unit)
                except (pint.errors.PintError, AttributeError) as error:
                    raise AssertionError(f"unit '{p.unit}' of {p.name} cannot be read: {error}") from None

    def test_starts_lie_within_bounds(self) -> None:
        for p in self.effect().parameters:
            expect(bool(p.starts), f"{p.name} has no start")
            for start in p.starts:
                expect(p.low < start < p.high, f"{p.name}: start {start} is outside ({p.low}, {p.high})")
                expect(start != p.off or bool(p.dimension), f"{p.name}: start {start} is `off`")

    def test_grid_lies_within_bounds(self) -> None:
        for case in self._cases:
            low, high = case.library.bounds(case.candidate)
            values = case.library.starts(case.candidate)
            expect(len(values) > 0, f"at {case.site}, the grid is empty")
            out = values[~((values >= low) & (values <= high)).all(axis=1)]
            expect(len(out) == 0, f"at {case.site}, {out[:1]} of the grid is outside [{low}, {high}]")

    def test_relations_name_parameters(self) -> None:
        e = self.effect()
        mine = {p.name for p in e.parameters}
        expect(e.amplitude is None or e.amplitude in mine, f"amplitude '{e.amplitude}' is no parameter; there are {mine}")
        for name, numbers in e.contains.items():
            other: Effect = registry().build("effect", name)
            theirs = {p.name for p in other.parameters}
            expect(other.site == e.site, f"contains '{name}', which acts at another kind of site")
            expect(set(numbers) <= mine, f"contains '{name}' by {set(numbers) - mine}, which it does not have")
            expect(
                not numbers or set(numbers.values()) == theirs,
                f"contains '{name}', whose parameters are {theirs}, by {numbers}",
            )

    def test_names_are_unique(self) -> None:
        e = self.effect()
        for model, _ in self._places():
            taken = {s.name for s in (*model.states, *model.inputs)} | {p.name for p in model.parameters}
            for site in self._where(model):
                extension = e.extension(site, model)
                names = [p.name for p in extension.parameters]
                count = 0 if extension.frees else len(e.parameters)
                expect(len(names) >= count, f"the extension has parameters {names}; expected {count}, then constants")
                names += [m.name for m in extension.memory]
                expect(not taken & set(names), f"{taken & set(names)} is already a name in the model")
                taken |= set(names)

    def test_off_changes_nothing(self) -> None:
        for case in self._cases:
            acting, own = case.library.extended((case.candidate,), {}), case.model
            gap = self._gap(acting, own if acting.substeps == own.substeps else stepped(own, acting.substeps) or own)
            expect(gap <= 1e-12, f"at {case.site}, switched off, the effect moves the model by {gap:.3g}")

    def test_on_changes_the_motion(self) -> None:
        for case in self._cases:
            gap = self._gap(case.truth, case.model)
            expect(gap > 1e-6, f"at {case.site}, switched on, the effect changes nothing")

    def test_canonical_means_the_same(self) -> None:
        e = self.effect()
        for case in self._cases:
            names = dict(zip((p.name for p in e.parameters), case.planted, strict=True))
            for sign in (1.0, -1.0):
                values = {k: case.planted[n] * (sign if k == e.amplitude else 1.0) for k, n in names.items()}
                plain = e.canonical(values)
                if plain == values:
                    continue
                one, two = (
                    case.library.extended((case.candidate,), {names[k]: v for k, v in numbers.items()})
                    for numbers in (values, plain)
                )
                gap = self._gap(one, two)
                expect(gap <= 1e-9, f"at {case.site}, {plain} moves the model by {gap:.3g} more than {values}")

    def test_planted_value_is_found(self) -> None:
        for case in self._cases:
            for name, found in self._found(case).items():
                wanted = case.planted[name]
                near = abs(found - wanted) <= 0.01 * abs(wanted)
                expect(near, f"at {case.site}: {name} = {wanted:.6g} was planted, {found:.6g} was found")

    @cached_property
    def _cases(self) -> tuple[_Case, ...]:
        found = []
        for model, site in self._places():
            c = Candidate(self.effect(), site)
            library = self._library(model, model)
            scales = library.scales(c) | {"value": next((p.value for p in model.parameters if p.name == site), 1.0)}
            values = [0.9 * p.starts[-1] * p.scale(scales) for p in c.effect.parameters]
            planted = dict(zip(library.names(c), values, strict=True))
            found.append(_Case(model, c, library, planted, library.extended((c,), planted)))
        return tuple(found)

    def _places(self) -> list[tuple[Model, str]]:
        """The first site of the first two models that have one."""
        found = [(m, where[0]) for m in self.models() if (where := self._where(m))][:2]
        expect(bool(found), f"no model has a site of kind '{self.effect().site}' where it applies")
        return found

    def _where(self, model: Model) -> list[str]:
        e = self.effect()
        return [s for s in model.sites(e.site) if e.applies(s, model)]

    def _found(self, case: _Case) -> dict[str, float]:
        """By a fit from the best point of the grid; or read off the values, where the effect says that it can be."""
        library, c = self._library(case.model, case.truth), case.candidate
        names, m = library.names(c), library.measured
        if c.effect.site == "output":
            at = [s.name for s in m.channels].index(c.site)
            seen = c.effect.seen_in(np.concatenate(m.outputs)[:, at])
            if seen is not None:
                return {n: seen[p.name] for n, p in library.parameters(c).items()}
        windows = m.windows(m.samples(self.window))
        h = library.hypothesis((c,))
        rows = np.tile(h.value, (len(library.starts(c)), 1))
        rows[:, [h.names.index(n) for n in names]] = library.starts(c)
        theta, start, _ = promising(h, windows, rows, windows.start)
        fitted = fit(h, windows, theta=theta, start=start, iterations=40)
        return {n: float(fitted.theta[h.names.index(n)]) for n in names}

    def _library(self, model: Model, truth: Model) -> Library:
        """Noiseless data of `truth`, every output measured, seen by `model`."""
        shown, u = self._shown(truth, model), self._input(model)
        channels = {s.name: shown[:, i] for i, s in enumerate(model.outputs)}
        channels |= {s.name: u[:, i] for i, s in enumerate(model.inputs)}
        recording = Recording.of(np.asarray(np.arange(len(u)) * model.period), channels)
        return Library(model, Dataset.of(model, recording), [self.effect()])

    def _input(self, model: Model) -> Array:
        """Another signal at every input."""
        waves = [multisine(self.seconds, model.period, 2.0, (0.3, 4.0), 3 + i) for i in range(model.nu)]
        return np.concatenate(waves, axis=1)

    def _gap(self, one: Model, two: Model) -> float:
        return float(np.abs(self._shown(one, two) - self._shown(two, two)).max())

    def _shown(self, model: Model, nominal: Model) -> Array:
        """What a motion shows (T, ny), each output as late as it is."""
        u = self._input(nominal)
        x0 = np.linspace(0.6, 0.3, nominal.nx)[None]
        x, known = model.fast_rollout(x0, u[None, :-1]).x, None
        if shows_memory(model):
            known = memories(model, x, u[None, :-1], {}, np.array([model.hidden_default]), 1)[0]
        y = model.output(x[0], u, None, known)
        t = np.arange(len(u)) * model.period
        late = model.output_delays()
        return np.stack([y[:, i] if d == 0 else CubicSpline(t, y[:, i])(t - d) for i, d in enumerate(late)], axis=-1)


@final
@dataclass(frozen=True)
class _Case:
    """An effect on one model: nearly its last start (in units of the nominal motion) is planted into `truth`."""

    model: Model
    candidate: Candidate
    library: Library
    planted: Mapping[str, float]
    truth: Model

    @property
    def site(self) -> str:
        return self.candidate.site
