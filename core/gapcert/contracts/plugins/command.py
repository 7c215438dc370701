"""A command of `gapcert` as a plugin declares it: data, so that `gapcert --help` imports none of it."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, final

Arguments = argparse.Namespace


@final
@dataclass(frozen=True)
class Argument:
    """`flags` are one name in capitals, as `RUN`, or options, as `--quiet -q`; `how` is what argparse is told besides."""

    flags: str
    help: str
    how: Mapping[str, Any] = field(default_factory=dict)


class Answer(NamedTuple):
    """What a command, a function of its parsed options, returns: `data` for --json, `words` for people, and the exit code."""

    data: object
    words: Iterable[str] = ()
    code: int = 0


SPEC = Argument("SPEC", "a spec file (YAML)")
RUN = Argument("RUN", "the folder of a finished run")
LOG = Argument("LOG", "a log: CSV, Parquet, HDF5, .mat, MCAP, a ROS 2 bag, a LeRobot data set; or a spec that names one")
SET = Argument("--set", "override a value of the spec", {"action": "append", "default": [], "metavar": "PATH=VALUE"})
ALLOW_CODE = Argument("--allow-code", "run Python functions that the spec names", {"action": "store_true"})
EXECUTED = (
    SPEC,
    SET,
    Argument("--out", "where run folders go (runs)", {"type": Path, "default": Path("runs"), "metavar": "DIR"}),
    Argument("--executor", "what computes samples: processes, threads, dask, dask:ADDRESS", {"metavar": "NAME"}),
    ALLOW_CODE,
    Argument("--view", "open a live Rerun viewer", {"action": "store_true"}),
    Argument("--quiet -q", "no progress; warnings, as of repaired data, stay", {"action": "store_true"}),
)
"""What a command takes that executes a spec; `gapcert.cli.main:execute` is its function."""
