"""Files that hold something else than what was written into them: what reading them raises, as one sentence."""

from __future__ import annotations

import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gapcert.numerics.errors import GapcertError, UsageError, clipped

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
