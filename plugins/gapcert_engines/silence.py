"""What native code prints, kept out of a program's own output."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
import tempfile
import threading
from collections.abc import Iterator

_ONE_AT_A_TIME = threading.RLock()
"""One lock for all engines: threads that load at once would restore each other's descriptors."""


@contextlib.contextmanager
def muted() -> Iterator[list[str]]:
    """Collects what C code prints on file descriptors 1 and 2: the list holds that text once the block has ended."""
    with _ONE_AT_A_TIME:
        said: list[str] = []
        libc = ctypes.CDLL(None)
        sys.stdout.flush()
        sys.stderr.flush()
        libc.fflush(None)
        saved = os.dup(1), os.dup(2)
        with tempfile.TemporaryFile() as sink:
            os.dup2(sink.fileno(), 1)
            os.dup2(sink.fileno(), 2)
            try:
                yield said
            finally:
                libc.fflush(None)
                for number, copy in zip((1, 2), saved, strict=True):
                    os.dup2(copy, number)
                    os.close(copy)
                sink.seek(0)
                said.append(sink.read().decode(errors="replace").strip())
