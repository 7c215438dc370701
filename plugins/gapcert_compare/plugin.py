"""Declares what this package offers; imports nothing but gapcert."""

from gapcert.plugin import EXECUTED, Component, hookimpl


@hookimpl
def gapcert_components() -> list[Component]:
    """The section `compare:`, and the command that carries it out."""
    return [
        Component(
            "study",
            "compare",
            "simulators side by side",
            "gapcert_compare.compare:ComparisonStudy",
            "gapcert_compare.section:CompareSection",
        ),
        Component(
            "command",
            "compare",
            "execute a spec that compares simulators: which, how far apart, and by which setting?",
            "gapcert.cli.commands:execute",
            arguments=EXECUTED,
        ),
    ]
