"""Is a model's own step fine enough for a recording, and for what is left of it? An integrator that is not brakes or drives by
itself, or blows up."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Model, UsageError, difference, registry
from gapcert_diagnosis.data.dataset import Windows, flat
from gapcert_diagnosis.thresholds import THRESHOLDS
from gapcert_engines import EngineModel

from .fit import Fit, followed
from .hypothesis import Hypothesis


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


def paced(model: Model, parts: float) -> Model:
    """The same equations with a period 1/parts as long, in sub-steps as long as before."""
    return built(model.to_spec() | {"period": f"{model.period / parts!r} s", "substeps": round(model.substeps / parts)})


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


def settled(model: Model, windows: Windows) -> tuple[Model, tuple[str, ...]]:
    """A model whose sub-steps are halved until its rollouts along a recording stand still, and a sentence that tells them.

    Its own are kept where no mode is fast, and where halving does not end. UsageError where it blows up in so many that an
    explicit integrator is not for it.
    """
    m, part, own = windows.measured, windows.take(_few(windows)), model.substeps
    finer = None if m.exact else stepped(model, own, model.period / THRESHOLDS.probing_substeps)
    # Of its own step a rate can show as nothing: a map that turns its mode over once has an eigenvalue of one.
    rate = 0.0 if finer is None else THRESHOLDS.probing_substeps * fastest(finer, part.start, part.u[:, m.history])
    if not THRESHOLDS.fastest_mode <= rate < np.inf:
        return model, ()
    first = y = _rolled(model, part)
    now, moved = model, np.inf
    most = min(THRESHOLDS.most_substeps * own, THRESHOLDS.stated_substeps)
    while moved > THRESHOLDS.still_rollout and (n := 2 * now.substeps) <= most:
        if (fine := stepped(model, n)) is None:
            return model, ()
        before, y = y, _rolled(fine, part)
        with np.errstate(all="ignore"):
            moved = float(np.nan_to_num(np.sqrt(np.mean((difference(m.channels, y, before) / m.sigma) ** 2)), nan=np.inf))
        now = fine if moved > THRESHOLDS.still_rollout else now
    time = model.period / own / rate
    if not np.isfinite(y).all() and rate > THRESHOLDS.most_substeps:
        need, most = f"{m.period / time:.2g}", most * m.repeat
        raise UsageError(
            f"model: its fastest mode has a time constant of {time:.2g} s, and samples are {m.period:.6g} s apart; an explicit "
            f"integrator would need {need} sub-steps between two; expected {most} at most; put the value that the fast state "
            "settles to in its place, or, if the time of the recording is in ms, say so, recording.units: {TIME: ms}"
        )
    lasting = moved <= THRESHOLDS.still_rollout or (np.isfinite(y).all() and not np.isfinite(first).all())
    if now is model or not lasting:
        return model, ()
    told = (
        f"the model is simulated in sub-steps of {now.period / now.substeps:.3g} s ({now.substeps} in a period, {own} as "
        f"stated), as its fastest mode has a time constant of {time:.2g} s"
    )
    return now, (told,)


def quickened(model: Model, windows: Windows) -> Model:
    """A model whose periods are so short that what acts within one may be its mean, where it is known how inputs are held.

    They are halved until inputs that come half of one late move rollouts alike, as means and as they come; or, of inputs that
    go straight from sample to sample, move no output that sees them at once.
    """
    m, part, repeat = windows.measured, windows.take(_few(windows)), windows.measured.repeat
    u = part.drive[:, m.past : m.past + (part.length - 1) * repeat]
    sampled = part.u[:, m.history :]
    change = np.diff(sampled, axis=1, prepend=sampled[:, :1])
    while m.hold in ("zero", "first") and repeat < THRESHOLDS.most_quickened * m.repeat:
        finer = stepped(model, math.ceil(model.substeps / 2), model.period / 2)
        if finer is None:
            break
        twice = np.repeat(u, 2, axis=1)
        late = np.concatenate([u[:, :1], twice[:, :-1]], axis=1)
        means = late.reshape(*u.shape[:2], 2, -1).mean(axis=2)
        sent = [(model, means), (finer, late)] if m.hold == "zero" else [(model, u)] * 2
        shown = [0 * sampled] * 2 if m.hold == "zero" else [sampled, sampled - change / (2 * repeat)]
        with np.errstate(all="ignore"):
            own, other = (
                one.output(flat(one.fast_rollout(part.start, v, every=v.shape[1] // (part.length - 1)).x), flat(at))
                for (one, v), at in zip(sent, shown, strict=True)
            )
            apart = difference(m.channels, own[:, m.columns], other[:, m.columns]) / m.sigma
            if not np.sqrt(np.mean(apart**2, axis=0)).max() > THRESHOLDS.mean_input:
                break
        model, repeat, u = finer, 2 * repeat, twice
    return model


def _rolled(model: Model, windows: Windows) -> Array:
    """Outputs (W, L, ny) from the measured starts."""
    return np.asarray(Hypothesis(model).simulate(windows, np.empty((1, 0)), windows.start[None])[0])


def _few(windows: Windows) -> npt.NDArray[np.intp]:
    """Rows spread over the recording."""
    count = min(THRESHOLDS.half_step_windows, len(windows))
    return np.asarray(np.unique(np.linspace(0, len(windows) - 1, count).round().astype(np.intp)))


def coarse(last: Fit) -> tuple[str, ...]:
    """A sentence where half the model's step moves a fit by what is not small against what the fit leaves; none otherwise.

    Both are compared from starts of their own on a few windows, since another start takes out what only shifts a motion.
    """
    h, windows = last.hypothesis.holding(last.theta), last.windows
    fine = None if windows.measured.exact else stepped(h.model, 2 * h.model.substeps)
    if fine is None:
        return ()
    rows = _few(windows)
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
