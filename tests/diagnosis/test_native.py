"""Diagnosis of a free body in contact, through an engine's own rollouts."""

import json
from pathlib import Path

import numpy as np
import pytest

import gapcert as gc
from gapcert.contracts.plugins.component import Context
from gapcert_diagnosis.native.candidates import native_candidates
from gapcert_diagnosis.native.rollouts import ErrorStore, Motions, channels
from gapcert_diagnosis.native.stepwise import EngineSearch, NativeFit, Surface, descend, design, hopeful
from gapcert_diagnosis.thresholds import THRESHOLDS
from gapcert_engines.native_model import NativeModel

pytestmark = pytest.mark.contract

MODELS = Path(__file__).parents[2] / "specs" / "models"
STATES = {n: f"base.{n}" for n in ("x", "y", "z", "vx", "vy", "vz")} | {f"w{a}": f"base.w{a}_body" for a in "xyz"}
STATES = {"q": "base.rotation"} | STATES
PERIOD = 1 / 148


def cube(kind="mujoco", ground=1.0, parameters=None, **options):
    robot = MODELS / ("cube.xml" if kind == "mujoco" else "cube.urdf")
    of = {"kind": kind, "robot": robot, "fixed_base": False, "ground": ground, "states": STATES, "substeps": 4, **options}
    known = gc.registry()
    of = known.config("backend", kind)(**of)
    config = known.config("model", "engine")(of=of, parameters=parameters or {})
    return known.build("model", "engine", config, Context(period=PERIOD))


@pytest.fixture(scope="module")
def model():
    pytest.importorskip("mujoco", reason="mujoco is not installed")
    return cube()


def tosses(model, count, steps=50, seed=0, noise=0.0):
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(count, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    place = np.column_stack([np.zeros((count, 2)), rng.uniform(0.1, 0.15, count)])
    speed = np.column_stack([rng.uniform(-1.5, 1.5, (count, 2)), rng.uniform(-1.5, 0, count)])
    x0 = np.concatenate([q, place, speed, rng.uniform(-4, 4, (count, 3))], axis=1)
    x = model.rollout(x0, np.empty((count, steps, 0))).x
    x[:, :, 4:] += noise * rng.normal(size=x[:, :, 4:].shape) * np.repeat([1e-3, 1e-2, 5e-2], 3)
    t = PERIOD * np.arange(steps + 1)
    names = channels(model)
    return gc.Recording(tuple(gc.Trajectory(t, dict(zip(names, row.T, strict=True)), f"{k}") for k, row in enumerate(x)))


def diagnosed(model, recording, **options):
    names = ["contact-friction", "contact-restitution", "parameter"]
    return gc.diagnose(model, recording, names, hold_out={"every": 4, "first": 1}, horizons=[0.1, 1.0], window=0.1, **options)


def test_rates_are_the_bodys_own(model):
    """A brick in flight keeps its angular momentum in the world, whatever its own frame says."""
    half = np.sqrt(0.5)
    x = np.array([[half, 0, 0, half, 0, 0, 1.0, 0, 0, 0, 2.0, 0, 0]])
    moved = model.step(x, np.empty((1, 0))).x[0]
    # Turned by 90° about z, the body's x is the world's y.
    world = NativeModel(
        model.of.model_copy(update={"states": {n: t.removesuffix("_body") for n, t in STATES.items()}}), Context()
    )
    x[0, 10:] = 0, 2.0, 0
    other = world.step(x, np.empty((1, 0))).x[0]
    np.testing.assert_allclose(moved[:10], other[:10], atol=1e-14)
    np.testing.assert_allclose(moved[10:], [2.0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(other[10:], [0, 2.0, 0], atol=1e-12)


def test_a_rotation_is_compared_by_its_angle(model):
    (group,) = (g for g in model.groups if g.output.name == "rotation")
    a, b = np.zeros((2, 13))
    a[0], b[:4] = 1, [-np.cos(0.15), -np.sin(0.15), 0, 0]
    assert group.error(a, b) == pytest.approx(0.3)


def test_rollouts_of_unequal_length_are_those_of_each_alone(model):
    recording = tosses(model, 3)
    cut = (recording.trajectories[0].part(0, 20), *recording.trajectories[1:])
    m = Motions.of(model, gc.Recording(cut))
    wrong = model.restated({"friction": 0.2})
    together = m.errors(wrong, 5.0)
    alone = np.concatenate([m.take([k]).errors(wrong, 5.0) for k in range(3)])
    assert together.tobytes() == alone.tobytes()
    assert (m.errors(model, 5.0)[..., 1] < 1e-9).all()
    assert [p[2] for p in m.pieces(10 * PERIOD)] == [10] * 11


def test_a_longer_horizon_goes_on_where_a_shorter_one_ends(model, monkeypatch):
    m, wrong, taken, step = Motions.of(model, tosses(model, 3)), model.restated({"friction": 0.2}), [], NativeModel._step
    _, alone = m.take(range(3)).rolled(wrong, 0.3)
    m.rolled(wrong, 0.15)
    monkeypatch.setattr(
        NativeModel, "_step", lambda self, x, *given, **more: taken.append(len(x)) or step(self, x, *given, **more)
    )
    assert m.rolled(wrong, 0.3)[1].tobytes() == alone.tobytes()
    assert sum(taken) == 3 * (m.pieces(0.3)[0][2] - m.pieces(0.15)[0][2])
    m.rolled(model, 0.3)
    assert sum(taken) > 3 * m.pieces(0.3)[0][2]  # another model begins anew


@pytest.fixture(scope="module")
def slippery(model):
    """Tosses on a slippery ground, their diagnosis, and how many rollouts it takes."""
    recording, taken, computed = tosses(model.restated({"friction": 0.25}), 16), [], Motions.errors
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Motions, "errors", lambda *given: taken.append(given[0]) or computed(*given))
        return recording, diagnosed(model, recording), len(taken)


@pytest.mark.exam
def test_the_truth_is_silent(model):
    silent = diagnosed(model, tosses(model, 16))
    assert (silent.verdict, silent.causes) == ("nothing", ())


@pytest.mark.exam
def test_a_hidden_friction_is_named(slippery):
    found = slippery[1]
    (cause,) = found.causes
    assert (found.verdict, cause.effect, cause.site, cause.native) == ("causes", "contact-friction", "ground", "friction")
    mu = cause.parameters["mu"]
    assert mu.low <= 0.25 <= mu.high
    assert mu.value == pytest.approx(0.25, rel=0.03)
    assert found.gain["1"]["position"].after < 0.1 * found.gain["1"]["position"].before
    assert "mass.cube" in found.log["native parameters that these data do not show"]
    assert "contact friction at the ground is 0.25" in found.sentence()


@pytest.mark.exam
def test_noise_is_silent_too(model):
    silent = diagnosed(model, tosses(model, 16, noise=1.0))
    assert (silent.verdict, silent.causes) == ("nothing", ())


@pytest.mark.exam
def test_a_tolerance_is_not_named(model):
    real = tosses(model.restated({"friction": 0.9}), 16)
    told = cube(parameters={"friction": {"value": 1.0, "tolerance": 0.3}})
    assert "contact-friction" not in {c.effect for c in diagnosed(told, real).causes}


@pytest.mark.exam
def test_an_interrupted_search_goes_on_where_it_was(model, slippery, tmp_path, monkeypatch):
    (recording, fresh, count), computed, left = slippery, Motions.errors, [12]

    def interrupted(self, *given):
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        return computed(self, *given)

    monkeypatch.setattr(Motions, "errors", interrupted)
    with pytest.raises(KeyboardInterrupt):
        diagnosed(model, recording, folder=tmp_path)
    assert len(list((tmp_path / "scores").glob("*.npz"))) == 12
    left[0] = 10**6
    found = diagnosed(model, recording, folder=tmp_path)
    assert 10**6 - left[0] == count - 12
    assert found.causes == fresh.causes


def late(recording):
    """Positions with noise, and velocities as a filter makes them of two samples: those of half a period ago, and noisy."""
    rng, out = np.random.default_rng(5), []
    for tr in recording.trajectories:
        seen = {n: np.array(c) for n, c in tr.channels.items()}
        for n in ("vx", "vy", "vz", "wx", "wy", "wz"):
            seen[n][1:] = (tr.channels[n][1:] + tr.channels[n][:-1]) / 2
            seen[n] += (0.2 if n[0] == "w" else 0.02) * rng.normal(size=len(seen[n]))
        for n in "xyz":
            seen[n] += 3e-5 * rng.normal(size=len(seen[n]))
        out.append(gc.Trajectory(tr.t, seen, tr.name))
    return gc.Recording(tuple(out))


@pytest.mark.parametrize("frame", ["_body", ""])
def test_a_flight_tells_where_a_rollout_starts(model, frame):
    """Noise of 0.02 m/s and 0.2 rad/s in the measured velocities is a tenth of that in the starts."""
    of = model.of.model_copy(update={"states": {n: t.replace("_body", frame) for n, t in STATES.items()}})
    model = NativeModel(of, Context(period=PERIOD))
    recording = tosses(model, 12)
    truth, m = Motions.of(model, recording), Motions.of(model, late(recording))
    pieces = m.pieces(1.0)
    start, seen, known = m.starts(model, pieces), *(np.stack([a.states[i][s] for i, s, _ in pieces]) for a in (m, truth))
    before, after = (np.sqrt(np.mean((a - known)[:, 7:] ** 2, axis=0)) for a in (seen, start))
    assert (after < 0.15 * before).all()
    # A contact that differs leaves the flight, and so the start; an engine that pulls less has a flight and a start of its own.
    assert m.starts(model.restated({"friction": 0.2, "contact_time": 0.01}), pieces).tobytes() == start.tobytes()
    assert (m.starts(model.restated({"gravity_z": -9.0}), pieces)[:, 9] < start[:, 9]).all()
    np.testing.assert_allclose(truth.starts(model, pieces), known, atol=1e-9)


def test_a_start_in_contact_is_the_measured_one(model):
    """The cube slides on the ground, which the stated friction of 1 would not let it."""
    flat = np.array([[1.0, 0, 0, 0, 0, 0, 0.0524, 1.0, 0, 0, 0, 0, 0]])
    x = model.restated({"friction": 0.1}).rollout(flat, np.empty((1, 40, 0))).x[0]
    t, names = PERIOD * np.arange(41), channels(model)
    recording = gc.Recording((gc.Trajectory(t, dict(zip(names, x.T, strict=True)), "slide"),))
    m = Motions.of(model, late(recording))
    assert m.starts(model, m.pieces(0.1)).tobytes() == np.stack([m.states[0][s] for _, s, _ in m.pieces(0.1)]).tobytes()


def test_the_starts_of_a_simulator_are_its_own(model):
    recording = late(tosses(model, 4))
    known = gc.Recording(recording.trajectories, noise=dict.fromkeys(channels(model), 1e-9))
    m = Motions.of(model, known)
    assert m.starts(model, m.pieces(1.0)).tobytes() == np.stack([x[0] for x in m.states]).tobytes()


def test_scores_of_a_hypothesis_are_kept_by_its_digest(model, tmp_path):
    m = Motions.of(model, tosses(model, 4))
    first = ErrorStore(tmp_path).errors(m, model.restated({"friction": 0.3}), (0.1,))
    store = ErrorStore(tmp_path)
    assert store.errors(m, model.restated({"friction": 0.3}), (0.1,)).tobytes() == first.tobytes()
    assert store.computed == 0
    store.errors(m, model.restated({"friction": 0.31}), (0.1,))
    assert store.computed == 1


def test_the_extended_model_is_a_spec(model):
    again = model.restated({"friction": 0.25}).to_spec()
    known = gc.registry()
    of = known.config("backend", "mujoco")(**again.pop("of"))
    built = known.build("model", "engine", known.config("model", "engine")(**again, of=of), Context())
    assert built.natives() == {"friction": 0.25}
    assert "friction = 0.25" in built.equations()
    assert "geom_friction[:, 0] *= 0.25" in built.files()["extended.py"]


@pytest.mark.parametrize("kind", ["pybullet", "dart"])
def test_what_no_file_says_code_does(kind, tmp_path, monkeypatch):
    pytest.importorskip({"dart": "dartpy"}.get(kind, kind))
    for name, text in cube(kind).restated({"friction": 0.25}).files().items():
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec((tmp_path / "extended.py").read_text(), names)
    if kind == "pybullet":
        assert names["pybullet"].getDynamicsInfo(names["robot"], -1)[1] == 0.25
        names["pybullet"].disconnect()
    else:
        (shape,) = (names["robot"].getBodyNode(0).getShapeNode(k) for k in range(1))
        assert shape.getDynamicsAspect().getFrictionCoeff() == 0.25


def test_code_softens_bullets_contacts(tmp_path, monkeypatch):
    pytest.importorskip("pybullet")
    for name, text in cube("pybullet").restated({"contact_time": 0.01, "rolling_friction": 0.02}).files().items():
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec((tmp_path / "extended.py").read_text(), names)
    info = names["pybullet"].getDynamicsInfo(names["robot"], -1)
    assert (info[6], *info[8:10]) == pytest.approx((0.02, 74.0, 3700.0))
    names["pybullet"].disconnect()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda r: {"vx": None}, "'vx' is missing; rollouts start from measured states"),
        (lambda r: {"t": r.t * 1.5}, "expected 0.00675676 s, the period of the model, throughout"),
        (lambda r: {"x": np.where(r.t > 0.1, np.nan, r.channels["x"])}, "has values that are missing"),
        (lambda r: {"q.w": r.channels["q.w"] + 1}, "expected unit quaternions"),
    ],
)
def test_a_log_that_does_not_fit_is_refused(model, change, told):
    (tr,) = tosses(model, 1).trajectories
    new = change(tr)
    channels = {n: v for n, v in {**tr.channels, **new}.items() if v is not None and n != "t"}
    with pytest.raises(gc.UsageError, match=told):
        Motions.of(model, gc.Recording((gc.Trajectory(new.get("t", tr.t), channels),)))


@pytest.mark.parametrize(
    ("states", "told"),
    [
        ({n: t for n, t in STATES.items() if n != "vy"}, r"base.vy is in no state"),
        (STATES | {"wx": "base.wx"}, r"the rate is in the body's frame in part"),
        ({"q": "base.rotation"}, r"there is no position in it"),
    ],
)
def test_states_that_are_not_the_whole_robot_are_refused(model, states, told):
    with pytest.raises(gc.UsageError, match=told):
        NativeModel(model.of.model_copy(update={"states": states}), Context())


def test_too_few_trajectories_are_refused(model):
    with pytest.raises(gc.UsageError, match="one trajectory is one voice"):
        diagnosed(model, tosses(model, 6))


def test_a_model_without_equations_says_so(model):
    with pytest.raises(gc.UsageError, match="without derivatives"):
        model.jacobian(np.zeros((1, 13)), np.empty((1, 0)))


def test_a_surface_finds_a_minimum_and_its_spread():
    rng = np.random.default_rng(0)
    centres = np.array([0.3, -0.2]) + 0.1 * rng.normal(size=(200, 2))
    stretch = np.array([[1.0, 0.4], [0.4, 0.5]])

    def evaluate(z):
        d = z - centres
        return np.einsum("ni,ij,nj->n", d, stretch, d)

    found, surface = descend(evaluate, np.zeros(2), [(-5, 5), (-5, 5)], 0.25, 4)
    np.testing.assert_allclose(found, centres.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(surface.bootstrap(0).std(axis=0), centres.std(axis=0) / np.sqrt(200), rtol=0.1)


def test_a_surface_without_a_minimum_leads_down():
    z = np.linspace(-1, 1, 5)[:, None]
    surface = Surface.of(z, -z, np.zeros(1), np.ones(1))
    assert surface.minimum()[0] == pytest.approx(3.0)


@pytest.mark.parametrize(("steep", "most"), [(0.0, 6), (20.0, 20)])
def test_near_a_minimum_few_points_do_unless_it_is_no_quadratic(steep, most):
    asked = []

    def evaluate(z):
        asked.append(z)
        d = z - 0.03
        return np.full(5, d @ d + steep * np.abs(d).sum() ** 1.5)

    found, surface = descend(evaluate, np.zeros(1), [(-5, 5)], 0.1, 4, 1e-3)
    assert len(asked) <= most
    assert (len(asked) > 6) == (steep > 0)
    np.testing.assert_allclose(found, 0.03, atol=1e-9 if not steep else 5e-3)
    assert surface.mean(found) == pytest.approx(float(evaluate(found).mean()), abs=1e-3)


@pytest.mark.parametrize("p", [1, 2, 3])
def test_a_lean_plan_has_as_many_points_as_a_quadratic_has_terms(p):
    plan = design(p, lean=True)
    rng = np.random.default_rng(p)
    c, g, h = rng.normal(), rng.normal(size=p), np.eye(p) + 0.3
    values = c + plan @ g + 0.5 * np.einsum("ni,ij,nj->n", plan, h, plan)
    assert len(plan) == 1 + p + p * (p + 1) // 2
    surface = Surface.of(plan, values[:, None], np.zeros(p), np.ones(p))
    np.testing.assert_allclose(surface.minimum(), np.clip(-np.linalg.solve(h, g), -3, 3), atol=1e-9)


def test_a_dip_is_found_where_quadratics_lead_away():
    """A score of exact data is the logarithm of a distance: no parabola."""
    found, surface = descend(lambda z: np.log(np.abs(z - 0.22) + 1e-3) * np.ones(5), np.zeros(1), [(-5, 5)], 0.25, 2)
    np.testing.assert_allclose(found, 0.22, atol=0.02)
    np.testing.assert_allclose(surface.minimum(), found)


@pytest.mark.parametrize(
    ("mean", "spread", "may"), [(0.004, 0.001, False), (0.01, 0.001, False), (0.01, 0.03, True), (0.03, 0.001, True)]
)
def test_what_plainly_gains_too_little_is_not_fitted_to_all(mean, spread, may):
    gained = mean + spread * np.tile([-1.0, 1.0], 12)
    assert hopeful(gained) == may


def test_a_bound_is_kept():
    found, _ = descend(lambda z: (z[0] + 2) ** 2 * np.ones(5), np.array([0.5]), [(0.0, 1.0)], 0.25, 4)
    assert found[0] == 0.0


def test_a_setting_is_tried_with_the_last_number_on_both_sides(model):
    known = native_candidates(model, ["contact-friction"], simulated=False)
    (friction,) = (n for n in known if n.native == "friction")
    setting = next(n for n in known if n.label == "cone = pyramidal")
    found = EngineSearch._variants(
        NativeFit((friction,), model.restated({"friction": 0.2})), setting, THRESHOLDS.setting_shifts
    )
    assert [m.values["friction"] for _, m in found] == pytest.approx([0.2 * np.exp(-0.2), 0.2, 0.2 * np.exp(0.2)])
    assert {m.of.cone for _, m in found} == {"pyramidal"}
    ((_, alone),) = EngineSearch._variants(NativeFit((), model), setting, THRESHOLDS.setting_shifts)
    assert alone.values == model.values


SPEC = """version: 1
name: tosses
model:
  kind: engine
  of: {{kind: mujoco, robot: {robot}, fixed_base: false, ground: 1.0, states: {states}, substeps: 4}}
recording: {{kind: csv, files: [log.csv], time: t, trajectory: toss, columns: {columns}}}
diagnose: {{effects: [contact-friction], train: {{every: 2}}, hold_out: {{every: 4, first: 1}}, horizons: [1 s], window: 0.1 s}}
expect: {{verdict: causes, causes: [contact-friction], gain.1.position.after <=: 0.001}}
"""


@pytest.mark.exam
def test_a_spec_from_end_to_end(model, tmp_path):
    names = channels(model)
    recording = tosses(model.restated({"friction": 0.25}), 16)
    rows = [np.column_stack([np.full(len(tr), k), tr.t, *tr.channels.values()]) for k, tr in enumerate(recording.trajectories)]
    header = ",".join(["toss", "t", *names])
    np.savetxt(tmp_path / "log.csv", np.concatenate(rows), delimiter=",", header=header, comments="", fmt="%.17g")
    columns = json.dumps({n: n for n in names})
    text = SPEC.format(robot=MODELS / "cube.xml", states=json.dumps(STATES), columns=columns)
    (tmp_path / "spec.yaml").write_text(text)
    run = gc.run(tmp_path / "spec.yaml", out=tmp_path / "runs")
    assert run.exit_code == 0, run.summary
    assert run.summary["log"]["trajectories fitted"] == 8
    assert run.summary["causes"][0]["native"] == "friction"
    page = (run.folder / "report.html").read_text()
    assert "contact friction" in page
    assert "mean length of the difference" in page
    assert (run.folder / "run.rrd").stat().st_size > 10_000
    extended = gc.load_spec(run.summary["extended_model"]).build("model")
    assert extended.natives()["friction"] == pytest.approx(0.25, rel=0.03)
    again = gc.run(tmp_path / "spec.yaml", out=tmp_path / "runs")
    assert again.summary["causes"] == run.summary["causes"]
