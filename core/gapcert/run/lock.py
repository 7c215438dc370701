"""Whose a run folder is: the lock that a run holds, and the mark by which others see it without touching the lock."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from gapcert.numerics.errors import UsageError

LOCK = "run.lock"


@contextmanager
def owned(folder: Path) -> Iterator[None]:
    """The folder is this process's alone; the lock goes with the process, however that ends. UsageError where it is taken."""
    import fcntl

    try:
        # Opened without truncation: the mark in it is of whoever holds the lock.
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
    """Who left a mark in the lock; None where nobody did, or a mark that cannot be read."""
    try:
        found = json.loads((folder / LOCK).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) and isinstance(found.get("pid"), int) else None


def alive(mark: Mapping[str, Any]) -> bool | None:
    """Whether the process of a mark still runs; None where it is of another machine or container, which cannot be seen."""
    if mark.get("place") != _place():
        return None
    return (born := _born(mark["pid"])) is not None and born == mark.get("born")


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
