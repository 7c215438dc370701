"""Executor `dask`: the same bits as any other, whatever is killed, and nothing left behind."""

import contextlib
import os
import signal
import sys
import tempfile
import time
from concurrent.futures import BrokenExecutor
from pathlib import Path

import numpy as np
import pytest
import sigkill

import gapcert as gc
from gapcert.certification.samples.executors import named, threads
from gapcert.certification.samples.store import Store
from gapcert.cli.main import main
from gapcert.testing.toys import Drift, Perturbed, ripple

pytestmark = [pytest.mark.needs("distributed"), pytest.mark.contract]


def cover(*counts) -> gc.plugin.Cover:
    return gc.plugin.Cover(gc.Domain.of(Drift(1), {"x0": (-1, 1), "u0": (-2, 2)}), counts or (40, 50))


def store(folder, executor, **options):
    model = Drift(1)
    return Store(folder, gc.plugin.Residual(Perturbed(model, ripple), model), "key", executor, **{"chunk": 100, **options})


def answers():
    return gc.plugin.Residual(Perturbed(Drift(1), ripple), Drift(1))(cover().chunk(0, 2000))


def children(pid: int) -> list[int]:
    found = [int(c) for t in Path(f"/proc/{pid}/task").iterdir() for c in (t / "children").read_text().split()]
    return found + [grandchild for c in found for grandchild in children(c)]


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory):
    return tmp_path_factory.mktemp("working-folder")


@pytest.fixture(scope="module")
def cluster(elsewhere):
    """One local cluster for all tests that do not end it, started in a working folder of its own."""
    with contextlib.chdir(elsewhere):
        pool = named("dask")(2)
    yield pool
    pool.shutdown(cancel_futures=True)


class Borrowed:
    """An executor that outlives its rounds."""

    def __init__(self, pool):
        self.pool, self.workers, self.remote = pool, pool.workers, pool.remote

    def submit(self, *task):
        return self.pool.submit(*task)

    def shutdown(self, **options):
        pass


def test_the_same_bits_as_threads_for_grids_and_for_points(tmp_path, cluster):
    a, b = store(tmp_path / "a", lambda: Borrowed(cluster)), store(tmp_path / "b", lambda: threads(2))
    points = gc.plugin.Points(cover().domain.draw(450, np.random.default_rng(0)))
    for one in (a, b):
        one.collect("grid", cover())
        one.collect("points", points)
    assert a.digests == b.digests


def test_nothing_is_left_in_the_working_folder(cluster, elsewhere):
    assert cluster.submit(os.getcwd).result() == str(elsewhere)
    assert list(elsewhere.iterdir()) == []


def test_a_cluster_at_an_address_sends_its_shards_back(tmp_path, cluster):
    """Its workers may be elsewhere, so none of them writes into the run folder."""
    address = cluster._client.scheduler.address
    writers = tmp_path / "b"
    there = store(writers, lambda: named(f"dask:{address}")(None))
    np.testing.assert_array_equal(there.collect("r", cover()), answers())
    here = store(tmp_path / "a", lambda: threads(1))
    here.collect("r", cover())
    assert there.digests == here.digests
    pool = named(f"dask:{address}")(None)
    assert (pool.remote, pool.workers, cluster.remote) == (True, 2, False)
    pool.shutdown(cancel_futures=True)
    assert cluster.submit(pow, 2, 10).result() == 1024  # it is not ours to end


@pytest.mark.fault("no Dask scheduler answers at the address", shows="the address and what to start")
def test_an_address_where_nobody_answers(monkeypatch):
    import gapcert_dask.executor as module

    monkeypatch.setattr(module, "WAIT", 0.2)
    with pytest.raises(gc.UsageError, match=r"no scheduler answers at tcp://127.0.0.1:9 .*start one with `dask scheduler`"):
        named("dask:tcp://127.0.0.1:9")(None)
    with pytest.raises(gc.UsageError, match="no scheduler answers at nowhere"):
        named("dask:nowhere")(None)


def test_an_error_in_a_chunk_stays_itself(tmp_path, cluster):
    with pytest.raises(gc.UsageError, match="the residual at"):
        store(tmp_path, lambda: Borrowed(cluster)).collect("r", gc.plugin.Points(np.full((300, 2), 1e308)))


@pytest.mark.exam
@pytest.mark.fault("Dask workers, then the whole cluster are killed", shows="replaced; then resumable by another executor")
def test_workers_and_then_the_whole_cluster_are_killed(tmp_path):
    """A worker killed mid-chunk is replaced by Dask, a lost scheduler by a new cluster; the bits are the same."""
    made, heard = [], []

    def executor():
        made.append(named("dask")(2))
        return made[-1]

    def emit(event):
        heard.append(event)
        done = event.data.get("done", 0)
        if done in (160, 320):  # of 2000: many more chunks than are asked for at a time
            host = made[-1]._host_process
            workers = [c for c in children(host.pid) if b"spawn_main" in Path(f"/proc/{c}/cmdline").read_bytes()]
            os.kill(workers[0] if done == 160 else host.pid, signal.SIGKILL)

    one = store(tmp_path / "a", executor, emit=emit, chunk=20)
    one.collect("r", cover())
    here = store(tmp_path / "b", lambda: threads(1), chunk=20)
    here.collect("r", cover())
    assert one.digests == here.digests
    assert len(made) == 2
    assert [e.name for e in heard].count("warning") == 1


def test_a_chunk_that_kills_every_worker_is_a_broken_executor(cluster):
    with pytest.raises(BrokenExecutor, match="those workers died while running it"):
        cluster.submit(os._exit, 3).result()
    assert cluster.submit(pow, 2, 10).result() == 1024


@pytest.mark.fault("the Dask scheduler is lost between two questions", shows="that it was lost, at once, to all that wait")
def test_no_question_outlives_the_scheduler(tmp_path, monkeypatch):
    """Dask's client leaves those unanswered that it is asked while it looks for the scheduler, and after."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    pool = named("dask")(1)
    assert pool.submit(pow, 2, 10).result() == 1024
    pool._client._timeout = 0.5  # s, for which it looks
    before = pool.submit(time.sleep, 600)
    os.kill(pool._host_process.pid, signal.SIGKILL)
    while pool._client.status == "running":
        time.sleep(0.001)
    with pytest.raises(BrokenExecutor, match="connection to Dask's scheduler was lost"):
        pool.submit(pow, 2, 10).result(60)
    with pytest.raises(BrokenExecutor, match="connection to Dask's scheduler was lost"):
        before.result(60)
    while pool._client.status != "closed":
        time.sleep(0.001)
    with pytest.raises(BrokenExecutor, match="connection to Dask's scheduler was lost"):
        pool.submit(pow, 2, 10).result(60)
    pool.shutdown(cancel_futures=True)
    assert list(tmp_path.iterdir()) == []


CHAIN = """
import sigkill, sys
from pathlib import Path
import gapcert as gc
from gapcert.certification.samples.executors import named
from gapcert.certification.samples.extremes import Extremes
from gapcert.certification.samples.store import Store
from gapcert.testing.toys import Drift, Perturbed, ripple

model = Drift(1)
domain = gc.Domain.of(model, {"x0": (-1, 1), "u0": (-2, 2)})
folder, name, keep = sys.argv[1:]
s = Store(Path(folder), gc.plugin.Residual(Perturbed(model, ripple), model), "key", lambda: named(name)(2), chunk=4000)
samples = s.samples("r", gc.plugin.Cover(domain, (1000, 800)), Extremes(domain, (10, 10)) if keep == "extremes" else None)
print(s.digests["r"], len(samples), samples.r.sum().hex())
"""


@pytest.mark.exam
@pytest.mark.parametrize("keep", ["extremes", "all"])
def test_killed_and_resumed_with_the_executors_exchanged(tmp_path, keep):
    script = tmp_path / "script.py"  # without a main guard: workers must not run it
    script.write_text(CHAIN)
    rng = np.random.default_rng(11)
    # Sometimes the main process alone: its workers and its cluster must follow it.
    for executor, whom in (("processes", "all"), ("dask", "one"), ("threads", "all"), ("dask", "all"), ("processes", "one")):
        sigkill.killed([sys.executable, script, tmp_path / "killed", executor, keep], rng, (5, 30), whom)
    output = [
        sigkill.whole([sys.executable, script, tmp_path / folder, executor, keep])
        for folder, executor in (("killed", "threads"), ("whole", "processes"))
    ]
    assert output[0].stdout == output[1].stdout != ""
    assert output[0].stderr == output[1].stderr == ""


@pytest.mark.exam
def test_an_address_in_the_spec_and_on_the_command_line(tmp_path, cluster, monkeypatch, capsys):
    address = cluster._client.scheduler.address
    model = "{kind: equations, states: {x: m}, inputs: {u: m}, next: {x: 0.5*x + u}, period: 1 s}"
    (tmp_path / "spec.yaml").write_text(
        f"version: 1\nname: small\nmodel: {model}\nbackend: {model}\ndomain: {{x: [-1, 1], u: [-1, 1]}}\n"
        f"sampling: {{kind: grid, counts: {{x: 30, u: 30}}, chunk: 300, keep: extremes, executor: dask:{address}}}\n"
        "lipschitz: {residual: {kind: interval}}\ngap: {kind: constant}\n"
        "certificate: {claim: deterministic, route: theorem1, violation: 0.1, confidence: 0.99}\n"
        "report: {html: false, rerun: false}\n"
    )
    monkeypatch.chdir(tmp_path)
    assert main(["run", "spec.yaml"]) == 0
    shards = {p: p.stat().st_mtime_ns for p in Path("runs").glob("*/samples/bound-0/chunk-*")}
    assert len(shards) == 3
    assert main(["run", "spec.yaml", "--executor", f"dask:{address}"]) == 0
    assert main(["run", "spec.yaml", "--executor", "threads"]) == 0  # the same folder, so nothing is computed again
    assert {p: p.stat().st_mtime_ns for p in Path("runs").glob("*/samples/bound-0/chunk-*")} == shards
    capsys.readouterr()
    assert main(["run", "spec.yaml", "--executor", "threads:tcp://a:1"]) == 2
    assert "takes no address" in capsys.readouterr().err
