"""Declares what this package offers; imports nothing but gapcert."""

from pathlib import Path

from gapcert.plugin import Argument, Component, hookimpl

_KINDS = "model, backend, gap_family, lipschitz, synthesizer, effect, reader, executor, observer or study"


@hookimpl
def gapcert_components() -> list[Component]:
    """The command that begins a plugin."""
    return [
        Component(
            "command",
            "plugins new",
            "write a plugin of your own: a working component, its contract test, and a spec that uses it",
            "gapcert_scaffold.scaffold:command",
            arguments=(
                Argument("KIND", _KINDS),
                Argument("NAME", "its name in specs, such as my-robot"),
                Argument("--out", "a new or empty folder for it (gapcert-NAME)", {"type": Path, "metavar": "DIR"}),
            ),
        )
    ]
