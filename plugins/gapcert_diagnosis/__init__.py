"""Why is the model wrong? Read `diagnose.py` second."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage, homes

_HOME = homes(
    {
        "gapcert_diagnosis.diagnose": "Diagnoser DiagnosisProblem diagnose",
        "gapcert_diagnosis.preview": "Preview preview previewed",
        "gapcert_diagnosis.results": "ORDER Cause Diagnosis Estimate Gain",
        "gapcert_diagnosis.testing": "EffectContract",
    }
)

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
