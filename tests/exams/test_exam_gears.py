"""The exam in gears: its plants move as two bodies and as one, and play of another hand is found."""

import numpy as np
import pytest
from exams import gears


def test_without_play_both_move_as_one():
    gear = gears.Gear(J=0.05, b=0.06, share=0.4, width=0.0, side=0, period=0.005)
    u = np.sin(0.02 * np.arange(400))
    path = gear.play(u)
    assert np.abs(path[:, 0] - path[:, 1]).max() < 1e-4 * np.ptp(path)
    one = gear.rigid(np.zeros((1, 2)), u[None], gear.J, gear.b)[0]
    assert np.abs(path @ [0.6, 0.4] - one).max() < 2e-3 * np.ptp(one)


def test_teeth_keep_the_gap_and_exchange_what_one_of_them_loses():
    gear = gears.Gear(J=0.05, b=1e-9, share=0.4, width=0.1, side=0, period=0.005)
    u = np.cos(0.02 * np.arange(600))
    path = gear.play(u)
    apart = path[:, 0] - path[:, 1]
    assert 0.05 <= np.abs(apart).max() < 0.06
    assert apart.max() > 0.049
    assert apart.min() < -0.049
    speed = np.concatenate([[0.0], np.cumsum(u) * 0.005 / 0.05])
    centre = np.concatenate([[0.0], np.cumsum(0.0025 * (speed[1:] + speed[:-1]))])[:-1]
    assert np.abs(path @ [0.6, 0.4] - centre).max() < 1e-3 * np.ptp(centre)


def test_of_every_fourth_case_nothing_is_left_for_play():
    for index in (2, 3):
        c = gears.case("gears", 1, index)
        assert (c.remains > gears.LEFT) == bool(c.gear.width) == (index == 2)
        assert c.model().nx == 2


@pytest.mark.exam
@pytest.mark.parametrize("index", [0, 1, 4])
def test_small_play_is_found_whatever_friction_is_the_links(index):
    said, c = gears.ask("gears", 5001, index, 300.0), gears.case("gears", 5001, index)
    assert said["verdict"] == "causes"
    (cause,) = said["causes"]
    shift = c.gear.width * (c.gear.share, 1 - c.gear.share)[c.gear.side]
    assert cause["effect"] == "gear-play"
    assert cause["numbers"][("motor_shift", "link_shift")[c.gear.side]] == pytest.approx(shift, rel=0.05)
