"""Recordings: what is refused, in one sentence that helps, and how they are split."""

import numpy as np
import pytest

from gapcert import Recording, Trajectory, UsageError

T = np.arange(40) * 0.01


def table(**columns):
    return {"time": T, "angle": np.sin(T), "torque": np.cos(T), **columns}


def read(table, **options):
    columns = {"theta": "angle", "u": "torque"}
    return Recording.from_columns([("log.csv", table)], **{"time": "time", "columns": columns, **options})


def broken(name, row, value):
    values = table()[name].copy()
    values[row] = value
    return table(**{name: values})


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (
            lambda: read({k: v for k, v in table().items() if k != "torque"}),
            r"log.csv: 'torque' is not a column; there are angle",
        ),
        (lambda: read(table(), columns={"theta": "angel"}), r"'angel' is not a column; did you mean 'angle'\?"),
        (lambda: read(table(), time="t"), r"'t' is not a column"),
        (lambda: read(table(), units={"angel": "deg"}), r"units: 'angel' .* did you mean 'angle'\?"),
        (lambda: read(broken("time", 7, 0.02)), r"time runs backwards in row 7 \(0.06 s, then 0.02 s\)"),
        (lambda: read(broken("time", 7, 0.06)), r"time stands still in row 7"),
        (lambda: read(broken("angle", 5, np.nan)), r"'theta' is nan in row 5; expected a finite number"),
        (lambda: read(broken("time", 5, np.inf)), r"'time' is inf in row 5"),
        (lambda: read({k: v[:9] for k, v in table().items()}), r"has 9 samples; at least 16"),
        (lambda: read(table(angle=np.array(["a"] * 40))), r"column 'angle' does not hold numbers"),
        (lambda: Recording(()), r"there is no trajectory"),
        (lambda: Trajectory(T, {"theta": T[:-1]}), r"'theta' has shape \(39,\); expected \(40,\)"),
        (lambda: Recording((Trajectory(T, {"a": T}), Trajectory(T, {"b": T}))), r"give all of them the same"),
        (lambda: read(broken("time", 7, 0.0702)).period, r"not evenly sampled: row 7 is 0.0002 s off a period of 0.01 s"),
        (lambda: read(table()).split({"last": 1.5}), r"last = 1.5; expected a fraction between 0 and 1"),
        (lambda: read(table()).split({"last": "some"}), r"last = some"),
        (lambda: read(table()).split({"first": 0.2}), r"expected \{last: 25 %\} or \{trajectories"),
        (lambda: read(table()).split({"trajectories": ["log"]}), r"'log' is not a trajectory; did you mean 'log.csv'\?"),
        (
            lambda: read(table()).split({"trajectories": ["log.csv"]}),
            r"1 of 1 trajectories; expected at least one on either side",
        ),
        (lambda: read(table(), units={"angle": "kg"}).converted({"theta": "rad"}), r"'theta': unit 'kg' does not fit"),
        (lambda: read(table(), units={"angle": "zorkmid"}).converted({"theta": "rad"}), r"unknown unit 'zorkmid'"),
    ],
)
def test_refuses_in_one_sentence(make, says):
    with pytest.raises(UsageError, match=says) as error:
        make()
    assert "\n" not in str(error.value)


def test_jitter_below_a_thousandth_of_the_period_is_accepted():
    k = np.arange(4000)
    assert Recording.of(0.01 * k + 4e-6 * (k % 2), {"a": k * 1.0}).period == pytest.approx(0.01, rel=1e-3)


def test_units_are_converted():
    recording = read(table(), units={"angle": "deg"}).converted({"theta": "rad", "u": "N*m"})
    assert np.allclose(recording.trajectories[0].channels["theta"], np.deg2rad(np.sin(T)), rtol=1e-12)
    assert recording.trajectories[0].channels["u"] is not None
    assert recording.units["theta"] == "rad"


def test_a_column_tells_trajectories_apart():
    t = np.concatenate([T, T])
    data = {"time": t, "angle": t, "torque": t, "run": np.repeat([3, 8], 40)}
    recording = read(data, trajectory="run")
    assert [tr.name for tr in recording.trajectories] == ["3", "8"]
    kept, held = recording.split({"trajectories": [8]})
    assert [tr.name for tr in kept.trajectories] == ["3"]
    assert [tr.name for tr in held.trajectories] == ["8"]


@pytest.mark.parametrize("last", [0.25, "25 %"])
def test_the_end_is_held_out(last):
    kept, held = Recording.of(np.arange(80.0), {"a": np.arange(80.0)}).split({"last": last})
    assert len(kept.trajectories[0]) == 60
    assert len(held.trajectories[0]) == 20
    assert kept.trajectories[0].t[-1] < held.trajectories[0].t[0]
    with pytest.raises(UsageError, match="at least 16"):
        read(table()).split({"last": last})
