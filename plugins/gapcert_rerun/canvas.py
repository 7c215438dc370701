"""What is drawn with: planes seen from above, values over time, static shapes and text of a recording, and their views.

A plane has two axes of any units on a unit square, y up, with their names and limits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from gapcert.plugin import Array, Bools
from gapcert_figures import Axis

Colour = tuple[int, int, int, int]
WITH, WITHOUT, TRUTH, FAINT = (110, 168, 255, 255), (255, 154, 77, 255), (240, 240, 240, 255), (150, 156, 166, 255)
ONLY_WITH, GOOD, BAD = (60, 190, 178, 255), (95, 209, 151, 255), (255, 105, 120, 255)
ROLES: Mapping[str, Colour] = {
    "with γ": WITH, "without γ": WITHOUT, "measured": TRUTH, "before": WITHOUT, "after": WITH,
    "stay": TRUTH, "avoid": BAD, "target": GOOD, "region": GOOD,
    "both": WITH, "only_with_gamma": ONLY_WITH, "only_without_gamma": WITHOUT,
}  # fmt: skip
"""What figures name, in its colour."""
_TALL = 1.3  # a square with its names above and below
_SEEN = 1.02  # of a distance, how much the camera sees from top to bottom
STEP = 1.3  # from one square to the next


@final
@dataclass(frozen=True)
class Plane:
    """The first two axes on the unit square whose lower left corner is (shift, 0)."""

    x: Axis
    y: Axis
    shift: float = 0.0

    def at(self, points: Array, height: float = 0.01) -> Array:
        """Points (…, ≥ 2) in axis units → (…, 3) in the scene."""
        u = (points[..., 0] - self.x.low) / (self.x.high - self.x.low) + self.shift
        v = (points[..., 1] - self.y.low) / (self.y.high - self.y.low)
        return np.stack([u, v, np.full_like(u, height)], axis=-1)

    def frame(self, title: str, *, left: bool = True) -> list[Any]:
        """The outline, its title, and the names and ends of its sides; left: those of y, too."""
        s, x, y = self.shift, self.x, self.y
        corners = np.asarray([[s, 0, 0], [s + 1, 0, 0], [s + 1, 1, 0], [s, 1, 0], [s, 0, 0]])
        marks = [(s + 0.5, -0.01, x.label), (s, -0.01, ends(x)[0]), (s + 1, -0.01, ends(x)[1])]
        if title:
            marks.append((s + 0.6, 1.1, title))
        if left:
            marks += [(s - 0.1, 1.1, y.label), (s - 0.14, 0.05, ends(y)[0]), (s - 0.14, 0.99, ends(y)[1])]
        return [rr.LineStrips3D([corners], colors=[FAINT], radii=0.003), texts(marks)]

    def zero(self) -> list[Any]:
        """The line y = 0, where it is inside."""
        line = self.at(np.array([[self.x.low, 0.0], [self.x.high, 0.0]]), 0.005)
        return [rr.LineStrips3D([line], colors=[FAINT], radii=0.001)] if self.y.low < 0 < self.y.high else []

    def heat(self, values: Array, top: float) -> rr.GridMap:
        """Values (n, n), row = y, from 0 to `top`, as colours; nothing where there is no value (NaN)."""
        level, absent = np.clip(np.nan_to_num(values / top if top > 0 else values), 0, 1), np.isnan(values)
        if absent.any():
            from matplotlib import colormaps

            pixels = colormaps["viridis"](level[::-1], bytes=True)
            pixels[absent[::-1]] = 0
            return self._map(pixels, "RGBA", None)
        return self._map((255 * level[::-1]).astype(np.uint8), "L", rr.components.Colormap.Viridis)

    def scale(self, top: float, unit: str) -> list[Any]:
        """What the colours of `heat` mean: a bar on the right, from 0 to `top`."""
        level = np.repeat(np.arange(255, -1, -1, dtype=np.uint8)[:, None], 10, axis=1)
        kind = rr.components.ImageFormat(width=10, height=256, color_model="L", channel_datatype="U8")
        place, colours = [self.shift + 1.1, 0.0, 0.0], rr.components.Colormap.Viridis
        bar = rr.GridMap(data=level.tobytes(), format=kind, cell_size=1 / 256, translation=place, colormap=colours)
        x = self.shift + 1.2
        return [bar, texts([(x, 1.1, f"{top:.3g} {unit}".removesuffix(" 1").rstrip()), (x, 0.05, "0")])]

    def mask(self, values: Bools, colour: Colour) -> rr.GridMap:
        """The cells (n, n) that are set, in one colour."""
        return self._map(np.where(values[::-1, :, None], np.asarray(colour), 0).astype(np.uint8), "RGBA", None)

    def _map(self, pixels: npt.NDArray[np.uint8], model: Literal["L", "RGBA"], colormap: Any) -> rr.GridMap:
        n = pixels.shape[0]
        kind = rr.components.ImageFormat(width=n, height=n, color_model=model, channel_datatype="U8")
        place = [self.shift, 0.0, 0.0]
        return rr.GridMap(data=pixels.tobytes(), format=kind, cell_size=1.0 / n, translation=place, colormap=colormap)

    def polygon(self, points: Array, colour: Colour, name: str = "") -> rr.LineStrips3D:
        """The outline with these corners (k, 2), and its name in the middle."""
        strip = self.at(np.vstack([points, points[:1]]), 0.02)
        labels = [name] if name else None
        return rr.LineStrips3D([strip], colors=[colour], radii=0.004, labels=labels, show_labels=bool(name))

    def curve(self, x: Array, y: Array, colour: Colour, width: float = 0.003, height: float = 0.02) -> rr.LineStrips3D:
        """y (T,) over x (T,), cut where a number is missing, and at the edges of the square."""
        points = np.column_stack([x, np.where((y < self.y.low) | (y > self.y.high), np.nan, y)])
        breaks = np.flatnonzero(~np.isfinite(points).all(axis=1))
        kept = [part[np.isfinite(part).all(axis=1)] for part in np.split(points, breaks)]
        strips = [self.at(part, height) for part in kept if len(part) > 1]
        return rr.LineStrips3D(strips, colors=[colour] * len(strips), radii=width)

    def ribbon(self, x: Array, low: Array, high: Array, colour: Colour, height: float = 0.01) -> rr.Mesh3D:
        """What lies between low and high (T,) over x (T,), cut off at the edges of the square; nothing where low is above."""
        ends = (np.clip(e, self.y.low, self.y.high) for e in (low, high))
        edge = np.stack([self.at(np.column_stack([x, e]), height) for e in ends], axis=1).reshape(-1, 3)
        first = 2 * np.flatnonzero((low <= high)[1:] & (low <= high)[:-1])[:, None]
        faces = np.concatenate([first + np.array([0, 2, 1]), first + np.array([1, 2, 3])])
        return rr.Mesh3D(vertex_positions=edge, triangle_indices=faces, albedo_factor=colour)


def ends(axis: Axis) -> tuple[str, str]:
    return f"{axis.low:.3g}", f"{axis.high:.3g}"


def texts(marks: list[tuple[float, float, str]]) -> rr.Points3D:
    """Words at places."""
    places, labels = [[x, y, 0.0] for x, y, _ in marks], [text for *_, text in marks]
    return rr.Points3D(places, labels=labels, radii=0.0, colors=[TRUTH] * len(marks), show_labels=True)


@final
@dataclass(frozen=True)
class Seen:
    """`squares` unit squares side by side, with their margins and, where there is a `bar` of colours, that; seen from above."""

    origin: str
    name: str
    squares: int = 1
    bar: bool = False

    def view(self, aspect: float) -> rrb.Spatial3DView:
        """With a camera whose picture is `aspect` times as wide as high."""
        left, right = -0.36, STEP * (self.squares - 1) + (1.4 if self.bar else 1.1)
        middle, height = (left + right) / 2, max(_TALL, (right - left) / aspect) / _SEEN
        eye = rrb.EyeControls3D(position=[middle, 0.51, height], look_target=[middle, 0.51, 0.0], eye_up=[0.0, 1.0, 0.0])
        return rrb.Spatial3DView(
            origin=self.origin, name=self.name, eye_controls=eye, line_grid=False, spatial_information=None
        )


def series(root: str, name: str, low: float, high: float, end: float | None = None) -> rrb.TimeSeriesView:
    """A plot over time with its ranges given, since the viewer's own need some frames to settle."""
    axis, legend = rrb.ScalarAxis(range=(low, high)), rrb.PlotLegend(visible=False)
    span = None
    if end is not None:
        first, last = (rr.TimeRangeBoundary.absolute(seconds=s) for s in (0.0, max(end, 1e-6)))
        span = rrb.TimeAxis(view_range=rr.TimeRange(first, last))
    return rrb.TimeSeriesView(origin=root, name=name, axis_y=axis, axis_x=span, plot_legend=legend)


TIME = "time"
"""Seconds of a motion."""


@final
class Canvas:
    """One recording; views: what is shown, by group and then by name; plays: is there a robot that moves? refuted: is what is
    drawn a band that was refuted?
    """

    def __init__(self, recording: rr.RecordingStream) -> None:
        self.recording, self.plays, self.refuted = recording, False, False
        self.views: dict[str, dict[str, rrb.View | Seen]] = {}

    def show(self, group: str, name: str, one: rrb.View | Seen) -> None:
        """A view of this group; one of that name is replaced."""
        self.views.setdefault(group, {})[name] = one

    def plane(self, root: str, x: Axis, y: Axis, title: str = "") -> Plane:
        """Two axes, with their frame."""
        plane = Plane(x, y)
        self.static(f"{root}/frame", *plane.frame(title))
        return plane

    def static(self, path: str, *what: Any) -> None:
        for one in what:
            self.recording.log(path, one, static=True)

    def text(self, path: str, markdown: str) -> None:
        self.static(path, rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN))

    def columns(self, path: str, t: Array, columns: Any) -> None:
        """Values at times t (T,), s."""
        self.recording.send_columns(path, [rr.TimeColumn(TIME, duration=t)], columns)

    def line(self, path: str, t: Array, values: Array, colour: tuple[int, ...], name: str, width: float = 1.5) -> None:
        """Values (T,) or (T, k) at times t; lines that are not finite everywhere are k entities, as far as they are.

        No NaN is written: it equals nothing, so that no two recordings with one would be the same.
        """
        values = values.reshape(len(values), -1)
        k, known = values.shape[1], np.isfinite(values)
        if not known.all():
            for j in range(k):
                part = known[:, j]
                self.line(path if k == 1 else f"{path}/{j}", t[part], values[part, j], colour, name, width)
            return
        self.static(path, rr.SeriesLines(colors=[colour] * k, names=[name] * k, widths=[width] * k))
        self.columns(path, t, rr.Scalars.columns(scalars=values.ravel()).partition(np.full(len(values), k)))

    def band(self, path: str, t: Array, low: Array, high: Array, colour: tuple[int, ...], name: str, unit: str) -> None:
        """Between low and high (T,) at times t, and their middle."""
        self.static(path, rr.Measurements.from_fields(names=[name], colors=[colour], units=[unit]))
        # The band of a measurement is one standard deviation wide: variance d² draws exactly ± d.
        self.columns(path, t, rr.Measurements.columns(values=(low + high) / 2, variances=((high - low) / 2) ** 2))
