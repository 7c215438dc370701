"""SIGKILL at ten random moments each: the published grid and an adaptive run end in the bits of an uninterrupted one."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import sigkill

pytestmark = pytest.mark.needs("pybullet")

SPEC = Path(__file__).parents[2] / "specs" / "pendulum.yaml"

RUNS = """
import sigkill, os, sys
from pathlib import Path
import gapcert as gc
from gapcert.certification.certify import certify
from gapcert.certification.samples.designs import AdaptiveSampling, GridSampling
from gapcert.certification.samples.executors import processes
from gapcert.certification.samples.store import Store

spec = gc.load_spec(sys.argv[1])
model = spec.build("model")
backend = spec.build("backend", model=model)
domain = gc.Domain.of(model, spec.config.domain)

def grid(folder):
    store = Store(folder, gc.plugin.Residual(backend, model), "key", processes, chunk=20_000)
    store.collect("bound-0", GridSampling.covering(domain, 0.0022, 0.01).first(domain))
    return store.counts["bound-0"], store.digests["bound-0"]

def adaptive(folder):
    # Small chunks, so that every round has shards to lose.
    c = certify(model, backend, domain, sampling=AdaptiveSampling(300, chunk=60), folder=folder / "run")
    c.save(folder / "run")
    return sorted(c.digests.items()), c.audit.k, c.summary()["states"]

# A process for each line, forked before any engine has started: what all import is imported once.
for line in sys.stdin:
    folder, *order = line.split()
    if (run := os.fork()) == 0:
        os.setsid()
        if order:
            sigkill.armed(*order)
        Path(folder + ".said").write_text(str(globals()[sys.argv[2]](Path(folder))))
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(run, 0)[1]), flush=True)
"""


class Runs:
    """Processes that make the same run, each in a folder of its own choice."""

    def __init__(self, which: str) -> None:
        command = [sys.executable, "-c", RUNS, SPEC, which]
        self.host = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=sigkill.ENV)

    def code(self, folder: Path, order: str = "") -> int:
        """How one ends, which leads a group of its own."""
        self.host.stdin.write(f"{folder} {order}\n")
        self.host.stdin.flush()
        return int(self.host.stdout.readline())

    def whole(self, folder: Path) -> str:
        """What an undisturbed one says."""
        assert self.code(folder) == 0
        return Path(f"{folder}.said").read_text()


@pytest.mark.exam
@pytest.mark.parametrize(("which", "most"), [("grid", 4), ("adaptive", 24)], ids=["2,076,900 grid points", "adaptive"])
def test_killed_ten_times(tmp_path, which, most):
    made, rng = Runs(which), np.random.default_rng(20)
    for _ in range(10):
        assert made.code(tmp_path / "killed", sigkill.order(rng, (1, most + 1))) == -signal.SIGKILL
    with made.host:  # which ends with its input
        assert made.whole(tmp_path / "killed") == made.whole(tmp_path / "whole") != ""
