"""Declares what this package offers; imports nothing but gapcert."""

from gapcert.plugin import EXECUTED, Argument, Component, hookimpl


@hookimpl
def gapcert_components() -> list[Component]:
    """The section `compare:`, the command that carries it out, and the one that compares what runs have found."""
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
        Component(
            "command",
            "runs compare",
            "what differs between the specs of runs, and which figures changed beyond noise",
            "gapcert_compare.run_folders:command",
            arguments=(
                Argument(
                    "RUNS", "run folders, the first of which the others are held against", {"metavar": "RUN", "nargs": "+"}
                ),
                Argument("--all", "show figures that are the same, too", {"action": "store_true"}),
            ),
        ),
    ]
