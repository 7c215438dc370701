"""Every kind of run, opened in a headless native viewer: its blueprint shows what there is, and nothing in it is broken."""

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from functools import partial
from io import BytesIO

import numpy as np
import pytest
from outside import watched

import gapcert as gc
import gapcert_figures
from gapcert_closed_loop.prediction import Ahead, Foreseen, Learned
from gapcert_figures.data import Axis, CompareFigure, Figures, LoopFigure, PairFigure, RecordedFigure, Runs, Stretch
from gapcert_figures.playback import Motion, Playback
from gapcert_figures.region_outlines import Outline

CLI = [sys.executable, "-m", "rerun"]


pytestmark = [pytest.mark.exam, pytest.mark.needs("rerun"), pytest.mark.outside("vulkan")]


def end(process):
    """The command is a shim: its child must go too, whatever it does meanwhile."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


@pytest.fixture(scope="module")
def process():
    """A headless native viewer on loopback, which listens to the last of its arguments."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [*CLI, "--headless", "--window-size", "1600x1000", "--bind", "127.0.0.1", "--port", str(port)]
    started = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        yield started
    finally:
        end(started)
        started.wait()


@pytest.fixture(scope="module")
def viewer(process):
    """Who talks to the viewer, once it is up."""
    from rerun.experimental import ViewerClient

    with watched(partial(end, process)):
        for _ in range(300):
            assert process.poll() is None, "the viewer has ended"
            try:
                client = ViewerClient.connect(f"rerun+http://127.0.0.1:{process.args[-1]}/proxy")
                client.get_state()
                return client
            except ConnectionError:  # it is not up yet
                time.sleep(0.2)
    pytest.fail("the viewer did not come up within a minute")


@pytest.fixture(autouse=True)
def in_time(process):
    with watched(partial(end, process)):
        yield


def opened(viewer, path):
    """The state of the viewer with this recording on screen, drawn."""
    (store,) = viewer.open(str(path)).store_ids
    for _ in range(600):
        state = viewer.get_state()
        if state.active_recording == store and state.views and not state.loading:
            break
        time.sleep(0.1)
    else:
        pytest.fail(f"{path} is not on screen after a minute")
    time.sleep(1.0)
    return viewer.get_state()


def states_axes():
    return Axis("x", "m", 0, 1), Axis("v", "m/s", -2, 2)


def motions(*names):
    t, poses = np.linspace(0, 1, 9), np.zeros((9, 1, 7))
    poses[:, 0, 0], poses[:, 0, 3] = t, 1.0
    shapes = (gc.plugin.Shape(0, "box", np.array([0.1, 0.1, 0.1])), gc.plugin.Shape(0, "capsule", np.array([0.05, 0.4])))
    return Playback(("body",), shapes, tuple(Motion(n, t, poses, 0.5 if n == "without γ" else -1.0) for n in names))


def foreseeing():
    """Runs with tubes, something to follow, something that is learned, and a robot."""
    steps, t = 8, np.linspace(0, 1, 9)
    x = np.stack([0.2 + 0.5 * t, 0.5 - t], axis=1)[None]
    runs = tuple(
        Runs(g, "first", 1, steps, np.array([-1 if g else 4]), x, np.array([-1 if g else 4]), x) for g in (False, True)
    )
    tube = Foreseen(2, x[0, 2:6], x[0, 2:6] - 0.1, x[0, 2:6] + 0.1)
    ahead = Ahead(np.zeros((steps, 2)), np.full((steps, 2), -0.1), np.full((steps, 2), 0.1), np.ones(steps, dtype=bool))
    known = Learned("m", "kg", np.tile([0.9, 1.1], (9, 1)), np.tile([0.8, 1.2], (9, 1)), 1.0)
    ends = np.array([[0.0, 1.0], [-2.0, 2.0]])
    played = motions("without γ", "with γ")
    return LoopFigure(states_axes(), 0.1, ends, runs, None, (tube,), (known,), ahead, x[0] + 0.05, played)


def winning():
    corners = np.array([[0.0, -2], [1, -2], [1, 2], [0, 2]])
    outlines = (Outline("stay", "", "everywhere", corners), Outline("target", "", "section", corners * 0.5))
    grid = np.triu(np.ones((16, 16)))
    steps = np.where(grid > 0, np.arange(256.0).reshape(16, 16), np.nan)
    return gapcert_figures.WinningFigure(states_axes(), "", "reach_avoid", grid, np.ones((16, 16)), steps, outlines)


def recorded():
    t = np.linspace(0, 0.5, 20)
    stretches = tuple(Stretch(n, u, t, np.sin(9 * t), -1.1 + 0 * t, 1.1 + 0 * t) for n, u in (("z", "m"), ("vz", "m/s")))
    return RecordedFigure(np.linspace(-1, 2, 50), 48, 0.0, stretches)


def compared():
    drift = np.array([1e-9, 1e-3, 1e-2])
    apart = PairFigure("one", "two", "x", "m", states_axes(), "u = 0 N", np.arange(256.0).reshape(16, 16), drift)
    same = PairFigure("one", "three", "x", "m", (), "", np.empty((0, 0)), drift * 1e-12)
    return CompareFigure(0.01, (apart, same))


KINDS = {
    "mpc": (
        [("controller", winning()), ("closed_loop", foreseeing())],
        {"winning", "promise", "loop", "tube", "learned", "robot"},
    ),
    "recording": ([("certificate", recorded())], {"scores", "stretch"}),
    "declared": ([("controller", winning())], {"winning", "promise", "stages"}),
    "compare": ([("pairs", compared())], {"pair", "drift"}),
    "unknown": ([], {"stages"}),
}


def written(path, name, figures, verdict="holds"):
    """A recording of a run that drew these figures."""
    from gapcert_figures.data import Lane
    from gapcert_rerun.stream import Stream

    stream, lanes = Stream({"rerun": str(path), "name": name}), (Lane("run", (1, 9), ("running", verdict)),)
    for stage, figure in figures:
        stream.receive(gc.Event("stage-finished", stage, {"figure": figure, "lanes": lanes}))
    summary = {"name": name, "verdict": verdict, "reason": "the solver stopped"}
    data = {"summary": summary, "markdown": f"# {name}: {verdict}\n", "lanes": lanes}
    stream.receive(gc.Event("run-finished", "run", data))
    stream.close()
    return path


def origins(state):
    return {v.origin.strip("/").split("/")[0] for v in state.views}


@pytest.mark.parametrize("kind", KINDS)
def test_a_kind_of_run_opens_and_nothing_is_broken(kind, viewer, tmp_path):
    figures, expected = KINDS[kind]
    state = opened(viewer, written(tmp_path / "run.rrd", kind, figures, "unknown" if kind == "unknown" else "holds"))
    assert [(v.name, v.reports) for v in state.views if v.reports] == []
    assert origins(state) >= expected | {"answer"}
    # Where something moves, the timeline has seconds; the lanes of the stages would be empty on it.
    timed = kind in ("mpc", "recording", "compare")
    active = next(r for r in state.recordings if r.store_id == state.active_recording)
    assert active.current_timeline == ("time" if timed else "event")
    assert ("stages" in origins(state)) is not timed


def test_a_diagnosis_opens_and_nothing_is_broken(viewer, tmp_path, every_picture):
    figure = replace(every_picture, playback=motions("measured", "before", "after"))
    state = opened(viewer, written(tmp_path / "run.rrd", "why", [("diagnosis", figure)], "causes"))
    assert [(v.name, v.reports) for v in state.views if v.reports] == []
    assert origins(state) >= {"answer", "diagnosis", "error", "law", "explained", "left", "experiment", "robot"}
    assert sum(v.origin == "/robot" for v in state.views) == 2


def test_a_certificate_and_its_loop_open_and_nothing_is_broken(viewer, small_run):
    from PIL import Image

    state = opened(viewer, small_run.folder / "run.rrd")
    assert [(v.name, v.reports) for v in state.views if v.reports] == []
    assert {"3D", "TimeSeries", "TextDocument"} <= {v.view_class for v in state.views}
    assert origins(state) == {"answer", "gap", "band", "winning", "loop", "alive"}
    maps = next(v for v in state.views if v.origin == "/gap/theta")
    picture = np.asarray(Image.open(BytesIO(viewer.take_screenshot(maps.view_id, max_size=600))).convert("RGB"))
    # Viridis from dark violet to yellow, and the black ground: a picture that failed has a handful of colours.
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 200
    assert Figures.load(small_run.folder).loop.playback is None
