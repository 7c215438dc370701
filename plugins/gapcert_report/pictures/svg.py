"""Drawing to inline SVG: text stays text, and colours are variables of the page's style sheet."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any, final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array
from gapcert_figures import Axis
from gapcert_report.harvest import Entry, as_data, legend_of, name_classes, read
from gapcert_report.words.words import power

from .palette import BAD, CARD, FAINT, GOOD, INK, ROLES, TRUTH, WITH, WITHOUT, variables

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["BAD", "CARD", "FAINT", "GOOD", "INK", "ROLES", "TRUTH", "WITH", "WITHOUT", "Picture", "draw"]
Paint = Callable[["Axes"], Sequence[Any] | None]
WIDTH = 4.2  # inches
_STYLE: Any = {
    "svg.fonttype": "none", "font.family": "sans-serif", "font.size": 9.5, "axes.titlesize": 9.5, "axes.labelsize": 9.5,
    "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": FAINT, "axes.labelcolor": INK, "text.color": INK,
    "xtick.color": FAINT, "ytick.color": FAINT, "xtick.labelcolor": INK, "ytick.labelcolor": INK, "axes.unicode_minus": True,
    "figure.facecolor": "none", "axes.facecolor": "none", "savefig.facecolor": "none", "legend.frameon": False,
    "legend.fontsize": 8.5, "lines.linewidth": 1.5, "path.simplify_threshold": 0.15, "hatch.linewidth": 0.7,
    "image.composite_image": False, "axes.formatter.useoffset": False,
}  # fmt: skip


@final
@dataclass(frozen=True)
class Picture:
    """One drawing: inline SVG, its title, what it shows in a sentence, its legend, and its values (None: there are none)."""

    title: str
    caption: str
    svg: str
    legend: tuple[Entry, ...] = ()
    data: Mapping[str, Any] | None = None


def draw(key: str, title: str, caption: str, paint: Paint, height: float = WIDTH * 0.62, link: str = "") -> Picture:
    """Run `paint` on fresh axes and return the SVG; the same input gives the same bytes.

    What `paint` returns is in the legend; where that is None, all that has a label. Pictures of one `link` share a cursor.
    """
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_STYLE | {"svg.hashsalt": key}):
        # An SVG is drawn at 72 dots per inch. Arranged before it is saved, it is not drawn a first time for its layout only.
        figure = Figure(figsize=(WIDTH, height), layout="constrained", dpi=72)
        FigureCanvasSVG(figure)
        ax = figure.add_subplot()
        shown = paint(ax)
        _thin_out(ax)
        legend = legend_of(figure, ax.get_legend_handles_labels()[0] if shown is None else shown)
        series = read(ax)
        if (layout := figure.get_layout_engine()) is not None:
            layout.execute(figure)
        figure.set_layout_engine(None)
        out = io.StringIO()
        figure.savefig(out, format="svg", dpi=110, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
        data = as_data(ax, series, title, link) if series else None
    return Picture(title, caption, _inline(out.getvalue(), key, caption), legend, data)


def _thin_out(ax: Axes) -> None:
    """Fewer labels along x, where long ones would touch."""
    from matplotlib.ticker import AutoLocator, MaxNLocator

    if isinstance(ax.xaxis.get_major_locator(), AutoLocator):
        ax.xaxis.set_major_locator(MaxNLocator(nbins=6, steps=[1, 2, 2.5, 5, 10]))


def _inline(svg: str, key: str, label: str) -> str:
    """Strip what only a stand-alone file needs, make ids unique on the page, and turn colours into variables."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", svg)
    svg = re.sub(r"\n\s*", "\n", svg).replace("\n<", "<")
    svg = re.sub(r"<metadata>.*?</metadata>|<defs><style.*?</style></defs>", "", svg, flags=re.S)
    # Hundredths of a point are finer than any screen, and half the size.
    svg = re.sub(r' (d|x|y|transform)="[^"]*"', lambda m: re.sub(r"(\.\d\d)\d+", r"\1", m.group()), svg)
    svg = re.sub(r' transform="rotate\(-0 [^"]*"', "", svg)
    # What can be shown, hidden and moved in the page, and what is found by a reference; all other names are in no use.
    svg = re.sub(r'<g id="(s\d+|d)\.\d+"', r'<g data-s="\1"', svg)
    svg = re.sub(r'<g (clip-path="[^"]*")><image', r'<g data-s="d" \1><image', svg)
    svg = re.sub(r'<g id="[xy]tick_\d+"', '<g class="tick"', svg).replace('<g id="axes_1"', '<g class="axes"', 1)
    used = set(re.findall(r'(?:url\(|href=")#([^")]*)', svg))
    svg = re.sub(r' id="([^"]*)"', lambda m: f' id="{key}-{m[1]}"' if m[1] in used else "", svg)
    svg = svg.replace("url(#", f"url(#{key}-").replace('href="#', f'href="#{key}-').replace("xlink:href", "href")
    svg = re.sub(r'<svg ([^>]*?)width="[\d.]+pt" height="[\d.]+pt"', r"<svg \1", svg, count=1)
    svg = re.sub(r"'DejaVu Sans'[^;\"]*", "system-ui, sans-serif", variables(svg))
    return svg.replace("<svg ", f'<svg role="img" aria-label="{escape(label, quote=True)}" ', 1).strip()


def scaled(unit: str, *values: Array) -> tuple[float, str]:
    """A power of ten that brings the largest value near 1, and the unit with it: (1e-5, "10⁻⁵ rad")."""
    top = max((float(np.nanmax(np.abs(v))) for v in values if v.size), default=0.0)
    exponent = int(np.floor(np.log10(top))) if top > 0 else 0
    if -2 <= exponent <= 3:
        return 1.0, unit
    return 10.0**exponent, f"{power(exponent)} {unit}"


def name_axes(ax: Axes, axes: Sequence[Axis]) -> None:
    """Labels and limits of the first two axes."""
    x, y = axes[:2]
    ax.set(xlabel=x.label, ylabel=y.label, xlim=(x.low, x.high), ylim=(y.low, y.high))


def heat(ax: Axes, axes: Sequence[Axis], values: Array, top: float, label: str, bar: str = "right") -> None:
    """A map of values (rows along the second axis, columns along the first) on the colours 0 … top, with its bar."""
    image = ax.imshow(values, **_cells(axes), cmap="viridis", vmin=0, vmax=top)
    image.set_label(label)
    name_axes(ax, axes)
    drawn = ax.figure.colorbar(image, ax=ax, label=label, location=bar, aspect=20 if bar == "right" else 40)
    drawn.outline.set_visible(False)


def classes(ax: Axes, axes: Sequence[Axis], parts: Sequence[tuple[npt.NDArray[np.bool_], str, str, float]]) -> list[Any]:
    """A map of disjoint parts (mask, colour, name, opacity), and the legend's entries of those that are not empty."""
    from matplotlib.colors import ListedColormap, to_rgba
    from matplotlib.patches import Patch

    values = np.full(parts[0][0].shape, np.nan)
    for k, (mask, *_) in enumerate(parts):
        values[mask] = k
    colours = ListedColormap([to_rgba(colour, alpha) for _, colour, _, alpha in parts])
    image = ax.imshow(values, **_cells(axes), cmap=colours, vmin=-0.5, vmax=len(parts) - 0.5)
    name_classes(image, [name for _, _, name, _ in parts])
    return [Patch(color=colour, alpha=alpha, label=name) for mask, colour, name, alpha in parts if mask.any()]


def _cells(axes: Sequence[Axis]) -> Any:
    # Not interpolated at all, an image has one pixel a cell: it is small, and stays exact however far one looks into it.
    extent = (axes[0].low, axes[0].high, axes[1].low, axes[1].high)
    return {"extent": extent, "origin": "lower", "aspect": "auto", "interpolation": "none"}
