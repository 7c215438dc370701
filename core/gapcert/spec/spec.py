"""Specs: YAML → checked, typed configuration; every error of a file in one pass, at its line and column."""

from __future__ import annotations

import functools
import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from gapcert.contracts.plugins.component import Component, Context
from gapcert.contracts.plugins.options import of_config
from gapcert.contracts.plugins.registry import Registry, registry
from gapcert.numerics.errors import GapcertError, UsageError
from gapcert.spec.check import COMPONENTS, SpecChecker
from gapcert.spec.compose import (
    data_files,
    extend,
    load_tree,
    matrix_problems,
    override,
    parse_path,
    put,
    variant_name,
    variants,
)
from gapcert.spec.relations import relate
from gapcert.spec.sections.sections import Config
from gapcert.spec.source import Mark, Problem, Source, Tree, failure, failures, parse, plain

if TYPE_CHECKING:
    from gapcert.contracts.controllers.goal import Goal
    from gapcert.contracts.data.recording import Recording
    from gapcert.contracts.systems.domain import Domain
    from gapcert.contracts.systems.system import Model


@final
@dataclass(frozen=True)
class Spec:
    """A checked spec. `data` is what was written, after `extends:` and `--set`; `config` is what it means.

    `folder` is where its relative paths start; `variant` holds the values that a `matrix:` chose, `members` its
    specs; `out` is the folder for runs.
    """

    data: Mapping[str, Any]
    config: Config
    path: Path | None
    folder: Path
    out: Path | None = None
    variant: Mapping[str, Any] = field(default_factory=dict)
    members: tuple[Spec, ...] = field(default=(), repr=False)
    files: tuple[Path, ...] = field(default=(), repr=False)
    tree: Tree = field(default_factory=lambda: Tree(None, {}), repr=False, compare=False)

    @property
    def name(self) -> str:
        return self.config.name

    @property
    def task(self) -> str:
        """What a run of it does, `certify` or a study; SpecError where it asks for nothing (as parts of other specs may)."""
        if self.config.study:
            return self.config.study
        if self.config.certificate is not None or self.config.controller is not None:
            return "certify"
        hint = "add certificate: (how wrong?) or diagnose: (why?) or compare: (which simulator?)"
        if "model" in self.data and set(self.data) <= {"version", "name", "seed", "model"}:
            hint = "it has a model only: a spec that `extends:` it and adds `recording:` and `diagnose:` asks why it is wrong"
        raise failure([Problem((), "nothing to do", hint)], self.tree)

    @property
    def is_matrix(self) -> bool:
        return "matrix" in self.data

    def expand(self) -> tuple[Spec, ...]:
        """The specs of a matrix, or this one alone."""
        return self.members or (self,)

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of the data and of every file that they name."""
        return self.digest_of(*self.data)

    def digest_of(self, *sections: str) -> str:
        """SHA-256 of some top-level sections and of every file that the spec names; who computes samples has no part in it."""
        part = {k: self.data[k] for k in sections if k in self.data}
        if isinstance(sampling := part.get("sampling"), Mapping):
            part["sampling"] = {k: v for k, v in sampling.items() if k not in ("executor", "workers")}
        total = hashlib.sha256(json.dumps(part, sort_keys=True).encode())
        for path in (inner for named in self.files for inner in data_files(named)):
            total.update(hashlib.sha256(path.read_bytes()).digest())
        return total.hexdigest()

    def component(self, section: str) -> Component:
        """What a section's `kind` names; sections are `model`, `lipschitz.residual`, …"""
        found = registry().find(COMPONENTS[section], self._config(section).kind)
        assert found is not None, "a checked spec names what is there"
        return found

    def build(self, section: str, *, model: Model | None = None, allow_code: bool = False, period: float | None = None) -> Any:
        """The object that a section describes; `period` is for a model whose section leaves it to the recording."""
        component = self.component(section)

        def other(path: str) -> Model:
            made: Model = load_spec(self.folder / path).build("model", allow_code=allow_code)
            return made

        context = Context(self.folder, model, self.config.seed, allow_code, period, other)
        return registry().build(component.kind, component.name, self._config(section), context)

    def recorded(self) -> Recording:
        """The recording that the spec names."""
        try:
            found: Recording = self.build("recording").read()
        except UsageError as error:
            raise self.placed(error) from None
        return found

    def goal(self, domain: Domain) -> Goal:
        """The controller's goal over a domain."""
        from gapcert.spec.sections.goals import goal

        assert self.config.goal is not None, "only a spec with a controller has a goal"
        return goal(self.config.goal, domain, self.folder)

    def error(self, path: str, message: str, hint: str = "") -> GapcertError:
        """A SpecError about the value at a dotted path, for what only a run can find out."""
        return failure([Problem(parse_path(path), message, hint)], self.tree)

    def placed(self, error: UsageError) -> GapcertError:
        """An error about keys of this spec, told where they stand: file, line, column and caret; others as they are."""
        if not error.at or self.tree.mark(error.at) is None:
            return error
        # What is told of a channel's unit stands at the column whose unit was given.
        at = error.at
        columns = (of_config(self.config.recording, "channels") or ("", dict[str, str]()))[1]
        if at[:2] == ("recording", "units") and at[2] in columns and at not in self.tree.marks:
            at = (*at[:2], columns[at[2]])
        what, _, todo = _without(str(error), error.at).rpartition("; ")
        return failure([Problem(at, what, todo)], self.tree)

    def _config(self, section: str) -> Any:
        head, _, rest = section.partition(".")
        part = getattr(self.config, head)
        return part[rest] if rest else part


def _without(text: str, at: tuple[str, ...]) -> str:
    """A message without the keys that it begins with: those of the place, or the last of them."""
    for k in range(len(at)):
        for end in range(len(at), k, -1):
            text = text.removeprefix(f"{'.'.join(at[k:end])}: ")
    return text


def load_spec(
    spec: str | os.PathLike[str] | Mapping[str, Any],
    overrides: Iterable[str] = (),
    out: str | os.PathLike[str] | None = None,
    components: Registry | None = None,
    folder: Path | None = None,
) -> Spec:
    """Read and check a spec: a path, YAML text (anything with a line break), or a mapping.

    overrides: `path.to.key=value` texts. folder: where relative paths of a text or mapping start (default: here). Raises
    SpecError with every error of the file, or MissingDependency where packages of a component are all that is missing. Nothing
    is executed.
    """
    path, folder, tree = _open(spec, folder or Path())
    tree = override(tree, overrides, folder)
    known = components or registry()
    problems = [(p, tree) for p in matrix_problems(tree.data)]
    members: list[Spec] = []
    where = Path(out) if out is not None else None
    for chosen, variant in variants(tree):
        member, config, files, found = _check(variant, known, folder)
        problems += [(p, member) for p in found]
        if chosen and config is not None:
            config = replace(config, name=variant_name(config.name, chosen))
        if config is not None:
            members.append(Spec(member.data, config, path, folder, where, chosen, (), files, member))
    if problems:
        raise failures(problems)
    if len(members) == 1 and not members[0].variant:
        return members[0]
    first = members[0]
    config = replace(first.config, name=tree.data["name"])
    return replace(first, data=tree.data, config=config, variant={}, members=_apart(members), tree=tree)


def _open(spec: str | os.PathLike[str] | Mapping[str, Any], here: Path) -> tuple[Path | None, Path, Tree]:
    if isinstance(spec, Mapping):
        problems: list[Problem] = []
        data = plain(spec, (), problems)
        return None, here, extend(Tree(data, {(): Mark(Source("spec", folder=here), (0, 0))}, tuple(problems)), here)
    if isinstance(spec, str) and "\n" in spec:
        return None, here, extend(parse(Source("<text>", spec, here)), here)
    path = Path(spec)
    return path, path.parent, load_tree(path)


def _check(tree: Tree, known: Registry, folder: Path) -> tuple[Tree, Config | None, tuple[Path, ...], list[Problem]]:
    """Check one tree; paths from an extended file in another folder are written anew, as seen from this one."""
    checker = SpecChecker(tree, known, folder)
    config = checker.config()
    problems = checker.problems
    if config is not None:
        config, found = relate(config, tree.data, known, checker.contributed)
        problems += found
    for at, path in checker.paths.items():
        mark = tree.mark(at)
        if not problems and mark is not None and mark.source.folder.resolve() != folder.resolve():
            here = replace(mark, source=replace(mark.source, folder=folder))
            return _check(put(tree, at, Tree(os.path.relpath(path, folder), {at: here})), known, folder)
    return tree, config, tuple(checker.paths[k] for k in sorted(checker.paths, key=str)), problems


def _apart(members: list[Spec]) -> tuple[Spec, ...]:
    """Members with names of their own, since each has its own run folder."""
    names = [m.name for m in members]
    unique = [n if names.count(n) == 1 else f"{n}-{i}" for i, n in enumerate(names, 1)]
    return tuple(replace(m, config=replace(m.config, name=n)) for m, n in zip(members, unique, strict=True))
