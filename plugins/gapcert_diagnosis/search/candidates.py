"""Every effect at every site of a model, with scales from data: what a search may try, and what it makes of a set of causes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np

from gapcert.plugin import Array, Effect, EffectParameter, Extension, Model, Parameter, difference, position
from gapcert_diagnosis.data.dataset import Dataset, once
from gapcert_diagnosis.fitting.fit import Fit
from gapcert_diagnosis.fitting.hypothesis import Hypothesis
from gapcert_diagnosis.fitting.linearised import sliding, velocity
from gapcert_diagnosis.fitting.step_size import built
from gapcert_diagnosis.results import ORDER
from gapcert_diagnosis.thresholds import THRESHOLDS

EARTH = ("gravity_x", "gravity_y", "gravity_z")  # known, unless the data are a simulator's


@final
@dataclass(frozen=True)
class Candidate:
    """An effect at a site."""

    effect: Effect
    site: str

    @property
    def key(self) -> tuple[str, str]:
        return self.effect.name, self.site

    @property
    def told(self) -> tuple[str, str]:
        """The name that is reported, and the site."""
        return self.effect.variant_of or self.effect.name, self.site


Causes = tuple[Candidate, ...]


@final
class Library:
    """Every effect at every site of a model, with scales from data; a set of causes becomes a Hypothesis.

    moves: what is added at once: an effect at a site, or the same effect at all its sites; seen: what shows in the measured
    values alone, with its numbers, and needs no fit; measured: the data, with what is seen in the noise floor; aside: what
    depends on a position that no output shows, or that never moves; horizon: in s, of the longest rollouts that matter; exact:
    inputs that act as they are logged.
    """

    def __init__(
        self, model: Model, measured: Dataset, effects: Sequence[Effect], horizon: float = 0.0, exact: Sequence[str] = ()
    ) -> None:
        self.model, self.measured, self.horizon, self.exact = model, measured, horizon, exact
        self._extensions: dict[tuple[str, str], Extension] = {}
        self._scales: dict[tuple[str, str], dict[str, float]] = {}
        self._hints: dict[tuple[str, str], list[tuple[float, ...]]] = {}
        self._made: dict[tuple[tuple[str, str], ...], Hypothesis] = {}
        self._models: dict[tuple[Sequence[tuple[str, str]], Sequence[tuple[str, float]]], Model] = {}
        self._restatements: dict[Sequence[tuple[str, float]], Model] = {}
        self._path = np.concatenate(measured.states), np.concatenate(measured.inputs)
        effects = [v for e in effects for v in (e, *(form() for form in e.variants))]
        every = [c for e in effects for s in model.sites(e.site) if self._possible(c := self._scaled(Candidate(e, s)))]
        self.aside = tuple(c for c in every if self._places(c) and not self.scales(c)["position_range"])
        every = [c for c in every if c not in self.aside]
        self.candidates = tuple(c for c in every if not _reads(c.effect))
        self.seen = tuple((c, found) for c in every if (found := self._read(c)) is not None)
        for c, found in self.seen:
            self.measured = self._roughened(c, found)
        forms = {e.name: {f.name for f in e.variants} for e in effects}
        near = {e.name: {n for n, same in e.contains.items() if not same and n != e.variant_of} for e in effects}
        self._contains = {e.name: {*e.contains, *(f for n in near[e.name] for f in forms.get(n, ()))} for e in effects}
        self.moves = (*((c,) for c in self.candidates), *self._everywhere())

    def _scaled(self, c: Candidate) -> Candidate:
        return c if type(c.effect).scaled is Effect.scaled else Candidate(c.effect.scaled(self.scales(c)), c.site)

    def under(self, model: Model, effects: Sequence[Effect] = (), measured: Dataset | None = None) -> Library:
        """Of another model, or of other data."""
        return Library(model, measured or self.measured, effects, self.horizon, self.exact)

    def shows(self, name: str) -> bool:
        """Do measured channels show an input at once, whatever it drives?"""
        at = [s.name for s in self.model.inputs].index(name)
        return bool(np.any(self._direct(at)[:, list(self.measured.columns)]))

    def _direct(self, i: int) -> Array:
        """What a small change of an input adds to the outputs (n, ny), wherever the data are."""
        rows = np.unique(np.linspace(0, len(self._path[0]) - 1, THRESHOLDS.swept_points).astype(np.intp))
        (x, u), m = (a[rows] for a in self._path), self.model
        near = u + THRESHOLDS.tangent_nudge * max(1.0, float(np.abs(u[:, i]).max())) * (np.arange(m.nu) == i)
        return difference(m.outputs, m.output(x, near), m.output(x, u))

    @cached_property
    def idle(self) -> tuple[str, ...]:
        """Inputs that move no state and no output, wherever the data are."""
        rows = np.unique(np.linspace(0, len(self._path[0]) - 1, THRESHOLDS.swept_points).astype(np.intp))
        (x, u), m = (a[rows] for a in self._path), self.model
        still = ~np.any(m.jacobian(x, u)[:, :, m.nx :], axis=(0, 1))
        return tuple(m.inputs[i].name for i in np.flatnonzero(still).tolist() if not np.any(self._direct(i)))

    def _possible(self, c: Candidate) -> bool:
        """Does the effect apply, can the data show it, and is there a tolerance that can be lifted?"""
        if c.effect.site == "output" and c.site not in {s.name for s in self.measured.channels}:
            return False
        if c.effect.site == "input" and c.site in (*self.exact, *self.idle):
            return False
        if not c.effect.applies(c.site, self.model):
            return False
        return self.extension(c).frees is None or self.loosened(c) is not None or self.doubted(c) is not None

    def _places(self, c: Candidate) -> bool:
        """Does what an effect does at a coordinate depend on where that is?"""
        sized = any(name.startswith("position") for p in c.effect.parameters for name in p.dimension)
        return c.effect.site == "coordinate" and (sized or "{q}" in (self.extension(c).force or ""))

    def _read(self, c: Candidate) -> dict[str, float] | None:
        if not _reads(c.effect):
            return None
        channel = [s.name for s in self.measured.channels].index(c.site)
        values, weights = (np.concatenate(a)[:, channel] for a in (self.measured.outputs, self.measured.weights))
        found = c.effect.seen_in(values[weights > 0])
        return None if found is None else {n: found[p.name] for n, p in self.parameters(c).items()}

    def _roughened(self, c: Candidate, found: Mapping[str, float]) -> Dataset:
        """With a noise floor of at least what the effect does to its channel over the range of the motion."""
        x, u = (np.linspace(a.min(axis=0), a.max(axis=0), THRESHOLDS.swept_points) for a in self._path)
        plain, acting = (m.output(x, u) for m in (self.model, self.extended((c,), found)))
        moved = difference(self.model.outputs, acting, plain)[:, list(self.measured.columns)]
        added, known = np.sqrt(np.mean(moved**2, axis=0)), self.measured.rough if self.measured.rough.size else 0.0
        sigma, rough = np.maximum(self.measured.sigma, added), np.maximum(known, np.abs(moved).max(axis=0))
        return replace(self.measured, sigma=sigma, rough=rough)

    def _everywhere(self) -> list[Causes]:
        """The same law at all coordinates, or at all inputs: joints and drives of one make share their faults."""
        groups = [tuple(g) for _, g in itertools.groupby(self.candidates, key=lambda c: c.effect.name)]
        return [g for g in groups if len(g) > 1 and g[0].effect.site in ("coordinate", "input")]

    def charge(self, settings: int = 0) -> float:
        """The fall in score that a cause must bring, chosen among so many settings as well: more rivals tried, more needed."""
        return 12 + 2 * math.log(max(1, len(self.candidates) + settings))

    def extension(self, c: Candidate) -> Extension:
        return once(self._extensions, c.key, lambda: self._extension(c))

    def _extension(self, c: Candidate) -> Extension:
        """What remembers as long as its bounds allow has those of the data."""
        e = c.effect.extension(c.site, self.model)
        if e.delay is None:
            return e
        own = (p.bounds(self.scales(c)) for p in c.effect.parameters)
        numbers = (replace(p, low=low, high=high) for p, (low, high) in zip(e.parameters, own, strict=True))
        return replace(e, parameters=tuple(numbers))

    def freed(self, c: Candidate) -> Parameter | None:
        """The parameter of the model that a candidate frees, as it is stated; None of a law, which has numbers of its own."""
        name = self.extension(c).frees
        return None if name is None else next((p for p in self.model.parameters if p.name == name), None)

    def loosened(self, c: Candidate) -> str | None:
        """The parameter of which a candidate lifts the tolerance: it is among the free numbers of every hypothesis."""
        freed = self.freed(c)
        return None if freed is None or freed.tolerance <= 0 else freed.name

    def doubted(self, c: Candidate) -> float | None:
        """The scale on which a candidate frees a parameter that has no tolerance, but that the model doubts."""
        freed = self.freed(c)
        if freed is None or freed.tolerance > 0 or (freed.name in EARTH and not self.measured.exact):
            return None
        return self.model.doubts.get(freed.name)

    def off(self, c: Candidate) -> list[float]:
        """The numbers at which a candidate changes nothing."""
        return [p.off for p in c.effect.parameters] if (freed := self.freed(c)) is None else [freed.value]

    def contains(self, name: str, other: str) -> bool:
        """Is the law `other` a special case of the law `name`?"""
        direct = self._contains.get(name, set())
        return other in direct or any(self.contains(d, other) for d in direct)

    def related(self, a: Candidate, b: Candidate) -> bool:
        """At one site, is one law a special case of the other, or another form of it?"""
        one, two = a.effect.name, b.effect.name
        return a.told == b.told or (a.site == b.site and (self.contains(one, two) or self.contains(two, one)))

    def simplicity(self, causes: Causes) -> tuple[int, list[int]]:
        """Fewest numbers first, then the order of the contract."""
        order = [ORDER.index(c.told[0]) if c.told[0] in ORDER else len(ORDER) for c in causes]
        return sum(len(c.effect.parameters) for c in causes), sorted(order)

    def scales(self, c: Candidate) -> dict[str, float]:
        """Root mean squares, peaks and ranges of what a site is measured in, and the times of the data."""
        return once(self._scales, (c.effect.site, c.site), lambda: _scales(self, c, *self._path))

    @cached_property
    def moved(self) -> tuple[Array, Array]:
        """What one step along the data adds to the states (n, nx), and what of that the inputs add."""
        x, u = self._path
        off = self.model.step(x, np.zeros_like(u)).x
        return difference(self.model.states, self.plain, x), difference(self.model.states, self.plain, off)

    @cached_property
    def plain(self) -> Array:
        """One step along the data, (n, nx)."""
        return self.model.step(*self._path).x

    def starts(self, c: Candidate) -> Array:
        """First values (s, p) of a candidate's parameters."""
        if (freed := self.freed(c)) is not None:
            scale = self.doubted(c)
            return np.array(
                [[freed.value + s * scale] for s in THRESHOLDS.doubt_starts] if scale is not None else [[freed.value]]
            )
        values = [*c.effect.grid(self.scales(c)), *self.suggested(c)]
        return np.array(values, dtype=np.float64).reshape(-1, len(c.effect.parameters))

    def suggested(self, c: Candidate) -> list[tuple[float, ...]]:
        """First values that the force which the data leave suggests, for an effect that depends on where its site is."""
        if type(c.effect).suggested is Effect.suggested or not self._places(c):
            return []
        with np.errstate(all="ignore"):
            return once(self._hints, c.key, lambda: [r for seen in self._lacking(c.site) for r in c.effect.suggested(*seen)])

    def needles(self, c: Candidate) -> tuple[str, ...]:
        """Which of its numbers have optima so narrow that their differences need a step of their own."""
        return tuple(name for name, p in self.parameters(c).items() if p.step)

    def _lacking(self, site: str) -> Iterator[tuple[Array, Array]]:
        """(places (n,), force (n,)) that the model lacks at a coordinate: along the smoothed path, and where the place is
        measured by its second differences, in which nothing is blunted, and noise is loud.
        """
        x, m = self._path[0], self.measured
        response, name = sliding(self.model, site, *self._path, self.plain), position(self.model, site) or site
        v, at = velocity(self.model, site, response), [s.name for s in self.model.states].index(name)
        rows = np.delete(np.arange(len(x)), np.cumsum([len(s) for s in m.states]) - 1)
        yield x[rows, at], ((x[rows + 1, v] - x[rows, v]) / m.repeat - self.moved[0][rows, v]) / response[rows, v]
        channel = [i for i, s in enumerate(m.channels) if s.name == name and s.name in self.model.coordinates]
        if channel:
            inner = np.setdiff1d(rows, np.cumsum([0, *(len(s) for s in m.states)]))
            y, seen = (np.concatenate(a)[:, channel[0]] for a in (m.outputs, m.weights))
            inner = inner[(seen[inner - 1] > 0) & (seen[inner] > 0) & (seen[inner + 1] > 0)]
            bent = (y[inner + 1] - 2 * y[inner] + y[inner - 1]) / m.period**2 * self.model.period
            yield x[inner, at], (bent - self.moved[0][inner, v]) / response[inner, v]

    def amplitude(self, c: Candidate) -> int | None:
        """Which parameter the effect is linear in."""
        if self.doubted(c) is not None:
            return 0
        return None if c.effect.amplitude is None else [p.name for p in c.effect.parameters].index(c.effect.amplitude)

    def is_factor(self, c: Candidate) -> bool:
        """Is it one factor of an input or an output, 1 where it does nothing?"""
        numbers = c.effect.parameters
        return c.effect.site in ("input", "output") and len(numbers) == 1 and not numbers[0].dimension and numbers[0].off == 1.0

    def names(self, c: Candidate) -> tuple[str, ...]:
        """What a candidate's parameters are called in the extended model."""
        return tuple(p.name for p in self._numbers(c))

    def parameters(self, c: Candidate) -> dict[str, EffectParameter]:
        """By these names, the parameters of the effect."""
        return dict(zip(self.names(c), c.effect.parameters, strict=True))

    def units(self, c: Candidate) -> tuple[str, ...]:
        return tuple(p.unit for p in self._numbers(c))

    def _numbers(self, c: Candidate) -> Sequence[Parameter]:
        """Without the constants that an extension may have besides."""
        return self.extension(c).parameters[: len(c.effect.parameters)] if (freed := self.freed(c)) is None else (freed,)

    def bounds(self, c: Candidate) -> tuple[Array, Array]:
        """(low, high) of a candidate's parameters, in their units."""
        stated, doubt = self.freed(c), self.doubted(c)
        if stated is not None and doubt is not None:
            ends = stated.value - THRESHOLDS.doubt_reach * doubt, stated.value + THRESHOLDS.doubt_reach * doubt
            return np.array([max(ends[0], stated.low)]), np.array([min(ends[1], stated.high)])
        scale = np.array([p.scale(self.scales(c)) for p in c.effect.parameters])
        low, high = np.array([p.bounds(self.scales(c)) for p in c.effect.parameters]).T
        if stated is not None:
            low, high = np.sort([stated.value * low / scale, stated.value * high / scale], axis=0)
            if stated.low < 0:  # A place, or a component, may have either sign.
                low = np.minimum(low, stated.value - THRESHOLDS.doubt_reach * stated.tolerance)
                high = np.maximum(high, stated.value + THRESHOLDS.doubt_reach * stated.tolerance)
            low, high = np.maximum(low, stated.low), np.minimum(high, stated.high)
        return low, high

    def further(self, causes: Causes, fitted: Fit) -> Hypothesis | None:
        """With the edges of levels and forces that numbers lie at ten times as far out; None where none does.

        Not towards where a law does nothing, and not times, which the log limits.
        """
        h, low, high = fitted.hypothesis, fitted.hypothesis.low.copy(), fitted.hypothesis.high.copy()
        for c in causes:
            for name, p in self.parameters(c).items() if self.freed(c) is None else ():
                i = h.names.index(name)
                near = THRESHOLDS.at_bound * (high[i] - low[i])
                if not p.dimension or {"time", "period", "angle"} & set(p.dimension):
                    continue
                if high[i] - fitted.theta[i] < near and p.off < high[i]:
                    high[i] *= 10
                elif fitted.theta[i] - low[i] < near and p.off > low[i] != 0:
                    low[i] *= 10 if low[i] < 0 else 0.1
        moved = np.any(low != h.low) or np.any(high != h.high)
        return replace(h, low=low, high=high) if moved else None

    def within(self, a: Candidate, b: Candidate) -> bool:
        """Does the second law contain the first, at the same site?"""
        return a.site == b.site and self.contains(b.effect.name, a.effect.name)

    def richer(self, a: Candidate, b: Candidate) -> bool:
        """Does one law contain another that is dry or remembers?"""
        return self.contains(a.effect.name, b.effect.name) and bool(self.dry((b,)) or self.extension(b).memory)

    def remembers(self, c: Candidate) -> bool:
        """Is it a law of an input that knows its past?"""
        e = self.extension(c)
        return c.effect.site == "input" and bool(e.memory or e.delay)

    def dry(self, causes: Causes) -> tuple[str, ...]:
        """Parameters of dry friction among them."""
        return tuple(n for c in causes if self.extension(c).dry_friction is not None for n in self.names(c))

    def hypothesis(self, causes: Causes) -> Hypothesis:
        return once(self._made, tuple(c.key for c in causes), lambda: self._hypothesis(causes))

    def _hypothesis(self, causes: Causes) -> Hypothesis:
        model = self.extended(causes, {})
        freed = {self.extension(c).frees for c in causes}
        rows: list[tuple[str, float, float, float, float, float]] = []
        for p in self.model.parameters:
            if p.tolerance > 0 and p.name not in freed:
                far = THRESHOLDS.nuisance_reach * p.tolerance
                near = max(p.low, p.value - far), min(p.high, p.value + far)
                rows.append(
                    (p.name, p.value, *near, THRESHOLDS.nuisance_step * p.tolerance, p.tolerance / THRESHOLDS.tolerance_sigmas)
                )
        for c in causes:
            low, high = (b.tolist() for b in self.bounds(c))
            if (stated := self.freed(c)) is not None:
                doubt = self.doubted(c)
                step = THRESHOLDS.nuisance_step * (stated.tolerance if doubt is None else THRESHOLDS.doubt_starts[-1] * doubt)
                rows.append((stated.name, stated.value, low[0], high[0], step, math.inf))
                continue
            for i, (name, e) in enumerate(self.parameters(c).items()):
                # Numbers that are suggested side by side are as many needles.
                apart = np.diff(np.unique([row[i] for row in self.suggested(c)])).min(initial=math.inf)
                step = min(_step(e, e.scale(self.scales(c))), THRESHOLDS.needle_step * apart if e.step else math.inf)
                rows.append((name, e.off, low[i], high[i], step, math.inf))
        names = tuple(r[0] for r in rows)
        return Hypothesis(model, names, *np.array([r[1:] for r in rows], dtype=np.float64).reshape(-1, 5).T)

    def extended(self, causes: Causes, values: Mapping[str, float]) -> Model:
        """The model with the causes, their parameters at `values` (default: off), and its own where these were fitted too."""
        key = tuple(c.key for c in causes), tuple(sorted(values.items()))
        return once(self._models, key, lambda: self._extended(causes, values))

    def _extended(self, causes: Causes, values: Mapping[str, float]) -> Model:
        extensions = []
        # The first extension of an input acts nearest to the dynamics.
        for c in sorted(causes, key=lambda c: -c.effect.stage):
            extension = self.extension(c)
            numbers = tuple(replace(p, value=float(values.get(p.name, p.value))) for p in extension.parameters)
            extensions.append(replace(extension, parameters=numbers))
        model = self._restated(values)
        return model.extend(extensions) if extensions else model

    def _restated(self, values: Mapping[str, float]) -> Model:
        """With other values of the model's own parameters; a figure asks for few sets of them, with many sets of causes."""
        loose = {
            p.name: float(values[p.name])
            for p in self.model.parameters
            if p.name in values and (p.tolerance > 0 or p.name in self.model.doubts) and values[p.name] != p.value
        }
        if not loose:
            return self.model
        return once(self._restatements, tuple(loose.items()), lambda: _restated(self.model, loose))

    def shared(self, c: Candidate) -> Model:
        """A model in which a candidate is off, and the same law at all other sites too: one program serves all of them."""
        if self.extension(c).frees is not None:
            return self.model
        return self.hypothesis(tuple(k for k in self.candidates if k.effect.name == c.effect.name)).model


def _step(p: EffectParameter, scale: float) -> float:
    return scale * (p.step or THRESHOLDS.difference_step * min(abs(s - p.off) if not p.dimension else abs(s) for s in p.starts))


def _reads(effect: Effect) -> bool:
    return type(effect).seen_in is not Effect.seen_in


def _restated(model: Model, values: Mapping[str, float]) -> Model:
    """With other values of its own parameters, through its own spec."""
    if (own := model.restated(values)) is not None:
        return own
    spec = model.to_spec()
    stated, units = spec["parameters"], {p.name: p.unit for p in model.parameters}
    return built(spec | {"parameters": stated | {n: {**stated[n], "value": f"{v!r} {units[n]}"} for n, v in values.items()}})


def _scales(library: Library, c: Candidate, x: Array, u: Array) -> dict[str, float]:
    model, measured = library.model, library.measured
    times = {
        "period": measured.period,
        "start": float(min(t[0] for t in measured.times)),
        "duration": float(max(t[-1] for t in measured.times) - min(t[0] for t in measured.times)),
        "mass": max((abs(p.value) for p in model.parameters if p.unit == "kg"), default=1.0),
    }
    kind = c.effect.site
    if kind == "input":
        at = [s.name for s in model.inputs].index(c.site)
        own = u[:, at]
        rates = np.abs(np.concatenate([np.diff(a[:, at]) for a in measured.inputs])) / measured.period
        found = {"input_rate": float(rates.mean()) or 1.0, "input_rate_peak": float(rates.max()) or 1.0}
        return times | _levels("input", own) | found | {"input_low": float(own.min()), "input_high": float(own.max())}
    if kind == "output":
        y = np.concatenate(measured.outputs)[:, [s.name for s in measured.channels].index(c.site)]
        return times | _levels("output", y - np.nanmean(y))
    if kind != "coordinate":
        stated = next(p for p in model.parameters if p.name == c.site)
        return times | {"value": abs(stated.value) or stated.tolerance or model.doubts.get(c.site, 1.0)}
    response = sliding(model, c.site, x, u, library.plain)
    v = velocity(model, c.site, response)
    moved, pushed = (a[:, v] for a in library.moved)
    gain = response[:, v]
    name = position(model, c.site)
    place = x[:, [s.name for s in model.states].index(name)] if name else np.ones(1)
    free, driven = _levels("force", moved / gain), _levels("force", pushed / gain)
    force = {k: math.hypot(free[k], driven[k]) for k in free}
    sizes = {
        "position_range": float(np.ptp(place)),
        "mass": max((p.value for p in model.parameters if p.unit == "kg"), default=1.0),
    }
    return times | force | sizes | _levels("velocity", x[:, v]) | _levels("position", place)


def _levels(name: str, values: Array) -> dict[str, float]:
    rms, peak = float(np.sqrt(np.nanmean(values**2))), float(np.nanmax(np.abs(values)))
    return {name: rms or 1.0, f"{name}_peak": peak or 1.0}
