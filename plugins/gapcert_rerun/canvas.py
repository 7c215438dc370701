"""What is drawn with: values over time, static shapes and text of a recording, and the views that show them."""

from __future__ import annotations

from typing import Any, final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from gapcert import Array
from gapcert_figures import Axis

from .plane import Plane, Seen

TIME = "time"
"""Seconds of a motion."""


@final
class Canvas:
    """One recording; views: what is shown, by group and then by name; plays: is there a robot that moves?"""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self.recording, self.plays = recording, False
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
