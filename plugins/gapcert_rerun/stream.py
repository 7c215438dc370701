"""One run as a Rerun recording: where it goes, and which figure is drawn by what. Data go by columns, never point by point."""

from __future__ import annotations

import json
import threading
import warnings
import weakref
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from gapcert import Array, Event
from gapcert_figures import CompareFigure, DiagnosisFigure, GapFigure, Lane, LoopFigure, RecordedFigure, WinningFigure

from .comparison import draw_comparison
from .control import draw_loop, draw_winning
from .diagnosis import draw_diagnosis
from .gap import draw_gap, draw_recorded
from .layout import blueprint, reading
from .plane import BAD, FAINT, GOOD, WITHOUT, Seen
from .viewer import PATIENCE, Viewer, open_viewer

TIME, EVENT = "time", "event"
"""Timelines: seconds of a motion, and the number of what a run has told so far."""
FOUND = ("holds", "done", "claimed", "causes", "nothing", "agree", "explained")
COLOURS = {"running": FAINT, "ambiguous": WITHOUT, "unknown": WITHOUT} | dict.fromkeys(FOUND, GOOD)


@final
class Stream:
    """Writes a run to `rerun` (a path), and to a viewer on this machine if `view` is set.

    A recording of before is replaced when the run has finished: one that is refused, or breaks off, leaves it as it was.

    views: what is shown, by group and then by name; plays: is there a robot that moves?
    """

    def __init__(self, data: Mapping[str, Any]) -> None:
        # A viewer keeps one arrangement per application: runs that have different views need one each.
        # What an event brings is written when it is over, never by the clock: the same run gives the same chunks.
        name = Path(data.get("folder") or data.get("name", "run")).name
        self.recording = rr.RecordingStream(f"gapcert {name}", batcher_config=rr.ChunkBatcherConfig.NEVER())
        self.views: dict[str, dict[str, rrb.View | Seen]] = {}
        self.plays = False
        self._over = False
        self._logged: dict[str, int] = {}
        self._shown: set[tuple[str, str]] = set()
        self._file = Path(data["rerun"]) if data.get("rerun") else None
        self._aside = self._file.with_name(f"{self._file.name}.new") if self._file and self._file.exists() else None
        self._unmade = weakref.finalize(self, _removed, self._aside)
        self._viewer = open_viewer() if data.get("view") else None
        sinks: list[rr.FileSink | rr.GrpcSink] = []
        if self._file:
            sinks.append(rr.FileSink(str(self._aside or self._file)))
        if isinstance(self._viewer, Viewer):
            sinks.append(rr.GrpcSink(self._viewer.url))
        elif self._viewer is not None:
            self._no_viewer(self._viewer)
        if sinks:
            self.recording.set_sinks(*sinks)
        self.recording.send_recording_name(str(data.get("name", "run")))

    def receive(self, event: Event) -> None:
        """Draw what an event brings."""
        self._lanes(event.data.get("lanes", ()))
        if event.name == "warning":
            self.recording.set_time(EVENT, sequence=event.data.get("number", 0))
            self.recording.log("log", rr.TextLog(str(event.data.get("message", "")), level=rr.TextLogLevel.WARN))
            self.recording.reset_time()
        match event.data.get("figure"):
            case GapFigure() as gap:
                draw_gap(self, gap)
            case RecordedFigure() as recorded:
                draw_recorded(self, recorded)
            case WinningFigure() as winning:
                draw_winning(self, winning)
            case LoopFigure() as loop:
                draw_loop(self, loop)
            case DiagnosisFigure() as diagnosis:
                draw_diagnosis(self, diagnosis)
            case CompareFigure() as comparison:
                draw_comparison(self, comparison)
        if "markdown" in event.data:
            # What the pictures mean follows the answer: a panel shows as much of it as there is room for.
            self.text("answer", event.data["markdown"] + reading(self.views))
            self.show("answer", "answer", rrb.TextDocumentView(origin="answer", name="Answer"))
        over, shown = event.name == "run-finished", {(g, name) for g, views in self.views.items() for name in views}
        if over:
            self._properties(event.data["summary"])
            self._over = True
        if over or shown != self._shown:
            self._shown = shown
            self.recording.send_blueprint(blueprint(self, over=over))
        self.recording.flush(timeout_sec=0)

    def close(self) -> None:
        """Write what is left. A viewer that hangs is ended, since the stream would wait for it for ever."""
        viewer = self._viewer if isinstance(self._viewer, Viewer) else None
        late = threading.Timer(2 * PATIENCE, viewer.end if viewer else lambda: None)
        late.start()
        lost = False
        try:
            self.recording.flush(timeout_sec=PATIENCE)
        except RuntimeError as error:
            if viewer is None or "gRPC" not in str(error):
                raise
            lost = True
        finally:
            self.recording.disconnect()
            lost = lost or not late.is_alive()
            late.cancel()
            if self._over and self._aside and self._file:
                self._aside.replace(self._file)
            self._unmade()
        if viewer and lost:
            self._no_viewer("it was closed or has stopped taking data")

    def _no_viewer(self, reason: str) -> None:
        kept = f"; the recording is in {self._file.name}" if self._file else ""
        warnings.warn(f"no live viewer ({reason}){kept}", RuntimeWarning, stacklevel=3)

    # What is drawn with

    def show(self, group: str, name: str, one: rrb.View | Seen) -> None:
        """A view of this group; one of that name is replaced."""
        self.views.setdefault(group, {})[name] = one

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

    # What a run tells

    def _lanes(self, lanes: Sequence[Lane]) -> None:
        """Log the states that are new since the last event."""
        for lane in lanes:
            path, old = f"stages/{lane.stage}", self._logged.get(lane.stage, 0)
            if len(lane.states) == old:
                continue
            states = list(dict.fromkeys(lane.states))
            self.static(path, rr.StateConfiguration(values=states, colors=[COLOURS.get(s, BAD) for s in states]))
            index = rr.TimeColumn(EVENT, sequence=lane.at[old:])
            self.recording.send_columns(path, [index], rr.StateChange.columns(state=lane.states[old:]))
            self._logged[lane.stage] = len(lane.states)
            self.show("stages", "stages", rrb.StateTimelineView(origin="stages", name="Stages of the run"))

    def _properties(self, summary: Mapping[str, Any]) -> None:
        """The certificate as properties of the recording, so that files can be searched and compared by them."""
        # Where and how fast it ran is none of what it found: the same run gives the same recording.
        found = {k: v for k, v in summary.items() if k not in ("run_dir", "timings")}
        flat: dict[str, Any] = {"summary": json.dumps(found, sort_keys=True, default=str)}
        flat |= {k: str(summary[k]) for k in ("name", "verdict", "reason") if summary.get(k)}
        certificate = summary.get("certificate", {})
        flat |= {f"claim_{k}": v for k, v in certificate.get("claim", {}).items()}
        for state, values in certificate.get("states", {}).items():
            flat |= {f"{state}_{k}": v for k, v in values.items()}
        self.recording.send_property("gapcert", rr.AnyValues(**flat))


def _removed(path: Path | None) -> None:
    if path is not None:
        path.unlink(missing_ok=True)
