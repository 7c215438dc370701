"""Sections of a spec that plugins contribute: the class of a component of kind `section`, or what a `study` has as `config`."""

from __future__ import annotations

import json
from abc import ABC
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, final

from pydantic import BaseModel

from gapcert.contracts.plugins.component import load
from gapcert.contracts.plugins.registry import Registry
from gapcert.numerics.errors import UsageError
from gapcert.spec.models import validate
from gapcert.spec.sections.sections import SECTIONS, Config
from gapcert.spec.source import At, Problem

Schema = dict[str, Any]


class Checker(Protocol):
    """What a section of a spec sees of its reader: it reports here what is wrong with the section, with the place."""

    problems: list[Problem]
    registry: Registry

    def say(self, path: At, message: str, hint: str = "", where: Literal["key", "value"] = "value") -> None:
        """A problem of the value at a path, or of its key."""

    def component(
        self, path: At, section: Any, kinds: tuple[str, ...] = (), absent: Callable[[str], bool] | None = None
    ) -> Any:
        """The config of a section whose `kind` is a plugin's of one of these kinds, or None; `absent` is told of a component
        that is not installed, and says whether that may be.
        """


class Axes(NamedTuple):
    """Names and units of the model's states and inputs; empty where they are not known."""

    states: dict[str, str]
    inputs: dict[str, str]


@final
@dataclass(frozen=True)
class Drawn:
    """A JSON Schema being drawn: `parts` are the choices of components by section, `definitions` what is referred to."""

    parts: Mapping[str, Schema]
    definitions: Schema
    registry: Registry

    def plain(self, body: Schema, name: str) -> Schema:
        """Move a schema into the common definitions, its own ones under its name, and refer to it."""
        own = body.pop("$defs", {})
        for key, value in {**{f"{name}.{k}": v for k, v in own.items()}, name: body}.items():
            text = json.dumps(value)
            for k in own:
                text = text.replace(f'"#/$defs/{k}"', json.dumps(f"#/$defs/{name}.{k}"))
            self.definitions[key] = json.loads(text)
        return {"$ref": f"#/$defs/{name}"}


class SpecSection(ABC):
    """How a section is read, and what of the rest of the spec it asks for.

    `model` are its options and `about` says what it is, for editors. It means nothing without the sections that it `needs`, and
    where others need one of those in `instead`, it will do. `alone`: it answers in place of a certificate, so that a spec has
    one such section. `timed`: a recording that it needs says the period of a model that has none. `simulated`: it asks a
    simulator at points of its own choice.
    """

    model: ClassVar[type[BaseModel]]
    about: ClassVar[str]
    needs: ClassVar[tuple[str, ...]] = ()
    instead: ClassVar[tuple[str, ...]] = ()
    alone: ClassVar[bool] = False
    timed: ClassVar[bool] = False
    simulated: ClassVar[bool] = False

    def __init__(self, name: str) -> None:
        self.name = name

    def read(self, checker: Checker, section: Any) -> Any:
        """The typed section, or None; problems go to `checker`."""
        return validate(self.model, section, (self.name,), checker.problems)

    def relate(self, config: Config, data: Mapping[str, Any], axes: Axes, registry: Registry) -> list[Problem]:
        """What does not go with the other sections; `data` is the spec as it is written."""
        return []

    def schema(self, drawn: Drawn) -> Schema:
        """The JSON Schema of the section, for editors."""
        return drawn.plain(self.model.model_json_schema(), self.name)


class _Unreadable(SpecSection):
    """Stands for one whose module fails: only a spec that has it is told."""

    about = "a section that cannot be read"

    def __init__(self, name: str, reason: str, hint: str) -> None:
        super().__init__(name)
        self.reason, self.hint = reason, hint

    def read(self, checker: Checker, section: Any) -> None:
        checker.say((self.name,), self.reason, self.hint, "key")

    def schema(self, drawn: Drawn) -> Schema:
        return {}


def contributed(registry: Registry) -> dict[str, SpecSection]:
    """All that the installed plugins contribute, by name; UsageError for a name that a section of the core has."""
    found: dict[str, SpecSection] = {}
    for part in (*registry.of("study"), *registry.of("section")):
        if not (target := part.target if part.kind == "section" else part.config):
            continue
        if part.name in SECTIONS:
            told = f"{part.distribution} declares section '{part.name}', which is Gapcert's own"
            raise UsageError(f"{told}; uninstall it, or ask its author for another name")
        try:
            found[part.name] = load(target)(part.name)
        except Exception as error:  # a plugin's module may fail in any way
            reason = f"cannot be read ({type(error).__name__}: {error})"
            found[part.name] = _Unreadable(part.name, reason, f"a fault of {part.distribution}; see `gapcert plugins`")
    return found
