"""What was measured once counts once: copies are found by content, and repetitions are none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded_twice import FORMS, WAYS, drawn

import gapcert as gc
from gapcert_recordings import Copies, copies

Array = np.ndarray


def answers(seed: int, folder: Path) -> tuple[set[str], set[str]]:
    recording, twice = drawn(seed, folder)
    return {c.name for c in Copies.of(recording, ("u",)).found}, twice


@pytest.mark.parametrize("way", range(len(WAYS)), ids=WAYS)
def test_copies_are_found_and_repetitions_are_none(way: int, tmp_path: Path) -> None:
    for form in range(len(FORMS)):
        found, twice = answers(len(FORMS) * way + form + 7200, tmp_path)
        assert found & twice, FORMS[form]
        assert found <= twice, FORMS[form]


@pytest.mark.exam
def test_so_it_is_in_a_thousand_recordings(tmp_path: Path) -> None:
    for seed in range(1000):
        found, twice = answers(seed, tmp_path)
        assert found & twice, seed
        assert found <= twice, seed


def log(n: int, seed: int, name: str = "0", **channels: Array) -> gc.Trajectory:
    rng = np.random.default_rng(seed)
    own = channels or {"x": np.cumsum(rng.normal(size=n)), "u": rng.normal(size=n)}
    return gc.Trajectory(0.1 * np.arange(n), own, name)


def found(*trajectories: gc.Trajectory, **options: object) -> list[str]:
    return [str(c) for c in Copies.of(gc.Recording(trajectories), ("u",), **options).found]  # type: ignore[arg-type]


def test_they_are_named_with_the_part_that_is_one() -> None:
    a, b = log(100, 0, "a"), log(80, 1, "b")
    assert found(a, b) == []
    assert found(a, b, replace(a, name="c")) == ["'c' is a copy of 'a'"]
    assert found(b, replace(b, name="b")) == ["'b (2)' is a copy of 'b (1)'"]
    mixed = {n: np.concatenate([a.channels[n][30:60], b.channels[n][:20]]) for n in a.channels}
    said = found(a, b, gc.Trajectory(0.1 * np.arange(50) + 7, mixed, "mixed"))
    assert said == [
        "'mixed' has 30 rows from 7 s on that are a copy of rows of 'a'",
        "'mixed' has 20 rows from 10 s on that are a copy of rows of 'b'",
    ]


def test_the_longest_counts_or_those_that_are_named_first() -> None:
    whole = log(100, 2, "whole")
    part = replace(whole.part(20, 70), name="part")
    assert found(part, whole) == ["'part' is a copy of 'whole'"]
    assert found(part, whole, first=(0,)) == ["'whole' has 50 rows from 2 s on that are a copy of rows of 'part'"]
    kept = Copies.of(gc.Recording((part, whole)), (), (0,)).without(gc.Recording((part, whole)))
    assert np.isnan(kept.trajectories[1].channels["x"]).sum() == 50


def test_a_hundred_times_the_same_is_one() -> None:
    many = gc.Recording(tuple(log(40, 3, f"{k}") for k in range(100)))
    copied = Copies.of(many)
    assert len(copied.without(many).trajectories) == 1
    assert len(copied.summary()) == 99
    assert copied.told == (
        "99 of 100 trajectories are copies of others and count once: '1' is a copy of '0', '2' of '0', '3' of '0', and 96 more"
    )


def test_they_are_told_in_one_sentence_those_that_are_whole_first() -> None:
    a, b = log(100, 0, "a"), log(80, 1, "b")
    mixed = {n: np.concatenate([a.channels[n][30:60], b.channels[n][:20]]) for n in a.channels}
    mixed_in = gc.Trajectory(0.1 * np.arange(50) + 7, mixed, "mixed")

    def told(*trajectories: gc.Trajectory, within: bool = False) -> str:
        return Copies.of(gc.Recording(trajectories), ("u",), within=within).told

    assert told(a, b) == ""
    parts = "'mixed' has 30 rows from 7 s on that are a copy of rows of 'a', "
    assert told(a, b, mixed_in).startswith(
        f"1 of 3 trajectories has rows that are a copy and counts once: {parts}'mixed' has 20"
    )
    both = told(a, b, mixed_in, replace(b, name="c"))
    assert both.startswith(
        f"2 of 4 trajectories have rows that are copies of others and count once: 'c' is a copy of 'b', {parts}"
    )
    rows = Copies.of(gc.Recording((a, b, mixed_in)), ("u",)).summary()
    assert rows[0] == {"name": "mixed", "of": "a", "start": 7.0, "rows": 30, "whole": False}
    twice = gc.Trajectory(0.1 * np.arange(200), {n: np.tile(v, 2) for n, v in a.channels.items()})
    assert told(twice, within=True).startswith("1 of 1 trajectories has rows that are a copy and counts once: '0' has 100 rows")


def test_logs_that_stand_still_are_no_copies() -> None:
    rng, n = np.random.default_rng(4), 200
    moved = [np.where(np.arange(n) < 120, 0.5, 0.5 + 0.01 * rng.normal(size=n)) for _ in range(2)]
    still = np.zeros(n)
    assert found(*(log(n, 0, f"{k}", x=x, u=still) for k, x in enumerate(moved))) == []
    # Nor where the same command is given meanwhile, which is no measurement.
    command = np.sin(0.3 * np.arange(n))
    assert found(*(log(n, 0, f"{k}", x=x, u=command) for k, x in enumerate(moved))) == []
    assert found(log(n, 0, "a", x=moved[0], u=command), log(n, 0, "b", x=moved[0], u=command)) == ["'b' is a copy of 'a'"]


def test_steps_far_above_the_noise_agree_by_chance(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two measurements with little noise most rows are the same; those that are not show that they are two."""
    n, command = 400, np.sin(0.05 * np.arange(400))

    def counted(seed: int) -> Array:
        return np.round(40 * command + 0.12 * np.random.default_rng(seed).normal(size=n))

    pair = [log(n, 0, f"{seed}", x=counted(seed), u=command) for seed in (5, 6)]
    assert np.mean(pair[0].channels["x"] == pair[1].channels["x"]) > 0.85
    assert found(*pair) == []
    monkeypatch.setattr(copies, "_told", lambda *_: True)
    assert found(*pair) != []


def test_windows_of_one_log_are_compared_where_it_is_asked() -> None:
    one = log(60, 7)
    twice = gc.Trajectory(0.1 * np.arange(120), {n: np.tile(v, 2) for n, v in one.channels.items()})
    assert found(twice) == []
    assert found(twice, within=True) == ["'0' has 60 rows from 6 s on that are a copy of rows of '0'"]


def test_other_rates_and_straight_lines_between_rows() -> None:
    fine = log(300, 8, "fine")
    at = np.arange(5.0, 25.0, 0.137)
    between = gc.Trajectory(at, {n: np.interp(at, fine.t, v) for n, v in fine.channels.items()}, "between")
    assert found(fine, between) == ["'between' is a copy of 'fine'"]
    third = gc.Trajectory(0.3 * np.arange(80) + 100, {n: v[20:260:3] for n, v in fine.channels.items()}, "third")
    assert found(fine, third) == ["'third' is a copy of 'fine'"]


def test_digits_that_were_dropped_are_no_difference_and_others_are() -> None:
    a = log(150, 9, "a")
    for digits in (2, 3, 6):
        rounded = replace(a, channels={n: np.round(v, digits) for n, v in a.channels.items()}, name="b")
        assert found(a, rounded) == ["'b' is a copy of 'a'"]
        off = {n: v + 3 * 10.0**-digits * (-1.0) ** np.arange(150) for n, v in rounded.channels.items()}
        assert found(a, replace(rounded, channels=off)) == []
