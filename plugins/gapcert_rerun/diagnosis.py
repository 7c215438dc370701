"""A diagnosis in the viewer: held-out motions, laws, what each cause explained, what is left, and the experiment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from gapcert import Axis, DiagnosisFigure
from gapcert_rerun.scene import FAINT, TRUTH, WITH, WITHOUT, Array, Plane, series, view

if TYPE_CHECKING:
    from gapcert_rerun.stream import Stream

BOTH = (("before", WITHOUT), ("after", WITH))


def draw(stream: Stream, d: DiagnosisFigure) -> None:
    """Everything of a diagnosis, each kind in views of its own."""
    for c in d.channels:
        _channel(stream, c)
    for i, law in enumerate(d.laws):
        _law(stream, f"law/{i}", law)
    if d.waterfall is not None:
        _waterfall(stream, d.waterfall)
    for one in d.correlations:
        _correlation(stream, one)
    for i, course in enumerate(d.courses):
        root, top = f"left/course{i}", 1.1 * float(max(course.before.max(), 1.5))
        for name, colour in BOTH:
            stream.line(f"{root}/{name}", getattr(course, name), colour, name)
        stream.line(f"{root}/floor", np.ones_like(course.t), FAINT, "noise floor", 1.0)
        stream.views[root] = series(root, "RMS residual of each window, in noise floors", 0.0, top)
    for s in d.experiment:
        root, reach = f"experiment/{s.name}", 1.1 * float(np.abs(s.values).max() or 1.0)
        stream.line(f"{root}/signal", s.values, TRUTH, s.name, 1.0)
        period = float(np.median(np.diff(s.t))) if len(s.t) > 1 else 0.0
        stream.views[root] = series(root, f"The experiment: {s.name} [{s.unit}], step {period:.3g} s", -reach, reach)


def _channel(stream: Stream, c: Any) -> None:
    root = f"diagnosis/{c.name}"
    for name, values, colour in (("measured", c.measured, TRUTH), ("before", c.before, WITHOUT), ("after", c.after, WITH)):
        stream.line(f"{root}/{name}", values, colour, name, 3.0 if name == "measured" else 1.5)
    period = float(np.median(np.diff(c.t))) if len(c.t) > 1 else 0.0
    both = np.concatenate([c.measured, c.after])
    low, high = float(np.nanmin(both)), float(np.nanmax(both))
    pad = 0.1 * (high - low) or 1.0
    title = f"{c.name} [{c.unit}], held out, step {period:.3g} s: measured white, before orange, after blue"
    stream.views[root] = series(root, title, low - pad, high + pad)
    root = f"error/{c.name}"
    for name, colour in BOTH:
        stream.line(f"{root}/{name}", getattr(c, name) - c.measured, colour, name)
    reach = 1.1 * float(np.nanmax(np.abs(c.before - c.measured))) or 1.0
    stream.views[root] = series(root, f"Error of {c.name} [{c.unit}], held out, step {period:.3g} s", -reach, reach)


def _law(stream: Stream, root: str, law: Any) -> None:
    """Points with their intervals, and the named law, on a square that holds both."""
    half = law.half if law.half.size else np.zeros_like(law.y)
    every = np.concatenate([law.y - half, law.y + half, law.law, [0.0]])
    low, high = float(np.nanmin(every)), float(np.nanmax(every))
    across = np.concatenate([law.x, law.at])
    plane = Plane(
        _axis(law.x_label, np.nanmin(across), np.nanmax(across)), _axis(law.y_label, low, high if high > low else low + 1.0)
    )

    def at(x: Array, y: Array, height: float = 0.01) -> Array:
        return plane.at(np.column_stack([x, y]), height)

    stream.static(f"{root}/frame", *plane.frame(law.title))
    ends = [at(np.array([x, x]), np.array([y - h, y + h])) for x, y, h in zip(law.x, law.y, half, strict=True)]
    stream.static(f"{root}/interval", rr.LineStrips3D(ends, radii=0.002, colors=[FAINT] * len(ends)))
    stream.static(f"{root}/missing", rr.Points3D(at(law.x, law.y, 0.03), radii=0.009, colors=[TRUTH]))
    if law.law.size and law.shape == "cloud":
        stream.static(f"{root}/named", rr.Points3D(at(law.at, law.law, 0.02), radii=0.004, colors=[WITH]))
    elif law.law.size:
        # A loop is in parts, with a gap after each.
        parts = np.split(np.column_stack([law.at, law.law]), np.flatnonzero(np.isnan(law.at)) + 1)
        kept = [part[np.isfinite(part).all(axis=1)] for part in parts if len(part) > 1]
        strips = [at(part[:, 0], part[:, 1], 0.02) for part in kept]
        stream.static(f"{root}/named", rr.LineStrips3D(strips, radii=0.006, colors=[WITH] * len(strips)))
    if law.lead:
        stream.views[root] = view(root, f"{law.title}: what the data ask for (white), the named law (blue)")


def _axis(label: str, low: float, high: float) -> Axis:
    name, _, unit = label.partition(" [")
    return Axis(name, unit.removesuffix("]"), float(low), float(high))


def _waterfall(stream: Stream, w: Any) -> None:
    names = ["before", *(f"+ {n}" for n in w.labels[1:])]
    rows = "".join(f"| {n} | {100 * e / w.error[0]:.3g} % |\n" for n, e in zip(names, w.error, strict=True))
    text = f"| in the order listed | held-out error left |\n| --- | --- |\n{rows}"
    stream.static("explained", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))
    stream.views["explained"] = rrb.TextDocumentView(origin="explained", name="What each cause explained")


def _correlation(stream: Stream, c: Any) -> None:
    root = f"left/{c.channel}-{c.against}"
    for name, colour in BOTH:
        stream.line(f"{root}/{name}", getattr(c, name), colour, name)
    stream.line(f"{root}/chance", c.band * np.array([[-1.0, 1.0]] * len(c.lag)), FAINT, "chance", 1.0)
    step = float(np.median(np.diff(c.lag))) if len(c.lag) > 1 else 0.0
    first = f"{c.lag[0]:.3g} s" if len(c.lag) else "0"
    title = f"Residual of {c.channel} with {c.against}: correlation, step 0 is lag {first}, each {step:.3g} s"
    stream.views[root] = series(root, title, -1.05, 1.05)
