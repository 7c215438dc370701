"""The folder of a run: made or found again, of one spec, without links, and of one process at a time."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from gapcert.errors import UsageError
from gapcert.sampling import write_atomic

if TYPE_CHECKING:
    from gapcert.spec import Spec


def opened(spec: Spec, out: Path) -> Path:
    """The run folder, made or found again; refused where it belongs to another spec or cannot be written."""
    folder = out / f"{spec.config.name}-{spec.digest[:8]}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder}: cannot be made ({error.strerror}); choose another folder with --out") from None
    if (link := _link(folder)) is not None:
        raise UsageError(
            f"{link}: is a link, through which a run would write elsewhere; expected what a run has written; delete it, or "
            "choose another folder with --out"
        )
    found = _spec_of(folder)
    if found not in (None, spec.digest):
        raise UsageError(f"{folder}: belongs to another spec ({found}); choose another folder with --out, or delete it")
    if found is None:
        about = {"spec": spec.digest, "name": spec.config.name, "folder": str(spec.folder.resolve())}
        # What a folder is of is said last: a kill before it leaves what is made again.
        write_atomic(folder / "spec.json", json.dumps(spec.data, indent=1).encode())
        write_atomic(folder / "run.json", json.dumps(about).encode())
    return folder


def _spec_of(folder: Path) -> str | None:
    """The digest of the spec that a run folder is of; None for a new one, or one that is damaged: its rounds have their own."""
    try:
        return str(json.loads((folder / "run.json").read_text(encoding="utf-8"))["spec"])
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return None


def _link(folder: Path) -> Path | None:
    """A link inside a run folder, which no run makes (the folder itself may be one, as its owner likes)."""
    for place, folders, files in os.walk(folder):
        for name in (*folders, *files):
            if (path := Path(place, name)).is_symlink():
                return path
    return None


@contextmanager
def owned(folder: Path) -> Iterator[None]:
    """The folder is this run's alone; the lock goes with the process, however that ends."""
    import fcntl

    try:
        lock = open(folder / "run.lock", "a")  # noqa: SIM115
    except OSError as error:
        raise UsageError(f"{folder}: cannot be written ({error.strerror}); choose another folder with --out") from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UsageError(
                f"{folder}: another process runs this spec; wait for it, or choose another folder with --out"
            ) from None
        yield
