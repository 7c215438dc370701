"""How wrong a model is: maps of the gap beside γ, residuals in bands, windows of a recording; and where simulators differ."""

from __future__ import annotations

import numpy as np
import rerun as rr

from gapcert import Array
from gapcert_figures import Axis, Band, CompareFigure, GapFigure, RecordedFigure, held, labelled

from .canvas import BAD, FAINT, GOOD, STEP, TRUTH, WITH, WITHOUT, Canvas, Colour, Plane, Seen, series

_TUBE: Colour = (70, 108, 165, 255)
_REACH: Colour = (36, 54, 82, 255)


def draw_gap(canvas: Canvas, gap: GapFigure) -> None:
    """Per state: true gap beside γ as maps, and the residual in its band along the axis that leads."""
    called = "refuted" if canvas.refuted else "certified"
    for s in gap.slices:
        root, top = f"gap/{s.state}", float(np.nanmax([s.gamma, s.gap]))
        left, right = Plane(gap.axes[0], gap.axes[1]), Plane(gap.axes[0], gap.axes[1], STEP)
        canvas.static(f"{root}/true", left.heat(s.gap, top))
        canvas.static(f"{root}/true/frame", *left.frame("true gap |f̂ − f|"))
        canvas.static(f"{root}/gamma", right.heat(s.gamma, top))
        canvas.static(f"{root}/gamma/frame", *right.frame(f"{called} γ, and samples", left=False))
        canvas.static(f"{root}/scale", *right.scale(top, s.unit))
        canvas.static(f"{root}/gamma/samples", rr.Points3D(right.at(gap.samples), radii=0.005, colors=[(255, 255, 255, 255)]))
        canvas.show("gap", s.state, Seen(root, f"How wrong: {s.state} [{s.unit}]{held(gap.fixed)}", 2, bar=True))
    for state, lead in gap.leads.items():
        for b in gap.bands:
            if b.state == state:
                _band(canvas, f"band/{state}/{b.axis.name}", b)
        axis = gap.bands[lead].axis.name
        canvas.show("band", state, Seen(f"band/{state}/{axis}", f"f̂ − f of {state} along {axis}, and its {called} band"))


def _band(canvas: Canvas, path: str, b: Band) -> None:
    reach = 1.15 * max(b.constant, float(b.gamma.max()))
    marks = [name for name, known in (("refuted", canvas.refuted), ("no band: l above u", b.empty.any())) if known]
    plane = canvas.plane(path, b.axis, Axis(f"gap of {b.state}", b.unit, -reach, reach), "; ".join(marks))
    drawn = (("gamma", -b.gamma, b.gamma, _REACH, 0.005), ("envelope", b.low, b.high, _TUBE, 0.01))
    for name, low, high, colour, height in drawn:
        # A refuted band has its ends alone, and so has one that no value lies in.
        bare = np.full(len(b.at), canvas.refuted) | (low > high)
        for side, end in (("low", low), ("high", high)) if bare.any() else ():
            canvas.static(f"{path}/{name}_{side}", plane.curve(b.at, np.where(bare, end, np.nan), BAD))
        if not bare.all():
            canvas.static(f"{path}/{name}", plane.ribbon(b.at, low, high, colour, height))
    for side, sign in (("low", -1), ("high", 1)):
        level = np.full_like(b.at, sign * b.constant)
        canvas.static(f"{path}/constant_{side}", plane.curve(b.at, level, FAINT, 0.0015))
    canvas.static(f"{path}/residual", plane.curve(b.at, b.residual, TRUTH))


def draw_recorded(canvas: Canvas, f: RecordedFigure) -> None:
    """Scores of the held windows in order, and the stretch of the window that set the band."""
    n = len(f.scores)
    low, high = min(0.0, float(f.scores.min())), float(f.scores.max())
    pad = 0.05 * (high - low) or 1.0
    windows, score = Axis("held window, from the best to the worst", "", 0, n + 1), Axis("score", "", low - pad, high + pad)
    plane = canvas.plane("scores", windows, score, f"rank {f.rank} of {n} sets the band")
    place = np.column_stack([np.arange(1, n + 1), f.scores])
    canvas.static("scores/zero", *plane.zero())
    canvas.static("scores/windows", rr.Points3D(plane.at(place), radii=0.005, colors=[WITH]))
    canvas.static("scores/rank", rr.Points3D(plane.at(place[f.rank - 1 : f.rank], 0.03), radii=0.014, colors=[GOOD]))
    canvas.show("scores", "scores", Seen("scores", "How far each window leaves the band of the fit, in scales"))
    for s in f.stretches:
        root, every = f"stretch/{s.state}", np.concatenate([s.low, s.high, s.residual])
        bottom, top = float(every.min()), float(every.max())
        canvas.band(f"{root}/band", s.t, s.low, s.high, WITH, "[l, u]", s.unit)
        canvas.line(f"{root}/residual", s.t, s.residual, TRUTH, "x⁺ − f", 2.0)
        pad, title = 0.1 * (top - bottom) or 1.0, f"gap of {labelled(s.state, s.unit)} as measured (white) in its band"
        canvas.show("stretch", s.state, series(root, title, bottom - pad, top + pad, float(s.t[-1])))


def draw_comparison(canvas: Canvas, comparison: CompareFigure) -> None:
    """Per pair that differs where it does, and how common runs of all pairs come apart."""
    end = 0.0
    for p in comparison.pairs:
        name = f"{p.a} against {p.b}"
        if p.values.size:
            root, top = f"pair/{p.a}-{p.b}", float(np.nanmax(p.values))
            plane = canvas.plane(root, p.axes[0], p.axes[1], f"one step of {p.state} differs by")
            canvas.static(f"{root}/map", plane.heat(p.values, top))
            canvas.static(f"{root}/scale", *plane.scale(top, p.unit))
            canvas.show("pair", root, Seen(root, f"{name}{f', {p.fixed}' if p.fixed else ''}", bar=True))
        if p.drift.size:
            # On a linear axis only the order of magnitude shows them all.
            t = comparison.period * np.arange(len(p.drift), dtype=np.float64)
            level: Array = np.log10(np.maximum(p.drift, 1e-18))
            canvas.line(f"drift/{p.a}-{p.b}", t, level, WITHOUT if p.values.size else GOOD, name)
            end = max(end, float(t[-1]))
    if end:
        title = "How runs come apart: log10 of their difference over one step's motion"
        canvas.show("drift", "drift", series("drift", title, -18.5, 3.0, end))
