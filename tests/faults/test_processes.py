"""Processes that are killed, crash, hang, or have no memory, home, locale or terminal: told, resumable, the same bits."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from faults import TINY, clean, digests, gapcert, told, written

import gapcert as gc
from gapcert.certification.samples.executors import processes, threads
from gapcert.certification.samples.store import Store
from gapcert.testing.toys import Drift, Perturbed, ripple

fault, case = pytest.mark.fault, pytest.param

BAD = '''
import ctypes, os, resource, time
from pathlib import Path
from gapcert.testing.toys import ripple

class Bad:
    """The ripple, until a chunk reaches x > 0.5: then what a broken engine does, `times` times in all."""

    def __init__(self, folder, what, times=10**9):
        self.folder, self.what, self.times = folder, what, times

    def __call__(self, z):
        seen = len(list(Path(self.folder).glob("seen-*")))
        if z[0, 0] > 0.5 and seen < self.times:
            Path(self.folder, f"seen-{os.getpid()}-{time.monotonic_ns()}").touch()
            getattr(self, self.what)()
        return ripple(z)

    def segfault(self):
        ctypes.string_at(0)

    def memory(self):
        used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        before = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (used + (64 << 20), before[1]))
        try:
            bytearray(1 << 30)
        finally:
            resource.setrlimit(resource.RLIMIT_AS, before)

    def exit(self):
        os._exit(7)

    def error(self):
        raise ZeroDivisionError("the solver gave up\\nat step 3")

    def hang(self):
        time.sleep(600)
'''


def cover():
    return gc.plugin.Cover(gc.Domain.of(Drift(1), {"x0": (-1, 1), "u0": (-2, 2)}), (40, 50))


def store(folder, perturbation, executor=lambda: processes(2), **options):
    model = Drift(1)
    return Store(
        folder, gc.plugin.Residual(Perturbed(model, perturbation), model), "key", executor, **{"chunk": 250, **options}
    )


@pytest.fixture
def bad(tmp_path, monkeypatch):
    (tmp_path / "bad_module.py").write_text(BAD)
    monkeypatch.syspath_prepend(str(tmp_path))
    sys.modules.pop("bad_module", None)
    import bad_module

    return lambda *what: bad_module.Bad(str(tmp_path), *what)


def whole(tmp_path):
    made = store(tmp_path / "whole", ripple, lambda: threads(2))
    made.collect("r", cover())
    return made.digests


@pytest.mark.exam
@pytest.mark.parametrize(
    "what",
    [
        case("segfault", id="segfault", marks=fault("an engine's segmentation fault in a worker", shows="another worker")),
        case("exit", id="exit", marks=fault("an engine ends its worker (`exit`)", shows="another worker")),
    ],
)
def test_workers_that_crash_once(tmp_path, bad, what):
    heard = []
    made = store(tmp_path / "a", bad(what, 1), emit=heard.append)
    made.collect("r", cover())
    assert made.digests == whole(tmp_path)
    assert len(list(tmp_path.glob("seen-*"))) == 1
    assert ["workers were lost and are replaced" in e.data["message"] for e in heard if e.name == "warning"] == [True]


@pytest.mark.exam
@pytest.mark.parametrize(
    ("what", "says"),
    [
        case(
            "memory",
            "memory",
            id="memory",
            marks=fault("a worker has too little memory", shows="what to make smaller; resumable"),
        ),
        case(
            "error",
            r"a system failed \(ZeroDivisionError: the solver gave up.*\) among 250 points \(x, u\) from \[",
            id="error",
            marks=fault("an engine raises an error of its own in a worker", shows="the error, and at which points"),
        ),
    ],
)
def test_workers_that_fail(tmp_path, bad, what, says):
    with pytest.raises((gc.GapcertError, MemoryError), match=says if what == "error" else None):
        store(tmp_path / "a", bad(what)).collect("r", cover())
    kept = {p: p.read_bytes() for p in (tmp_path / "a").rglob("chunk-*")}
    assert kept
    again = store(tmp_path / "a", ripple, lambda: threads(2))
    again.collect("r", cover())
    assert again.digests == whole(tmp_path)
    assert all(p.read_bytes() == content for p, content in kept.items())


@pytest.mark.exam
@fault("memory runs out in the main process", shows="what to make smaller, exit 4; what is finished stays")
def test_the_command_without_memory(tmp_path):
    limit = "import gapcert.run.run, resource; resource.setrlimit(resource.RLIMIT_AS, (3 << 30, 3 << 30))"
    spec = written(
        tmp_path, sampling={"kind": "grid", "counts": {"x": 60_000, "u": 60_000}, "executor": "threads", "chunk": 10**9}
    )
    clean(gapcert("run", spec, "--out", tmp_path / "runs", "--quiet", before=limit), 4, "memory ran out")


HANGING = """
import sys
sys.path.insert(0, {folder!r})
import bad_module
from pathlib import Path
import gapcert.certification.samples.executors as executors
import gapcert.certification.samples.store as sampling
from gapcert.cli.main import main
from gapcert.testing.toys import Drift, Perturbed
import gapcert as gc, gapcert.spec.spec
stop = executors.abandon
sampling.abandon = lambda pool: stop(pool, 0.5)
def work(*args, **options):
    model = Drift(1)
    z = gc.Domain.of(model, {{"x0": (-1, 1), "u0": (-2, 2)}})
    system = Perturbed(model, bad_module.Bad({folder!r}, "hang"))
    residual = gc.plugin.Residual(system, model)
    store = sampling.Store(Path({folder!r}) / "a", residual, "key", lambda: executors.processes(2), 250)
    store.collect("r", gc.plugin.Cover(z, (40, 50)))
if __name__ == "__main__":
    gapcert.spec.spec.load_spec = work
    sys.exit(main(["run", "x.yaml"]))
"""


@pytest.mark.run
@pytest.mark.parametrize(
    ("number", "what"),
    [
        case(
            signal.SIGINT,
            "",
            id="Ctrl-C",
            marks=fault("an engine hangs in a worker, and Ctrl-C is pressed", shows="exit 4, soon"),
        ),
        case(signal.SIGTERM, "", id="SIGTERM", marks=fault("a scheduler ends the run (SIGTERM)", shows="exit 4; how to go on")),
    ],
)
def test_what_hangs_can_be_stopped(tmp_path, bad, number, what):
    script = tmp_path / "hanging.py"
    script.write_text(HANGING.format(folder=str(tmp_path)))
    process = subprocess.Popen([sys.executable, script], stderr=subprocess.PIPE, text=True, start_new_session=True)
    end = time.monotonic() + 60
    while not list(tmp_path.glob("seen-*")) and process.poll() is None:
        assert time.monotonic() < end
        time.sleep(0.05)
    os.kill(process.pid, number)
    err = process.communicate(timeout=60)[1]
    assert process.returncode == 4, err
    assert "run the same command again to go on" in err
    assert "Traceback" not in err
    again = store(tmp_path / "a", ripple, lambda: threads(2))
    again.collect("r", cover())
    assert again.digests == whole(tmp_path)


# The processes that are killed begin with what the first of them has imported.
STAGES = """
import os, signal, sys
import gapcert as gc, gapcert.run, gapcert_report.pages.page, gapcert_symbolic.synthesizer

def killed_at(k):
    count = 0
    def observer(event):
        nonlocal count
        count += event.name != "progress"
        if count == k:
            os.kill(os.getpid(), signal.SIGKILL)
    gc.run(sys.argv[1], out=sys.argv[2], observers=[observer])

gc.load_spec(sys.argv[1]).build("model")
for k in range(1, 10):
    if (process := os.fork()) == 0:
        killed_at(k)
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]), flush=True)
"""


@pytest.mark.exam
@fault(
    "the main process is killed (SIGKILL) at every event of a run in turn", shows="the same command ends in the same digests"
)
def test_killed_at_every_stage(tmp_path, small_run):
    from importlib.util import module_from_spec, spec_from_file_location

    found = spec_from_file_location("shared", Path(__file__).parents[1] / "conftest.py")
    shared = module_from_spec(found)
    found.loader.exec_module(shared)
    spec = written(tmp_path, shared.SMALL)
    out = tmp_path / "runs"
    done = subprocess.run([sys.executable, "-c", STAGES, spec, out], capture_output=True, text=True, check=False)
    codes = [int(line) for line in done.stdout.split()]
    assert len(codes) == 9, done.stderr
    assert set(codes) <= {0, -signal.SIGKILL}, done.stderr
    killed = codes.count(-signal.SIGKILL)
    assert killed >= 6
    run = gc.run(spec, out=out)
    assert digests(out) == digests(small_run.folder)
    kept = ("verdict", "certificate", "controller", "closed_loop")
    assert json.dumps({k: run.summary[k] for k in kept}) == json.dumps({k: small_run.summary[k] for k in kept})


@pytest.mark.exam
@fault("no file can be opened any more (`ulimit -n`)", shows="a sentence; with files to open, the same bits")
def test_no_more_open_files(tmp_path, tiny_digests):
    limit = "import gapcert.run.run, gapcert_bounds, resource; resource.setrlimit(resource.RLIMIT_NOFILE, (5, 5))"
    spec = written(tmp_path)
    done = gapcert("run", spec, "--out", tmp_path / "runs", "--quiet", before=limit)
    assert done.returncode == 2, done.stderr
    assert "too many open files" in done.stderr.lower()
    assert "Traceback" not in done.stderr
    gc.run(TINY, out=tmp_path / "runs")
    assert digests(tmp_path / "runs") == tiny_digests


# Which kernels of BLAS run, and so the last bits of a fit, which its audit is drawn by, belongs to the machine.
BARE = {"PATH": os.environ["PATH"], "OMP_NUM_THREADS": "1"} | {k: v for k, v in os.environ.items() if k.startswith("OPENBLAS_")}


@pytest.mark.exam
@fault(
    "no HOME, no TMPDIR, no user, the locale is C and the terminal has no γ", shows="a run like any other; γ is written \\u03b3"
)
def test_a_bare_environment(tmp_path, tiny_digests):
    environment = {**BARE, "LC_ALL": "C", "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = gapcert("run", written(tmp_path), "--out", tmp_path / "runs", env=environment)
    assert done.returncode == 0, done.stderr
    assert "\\u03b3" in done.stdout
    assert digests(tmp_path / "runs") == tiny_digests


@pytest.mark.exam
@pytest.mark.parametrize(
    "how",
    [
        case(">&-", id="closed", marks=fault("standard output is closed", shows="the run ends as ever; the folder has all")),
        case(">/dev/full", id="full", marks=fault("standard output is full", shows="a sentence, exit 2; the folder has all")),
        case(">&- 2>&-", id="both", marks=fault("both outputs are closed, as in a daemon", shows="the run ends as ever")),
    ],
)
def test_standard_output(tmp_path, how, tiny_run):
    shutil_copy(tiny_run.folder.parent, tmp_path / "runs")
    (tmp_path / "runs" / tiny_run.folder.name / "summary.json").unlink()
    command = f"{sys.executable} -m gapcert run {written(tmp_path)} --out {tmp_path / 'runs'} --quiet {how}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.returncode == (2 if "full" in how else 0), done.stderr
    assert done.stderr == ("" if "full" not in how else done.stderr)
    assert "full" not in how or done.stderr.startswith("output: no space left on device; make room")
    assert "Exception" not in done.stderr
    assert (tmp_path / "runs" / tiny_run.folder.name / "summary.json").is_file()


def shutil_copy(source, target):
    import shutil

    shutil.copytree(source, target)


@pytest.mark.exam
@fault("spaces, quotes and other alphabets in paths; the folder for runs is a link", shows="the same digests")
def test_odd_places(tmp_path, capsys, tiny_digests):
    place = tmp_path / "Größe 'γ' \"и\" $HOME; 空"
    (place / "real").mkdir(parents=True)
    (place / "runs").symlink_to(place / "real", target_is_directory=True)
    told(capsys, "run", str(written(place)), "--out", str(place / "runs"), code=0)
    assert digests(place / "real") == tiny_digests
    told(capsys, "verify", str(next((place / "runs").glob("tiny-*"))), code=0)


@pytest.mark.exam
@fault("two processes run one spec into one folder", shows="the second is told so at once; the first is not disturbed")
def test_two_processes(tmp_path, tiny_digests, capsys):
    spec = written(tmp_path)
    answered = tmp_path / "answered"
    slow = f"""
import sys, time
from pathlib import Path
from gapcert.certification.samples import store as sampling
from gapcert.cli import main as cli

compute = sampling.compute_chunk
def second(task):
    while not Path({str(answered)!r}).exists():
        time.sleep(0.01)
    return compute(task)
def first(task):
    sampling.compute_chunk = second
    return compute(task)
sampling.compute_chunk = first
sys.exit(cli.main(sys.argv[1:]))
"""
    command = [sys.executable, "-c", slow, "run", spec, "--out", tmp_path / "runs", "--quiet"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    while not list(tmp_path.rglob("chunk-*")) and process.poll() is None:
        time.sleep(0.02)
    told(
        capsys, "run", str(spec), "--out", str(tmp_path / "runs"), "--quiet", says="another process runs this spec; wait for it"
    )
    answered.touch()
    assert process.wait(200) == 0
    assert digests(tmp_path / "runs") == tiny_digests


@fault("an engine returns NaN", shows="the state and input, exit 2; what is finished stays")
def test_an_engine_of_nan(tmp_path, capsys):
    backend = {**TINY["backend"], "next": {"x": "0.5*x + u + 0.01*sqrt(0.9 - x)"}}
    spec = written(
        tmp_path, backend=backend, sampling={"kind": "grid", "counts": {"x": 40, "u": 40}, "chunk": 40, "executor": "threads"}
    )
    told(capsys, "run", str(spec), "--out", str(tmp_path / "runs"), "--quiet", says="(x, u) = [")
    assert not list(tmp_path.rglob("certificate.json"))
