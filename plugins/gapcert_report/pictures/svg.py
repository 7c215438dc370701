"""Drawing to inline SVG, and what is drawn as data: read off the axes, so that a page tells the very numbers that it draws.

Text stays text, and colours are variables of the page's style sheet, for which pictures are drawn with stand-ins.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import TYPE_CHECKING, Any, final

import numpy as np

from gapcert.plugin import Array, Bools
from gapcert_figures import Axis
from gapcert_report.words.words import power

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage
    from matplotlib.lines import Line2D

# No colour map produces these; each becomes a CSS variable, so that dark mode and print choose their own.
INK, FAINT, WITH, WITHOUT, TRUTH, BAD, GOOD = "#111213", "#717273", "#2f6fd1", "#d9670b", "#111214", "#c81e32", "#15803e"
CARD = "#fdfcfb"
_VARIABLES = {
    INK: "ink", FAINT: "faint", WITH: "with", WITHOUT: "without", TRUTH: "truth", BAD: "bad", GOOD: "good", CARD: "card",
}  # fmt: skip
ROLES = {
    "with γ": WITH, "without γ": WITHOUT, "measured": TRUTH, "before": WITHOUT, "after": WITH,
    "stay": INK, "avoid": BAD, "target": GOOD, "region": GOOD,
    # Inside bitmaps, so readable on light and dark alike.
    "both": "#4a86dc", "only_with_gamma": "#23b5a8", "only_without_gamma": "#e8833a",
}  # fmt: skip
"""What figures name, in its colour."""


Paint = Callable[["Axes"], Sequence[Any] | None]
WIDTH = 4.2  # inches
_CLASSES = "_gapcert_classes"
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
        legend = _legend_of(figure, ax.get_legend_handles_labels()[0] if shown is None else shown)
        series = _read(ax)
        if (layout := figure.get_layout_engine()) is not None:
            layout.execute(figure)
        figure.set_layout_engine(None)
        out = io.StringIO()
        figure.savefig(out, format="svg", dpi=110, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
        data = _as_data(ax, series, title, link) if series else None
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
    svg = re.sub(r"'DejaVu Sans'[^;\"]*", "system-ui, sans-serif", _variables(svg))
    return svg.replace("<svg ", f'<svg role="img" aria-label="{escape(label, quote=True)}" ', 1).strip()


def _variables(text: str) -> str:
    """A text in which each stand-in is the variable that it stands for."""
    for stand_in, name in _VARIABLES.items():
        text = text.replace(stand_in, f"var(--{name})")
    return text


def scaled(unit: str, *values: Array) -> tuple[float, str]:
    """A power of ten that brings the largest value near 1, and the unit with it: (1e-5, "10⁻⁵ rad")."""
    top = max((float(np.abs(v[np.isfinite(v)]).max(initial=0.0)) for v in values), default=0.0)
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


def classes(ax: Axes, axes: Sequence[Axis], parts: Sequence[tuple[Bools, str, str, float]]) -> list[Any]:
    """A map of disjoint parts (mask, colour, name, opacity), and the legend's entries of those that are not empty."""
    from matplotlib.colors import ListedColormap, to_rgba
    from matplotlib.patches import Patch

    values = np.full(parts[0][0].shape, np.nan)
    for k, (mask, *_) in enumerate(parts):
        values[mask] = k
    colours = ListedColormap([to_rgba(colour, alpha) for _, colour, _, alpha in parts])
    image = ax.imshow(values, **_cells(axes), cmap=colours, vmin=-0.5, vmax=len(parts) - 0.5)
    _name_classes(image, [name for _, _, name, _ in parts])
    return [Patch(color=colour, alpha=alpha, label=name) for mask, colour, name, alpha in parts if mask.any()]


def _cells(axes: Sequence[Axis]) -> Any:
    # Not interpolated at all, an image has one pixel a cell: it is small, and stays exact however far one looks into it.
    extent = (axes[0].low, axes[0].high, axes[1].low, axes[1].high)
    return {"extent": extent, "origin": "lower", "aspect": "auto", "interpolation": "none"}


@final
@dataclass(frozen=True)
class Entry:
    """One entry of a legend: its name, and a drawing of what it names, as SVG."""

    name: str
    swatch: str


@final
@dataclass
class Series:
    """What one name of a picture stands for: parts {x, y}, {x, low, high} or {values, low, high of both axes}."""

    name: str
    kind: str
    parts: list[dict[str, Any]] = field(default_factory=list)


def _name_classes(image: AxesImage, names: Sequence[str]) -> None:
    """Name the values 0, 1, … of a map."""
    image.set_label("here")
    setattr(image, _CLASSES, list(names))


def _legend_of(figure: Figure, handles: Sequence[Any]) -> tuple[Entry, ...]:
    """An entry per name; the legend itself is not drawn: the page shows it, where it wraps and can be pressed."""
    named = {str(h.get_label()): h for h in reversed(handles)}
    if not named:
        return ()
    legend = figure.legend(handles=[named[n] for n in dict.fromkeys(str(h.get_label()) for h in handles)])
    found = zip(legend.get_texts(), legend.legend_handles, strict=True)
    entries = tuple(Entry(text.get_text(), _variables(_swatch(handle))) for text, handle in found)
    legend.remove()
    return entries


def _swatch(handle: Any) -> str:
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_hex, to_rgba
    from matplotlib.lines import Line2D

    if isinstance(handle, Line2D):
        return _line_swatch(handle)
    if isinstance(handle, LineCollection):  # of an error bar
        colour = to_hex(np.atleast_2d(handle.get_colors())[0])
        return f'<path d="M11 0V10" stroke="{colour}"/><circle cx="11" cy="5" r="2.6" fill="{colour}"/>'
    face, edge = (np.atleast_2d(get())[0] if np.size(get()) else None for get in (handle.get_facecolor, handle.get_edgecolor))
    parts = [f'{what}="{to_hex(c)}" {what}-opacity="{to_rgba(c)[3]:.3g}"'
             for what, c in (("fill", face), ("stroke", edge)) if c is not None]  # fmt: skip
    if getattr(handle, "get_hatch", str)():
        return f'<path d="M2 9L8 1M8 9L14 1M14 9L20 1" fill="none" stroke="{to_hex(handle.get_edgecolor())}"/>'
    dashed = ' stroke-dasharray="1.5 2"' if getattr(handle, "get_linestyle", str)() in (":", "dotted") else ""
    return f'<rect x="1" y="1" width="20" height="8" {" ".join(parts)}{dashed}/>'


def _line_swatch(line: Line2D) -> str:
    from matplotlib.colors import to_hex

    drawn_in: Any = line.get_color()
    colour, opacity = to_hex(drawn_in), f"{line.get_alpha() or 1:.3g}"
    dashes = {"--": ' stroke-dasharray="5 3"', ":": ' stroke-dasharray="1.5 2"'}.get(str(line.get_linestyle()), "")
    drawn = "" if line.get_linestyle() in ("None", "") else (
        f'<path d="M1 5H21" fill="none" stroke="{colour}" stroke-opacity="{opacity}" '
        f'stroke-width="{min(line.get_linewidth(), 4):.3g}"{dashes}/>'
    )  # fmt: skip
    marker = str(line.get_marker())
    if marker in ("None", ""):
        return drawn
    edge = to_hex(line.get_markeredgecolor())
    if marker in "x+":
        return f'{drawn}<path d="M8 2L14 8M8 8L14 2" fill="none" stroke="{edge}" stroke-width="1.8"/>'
    hollow = str(line.get_markerfacecolor()).lower() == "none"
    style = f'fill="{"none" if hollow else to_hex(line.get_markerfacecolor())}" stroke="{edge}"'
    shapes = {"^": '<path d="M11 1.5L15 8H7z"', "v": '<path d="M11 8.5L15 2H7z"', ".": '<circle cx="11" cy="5" r="2"'}
    shape = shapes.get(marker, '<circle cx="11" cy="5" r="3.2"')
    return f"{drawn}{shape} {style}/>"


def _read(ax: Axes) -> list[Series]:
    """Everything of which a page tells values, and a mark on every artist that moves with the axes or belongs to a series."""
    from matplotlib.collections import PolyCollection

    found: dict[str, Series] = {}
    marks = 0

    def mark(artist: Artist, series: str) -> None:
        nonlocal marks
        marks += 1
        artist.set_gid(f"{series}.{marks}")

    def add(name: str, kind: str, part: dict[str, Any]) -> str:
        series = found.setdefault(name, Series(name, kind))
        series.parts.append(part)
        return f"s{list(found).index(name)}"

    arrows = [arrow for text in ax.texts if (arrow := getattr(text, "arrow_patch", None)) is not None]
    for artist in (*ax.texts, *arrows, *ax.patches, *ax.collections, *ax.lines):
        mark(artist, "d")
    if _named(ax):
        return []
    for image in ax.images:
        add(str(image.get_label()), "map", _map(image))
    bands = [c for c in ax.collections if isinstance(c, PolyCollection)]
    alike = {_fill(c): _name(c) for c in reversed(bands) if _name(c)}
    for band in bands:
        if name := _name(band) or alike.get(_fill(band), ""):
            for part in _band(band):
                mark(band, add(name, "band", part))
    for container in ax.containers:
        line, caps, bars = getattr(container, "lines", (None, (), ()))
        if line is not None and (name := str(container.get_label())):
            for one in (line, *caps, *bars):
                mark(one, add(name, "dots", _measured(line, bars)) if one is line else f"s{list(found).index(name)}")
    for line, name in _lines(ax, (False, True)):
        mark(line, add(name, "level", {"y": np.asarray(line.get_ydata(orig=False), float)[:1]}))
    for line, name in _lines(ax):
        x, y = (np.asarray(v, float) for v in (line.get_xdata(orig=False), line.get_ydata(orig=False)))
        mark(line, add(name, _kind(line, x), {"x": x, "y": y}))
    return list(found.values())


def _named(ax: Axes) -> bool:
    """Is an axis one of names? Then the numbers stand in the picture already."""
    from matplotlib.ticker import FixedFormatter

    both = (ax.xaxis, ax.yaxis)
    return any(isinstance(a.get_major_formatter(), FixedFormatter) or len(a.get_ticklocs()) == 0 for a in both)


def _name(artist: Artist) -> str:
    label = str(artist.get_label() or "")
    return "" if label.startswith("_") else label


def _lines(ax: Axes, over_both: tuple[bool, bool] = (True, True)) -> Iterator[tuple[Line2D, str]]:
    """Lines over both axes, or one, with their names; one without a name has that of the one that looks like it."""
    inside = {id(x) for c in ax.containers if hasattr(c, "lines") for x in (c.lines[0], *c.lines[1])}
    data = ax.transData
    over = [a for a in ax.lines if id(a) not in inside and a.get_transform().contains_branch_seperately(data) == over_both]
    alike = {_look(a): _name(a) for a in reversed(over) if _name(a)}
    single = all(over_both) and len({_look(a) for a in over}) == 1 and not ax.images
    alone = ax.get_ylabel().split(" [")[0] if single else ""
    for line in over:
        if name := _name(line) or alike.get(_look(line), alone):
            yield line, name


def _fill(band: PolyCollection) -> tuple[str, ...]:
    return tuple(map(str, band.get_facecolor()))


def _look(line: Line2D) -> tuple[str, str, str]:
    return str(line.get_color()), str(line.get_linestyle()), str(line.get_marker())


def _kind(line: Line2D, x: Array) -> str:
    steps = np.diff(x[np.isfinite(x)])
    if (steps < 0).any():
        return "path"
    return "dots" if line.get_linestyle() in ("None", "") else "line"


def _map(image: AxesImage) -> dict[str, Any]:
    values: Array = np.ma.filled(np.ma.asarray(image.get_array(), float), np.nan)
    left, right, bottom, top = image.get_extent()
    part = {"values": values.ravel(), "columns": values.shape[1], "rows": values.shape[0]}
    part |= {"x": [left, right], "y": [bottom, top]}
    if (names := getattr(image, _CLASSES, None)) is not None:
        part["names"] = names
    return part


def _band(band: PolyCollection) -> Iterator[dict[str, Any]]:
    # matplotlib goes along one edge and back along the other, with one point more at each end, and one that closes.
    for path in band.get_paths():
        corners = np.asarray(path.vertices)
        n = (len(corners) - 3) // 2
        there, back = corners[1 : n + 1], corners[n + 2 : 2 * n + 2][::-1]
        ends = np.stack([there[:, 1], back[:, 1]])
        yield {"x": there[:, 0], "low": ends.min(axis=0), "high": ends.max(axis=0)}


def _measured(line: Line2D, bars: Sequence[Any]) -> dict[str, Any]:
    x, y = (np.asarray(v, float) for v in (line.get_xdata(orig=False), line.get_ydata(orig=False)))
    part = {"x": x, "y": y}
    if bars:
        ends = np.array([s[:, 1] for s in bars[0].get_segments()])
        part |= {"low": ends.min(axis=1), "high": ends.max(axis=1)}
    return part


def _as_data(ax: Axes, series: Sequence[Series], title: str, link: str) -> Mapping[str, Any]:
    """JSON of a drawn picture: its axes, where they lie in the SVG, and the series; arrays are packed."""
    figure = ax.get_figure(root=True)
    assert figure is not None
    at, (wide, high) = ax.get_position(), figure.get_size_inches() * 72
    box = [at.x0 * wide, (1 - at.y1) * high, at.x1 * wide, (1 - at.y0) * high]
    axes = {}
    for key, axis, limits in (("x", ax.xaxis, ax.get_xlim()), ("y", ax.yaxis, ax.get_ylim())):
        name, _, unit = axis.get_label_text().partition(" [")
        axes[key] = {"name": name, "unit": unit.removesuffix("]"), "limits": limits, "log": axis.get_scale() == "log"}
    small = [[{k: packed(v) if isinstance(v, np.ndarray) else v for k, v in p.items()} for p in s.parts] for s in series]
    shown = [{"name": s.name, "kind": s.kind, "parts": parts} for s, parts in zip(series, small, strict=True)]
    return {"title": title, "box": [round(v, 2) for v in box], **axes, "series": shown, "link": link}


def packed(values: Array) -> dict[str, Any]:
    """An array in JSON, small: evenly spaced as {n, first, step}; steps as {runs} of (whole number or None, how often); else
    as {offset, f32} in base64: seven digits of every value, where all are close of its distance from the offset. NaN stands for
    what is not there.
    """
    values = np.asarray(values, float).ravel()
    known = values[np.isfinite(values)]
    n, wide, top = len(values), float(np.ptp(known)) if len(known) else 0.0, float(np.abs(known).max(initial=0.0))
    if n > 2 and len(known) == n:
        first, step = float(values[0]), float(values[-1] - values[0]) / (n - 1)
        if np.allclose(values, first + step * np.arange(n), rtol=0, atol=1e-9 * max(wide, 1e-3 * top)):
            return {"n": n, "first": first, "step": step}
    starts = np.flatnonzero(np.append(True, ~((values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1])))))
    if 4 * len(starts) < n and (known == np.round(known)).all():
        counts = np.diff(np.append(starts, n)).tolist()
        return {"runs": [[None if np.isnan(v) else int(v), c] for v, c in zip(values[starts], counts, strict=True)]}
    offset = float(known[0]) if top > 100 * wide else 0.0
    return {"offset": offset, "f32": base64.b64encode((values - offset).astype("<f4").tobytes()).decode()}
