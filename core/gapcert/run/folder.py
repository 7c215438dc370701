"""A run folder: what makes it one, `run.json` and `spec.json`, from which alone the run can go on; and whose it is.

That is the lock which a run holds, and what it writes there, by which others see it without touching the lock.
"""

from __future__ import annotations

import hashlib
import json
import os
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gapcert.numerics.atomic_files import write_atomic
from gapcert.numerics.errors import UsageError

if TYPE_CHECKING:
    from gapcert.spec.spec import Spec

MARK, SPEC, LOCK, ROOT = "run.json", "spec.json", "run.lock", "root.json"
# What has digests of its own, changes after a run, or is made again of the rest.
_APART = {ROOT, LOCK, "samples", "fit", "beside", "progress.jsonl", "report.html", "run.rrd"}


def place(spec: Spec, out: Path) -> Path:
    """Where the runs of a spec go."""
    return out / f"{spec.config.name}-{spec.digest[:8]}"


def opened(spec: Spec, out: Path) -> Path:
    """The run folder, made or found again; refused where it belongs to another spec or cannot be written."""
    folder = place(spec, out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder}: cannot be made ({error.strerror}); choose another folder with --out") from None
    if (link := _link(folder)) is not None:
        raise UsageError(
            f"{link}: is a link, through which a run would write elsewhere; expected what a run has written; delete it, or "
            "choose another folder with --out"
        )
    # A mark that is damaged says nothing: each round of samples has a digest of its own.
    found = (stored(folder, MARK) or {}).get("spec")
    if found not in (None, spec.digest):
        raise UsageError(f"{folder}: belongs to another spec ({found}); choose another folder with --out, or delete it")
    return folder


def _link(folder: Path) -> Path | None:
    """A link inside a run folder, which no run makes (the folder itself may be one, as its owner likes)."""
    for at, folders, files in os.walk(folder):
        for name in (*folders, *files):
            if (path := Path(at, name)).is_symlink():
                return path
    return None


def enter(folder: Path, spec: Spec, executor: str | None) -> None:
    """Write both, or anew where the run goes on from another place or with another executor.

    `--allow-code` is not kept: whoever resumes a folder of someone else's says it for himself.
    """
    home = spec.folder.resolve()
    mark = {
        "spec": spec.digest,
        "name": spec.config.name,
        "folder": str(home),
        "executor": executor,
        "files": {os.path.relpath(p.resolve(), home): _sha256(p) for p in spec.files if p.is_file()},
    }
    if stored(folder, SPEC) != json.loads(json.dumps(spec.data)):
        write_atomic(folder / SPEC, json.dumps(spec.data, indent=1).encode())
    # What a folder is of is said last: a kill before it leaves what is made again.
    if stored(folder, MARK) != mark:
        write_atomic(folder / MARK, json.dumps(mark).encode())


def stored(folder: Path, name: str) -> dict[str, Any] | None:
    """A JSON object of a run folder; None where it is missing or cannot be read."""
    try:
        found = json.loads((folder / name).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def is_run(folder: Path) -> bool:
    """A folder of its own, not a link to one, with the mark of a run."""
    mark = None if folder.is_symlink() or not folder.is_dir() else stored(folder, MARK)
    return mark is not None and all(isinstance(mark.get(k), str) for k in ("spec", "name"))


def marked(folder: Path) -> dict[str, Any]:
    """The mark of a run folder; UsageError where it is none."""
    if not is_run(folder):
        found = "is not there" if not folder.exists() else "is a link" if folder.is_symlink() else "holds no run.json of a run"
        raise UsageError(f"{folder}: {found}; expected a run folder, such as runs/pendulum-1a2b3c4d; `gapcert runs` lists them")
    mark = stored(folder, MARK)
    assert mark is not None, "is_run has read it"
    return mark


def spec_of(folder: Path) -> Spec:
    """The spec of a run folder, checked again; UsageError where it or its files are no longer what they were."""
    from gapcert.spec.spec import load_spec

    mark, data = marked(folder), stored(folder, SPEC)
    home = Path(mark.get("folder", "."))
    if data is None:
        raise UsageError(f"{folder}: has no spec.json that can be read; run the spec file again")
    if not home.is_dir():
        raise UsageError(
            f"{folder}: its spec's folder {home} is not there any more; bring it back, or run the spec from its new place"
        )
    loaded = load_spec(data, folder=home)
    # A spec of a matrix has a name of its own.
    loaded = replace(loaded, config=replace(loaded.config, name=mark["name"]))
    if loaded.digest != mark["spec"]:
        what = _changes(mark.get("files", {}), home) or "a file that it names, or spec.json itself"
        raise UsageError(f"{folder}: its spec is not the one that was begun: {what} has changed since; run the spec file again")
    if folder.resolve().name != (name := f"{mark['name']}-{mark['spec'][:8]}"):
        raise UsageError(f"{folder}: was renamed; a run goes on in the folder of its name; call it {name} again")
    return loaded


def _changes(files: Mapping[str, str], home: Path) -> str:
    changed = [name for name, digest in files.items() if not (home / name).is_file() or _sha256(home / name) != digest]
    return ", ".join(sorted(changed))


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def sealed(folder: Path) -> dict[str, Any]:
    """{"files": {path: SHA-256}, "root": SHA-256 of these}: what ties a run together. Rounds of samples have their digests in
    the certificate. The root finds damage; a forger makes it anew.
    """
    found = (p.relative_to(folder) for p in sorted(folder.rglob("*")) if p.is_file() and p.suffix != ".tmp")
    files = {p.as_posix(): _sha256(folder / p) for p in found if not _APART & {*p.parts}}
    return {"files": files, "root": hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()}


@contextmanager
def owned(folder: Path) -> Iterator[None]:
    """The folder is this process's alone; the lock goes with the process, however that ends. UsageError where it is taken."""
    import fcntl

    try:
        # Opened without truncation: what it says is of whoever holds the lock.
        lock = open(folder / LOCK, "a+", encoding="utf-8")  # noqa: SIM115
    except FileNotFoundError:
        raise UsageError(f"{folder}: was removed just now; run it again") from None
    except OSError as error:
        raise UsageError(f"{folder}: cannot be written ({error.strerror}); choose another folder with --out") from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UsageError(
                f"{folder}: another process runs this spec; wait for it, or choose another folder with --out"
            ) from None
        if not _same(folder / LOCK, lock.fileno()):
            raise UsageError(f"{folder}: was removed just now; run it again")
        lock.truncate(0)
        lock.write(json.dumps(myself()) + "\n")
        lock.flush()
        try:
            yield
        finally:
            with suppress(OSError):
                lock.truncate(0)


def _same(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(os.stat(path), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def myself() -> dict[str, Any]:
    """This process, so that no later one of the same number is taken for it."""
    return {"pid": os.getpid(), "place": _place(), "born": _born(os.getpid())}


def owner(folder: Path) -> dict[str, Any] | None:
    """Who holds the lock, or held it and was killed, as the lock says; None where it says nothing that can be read."""
    found = stored(folder, LOCK)
    return found if found is not None and isinstance(found.get("pid"), int) else None


def alive(holder: Mapping[str, Any]) -> bool | None:
    """Whether that process still runs; None where it is of another machine or container, which cannot be seen."""
    if holder.get("place") != _place():
        return None
    return (born := _born(holder["pid"])) is not None and born == holder.get("born")


def _place() -> str:
    """The machine and its process numbers: containers of one name have numbers of their own."""
    space = ""
    with suppress(OSError):
        space = os.readlink("/proc/self/ns/pid")
    return f"{socket.gethostname()} {space}".strip()


def _born(pid: int) -> int | None:
    """When a process began, in ticks since the machine did; None where there is none, or it has ended and is not yet buried."""
    try:
        # The name, in brackets, may hold anything.
        words = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        return None if words[0] in "ZX" else int(words[19])
    except (OSError, ValueError, IndexError):
        return None
