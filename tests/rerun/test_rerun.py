"""The observer `rerun`: a run as a recording that reads back, opens well arranged, and never stops a run."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

import gapcert as gc
import gapcert_figures
from gapcert_figures.data import Figures
from gapcert_figures.diagnosis import Correlation, Course, Law, Signal, Waterfall
from gapcert_rerun import plugin

pytestmark = pytest.mark.needs("rerun")

CLI = [sys.executable, "-m", "rerun"]


@pytest.fixture(autouse=True)
def strict():
    """Errors in logging are errors."""
    import rerun as rr

    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


def chunks(path):
    from rerun.chunk import RrdReader

    return list(RrdReader(str(path)).stream())


def column(path, entity, name):
    """The values of one component of one entity, in time order."""
    out = []
    for chunk in chunks(path):
        if str(chunk.entity_path) == entity:
            batch = chunk.to_record_batch()
            for field, values in zip(batch.schema.names, batch.columns, strict=True):
                if field.split(":")[-1] == name:
                    out += [v for v in values.to_pylist() if v is not None]
    return out


def timed(path, entity):
    """The times of an entity's rows, in s."""
    found = [c.to_record_batch() for c in chunks(path) if str(c.entity_path) == entity]
    return np.concatenate([b.column("time").cast("int64").to_numpy() for b in found if "time" in b.schema.names]) / 1e9


def flat(values):
    return np.asarray(values, dtype=float).ravel()


@pytest.mark.contract
def test_declared_and_light():
    component = gc.registry().get("observer", "rerun")
    assert component.missing() is None
    code = "import sys, gapcert_rerun.plugin; sys.exit(bool({'rerun', 'numpy', 'pyarrow'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_run_that_did_not_ask_gets_none(tmp_path):
    plugin.gapcert_event(gc.Event("run-started", "run", {"name": "n", "folder": tmp_path, "rerun": None, "view": False}))
    assert plugin._STREAM.get() is None
    plugin.gapcert_event(gc.Event("stage-started", "certificate"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.exam
def test_everything_of_a_run_is_in_its_recording(small_run):
    paths = {str(c.entity_path) for c in chunks(small_run.folder / "run.rrd")}
    expected = {"/answer", "/alive/with_gamma", "/alive/without_gamma", "/winning/both", "/winning/goal/stay/0"}
    for state in ("theta", "omega"):
        expected |= {f"/gap/{state}/true", f"/gap/{state}/gamma", f"/gap/{state}/gamma/samples", f"/gap/{state}/scale"}
        expected |= {
            f"/band/{state}/{axis}/{what}"
            for axis in ("theta", "omega", "torque")
            for what in ("gamma", "envelope", "residual")
        }
        expected |= {f"/loop/{state}/{what}" for what in ("with_gamma", "without_gamma", "with_gamma_predicted", "low", "high")}
    expected |= {f"/stages/{stage}" for stage in ("run", "certificate", "controller", "closed_loop")}
    # Runs that broke are lines of their own.
    assert expected <= paths | {p.rpartition("/")[0] for p in paths}


def test_the_bands_are_those_of_the_certificate(small_run):
    """On a square whose sides are the axis and ± its reach."""
    path, gap = small_run.folder / "run.rrd", Figures.load(small_run.folder).gap
    for b in gap.bands[:2]:
        root, reach = f"/band/{b.state}/{b.axis.name}", 1.15 * max(b.constant, float(b.gamma.max()))

        def gaps(points, reach=reach):
            return (np.asarray(points)[:, 1] - 0.5) * 2 * reach

        ends = {n: column(path, f"{root}/{n}", "vertex_positions")[0] for n in ("gamma", "envelope")}
        for name, low, high in (("gamma", -b.gamma, b.gamma), ("envelope", b.low, b.high)):
            assert np.allclose(gaps(ends[name])[::2], low, rtol=0, atol=1e-6 * reach)
            assert np.allclose(gaps(ends[name])[1::2], high, rtol=0, atol=1e-6 * reach)
        (strip,) = column(path, f"{root}/residual", "strips")[0]
        assert np.allclose(gaps(strip), b.residual, rtol=0, atol=1e-6 * reach)
        for name, level in (("constant_low", -b.constant), ("constant_high", b.constant)):
            (strip,) = column(path, f"{root}/{name}", "strips")[0]
            assert np.allclose(gaps(strip), level, rtol=0, atol=1e-6 * reach)
        labels = column(path, f"{root}/frame", "labels")[0]
        assert {f"{b.axis.name} [{b.axis.unit}]", f"gap of {b.state} [{b.unit}]"} <= set(labels)


@pytest.mark.parametrize("refuted", [False, True])
def test_a_refuted_band_is_not_filled_nor_is_one_that_is_empty(refuted, tmp_path):
    from gapcert_figures.data import Axis, Band, GapFigure, Slice
    from gapcert_rerun.stream import Stream

    at = np.linspace(-3.0, 4.0, 71)
    low, high, gamma = np.full(71, -0.4), 0.5 - 0.3 * np.abs(at), np.full(71, 0.7)
    band = Band("w", "rad/s", Axis("a", "1", -3.0, 4.0), at, 0 * at, low, high, gamma, 0.8)
    maps = (Slice("w", "rad/s", np.ones((5, 5)), np.zeros((5, 5))),)
    path, stream = tmp_path / "run.rrd", Stream({"rerun": str(tmp_path / "run.rrd"), "name": "n"})
    figure = GapFigure((band.axis, Axis("b", "1", 0.0, 1.0)), "", maps, (band,), np.zeros((1, 2)))
    stream.receive(gc.Event("stage-finished", "certificate", {"figure": figure, "refuted": refuted}))
    stream.close()
    paths = {str(c.entity_path) for c in chunks(path)}
    filled = {p.rpartition("/")[2] for p in paths if p.startswith("/band/w/a/")} & {"gamma", "envelope"}
    assert filled == (set() if refuted else {"gamma", "envelope"})
    empty = np.flatnonzero(low > high)
    for side, end in (("low", low), ("high", high)):
        strips = [np.asarray(s) for s in column(path, f"/band/w/a/envelope_{side}", "strips")[0]]
        assert sum(map(len, strips)) == (71 if refuted else len(empty))
        shown = np.concatenate(strips)[:, 1] * 2 * 1.15 * 0.8 - 1.15 * 0.8
        assert np.allclose(shown, end if refuted else end[empty], atol=1e-6)
    if not refuted:
        corners = np.unique(np.asarray(column(path, "/band/w/a/envelope", "triangle_indices")[0]) // 2)
        assert set(corners.tolist()) == set(range(71)) - set(empty.tolist())
    marks = column(path, "/band/w/a/frame", "labels")[0]
    assert ("refuted; no band: l above u" if refuted else "no band: l above u") in marks
    names = column(path, "/gap/w/gamma/frame", "labels")[0]
    assert ("refuted γ, and samples" in names, "certified γ, and samples" in names) == (refuted, not refuted)


@pytest.mark.exam
def test_what_is_refuted_is_drawn_as_that_from_end_to_end(small_spec, tmp_path):
    """Constants of which a fiftieth is taken."""
    spec = {k: small_spec[k] for k in ("version", "name", "model", "backend", "domain", "gap")}
    less = {"lipschitz": {"residual": {"kind": "wood-zhang", "safety": 0.02}}, "report": {"rerun": True}}
    done = gc.run({**spec, **less, "certificate": {"claim": "statistical"}}, out=tmp_path)
    assert done.summary["verdict"] == "fails"
    paths = {str(c.entity_path) for c in chunks(done.folder / "run.rrd")}
    assert "/band/omega/theta/envelope_low" in paths
    assert "/band/omega/theta/envelope" not in paths


def test_a_run_is_alive_until_the_step_at_which_it_breaks(small_run):
    for runs in Figures.load(small_run.folder).loop.runs:
        alive = flat(column(small_run.folder / "run.rrd", f"/alive/with{'' if runs.gamma else 'out'}_gamma", "scalars"))
        assert alive.tolist() == [((runs.broke < 0) | (runs.broke > k)).sum() for k in range(runs.steps + 1)]
        assert (alive[-1] < runs.starts) == (not runs.gamma)


def test_the_certificate_is_a_property_of_the_recording(small_run):
    found = {}
    for chunk in chunks(small_run.folder / "run.rrd"):
        batch = chunk.to_record_batch()
        for name, values in zip(batch.schema.names, batch.columns, strict=True):
            found |= {name.split(":")[-1]: values.to_pylist()[0]} if "/__properties" in str(chunk.entity_path) else {}
    assert found["verdict"] == ["holds"]
    assert found["claim_kind"] == ["deterministic"]
    assert found["theta_gamma_mean"] == [small_run.summary["certificate"]["states"]["theta"]["gamma_mean"]]


def test_lanes_and_text(small_run):
    path = small_run.folder / "run.rrd"
    assert [v[0] for v in column(path, "/stages/run", "state")] == ["running", "holds"]
    text = column(path, "/answer", "text")[-1][0]
    assert text.startswith("# small: holds")
    assert "How to read the pictures" in text


def test_series_go_by_columns(small_run):
    """A chunk per line, not a row per point: 401 points of 18 band lines would be thousands of chunks."""
    assert len(chunks(small_run.folder / "run.rrd")) < 400
    assert (small_run.folder / "run.rrd").stat().st_size < 3e6


@pytest.mark.contract
def test_the_file_is_whole(small_run):
    done = subprocess.run([*CLI, "rrd", "verify", small_run.folder / "run.rrd"], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    # `verify` is content with a file that it cannot even open, so the count is what tells.
    assert "1 file verified without error" in done.stdout + done.stderr


def start(folder, **data):
    plugin.gapcert_event(gc.Event("run-started", "run", {"name": "n", "folder": folder, "rerun": None, "view": False} | data))


def finish():
    plugin.gapcert_event(gc.Event("run-finished", "run", {"summary": {"name": "n", "verdict": "holds"}}))


@pytest.mark.fault("there is no display for the viewer", shows="a warning; the run goes on")
def test_a_viewer_without_a_display_costs_the_viewer_only(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    with pytest.warns(RuntimeWarning, match=r"^no live viewer \(there is no display\); the recording is in run\.rrd$"):
        start(tmp_path, rerun=str(tmp_path / "run.rrd"), view=True)
    finish()
    assert chunks(tmp_path / "run.rrd")


def test_a_viewer_that_does_not_start_costs_the_viewer_only(tmp_path, monkeypatch):
    asked = []

    class Dead:
        def __init__(self, command, **options):
            asked.append(command)

        def poll(self):
            return 1

        def wait(self, timeout):
            return 1

    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setattr("subprocess.Popen", Dead)
    with pytest.warns(RuntimeWarning, match=r"no live viewer \(it did not start"):
        start(tmp_path, rerun=str(tmp_path / "run.rrd"), view=True)
    finish()
    assert chunks(tmp_path / "run.rrd")
    assert asked[0][asked[0].index("--bind") + 1] == "127.0.0.1"


LOST = """
import os, signal, subprocess, sys, time, warnings
from pathlib import Path
import gapcert as gc
from gapcert_rerun import plugin
warnings.showwarning = lambda message, *_: print(message)
made = subprocess.Popen
# A server without a window stands for the viewer.
subprocess.Popen = lambda command, **options: made([*command[:-1], "--serve-grpc"], **options)
data = {"name": "n", "folder": Path(), "rerun": "run.rrd", "view": True}
plugin.gapcert_event(gc.Event("run-started", "run", data))
sys.modules["gapcert_rerun.stream"].PATIENCE = 0.5
viewer = plugin._STREAM.get()._viewer
time.sleep(0.3)
os.killpg(viewer.process.pid, getattr(signal, sys.argv[1]))
# Which takes a process of many threads some milliseconds.
sys.argv[1] == "SIGKILL" and viewer.process.wait(5)
plugin.gapcert_event(gc.Event("run-finished", "run", {"summary": {"name": "n", "verdict": "holds"}}))
viewer.process.wait(5)
"""


@pytest.mark.exam
@pytest.mark.fault("the Rerun viewer is killed or stops taking data", shows="a sentence; the recording is whole")
@pytest.mark.parametrize("end", ["SIGKILL", pytest.param("SIGSTOP", marks=pytest.mark.exam)])
def test_a_viewer_that_is_lost_is_told_in_one_sentence(end, tmp_path):
    environment = {k: v for k, v in os.environ.items() if k != "RUST_LOG"} | {"DISPLAY": ":99"}
    command = [sys.executable, "-c", LOST, end]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment, timeout=60, check=True)
    assert done.stderr == ""
    assert done.stdout == "no live viewer (it was closed or has stopped taking data); the recording is in run.rrd\n"
    assert chunks(tmp_path / "run.rrd")


@pytest.mark.fault("the recording cannot be written", shows="a warning; the run goes on")
def test_a_file_that_cannot_be_written_is_a_warning(tmp_path):
    with pytest.warns(RuntimeWarning, match="no Rerun recording"):
        start(tmp_path, rerun=str(tmp_path / "absent" / "run.rrd"))
    finish()
    assert plugin._STREAM.get() is None


@pytest.mark.fault("a figure cannot be drawn", shows="a warning; the run goes on")
def test_a_figure_that_cannot_be_drawn_ends_the_stream_and_not_the_run(tmp_path):
    start(tmp_path, rerun=str(tmp_path / "run.rrd"))
    broken = gapcert_figures.GapFigure((), "", (None,), (), np.zeros((0, 2)))
    with pytest.warns(RuntimeWarning, match="no Rerun recording"):
        plugin.gapcert_event(gc.Event("stage-finished", "certificate", {"figure": broken}))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plugin.gapcert_event(gc.Event("stage-started", "controller", {"number": 3}))
        finish()
    assert plugin._STREAM.get() is None


@pytest.mark.fault("a run that has finished is run again, and refused or cut off", shows="its recording stays as it was")
def test_a_recording_stays_until_the_next_has_finished(tmp_path):
    path = tmp_path / "run.rrd"
    start(tmp_path, rerun=str(path))
    finish()
    before = path.read_bytes()
    start(tmp_path, rerun=str(path))
    assert path.read_bytes() == before
    plugin._end()
    assert [p.name for p in tmp_path.iterdir()] == ["run.rrd"]
    assert path.read_bytes() == before
    start(tmp_path, rerun=str(path), name="other")
    finish()
    assert [p.name for p in tmp_path.iterdir()] == ["run.rrd"]
    assert path.read_bytes() != before


def test_a_run_that_died_leaves_no_stream_to_the_next(tmp_path):
    start(tmp_path, rerun=str(tmp_path / "first.rrd"))
    first = plugin._STREAM.get()
    start(tmp_path, rerun=str(tmp_path / "second.rrd"))
    assert plugin._STREAM.get() is not first
    finish()
    assert plugin._STREAM.get() is None


def test_diagnosis_is_drawn_beside_the_measurement(tmp_path):
    t = np.linspace(0, 1, 11)
    axes = ("q_dot [rad/s]", "missing force [N]")
    gap = np.where(np.arange(11) == 5, np.nan, t)
    laws = (
        Law("friction", *axes, t, -t, t, -t, 0.1 + 0 * t),
        Law("play", *axes, t, t, gap, gap, 0.1 + 0 * t, t, "loop"),
        Law("held", *axes, 1 + 0 * t, t, t[:0], t[:0], 0.1 + 0 * t),  # an input that never changed
        Law("what is left", *axes, t, t, t[:0], t[:0], 0.1 + 0 * t, lead=False),
    )
    figure = gapcert_figures.DiagnosisFigure(
        (gapcert_figures.Channel("q", "rad", t, np.sin(t), np.cos(t), np.sin(t)),),
        laws,
        Waterfall(("none", "friction at q"), np.array([2.0, 0.5])),
        (Correlation("q", "itself", t, t, t / 10, 0.05),),
        (Course(t, 1 + t, 1 + 0 * t),),
        (Signal("u", "N*m", t, np.sin(t)),),
    )
    start(tmp_path, rerun=str(tmp_path / "run.rrd"))
    plugin.gapcert_event(gc.Event("stage-finished", "diagnosis", {"figure": figure}))
    finish()
    path = tmp_path / "run.rrd"
    for name, values in (("measured", np.sin(t)), ("before", np.cos(t)), ("after", np.sin(t))):
        assert np.array_equal(flat(column(path, f"/diagnosis/q/{name}", "scalars")), values)
    assert np.allclose(flat(column(path, "/error/q/before", "scalars")), np.cos(t) - np.sin(t))
    assert np.allclose(timed(path, "/diagnosis/q/before"), t), "in seconds"
    assert len(column(path, "/law/0/missing", "positions")[0]) == len(t)
    assert len(column(path, "/law/1/named", "strips")[0]) == 2, "a loop has a gap after each part"
    assert column(path, "/law/2/named", "strips") == []
    assert "| + friction at q | 25 % |" in column(path, "/explained", "text")[0][0]
    paths = {str(c.entity_path) for c in chunks(path)}
    assert {"/left/q-itself/after", "/left/course0/before", "/experiment/u/signal", "/law/2/missing"} <= paths


def test_what_a_controller_foresaw_is_in_the_recording(tmp_path):
    """The ends of a tube over time from its step on, and a box per step."""
    from gapcert_closed_loop.prediction import Foreseen
    from gapcert_figures.data import Axis, LoopFigure, Runs
    from gapcert_rerun.stream import Stream

    axes, x = (Axis("x", "m", 0, 1), Axis("y", "m", 0, 2)), np.full((1, 5, 2), 0.5)
    runs = tuple(Runs(gamma, "first", 1, 4, np.array([-1]), x, np.array([-1]), x) for gamma in (False, True))
    half = np.array([[0.0, 0.0], [0.1, 0.2], [0.2, 0.4]])
    told = Foreseen(2, x[0, :3], x[0, :3] - half, x[0, :3] + half)
    path = tmp_path / "run.rrd"
    stream = Stream({"rerun": str(path), "name": "n"})
    loop = LoopFigure(axes, 0.1, np.array([[0.0, 1.0], [0.0, 2.0]]), runs, foreseen=(told,))
    stream.receive(gc.Event("stage-finished", "closed_loop", {"figure": loop}))
    stream.close()
    middle, spread = (flat(column(path, "/loop/x/foreseen0", name)) for name in ("values", "variances"))
    assert np.allclose(middle, 0.5)
    assert np.allclose(np.sqrt(spread), [0.0, 0.1, 0.2]), "a band is one standard deviation wide"
    assert np.allclose(timed(path, "/loop/x/foreseen0"), [0.2, 0.3, 0.4]), "from step 2 on"
    (boxes,) = column(path, "/winning/runs/foreseen0", "strips")
    assert np.allclose(np.asarray(boxes[2])[:, :2], [[0.3, 0.05], [0.7, 0.05], [0.7, 0.45], [0.3, 0.45], [0.3, 0.05]])


def test_what_is_learned_is_in_the_recording(tmp_path):
    from gapcert_closed_loop.prediction import Learned
    from gapcert_figures.data import Axis, LoopFigure, Runs
    from gapcert_rerun.stream import Stream

    x = np.full((1, 3, 1), 0.5)
    runs = tuple(Runs(gamma, "first", 1, 2, np.array([-1]), x, np.array([-1]), x) for gamma in (False, True))
    run, hull = np.array([[0.6, 1.4], [1.2, 1.3], [1.2, 1.3]]), np.array([[0.6, 1.4], [1.0, 1.4], [1.1, 1.3]])
    stream = Stream({"rerun": str(tmp_path / "run.rrd"), "name": "n"})
    loop = LoopFigure(
        (Axis("x", "m", 0, 1),), 0.1, np.array([[0.0, 1.0]]), runs, learned=(Learned("m", "kg", run, hull, 1.25),)
    )
    stream.receive(gc.Event("stage-finished", "closed_loop", {"figure": loop}))
    stream.close()
    for name, values in (("run", run), ("all", hull)):
        assert np.array_equal(flat(column(tmp_path / "run.rrd", f"/learned/m/{name}", "scalars")).reshape(-1, 2), values)
    assert (flat(column(tmp_path / "run.rrd", "/learned/m/stated", "scalars")) == 1.25).all()


def test_simulator_against_simulator_is_in_the_recording(tmp_path):
    """A map where a pair differs, and how the runs of each pair come apart."""
    from gapcert_figures.data import Axis, CompareFigure, PairFigure
    from gapcert_rerun.stream import Stream

    axes = (Axis("theta", "rad", -1, 1), Axis("omega", "rad/s", -2, 2))
    values, drift = np.arange(16.0).reshape(4, 4), np.array([0.0, 1e-3, 1e-2])
    apart = PairFigure("one", "two", "theta", "rad", axes, "torque = 0 N·m", values, drift)
    same = PairFigure("one", "three", "theta", "rad", (), "", np.empty((0, 0)), drift * 1e-12)
    path = tmp_path / "run.rrd"
    stream = Stream({"rerun": str(path), "name": "n"})
    stream.receive(gc.Event("stage-finished", "pairs", {"figure": CompareFigure(0.005, (apart, same))}))
    stream.close()
    paths = {str(c.entity_path) for c in chunks(path)}
    assert {"/pair/one-two/map", "/drift/one-two", "/drift/one-three"} <= paths
    assert "/pair/one-three/map" not in paths
    assert np.allclose(flat(column(path, "/drift/one-two", "scalars")), [-18, -3, -2])


def robot_figure(motions=("without γ", "with γ")):
    """A ball on a rod that slides: shapes of every kind, 20 frames, broken at 0.5 s without γ."""
    shapes = [
        gc.plugin.Shape(0, "plane", np.array([1.0, 1.0])),
        gc.plugin.Shape(1, "box", np.array([0.1, 0.2, 0.3])),
        gc.plugin.Shape(1, "sphere", np.array([0.1])),
        gc.plugin.Shape(1, "capsule", np.array([0.1, 0.5])),
        gc.plugin.Shape(1, "cylinder", np.array([0.1, 0.5])),
        gc.plugin.Shape(1, "ellipsoid", np.array([0.1, 0.2, 0.3])),
        gc.plugin.Shape(1, "mesh", np.empty(0), vertices=np.eye(3), faces=np.array([[0, 1, 2]])),
    ]
    t = np.linspace(0, 1, 20)
    poses = np.zeros((20, 2, 7))
    poses[:, :, 3] = 1.0
    poses[:, 1, 0] = t
    made = tuple(gapcert_figures.Motion(n, t, poses, 0.5 if n == "without γ" else -1.0) for n in motions)
    return gapcert_figures.Playback(("world", "slider/1"), tuple(shapes), made)


def test_the_robot_is_in_the_recording(tmp_path):
    """Poses of the link that moves by columns, of the one that does not once; shapes, and red from the violation on."""
    from gapcert_rerun.robot import draw_robot
    from gapcert_rerun.stream import Stream

    path, played = tmp_path / "run.rrd", robot_figure()
    stream = Stream({"rerun": str(path), "name": "n"})
    draw_robot(stream.canvas, played)
    stream.close()
    every = [str(c.entity_path) for c in chunks(path)]
    for name in ("without_gamma", "with_gamma"):
        link = f"/robot/{name}/slider\\/1"
        assert np.allclose(flat(column(path, link, "translation")).reshape(-1, 3), played.motions[0].poses[:, 1, :3])
        assert np.allclose(flat(column(path, link, "quaternion")).reshape(-1, 4), [0, 0, 0, 1])
        assert np.allclose(timed(path, link), played.motions[0].t)
        assert len(column(path, f"/robot/{name}/world", "translation")) == 1
        assert {f"{link}/{k}" for k in range(6)} <= set(every)
        assert sum(e == link for e in every) == 1, "one chunk for all poses of a link"
    reds = column(path, "/robot/without_gamma/slider\\/1/0", "colors")
    assert len(reds) == 2
    assert np.allclose(timed(path, "/robot/without_gamma/slider\\/1/0"), [0.0, 0.5])
    assert len(column(path, "/robot/with_gamma/slider\\/1/0", "colors")) == 1
    assert list(stream.canvas.views["robot"]) == ["without γ", "with γ"]
    assert path.stat().st_size < 2e5


def test_a_closed_loop_without_a_body_has_no_robot(small_run):
    assert not any(str(c.entity_path).startswith("/robot") for c in chunks(small_run.folder / "run.rrd"))


@pytest.mark.exam
def test_the_robot_of_a_run_is_in_its_recording(small_spec, tmp_path):
    """The tip of PyBullet's pendulum is where the recorded angle has it, in both runs; 60 pictures a second at most."""
    pytest.importorskip("pybullet")
    robot = Path(__file__).parents[2] / "specs" / "models" / "pendulum.urdf"
    backend = {"kind": "pybullet", "robot": str(robot), "inputs": {"torque": "hinge"}}
    backend["states"] = {"theta": "hinge.position", "omega": "hinge.velocity"}
    lipschitz = {"residual": {"kind": "wood-zhang", "safety": 1.2}}
    spec = small_spec | {"backend": backend, "lipschitz": lipschitz, "certificate": {"claim": "empirical"}}
    run = gc.run({k: v for k, v in spec.items() if k != "expect"} | {"report": {"html": False}}, out=tmp_path)
    loop, path = Figures.load(run.folder).loop, run.folder / "run.rrd"
    for runs in loop.runs:
        link = f"/robot/{'with_gamma' if runs.gamma else 'without_gamma'}/rod"
        x, y, z, w = flat(column(path, link, "quaternion")).reshape(-1, 4).T
        assert np.allclose(x, 0, atol=1e-6)
        assert np.allclose(z, 0, atol=1e-6)
        at = np.round(timed(path, link) / loop.period).astype(int)
        assert np.allclose(2 * np.arctan2(y, w), runs.traces[0, at, 0], atol=1e-5)
        assert np.diff(timed(path, link)).min() > 1 / 61
    assert path.stat().st_size < 3e6


@pytest.mark.exam
def test_the_same_run_gives_the_same_recording(small_spec, small_run, tmp_path):
    again = gc.run(small_spec, out=tmp_path)
    both = [str(r.folder / "run.rrd") for r in (small_run, again)]
    assert subprocess.run([*CLI, "rrd", "compare", "--unordered", *both], check=False).returncode == 0
    other = gc.run(small_spec | {"seed": 1}, out=tmp_path)
    both[1] = str(other.folder / "run.rrd")
    assert subprocess.run([*CLI, "rrd", "compare", "--unordered", *both], capture_output=True, check=False).returncode != 0
