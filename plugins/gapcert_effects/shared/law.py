"""Effects whose law is text."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import gapcert as gc
from gapcert_effects.plugin import SENTENCES

SITE = {name: f"{{{name}}}" for name in "qvufyth"}
"""Placeholders of an Extension, which the model fills."""


class Law(gc.plugin.Effect):
    """An effect that its attributes say whole; its sentence is that of its declaration.

    adds: of an Extension (`force`, `input`, …) → text, where `{level}` is the parameter `level` under its name at the site, and
    `{memory}` the name of the hidden state; memory: that state, its unit perhaps `{force}` or `{input}`, those of the site;
    where: what must hold of a site and a model for the effect to act there.
    """

    adds: ClassVar[Mapping[str, str]] = {}
    memory: ClassVar[gc.plugin.Memory | None] = None
    where: ClassVar[tuple[Callable[[str, gc.Model], object], ...]] = ()

    def __init_subclass__(cls) -> None:
        if "sentence" not in vars(cls):
            cls.sentence = SENTENCES.get(getattr(cls, "name", ""), "")

    def applies(self, site: str, model: gc.Model) -> bool:
        return all(holds(site, model) for holds in self.where)

    def extension(self, site: str, model: gc.Model) -> gc.plugin.Extension:
        own, memory = self.named(site, model), self.memory
        names: dict[str, Any] = SITE | {p.name: n.name for p, n in zip(self.parameters, own, strict=True)}
        kept: tuple[gc.plugin.Memory, ...] = ()
        if memory is not None:
            units, name = gc.plugin.site_units(model, self.site, site), memory.name.format_map(names)
            names["memory"] = name
            kept = (gc.plugin.Memory(name, memory.unit.format_map(units), memory.next.format_map(names)),)
        filled: dict[str, Any] = {what: text.format_map(names) for what, text in self.adds.items()}
        return gc.plugin.Extension(self.name, site, own, memory=kept, **filled)
