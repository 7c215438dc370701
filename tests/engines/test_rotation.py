"""Roll, pitch and yaw of a base that floats: the same rotation there and back, at the poles too, whatever the batch."""

from types import SimpleNamespace

import numpy as np
import pytest

from gapcert_engines.wiring import from_columns, to_columns

EULER = SimpleNamespace(rotation="euler", fixed_base=False)


def angles(n):
    out = np.zeros((n, 12))
    out[:, 3:6] = np.random.default_rng(0).uniform(-np.pi, np.pi, (n, 3)) * [1, 0.5, 1]
    return out


def rotations(columns):
    return from_columns(columns, EULER)[:, 3:7]


@pytest.mark.parametrize("below", [0.0, 1e-16, 1e-12, 1e-8, 1e-4, None])
def test_the_rotation_is_the_same_there_and_back(below):
    """At a pitch of ±90° two of the three angles are not determined, and the rotation is."""
    columns = angles(2000)
    if below is not None:
        columns[:, 4] = np.sign(columns[:, 4]) * (np.pi / 2 - below)
    back = to_columns(from_columns(columns, EULER), EULER)
    assert np.abs(np.abs((rotations(columns) * rotations(back)).sum(axis=1)) - 1).max() < 1e-14
    if below is None:
        level = np.abs(columns[:, 4]) < 1.4
        assert np.abs(np.sin((back - columns)[level, 3:6])).max() < 1e-14


def test_a_level_base_stays_level_to_the_last_bit():
    columns = np.zeros((100, 12))
    columns[:, 5] = np.linspace(-3, 3, 100)
    back = to_columns(from_columns(columns, EULER), EULER)
    assert (back[:, 3:5] == 0).all()


def test_a_row_does_not_depend_on_its_batch():
    base = from_columns(angles(301), EULER)
    whole = to_columns(base, EULER)
    for k in range(301):
        assert to_columns(base[k : k + 1], EULER).tobytes() == whole[k : k + 1].tobytes()
        assert from_columns(whole[k : k + 1], EULER).tobytes() == from_columns(whole, EULER)[k : k + 1].tobytes()
