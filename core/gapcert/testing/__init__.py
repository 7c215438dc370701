"""What a plugin's tests need: contracts to subclass, small Systems, inputs that excite. Imported on first use.

Contracts of kinds that belong to a plugin are that plugin's components of kind `contract`, by their names.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from gapcert.contracts.plugins.registry import registry
from gapcert.lazy import homes

if TYPE_CHECKING:
    from gapcert.testing.execution import ExecutorContract as ExecutorContract
    from gapcert.testing.models import ModelContract as ModelContract
    from gapcert.testing.observers import ObserverContract as ObserverContract
    from gapcert.testing.plugins import PluginContract as PluginContract
    from gapcert.testing.signals import chirp as chirp
    from gapcert.testing.signals import multisine as multisine
    from gapcert.testing.signals import steps as steps
    from gapcert.testing.signals import write_csv as write_csv
    from gapcert.testing.systems import SystemContract as SystemContract
    from gapcert.testing.systems import ToyOscillator as ToyOscillator

_HOME = homes(
    {
        "gapcert.testing.execution": "ExecutorContract",
        "gapcert.testing.models": "ModelContract",
        "gapcert.testing.observers": "ObserverContract",
        "gapcert.testing.plugins": "PluginContract",
        "gapcert.testing.signals": "chirp multisine steps write_csv",
        "gapcert.testing.systems": "SystemContract ToyOscillator",
    }
)

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(importlib.import_module(_HOME[name]), name)
    elif (part := registry().components.get(("contract", name))) is not None:
        value = part.load()
    else:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*_HOME, *registry().names("contract")])
