"""A diagnosis in the viewer: held-out motions, laws, what each cause explained, what is left, and the experiment."""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from gapcert import Array
from gapcert_figures import Axis, DiagnosisFigure

from .canvas import FAINT, ROLES, TRUTH, WITH, Canvas, Seen, series
from .robot import draw_robot

BOTH = ("before", "after")


def draw_diagnosis(canvas: Canvas, d: DiagnosisFigure) -> None:
    """Everything of a diagnosis, each kind in views of its own."""
    for c in d.channels:
        _channel(canvas, c)
    for i, law in enumerate(d.laws):
        _law(canvas, f"law/{i}", law)
    if d.waterfall is not None:
        _waterfall(canvas, d.waterfall)
    for one in d.correlations:
        _correlation(canvas, one)
    for i, course in enumerate(d.courses):
        title = f"Errors of trajectory {i + 1}" if len(d.courses) > 1 else "Error of each window"
        _course(canvas, f"left/course{i}", course, title)
    for s in d.experiment:
        root, reach = f"experiment/{s.name.replace(' ', '-')}", 1.1 * float(np.abs(s.values).max() or 1.0)
        for k, row in enumerate(np.atleast_2d(s.values)):
            canvas.line(f"{root}/signal{k or ''}", s.t, row, TRUTH, s.name, 1.0)
        canvas.show("experiment", s.name, series(root, f"The experiment: {s.name} [{s.unit}]", -reach, reach, float(s.t[-1])))
    if d.playback is not None:
        draw_robot(canvas, d.playback)


def _channel(canvas: Canvas, c: Any) -> None:
    root, t = f"diagnosis/{c.name}", c.t - c.t[0]
    for name in ("measured", *BOTH):
        canvas.line(f"{root}/{name}", t, getattr(c, name), ROLES[name], name, 3.0 if name == "measured" else 1.5)
    both = np.concatenate([c.measured, c.after])
    low, high = float(np.nanmin(both)), float(np.nanmax(both))
    pad = 0.1 * (high - low) or 1.0
    title = f"{c.name} [{c.unit}], held out: measured white, before orange, after blue"
    canvas.show("channel", c.name, series(root, title, low - pad, high + pad, float(t[-1])))
    root = f"error/{c.name}"
    for name in BOTH:
        canvas.line(f"{root}/{name}", t, getattr(c, name) - c.measured, ROLES[name], name)
    reach = 1.1 * float(np.nanmax(np.abs(c.before - c.measured))) or 1.0
    canvas.show("error", c.name, series(root, f"Error of {c.name} [{c.unit}], held out", -reach, reach, float(t[-1])))


def _law(canvas: Canvas, root: str, law: Any) -> None:
    """Points with their intervals, and the named law, on a square that holds both."""
    half = law.half if law.half.size else np.zeros_like(law.y)
    every = np.concatenate([law.y - half, law.y + half, law.law, [0.0]])
    low, high = float(np.nanmin(every)), float(np.nanmax(every))
    across = np.concatenate([law.x, law.at])
    plane = canvas.plane(root, _axis(law.x_label, np.nanmin(across), np.nanmax(across)), _axis(law.y_label, low, high))

    def at(x: Array, y: Array, height: float = 0.01) -> Array:
        return plane.at(np.column_stack([x, y]), height)

    canvas.static(f"{root}/zero", *plane.zero())
    ends = [at(np.array([x, x]), np.array([y - h, y + h])) for x, y, h in zip(law.x, law.y, half, strict=True)]
    canvas.static(f"{root}/interval", rr.LineStrips3D(ends, radii=0.002, colors=[FAINT] * len(ends)))
    canvas.static(f"{root}/missing", rr.Points3D(at(law.x, law.y, 0.03), radii=0.009, colors=[TRUTH]))
    if law.law.size and law.shape == "cloud":
        canvas.static(f"{root}/named", rr.Points3D(at(law.at, law.law, 0.02), radii=0.004, colors=[WITH]))
    elif law.law.size:
        # A loop is in parts, with a gap after each.
        parts = np.split(np.column_stack([law.at, law.law]), np.flatnonzero(np.isnan(law.at)) + 1)
        kept = [part[np.isfinite(part).all(axis=1)] for part in parts if len(part) > 1]
        strips = [at(part[:, 0], part[:, 1], 0.02) for part in kept]
        canvas.static(f"{root}/named", rr.LineStrips3D(strips, radii=0.006, colors=[WITH] * len(strips)))
    if law.lead:
        canvas.show("law", root, Seen(root, law.title[:1].upper() + law.title[1:]))


def _axis(label: str, low: float, high: float) -> Axis:
    """From least to greatest; what never changes is in the middle of one."""
    name, _, unit = label.partition(" [")
    pad = 0.0 if high > low else 0.5 * max(1.0, abs(low))
    return Axis(name, unit.removesuffix("]").replace("**", "^").replace("*", "·"), float(low) - pad, float(high) + pad)


def _waterfall(canvas: Canvas, w: Any) -> None:
    names = ["before", *(f"+ {n}" for n in w.labels[1:])]
    rows = "".join(f"| {n} | {100 * e / w.error[0]:.3g} % |\n" for n, e in zip(names, w.error, strict=True))
    canvas.text("explained", f"| in the order listed | held-out error left |\n| --- | --- |\n{rows}")
    canvas.show("explained", "explained", rrb.TextDocumentView(origin="explained", name="What each cause explained"))


def _correlation(canvas: Canvas, c: Any) -> None:
    """Over the lag, which is no time that runs: in a plane."""
    if len(c.lag) < 2:
        return
    root = f"left/{c.channel}-{c.against}"
    plane = canvas.plane(root, Axis("lag", "s", float(c.lag[0]), float(c.lag[-1])), Axis("correlation", "", -1.05, 1.05))
    band = np.full_like(c.lag, c.band)
    canvas.static(f"{root}/chance", plane.ribbon(c.lag, -band, band, (60, 64, 72, 255), 0.005))
    for name in BOTH:
        canvas.static(
            f"{root}/{name}", plane.curve(c.lag, getattr(c, name), ROLES[name], height=0.02 if name == "before" else 0.03)
        )
    canvas.show("left", root, Seen(root, f"Residual of {c.channel} with {c.against}"))


def _course(canvas: Canvas, root: str, course: Any, title: str) -> None:
    top = 1.1 * float(max(course.before.max(), 1.5))
    span = Axis("time", "s", float(course.t[0]), float(course.t[-1]) if len(course.t) > 1 else float(course.t[0]) + 1.0)
    plane = canvas.plane(root, span, Axis("RMS", "noise floors", 0.0, top))
    canvas.static(f"{root}/floor", plane.curve(course.t, np.ones_like(course.t), FAINT, 0.0015))
    for name in BOTH:
        canvas.static(f"{root}/{name}", plane.curve(course.t, getattr(course, name), ROLES[name]))
    canvas.show("course", root, Seen(root, title))
