"""Why the mecanum base falls behind: the causes in each engine, the gap that is left, and the extended model as a spec."""

from pathlib import Path

import numpy as np
import pytest

import gapcert as gc

pytestmark = pytest.mark.contract

ROOT = Path(__file__).parents[2]
MUTED = (
    "report.html=false",
    "report.rerun=false",
    "certificate=null",
    "hidden=null",
    "sampling=null",
    "lipschitz=null",
    "gap=null",
)


def run(name, tmp_path, *changes):
    spec = gc.load_spec(ROOT / f"specs/diagnose/{name}.yaml", (*MUTED, *changes))
    return gc.run(spec, out=tmp_path).summary


def asked(summary):
    """What the spec expects of the diagnosis; no certificate is made here."""
    return [e for e in summary["expectations"] if not e["text"].startswith("recertified")]


def ratios(summary):
    return [g["before"] / g["after"] for g in summary["gain"]["0.3"].values()]


@pytest.mark.exam
@pytest.mark.outside("gazebo")
@pytest.mark.parametrize(("name", "least"), [("mecanum", 30), ("mecanum_motion", 30)])
def test_in_gazebo_a_rate_limit_at_what_friction_allows_is_named(name, least, tmp_path):
    summary = run(name, tmp_path)
    assert all(e["met"] for e in asked(summary))
    assert sorted((c["effect"], c["site"]) for c in summary["causes"]) == [
        ("input-rate-limit", "ua"),
        ("input-rate-limit", "ub"),
    ]
    for cause in summary["causes"]:
        assert cause["parameters"]["rate"]["value"] == pytest.approx(9.81 / 2, rel=0.01)
    assert min(ratios(summary)) > least


@pytest.mark.exam
def test_in_mujoco_a_lag_is_named(tmp_path):
    summary = run("mecanum_mujoco", tmp_path)
    assert all(e["met"] for e in asked(summary))
    assert sorted((c["effect"], c["site"]) for c in summary["causes"]) == [("input-lag", "ua"), ("input-lag", "ub")]
    assert min(ratios(summary)) > 100


@pytest.mark.exam
@pytest.mark.parametrize(
    ("engine", "name", "pause", "law", "least"),
    [
        ("dart", "mecanum_barrels", "0", "input-rate-limit", 6),
        # Which of the two it is hangs on the order in which contacts are solved.
        ("pybullet", "mecanum_barrels_pybullet", "0", "input-rate-limit or input-rate-limited-lag", 6),
        ("mujoco", "mecanum_barrels_mujoco", "0.6 s", "input-rate-limited-lag", 20),
    ],
)
def test_on_rollers_that_make_round_wheels_a_limited_rate_is_named(engine, name, pause, law, least, tmp_path):
    if gc.registry().get("backend", engine).missing():
        pytest.skip(f"{engine} is not installed")
    summary = run(name, tmp_path, f"play.pause={pause}")
    # What a spec says about the law is said of motion; from rest another one may be named.
    assert all(e["met"] for e in asked(summary) if ".effect" not in e["text"])
    first = summary["causes"][:2]
    assert {c["site"] for c in first} == {"ua", "ub"}
    assert {c["effect"] for c in first} <= {*law.split(" or ")}
    # Whatever else is in question, rounded or not: both rates are limited in every answer.
    limited = {"input-rate-limit", "input-rate-limited-lag"}
    for group in summary.get("ambiguous_with", []):
        assert {c["site"] for c in group if c["effect"] in limited} == {"ua", "ub"}
    assert min(ratios(summary)) > least


@pytest.mark.exam
def test_any_faults_on_the_way_of_both_inputs_can_be_written_down():
    """The longest equation that a search may try on two inputs which move every state."""
    nominal = gc.load_spec(ROOT / "specs/diagnose/mecanum_mujoco.yaml").build("model")
    faults = [e for n in gc.registry().names("effect") if (e := gc.registry().build("effect", n)).site == "input"]
    faults.sort(key=lambda e: -e.stage)
    extended = nominal.extend([e.extension(site, nominal) for e in faults for site in nominal.sites("input")])
    assert len(faults) == 11
    u = np.zeros((1, 2))
    assert extended.step(np.zeros((1, 2)), u).x == pytest.approx(np.zeros((1, 2)))


def test_the_model_with_the_lag_is_the_extended_model_that_knows_its_velocity():
    """specs/mecanum_lag.yaml writes one period in closed form, with what the effect remembers as a state."""
    nominal = gc.load_spec(ROOT / "specs/diagnose/mecanum_mujoco.yaml").build("model")
    lag = gc.registry().build("effect", "input-lag")
    extended = nominal.extend([lag.extension(site, nominal) for site in nominal.sites("input")])
    times = {p.name: 0.0965 for p in extended.parameters}
    written = gc.load_spec(ROOT / "specs/mecanum_lag.yaml").build("model")
    z = np.random.default_rng(0).uniform(-1, 1, (50, 6))
    p, v, u = z[:, :2], z[:, 2:4], z[:, 4:]
    along = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2)
    found = extended.step(p, u @ along, hidden=v @ along, parameters=times)
    after = written.step(z[:, :4], u).x
    assert found.x == pytest.approx(after[:, :2], abs=1e-12)
    assert found.hidden @ along == pytest.approx(after[:, 2:], abs=1e-12)
