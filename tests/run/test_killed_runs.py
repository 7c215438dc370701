"""Runs that are killed: listed as interrupted, watched, and resumed from their folders alone to the same bits."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import sigkill

from gapcert.cli.main import main
from gapcert.run import journal
from gapcert.run.status import standing

SPEC = """\
version: 1
name: long
model:
  kind: equations
  states: {x: m, v: m/s}
  inputs: {u: m/s^2}
  parameters: {k: 0.1 1/s^2, c: 0.01 1/m}
  derivative: {x: v, v: u - k*x}
  integrator: euler
  period: 20 ms
backend:
  kind: equations
  states: {x: m, v: m/s}
  inputs: {u: m/s^2}
  parameters: {k: 0.1 1/s^2, c: 0.01 1/m}
  derivative: {x: v, v: u - k*x - c*v*v}
  integrator: euler
  period: 20 ms
domain: {x: [-1, 1], v: [-1, 1], u: [-1, 1]}
sampling: {kind: grid, counts: {x: 100, v: 100, u: 80}, chunk: 400, executor: threads, workers: 1}
lipschitz: {residual: {kind: interval}}
gap: {kind: constant}
certificate: {claim: deterministic, route: theorem1}
report: {html: false, rerun: false}
"""


COMMAND = "import sigkill, sys; from gapcert.cli.main import main; sys.exit(main(sys.argv[1:]))"


def gapcert(*arguments, **environment):
    """A process group of its own, so that a kill takes the workers, too."""
    command, into = [sys.executable, "-c", COMMAND, *map(str, arguments)], subprocess.PIPE
    return subprocess.Popen(command, stdout=into, stderr=into, text=True, start_new_session=True, env=sigkill.ENV | environment)


def killed(process):
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


def until(condition, process, limit=120.0):
    end = time.monotonic() + limit
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.02)


def bits(folder):
    """What a run has found, and the samples behind it."""
    found = {}
    for name in ("certificate.json", "certificate.npz"):
        found[name] = (folder / name).read_bytes()
    summary = json.loads((folder / "summary.json").read_text())
    return found | {"summary": {k: v for k, v in summary.items() if k not in ("timings", "run_dir")}}


@pytest.mark.exam
def test_a_killed_run_is_listed_watched_and_resumed_to_the_same_bits(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("long.yaml").write_text(SPEC)
    # Two at once: one that is left alone, one that halts amid its samples, to be looked at and killed.
    whole, run = (
        gapcert("run", "long.yaml", "--out", "whole", "-q"),
        gapcert("run", "long.yaml", "--out", "cut", "-q", SIGKILL_AFTER="500 1.1 halt"),
    )
    assert os.waitid(os.P_PID, run.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT).si_status == signal.SIGSTOP
    (folder,) = Path("cut").glob("long-*")
    assert standing(folder).share
    watched, kept = gapcert("watch", folder, "--json"), gapcert("watch", folder, "--keep")
    seen = json.loads(watched.stdout.readline())
    assert (seen["event"], seen["pid"]) == ("run-started", run.pid)
    assert main(["runs", "--out", "cut"]) == 0
    assert f"(process {run.pid})" in (listed := capsys.readouterr().out)
    assert "running, sampling bound-0" in listed
    killed(run)
    named = (folder / "samples/bound-0/manifest.jsonl").read_text().count('"chunk":')  # a shard counts once this names it

    out, err = watched.communicate(timeout=60)
    last = json.loads(out.splitlines()[-1])
    assert (watched.returncode, last["state"], last["exit_code"]) == (4, "interrupted", 4)
    assert "interrupted in sampling bound-0 at " in err
    assert main(["runs", "--out", "cut", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert (row["state"], row["stage"]) == ("interrupted", "sampling bound-0")
    assert 0 < row["share"] < 1

    resumed = gapcert("runs", "resume", folder, "-q")
    until(lambda: any(line.get("again") for line in journal.read(folder / journal.NAME)), resumed)
    assert standing(folder).state == "running"
    out, err = resumed.communicate(timeout=200)
    assert resumed.returncode == 0, err
    assert "long: holds" in out

    out, err = kept.communicate(timeout=60)
    assert kept.returncode == 0
    assert "interrupted in sampling bound-0" in err
    assert "began the run, which goes on" in err
    assert "finished: holds" in err
    assert "long: holds" in out

    assert whole.wait(timeout=200) == 0
    whole.communicate()
    (other,) = Path("whole").glob("long-*")
    assert bits(folder) == bits(other)
    first = next(line for line in journal.read(folder / journal.NAME) if line.get("again") is False)
    assert first["pid"] == run.pid
    sampled = [line for line in standing(folder).session if line["event"] == "progress" and line["stage"] == "sampling bound-0"]
    assert named >= 500
    assert sampled[0]["done"] >= 400 * (named - 1), "what was sampled before is not sampled again"
