"""What a picture shows, as data: read off the drawn axes, so that a page tells the very numbers that it draws."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, final

import numpy as np

from gapcert.plugin import Array

from .pictures.palette import variables

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage
    from matplotlib.lines import Line2D

_CLASSES = "_gapcert_classes"


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


def name_classes(image: AxesImage, names: Sequence[str]) -> None:
    """Name the values 0, 1, … of a map."""
    image.set_label("here")
    setattr(image, _CLASSES, list(names))


def legend_of(figure: Figure, handles: Sequence[Any]) -> tuple[Entry, ...]:
    """An entry per name; the legend itself is not drawn: the page shows it, where it wraps and can be pressed."""
    named = {str(h.get_label()): h for h in reversed(handles)}
    if not named:
        return ()
    legend = figure.legend(handles=[named[n] for n in dict.fromkeys(str(h.get_label()) for h in handles)])
    found = zip(legend.get_texts(), legend.legend_handles, strict=True)
    entries = tuple(Entry(text.get_text(), variables(_swatch(handle))) for text, handle in found)
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


def read(ax: Axes) -> list[Series]:
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


def as_data(ax: Axes, series: Sequence[Series], title: str, link: str) -> Mapping[str, Any]:
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
