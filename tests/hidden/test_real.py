"""Real measurements with a known cause: the specs that ship are their own regression tests."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SPECS = Path(__file__).parents[2] / "specs" / "diagnose"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["linear_drive", "single_pendulum_decay", "double_pendulum_free"])
def test_a_real_cause_is_named_or_none(name, tmp_path):
    pytest.importorskip("numba")
    silent = ["--set", "report.html=false", "--set", "report.rerun=false", "--out", str(tmp_path)]
    command = [sys.executable, "-m", "gapcert", "diagnose", str(SPECS / f"{name}.yaml"), "--json", *silent]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    assert all(e["met"] for e in json.loads(done.stdout)["expectations"])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "package"), [("", "mujoco"), ("_pybullet", "pybullet"), ("_dart", "dartpy")])
def test_the_friction_of_a_tossed_cube_is_named(name, package, tmp_path):
    pytest.importorskip(package)
    silent = ["--set", "report.html=false", "--set", "report.rerun=false", "--out", str(tmp_path)]
    command = [sys.executable, "-m", "gapcert", "diagnose", str(SPECS / f"cube_toss{name}.yaml"), "--json", *silent]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1800, check=False)
    assert done.returncode == 0, done.stderr
    assert all(e["met"] for e in json.loads(done.stdout)["expectations"])
