"""Errors that reach the user: one sentence (where: found; expected; what to do) and an exit code."""

from __future__ import annotations

import errno
import re
from typing import final

INTERRUPTED, INTERNAL = 4, 70
NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EACCES, errno.EPERM, errno.EROFS}
MACHINE = {errno.EIO, errno.EMFILE, errno.ENFILE, errno.ESTALE, errno.ELOOP, errno.ENAMETOOLONG}
"""Errors of the file system that are no fault of Gapcert: no room or no right; a machine that is at its limits."""

_UNSEEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
LONGEST = 600  # characters of a line that is told


def harmless(text: object) -> str:
    """Text with what a terminal would obey (escape sequences, changes of direction) written out: names come from strangers."""
    return _UNSEEN.sub(lambda m: m[0].encode("unicode_escape").decode(), str(text))


def clipped(text: str, at: int = 0, longest: int = LONGEST) -> tuple[str, int]:
    """The part of a long text around character `at`, with … where something is left out, and where `at` is in it."""
    if len(text) <= longest:
        return text, at
    start = max(0, min(at - longest // 3, len(text) - longest))
    head, tail = "…" * (start > 0), "…" * (start + longest < len(text))
    return head + text[start : start + longest] + tail, at - start + len(head)


class GapcertError(Exception):
    """Base of every error that is the user's to mend; `exit_code` is what the command line returns.

    `problems` lists them one by one for machines, where there is more than the sentence.
    """

    exit_code = 2
    problems: tuple[dict[str, object], ...] = ()


class UsageError(GapcertError):
    """A value, shape, file or combination that cannot be used (exit 2). at: the keys of a spec that it is about, if any."""

    def __init__(self, text: object = "", at: tuple[str, ...] = ()) -> None:
        super().__init__(text)
        self.at = at


@final
class NoStart(UsageError):
    """No state was found from which both controllers win: nothing beyond the target may be won at all."""


@final
class SpecError(GapcertError):
    """One or more errors in a spec file, each already rendered with file, line, column and caret (exit 2)."""


@final
class MissingDependency(GapcertError):
    """A component needs a package that is not installed (exit 3)."""

    exit_code = 3


@final
class Undecided(GapcertError):
    """A budget or a solver ended before the claim was decided: the verdict is `unknown` (exit 5)."""

    exit_code = 5


@final
class Interrupted(GapcertError):
    """The run was interrupted and can be resumed by the same command (exit 4)."""

    exit_code = INTERRUPTED


def exit_code(error: BaseException) -> int:
    """What the command line returns for any error: 70 for one of ours."""
    if isinstance(error, GapcertError):
        return error.exit_code
    if isinstance(error, KeyboardInterrupt | MemoryError):
        return INTERRUPTED
    return 2 if isinstance(error, OSError) and error.errno in NO_ROOM | MACHINE else INTERNAL
