"""What this machine can do, and under which licences: found out without importing anything heavy."""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import platform
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, final

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from gapcert.contracts.plugins.registry import installed
from gapcert.version import __version__

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
DRIVERS = ("/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d", "/etc/vulkan/icd.d")
BESIDE = ("all", "dev")
"""Extras that are no group of their own: the sum of the others, and what only the tests need."""
SHORT = 60  # characters: longer texts are the licence itself


def examine() -> dict[str, Any]:
    """Versions, components with reasons, the browser that tests the report, the Vulkan driver that draws Rerun's pictures."""
    browser = next((path for name in BROWSERS if (path := shutil.which(name)) is not None), None)
    drivers = [str(p) for folder in DRIVERS for p in sorted(Path(folder).glob("*.json"))]
    return {
        "gapcert": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processors": os.cpu_count(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "chromium": browser or _playwright() or "not found: reports are written, only their browser test needs one",
        "vulkan": drivers[0]
        if drivers
        else "no driver: Rerun's pictures need one; run: apt-get install -y mesa-vulkan-drivers",
        "packages": _packages(),
        "components": installed().listing(),
    }


def pasted(found: Mapping[str, Any]) -> Iterator[str]:
    """The same as a block of Markdown to paste into a report of a fault: short, and without the names of folders at home."""
    packages = found["packages"]
    lost = [f"{c['kind']} {c['name']}: {c['reason']}" for c in found["components"] if not c["available"]]
    foreign = {c["distribution"] for c in found["components"]} - {f"gapcert {found['gapcert']}", None}
    yield "```text"
    yield f"gapcert {found['gapcert']}, Python {found['python']}, {found['platform']}"
    yield f"{found['processors']} processors, {found['memory_gib']} GiB of memory"
    yield "packages: " + ", ".join(f"{name} {version}" for name, version in packages.items() if version)
    yield "not installed: " + (", ".join(name for name, version in packages.items() if version is None) or "none")
    yield "plugins of others: " + (", ".join(sorted(foreign)) or "none")
    home = str(Path.home())
    yield from (text.replace(home, "~") for text in (*lost, f"chromium: {found['chromium']}", f"vulkan: {found['vulkan']}"))
    yield "```"


def _packages() -> dict[str, str | None]:
    """Installed versions of everything that gapcert or one of its extras names."""
    found: dict[str, str | None] = {}
    for need in map(Requirement, _requires("gapcert")):
        if need.name != "gapcert" and 'extra == "dev"' not in str(need.marker):
            found[need.name] = None
            with contextlib.suppress(importlib.metadata.PackageNotFoundError):
                found[need.name] = importlib.metadata.version(need.name)
    return dict(sorted(found.items()))


def _playwright() -> str | None:
    root = Path(os.environ.get("PLAYWRIGHT_BROWSERS_PATH") or Path.home() / ".cache/ms-playwright")
    return next((str(p) for p in sorted(root.glob("chromium*/**/chrome*")) if p.is_file() and os.access(p, os.X_OK)), None)


@final
@dataclass(frozen=True)
class Licence:
    """A package that the core (`core`) or extras need, directly or not, with its licence in its authors' words.

    `licence` is None where the package states none, `version` where it is not installed.
    """

    package: str
    version: str | None
    licence: str | None
    needed_by: tuple[str, ...]

    def facts(self) -> dict[str, Any]:
        return asdict(self)


def licences(development: bool = False) -> list[Licence]:
    """One row per package that `gapcert` and its extras need on this machine; with what only tests need, for `development`."""
    extras = [e for e in importlib.metadata.metadata("gapcert").get_all("Provides-Extra") or () if e not in BESIDE]
    groups = {"core": "", **{e: e for e in [*extras, *(["dev"] if development else [])]}}
    needs = {name: _needed(extra) for name, extra in groups.items()}
    rows = []
    for package in sorted(set().union(*needs.values())):
        by = tuple(name for name, packages in needs.items() if package in packages)
        rows.append(Licence(package, *_stated(package), ("core",) if "core" in by else by))
    return rows


def _needed(extra: str) -> set[str]:
    """Packages that `gapcert[extra]` needs, directly or not, as markers hold on this machine."""
    found: set[str] = set()
    waiting = [("gapcert", {extra})]
    seen: set[tuple[str, str]] = set()
    while waiting:
        package, asked = waiting.pop()
        for line in _requires(package):
            need = Requirement(line)
            if not any(need.marker is None or need.marker.evaluate({"extra": e}) for e in asked | {""}):
                continue
            name = canonicalize_name(need.name)
            if name != "gapcert":
                found.add(name)
            if fresh := {(name, e) for e in need.extras | {""}} - seen:
                seen |= fresh
                waiting.append((name, set(need.extras)))
    return found


def _requires(package: str) -> list[str]:
    try:
        return importlib.metadata.requires(package) or []
    except importlib.metadata.PackageNotFoundError:
        return []


def _stated(package: str) -> tuple[str | None, str | None]:
    """(version, licence): the SPDX expression, else a short licence field, else classifiers, else the text's first line."""
    try:
        about = importlib.metadata.metadata(package)
    except importlib.metadata.PackageNotFoundError:
        return None, None
    text, expression = (next(iter(about.get_all(key) or ()), "").strip() for key in ("License", "License-Expression"))
    classifiers = [c.rpartition("::")[2].strip() for c in about.get_all("Classifier") or () if c.startswith("License ::")]
    told = expression or (text if len(text) <= SHORT and "\n" not in text else "")
    first = next((line.strip(" =") for line in text.splitlines() if line.strip(" =")), None)
    return about["Version"], told or " or ".join(classifiers) or first
