"""Angles with holes, in which they turned several times: the turns are not lost."""

import numpy as np
import pytest

from gapcert import Recording
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.testing import ROD, equations
from gapcert_recordings.resampling import unwrapped

PERIOD = 0.005
T = np.arange(800) * PERIOD
ANGLE = 40 * T + 3 * np.sin(2 * np.pi * 0.5 * T)  # many turns, at 31 to 49 rad/s
SPEED = 40 + 3 * np.pi * np.cos(2 * np.pi * 0.5 * T)
HOLE = slice(300, 380)  # 0.4 s: more than two turns


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def holed(values):
    return np.where((np.arange(len(values)) >= HOLE.start) & (np.arange(len(values)) < HOLE.stop), np.nan, values)


def same(found, angle=ANGLE):
    there = np.isfinite(found)
    np.testing.assert_allclose(found[there] - found[0], angle[there] - angle[0], atol=1e-9)


def test_a_log_that_counts_its_turns_is_taken_at_its_word():
    same(unwrapped(holed(ANGLE), T, PERIOD))
    # Where it swings back, no speed tells.
    swinging = 20 * np.sin(2 * np.pi * 0.6 * T)
    same(unwrapped(holed(swinging), T, PERIOD), swinging)


def test_a_wrapped_angle_is_unwrapped_over_a_hole_at_its_speed():
    same(unwrapped(wrapped(ANGLE), T, PERIOD))
    same(unwrapped(holed(wrapped(ANGLE)), T, PERIOD, SPEED))
    same(unwrapped(holed(wrapped(ANGLE)), T, PERIOD))  # that at its ends, which differ little


def test_a_measured_speed_tells_more_than_the_ends_of_a_hole():
    speed = np.where((T > 1.5) & (T < 1.9), 80.0, 10.0)  # turns fast while it is not seen
    angle = np.concatenate([[0], np.cumsum(speed[:-1] + speed[1:]) / 2 * PERIOD])
    same(unwrapped(holed(wrapped(angle)), T, PERIOD, speed), angle)


def test_an_angle_that_never_turned_stays_within_its_turn():
    swinging = 1.5 * np.sin(2 * np.pi * 0.5 * T + 1)
    assert np.array_equal(unwrapped(holed(swinging), T, PERIOD), holed(swinging), equal_nan=True)


def test_rows_that_are_lost_are_a_hole_as_well():
    keep = np.delete(np.arange(len(T)), np.arange(HOLE.start, HOLE.stop))
    same(unwrapped(wrapped(ANGLE)[keep], T[keep], PERIOD), ANGLE[keep])


@pytest.mark.parametrize("log", [ANGLE, wrapped(ANGLE)], ids=["counted", "wrapped"])
def test_a_hole_in_an_angle_moves_no_guess_of_a_start(log):
    model = equations({**ROD, "coordinates": {"q": {"unit": "rad", "kind": "angle"}}, "period": "5 ms"})
    channels = {"q": holed(log), "q_dot": SPEED, "u": np.sin(3 * T)}
    m = Dataset.of(model, Recording.of(T, channels))
    guess = m.states[0][:, 0]
    turns = (guess - ANGLE - (guess - ANGLE)[0]) / (2 * np.pi)
    assert np.abs(turns[HOLE.stop + 10 :]).max() < 0.1
