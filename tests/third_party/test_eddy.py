"""An effect in one file keeps the shipped contract, and is named where it is hidden."""

import sys
from pathlib import Path

import numpy as np
import pytest

import gapcert as gc
from gapcert.testing import EffectContract

sys.path.append(str(Path(__file__).parent / "gapcert_eddy"))

from gapcert_eddy import EddyBrake, gapcert_components

pytestmark = pytest.mark.contract


class TestEddyBrake(EffectContract):
    def effect(self):
        return EddyBrake()


def test_is_declared():
    (declared,) = gapcert_components()
    assert declared.load() is EddyBrake


def test_is_found_beside_its_rival():
    (model, *_) = EffectContract.models(TestEddyBrake())
    braked = model.extend([EddyBrake().extension("q", model)])
    u = gc.testing.multisine(16.0, model.period, 3.0, (0.2, 2.5), 4)
    numbers = {"eddy_brake_q_peak": 0.3, "eddy_brake_q_speed": 1.0}
    x = braked.rollout([[0.3, 0.0]], u[None, :-1], parameters=numbers).x[0]
    q = x[:, 0] + 1e-3 * np.random.default_rng(1).standard_normal(len(x))
    recording = gc.Recording.of(np.arange(len(x)) * model.period, {"q": q, "u": u[:, 0]})
    found = gc.diagnose(model, recording, [EddyBrake(), "viscous-friction", "quadratic-drag"])
    (cause,) = found.causes
    assert cause.effect == "eddy-brake"
    assert abs(cause.parameters["peak"].value - 0.3) < 0.015
