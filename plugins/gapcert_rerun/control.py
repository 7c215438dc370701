"""What a controller may promise: where it may start, runs over two states and over time, and what it foresaw and learned."""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun as rr

from gapcert import Array
from gapcert_figures import LoopFigure, Runs, WinningFigure, held

from .canvas import BAD, FAINT, ONLY_WITH, ROLES, TRUTH, WITH, Canvas, Colour, Plane, Seen, series
from .robot import as_path, draw_robot


def draw_winning(canvas: Canvas, w: WinningFigure) -> None:
    """Where both controllers win, or one alone; the goal; and how long it takes."""
    plane = canvas.plane("winning", w.axes[0], w.axes[1])
    for role, _, mask in w.areas:
        # Darker than the runs that lie upon it.
        red, green, blue = (c * 2 // 5 for c in ROLES[role][:3])
        canvas.static(f"winning/{role}", plane.mask(mask, (red, green, blue, 255)))
    both = zip(w.labels, (w.with_gamma, w.without_gamma), strict=True)
    shares = ", ".join(f"{name} {100 * grid.mean():.3g} %" for name, grid in both)
    roots = {"winning": f"May start: {shares}{held(w.fixed)}"}
    if w.values.size:
        roots["promise"], top = f"Steps that are promised{held(w.fixed)}", float(np.nanmax(w.values))
        canvas.static("promise/steps", canvas.plane("promise", plane.x, plane.y).heat(w.values, top))
        canvas.static("promise/scale", *plane.scale(top, "steps"))
    for root, title in roots.items():
        for k, o in enumerate(o for o in w.outlines if o.cut):
            colour = FAINT if o.dotted else ROLES[o.role]
            canvas.static(f"{root}/goal/{o.role}/{k}", plane.polygon(o.points, colour, o.name))
        canvas.show("winning", root, Seen(root, title, bar=root == "promise"))


def draw_loop(canvas: Canvas, loop: LoopFigure) -> None:
    """Runs over time and over two states; tubes that were foreseen, what was learned, and the robot."""
    for runs in loop.runs:
        _runs(canvas, loop, runs)
    t = times(loop, max(r.steps for r in loop.runs) + 1)
    for m, told in enumerate(loop.foreseen):
        _foreseen(canvas, loop, told, m)
    # Later there is nothing to be seen.
    end = loop.period * max(1, *(int(np.isfinite(x[:, 0]).sum()) - 1 for r in loop.runs for x in r.traces))
    for i, axis in enumerate(loop.axes):
        root, (low, high) = f"loop/{axis.name}", loop.stay[i]
        if loop.wanted.size:
            canvas.line(f"{root}/wanted", t[: len(loop.wanted)], loop.wanted[:, i], TRUTH, "wanted", 2.0)
        pad = 0.15 * (high - low)
        for name, limit in (("low", low), ("high", high)):
            canvas.line(f"{root}/{name}", t, np.full(len(t), limit), BAD, "limit", 1.0)
        canvas.show("loop", axis.name, series(root, axis.label, low - pad, high + pad, end))
    _ahead(canvas, loop)
    _learned(canvas, loop)
    top = 1.08 * max(r.starts for r in loop.runs)
    last = max(end, loop.period * max(int(r.broke.max()) for r in loop.runs))
    canvas.show("alive", "alive", series("alive", "Runs unbroken", 0.0, top, last))
    if loop.playback is not None:
        draw_robot(canvas, loop.playback)


def times(loop: LoopFigure, steps: int, first: int = 0) -> Array:
    """Seconds of these steps."""
    return np.asarray(loop.period * np.arange(first, first + steps), dtype=np.float64)


def _runs(canvas: Canvas, loop: LoopFigure, runs: Runs) -> None:
    name, label, colour, t = as_path(runs.name), runs.name, ROLES[runs.name], times(loop, runs.steps + 1)
    for i, axis in enumerate(loop.axes):
        canvas.line(f"loop/{axis.name}/{name}", t, runs.traces[:, :, i].T, colour, f"f̂, {label}")
        predicted = runs.predicted[:1, :, i].T
        canvas.line(f"loop/{axis.name}/{name}_predicted", t, predicted, FAINT, f"f alone, {label}", 1.0)
    canvas.line(f"alive/{name}", t, runs.alive.astype(np.float64), colour, label, 3.0)
    if len(loop.axes) < 2:
        return
    plane = Plane(loop.axes[0], loop.axes[1])
    height, radius = (0.035, 0.002) if runs.gamma else (0.03, 0.004)
    strips = [plane.at(piece, height) for trace in runs.traces for piece in loop.pieces(trace)]
    canvas.static(f"winning/runs/{name}", rr.LineStrips3D(strips, colors=[colour] * len(strips), radii=radius))
    ended = [plane.at(trace[int(e)], 0.04) for trace, e in zip(runs.traces, runs.ended, strict=True) if e >= 0]
    if ended:
        canvas.static(f"winning/runs/{name}/violations", rr.Points3D(ended, colors=[BAD], radii=0.012))
    if len(runs.traces):
        _now(canvas, f"winning/runs/{name}/now", plane, runs.traces[0], t, colour)
    if "winning" not in canvas.views:
        canvas.plane("winning", plane.x, plane.y)
        canvas.show("winning", "winning", Seen("winning", "Runs over the first two states"))


def _now(canvas: Canvas, path: str, plane: Plane, trace: Array, t: Array, colour: Colour) -> None:
    """The first run at the time cursor."""
    trace = trace[np.isfinite(trace).all(axis=1)]
    canvas.static(path, rr.Points3D.from_fields(colors=[colour], radii=[0.016]))
    canvas.columns(path, t[: len(trace)], rr.Points3D.columns(positions=plane.at(trace, 0.045)))


def _foreseen(canvas: Canvas, loop: LoopFigure, told: Any, number: int) -> None:
    """Where the controller with γ said that the first run would be: a tube over time, and boxes over two states."""
    t = times(loop, len(told.low), told.step)
    for i, axis in enumerate(loop.axes):
        path, what = f"loop/{axis.name}/foreseen{number}", f"foreseen at step {told.step}"
        canvas.band(path, t, told.low[:, i], told.high[:, i], ONLY_WITH, what, axis.unit)
    if len(loop.axes) < 2:
        return
    plane, ends = Plane(loop.axes[0], loop.axes[1]), np.stack([told.low, told.high])[:, :, :2]
    sides = ((0, 0), (1, 0), (1, 1), (0, 1), (0, 0))
    boxes = [plane.at(np.array([[box[a, 0], box[b, 1]] for a, b in sides]), 0.038) for box in ends.transpose(1, 0, 2)]
    strips = rr.LineStrips3D(boxes, colors=[ONLY_WITH] * len(boxes), radii=0.0015)
    canvas.static(f"winning/runs/foreseen{number}", strips)


def _ahead(canvas: Canvas, loop: LoopFigure) -> None:
    """Each step of the first run with γ against the box that the controller had foreseen for it."""
    if (ahead := loop.ahead) is None:
        return
    t, out = times(loop, len(ahead.error), 1), int((~ahead.kept).sum())
    for i, axis in enumerate(loop.axes):
        root, low, high = f"tube/{axis.name}", ahead.low[:, i], ahead.high[:, i]
        canvas.band(f"{root}/foreseen", t, low, high, ONLY_WITH, "foreseen box", axis.unit)
        canvas.line(f"{root}/error", t, ahead.error[:, i], TRUTH, "where the step led", 1.5)
        reach = 1.15 * max(float(np.abs(v).max()) for v in (low, high, ahead.error[:, i])) or 1.0
        title = f"Step against its tube: {axis.label}, {out} of {len(t)} outside"
        canvas.show("tube", axis.name, series(root, title, -reach, reach, float(t[-1])))


def _learned(canvas: Canvas, loop: LoopFigure) -> None:
    for one in loop.learned:
        root, whole, t = f"learned/{one.name}", one.hull[0], times(loop, len(one.run))
        canvas.line(f"{root}/all", t, one.hull, FAINT, "known to all runs", 1.0)
        canvas.line(f"{root}/run", t, one.run, WITH, "known to one run", 2.0)
        canvas.line(f"{root}/stated", t, np.full(len(one.run), one.stated), TRUTH, "the model of γ", 1.0)
        pad = 0.1 * float(np.ptp(whole)) or 1.0
        low, high = float(whole.min()) - pad, float(whole.max()) + pad
        title = f"What is learned of {one.name} [{one.unit}]: one run blue, all grey"
        canvas.show("learned", one.name, series(root, title, low, high, float(t[-1])))
