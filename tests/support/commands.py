"""The command line in this process, told as a shell tells it: an exit code and what stands on the two streams."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass
from unittest import mock

import pytest

from gapcert.cli.main import main


@dataclass(frozen=True)
class Done:
    """How a command ended and what it printed, the processes that it started included."""

    code: int
    out: str
    err: str


def command(capfd: pytest.CaptureFixture[str], *arguments: object) -> Done:
    """Run a command. Warnings are shown as Python shows them to users, and help is as wide as where no terminal is."""
    capfd.readouterr()
    with warnings.catch_warnings(), mock.patch.dict(os.environ, {"COLUMNS": "80"}):
        warnings.resetwarnings()
        for hidden in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
            warnings.simplefilter("ignore", hidden)
        code = main([str(a) for a in arguments])
    return Done(code, *capfd.readouterr())
