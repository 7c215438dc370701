"""What a user can get wrong ends in one clear sentence, exit code 2 or 3, and no traceback."""

import importlib.util
import json
import os
import re
import shutil
from pathlib import Path

import pytest
from commands import command

from gapcert.cli.main import main

ROOT = Path(__file__).parents[2]
PENDULUM = ROOT / "specs" / "pendulum.yaml"
DIAGNOSE = ROOT / "specs" / "diagnose" / "pendulum.yaml"
GOAL = "controller.goal.invariance.theta"

# name: (spec, --set, part of the sentence)
SPECS = {
    "unknown kind": (PENDULUM, "gap.kind=envelop", "did you mean 'envelope'"),
    "unknown key": (PENDULUM, "certificate.clam=empirical", "did you mean 'claim'"),
    "wrong unit": (PENDULUM, 'domain.torque=["-1 rad/s", "1 rad/s"]', "N"),
    "wrong unit in an equation": (PENDULUM, "model.derivative.omega=torque", "unit"),
    "empty box": (PENDULUM, "domain.theta=[0.1, 0.1]", "empty"),
    "inverted box": (PENDULUM, "domain.theta=[0.2, -0.2]", "inverted"),
    "not a number": (PENDULUM, "domain.theta=[.nan, 0.2]", "finite"),
    "infinite": (PENDULUM, "domain.omega=[-.inf, 0.25]", "finite"),
    "missing robot file": (PENDULUM, "backend.robot=models/pendulu.urdf", "pendulu.urdf"),
    "joint not in the file": (PENDULUM, "backend.inputs.torque=hing", "did you mean 'hinge'"),
    "state without a joint": (PENDULUM, "backend.states={theta: hinge.position}", "omega"),
    "basis that cannot be bounded": (PENDULUM, "gap={kind: basis, functions: ['1', '1/theta'], predictor: none}", "1/theta"),
    "goal outside the domain": (PENDULUM, f"{GOAL}=[0, 0.5]", "domain"),
    "claim beyond its ingredients": (PENDULUM, "certificate.claim=deterministic", "wood-zhang"),
    "theorem 1 without a cover": (PENDULUM, "certificate.route=theorem1", "theorem1"),
    "recording without the column": (DIAGNOSE, "recording.columns.theta=angel", "angel"),
    "unknown effect": (DIAGNOSE, "diagnose.effects=[viscous-fricton]", "did you mean 'viscous-friction'"),
    "horizon beyond the data": (DIAGNOSE, "diagnose.horizons=[1000 s]", "horizon"),
}


def one_sentence(capsys, code: int, part: str) -> None:
    err = capsys.readouterr().err
    assert code == 2, err
    assert part in err
    assert "Traceback" not in err
    assert len(err) < 3000


@pytest.mark.parametrize("name", SPECS)
def test_bad_specs(name, tmp_path, capsys):
    spec, change, part = SPECS[name]
    one_sentence(capsys, main(["run", str(spec), "--set", change, "--out", str(tmp_path), "--quiet"]), part)
    assert not list(tmp_path.rglob("certificate.json"))


@pytest.mark.fault("a recording whose time runs back, of NaN, too short or no table", shows="what was found")
@pytest.mark.parametrize(
    ("damage", "part"),
    [
        (lambda rows: [rows[0], *rows[:0:-1]], "time never goes forward"),
        (lambda rows: [rows[0], *(re.sub(r",[^,]*", ",nan", row, count=1) for row in rows[1:])], "holds no finite number"),
        (lambda rows: rows[:3], ""),
        (lambda rows: rows[:1], ""),
        (lambda rows: [], ""),
        (lambda rows: ["not,a,csv\n", '"', *rows], ""),
    ],
    ids=["time runs backwards", "nothing but NaN", "too short", "no rows", "empty file", "not a table"],
)
def test_bad_recordings(damage, part, tmp_path, capsys):
    shutil.copytree(ROOT / "specs", tmp_path / "specs")
    path = tmp_path / "specs" / "data" / "pendulum_hidden.csv"
    path.write_text("".join(damage(path.read_text().splitlines(keepends=True))))
    spec = tmp_path / "specs" / "diagnose" / "pendulum.yaml"
    one_sentence(capsys, main(["diagnose", str(spec), "--out", str(tmp_path / "runs"), "--quiet"]), part)


@pytest.mark.fault("a robot file that is none", shows="the file and the reason")
def test_a_robot_file_that_is_none(tmp_path, capsys):
    (tmp_path / "broken.urdf").write_text("<robot><link")
    change = f"backend.robot={os.path.relpath(tmp_path / 'broken.urdf', PENDULUM.parent)}"
    one_sentence(capsys, main(["run", str(PENDULUM), "--set", change, "--out", str(tmp_path), "--quiet"]), "broken.urdf")


@pytest.mark.fault("a file lies where the folder for runs should be", shows="choose another with --out")
def test_an_unwritable_folder(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    one_sentence(capsys, main(["run", str(PENDULUM), "--out", str(tmp_path / "file" / "runs"), "--quiet"]), "--out")


def test_a_run_folder_of_another_spec(tmp_path, capsys):
    from gapcert import load_spec

    folder = tmp_path / f"pendulum-{load_spec(PENDULUM).digest[:8]}"
    folder.mkdir()
    (folder / "run.json").write_text(json.dumps({"spec": "0" * 64}))
    one_sentence(capsys, main(["run", str(PENDULUM), "--out", str(tmp_path), "--quiet"]), "belongs to another spec")


def test_code_is_refused_unless_allowed(tmp_path, capsys):
    states = "{theta: rad, omega: rad/s}"
    change = f"model={{kind: python, function: 'os:system', states: {states}, inputs: {{torque: N*m}}, period: 5 ms}}"
    one_sentence(capsys, main(["run", str(PENDULUM), "--set", change, "--out", str(tmp_path), "--quiet"]), "--allow-code")


@pytest.mark.contract
@pytest.mark.fault("a package of an extra is missing", shows="the line that installs it, exit 3")
def test_a_missing_dependency_is_one_sentence_with_the_install_line(tmp_path, monkeypatch, capfd):
    # A finder that hides pybullet, as on a machine where the extra was not installed.
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "pybullet" else find(name, *a))
    done = command(capfd, "run", PENDULUM, "--out", tmp_path, "--quiet")
    assert done.code == 3, done.err
    assert "pip install 'gapcert[pybullet]'" in done.err
    assert "Traceback" not in done.err
