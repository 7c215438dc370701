"""One run as a Rerun recording: what is drawn where, and how it is arranged. Data go by columns, never point by point."""

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
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from gapcert import Band, CompareFigure, DiagnosisFigure, Event, GapFigure, Lane, LoopFigure, Runs, WinningFigure
from gapcert_rerun.diagnosis import draw
from gapcert_rerun.scene import BAD, FAINT, GOOD, ONLY_WITH, STEP, TRUTH, WITH, WITHOUT, Array, Plane, series, view

TIMELINE = "step"
WINDOW = 0.5  # seconds that a viewer which takes data may need to find out that it gets no window
PATIENCE = 10.0  # seconds for a viewer to appear, and for it to take the last data
READING = """
## How to read the pictures
- Maps: true gap beside γ on the same colours (dark: none); dots: sampled points.
- Bands: white is f̂ − f, the thin blue band its certified [l, u], the wide one ±γ, grey the best constant bound.
- Controllers: blue with γ (where both may start, too), orange without, green where only γ wins, red limits and
  violations; thin grey: what f alone would have done. Green boxes and lines: where the controller foresaw that it would be.
- Parameters that are learned: between the blue lines as one run knows them, between the grey ones as all runs do.
- Simulator against simulator: where one step differs, on colours from none to the most.
- Measured data: white; simulation before (orange) and after (blue) the named causes, and their errors.
- Laws: white points are what the data ask for in each interval, no law assumed; blue is the law that was named.
- Residuals: the error of fitted windows over time, and its correlation with itself and with an input; grey is chance.
- All plots run over `step`; what one step is, the title or the name of the line says.
"""
FOUND = ("holds", "done", "claimed", "causes", "nothing", "agree", "explained")
COLOURS = {"running": FAINT, "ambiguous": WITHOUT} | dict.fromkeys(FOUND, GOOD)


@final
class Stream:
    """Writes a run to `rerun` (a path), and to a viewer on this machine if `view` is set."""

    def __init__(self, data: Mapping[str, Any]) -> None:
        self.recording = rr.RecordingStream("gapcert")
        self.views: dict[str, rrb.View | rrb.Container] = {}
        self._logged: dict[str, int] = {}
        self._file = Path(data["rerun"]).name if data.get("rerun") else None
        self._viewer = open_viewer() if data.get("view") else None
        sinks: list[rr.FileSink | rr.GrpcSink] = []
        if self._file:
            sinks.append(rr.FileSink(str(data["rerun"])))
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
            self.recording.set_time(TIMELINE, sequence=event.data.get("number", 0))
            self.recording.log("log", rr.TextLog(str(event.data.get("message", "")), level=rr.TextLogLevel.WARN))
        if "markdown" in event.data:
            document = rr.TextDocument(event.data["markdown"] + READING, media_type=rr.MediaType.MARKDOWN)
            self.static("answer", document)
            self.views["answer"] = rrb.TextDocumentView(origin="answer", name="Answer")
        match event.data.get("figure"):
            case GapFigure() as gap:
                self._gap(gap)
            case WinningFigure() as winning:
                self._winning(winning)
            case LoopFigure() as loop:
                self._loop(loop)
            case DiagnosisFigure() as diagnosis:
                draw(self, diagnosis)
            case CompareFigure() as comparison:
                self._comparison(comparison)
        if event.name == "run-finished":
            self._properties(event.data["summary"])
        if event.name in ("stage-finished", "run-finished"):
            self.recording.send_blueprint(self.blueprint())

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
        if viewer and lost:
            self._no_viewer("it was closed or has stopped taking data")

    def _no_viewer(self, reason: str) -> None:
        kept = f"; the recording is in {self._file}" if self._file else ""
        warnings.warn(f"no live viewer ({reason}){kept}", RuntimeWarning, stacklevel=3)

    def static(self, path: str, *what: Any) -> None:
        for one in what:
            self.recording.log(path, one, static=True)

    def line(self, path: str, values: Array, colour: tuple[int, ...], name: str, width: float = 1.5) -> None:
        """Values (T,) or (T, k) over the steps 0 … T − 1."""
        values = values.reshape(len(values), -1)
        k = values.shape[1]
        self.static(path, rr.SeriesLines(colors=[colour] * k, names=[name] * k, widths=[width] * k))
        index = rr.TimeColumn(TIMELINE, sequence=np.arange(len(values)))
        columns = rr.Scalars.columns(scalars=values.ravel())
        self.recording.send_columns(path, [index], columns.partition(np.full(len(values), k)))

    def _lanes(self, lanes: Sequence[Lane]) -> None:
        """Log the states that are new since the last event."""
        for lane in lanes:
            path, old = f"verdict/{lane.stage}", self._logged.get(lane.stage, 0)
            if len(lane.states) == old:
                continue
            states = list(dict.fromkeys(lane.states))
            self.static(path, rr.StateConfiguration(values=states, colors=[COLOURS.get(s, BAD) for s in states]))
            index = rr.TimeColumn(TIMELINE, sequence=lane.at[old:])
            self.recording.send_columns(path, [index], rr.StateChange.columns(state=lane.states[old:]))
            self._logged[lane.stage] = len(lane.states)
            self.views["verdict"] = rrb.StateTimelineView(origin="verdict", name="Stages and verdicts")

    def _gap(self, gap: GapFigure) -> None:
        """Per state: true gap beside γ as maps, and the residual in its band along the axis where it varies most."""
        for s in gap.slices:
            root, top = f"gap/{s.state}", float(np.nanmax([s.gamma, s.gap]))
            left, right = Plane(gap.axes[0], gap.axes[1]), Plane(gap.axes[0], gap.axes[1], STEP)
            self.static(f"{root}/true", left.heat(s.gap, top))
            self.static(f"{root}/true/frame", *left.frame(f"true gap, up to {top:.3g} {s.unit}"))
            self.static(f"{root}/gamma", right.heat(s.gamma, top))
            self.static(f"{root}/gamma/frame", *right.frame("certified γ"))
            points = rr.Points3D(right.at(gap.samples), radii=0.006, colors=[(255, 255, 255, 255)])
            self.static(f"{root}/gamma/samples", points)
            held = f" at {gap.fixed}" if gap.fixed else ""
            self.views[root] = view(root, f"How wrong: {s.state}{held}", 2)
        for state in dict.fromkeys(b.state for b in gap.bands):
            bands = [b for b in gap.bands if b.state == state]
            most = max(bands, key=lambda b: float(np.ptp(b.residual)))
            for b in bands:
                self._band(f"band/{state}/{b.axis.name}", b)
            root, reach = f"band/{state}/{most.axis.name}", 1.15 * max(most.constant, float(most.gamma.max()))
            self.views[root] = series(root, f"Gap of {state} along {most.axis.name} [{most.unit}]", -reach, reach)

    def _band(self, path: str, b: Band) -> None:
        index = rr.TimeColumn(TIMELINE, sequence=np.arange(len(b.at)))
        middle, half = (b.low + b.high) / 2, (b.high - b.low) / 2
        for name, value, reach in (("gamma", np.zeros_like(b.at), b.gamma), ("envelope", middle, half)):
            label = "±γ" if name == "gamma" else "[l, u]"
            self.static(f"{path}/{name}", rr.Measurements.from_fields(names=[label], colors=[WITH], units=[b.unit]))
            # The band of a measurement is one standard deviation wide: variance γ² draws exactly ±γ.
            columns = rr.Measurements.columns(values=value, variances=reach**2)
            self.recording.send_columns(f"{path}/{name}", [index], columns)
        ends = f"step 0 … {len(b.at) - 1} is {b.axis.low:g} … {b.axis.high:g} {b.axis.unit}"
        self.line(f"{path}/residual", b.residual, TRUTH, f"f̂ − f; {ends}", 2.0)
        self.line(f"{path}/constant", b.constant * np.array([[-1.0, 1.0]] * len(b.at)), FAINT, "constant bound", 1.0)

    def _winning(self, w: WinningFigure) -> None:
        plane = Plane(w.axes[0], w.axes[1])
        a, b = w.with_gamma > 0, w.without_gamma > 0
        masks = (("both", a & b, WITH), ("only_with_gamma", a & ~b, ONLY_WITH), ("only_without_gamma", b & ~a, WITHOUT))
        for name, mask, colour in masks:
            # Darker than the runs that lie upon it.
            red, green, blue = (c * 2 // 5 for c in colour[:3])
            self.static(f"winning/{name}", plane.mask(mask, (red, green, blue, 255)))
        self.static("winning/frame", *plane.frame(f"wins {w.labels[0]} {a.mean():.1%}, {w.labels[1]} {b.mean():.1%}"))
        held, roots = f" at {w.fixed}" if w.fixed else "", {"winning": "Where the controller may start"}
        if w.values.size:
            roots["promise"], top = "How long it takes", float(np.nanmax(w.values))
            self.static("promise/steps", plane.heat(w.values, top))
            self.static("promise/frame", *plane.frame(f"steps {w.labels[0]}, up to {top:g}"))
        for root, title in roots.items():
            for k, o in enumerate(o for o in w.outlines if o.cut):
                colour = FAINT if o.dotted else _ROLES[o.role]
                self.static(f"{root}/goal/{o.role}/{k}", plane.polygon(o.points, colour, o.name))
            self.views[f"winning/{root}"] = view(root, f"{title}{held}")

    def _loop(self, loop: LoopFigure) -> None:
        for runs in loop.runs:
            name, colour = ("with_gamma", WITH) if runs.gamma else ("without_gamma", WITHOUT)
            self._runs(loop, runs, name, colour)
        for m, told in enumerate(loop.foreseen):
            self._foreseen(loop, told, m)
        for one in loop.learned:
            root, whole = f"learned/{one.name}", one.hull[0]
            self.line(f"{root}/all", one.hull, FAINT, "known to all runs", 1.0)
            self.line(f"{root}/run", one.run, WITH, "known to one run", 2.0)
            self.line(f"{root}/stated", np.full(len(one.run), one.stated), TRUTH, "the model of γ", 1.0)
            pad = 0.1 * float(np.ptp(whole))
            low, high = float(whole.min()) - pad, float(whole.max()) + pad
            self.views[root] = series(root, f"What is learned of {one.name} [{one.unit}], step {loop.period:g} s", low, high)
        last = max(r.steps for r in loop.runs)
        for i, axis in enumerate(loop.axes):
            root, (low, high) = f"loop/{axis.name}", loop.stay[i]
            for name, limit in (("low", low), ("high", high)):
                self.line(f"{root}/{name}", np.full(last + 1, limit), BAD, "limit", 1.0)
            pad = 0.15 * (high - low)
            self.views[root] = series(root, f"{axis.name} [{axis.unit}], step {loop.period:g} s", low - pad, high + pad)
        top = 1.08 * max(r.starts for r in loop.runs)
        self.views["alive"] = series("alive", f"Runs unbroken, step {loop.period:g} s", 0.0, top)

    def _runs(self, loop: LoopFigure, runs: Runs, name: str, colour: tuple[int, int, int, int]) -> None:
        label = name.replace("_gamma", " γ")
        for i, axis in enumerate(loop.axes):
            self.line(f"loop/{axis.name}/{name}", runs.traces[:, :, i].T, colour, f"f̂, {label}")
            predicted = runs.predicted[:1, :, i].T
            self.line(f"loop/{axis.name}/{name}_predicted", predicted, FAINT, f"f alone, {label}", 1.0)
        broke = np.where(runs.broke < 0, runs.steps + 1, runs.broke)
        alive = (broke[None] > np.arange(runs.steps + 1)[:, None]).sum(axis=1).astype(np.float64)
        self.line(f"alive/{name}", alive, colour, label, 3.0)
        if len(loop.axes) < 2:
            return
        plane = Plane(loop.axes[0], loop.axes[1])
        height, radius = (0.035, 0.002) if runs.gamma else (0.03, 0.004)
        strips = [plane.at(piece, height) for t in runs.traces for piece in loop.pieces(t)]
        self.static(f"winning/runs/{name}", rr.LineStrips3D(strips, colors=[colour] * len(strips), radii=radius))
        ended = [plane.at(t[int(e)], 0.04) for t, e in zip(runs.traces, runs.ended, strict=True) if e >= 0]
        if ended:
            self.static(f"winning/runs/{name}/violations", rr.Points3D(ended, colors=[BAD], radii=0.012))

    def _foreseen(self, loop: LoopFigure, told: Any, number: int) -> None:
        """Where the controller with γ said that the first run would be: its ends over time, and boxes over two states."""
        for i, axis in enumerate(loop.axes):
            ends = np.full((told.step + len(told.low), 2), np.nan)
            ends[told.step :] = np.stack([told.low[:, i], told.high[:, i]], axis=1)
            self.line(f"loop/{axis.name}/foreseen{number}", ends, ONLY_WITH, f"foreseen at step {told.step}", 1.0)
        if len(loop.axes) < 2:
            return
        plane, ends = Plane(loop.axes[0], loop.axes[1]), np.stack([told.low, told.high])[:, :, :2]
        sides = ((0, 0), (1, 0), (1, 1), (0, 1), (0, 0))
        boxes = [plane.at(np.array([[box[a, 0], box[b, 1]] for a, b in sides]), 0.038) for box in ends.transpose(1, 0, 2)]
        strips = rr.LineStrips3D(boxes, colors=[ONLY_WITH] * len(boxes), radii=0.0015)
        self.static(f"winning/runs/foreseen{number}", strips)

    def _comparison(self, comparison: CompareFigure) -> None:
        """Per pair that differs where it does, and how common runs of all pairs come apart."""
        for p in comparison.pairs:
            name = f"{p.a} against {p.b}"
            if p.values.size:
                root, top = f"pair/{p.a}-{p.b}", float(np.nanmax(p.values))
                plane = Plane(p.axes[0], p.axes[1])
                self.static(f"{root}/map", plane.heat(p.values, top))
                self.static(f"{root}/frame", *plane.frame(f"{p.state}, up to {top:.3g} {p.unit}"))
                self.views[root] = view(root, f"{name}, {p.fixed}")
            if p.drift.size:
                # On a linear axis only the order of magnitude shows them all.
                level = np.log10(np.maximum(p.drift, 1e-18))
                self.line(f"drift/{p.a}-{p.b}", level, WITHOUT if p.values.size else GOOD, name)
        title = f"How runs come apart: log10 of the difference in steps' motion, step {comparison.period:g} s"
        self.views["drift"] = series("drift", title, -18.5, 3.0)

    def _properties(self, summary: Mapping[str, Any]) -> None:
        """The certificate as properties of the recording, so that files can be searched and compared by them."""
        flat: dict[str, Any] = {"summary": json.dumps(summary, sort_keys=True, default=str)}
        flat |= {k: str(summary[k]) for k in ("name", "verdict", "reason") if summary.get(k)}
        certificate = summary.get("certificate", {})
        flat |= {f"claim_{k}": v for k, v in certificate.get("claim", {}).items()}
        for state, values in certificate.get("states", {}).items():
            flat |= {f"{state}_{k}": v for k, v in values.items()}
        self.recording.send_property("gapcert", rr.AnyValues(**flat))

    def blueprint(self) -> rrb.Blueprint:
        """Text and lanes on the left; pictures of the model's error above, of what it costs a controller below."""
        groups: dict[str, list[Any]] = {}
        for key, one in self.views.items():
            groups.setdefault(key.split("/")[0], []).append(one)
        left = rrb.Vertical(*groups.get("answer", []), *groups.get("verdict", []), row_shares=[3, 1][: _count(groups)])
        rows = [row for names in _ROWS if (row := [v for name in names for v in _tabbed(groups, name)])]
        # One row is as high as the window, and two maps side by side are wider than their half of it.
        flat = len(rows) == 1 and isinstance(rows[0][0], rrb.Tabs)
        right = rrb.Vertical(*(rows[0] if flat else [rrb.Horizontal(*row) for row in rows]))
        body = rrb.Horizontal(left, right, column_shares=[1, 3])
        time_panel = rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="paused")
        return rrb.Blueprint(body, time_panel, rrb.SelectionPanel(state="hidden"), rrb.BlueprintPanel(state="hidden"))


_ROLES = {"stay": TRUTH, "target": GOOD, "avoid": BAD, "region": GOOD}
_ROWS = (
    ("gap", "band", "diagnosis", "error", "pair"),
    ("winning", "loop", "learned", "alive", "drift", "law", "explained"),
    ("left", "experiment"),
)


def _count(groups: Mapping[str, list[Any]]) -> int:
    return sum(name in groups for name in ("answer", "verdict"))


def _tabbed(groups: Mapping[str, list[Any]], name: str) -> list[Any]:
    """The views of a group: stacked while they are few, else in tabs, as maps of one plane are."""
    views = groups.get(name, [])
    if name == "winning" and len(views) > 1:
        return [rrb.Tabs(*views)]
    if len(views) < 2:
        return views
    return [rrb.Vertical(*views)] if len(views) == 2 else [rrb.Tabs(*views)]


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
