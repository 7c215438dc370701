"""A comparison that is killed goes on, on another executor, to the digests of one that was not; and the shipped spec holds."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import sigkill

from gapcert.cli.main import main

SPECS = Path(__file__).parents[2] / "specs"
SPEC = """\
version: 1
name: killed
model: {model}
domain: {domain}
sampling: {{kind: adaptive, budget: 40, chunk: 4000, executor: threads}}
report: {{html: false, rerun: false}}
compare:
  backends:
    one: {one}
    two: {two}
    three: {three}
  families: [envelope]
  lipschitz: [{{kind: wood-zhang, safety: 1.2}}]
  pairs: {{points: 500, rollouts: 5, steps: 50, cells: 10}}
"""


def text() -> str:
    model = {
        "kind": "equations",
        "states": {"theta": {"unit": "rad", "kind": "angle"}, "omega": "rad/s"},
        "inputs": {"torque": "N*m"},
        "parameters": {"m": "1 kg", "l": "1 m", "g": "9.81 m/s^2"},
        "derivative": {"theta": "omega", "omega": "-3*g/(2*l)*sin(theta) + 3*torque/(m*l**2)"},
        "period": "5 ms",
    }
    domain = {"theta": [-0.2, 0.2], "omega": [-0.25, 0.25], "torque": [-1, 1]}
    made = {n: json.dumps(model | {"integrator": i}) for n, i in (("model", "euler"), ("one", "semi_implicit"))}
    made |= {"two": json.dumps(model | {"integrator": "rk4"}), "three": json.dumps(model | {"integrator": "euler"})}
    return SPEC.format(domain=json.dumps(domain), **made)


def compared(spec: Path, out: Path, *more: str) -> list[str]:
    start = "import sigkill, sys; from gapcert.cli.main import main; sys.exit(main(sys.argv[1:]))"
    return [sys.executable, "-c", start, "compare", str(spec), "--json", "--quiet", "--out", str(out), *more]


@pytest.mark.fault("a comparison is killed, and goes on with another executor", shows="the same digests")
@pytest.mark.exam
def test_killed_and_resumed_with_another_executor(tmp_path):
    spec = tmp_path / "killed.yaml"
    spec.write_text(text())
    whole = json.loads(sigkill.whole(compared(spec, tmp_path / "whole")).stdout)
    rng = np.random.default_rng(4)
    for _ in range(4):
        sigkill.killed(compared(spec, tmp_path / "killed"), rng, (1, 9))
    resumed = json.loads(sigkill.whole(compared(spec, tmp_path / "killed", "--executor", "processes")).stdout)
    assert resumed["digest"] == whole["digest"]
    assert resumed["pairs"] == whole["pairs"]
    for row in (*resumed["rows"], *whole["rows"]):
        del row["cpu_s"]
    assert resumed["rows"] == whole["rows"]


@pytest.mark.exam
def test_the_shipped_spec_meets_what_it_expects(tmp_path, capsys):
    pytest.importorskip("pybullet", reason="needs the pybullet extra")
    assert main(["compare", str(SPECS / "compare.yaml"), "--json", "--quiet", "--out", str(tmp_path)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert all(e["met"] for e in found["expectations"])
    against = [p for p in found["pairs"] if "pybullet" in (p["a"], p["b"])]
    assert len(against) == len(found["backends"]) - 1
    for pair in against:
        first = pair["explained_by"][0]
        assert (first["setting"], first["was"], first["value"], first["on"]) == ("damping", 0.04, 0.0, "pybullet")
        assert first["options"] == {"linear_damping": 0.0, "angular_damping": 0.0}
        assert first["reduction"] > 1 - 1e-9
    assert all(p["max"] <= 1e-15 for p in found["pairs"] if p not in against)
