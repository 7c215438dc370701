"""The hooks of Gapcert. A plugin module implements any of them, decorated with `gapcert.hookimpl`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pluggy

if TYPE_CHECKING:
    from gapcert.contracts.plugins.component import Component
    from gapcert.contracts.plugins.events import Event

hookspec = pluggy.HookspecMarker("gapcert")
hookimpl = pluggy.HookimplMarker("gapcert")


@hookspec
def gapcert_components() -> list[Component]:  # type: ignore[empty-body]  # pluggy never calls a specification
    """Declare what this plugin offers. Called once, when components are first listed; must import nothing heavy."""


@hookspec
def gapcert_event(event: Event) -> None:
    """Observe a run: called for every event (stages, progress, warnings), never per sample. Errors are reported, not fatal."""
