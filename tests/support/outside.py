"""What tests need of the machine beyond Python, a compiler and what pip installs: `@pytest.mark.outside(NAME)`.

Where it is absent, its tests are skipped, and the last lines of the run say which, and how to get it.
"""

from __future__ import annotations

import os
import shutil
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

PATIENCE = 120.0
"""Seconds for a start, and for each answer, of a program that is not ours."""


@contextmanager
def watched(kill: Callable[[], object]) -> Iterator[None]:
    """Where such a program hangs inside it is killed, so that who waits for it gets an error."""
    watch = threading.Timer(PATIENCE, kill)
    watch.start()
    try:
        yield
    finally:
        watch.cancel()


class Outside(NamedTuple):
    """Something of the machine: in words, whether it is here, and the command that brings it."""

    words: str
    here: Callable[[], bool]
    install: str


def _gazebo() -> bool:
    import gapcert

    return gapcert.registry().get("backend", "gazebo").missing() is None


def _vulkan() -> bool:
    places = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d")
    viewer = shutil.which("rerun", path=str(Path(sys.executable).parent))
    return viewer is not None and any(True for place in places for _ in Path(place).glob("*.json"))


BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SERVER = "yaml-language-server"
OUTSIDE = {
    "gazebo": Outside(
        "Gazebo's physics",
        _gazebo,
        "apt-get install pkg-config libeigen3-dev libignition-physics-core-dev libignition-physics-sdf-dev"
        " libignition-physics5-dartsim-plugin5 libignition-plugin-dev libsdformat-dev",
    ),
    "chromium": Outside("Chromium", lambda: any(map(shutil.which, BROWSERS)), "apt-get install chromium"),
    "editor": Outside(
        "the YAML server of editors",
        lambda: bool(os.environ.get("YAML_LANGUAGE_SERVER") or shutil.which(SERVER)),
        f"npm install --global {SERVER}",
    ),
    "vulkan": Outside("a driver of Vulkan", _vulkan, "apt-get install mesa-vulkan-drivers libvulkan1"),
}
_FIXTURES = {"browser": "chromium", "server": "editor", "viewer": "vulkan"}
"""Fixtures that are the thing itself."""


@cache
def here(name: str) -> bool:
    """Whether it is on this machine."""
    return OUTSIDE[name].here()


def needed(item: pytest.Item) -> set[str]:
    """What a test needs, by its marks and by the fixtures that it asks for."""
    marked = {name for mark in item.iter_markers("outside") for name in mark.args}
    return marked | {_FIXTURES[f] for f in getattr(item, "fixturenames", ()) if f in _FIXTURES}


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks all that a test needs, so that `-m outside` finds it, and skips what cannot run here."""
    for item in items:
        names = needed(item)
        if names and item.get_closest_marker("outside") is None:
            item.add_marker(pytest.mark.outside(*names))
        if absent := sorted(name for name in names if not here(name)):
            item.add_marker(pytest.mark.skip(reason=f"needs {OUTSIDE[absent[0]].words}"))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """A line for each thing that is absent."""
    skipped = [r for r in terminalreporter.stats.get("skipped", ()) if isinstance(r.longrepr, tuple)]
    for thing in OUTSIDE.values():
        files = Counter(r.nodeid.split("::")[0] for r in skipped if str(r.longrepr[2]).endswith(f"needs {thing.words}"))
        if files:
            listed = ", ".join(f"{count} of {file}" for file, count in sorted(files.items()))
            terminalreporter.write_line(f"skipped, since {thing.words} is not on this machine ({thing.install}): {listed}")
