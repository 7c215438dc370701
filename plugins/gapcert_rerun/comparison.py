"""Simulator against simulator: where one step differs, and how common runs come apart."""

from __future__ import annotations

import numpy as np

from gapcert import Array
from gapcert_figures import CompareFigure

from .canvas import Canvas
from .plane import GOOD, WITHOUT, Seen, series


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
