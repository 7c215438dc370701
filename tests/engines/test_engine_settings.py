"""Settings of engines as causes: what differs between two engines, or two settings of one, is found and named."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gapcert as gc
import gapcert_engines
from gapcert_diagnosis.search import engine_settings as settings
from gapcert_mujoco.config import MuJoCoConfig

pytestmark = [pytest.mark.needs("mujoco"), pytest.mark.contract]


ROOT = Path(__file__).parents[2]
FRICTION = ["coulomb-friction", "viscous-friction", "stribeck-friction", "input-gain"]
ROD = """<mujoco>
  <option timestep="0.002"/><compiler angle="radian"/>
  <worldbody><body name="rod"><joint name="hinge" axis="0 1 0" damping="{damping}" frictionloss="{dry}" armature="{armature}"/>
    <inertial pos="0 0 -0.5" mass="1" diaginertia="0.09 0.09 0.001"/></body></worldbody>
</mujoco>
"""
TWO = """<mujoco><option timestep="0.001" integrator="{integrator}" tolerance="1e-14"/><compiler angle="radian"/><worldbody>
  <body name="a"><joint name="j1" axis="0 1 0" armature="0.01" frictionloss="0.3" damping="0.1"/>
    <inertial pos="0 0 -0.2" mass="1.1" diaginertia="0.02 0.02 0.002"/>
    <body name="b" pos="0 0 -0.3"><joint name="j2" axis="1 1 0" frictionloss="0.1"/>
      <inertial pos="0 0.02 -0.1" mass="0.6" diaginertia="0.01 0.01 0.001"/></body></body>
</worldbody></mujoco>"""


def backend(folder, *, name="robot", damping=0.0, dry=0.0, armature=0.0, **options):
    from gapcert_mujoco.engine import MuJoCoEngine

    (folder / f"{name}.xml").write_text(ROD.format(damping=damping, dry=dry, armature=armature))
    states = {"q": "hinge.position", "q_dot": "hinge.velocity"}
    section = {"kind": "mujoco", "robot": f"{folder}/{name}.xml", "states": states, "inputs": {"u": "hinge"}, "period": "4 ms"}
    return gapcert_engines.EngineBackend(MuJoCoEngine(MuJoCoConfig.model_validate(section | options)))


def played(system, pace=1.0):
    log = gc.play(system, {"u": (-1.5, 1.5), "q": (-0.5, 0.5)}, seconds=6.0, trajectories=2, seed=1)
    return replace(log, trajectories=tuple(replace(tr, t=tr.t * pace) for tr in log.trajectories))


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
def test_dry_friction_gives_way_as_in_mujoco(tmp_path, integrator):
    from gapcert_mujoco.engine import MuJoCoEngine

    (tmp_path / "two.xml").write_text(TWO.format(integrator=integrator))
    states = {f"q{i}{end}": f"j{i}.{field}" for i in (1, 2) for end, field in (("", "position"), ("_dot", "velocity"))}
    section = {"kind": "mujoco", "robot": f"{tmp_path}/two.xml", "states": states, "inputs": {"u": "j1"}, "period": "4 ms"}
    system = gapcert_engines.EngineBackend(MuJoCoEngine(MuJoCoConfig.model_validate(section | {"substeps": 4})))
    model, rng = gapcert_engines.EngineModel(system), np.random.default_rng(0)
    order = [[s.name for s in system.states].index(s.name) for s in model.states]
    for size in (0.01, 0.1, 1.0):
        x, u = size * rng.normal(size=(30, 4)), size * rng.normal(size=(30, 20, 1))
        at = np.empty_like(x)
        at[:, order] = x
        np.testing.assert_allclose(model.fast_rollout(x, u).x, system.rollout(at, u).x[:, :, order], rtol=0, atol=1e-9)


@pytest.mark.exam
@pytest.mark.parametrize(
    ("options", "name", "value"),
    [({"integrator": "RK4"}, "integrator", "RK4"), ({"substeps": 4}, "substeps", 4)],
)
def test_a_setting_of_the_engine_is_named(tmp_path, options, name, value):
    reality = backend(tmp_path, name="real", **options)
    found = gc.diagnose(gapcert_engines.EngineModel(backend(tmp_path)), played(reality), horizons=[0.5])
    (cause,) = found.causes
    assert (cause.effect, cause.site, cause.native) == ("engine-setting", name, name)
    assert cause.setting["value"] == value
    assert found.verdict == "causes"
    assert found.summary()["causes"][0]["setting"]["value"] == value
    assert f"setting {name}: {value}" in found.extended_model.files()["not_in_the_file.txt"]
    rng = np.random.default_rng(1)
    x, u = rng.normal(size=(4, 2)), rng.normal(size=(4, 60, 1))
    np.testing.assert_allclose(found.extended_model.rollout(x, u).x, reality.rollout(x, u).x, rtol=0, atol=1e-9)


@pytest.mark.exam
def test_a_step_of_another_length_is_named(tmp_path):
    reality = backend(tmp_path, period="0.00416666666666666667 s")
    found = gc.diagnose(gapcert_engines.EngineModel(backend(tmp_path)), played(reality, 0.96), horizons=[0.5])
    assert [(c.effect, c.site) for c in found.causes] == [("engine-setting", "time_step")]
    assert found.causes[0].parameters["value"].value == pytest.approx(1 / 240)


@pytest.mark.exam
@pytest.mark.parametrize(
    ("hidden", "effect", "native", "value"),
    [
        ({"dry": 0.1}, "coulomb-friction", "frictionloss.hinge", 0.1),
        ({"armature": 0.02}, "parameter", "armature.hinge", 0.02),
        ({"gravity": (0.0, 0.0, -9.7)}, "parameter", "gravity_z", -9.7),
    ],
)
def test_native_parameters_without_a_tolerance_are_named(tmp_path, hidden, effect, native, value):
    found = gc.diagnose(
        gapcert_engines.EngineModel(backend(tmp_path)), played(backend(tmp_path, name="real", **hidden)), horizons=[0.5]
    )
    (cause,) = found.causes
    assert (cause.effect, cause.native) == (effect, native)
    (number,) = cause.parameters.values()
    assert number.value == pytest.approx(value, rel=1e-6)
    assert found.extended_model.natives() == pytest.approx({native: value}, rel=1e-6)


@pytest.mark.exam
def test_a_setting_and_an_effect_are_told_apart(tmp_path):
    reality = backend(tmp_path, name="real", damping=0.05, integrator="RK4")
    found = gc.diagnose(gapcert_engines.EngineModel(backend(tmp_path)), played(reality), horizons=[0.5])
    assert {(c.effect, c.site) for c in found.causes} == {("engine-setting", "integrator"), ("viscous-friction", "q")}
    assert next(c for c in found.causes if c.effect == "viscous-friction").parameters["coefficient"].value == pytest.approx(
        0.05
    )


def test_engines_in_matched_settings_differ_in_nothing(tmp_path):
    found = gc.diagnose(gapcert_engines.EngineModel(backend(tmp_path)), played(backend(tmp_path, name="real")), horizons=[0.5])
    assert (found.verdict, found.causes) == ("nothing", ())


def test_variants_change_the_motion_and_say_what_they_were(tmp_path):
    model = gapcert_engines.EngineModel(backend(tmp_path))
    variants = model.variants()
    assert {"integrator", "substeps", "time_step", "damping", "dry_friction", "implicit_damping"} <= {
        v.setting for v in variants
    }
    x, u = np.array([[0.4, 1.0]]), np.array([[0.3]])
    for v in variants:
        if v.setting not in ("dry_friction", "implicit_damping"):
            assert np.abs(v.model.step(x, u).x - model.step(x, u).x).max() > 1e-9, v.setting
        assert v.value != v.was


@pytest.mark.exam
def test_two_engines_that_disagree_agree_once_told_why(tmp_path):
    """Bullet's drag on links, between PyBullet and MuJoCo; γ of the extended model is rounding."""
    pytest.importorskip("pybullet", reason="pybullet is not installed")
    spec = gc.load_spec(ROOT / "specs/diagnose/engines_gap.yaml", ("report.html=false", "report.rerun=false"))
    summary = gc.run(spec, out=tmp_path).summary
    assert all(e["met"] for e in summary["expectations"]), summary["expectations"]
    assert summary["sentence"].startswith("Of the engine's settings, damping (the drag on every link")
    (told,) = tmp_path.glob("*/not_in_the_file.txt")
    assert told.read_text() == "setting damping: 0.04 instead of 0.0\n"


def chain(folder, kind, name, damping=0.0, dry=0.0, **options):
    """A hinge in any engine that reads URDF."""
    pytest.importorskip({"pybullet": "pybullet", "dart": "dartpy", "mujoco": "mujoco"}[kind])
    (folder / f"{name}.urdf").write_text(
        '<robot name="rod"><link name="base"/><link name="rod"><inertial><origin xyz="0.01 0.01 -0.2"/><mass value="0.8"/>'
        '<inertia ixx="0.01" iyy="0.012" izz="0.003" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="hinge" type="continuous"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>'
        f'<dynamics damping="{damping}" friction="{dry}"/></joint></robot>'
    )
    section = {
        "kind": kind,
        "robot": f"{folder}/{name}.urdf",
        "states": {"q": "hinge.position", "q_dot": "hinge.velocity"},
        "inputs": {"u": "hinge"},
        "period": "5 ms",
    }
    calm = {"linear_damping": 0.0, "angular_damping": 0.0} if kind == "pybullet" else {}
    config = gc.registry().config("backend", kind).model_validate(section | calm | options)
    return gc.registry().build("backend", kind, config, gc.Context())


@pytest.mark.exam
@pytest.mark.parametrize(("simulation", "value"), [("mujoco", False), ("dart", False), ("pybullet", True)])
def test_damping_that_another_engine_solves_otherwise_is_no_other_law(tmp_path, simulation, value):
    """With its two numbers an asymmetric law is as exact as the simple one under the right setting."""
    reality = "pybullet" if simulation != "pybullet" else "mujoco"
    log = played(chain(tmp_path, reality, "real", damping=0.08))
    found = gc.diagnose(gapcert_engines.EngineModel(chain(tmp_path, simulation, "robot")), log, horizons=[0.5])
    assert [(c.effect, c.site) for c in found.causes] == [("engine-setting", "implicit_damping"), ("viscous-friction", "q")]
    assert found.causes[0].setting == {"value": value, "was": not value}
    assert found.causes[1].parameters["coefficient"].value == pytest.approx(0.08, rel=1e-9)


@pytest.mark.exam
def test_a_base_that_leans_and_a_biased_sensor_are_one(tmp_path):
    leant = chain(tmp_path, "dart", "real", gravity=(-9.81 * np.sin(0.06), 0.0, -9.81 * np.cos(0.06)))
    found = gc.diagnose(gapcert_engines.EngineModel(chain(tmp_path, "dart", "robot")), played(leant), horizons=[0.5])
    explanations = [[(c.effect, c.site) for c in found.causes], *(list(t) for t in found.ambiguous_with)]
    assert sorted(explanations) == [[("gravity-tilt", "q")], [("sensor-bias", "q")]]


@pytest.mark.exam
def test_how_friction_is_solved_counts_beside_it_in_noisy_data_too(tmp_path):
    """Without friction in the model this setting changes nothing."""
    rng, real = np.random.default_rng(0), chain(tmp_path, "dart", "real", dry=0.2)
    (tr,) = gc.play(real, {"u": (-1.5, 1.5), "q": (-0.5, 0.5)}, seconds=12.0, trajectories=1, seed=1).trajectories
    noisy = {n: v + (n != "u") * 3e-4 * v.std() * rng.standard_normal(len(v)) for n, v in tr.channels.items()}
    model, recording = (
        gapcert_engines.EngineModel(chain(tmp_path, "mujoco", "robot")),
        gc.Recording.of(tr.t, noisy, hold="zero"),
    )
    found = gc.diagnose(model, recording, FRICTION, horizons=[0.5])
    assert [(c.effect, c.site) for c in found.causes] == [("engine-setting", "dry_friction"), ("coulomb-friction", "q")]
    assert found.causes[0].setting == {"value": "hard", "was": "soft"}
    assert found.causes[1].parameters["level"].value == pytest.approx(0.2, rel=1e-3)


@pytest.mark.exam
def test_with_noise_most_settings_cost_one_step_and_no_fit(tmp_path, monkeypatch):
    rng, real = np.random.default_rng(0), chain(tmp_path, "mujoco", "real", damping=0.08)
    (tr,) = gc.play(real, {"u": (-1.5, 1.5), "q": (-0.5, 0.5)}, seconds=12.0, trajectories=1, seed=1).trajectories
    noisy = {n: v + (n != "u") * 3e-3 * v.std() * rng.standard_normal(len(v)) for n, v in tr.channels.items()}
    model, fits = gapcert_engines.EngineModel(chain(tmp_path, "mujoco", "robot")), []
    fit = settings.fit
    monkeypatch.setattr(settings, "fit", lambda h, *a, **k: fits.append(h.model) or fit(h, *a, **k))
    found = gc.diagnose(model, gc.Recording.of(tr.t, noisy, hold="zero"), FRICTION, horizons=[0.5])
    assert [(c.effect, c.site) for c in found.causes] == [("viscous-friction", "q")]
    assert len({id(m) for m in fits}) <= settings.THRESHOLDS.setting_contenders + 2 < len(model.variants())


@pytest.mark.exam
def test_a_step_that_is_late_is_no_delay_of_the_input(tmp_path):
    """Half of a step of 10 ms beyond half of one of 2.5 ms is 3.75 ms; and less damping than the file's is no negative one."""
    reality = backend(tmp_path, name="real", damping=0.05, dry=0.06, period="10 ms", substeps=4)
    log = gc.play(reality, {"u": (-1.5, 1.5), "q": (-0.5, 0.5)}, seconds=16.0, trajectories=1, seed=2)
    (tr,) = log.trajectories
    noise = 5e-4 * np.random.default_rng(3).standard_normal(len(tr.t))
    log = replace(gc.Recording.of(tr.t, {"q": tr.channels["q"] + noise, "u": tr.channels["u"]}), hold="zero")
    model = gapcert_engines.EngineModel(backend(tmp_path, damping=0.09, period="10 ms"))
    found = gc.diagnose(model, log, ["viscous-friction", "coulomb-friction", "input-delay", "sensor-delay"], horizons=[0.5])
    causes = {c.effect: c for c in found.causes}
    assert set(causes) == {"engine-setting", "viscous-friction", "coulomb-friction"}
    assert (causes["engine-setting"].site, causes["engine-setting"].setting["value"]) == ("substeps", 4)
    assert causes["viscous-friction"].parameters["coefficient"].value == pytest.approx(-0.04, rel=0.1)
    assert not any(f.startswith("implausible") for f in causes["viscous-friction"].flags)
