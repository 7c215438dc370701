"""Files that are written whole or not at all, and the arrays in them."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gapcert.numerics.errors import GapcertError, UsageError, clipped


def write_atomic(path: Path, *content: bytes | memoryview, flush: bool = True) -> None:
    """Write by temporary file, flush and rename: a reader sees the whole content or none of it.

    Without `flush` that holds when processes are killed, but not when the machine loses its power.
    """
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        # Exclusive: no link that lies there is written through.
        temporary.unlink(missing_ok=True)
        with open(temporary, "xb") as file:
            file.writelines(content)
            if flush:
                file.flush()
                os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise no_room(path, error) from error


def no_room(path: Path, error: OSError) -> UsageError:
    """What to say where a file cannot be written."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return UsageError(
            f"{path.parent}: the disk is full; free some room and run the same command again (finished shards are kept)"
        )
    return UsageError(f"{path.parent}: cannot write ({error.strerror}); choose another folder with --out")


def npz_bytes(arrays: Mapping[str, npt.NDArray[Any]], *, compress: bool = False) -> bytes:
    """The content of an .npz file, for `write_atomic`."""
    buffer = io.BytesIO()
    (np.savez_compressed if compress else np.savez)(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def npy_parts(array: npt.NDArray[Any]) -> tuple[bytes, memoryview]:
    """The content of an .npy file, as header and data; the data are not copied."""
    array = np.ascontiguousarray(array)
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, np.lib.format.header_data_from_array_1_0(array))
    return header.getvalue(), array.view(np.uint8).reshape(-1).data if array.size else memoryview(b"")


DAMAGE = (
    OSError, LookupError, ValueError, TypeError, AttributeError, ArithmeticError, EOFError, MemoryError, RuntimeError,
    SyntaxError, tokenize.TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What data of another shape than a run's may raise, wherever they are used first."""


@contextmanager
def damage_told(where: Path | str, what: str = "the run is damaged", hint: str = "run it again") -> Iterator[None]:
    """UsageError `where: what (why); hint` for whatever is raised inside."""
    try:
        yield
    except GapcertError:
        raise
    except DAMAGE as error:
        why = f"{type(error).__name__}: {clipped(str(error))[0]}"
        raise UsageError(f"{where}: {what} ({why}); {hint}") from None
