"""What a controller knows along its runs: the tubes and boxes that it foresees, and what it has learned of parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np

from gapcert.plugin import Array, Bools, Policy, System, circle, pretty, turned

if TYPE_CHECKING:
    from gapcert.plugin import Controller

Ends = Mapping[str, Array]
MOMENTS = 4  # of a run, whose predictions are drawn; chosen, not measured


@final
@dataclass(frozen=True)
class Foreseen:
    """At `step` of a run: rows k of centre, low and high (N + 1, nx) are about step + k."""

    step: int
    centre: Array
    low: Array
    high: Array


@final
@dataclass(frozen=True)
class Ahead:
    """Row k: where step k of a run led to, and the box in which this had to be, relative to where it was foreseen, (steps, nx)
    each; and whether it was in there, (steps,).
    """

    error: Array
    low: Array
    high: Array
    kept: Bools


def foreseen(controller: Controller, x: Array, policy: Policy) -> tuple[tuple[Foreseen, ...], Ahead | None]:
    """What it foresaw along a run x (steps + 1, nx), which is answered again as far as is drawn; if anything.
    Each moment stands where what the one before has foreseen ends.
    """
    out: list[Foreseen] = []
    rows: list[tuple[Array, ...]] = []
    angles = np.array([axis.kind == "angle" for axis in controller.goal.stay.axes])
    made, wanted = int(np.isfinite(x).all(axis=1).sum()), 0
    memory = controller.start(x[:1])
    for k in range(made):
        row = x[k : k + 1]
        memory = controller.advance(row, memory) if k else memory
        if (len(out) == MOMENTS and k >= wanted) or controller.over(row, memory)[0] or not controller.keeps(row, memory)[0]:
            break
        controller.respond(row, memory, policy, k=k)
        if (found := controller.predicted(x[k], memory)) is None:
            break
        if k + 1 < made and len(found[0]) > 1:
            centre, low, high = (part[1] for part in found)
            came = circle.near(x[k + 1], centre, angles)
            rows.append((came - centre, low - centre, high - centre, ((came >= low) & (came <= high)).all()))
        if len(out) < MOMENTS and k >= wanted:
            # Angles as the picture has them: in the range of the set to stay in.
            shift = turned(controller.goal.stay, row)[0] - x[k]
            out.append(Foreseen(k, *(np.asarray(part) + shift for part in found)))
            wanted = k + max(1, len(found[0]) - 1)
    return tuple(out), Ahead(*map(np.array, zip(*rows, strict=True))) if rows else None


def followed(model: System, x: Array, u: Array) -> Array:
    """What a model makes of the inputs u (n, N, nu) of runs x (n, N + 1, nx) from their starts, without looking at them again.

    NaN after the end of a run, which is where its states are, and from where the model has no answer.
    """
    out, rows, hidden = np.full_like(x, np.nan), np.arange(len(x)), None
    out[:, 0] = x[:, 0]
    for k in range(u.shape[1]):
        on = np.isfinite(x[rows, k + 1]).all(axis=1) & np.isfinite(out[rows, k]).all(axis=1)
        rows, hidden = rows[on], None if hidden is None else hidden[on]
        if len(rows):
            done = model.step(out[rows, k], u[rows, k], hidden=hidden)
            out[rows, k + 1], hidden = done.x, done.hidden
    return out


@final
@dataclass(frozen=True)
class Learned:
    """A parameter over the steps: [low, high] as one run knows it, and the hull of what all know, (steps + 1, 2) each, NaN
    where nothing is known. stated: its value in the model around which γ was found.
    """

    name: str
    unit: str
    run: Array
    hull: Array
    stated: float


def last(x: Array, ends: Array) -> tuple[Array, Array]:
    """([low, high] after the last step of each run (n, 2), is it refuted (n,)) of runs x (n, steps + 1, nx).

    Refuted: no value makes all steps of the run; [low, high] is what was known before that.
    """
    known = np.isfinite(ends).all(axis=2)
    steps = np.arange(ends.shape[1])
    end = np.where(known, steps, 0).max(axis=1)
    return ends[np.arange(len(ends)), end], np.isfinite(x).all(axis=2).sum(axis=1) - 1 > end


def summary(x: Array, learned: Ends) -> dict[str, Any]:
    """Per parameter: `first` and `last`, the hulls over all runs before and after them; `left`, the mean share of a run's range
    that it still holds possible after its last step; `refuted`, runs of which no value makes all steps.
    """
    out: dict[str, Any] = {}
    for name, ends in learned.items():
        begin, (end, refuted) = ends[:, 0], last(x, ends)
        out[name] = {
            "first": [float(begin[:, 0].min()), float(begin[:, 1].max())],
            "last": [float(end[:, 0].min()), float(end[:, 1].max())],
            "left": float((np.diff(end) / np.diff(begin)).mean()),
            "refuted": int(refuted.sum()),
        }
    return out


def figures(learned: Ends | None, model: System, row: int) -> tuple[Learned, ...]:
    """Of one run and of all, for the parameters of the model; none where nothing is learned."""
    stated = {p.name: p for p in model.parameters}
    out = []
    for name, ends in (learned or {}).items():
        least, most = (np.where(np.isfinite(v), v, far) for v, far in ((ends[..., 0], np.inf), (ends[..., 1], -np.inf)))
        hull = np.stack([least.min(axis=0), most.max(axis=0)], axis=1)
        hull[~np.isfinite(hull)] = np.nan
        p = stated[name]
        out.append(Learned(name, pretty(p.unit), ends[row], hull, float(p.value)))
    return tuple(out)
