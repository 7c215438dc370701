"""What a plugin declares: a component by kind and name, and what a command takes, as data: listing imports nothing of it."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, final

from gapcert.numerics.errors import MissingDependency, UsageError

if TYPE_CHECKING:
    from gapcert.contracts.systems.system import Model

KINDS = ("model", "backend", "gap_family", "lipschitz", "synthesizer", "effect", "reader", "executor", "observer")
INNER = ("automaton", "command", "contract", "diagnoser", "illustrator", "report", "route", "section", "study", "view")
"""Kinds that are no `kind:` of a spec. An `automaton` reads a text as one; a `command` is `function(options) -> Answer`; a
`contract` is a class of checks for `gapcert.testing`; a `diagnoser` says why models of its own sort are wrong; an `illustrator`
adds figures to events, as `make(folder, emit)`, an Emit; a `report` makes a page of a run folder; a `route` turns a band into a
claim; a `section` is a key of specs, and a `study` carries one out; a `view` shows the results of a class.
"""


@final
@dataclass(frozen=True)
class Argument:
    """`flags` are one name in capitals, as `RUN`, or options, as `--quiet -q`; `how` is what argparse is told besides."""

    flags: str
    help: str
    how: Mapping[str, Any] = field(default_factory=dict)


Arguments = argparse.Namespace


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
"""What a command takes that executes a spec; `gapcert.cli.commands:execute` is its function."""


@final
@dataclass(frozen=True)
class Component:
    """A declaration: nothing of it is imported until it is used.

    `target` and `config` are `"module:Name"` strings; `config` names a pydantic model whose field `kind` is
    `Literal[name]` (empty: the component takes no options). `requires` lists importable modules, `extra` the gapcert
    extra that installs them (`install` overrides the whole install line, e.g. for apt packages). `check` names a function
    that lists what else is absent, such as a compiler; every listing calls it, so it is quick and imports nothing heavy.
    `claim` is the strongest claim that a certificate built on it can make. `code` marks a component whose options name code
    to run: it is refused unless the user allows that. `controller` names, for a synthesizer whose controllers are not on cells,
    their class: its `load(folder)` is the inverse of their `save`. `arguments` are those of a command. `of`: the kinds that the
    option `of` of a component may have that wraps another one.
    """

    kind: str
    name: str
    summary: str
    target: str
    config: str = ""
    requires: tuple[str, ...] = ()
    check: str = ""
    extra: str = ""
    install: str = ""
    distribution: str = ""
    claim: Literal["deterministic", "statistical", "empirical", "assumed"] = "deterministic"
    code: bool = False
    controller: str = ""
    arguments: tuple[Argument, ...] = ()
    of: tuple[str, ...] = ()

    def missing(self) -> str | None:
        """None when the component can be loaded, else one sentence that says what is missing and how to get it."""
        # Only the top-level package is looked up: finding a submodule would import its parents.
        absent = [m for m in self.requires if importlib.util.find_spec(m.partition(".")[0]) is None]
        absent += load(self.check)() if self.check else ()
        if not absent:
            return None
        return f"{self.kind} '{self.name}' needs {', '.join(absent)}, which is not installed; run: {self.install_line()}"

    def install_line(self) -> str:
        """The command that installs what this component requires."""
        package = f"'gapcert[{self.extra}]'" if self.extra else " ".join(self.requires)
        return self.install or f"pip install {package}"

    def load(self) -> Any:
        """Import and return the implementation; MissingDependency with the install line if a requirement is absent."""
        if (reason := self.missing()) is not None:
            raise MissingDependency(reason)
        return load(self.target)


@final
@dataclass(frozen=True)
class Context:
    """What a component may need besides its own options when it is built from a spec.

    loader: of the model of another spec, by its path.
    """

    folder: Path = field(default_factory=Path)
    model: Model | None = None
    seed: int = 0
    allow_code: bool = False
    period: float | None = None
    loader: Callable[[str], Model] | None = field(default=None, repr=False, compare=False)

    def other(self, path: str) -> Model:
        """The model of another spec; UsageError where no spec stands behind the component."""
        if self.loader is None:
            raise UsageError(f"{path}: the model of another spec is taken only from within a spec; give the model itself")
        return self.loader(path)

    def __getstate__(self) -> dict[str, Any]:
        """What is asked once goes to no other process, and has no part in what a component is."""
        return {k: v for k, v in vars(self).items() if k != "loader"}


def load(target: str) -> Any:
    """The object named by `"module:Name"`."""
    module, _, name = target.partition(":")
    return getattr(importlib.import_module(module), name)
