"""What a class or function is called in data that outlive its moves: digests, ledgers, saved controllers."""

from __future__ import annotations

import functools
import importlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

HOMES = "identities.json"
"""A file beside the `__init__` of a package where something has moved: module, or `module:Name`, as it is → as it was first."""


def identity(value: Any) -> str:
    """`module:Name`, where a class or function was first."""
    module, name = str(value.__module__), value.__qualname__
    homes = _homes(module.partition(".")[0])
    return homes.get(f"{module}:{name}") or f"{homes.get(module, module)}:{name}"


def located(name: str, packages: Iterable[str]) -> Any:
    """What has this identity, perhaps in these packages by now; ImportError or AttributeError where nothing has."""
    now = {was: here for package in packages for here, was in _homes(package).items()}
    module, _, path = name.partition(":")
    module, _, path = now.get(name, f"{now.get(module, module)}:{path}").partition(":")
    return functools.reduce(getattr, path.split("."), importlib.import_module(module))


@functools.cache
def _homes(package: str) -> Mapping[str, str]:
    try:
        folders = getattr(importlib.import_module(package), "__path__", ())
    except ImportError:  # the module of what C code has made may be none
        return {}
    tables = [table for folder in folders if (table := Path(folder, HOMES)).exists()]
    return {here: was for table in tables for here, was in json.loads(table.read_text(encoding="utf-8")).items()}
