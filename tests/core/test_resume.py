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

HEAD = """
import sys
from pathlib import Path
import gapcert as gc
from gapcert.sampling import GridSampling, Store, processes

def parts():
    spec = gc.load_spec(sys.argv[2])
    model = spec.build("model")
    backend = spec.build("backend", model=model)
    return model, backend, gc.Domain.of(model, spec.config.domain)
"""
GRID = (
    HEAD
    + """
if __name__ == "__main__":
    model, backend, domain = parts()
    store = Store(Path(sys.argv[1]), gc.Residual(backend, model), "key", processes)
    store.collect("bound-0", GridSampling.covering(domain, 0.0022, 0.01).first(domain))
    print(store.counts["bound-0"], store.digests["bound-0"])
"""
)
ADAPTIVE = (
    HEAD
    + """
from gapcert.sampling import AdaptiveSampling

if __name__ == "__main__":
    model, backend, domain = parts()
    # Small chunks, so that every round has shards to lose.
    c = gc.certify(model, backend, domain, sampling=AdaptiveSampling(300, chunk=60), folder=Path(sys.argv[1]) / "run")
    c.save(Path(sys.argv[1]) / "run")
    print(sorted(c.digests.items()), c.audit.k, c.summary()["states"])
"""
)


def start(script: Path, folder: Path, **options) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, script, folder, SPEC], stdout=subprocess.PIPE, text=True, **options)


def shards(folder: Path) -> int:
    return len(list(folder.rglob("chunk-*.npy")))


@pytest.mark.exam
@pytest.mark.parametrize(("text", "most"), [(GRID, 1), (ADAPTIVE, 24)], ids=["2,076,900 grid points", "adaptive"])
def test_killed_ten_times(tmp_path, text, most):
    """Each time once up to `most` further shards are there, and a random moment later."""
    script = tmp_path / "script.py"
    script.write_text(text)
    rng = np.random.default_rng(20)
    unfinished = 0
    for _ in range(10):
        wanted = shards(tmp_path / "killed") + rng.integers(1, most + 1)
        process = start(script, tmp_path / "killed", start_new_session=True)
        while shards(tmp_path / "killed") < wanted and process.poll() is None:
            time.sleep(0.002)
        time.sleep(0.02 * rng.random())
        unfinished += process.poll() is None
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
    assert unfinished >= 8, "the kills came too late to test anything"
    resumed = start(script, tmp_path / "killed").communicate()[0]
    whole = start(script, tmp_path / "whole").communicate()[0]
    assert whole
    assert resumed == whole
