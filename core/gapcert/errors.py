"""Errors that reach the user: one sentence (where: found; expected; what to do) and an exit code."""

from __future__ import annotations

import errno
from typing import final

INTERRUPTED, INTERNAL = 4, 70
NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS}


class GapcertError(Exception):
    """Base of every error that is the user's to mend; `exit_code` is what the command line returns.

    `problems` lists them one by one for machines, where there is more than the sentence.
    """

    exit_code = 2
    problems: tuple[dict[str, object], ...] = ()


class UsageError(GapcertError):
    """A value, shape, file or combination that cannot be used (exit 2)."""


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
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED
    return 2 if isinstance(error, OSError) and error.errno in NO_ROOM else INTERNAL
