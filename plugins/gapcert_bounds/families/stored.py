"""Gap functions made again from what was saved of them: they answer to the same bits as those that were."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from gapcert.plugin import AffinePredictor, Array, Cells, GapFunction, Predictor, Zone
from gapcert_functions import WeightedSum

from .basis import BasisGap
from .constant import ConstantGap
from .envelope import EnvelopeGap, PiecewiseEnvelope
from .multilinear import MultilinearGap, MultilinearPredictor

Arrays = Mapping[str, Array]


def stored(form: Mapping[str, Any], arrays: Arrays, zone: Zone, model: Predictor | None = None) -> GapFunction | None:
    """From what `GapFunction.form` and `arrays` hold; model: a predictor that these do not. None where a form is none of those
    of this package.
    """
    kind = form["form"]
    if kind == "constant":
        return ConstantGap(arrays["gamma"])
    if kind == "basis":
        own = WeightedSum.stored(form, arrays)
        return BasisGap(own.terms, own.weights, arrays["margin"])
    if kind not in ("envelope", "multilinear"):
        return None
    p, nz = model or _predictor(form["predictor"], arrays, len(zone.low)), len(zone.low)
    g, constants, e = (arrays[name] for name in ("g", "L", "e"))
    if kind == "multilinear":
        axes = tuple(arrays[f"axis{j}"] for j in range(nz))
        values = g.reshape(*map(len, axes), -1)
        return MultilinearGap(axes, values, [arrays[f"H{j}"] for j in range(nz)], constants, e, p)
    if "cells" not in form:
        return EnvelopeGap(arrays["z"], g, constants, e, p)
    axis, child = (arrays[f"cells.{name}"].astype(np.int64) for name in ("axis", "child"))
    own_constants, jumps = arrays["cells.L"], arrays["cells.J"]
    ends = np.asarray(zone.low), np.asarray(zone.high)
    cells = Cells(*ends, axis, arrays["cells.cut"], child, own_constants, jumps, np.zeros((0, nz)))
    return PiecewiseEnvelope(arrays["z"], g, cells, e, p)


def _predictor(kind: str, arrays: Arrays, nz: int) -> Predictor:
    if kind == "multilinear":
        return MultilinearPredictor(tuple(arrays[f"axis{j}"] for j in range(nz)), arrays["values"])
    return AffinePredictor(arrays["offset"], arrays["slope"], kind)


def calibrated(low: Array, high: Array, widening: Array, resolution: Array) -> tuple[Array, Array]:
    """[l − w − e, u + w + e], w (nx,) of either sign; an end that w < 0 moves inwards stops at the middle."""
    middle = low + (high - low) / 2
    # A residual whose score is within the threshold lies in [l − w, u + w], which then is not empty; elsewhere any will do.
    lower, upper = np.nextafter(low - widening, -np.inf), np.nextafter(high + widening, np.inf)
    return np.minimum(lower, middle) - resolution, np.maximum(upper, middle) + resolution
