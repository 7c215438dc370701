"""Real measurements with a known cause: the specs that ship are their own regression tests."""

import json
from pathlib import Path

import pytest
from commands import command

SPECS = Path(__file__).parents[2] / "specs" / "diagnose"


@pytest.fixture
def diagnosed(tmp_path, capfd):
    """What the command says of a spec, which meets all that it expects."""
    pytest.importorskip("numba")

    def answered(name, *more):
        silent = ["--set", "report.html=false", "--set", "report.rerun=false", "--out", str(tmp_path)]
        done = command(capfd, "diagnose", SPECS / f"{name}.yaml", "--json", *silent, *more)
        assert done.code == 0, done.err
        found = json.loads(done.out)
        assert all(e["met"] for e in found.get("expectations", ()))
        return found

    return answered


@pytest.mark.exam
@pytest.mark.parametrize("name", ["linear_drive", "single_pendulum_decay", "double_pendulum_free", "silverbox"])
def test_a_real_cause_is_named_or_none(name, diagnosed):
    diagnosed(name)


@pytest.mark.exam
def test_a_robot_file_explains_a_real_log_as_its_equations_do(diagnosed):
    pytest.importorskip("mujoco")
    dry = "--set", "diagnose.effects=[coulomb-friction]"
    published, file = (diagnosed(f"double_pendulum_c0{end}", *dry) for end in ("", "_mjcf"))
    assert {c["native"] for c in file["causes"]} == {"frictionloss.shoulder", "frictionloss.elbow"}
    for q in ("q1", "q2"):
        assert file["gain"]["0.4"][q]["after"] <= 1.1 * published["gain"]["0.4"][q]["after"]


@pytest.mark.exam
@pytest.mark.parametrize(("name", "package"), [("", "mujoco"), ("_pybullet", "pybullet"), ("_dart", "dartpy")])
def test_the_friction_of_a_tossed_cube_is_named(name, package, diagnosed):
    """As the spec expects; in DART from an eighth of its tosses, and by contact friction and settings alone."""
    pytest.importorskip(package)
    fewer = ("--set", "diagnose.train.every=16", "--set", "diagnose.effects=[contact-friction]") if name == "_dart" else ()
    diagnosed(f"cube_toss{name}", *fewer)
