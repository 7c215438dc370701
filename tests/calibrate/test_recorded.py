"""Calibration on a recording: windows are the units, and what is claimed of a further one is marginal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from measuring import PERIOD, RANGES, calibrated, recording

import gapcert as gc
from gapcert.numerics.order_statistics import DRAWN_WINDOWS
from gapcert.testing.toys import Drift
from gapcert_calibrate.recording_certificate import Windows
from gapcert_figures.data import SHOWN, recorded_figure
from gapcert_report.pictures.gap import recorded_pictures
from gapcert_verify.verify import verify_run

ROOT = Path(__file__).parents[2]


def broken(c: gc.CalibratedRecording, log: gc.Recording) -> bool:
    return gc.check(c.certified, log).band_violations > 0


@pytest.mark.exam
def test_a_further_trajectory_stays_inside_as_often_as_is_said() -> None:
    missed = []
    for seed in range(60):
        c = calibrated(30, seed, violation=0.2, seed=seed)
        missed += [broken(c, gc.Recording((tr,))) for tr in recording(20, 10_000 + seed).trajectories]
    share = float(np.mean(missed))
    assert share <= 0.2 + 0.06  # four standard deviations of the mean of 60 calibrations
    assert share > 0.05  # it is a calibrated band, not a wide one


def test_the_claim_is_marginal_and_says_so() -> None:
    c = calibrated()
    assert c.claim.kind == "statistical"
    assert c.claim.beta is None
    assert c.claim.epsilon == 0.05
    assert c.claim.carried.kind == "empirical"
    assert "exchangeable" in c.assumptions[0]
    assert "assumed, not tested" in c.assumptions[0]
    assert "no confidence is stated" in c.assumptions[1]
    assert c.units == 90
    assert set(c.fit.window).isdisjoint(c.held.window)
    assert calibrated(seed=1).summary() != c.summary()
    assert calibrated().summary() == c.summary()


def test_transitions_of_one_window_are_no_units_of_their_own() -> None:
    """Were each transition a unit, the band would be that of the mean noise, and miss trajectories far too often."""
    c = calibrated(90)
    model = Drift(1)
    single = gc.calibrate_recording(model, recording(90), gc.Domain.of(model, RANGES), violation=0.05, window=PERIOD)
    assert single.units > 15 * 90
    fresh = [gc.Recording((tr,)) for tr in recording(200, 77).trajectories]
    assert np.mean([broken(c, log) for log in fresh]) < 0.12
    assert np.mean([broken(single, log) for log in fresh]) > 0.2


def test_windows_keep_their_transitions_whole() -> None:
    c = calibrated(60, window=0.5, violation=0.05)
    assert c.units == 60 * 4
    assert len(c.fit.z) + len(c.held.z) <= 60 * 4 * 5  # that which ends in the next window belongs to neither


@pytest.mark.exam
def test_with_a_confidence_few_calibrations_miss_more_often_than_is_said() -> None:
    model, epsilon, confidence = Drift(1), 0.2, 0.8
    pool = Windows.cut(model, recording(400, 99_999), gc.Domain.of(model, RANGES), None)
    missed: dict[float | None, list[float]] = {confidence: [], None: []}
    for seed in range(60):
        for asked, shares in missed.items():
            c = calibrated(30, seed, violation=epsilon, confidence=asked, seed=seed)
            low, high = c.gap.interval(pool.z)
            out = ((pool.r < low) | (pool.r > high)).any(axis=1)
            shares.append(len(np.unique(pool.window[out])) / len(pool))
    worse = {asked: float(np.mean(np.array(shares) > epsilon)) for asked, shares in missed.items()}
    assert worse[confidence] <= 0.2 + 0.15  # three standard deviations of a share of 60
    assert worse[None] > 0.35  # the rank for an average would claim too much
    assert np.mean(missed[confidence]) > 0.05  # it is no wider than it has to be
    c = calibrated(30, violation=epsilon, confidence=confidence)
    assert c.claim == gc.Claim("statistical", epsilon, 0.2, DRAWN_WINDOWS)
    assert "independent draws of one distribution" in c.assumptions[0]
    assert "a share β = 0.2 that are worse" in c.assumptions[1]


@pytest.mark.parametrize("steps", [20, 3 * SHOWN])
def test_the_picture_shows_where_the_band_was_set(steps: int) -> None:
    model = Drift(1)
    c = gc.calibrate_recording(model, recording(9, 0, steps), gc.Domain.of(model, RANGES), violation=0.2)
    figure = recorded_figure(c)
    (s,) = figure.stretches
    assert figure.scores[figure.rank - 1] == c.score
    assert (np.diff(figure.scores) >= 0).all()
    assert len(s.t) == min(steps, SHOWN)
    assert (np.diff(s.t) > 0).all()
    left = np.minimum(s.residual - s.low, s.high - s.residual)
    assert 0 <= left.min() < 1e-9
    assert "x0 in the window whose score set the band; it touches its band" in recorded_pictures(figure)[1].caption


def test_a_confidence_takes_a_wider_band_than_the_average_does() -> None:
    wide, narrow = calibrated(violation=0.1, confidence=0.9), calibrated(violation=0.1)
    assert wide.rank > narrow.rank
    assert wide.score > narrow.score


def test_too_few_windows_for_a_confidence() -> None:
    what = r"60 trajectories .* ε = 0\.05, β = 0\.1 needs 45 others, 67 in all, and 40 allow 0\.05594 at best"
    with pytest.raises(gc.UsageError, match=what):
        calibrated(60, confidence=0.9)
    assert calibrated(67, confidence=0.9).rank == 45


def test_rows_without_a_value_or_a_successor_are_counted_and_told() -> None:
    log = recording(90)
    gone = tuple(holed(tr, np.arange(len(tr)) % 6 > 2) for tr in log.trajectories)
    model, full = Drift(1), calibrated()
    c = gc.calibrate_recording(model, gc.Recording(gone), gc.Domain.of(model, RANGES), violation=0.05)
    rows = c.summary()["recording"]["rows"]
    assert full.summary()["recording"]["rows"]["no_transition"] == 90  # the last row of each
    assert full.warnings == []
    assert rows["no_transition"] == rows["all"] - len(c.fit.z) - len(c.held.z) - rows["outside"]
    assert 2 * rows["no_transition"] > rows["all"]
    assert "begin no transition of one period" in c.warnings[0]
    nothing = gc.Recording(tuple(holed(tr, np.arange(len(tr)) > 0) for tr in log.trajectories))
    with pytest.raises(gc.UsageError, match=r"calibration: no two rows are one period of 0\.1 s apart"):
        gc.calibrate_recording(model, nothing, gc.Domain.of(model, RANGES))


def holed(tr: gc.Trajectory, missing: np.ndarray) -> gc.Trajectory:
    x = np.where(missing, np.nan, tr.channels["x0"])
    return gc.Trajectory(tr.t, {**tr.channels, "x0": x}, tr.name)


def test_a_model_without_inputs_can_be_calibrated() -> None:
    """Whether γ overpowers the input is then no question."""
    spec = gc.load_spec(ROOT / "specs/free_fall.yaml")
    model = spec.build("model")
    log = spec.build("recording").read()
    domain = gc.Domain.of(model, {"z": (0.1, 0.26), "vz": (-1.6, 0.6)})
    c = gc.calibrate_recording(model, log, domain, violation=0.05)
    assert all(s.overpowered is None for s in c.states.values())
    assert c.rank == 232  # of 379 tosses, 14 are in the data twice


def test_too_few_windows_say_how_many_are_needed() -> None:
    what = r"15 trajectories .* 5 of them for the fit; ε = 0\.05 needs 19 others, 28 in all, and 10 allow 0\.09091"
    with pytest.raises(gc.UsageError, match=what):
        calibrated(15)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"window": 0.01}, "expected at least the period"),
        ({"fit": 1.0}, "expected a share"),
        ({"family": "multilinear"}, "points of its own choice"),
        ({"lipschitz": "wood-zhang"}, "a recording answers no questions"),
        ({"predictor": "afine"}, "calibration: found predictor 'afine'; expected 'none'"),
        ({"predictor": Drift(1, period=0.5)}, "the predictor's model does not fit the model: its period is 0.5 s"),
    ],
)
def test_what_does_not_fit_is_one_sentence(options: dict[str, Any], message: str) -> None:
    kinds = {"family": "gap_family", "lipschitz": "lipschitz"}
    made = {k: gc.registry().get(kinds[k], v).load()() if k in kinds else v for k, v in options.items()}
    with pytest.raises(gc.UsageError, match=message):
        calibrated(**made)


@pytest.mark.parametrize("name", ["envelope", "constant", "basis"])
def test_what_was_saved_verifies(tmp_path: Path, name: str) -> None:
    options = {"functions": ["1", "u0^2"]} if name == "basis" else {}
    c = calibrated(family=gc.registry().get("gap_family", name).load()(**options))
    c.save(tmp_path)
    result = verify_run(tmp_path)
    assert result["verdict"] == "holds", result
    assert any("exchangeable" in s for s in result["trusted"])


def test_a_real_double_pendulum() -> None:
    """80 s of a free double pendulum: in windows of 0.5 s, 107 of them left for the calibration."""
    spec = gc.load_spec(ROOT / "specs/diagnose/double_pendulum_free.yaml")
    one = {k: spec.data[k] for k in ("version", "name", "model")}
    model = gc.load_spec({**one, "model": {**one["model"], "period": "4 ms"}}).build("model")
    log = spec.build("recording").read()
    domain = gc.Domain.of(model, {"q1": (2.0, 4.3), "q2": (1.3, 4.95), "q1_dot": (-11, 12), "q2_dot": (-15.5, 15.5)})
    c = gc.calibrate_recording(model, log, domain, violation=0.01, window=0.5)
    assert (c.units, c.rank) == (160, 107)
    assert gc.check(c.certified, log).band_violations <= 0.001 * len(c.held.z)
    with pytest.raises(gc.UsageError, match=r"1 trajectories .* needs 99 others"):
        gc.calibrate_recording(model, log, domain, violation=0.01)


def test_what_was_measured_once_is_one_unit() -> None:
    """Seven times the same log is one log: cut, renamed, shifted, and with fewer digits as well."""
    log = recording(45)
    rounded = tuple(
        gc.Trajectory(tr.t + 9, {n: np.round(v, 7) for n, v in tr.channels.items()}, f"later {k}")
        for k, tr in enumerate(log.trajectories)
    )
    cut = tuple(tr.part(0, 18) for tr in log.trajectories)
    model = Drift(1)
    domain, options = gc.Domain.of(model, RANGES), {"violation": 0.05}
    once = gc.calibrate_recording(model, log, domain, **options)
    many = gc.calibrate_recording(model, gc.Recording(cut + log.trajectories + rounded + cut), domain, **options)
    assert (many.units, many.rank) == (once.units, once.rank) == (45, 30)
    (told,) = many.warnings
    assert told.startswith("135 of 180 trajectories are copies of others and count once: '0 (1)' is a copy of '0 (46)'")
    assert many.assumptions[-1] == f"{told}; windows with such rows are left out."
    few = gc.Recording(recording(9).trajectories * 5)
    with pytest.raises(gc.UsageError, match=r"9 trajectories have .* count once: '0 \(10\)' is a copy of '0 \(1\)'"):
        gc.calibrate_recording(model, few, domain, **options)


def test_no_window_of_the_fit_is_among_the_held_ones() -> None:
    """One log twice in a file, going on in time: halves of it lie at other places of their windows, and are the same."""
    (tr,) = recording(1, steps=600).trajectories
    whole = gc.Trajectory(PERIOD * np.arange(1202), {n: np.tile(v, 2) for n, v in tr.channels.items()})
    model = Drift(1)
    c = gc.calibrate_recording(model, gc.Recording((whole,)), gc.Domain.of(model, RANGES), violation=0.1, window=1.3)
    rows = {tuple(z) for z in c.fit.z}
    assert rows.isdisjoint({tuple(z) for z in c.held.z})
    assert c.units <= 601 / 13
    assert "a copy of rows of" in c.assumptions[-1]
