"""A time column in another unit than the spec says: told in one sentence, before anything is fitted."""

import numpy as np
import pytest

from gapcert import Recording, UsageError, diagnose
from gapcert_diagnosis.testing import ROD, equations

T = np.arange(4000) * 0.005


def recorded(scale):
    rng = np.random.default_rng(0)
    channels = {"q": np.sin(3 * T), "q_dot": 3 * np.cos(3 * T), "u": np.sin(2 * T)}
    noisy = {n: v if n == "u" else v + 1e-3 * rng.standard_normal(len(T)) for n, v in channels.items()}
    return Recording.of(scale * T, noisy)


@pytest.mark.parametrize("period", ["5 ms", "5 s"])
def test_milliseconds_read_as_seconds(period):
    model = equations({**ROD, "period": period})
    with pytest.raises(UsageError) as refused:
        diagnose(model, recorded(1000), ["coulomb-friction"], horizons=[0.5, 20])
    said = str(refused.value)
    assert said.startswith(
        "diagnose.horizons: 0.5 s is shorter than 5 s, the period of the recording; expected at least that; "
    )
    assert "recording.units: {TIME: ms}" in said


def test_seconds_read_as_milliseconds():
    model = equations({**ROD, "period": "5 us"})
    with pytest.raises(UsageError) as refused:
        diagnose(model, recorded(1e-3), ["coulomb-friction"], horizons=[0.001])
    assert str(refused.value).startswith("recording: the longest stretch is 0.015 s; expected a window of 0.00")
    assert "after 0.1 s of history; record for longer, or, where its time is not in s" in str(refused.value)


def test_a_horizon_of_one_sample_is_long_enough():
    with pytest.raises(UsageError, match="no effect is given"):
        diagnose(equations({**ROD, "period": "5 ms"}), recorded(1), [], horizons=[0.005])
