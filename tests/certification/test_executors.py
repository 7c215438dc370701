"""Executors of this machine: what they survive, and that threads share no system."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from concurrent.futures import BrokenExecutor, Executor, Future
from pathlib import Path

import numpy as np
import pytest

import gapcert as gc
from gapcert.certification.samples.executors import Kept, named, processes, threads
from gapcert.certification.samples.store import Store
from gapcert.testing.toys import Drift, Perturbed, ripple

DEADLY = '''
import os, signal
from contextlib import suppress
from pathlib import Path
from gapcert.testing.toys import ripple

class Deadly:
    """The ripple, whose worker dies in the middle of a chunk, `times` times in all."""

    def __init__(self, folder, times):
        self.folder, self.times = folder, times

    def __call__(self, z):
        for death in range(self.times if z[0, 0] > 0 else 0):
            with suppress(FileExistsError):  # no two workers die the same
                Path(self.folder, f"death-{death}").touch(exist_ok=False)
                os.kill(os.getpid(), signal.SIGKILL)
        return ripple(z)
'''


def cover() -> gc.plugin.Cover:
    return gc.plugin.Cover(gc.Domain.of(Drift(1), {"x0": (-1, 1), "u0": (-2, 2)}), (40, 50))


def store(folder, perturbation, executor, **options):
    model = Drift(1)
    return Store(
        folder, gc.plugin.Residual(Perturbed(model, perturbation), model), "key", executor, **{"chunk": 100, **options}
    )


def answers():
    return gc.plugin.Residual(Perturbed(Drift(1), ripple), Drift(1))(cover().chunk(0, 2000))


@pytest.fixture
def deadly(tmp_path, monkeypatch):
    (tmp_path / "deadly_module.py").write_text(DEADLY)
    monkeypatch.syspath_prepend(str(tmp_path))
    import deadly_module

    return lambda times: deadly_module.Deadly(str(tmp_path), times)


@pytest.mark.exam
@pytest.mark.fault(
    "workers are killed (SIGKILL, the out-of-memory killer) amid their chunks", shows="they are replaced; the same residuals"
)
def test_workers_killed_in_the_middle_of_a_chunk_are_survived(tmp_path, deadly):
    heard = []
    # Both in one pool, or in two of which the first answers half the chunks: never two pools in a row for nothing.
    r = store(tmp_path / "a", deadly(2), lambda: processes(2), emit=heard.append).collect("r", cover())
    np.testing.assert_array_equal(r, answers())
    assert len(list(tmp_path.glob("death-*"))) == 2
    assert [e.name for e in heard].count("warning") >= 1


class AtOnce(Executor):
    """Answers at once, and breaks at its third chunk."""

    workers, asked = 2, 0

    def submit(self, do, task):
        future = Future()
        self.asked += 1
        if self.asked == 3:
            future.set_exception(BrokenExecutor("the third chunk"))
        else:
            future.set_result(do(task))
        return future


@pytest.mark.unit
def test_what_is_finished_when_a_pool_breaks_is_kept(tmp_path):
    pools, heard = iter([AtOnce(), threads(2)]), []
    r = store(tmp_path / "a", ripple, lambda: next(pools), emit=heard.append).collect("r", cover())
    np.testing.assert_array_equal(r, answers())
    at = [e.name for e in heard].index("warning")
    assert [e.data["done"] for e in heard[:at] if e.name == "progress"] == [100 * n for n in range(6)]  # 5 of the 6 in flight


def test_one_pool_serves_all_rounds_until_its_workers_are_lost(tmp_path, deadly):
    made = []

    def make():
        made.append(processes(2))
        return made[-1]

    with Kept(make) as pools:
        for name in "rs":
            np.testing.assert_array_equal(store(tmp_path / "a", ripple, pools).collect(name, cover()), answers())
        assert len(made) == 1
        lost = list(made[0]._processes)  # a pool starts as many as its chunks need
        np.testing.assert_array_equal(store(tmp_path / "b", deadly(1), pools).collect("r", cover()), answers())
        assert len(made) >= 2
        others = list(made[-1]._processes)
        assert lost
        assert not any(map(alive, lost))
    assert others
    assert not any(map(alive, others))


@pytest.mark.exam
@pytest.mark.fault("a chunk kills every worker that takes it", shows="exit 4, what to try; resumable")
def test_a_chunk_that_kills_every_worker_ends_the_run_resumably(tmp_path, deadly):
    with pytest.raises(gc.GapcertError, match=r"workers died twice in round 'r'.*run the same command again") as error:
        store(tmp_path / "a", deadly(1000), lambda: processes(2)).collect("r", cover())
    assert error.value.exit_code == 4
    np.testing.assert_array_equal(store(tmp_path / "a", deadly(0), lambda: threads(2)).collect("r", cover()), answers())


@pytest.mark.contract
@pytest.mark.fault("the main process alone is killed", shows="its workers end, too")
def test_workers_end_with_a_main_process_that_is_killed_alone(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        textwrap.dedent("""
        import os, time
        from gapcert.certification.samples.executors import processes
        pool = processes(2)
        print(*{pool.submit(os.getpid).result() for _ in range(20)}, flush=True)
        pool.submit(time.sleep, 60)
        time.sleep(60)
        """)
    )
    process = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True)
    workers = [int(pid) for pid in process.stdout.readline().split()]
    assert workers
    process.kill()
    process.communicate()
    end = time.monotonic() + 20
    while any(alive(pid) for pid in workers):
        assert time.monotonic() < end, "workers outlived the process that they worked for"
        time.sleep(0.05)


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


class Scratch:
    """Not safe to share: it keeps what it was asked while it waits for a second thread to ask."""

    meeting = threading.Barrier(2)

    def __call__(self, z):
        self.asked = z
        try:
            self.meeting.wait(30)
        except threading.BrokenBarrierError:
            raise AssertionError("no two chunks were computed at the same time") from None
        return ripple(self.asked)


def test_threads_work_at_once_and_each_has_its_own_system(tmp_path):
    r = store(tmp_path, Scratch(), lambda: threads(2)).collect("r", cover())
    np.testing.assert_array_equal(r, answers())


def test_one_system_for_all_threads_would_mix_answers():
    """Necessity: the system above answers one thread with what another asked."""
    shared, z = Scratch(), cover().chunk(0, 2000)
    with threads(2) as pool:
        halves = list(pool.map(shared, (z[:1000], z[1000:])))
    assert not np.array_equal(np.concatenate(halves), ripple(z))


def test_names_and_addresses():
    pool = named("threads")(3)
    assert pool.workers == 3
    pool.shutdown()
    with pytest.raises(gc.UsageError, match=r"threads works on this machine alone and takes no address; write 'threads'"):
        named("threads:tcp://somewhere:1")
    with pytest.raises(gc.UsageError, match="no plugin provides executor 'proceses'"):
        named("proceses")


def test_the_run_folder_does_not_depend_on_who_computes(tmp_path):
    def spec(**sampling):
        model = {"kind": "equations", "states": {"x": "m"}, "inputs": {"u": "m"}, "next": {"x": "0.5*x + u"}, "period": "1 s"}
        return gc.load_spec(
            {
                "version": 1,
                "name": "who",
                "model": model,
                "backend": model,
                "domain": {"x": [-1, 1], "u": [-1, 1]},
                "sampling": {"kind": "adaptive", "budget": 30, **sampling},
                "certificate": {"claim": "empirical"},
            }
        )

    assert spec(executor="threads").digest == spec(executor="processes", workers=2).digest == spec().digest
    assert spec(budget=31).digest != spec().digest


@pytest.mark.fault("Ctrl-C reaches the whole process group", shows="chunks in flight are finished")
def test_ctrl_c_does_not_kill_workers(tmp_path):
    """Workers ignore it, so that chunks in flight are written before the main process answers."""
    with processes(1) as pool:
        pid = pool.submit(os.getpid).result()
        os.kill(pid, signal.SIGINT)
        assert pool.submit(os.getpid).result() == pid
