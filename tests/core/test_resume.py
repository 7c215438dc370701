"""SIGKILL at ten random moments each: the published grid and an adaptive run end in the bits of an uninterrupted one."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.needs("pybullet")

SPEC = Path(__file__).parents[2] / "specs" / "pendulum.yaml"

RUNS = """
import os, sys
from pathlib import Path
import gapcert as gc
from gapcert.certify import certify
from gapcert.sampling import AdaptiveSampling, GridSampling, Store, processes

spec = gc.load_spec(sys.argv[1])
model = spec.build("model")
backend = spec.build("backend", model=model)
domain = gc.Domain.of(model, spec.config.domain)

def grid(folder):
    store = Store(folder, gc.Residual(backend, model), "key", processes)
    store.collect("bound-0", GridSampling.covering(domain, 0.0022, 0.01).first(domain))
    return store.counts["bound-0"], store.digests["bound-0"]

def adaptive(folder):
    # Small chunks, so that every round has shards to lose.
    c = certify(model, backend, domain, sampling=AdaptiveSampling(300, chunk=60), folder=folder / "run")
    c.save(folder / "run")
    return sorted(c.digests.items()), c.audit.k, c.summary()["states"]

# A process for each line, forked before any engine has started: what all import is imported once.
for line in sys.stdin:
    if (run := os.fork()) == 0:
        os.setsid()
        Path(line.strip() + ".said").write_text(str(globals()[sys.argv[2]](Path(line.strip()))))
        os._exit(0)
    print(run, flush=True)
    os.waitpid(run, 0)
    print("ended", flush=True)
"""


class Runs:
    """Processes that make the same run, each in a folder of its own choice."""

    def __init__(self, which: str) -> None:
        command = [sys.executable, "-c", RUNS, SPEC, which]
        self.host = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def start(self, folder: Path) -> int:
        """The process, which leads a group of its own."""
        self.host.stdin.write(f"{folder}\n")
        self.host.stdin.flush()
        return int(self.host.stdout.readline())

    def end(self) -> None:
        """Waits until the process that was started last has ended."""
        assert self.host.stdout.readline() == "ended\n"

    def whole(self, folder: Path) -> str:
        """What an undisturbed process says."""
        self.start(folder)
        self.end()
        return Path(f"{folder}.said").read_text()


def shards(folder: Path) -> int:
    return len(list(folder.rglob("chunk-*.npy")))


@pytest.mark.exam
@pytest.mark.parametrize(("which", "most"), [("grid", 1), ("adaptive", 24)], ids=["2,076,900 grid points", "adaptive"])
def test_killed_ten_times(tmp_path, which, most):
    """Each time once up to `most` further shards are there, and a random moment later."""
    made, killed = Runs(which), tmp_path / "killed"
    rng = np.random.default_rng(20)
    unfinished = 0
    for _ in range(10):
        wanted = shards(killed) + rng.integers(1, most + 1)
        process = made.start(killed)
        while shards(killed) < wanted and Path(f"/proc/{process}").exists():
            time.sleep(0.002)
        time.sleep(0.02 * rng.random())
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process, signal.SIGKILL)
            unfinished += 1
        made.end()
    assert unfinished >= 8, "the kills came too late to test anything"
    with made.host:  # which ends with its input
        assert made.whole(killed) == made.whole(tmp_path / "whole") != ""
