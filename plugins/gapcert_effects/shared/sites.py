"""What a site of a model is like: can an effect act there, and from which values would a search start."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

import gapcert as gc

LENGTHS = ("m", "mm", "cm", "km")
NEVER = 1e15  # a limit that nothing reaches; exact in min and max, and within rounding elsewhere


def spread(low: float, high: float, count: int) -> tuple[float, ...]:
    """`count` numbers from low to high, each the same multiple of the one before."""
    return tuple(float(v) for v in np.geomspace(low, high, count))


def driven(site: str, model: gc.Model) -> bool:
    """Does an input act at this coordinate (or in this state equation)?"""
    text = str(_section(model, "forces", "derivative").get(site, "0"))
    return bool({u.name for u in model.inputs} & _words(text))


def placed(site: str, model: gc.Model) -> bool:
    """Has this coordinate (or the state whose equation this is) a position?"""
    if mechanical(model):
        return site in model.coordinates
    return site in (str(text).strip() for text in _section(model, "derivative").values())


def mechanical(model: gc.Model) -> bool:
    return bool(_section(model, "coordinates"))


def straight(site: str, model: gc.Model) -> bool:
    """Is the coordinate a length?"""
    units = {s.name: s.unit for s in model.states}
    return units[site] in LENGTHS if mechanical(model) else units[site].removesuffix("/s") in LENGTHS


def turning(site: str, model: gc.Model) -> bool:
    """Is the coordinate an angle?"""
    return {s.name: s.unit for s in model.states}[site] in ("rad", "deg", "1")


def tilts(site: str, model: gc.Model) -> bool:
    """Can gravity be turned along this coordinate: is it a length, or an angle that gravity pulls back?"""
    return mechanical(model) and (straight(site, model) or (turning(site, model) and weighs(site, model)))


def weighs(site: str, model: gc.Model) -> bool:
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


def neighbour(site: str, model: gc.Model) -> str | None:
    """The next coordinate of the same unit, the one before at the end of a chain."""
    units = {s.name: s.unit for s in model.states}
    alike = [q for q in model.coordinates if units[q] == units[site]]
    if not mechanical(model) or len(alike) < 2:
        return None
    i = alike.index(site)
    return alike[i + 1] if i + 1 < len(alike) else alike[i - 1]


def _section(model: gc.Model, *keys: str) -> Mapping[str, object]:
    spec = model.text()
    return next((spec[k] for k in keys if spec.get(k)), {})


def _words(text: str) -> set[str]:
    return set(re.findall(r"[^\W\d]\w*", text))
