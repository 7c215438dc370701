"""One run as a Rerun recording: where it goes, and which figure is drawn by what. Data go by columns, never point by point."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
import weakref
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import rerun as rr
import rerun.blueprint as rrb

from gapcert import Event
from gapcert_figures import CompareFigure, DiagnosisFigure, GapFigure, Lane, LoopFigure, RecordedFigure, WinningFigure

from .canvas import BAD, FAINT, GOOD, WITHOUT, Canvas
from .control import draw_loop, draw_winning
from .diagnosis import draw_diagnosis
from .gap import draw_comparison, draw_gap, draw_recorded
from .layout import blueprint, reading

WINDOW = 0.5  # seconds that a viewer which takes data may need to find out that it gets no window
PATIENCE = 10.0  # seconds for a viewer to appear, and for it to take the last data
EVENT = "event"
"""The timeline of what a run has told so far, by number."""
FOUND = ("holds", "done", "claimed", "causes", "nothing", "agree", "explained")
DRAWN: Mapping[type, Callable[[Canvas, Any], None]] = {
    GapFigure: draw_gap,
    RecordedFigure: draw_recorded,
    WinningFigure: draw_winning,
    LoopFigure: draw_loop,
    DiagnosisFigure: draw_diagnosis,
    CompareFigure: draw_comparison,
}
COLOURS = {"running": FAINT, "ambiguous": WITHOUT, "unknown": WITHOUT} | dict.fromkeys(FOUND, GOOD)


@final
class Stream:
    """Writes a run to `rerun` (a path), and to a viewer on this machine if `view` is set.

    A recording of before is replaced when the run has finished: one that is refused, or breaks off, leaves it as it was.
    """

    def __init__(self, data: Mapping[str, Any]) -> None:
        # A viewer keeps one arrangement per application: runs that have different views need one each.
        # What an event brings is written when it is over, never by the clock: the same run gives the same chunks.
        name = Path(data.get("folder") or data.get("name", "run")).name
        self.recording = rr.RecordingStream(f"gapcert {name}", batcher_config=rr.ChunkBatcherConfig.NEVER())
        self.canvas = Canvas(self.recording)
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
        if (draw := DRAWN.get(type(figure := event.data.get("figure")))) is not None:
            self.canvas.refuted = event.data.get("refuted", False)
            draw(self.canvas, figure)
        if "markdown" in event.data:
            # What the pictures mean follows the answer: a panel shows as much of it as there is room for.
            self.canvas.text("answer", event.data["markdown"] + reading(self.canvas.views))
            self.canvas.show("answer", "answer", rrb.TextDocumentView(origin="answer", name="Answer"))
        over, shown = event.name == "run-finished", {(g, name) for g, views in self.canvas.views.items() for name in views}
        if over:
            self._properties(event.data["summary"])
            self._over = True
        if over or shown != self._shown:
            self._shown = shown
            self.recording.send_blueprint(blueprint(self.canvas, over=over))
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
            # One that is gone has not always been missed by the stream yet.
            lost = lost or not late.is_alive() or (viewer is not None and viewer.process.poll() is not None)
            late.cancel()
            if self._over and self._aside and self._file:
                self._aside.replace(self._file)
            self._unmade()
        if viewer and lost:
            self._no_viewer("it was closed or has stopped taking data")

    def _no_viewer(self, reason: str) -> None:
        kept = f"; the recording is in {self._file.name}" if self._file else ""
        warnings.warn(f"no live viewer ({reason}){kept}", RuntimeWarning, stacklevel=3)

    # What a run tells

    def _lanes(self, lanes: Sequence[Lane]) -> None:
        """Log the states that are new since the last event."""
        for lane in lanes:
            path, old = f"stages/{lane.stage}", self._logged.get(lane.stage, 0)
            if len(lane.states) == old:
                continue
            states = list(dict.fromkeys(lane.states))
            self.canvas.static(path, rr.StateConfiguration(values=states, colors=[COLOURS.get(s, BAD) for s in states]))
            index = rr.TimeColumn(EVENT, sequence=lane.at[old:])
            self.recording.send_columns(path, [index], rr.StateChange.columns(state=lane.states[old:]))
            self._logged[lane.stage] = len(lane.states)
            self.canvas.show("stages", "stages", rrb.StateTimelineView(origin="stages", name="Stages of the run"))

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


@final
@dataclass(frozen=True)
class Viewer:
    """A native viewer of ours, and where it takes data."""

    process: subprocess.Popen[bytes]
    url: str

    def end(self) -> None:
        # The command is a shim: its child must go too.
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)


def open_viewer() -> Viewer | str:
    """Start the native viewer on a free loopback port; or why it does not come up."""
    if sys.platform == "linux" and not any(os.environ.get(d) for d in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")):
        return "there is no display"
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", "--port", str(port), "--hide-welcome-screen"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    viewer, end = Viewer(process, f"rerun+http://127.0.0.1:{port}/proxy"), time.monotonic() + PATIENCE
    while not _listens(port) and process.poll() is None:
        if time.monotonic() > end:
            viewer.end()
            return f"it did not start within {PATIENCE:g} s"
        time.sleep(0.1)
    # It takes data before it has a window, and goes away again where it gets none.
    with suppress(subprocess.TimeoutExpired):
        process.wait(WINDOW)
        return "it did not start; is there a display?"
    return viewer


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(0.2)
        return probe.connect_ex(("127.0.0.1", port)) == 0
