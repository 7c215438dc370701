"""Effects whose law is text, and what a site of a model is like: can a law act there?"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Literal

import numpy as np

import gapcert as gc
from gapcert.plugin import Effect, EffectParameter, Extension, Memory, magnitude, site_units
from gapcert_effects.plugin import SENTENCES
from gapcert_effects.thresholds import THRESHOLDS

_LENGTHS = ("m", "mm", "cm", "km")
NEVER = 1e15  # a limit that nothing reaches; exact in min and max, and within rounding elsewhere
_SITE = {name: f"{{{name}}}" for name in "qvufyth"}
"""Placeholders of an Extension, which the model fills."""


class Law(Effect):
    """An effect that its attributes say whole; its sentence is that of its declaration.

    adds: of an Extension (`force`, `input`, …) → text, where `{level}` is the parameter `level` under its name at the site, and
    `{memory}` the name of the hidden state; memory: that state, its unit perhaps `{force}` or `{input}`, those of the site;
    where: what must hold of a site and a model for the effect to act there. site: a coordinate, unless the law says otherwise.
    """

    site: Literal["coordinate", "input", "output", "parameter", "contact"] = "coordinate"
    adds: ClassVar[Mapping[str, str]] = {}
    memory: ClassVar[Memory | None] = None
    where: ClassVar[tuple[Callable[[str, gc.Model], object], ...]] = ()

    def __init_subclass__(cls) -> None:
        if "sentence" not in vars(cls):
            cls.sentence = SENTENCES.get(cls.variant_of or getattr(cls, "name", ""), "")

    def applies(self, site: str, model: gc.Model) -> bool:
        return all(holds(site, model) for holds in self.where)

    def extension(self, site: str, model: gc.Model) -> Extension:
        own, memory = self.named(site, model), self.memory
        names: dict[str, Any] = _SITE | {p.name: n.name for p, n in zip(self.parameters, own, strict=True)}
        kept: tuple[Memory, ...] = ()
        if memory is not None:
            units, name = site_units(model, self.site, site), memory.name.format_map(names)
            names["memory"] = name
            kept = (Memory(name, memory.unit.format_map(units), memory.next.format_map(names)),)
        filled: dict[str, Any] = {what: text.format_map(names) for what, text in self.adds.items()}
        return Extension(self.name, site, own, memory=kept, **filled)


def spread(low: float, high: float, count: int) -> tuple[float, ...]:
    """`count` numbers from low to high, each the same multiple of the one before."""
    return tuple(float(v) for v in np.geomspace(low, high, count))


def graded(low: float, high: float) -> tuple[float, ...]:
    """Numbers from low to high, each at most `next_time` times the one before."""
    return spread(low, high, 1 + math.ceil(math.log(high / low) / math.log(THRESHOLDS.next_time)))


def times(parameter: EffectParameter, scales: Mapping[str, float], share: float = 0.9, least: float = 0.1) -> tuple[float, ...]:
    """From `least` of a period of sampling to this share of the longest time that a parameter may take."""
    high = share * parameter.bounds(scales)[1]
    return graded(min(least * scales["period"], 0.5 * high), high)


def driven(site: str, model: gc.Model) -> bool:
    """Does an input act at this coordinate (or in this state equation)?"""
    text = str(_section(model, "forces", "derivative").get(site, "0"))
    return bool({u.name for u in model.inputs} & _words(text))


def linked(site: str, model: gc.Model) -> bool:
    """Is there a force that reaches a coordinate of a mechanism?"""
    return _mechanical(model) and driven(site, model)


def placed(site: str, model: gc.Model) -> bool:
    """Has this coordinate (or the state whose equation this is) a position?"""
    if _mechanical(model):
        return site in model.coordinates
    return site in (str(text).strip() for text in _section(model, "derivative").values())


def _mechanical(model: gc.Model) -> bool:
    return bool(_section(model, "coordinates"))


def rigid(site: str, model: gc.Model) -> tuple[str, str, str, str] | None:
    """(inertia, applied force, bias, speed) as text of what an input moves at a coordinate, or at the equation of a speed.

    None where no input acts there, or other coordinates move it as well.
    """
    if not driven(site, model):
        return None
    if not _mechanical(model):
        return "1", str(_section(model, "derivative")[site]), "", site
    rows, i = _section(model, "mass_matrix"), model.coordinates.index(site)
    others = rows and [str(row[i]) for k, row in enumerate(rows) if k != i]
    if not rows or any(text.strip() not in ("0", "0.0") for text in others):
        return None
    force = str(_section(model, "forces").get(site, "0"))
    return f"({rows[i][i]})", force, str(_section(model, "bias").get(site, "")), f"{site}_dot"


def straight(site: str, model: gc.Model) -> bool:
    """Is the coordinate a length?"""
    units = {s.name: s.unit for s in model.states}
    return units[site] in _LENGTHS if _mechanical(model) else units[site].removesuffix("/s") in _LENGTHS


def turns(site: str, model: gc.Model) -> bool:
    """Is the coordinate no length, but an angle?"""
    return not straight(site, model)


def moves(site: str, model: gc.Model) -> bool:
    """Does something move there, by its unit: is the coordinate a length, an angle or a pure number, or the state a speed?

    Levels, temperatures, pressures and charges are no speeds.
    """
    unit = {s.name: s.unit for s in model.states}[site]
    return unit == "1" or any(_fits(unit, known) for known in (("m", "rad") if _mechanical(model) else ("m/s", "rad/s")))


def _fits(unit: str, other: str) -> bool:
    try:
        return bool(magnitude(f"1 {unit}", other))
    except ValueError:
        return False


def rubs(site: str, model: gc.Model) -> bool:
    """May wet friction act there: does something move, or is it a coordinate, whatever it is measured in?"""
    return _mechanical(model) or moves(site, model)


def _turning(site: str, model: gc.Model) -> bool:
    """Is the coordinate an angle?"""
    return {s.name: s.unit for s in model.states}[site] in ("rad", "deg", "1")


def tilts(site: str, model: gc.Model) -> bool:
    """Can gravity be turned along this coordinate: is it a length, or an angle that gravity pulls back?"""
    return _mechanical(model) and (straight(site, model) or (_turning(site, model) and _weighs(site, model)))


def _weighs(site: str, model: gc.Model) -> bool:
    """Does a resting coordinate of a mechanical model feel a force that depends on its place?"""
    if not _section(model, "bodies") and not any(site in _words(str(t)) for t in _section(model, "bias").values()):
        return False
    n = len(model.coordinates)
    x = np.zeros((1, model.nx))
    x[0, :n] = np.linspace(0.3, 0.7, n)
    return bool(np.any(model.step(x, np.zeros((1, model.nu))).x[0, n:]))


def carries(site: str, model: gc.Model) -> bool:
    """Has the coordinate a `points` entry, where a payload would sit?"""
    return site in _section(model, "points")


def wheels(site: str, model: gc.Model) -> tuple[str, str] | None:
    """(y, θ), where x is the site of a base that rolls along its heading: ẋ = v cos θ, ẏ = v sin θ.

    Turning the heading turns every step, and steps point along the chord of the heading's arc.
    """
    rates, units = _section(model, "derivative"), {s.name: s.unit for s in model.states}
    if site not in rates or not straight(site, model):
        return None
    for y, heading in itertools.permutations(rates, 2):
        turns = heading in _words(str(rates[site])) & _words(str(rates[y]))
        if turns and site not in (y, heading) and units[y] == units[site] and units[heading] == "rad":
            names = list(units)
            if _rolls(model, names.index(site), names.index(y), names.index(heading)):
                return y, heading
    return None


def _rolls(model: gc.Model, x: int, y: int, heading: int) -> bool:
    rng, n = np.random.default_rng(0), THRESHOLDS.rolling_points
    before, u = rng.uniform(-1, 1, (n, model.nx)), rng.uniform(-1, 1, (n, model.nu))
    straight = before * (np.arange(model.nx) != heading)
    try:
        moved, plain = (model.step(a, u).x - a for a in (before, straight))
    except gc.GapcertError:
        return False
    way, ahead = (d[:, x] + 1j * d[:, y] for d in (moved, plain))
    arc, beside = moved[:, heading], np.abs(np.sin(np.angle(ahead) - 0.5 * moved[:, heading]))
    along = bool(np.all(beside <= THRESHOLDS.rolling_aside * np.abs(arc) + 1e-9))
    return along and bool(np.any(way)) and np.allclose(way, ahead * np.exp(1j * before[:, heading]), rtol=1e-6, atol=1e-12)


def neighbour(site: str, model: gc.Model) -> str | None:
    """The next coordinate of the same unit, the one before at the end of a chain."""
    units = {s.name: s.unit for s in model.states}
    alike = [q for q in model.coordinates if units[q] == units[site]]
    if not _mechanical(model) or len(alike) < 2:
        return None
    i = alike.index(site)
    return alike[i + 1] if i + 1 < len(alike) else alike[i - 1]


def _section(model: gc.Model, *keys: str) -> Any:
    spec = model.text()
    return next((spec[k] for k in keys if spec.get(k)), {})


def _words(text: str) -> set[str]:
    return set(re.findall(r"[^\W\d]\w*", text))
