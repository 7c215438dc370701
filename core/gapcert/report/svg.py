"""Drawing to inline SVG: text stays text, and colours are variables of the page's style sheet."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np

from gapcert.figures import Axis
from gapcert.report.words import power
from gapcert.system import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Stand-ins that no colour map produces; each becomes a CSS variable, so that dark mode and print choose their own.
INK, FAINT, WITH, WITHOUT, TRUTH, BAD, GOOD = "#111213", "#717273", "#2f6fd1", "#d9670b", "#111214", "#c81e32", "#15803e"
CARD = "#fdfcfb"
_VARIABLES = {
    INK: "ink", FAINT: "faint", WITH: "with", WITHOUT: "without", TRUTH: "truth", BAD: "bad", GOOD: "good", CARD: "card",
}  # fmt: skip
_STYLE: Any = {
    "svg.fonttype": "none", "font.family": "sans-serif", "font.size": 9.5, "axes.titlesize": 9.5, "axes.labelsize": 9.5,
    "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": FAINT, "axes.labelcolor": INK, "text.color": INK,
    "xtick.color": FAINT, "ytick.color": FAINT, "xtick.labelcolor": INK, "ytick.labelcolor": INK, "axes.unicode_minus": True,
    "figure.facecolor": "none", "axes.facecolor": "none", "savefig.facecolor": "none", "legend.frameon": False,
    "legend.fontsize": 8.5, "lines.linewidth": 1.5, "path.simplify_threshold": 0.3, "hatch.linewidth": 0.7,
}  # fmt: skip


@final
@dataclass(frozen=True)
class Picture:
    """One drawing: inline SVG, its title, and what it shows in a sentence."""

    title: str
    caption: str
    svg: str


def draw(key: str, title: str, caption: str, paint: Callable[[Axes], None], height: float = 2.9) -> Picture:
    """Run `paint` on fresh axes and return the SVG; the same input gives the same bytes."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_STYLE | {"svg.hashsalt": key}):
        # An SVG is drawn at 72 dots per inch. Arranged before it is saved, it is not drawn a first time for its layout only.
        figure = Figure(figsize=(4.5, height), layout="constrained", dpi=72)
        FigureCanvasSVG(figure)
        paint(figure.add_subplot())
        if (layout := figure.get_layout_engine()) is not None:
            layout.execute(figure)
        figure.set_layout_engine(None)
        out = io.StringIO()
        figure.savefig(out, format="svg", dpi=110, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    return Picture(title, caption, _inline(out.getvalue(), key, caption))


def _inline(svg: str, key: str, label: str) -> str:
    """Strip what only a stand-alone file needs, make ids unique on the page, and turn colours into variables."""
    from html import escape

    svg = svg[svg.index("<svg") :]
    svg = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", svg)
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.S)
    svg = re.sub(r"\n\s*", "\n", svg)
    # Hundredths of a point are finer than any screen, and half the size.
    svg = re.sub(r' (d|x|y)="[^"]*"', lambda m: re.sub(r"(\.\d\d)\d+", r"\1", m.group()), svg)
    svg = re.sub(r'\bid="', f'id="{key}-', svg).replace("url(#", f"url(#{key}-").replace('href="#', f'href="#{key}-')
    svg = re.sub(r'<svg ([^>]*?)width="[\d.]+pt" height="[\d.]+pt"', r"<svg \1", svg.replace("\n<", "<"), count=1)
    for stand_in, name in _VARIABLES.items():
        svg = svg.replace(stand_in, f"var(--{name})")
    svg = re.sub(r"'DejaVu Sans'[^;\"]*", "system-ui, sans-serif", svg)
    return svg.replace("<svg ", f'<svg role="img" aria-label="{escape(label, quote=True)}" ', 1)


def scaled(unit: str, *values: Array) -> tuple[float, str]:
    """A power of ten that brings the largest value near 1, and the unit with it: (1e-5, "10⁻⁵ rad")."""
    top = max((float(np.nanmax(np.abs(v))) for v in values if v.size), default=0.0)
    exponent = int(np.floor(np.log10(top))) if top > 0 else 0
    if -2 <= exponent <= 3:
        return 1.0, unit
    return 10.0**exponent, f"{power(exponent)} {unit}"


def axis_label(axis: Axis) -> str:
    """`theta [rad]`; the name alone where there is no unit."""
    return axis.name if axis.unit in ("", "1") else f"{axis.name} [{axis.unit}]"


def extent_of(axes: Sequence[Axis]) -> tuple[float, float, float, float]:
    """(left, right, bottom, top) of the first two axes."""
    return axes[0].low, axes[0].high, axes[1].low, axes[1].high


def name_axes(ax: Axes, axes: Sequence[Axis]) -> None:
    """Labels and limits of the first two axes."""
    ax.set(
        xlabel=axis_label(axes[0]),
        ylabel=axis_label(axes[1]),
        xlim=(axes[0].low, axes[0].high),
        ylim=(axes[1].low, axes[1].high),
    )


def figure_of(ax: Axes) -> Figure:
    """The figure that axes are part of."""
    figure = ax.get_figure(root=True)
    assert figure is not None
    return figure


def heat(ax: Axes, axes: Sequence[Axis], values: Array, top: float, label: str, bar: str = "right") -> None:
    """A map of values (rows along the second axis, columns along the first) on the colours 0 … top, with its bar."""
    image = ax.imshow(
        values, extent=extent_of(axes), origin="lower", aspect="auto", cmap="viridis", vmin=0, vmax=top, interpolation="nearest"
    )
    name_axes(ax, axes)
    drawn = figure_of(ax).colorbar(image, ax=ax, label=label, location=bar, aspect=20 if bar == "right" else 40)
    drawn.outline.set_visible(False)
