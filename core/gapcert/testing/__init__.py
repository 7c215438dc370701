"""What a plugin's tests need: contracts to subclass, small Systems, and data with a hidden effect. Imported on first use."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from gapcert.lazy import LazyPackage

if TYPE_CHECKING:
    from gapcert.testing.bounds import GapFamilyContract as GapFamilyContract
    from gapcert.testing.bounds import LipschitzContract as LipschitzContract
    from gapcert.testing.effects import EffectContract as EffectContract
    from gapcert.testing.execution import ExecutorContract as ExecutorContract
    from gapcert.testing.hide import chirp as chirp
    from gapcert.testing.hide import hide as hide
    from gapcert.testing.hide import multisine as multisine
    from gapcert.testing.hide import steps as steps
    from gapcert.testing.hide import write_csv as write_csv
    from gapcert.testing.models import ModelContract as ModelContract
    from gapcert.testing.observers import ObserverContract as ObserverContract
    from gapcert.testing.plugins import PluginContract as PluginContract
    from gapcert.testing.readers import ReaderContract as ReaderContract
    from gapcert.testing.synthesis import SynthesizerContract as SynthesizerContract
    from gapcert.testing.systems import SystemContract as SystemContract
    from gapcert.testing.systems import ToyOscillator as ToyOscillator

# One name per line: where each lives.
_HOME = {
    "EffectContract": "effects",
    "ExecutorContract": "execution",
    "GapFamilyContract": "bounds",
    "LipschitzContract": "bounds",
    "ModelContract": "models",
    "ObserverContract": "observers",
    "PluginContract": "plugins",
    "ReaderContract": "readers",
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
sys.modules[__name__].__class__ = LazyPackage
