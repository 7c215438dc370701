"""Which causes: candidates are added and dropped while the score pays for it, and later data have the last word."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from gapcert.components import registry
from gapcert.effect import Effect, EffectParameter, site_units
from gapcert.evidence import Fit, Hypothesis, fit, promising
from gapcert.measured import Measured, Windows
from gapcert.system import Array, Extension, Model, Parameter, difference

MOST = 3  # causes; more than that are stand-ins for a law that the library lacks
SLIGHT, LATE = 0.006, 0.1  # share of the effort at a site, of a sampling period: nothing smaller is named
FALL = 0.03  # least relative fall of the squared residual
AGREE = 0.15  # least share of the excess over the noise that the guard must see explained
REACH = 3.0  # tolerances that a stated parameter may be off before that is itself a cause
FULL = 15  # iterations of a fit that counts
KEEP = 2  # candidates that get a full fit after a short one
SHAKES, SETTLED, CLOSE = (0.93, 1.05), 1.1, 2.0  # restarts of dry laws that are close to the best, but not yet at the noise
TIE = 10.0  # scores closer than this cannot be told apart


@final
@dataclass(frozen=True)
class Candidate:
    """An effect at a site."""

    effect: Effect
    site: str

    @property
    def key(self) -> tuple[str, str]:
        return self.effect.name, self.site


Causes = tuple[Candidate, ...]
Found = tuple[Causes, Fit]


@final
class Library:
    """Every effect at every site of a model, with scales from data; a set of causes becomes a Hypothesis."""

    def __init__(self, model: Model, measured: Measured, effects: Sequence[Effect]) -> None:
        self.model = model
        self.candidates = tuple(Candidate(e, s) for e in effects for s in model.sites(e.site))
        self.period = measured.period
        self._path = np.concatenate(measured.states), np.concatenate(measured.inputs)
        self._scales: dict[tuple[str, str], dict[str, float]] = {}
        self._made: dict[tuple[tuple[str, str], ...], Hypothesis] = {}

    @property
    def threshold(self) -> float:
        """The fall in score that a cause must bring: more rivals tried, more needed."""
        return 12 + 2 * math.log(max(1, len(self.candidates)))

    def scales(self, c: Candidate) -> dict[str, float]:
        """Root mean squares of force, velocity, position and input at a site."""
        key = (c.effect.site, c.site)
        if key not in self._scales:
            self._scales[key] = _scales(self.model, c, *self._path)
        return self._scales[key]

    def starts(self, c: Candidate) -> Array:
        """First values (s, p) of a candidate's parameters, `off` among them."""
        columns = [np.array([p.off, *(p.scale(self.scales(c)) * s for s in p.starts)]) for p in c.effect.parameters]
        return np.stack(np.meshgrid(*columns, indexing="ij"), axis=-1).reshape(-1, len(columns))

    def names(self, c: Candidate) -> tuple[str, ...]:
        """What a candidate's parameters are called in the extended model."""
        return tuple(p.name for p in c.effect.named(c.site, self.model))

    def matters(self, causes: Causes, fitted: Fit) -> bool:
        """Is every cause larger than what an integrator may leave: a share of the effort, or of a sample's time?"""
        values = dict(zip(fitted.hypothesis.names, fitted.theta, strict=True))

        def large(c: Candidate, name: str, p: EffectParameter) -> bool:
            least = LATE * self.period if "time" in p.dimension else SLIGHT * p.scale(self.scales(c))
            return bool(abs(values[name] - p.off) > least)

        return all(any(large(c, n, p) for n, p in zip(self.names(c), c.effect.parameters, strict=True)) for c in causes)

    def dry(self, causes: Causes) -> tuple[str, ...]:
        """Parameters of dry friction among them."""
        return tuple(
            n for c in causes if c.effect.extension(c.site, self.model).dry_friction is not None for n in self.names(c)
        )

    def hypothesis(self, causes: Causes) -> Hypothesis:
        key = tuple(c.key for c in causes)
        if key not in self._made:
            self._made[key] = self._hypothesis(causes)
        return self._made[key]

    def _hypothesis(self, causes: Causes) -> Hypothesis:
        model = self.extended(causes, {})
        loose = [p for p in self.model.parameters if p.tolerance > 0]
        rows = [
            (p.name, p.value, max(p.low, p.value - far), min(p.high, p.value + far), 0.1 * p.tolerance, p.tolerance)
            for p in loose
            for far in (REACH * p.tolerance,)
        ]
        for c in causes:
            for name, p in zip(self.names(c), c.effect.parameters, strict=True):
                scale = p.scale(self.scales(c))
                step = 0.1 * scale * min(abs(s - p.off if not p.dimension else s) for s in p.starts)
                rows.append((name, p.off, p.low * scale, p.high * scale, step, np.inf))
        names = tuple(r[0] for r in rows)
        return Hypothesis(model, names, *np.array([r[1:] for r in rows], dtype=np.float64).reshape(-1, 5).T)

    def extended(self, causes: Causes, values: dict[str, float]) -> Model:
        """The model with the causes, their parameters at `values` (default: off), and its own where these were fitted too."""
        extensions = []
        for c in causes:
            extension = c.effect.extension(c.site, self.model)
            numbers = tuple(replace(p, value=values.get(p.name, p.value)) for p in extension.parameters)
            extensions.append(replace(extension, parameters=numbers))
        model = _restated(self.model, values)
        return model.extend(extensions) if extensions else model


def _restated(model: Model, values: dict[str, float]) -> Model:
    """With other values of its uncertain parameters, through its own spec."""
    loose = {p.name: f"{values[p.name]!r} {p.unit}" for p in model.parameters if p.tolerance > 0 and p.name in values}
    if not loose:
        return model
    spec = model.to_spec()
    stated = spec["parameters"]
    spec["parameters"] = stated | {n: {**stated[n], "value": text} for n, text in loose.items()}
    known = registry()
    section: Any = known.config("model", spec["kind"])
    restated: Model = known.build("model", spec["kind"], section.model_validate(spec))
    return restated


def probe(model: Model, site: str, x: Array, u: Array) -> Array:
    """∂x⁺/∂f (n, nx) for a force f at a coordinate, held for one period."""
    force = Parameter("probe_force", 0.0, site_units(model, "coordinate", site)["force"])
    pushed = model.extend([Extension("probe", site, (force,), force=force.name)])
    on, off = (pushed.step(x, u, parameters={"probe_force": f}).x for f in (1.0, 0.0))
    return difference(model.states, on, off)


def velocity(model: Model, site: str, response: Array) -> int:
    """The column of the state that a force at `site` changes first: by period/inertia, its integral by a period less."""
    return int(np.argmax(np.abs(response).max(axis=0)))


def _scales(model: Model, c: Candidate, x: Array, u: Array) -> dict[str, float]:
    def rms(a: Array) -> float:
        return float(np.sqrt(np.mean(a**2))) or 1.0

    units = site_units(model, c.effect.site, c.site)
    if "input" in units:
        return {"input": rms(u[:, [s.name for s in model.inputs].index(c.site)])}
    if "force" not in units:
        return {}
    response = probe(model, c.site, x, u)
    v = velocity(model, c.site, response)
    moved = difference(model.states, model.step(x, u).x, x)[:, v]
    pushed = difference(model.states, model.step(x, u).x, model.step(x, np.zeros_like(u)).x)[:, v]
    gain = response[:, v]
    positions = [i for i, s in enumerate(model.states) if s.name == c.site]
    return {
        "force": math.hypot(rms(moved / gain), rms(pushed / gain)),
        "velocity": rms(x[:, v]),
        "position": rms(x[:, positions[0]]) if positions else 1.0,
    }


def better(new: Fit, old: Fit) -> float:
    """ΔS: how far the score of `new` lies below that of `old`, both under the whiteness of the closer fit."""
    closer = new if new.chi.sum() < old.chi.sum() else old
    return old.score(closer.whiteness) - new.score(closer.whiteness)


@final
class Search:
    """Forward steps and drops on some windows; every set of causes is fitted once."""

    def __init__(self, library: Library, windows: Windows, progress: Callable[[str], None] = lambda text: None) -> None:
        self.library, self.windows, self.progress = library, windows, progress
        self._fits: dict[frozenset[tuple[str, str]], Found] = {}
        self.nothing = self.fit((), None)

    def fit(self, causes: Causes, base: Found | None, iterations: int = FULL) -> Fit:
        """From `base`, the fit of a set that differs by at most one cause; a short fit is only looked at, not kept."""
        key = frozenset(c.key for c in causes)
        if key in self._fits:
            return self._fits[key][1]
        result = self._fit(causes, base, iterations)
        if iterations >= FULL:
            self._fits[key] = causes, result
        return result

    def _fit(self, causes: Causes, base: Found | None, iterations: int) -> Fit:
        h = self.library.hypothesis(causes)
        if base is None:
            return fit(h, self.windows, iterations=iterations)
        known = dict(zip(base[1].hypothesis.names, base[1].theta, strict=True))
        theta = np.array([known.get(n, v) for n, v in zip(h.names, h.value, strict=True)])
        start = base[1].start
        if len(start) != len(self.windows):
            start = self.windows.start
        for c in causes:
            names = self.library.names(c)
            if names[0] not in known:
                rows = np.tile(theta, (len(self.library.starts(c)), 1))
                rows[:, [h.names.index(n) for n in names]] = self.library.starts(c)
                theta, start = promising(h, self.windows, rows, start)
        return fit(h, self.windows, theta=theta, start=start, iterations=iterations)

    def settled(self, causes: Causes, base: Found) -> Fit:
        """The best of a fit and of fresh ones from nearby: sticking puts kinks into the cost, and a fit may catch on one."""
        best, dry = self.fit(causes, base), self.library.dry(causes)
        for factor in SHAKES if dry and best.chi.max() > SETTLED else ():
            theta = best.theta * np.where([n in dry for n in best.hypothesis.names], factor, 1.0)
            best = min(best, fit(best.hypothesis, self.windows, theta=theta), key=lambda f: float(f.chi.sum()))
        self._fits[frozenset(c.key for c in causes)] = causes, best
        return best

    def additions(self, causes: Causes, base: Found, without: Causes = (), hope: float = -np.inf) -> list[Found]:
        """Fits of `causes` with one more, best first; a short fit decides which are worth a full one.

        None at all where no short fit lowers the score of `base` by more than `hope`.
        """
        taken = {c.key for c in (*causes, *without)}
        short = []
        for c in self.library.candidates:
            if c.key not in taken:
                self.progress(" + ".join(f"{e} at {s}" for e, s in (*(c.key for c in causes), c.key)))
                short.append(((*causes, c), self.fit((*causes, c), base, iterations=3)))
        short = ranked(short)
        if not short or better(short[0][1], base[1]) <= hope:
            return []
        near = [f for _, f in short[KEEP:] if -better(f, short[0][1]) < TIE]
        full = ranked([(s, self.fit(s, (s, f))) for s, f in short[: KEEP + len(near)]])
        close = [s for s, f in full if f.chi.sum() < CLOSE * full[0][1].chi.sum()]
        return ranked([(s, self.settled(s, (s, f)) if s in close else f) for s, f in full])

    def forward(self) -> Found:
        """Add the best cause while it pays, and after each drop those that no longer do."""
        causes: Causes = ()
        now = self.nothing
        while len(causes) < MOST:
            found = [f for f in self.additions(causes, (causes, now), hope=0.0) if self.library.matters(*f)]
            if not found or not self._pays(found[0][1], now):
                break
            (causes, now), before = found[0], causes
            causes, now = self.drop(causes, now)
            if causes == before:
                break
        return causes, now

    def drop(self, causes: Causes, now: Fit) -> Found:
        for c in causes[:-1]:
            rest = tuple(k for k in causes if k is not c)
            without = self.fit(rest, (causes, now))
            if not self._pays(now, without):
                return self.drop(rest, without)
        return causes, now

    def _pays(self, new: Fit, old: Fit) -> bool:
        fell = new.chi < (1 - FALL) * old.chi
        return bool(fell.any()) and better(new, old) > self.library.threshold

    def agreed(self, causes: Causes, now: Fit, guard: Windows) -> Found:
        """What is left of a set once later data are asked: first about the whole, then about each cause without it."""
        if not causes or not _agrees(now, self.nothing, guard):
            return (), self.nothing
        for c in reversed(causes):
            rest = tuple(k for k in causes if k is not c)
            without = self.fit(rest, (causes, now))
            if rest and not _agrees(now, without, guard):
                return self.agreed(rest, without, guard)
        return causes, now


def ranked(found: Sequence[Found]) -> list[Found]:
    """Best score first, all under the whiteness of the closest fit."""
    if not found:
        return []
    whiteness = min((f for _, f in found), key=lambda f: float(f.chi.sum())).whiteness
    return sorted(found, key=lambda f: f[1].score(whiteness))


def judged(fitted: Fit, windows: Windows) -> Fit:
    """The same numbers on other windows; only the starts are free."""
    return fit(fitted.hypothesis.holding(fitted.theta), windows)


def _agrees(new: Fit, old: Fit, guard: Windows) -> bool:
    after, before = (judged(f, guard).chi for f in (new, old))
    worst = int(np.argmax(before))
    return bool(before[worst] - after[worst] >= max(AGREE * (before[worst] - 1), 1e-9))
