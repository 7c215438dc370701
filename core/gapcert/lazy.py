"""Packages whose names are imported on first use."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Mapping
from types import ModuleType
from typing import Any, final


def homes(offered: Mapping[str, str]) -> dict[str, str]:
    """Name → module, of module → names with spaces between them."""
    return {name: module for module, names in offered.items() for name in names.split()}


@final
class LazyPackage(ModuleType):
    """A package that takes each public name from the module `_HOME[name]` when it is first asked for.

    Names in `_MOVED` (optional) are the packages' that it names; they answer here with a DeprecationWarning.
    """

    _HOME: dict[str, str]

    def __getattr__(self, name: str) -> Any:
        home = self.__dict__.get("_HOME", {}).get(name)
        if (moved := self.__dict__.get("_MOVED", {}).get(name)) is not None:
            told = f"{self.__name__}.{name} is {moved}.{name} now; the old name goes with the next version"
            warnings.warn(told, DeprecationWarning, stacklevel=2)
            return getattr(importlib.import_module(moved), name)
        if home is None:
            raise AttributeError(f"module '{self.__name__}' has no attribute '{name}'")
        module = importlib.import_module(home)
        value = getattr(module, name) if hasattr(module, name) else importlib.import_module(f"{home}.{name}")
        setattr(self, name, value)
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        # Importing the submodule `gapcert.certify` would bind it over the function of the same name.
        if not (name in self._HOME and isinstance(value, ModuleType)):
            super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted(self._HOME)
