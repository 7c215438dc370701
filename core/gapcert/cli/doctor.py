"""What this machine can do, found out without importing anything heavy."""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import platform
import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from gapcert.contracts.plugins.registry import installed
from gapcert.version import __version__

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
DRIVERS = ("/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d", "/etc/vulkan/icd.d")


def examine() -> dict[str, Any]:
    """Versions, components with reasons, the browser that tests the report, the Vulkan driver that draws Rerun's pictures."""
    browser = next((path for name in BROWSERS if (path := shutil.which(name)) is not None), None)
    drivers = [str(p) for folder in DRIVERS for p in sorted(Path(folder).glob("*.json"))]
    return {
        "gapcert": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processors": os.cpu_count(),
        "memory_gib": _memory(),
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


def _memory() -> float:
    return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)


def _packages() -> dict[str, str | None]:
    """Installed versions of everything that gapcert or one of its extras names."""
    found: dict[str, str | None] = {}
    for line in importlib.metadata.requires("gapcert") or ():
        name = re.split(r"[\s;<>=!~\[]", line, maxsplit=1)[0]
        if name != "gapcert" and 'extra == "dev"' not in line and "extra == 'dev'" not in line:
            found[name] = None
            with contextlib.suppress(importlib.metadata.PackageNotFoundError):
                found[name] = importlib.metadata.version(name)
    return dict(sorted(found.items()))


def _playwright() -> str | None:
    root = Path(os.environ.get("PLAYWRIGHT_BROWSERS_PATH") or Path.home() / ".cache/ms-playwright")
    return next((str(p) for p in sorted(root.glob("chromium*/**/chrome*")) if p.is_file() and os.access(p, os.X_OK)), None)
