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
        (lambda: read(table(angle=T * np.nan)), r"'theta' holds no finite number; expected measurements"),
        (lambda: read(table(time=T * np.nan)), r"'time' holds no finite number"),
        (lambda: read(table(time=-T)).period, r"time never goes forward; name the column that counts the seconds"),
        (lambda: read({k: v[:9] for k, v in table().items()}), r"has 9 samples; at least 16"),
        (lambda: read(table(angle=np.array(["a"] * 40))), r"column 'angle' holds 'a' in row 1; expected a number"),
        (lambda: read(table(angle=np.array([1.0] * 30 + ["", None, "oops"] + [1] * 7, object))), r"holds 'oops' in row 33; "),
        (lambda: read({k: v[:0] for k, v in table().items()}), r"has no rows; expected at least 16 samples"),
        (lambda: Recording(()), r"there is no trajectory"),
        (lambda: Trajectory(T, {"theta": T[:-1]}), r"'theta' has shape \(39,\); expected \(40,\)"),
        (lambda: Recording((Trajectory(T, {"a": T}), Trajectory(T, {"b": T}))), r"give all of them the same"),
        (lambda: read(table()).split({"last": 1.5}), r"last = 1.5; expected a fraction between 0 and 1"),
        (lambda: read(table()).split({"last": "some"}), r"last = some"),
        (lambda: read(table()).split({"first": 0.2}), r"\{trajectories: \[name, …\]\} or \{every: 5\}"),
        (lambda: read(table()).split({"every": 2, "first": 1}), r"hold_out: found .*expected .*first: k\} of 1 trajectories"),
        (lambda: read(table()).split({"every": 1}), r"hold_out: all 1 trajectories; expected some for the fit"),
        (lambda: read(table()).split({"every": 1}, {"last": 0.5}), r"train: found .*expected \{trajectories"),
        (
            lambda: read(table()).split({"from": 1, "to": 2}),
            r"hold_out: from 1 s to 2 s; .* the recording goes from 0 to 0.39 s",
        ),
        (lambda: read(table()).split({"from": "1 m"}), r"hold_out: unit 'm' does not fit; expected s"),
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


def test_the_period_is_the_median_step_or_what_is_asked_for():
    k = np.arange(4000)
    uneven = 0.01 * k + 4e-4 * (k % 2)
    assert Recording.of(uneven, {"a": k * 1.0}).period == pytest.approx(0.01, rel=0.05)
    assert Recording.of(uneven, {"a": k * 1.0}, every=0.02).period == 0.02
    assert read(table(), every=0.03, hold="first").hold == "first"


@pytest.mark.parametrize(
    ("time", "options"),
    [
        (1.7e9 + T, {}),
        ((1_700_000_000_123_456_789 + np.round(T * 1e9)).astype(np.int64), {"units": {"time": "ns"}}),
        (np.round(T * 1e3).astype(np.int64), {"units": {"time": "ms"}}),
        (np.datetime64("2024-02-29T12:00") + np.round(T * 1e9).astype("timedelta64[ns]"), {}),
    ],
)
def test_times_since_an_epoch_are_counted_from_the_first(time, options):
    exact = np.asarray(time).dtype.kind in "iM"
    t = read(table(time=time), **options).trajectories[0].t
    assert np.allclose(t, T, rtol=0, atol=1e-12 if exact and "ns" not in str(options) else 3e-7)


def test_nanoseconds_since_an_epoch_keep_every_digit():
    start = 1_700_000_000_000_000_000
    stamps = start + np.arange(40, dtype=np.int64) * 1_000_001
    t = read(table(time=stamps), units={"time": "ns"}).trajectories[0].t
    assert np.allclose(t, np.arange(40) * 1.000001e-3, rtol=1e-12, atol=0)


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


def test_trajectories_of_one_table_share_its_memory():
    """Hundreds of them that hold a copy of the whole table each take gigabytes."""
    t = np.concatenate([T, T, T]).astype(np.float32)
    recording = read({"time": t, "angle": t, "torque": t, "run": np.repeat([1, 2, 3], 40)}, trajectory="run")
    assert len({id(tr.channels["theta"].base) for tr in recording.trajectories}) == 1


def test_a_block_of_time_is_held_out():
    recording = Recording.of(np.arange(80.0), {"a": np.arange(80.0)}, hold="zero")
    kept, held = recording.split({"from": "30 s", "to": "50 s"})
    assert [(tr.t[0], tr.t[-1]) for tr in kept.trajectories] == [(0, 29), (50, 79)]
    assert [(tr.t[0], tr.t[-1]) for tr in held.trajectories] == [(30, 49)]
    assert len({tr.name for tr in (*kept.trajectories, *held.trajectories)}) == 3
    assert kept.hold == held.hold == "zero"
    assert recording.split({"from": 60})[1].trajectories[0].t[0] == 60


@pytest.mark.parametrize("last", [0.25, "25 %"])
def test_the_end_is_held_out(last):
    kept, held = Recording.of(np.arange(80.0), {"a": np.arange(80.0)}).split({"last": last})
    assert len(kept.trajectories[0]) == 60
    assert len(held.trajectories[0]) == 20
    assert kept.trajectories[0].t[-1] < held.trajectories[0].t[0]
    with pytest.raises(UsageError, match="at least 16"):
        read(table()).split({"last": last})


def test_what_was_measured_before_a_part_can_be_had_with_it():
    t = np.arange(100) * 0.1
    whole = Recording.of(t, {"q": np.sin(t)})
    for hold_out in ({"last": 0.25}, {"from": 7.5}):
        _, part = whole.split(hold_out)
        led_up, since = whole.led_up(part)
        (tr,) = led_up.trajectories
        assert len(tr) == 100
        assert since == (7.5,)
    _, block = whole.split({"from": 3.0, "to": 6.0})
    led_up, since = whole.led_up(block)
    assert (len(led_up.trajectories[0]), since) == (60, (3.0,))
    twice = Recording.of(np.r_[0.0, t], {"q": np.sin(np.arange(101))})
    _, part = twice.split({"last": 0.25})
    assert len(twice.led_up(part)[0].trajectories[0]) == 101  # a stamp that comes twice sets no clock back
    back = Recording.of(np.r_[t[:50], t[:50]], {"q": np.sin(np.arange(100))})
    _, part = back.split({"last": 0.25})
    assert len(back.led_up(part)[0].trajectories[0]) == 25  # a clock that was reset: what came before is not known


def test_whole_trajectories_are_chosen_by_number():
    names = [str(k) for k in range(20)]
    whole = Recording(tuple(Trajectory(T, {"x": T}, n) for n in names))

    def parts(*rules):
        return tuple([tr.name for tr in part.trajectories] for part in whole.split(*rules))

    assert parts({"every": 16, "first": 1}, {"every": 2}) == (names[::2], ["1", "17"])
    # What is held out is not fitted.
    assert parts({"every": 4}, {"every": 2}) == (names[2::4], names[::4])
    assert parts({"every": 5, "first": 2}) == ([n for n in names if int(n) % 5 != 2], names[2::5])
    assert parts({"trajectories": ["3"]}, {"trajectories": ["3", "4"]}) == (["4"], ["3"])
