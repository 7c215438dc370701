"""A clock in another unit, where no horizon gives it away: told by the measured velocity, or by a simulation that is lost."""

import numpy as np
import pytest

from gapcert import Recording, UsageError, diagnose
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.residual.unexplained import Left
from gapcert_diagnosis.testing import ROD, equations

FEW = ["viscous-friction", "constant-force"]


def inverted(period):
    """A pendulum on its head, linear: a start grows by e every half second."""
    parameters = {"J": "1 kg*m^2", "k": "4 N*m"}
    upright = {"mass_matrix": [["J"]], "bias": {"q": "-k*q"}, "coordinates": {"q": "rad"}, "parameters": parameters}
    return equations({**ROD, **upright, "integrator": "semi_implicit", "period": period})


def logged(scale, channels=("q", "u"), count=1500):
    """Samples 8 ms apart, whose times are `scale` times what they are in s."""
    t, rng = np.arange(count) * 0.008, np.random.default_rng(0)
    all_ = {"q": 0.1 * np.sin(3 * t), "q_dot": 0.3 * np.cos(3 * t)}
    noisy = {n: v + 1e-4 * rng.standard_normal(count) for n, v in all_.items() if n in channels}
    return Recording.of(scale * t, noisy | {"u": np.sin(2 * t)})


@pytest.mark.exam
def test_a_simulation_whose_squares_overflow_is_refused():
    with pytest.raises(UsageError) as refused:
        diagnose(inverted("80 ms"), logged(1000), FEW, horizons=[500, 2000])
    said = str(refused.value)
    assert said.startswith("diagnose: the simulation blows up within 240 s, from where the data are; expected one that stays")
    assert "samples are 8 s apart: if the time is in ms, say so, recording.units: {TIME: ms}" in said


def test_a_simulation_that_follows_nothing_is_not_told_to_lack_nothing():
    found = diagnose(equations({**ROD, "period": "8 s"}), logged(1000), FEW, horizons=[500, 2000])
    assert (found.verdict, found.causes) == ("unexplained", ())
    assert "samples are 8 s apart" in found.assumptions[-1]
    assert "the time in ms?" in found.assumptions[-1]


@pytest.mark.parametrize(("unit", "scale"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9), ("min", 1 / 60), ("h", 1 / 3600)])
def test_position_and_velocity_tell_the_unit_of_time(unit, scale):
    both = logged(scale, ("q", "q_dot"))
    with pytest.raises(UsageError) as refused:
        diagnose(equations({**ROD, "period": f"{0.008 * scale!r} s"}), both, FEW, horizons=[100 * scale])
    factor = {"min": "60 times faster", "h": "3,600 times faster"}.get(unit, f"{scale:,.0f} times slower")
    assert str(refused.value).startswith(
        f"recording: q moves about {factor} than q_dot says, with samples {0.008 * scale:.6g} s"
    )
    assert f"recording.units: {{TIME: {unit}}}; otherwise mend the unit of q_dot" in str(refused.value)


@pytest.mark.parametrize("wrong", [57.2958, -1.0, 2.0])
def test_a_velocity_that_is_wrong_otherwise_is_no_matter_of_time(wrong):
    both = logged(1, ("q", "q_dot"))
    tr = both.trajectories[0]
    other = Recording.of(tr.t, {**tr.channels, "q_dot": wrong * tr.channels["q_dot"]})
    with pytest.raises(UsageError, match="no effect is given"):
        diagnose(equations({**ROD, "period": "8 ms"}), other, [], horizons=[0.5])


def test_a_share_of_no_effort_is_no_percentage():
    left = Left.__new__(Left)
    for name, value in {"growth": _Grown, "learnt": (), "share": 1e152}.items():
        object.__setattr__(left, name, value)
    assert left.doubt == "inadequate: a residual of more than any effort here is left that is not noise"


class _Grown:
    sigmas, chi_short = 9.0, 99.0


def test_rows_in_no_order_of_time_are_told():
    tr = logged(1).trajectories[0]
    order = np.random.default_rng(0).permutation(len(tr.t))
    mixed = Recording.of(tr.t[order], {n: v[order] for n, v in tr.channels.items()})
    with pytest.raises(UsageError, match=r"time goes back after 7\d\d of 1,500 rows; expected rows in the order of time; sort"):
        diagnose(equations({**ROD, "period": "8 ms"}), mixed, FEW, horizons=[100])


def test_a_fast_log_keeps_windows_to_fit_and_to_judge():
    windows = Dataset.of(equations({**ROD, "period": "8 ms"}), logged(1)).windows(150)
    assert len(windows) == 9
    assert len(windows.thinned(160)) == 2
    assert len(windows.thinned(160, 4)) == 5
    assert len(windows.thinned(160, 20)) == 9


def test_channels_at_several_rates_are_told_what_to_do():
    tr = logged(1).trajectories[0]
    slow = np.where(np.arange(len(tr.t)) % 4 == 0, tr.channels["q"], np.nan)
    with pytest.raises(UsageError, match=r"too many values are missing; expected 50 % .* different rates, .* every: 0.032 s"):
        diagnose(equations({**ROD, "period": "8 ms"}), Recording.of(tr.t, {**tr.channels, "q": slow}), FEW, horizons=[0.5])
