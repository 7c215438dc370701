"""Declares what this package offers; imports nothing but gapcert."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gapcert.plugin import ALLOW_CODE, Argument, Component, hookimpl

ORDERS = ("age", "name", "kind", "state", "size", "seconds")
WORDS = (
    *("running", "finished", "interrupted", "failed", "holds", "fails", "unknown"),
    *("causes", "ambiguous", "nothing", "unexplained", "agree", "explained", "differ", "compared"),
)
_TICK: Mapping[str, Any] = {"action": "store_true"}
_CHOSEN = (
    Argument("--out", "where the run folders are (runs)", {"type": Path, "default": Path("runs"), "metavar": "DIR"}),
    Argument(
        "--name",
        "names or folders such as 'pendulum*'; may be repeated",
        {"action": "append", "default": [], "metavar": "PATTERN"},
    ),
    Argument(
        "--state",
        f"one of {', '.join(WORDS)}; may be repeated",
        {"action": "append", "default": [], "metavar": "WORD", "choices": WORDS},
    ),
    Argument("--sort", f"one of {', '.join(ORDERS)}", {"default": "age", "choices": ORDERS, "metavar": "BY"}),
)


def _command(name: str, summary: str, does: str, *arguments: Argument) -> Component:
    return Component("command", name, summary, f"gapcert_runs.{does}", arguments=arguments)


@hookimpl
def gapcert_components() -> list[Component]:
    """The commands about run folders."""
    return [
        _command("runs", "list, compare, clean and resume run folders", "listing:command", *_CHOSEN),
        _command(
            "runs list",
            "run folders with state, figures and size (what `gapcert runs` alone does)",
            "listing:command",
            *_CHOSEN,
        ),
        _command(
            "runs clean",
            "which run folders would go; with --yes they do",
            "cleaning:command",
            *_CHOSEN,
            Argument("--older-than", "such as 30min, 12h, 7d, 2w", {"metavar": "AGE"}),
            Argument("--larger-than", "such as 100MB, 2GB", {"metavar": "SIZE"}),
            Argument("--keep-last", "keep the newest N of each name", {"default": 0, "type": int, "metavar": "N"}),
            Argument("--all", "every folder that nothing else leaves out", _TICK),
            Argument("--yes", "remove them", _TICK),
        ),
        Component(
            "command",
            "runs resume",
            "go on with an interrupted run from its folder alone",
            "gapcert.cli.commands:resume",
            arguments=(
                Argument("RUN", "the folder of a run"),
                Argument("--executor", "another executor than the run was begun with", {"metavar": "NAME"}),
                ALLOW_CODE,
                Argument("--view", "open a live Rerun viewer", _TICK),
                Argument("--quiet -q", "no progress", _TICK),
            ),
        ),
        _command(
            "runs compare",
            "what differs between the specs of runs, and which figures changed beyond noise",
            "comparison:command",
            Argument("RUNS", "run folders, the first of which the others are held against", {"metavar": "RUN", "nargs": "+"}),
            Argument("--all", "show figures that are the same, too", _TICK),
        ),
    ]
