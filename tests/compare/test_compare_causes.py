"""Two engines and why they differ: a diagnosis of one by the motion of the other names it, and the change is made."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

import gapcert as gc
from gapcert.certification.samples.executors import threads
from gapcert.contracts.plugins.events import silent
from gapcert.run.build import Build
from gapcert.spec.spec import load_spec
from gapcert_compare import causes
from gapcert_compare.compare import closed, write_tables
from gapcert_compare.laboratory import Given, Laboratory, peers
from gapcert_compare.pairs import Pairs
from gapcert_compare.settings import Change, Trial, explain
from gapcert_report.words.compare import setting_name

pytestmark = pytest.mark.contract

URDF = Path(__file__).parents[2] / "specs" / "models" / "pendulum.urdf"
MODEL = {
    "kind": "equations",
    "states": {"theta": {"unit": "rad", "kind": "angle"}, "omega": "rad/s"},
    "inputs": {"torque": "N*m"},
    "parameters": {"m": "1 kg", "l": "1 m", "g": "9.81 m/s^2"},
    "derivative": {"theta": "omega", "omega": "-3*g/(2*l)*sin(theta) + 3*torque/(m*l**2)"},
    "integrator": "semi_implicit",
    "period": "5 ms",
}
CALM = {"linear_damping": 0, "angular_damping": 0}


def engine(kind, **options):
    pytest.importorskip({"dart": "dartpy", "drake": "pydrake"}.get(kind, kind), reason=f"needs the {kind} extra")
    wires = {"states": {"theta": "hinge.position", "omega": "hinge.velocity"}, "inputs": {"torque": "hinge"}}
    return {"kind": kind, "robot": str(URDF), **wires, **options}


def law(omega, **parameters):
    return MODEL | {
        "derivative": {"theta": "omega", "omega": omega},
        "parameters": {**MODEL["parameters"], **parameters},
    }


@pytest.fixture
def meet(tmp_path):
    def between(a, b):
        pairs = {"points": 200, "rollouts": 0, "cells": 0}
        data = {"version": 1, "name": "two", "model": MODEL, "compare": {"backends": {"a": a, "b": b}, "pairs": pairs}}
        loaded = load_spec(data | {"domain": {"theta": [-0.2, 0.2], "omega": [-0.25, 0.25], "torque": [-1, 1]}})
        build, asked = Build(loaded, None, tmp_path, False), loaded.config.sections["compare"]
        model = build.make("model")
        found, _ = peers(build, asked, model)
        laboratory = Laboratory(tmp_path / "pairs", gc.Domain.of(model, loaded.config.domain), asked, 0, threads, 1000, silent)
        summary = Pairs(build, model, laboratory, silent).between(found["a"], found["b"]).summary
        return summary, laboratory

    return between


def told(tmp_path):
    return [json.loads(p.read_text()) for p in (tmp_path / "pairs").glob("causes-*.json")]


@pytest.mark.exam
def test_an_engine_that_integrates_the_flow_is_told_to_step(meet):
    summary, _ = meet(engine("drake", integrator="runge_kutta3", accuracy=1e-9), engine("dart"))
    first = summary["explained_by"][0]
    assert (first["on"], first["setting"], first["value"], first["closes"]) == ("a", "integrator", "discrete", True)


@pytest.mark.exam
def test_the_damping_that_no_file_mentions_is_named_and_switched_off(meet, tmp_path):
    summary, _ = meet(engine("mujoco"), engine("pybullet"))
    first = summary["explained_by"][0]
    assert (first["on"], first["setting"], first["was"], first["value"]) == ("b", "damping", 0.04, 0.0)
    assert first["options"] == {"linear_damping": 0.0, "angular_damping": 0.0}
    assert first["closes"]
    assert first["made"]
    assert [[c["setting"] for c in changes] for t in told(tmp_path) for changes in t["alternatives"]] == [["damping"]] * 2


def test_a_comparison_that_goes_on_asks_no_second_time(meet, monkeypatch):
    summary, laboratory = meet(engine("pybullet"), MODEL)

    def again(*_):
        raise AssertionError("diagnosed anew")

    monkeypatch.setattr(causes, "_found", again)
    after, once_more = meet(engine("pybullet"), MODEL)
    assert after == summary
    assert once_more.digests == laboratory.digests


@pytest.mark.exam
def test_another_integrator_is_named(meet, tmp_path):
    first = meet(engine("mujoco", integrator="RK4"), engine("dart"))[0]["explained_by"][0]
    assert (first["on"], first["setting"], first["was"], first["value"]) == ("a", "integrator", "RK4", "Euler")
    assert first["closes"]
    assert told(tmp_path)[0]["alternatives"]


@pytest.mark.exam
def test_inertia_of_a_motor_is_named_with_its_number(meet):
    summary, _ = meet(engine("mujoco"), engine("mujoco", armature=0.02))
    first = summary["explained_by"][0]
    assert (first["effect"], first["site"], first["native"]) == ("parameter", "armature_hinge", "armature.hinge")
    values = {e["on"]: e for e in summary["explained_by"] if e.get("native")}
    number = values[first["on"]]["parameters"]["value"]["value"]
    assert number == pytest.approx({"a": 0.02, "b": 0.0}[first["on"]], abs=1e-9)
    assert first["closes"]
    assert first["options"] == {"armature": {"a": 0.02, "b": 0.0}[first["on"]]}
    assert "armature" in setting_name(first)
    assert "kg·m²" in setting_name(first)


@pytest.mark.exam
def test_what_no_option_says_is_set_as_a_native_parameter(meet):
    """Equations with c = 0.02 1/s of I = 1/3 kg·m²: PyBullet's joint is damped by c I, and then agrees."""
    summary, _ = meet(law(MODEL["derivative"]["omega"] + " - c*omega", c="0.02 1/s"), engine("pybullet", **CALM))
    (first,) = summary["explained_by"]
    assert (first["on"], first["effect"], first["site"], first["native"]) == ("b", "viscous-friction", "theta", "damping.hinge")
    assert first["parameters"]["coefficient"]["value"] == pytest.approx(0.02 / 3, rel=1e-9)
    assert first["value"] == pytest.approx(0.02 / 3, rel=1e-9)
    assert (first["was"], first["options"], first["made"]) == (0.0, {}, True)
    assert first["reduction"] > 1 - 1e-9
    assert setting_name(first) == "damping.hinge 0 → 0.00666667 N·m/(rad/s) of b (viscous friction at theta)"


def test_what_the_engine_cannot_be_told_is_measured_in_its_equations(meet):
    """DART has no inertia of motors; equations that have it are what DART's would be."""
    heavy = "(-3*g/(2*l)*sin(theta) + 3*torque/(m*l**2))/1.06"
    summary, _ = meet(engine("dart"), law(heavy))
    first = summary["explained_by"][0]
    assert (first["effect"], first["site"], first["options"], first["made"]) == ("parameter", "armature_hinge", {}, False)
    assert first["value"] == pytest.approx(0.02, rel=1e-9)
    assert first["reduction"] > 1 - 1e-9
    assert closed(summary)
    assert setting_name(first) == "armature_hinge 0 → 0.02 kg·m² of a"


def test_engines_that_agree_are_not_diagnosed(meet, tmp_path):
    summary, _ = meet(engine("mujoco"), engine("dart"))
    assert summary["explained_by"] == []
    assert not told(tmp_path)


TIED = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="hinge" axis="0 -1 0"/>
  <inertial pos="0 0 -0.5" mass="1" diaginertia="0.0833333333333 0.0833333333333 0.001"/></body></worldbody>
  <tendon><fixed limited="true" range="-50 50"><joint joint="hinge" coef="1"/></fixed></tendon></mujoco>"""


@pytest.mark.exam
def test_what_cannot_be_diagnosed_is_searched_setting_by_setting(meet, tmp_path):
    """A tendon, if only one that never tightens, is no law of a tree of bodies."""
    path = tmp_path / "tied.xml"
    path.write_text(TIED)
    summary, _ = meet(MODEL, engine("mujoco", robot=str(path), substeps=5))
    assert [t["alternatives"] for t in told(tmp_path)] == [[]]
    assert closed(summary)
    assert summary["explained_by"][0]["setting"] == "substeps"


def test_ends_of_a_joint_that_are_far_from_the_points_are_no_obstacle(meet, tmp_path):
    limit = '<limit lower="-3" upper="3" effort="100" velocity="100"/><axis'
    path = tmp_path / "limited.urdf"
    path.write_text(URDF.read_text().replace('type="continuous"', 'type="revolute"').replace("<axis", limit))
    summary, _ = meet(MODEL, engine("mujoco", robot=str(path), substeps=5))
    assert closed(summary)
    assert summary["explained_by"][0]["setting"] == "substeps"
    assert [t["alternatives"] for t in told(tmp_path)] != [[]]


def test_native_parameters_are_set_and_have_a_digest_of_their_own(meet, tmp_path):
    config = gc.registry().config("backend", "mujoco").model_validate(engine("mujoco", period="5 ms"))
    system = gc.registry().build("backend", "mujoco", config, gc.Context())
    given = Given(system, {"damping.hinge": 0.3})
    x, u = np.array([[0.1, 1.0]]), np.zeros((1, 1))
    assert (given.step(x, u).x == system.step(x, u, parameters={"damping.hinge": 0.3}).x).all()
    assert len({given.digest(), system.digest(), Given(system, {"damping.hinge": 0.2}).digest()}) == 3


# --- how a diagnosis stands beside the search


LAW = {"effect": "input-gain", "site": "torque", "parameters": {"gain": {"value": 0.9, "unit": "1", "low": 0.9, "high": 0.9}}}
NAMED = Change("a", "input-gain", {}, {}, told=LAW | {"value": 0.9, "was": None})
OPTION = Change("b", "robot", {"robot": "b"}, {"robot": "a"})


def around(means):
    return lambda changes: Trial(changes, means.get(changes[0].setting, 1.0), means.get(changes[0].setting) == 0.0)


def test_another_robot_is_no_setting_and_comes_last():
    damped = Change("a", "damping.j", {}, {}, natives={"damping.j": 0.1}, told={"value": 0.1, "was": 0.0})
    entries = explain([OPTION], around({"robot": 0.0}), 1.0, 0.01, 0.0, lambda _: [Trial((damped,), 1e-9, False, True, True)])
    assert [e["setting"] for e in entries] == ["damping.j", "robot"]


def test_what_can_be_told_to_one_needs_no_stand_in_in_the_equations_of_the_other():
    drag = Change("b", "drag", {"drag": 0.0}, {"drag": 1.0})
    diagnosed = [Trial((NAMED,), 0.0, True, False, True)]
    entries = explain([drag], around({"drag": 0.0}), 1.0, 0.01, 0.0, lambda _: diagnosed)
    assert [e["setting"] for e in entries] == ["drag"]
    (alone,) = explain([], around({}), 1.0, 0.01, 0.0, lambda _: diagnosed)
    assert (alone["setting"], alone["made"]) == ("input-gain", False)


def test_what_a_diagnosis_names_without_effect_is_not_listed():
    assert explain([], around({}), 1.0, 0.01, 0.0, lambda _: [Trial((NAMED,), 0.999, False, False, True)]) == []


def test_words_and_tables_of_a_law(tmp_path):
    (entry,) = explain([], around({}), 1.0, 0.01, 0.0, lambda _: [Trial((NAMED,), 0.0, True, False, True)])
    assert setting_name(entry) == "input gain at torque (gain 0.9) in a"
    pair = {"a": "a", "b": "b", "mean": 1.0, "max": 1.0, "where": None, "explained_by": [entry]}
    write_tables({"rows": [], "unavailable": [], "pairs": [pair]}, tmp_path)
    with open(tmp_path / "settings.csv", encoding="utf-8", newline="") as file:
        (line,) = csv.DictReader(file)
    assert (line["effect"], line["site"], line["made"]) == ("input-gain", "torque", "False")
    assert json.loads(line["parameters"])["gain"]["value"] == 0.9
