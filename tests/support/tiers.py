"""The four kinds of tests, and what keeps unit tests what they are: they start no program and step no physics engine.

A test has one of four marks: `unit` (also where it has none), `contract` (what `gapcert.testing` asks has it by itself),
`run` and `exam`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest

TIERS = ("unit", "contract", "run", "exam")
DAILY = frozenset(TIERS[:-1])
_STARTS = frozenset(("subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.system"))
_LOOKUPS = ("pkg-config", "ldconfig", "uname", "lscpu")
"""How `platform`, `ctypes` and backend `gazebo` look at the machine, once in a process: whichever test comes first."""
_running: list[str] = []
"""What the unit test that runs now has done that it may not."""


def tier(item: pytest.Item) -> str:
    """The last one of the four marks that a test has."""
    return next(t for t in reversed(TIERS) if item.get_closest_marker(t))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks what a shipped contract asks of a plugin, wherever its class is, and what is marked as nothing else."""
    for item in items:
        package, _, module = str(getattr(getattr(item, "function", None), "__module__", "")).partition(".")
        if package.startswith("gapcert") and module.startswith("testing"):
            item.add_marker("contract")
        if not any(item.get_closest_marker(t) for t in TIERS):
            item.add_marker("unit")


def pytest_configure() -> None:
    sys.addaudithook(_started)


def _started(event: str, given: tuple[Any, ...]) -> None:
    if event in _STARTS and not str(given[0] if given else "").endswith(_LOOKUPS) and not _importing():
        _running.append("starts a program")


def _importing() -> bool:
    """Some packages start one when they are imported first."""
    frame = sys._getframe()
    while frame is not None and frame.f_code.co_filename != "<frozen importlib._bootstrap>":
        frame = frame.f_back
    return frame is not None


def _watch(owner: type, name: str, does: str) -> None:
    method: Callable[..., Any] = getattr(owner, name)

    def watched(*given: Any, **named: Any) -> Any:
        _running.append(does)
        return method(*given, **named)

    setattr(owner, name, watched)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Fails a unit test that has done what it may not."""
    backend = sys.modules.get("gapcert_engines.backend")
    if backend is not None and backend.EngineBackend._step.__name__ != "watched":
        _watch(backend.EngineBackend, "_step", "steps an engine")
    _running.clear()
    answer = yield
    if tier(item) == "unit" and _running:
        pytest.fail(f"{item.name}: a unit test, and it {' and '.join(sorted(set(_running)))}", pytrace=False)
    return answer
