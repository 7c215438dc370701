"""What tests of faults share: a spec that runs in a moment, the command in this process and in one of its own, small disks."""

import json
import os
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

from gapcert.cli.main import main

LINE = {"kind": "equations", "states": {"x": "1"}, "inputs": {"u": "1"}, "period": "1 s"}
TINY = {
    "version": 1,
    "name": "tiny",
    "model": {**LINE, "next": {"x": "0.5*x + u"}},
    "backend": {**LINE, "next": {"x": "0.5*x + u + 0.01*sin(3*x)"}},
    "domain": {"x": [-1, 1], "u": [-1, 1]},
    "sampling": {"kind": "adaptive", "budget": 1200, "chunk": 400, "executor": "threads"},
    "lipschitz": {"residual": {"kind": "interval"}},
    "gap": {"kind": "envelope"},
    "certificate": {"claim": "empirical"},
    "report": {"rerun": False},
}


def written(folder: Path, spec=TINY, **changes) -> Path:
    """A spec as a file (YAML reads JSON)."""
    path = folder / f"{spec['name']}.yaml"
    path.write_text(json.dumps({**spec, **changes}))
    return path


def digests(folder: Path) -> dict[str, str]:
    """The digests of all rounds of the one run below a folder."""
    (path,) = folder.rglob("certificate.json")
    return json.loads(path.read_text())["digests"]


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, but the locks."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file() and p.suffix != ".lock"}


def told(capsys, *command: str, code: int = 2, says: str = "") -> str:
    """Run the command here; it must end with that code and one short sentence that says so, without a traceback."""
    capsys.readouterr()
    found = main([*command])
    err = capsys.readouterr().err
    assert found == code, err
    assert says in err, err
    assert "Traceback" not in err
    assert "internal error" not in err
    assert len(err) < 3000
    return err


def gapcert(*command: object, before: str = "", limit: float = 60, **options) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own, after the statements `before`."""
    code = (
        f"import sys\n{before}\nfrom gapcert.cli.main import main\nif __name__ == '__main__':\n    sys.exit(main(sys.argv[1:]))"
    )
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, command)],
        **{"capture_output": True, "text": True, "timeout": limit, "check": False, **options},
    )


def clean(done: subprocess.CompletedProcess[str], code: int, says: str) -> None:
    """It ended with that code and one sentence that says so, and without a traceback."""
    assert done.returncode == code, done.stderr
    assert says in done.stderr, done.stderr
    assert "Traceback" not in done.stderr
    assert "internal error" not in done.stderr
    assert len(done.stderr) < 3000


@contextmanager
def soon(seconds: int = 10):
    """What hangs inside is ended by an error."""

    def late(*_):
        raise TimeoutError(f"not done within {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def mounted(folder: Path, *options: str) -> Path:
    """A mount at a folder, which is made; skips where this process may not mount."""
    folder.mkdir(exist_ok=True)
    if os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("only root mounts file systems")
    done = subprocess.run(["mount", *options, str(folder)], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        pytest.skip(f"no file system can be mounted here: {done.stderr.strip()}")
    return folder
