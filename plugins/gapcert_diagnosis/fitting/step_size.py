"""Is a model's own step fine enough for what is left of a recording? An integrator that is not brakes, or drives, by itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from gapcert.plugin import Array, Model, registry
from gapcert_diagnosis.thresholds import THRESHOLDS
from gapcert_engines import EngineModel

from .fit import Fit, followed


def built(section: Mapping[str, Any]) -> Model:
    """A model from its section, through whatever plugin provides its kind."""
    config: Any = registry().config("model", section["kind"])
    made: Model = registry().build("model", section["kind"], config.model_validate(dict(section)))
    return made


def stepped(model: Model, substeps: int, period: float | None = None) -> Model | None:
    """The same equations in so many sub-steps; None where no integrator steps the model, or an engine's, which is meant.

    None, too, where it has memory: that may be written per sub-step, and would be another one with more of them.
    """
    if isinstance(model, EngineModel):
        return None
    section = model.to_spec()
    if section.get("kind") != "equations" or {"next", "memory"} & section.keys():
        return None
    return built(section | {"substeps": substeps} | ({} if period is None else {"period": f"{period!r} s"}))


def fastest(model: Model, x: Array, u: Array) -> float:
    """A sub-step times the fastest rate of the map that it makes, at states x (n, nx) and inputs u (n, nu): max |log μ|."""
    one = stepped(model, 1, model.period / model.substeps)
    if one is None:
        return 0.0
    with np.errstate(all="ignore"):
        slopes = one.jacobian(x, u)[:, :, : model.nx]
        if not np.isfinite(slopes).all():
            return np.inf
        return float(np.abs(np.log(np.linalg.eigvals(slopes).astype(complex))).max())


def coarse(last: Fit) -> tuple[str, ...]:
    """A sentence where half the model's step moves a fit by what is not small against what the fit leaves; none otherwise.

    Both are compared from starts of their own on a few windows, since another start takes out what only shifts a motion.
    """
    h, windows = last.hypothesis.holding(last.theta), last.windows
    fine = None if windows.measured.exact else stepped(h.model, 2 * h.model.substeps)
    if fine is None:
        return ()
    rows = np.unique(np.linspace(0, len(windows) - 1, min(THRESHOLDS.half_step_windows, len(windows))).round().astype(np.intp))
    part, start = windows.take(rows), last.start[rows]
    # One without a fast mode is off by its order alone; what it then makes of the motion is no friction.
    if fastest(h.model, start, part.u[:, windows.measured.history]) < THRESHOLDS.fastest_mode:
        return ()
    own, other = (followed(one, np.empty(0), part, start).residual for one in (h, replace(h, model=fine)))
    left, moved = (np.sqrt(np.mean(r**2, axis=(0, 1))) for r in (own, other - own))
    worst = int(np.argmax(moved / np.maximum(left, 1.0)))
    if moved[worst] <= THRESHOLDS.half_step_change * max(left[worst], 1.0):
        return ()
    m, model = windows.measured, h.model
    c, (by, rest) = m.channels[worst], (float(v[worst] * m.sigma[worst]) for v in (moved, left))
    told = (
        f"step: with half of its step of {model.period / model.substeps:.3g} s the model moves {c.name} by {by:.2g} {c.unit} "
        f"over {windows.length * m.period:.2g} s, where {rest:.2g} {c.unit} are left; an integrator too coarse for a fast mode "
        f"brakes or drives like a friction; set model.substeps to {4 * model.substeps} or more, and see what stays"
    )
    return (told,)
