"""What a plugin's tests need: contracts to subclass, small Systems, and data with a hidden effect. Imported on first use."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gapcert.testing.bounds import GapFamilyContract as GapFamilyContract
    from gapcert.testing.bounds import LipschitzContract as LipschitzContract
    from gapcert.testing.effects import EffectContract as EffectContract
    from gapcert.testing.hide import chirp as chirp
    from gapcert.testing.hide import hide as hide
    from gapcert.testing.hide import multisine as multisine
    from gapcert.testing.hide import steps as steps
    from gapcert.testing.hide import write_csv as write_csv
    from gapcert.testing.synthesis import SynthesizerContract as SynthesizerContract
    from gapcert.testing.systems import SystemContract as SystemContract
    from gapcert.testing.systems import ToyOscillator as ToyOscillator

# One name per line: where each lives.
_HOME = {
    "EffectContract": "effects",
    "GapFamilyContract": "bounds",
    "LipschitzContract": "bounds",
    "SynthesizerContract": "synthesis",
    "SystemContract": "systems",
    "ToyOscillator": "systems",
    "chirp": "hide",
    "hide": "hide",
    "multisine": "hide",
    "steps": "hide",
    "write_csv": "hide",
}

__all__ = sorted(_HOME)


class _Package(ModuleType):
    def __setattr__(self, name: str, value: Any) -> None:
        # Importing the submodule `hide` would bind it over the function of the same name.
        if not (name in _HOME and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'gapcert.testing' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"gapcert.testing.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
