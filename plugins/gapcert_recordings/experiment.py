"""An experiment on a System: drawn inputs, held for drawn times, and what they made of the states, as a recording."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from gapcert.plugin import SHORTEST, Array, Recording, Relation, System, Trajectory, UsageError, Zone, step_seed
from gapcert_recordings.thresholds import THRESHOLDS


def play(
    system: System,
    ranges: Mapping[str, tuple[float, float]],
    *,
    seconds: float = 10.0,
    trajectories: int = 8,
    hold: tuple[float, float] = THRESHOLDS.hold_seconds,
    pause: float = 0.0,
    relations: Sequence[Relation] = (),
    channels: Collection[str] | None = None,
    seed: int = 0,
) -> Recording:
    """What a system does under inputs uniform in their ranges, each held for a time uniform in `hold` (s).

    ranges: of every input, and of states where a trajectory starts (a state without one starts at 0; [a, a] is a point);
    hidden state starts at its default. Motion may leave the ranges. pause: s of zero input after every drawn one, so that a
    system that brakes by itself starts each from rest. relations: over (x, u), kept by every drawn input while one of
    `input_tries` does. channels: the states that are recorded (default: all that are numbers). The noise of a state is the
    system's rounding; of a system with a `seed` it is left to be estimated. A pure function of its arguments.
    """
    _check(system, ranges, seconds, hold)
    rng, count = np.random.default_rng(seed), round(seconds / system.period)
    low, high = _bounds([s.name for s in system.inputs], ranges)
    start, end = _bounds([s.name for s in system.states for _ in range(s.size)], ranges)
    zone = Zone((*start, *low), (*end, *high), tuple(relations))
    x, u = np.empty((trajectories, count + 1, system.nx)), np.zeros((trajectories, count + 1, system.nu))
    x[:, 0] = start + (end - start) * rng.random((trajectories, system.nx))
    noisy, hidden = "seed" in system.capabilities, None
    left, driven = np.zeros(trajectories, dtype=int), np.zeros(trajectories, dtype=bool)
    for k in range(count):
        u[:, k] = u[:, k - 1] if k else 0.0
        for i in np.flatnonzero(left == 0).tolist():
            driven[i] = not (driven[i] and pause)
            time = rng.uniform(*hold) if driven[i] else pause
            left[i] = max(1, round(time / system.period))
            u[i, k] = _drawn(zone, x[i, k], u[i, k], low, high, rng) if driven[i] else 0.0
        once = step_seed(seed, k) if noisy else None
        after = system.step(x[:, k], u[:, k], hidden=hidden, seed=once)
        x[:, k + 1], hidden = after.x, after.hidden
        left -= 1
    u[:, count] = u[:, count - 1]
    return _recording(system, x, u, channels)


def _check(system: System, ranges: Mapping[str, tuple[float, float]], seconds: float, hold: tuple[float, float]) -> None:
    known = [s.name for s in (*system.states, *system.inputs)]
    if unknown := [n for n in ranges if n not in known]:
        raise UsageError(f"play: '{unknown[0]}' is no state or input; there are {', '.join(known)}")
    if missing := [s.name for s in system.inputs if s.name not in ranges]:
        raise UsageError(f"play: no range for the input '{missing[0]}'; add {missing[0]}: [low, high]")
    if wrong := [n for n, (low, high) in ranges.items() if not (np.isfinite([low, high]).all() and low <= high)]:
        raise UsageError(f"play: {wrong[0]} = {list(ranges[wrong[0]])}; expected two numbers, the smaller one first")
    if turned := [s.name for s in system.states if s.size > 1]:
        raise UsageError(
            f"play: '{turned[0]}' is a rotation, which cannot be drawn from a range; use angles, or leave it hidden"
        )
    if round(seconds / system.period) < SHORTEST:
        least = SHORTEST * system.period
        raise UsageError(f"play: {seconds:g} s in steps of {system.period:g} s; expected at least {least:g} s; play for longer")
    if not 0 < hold[0] <= hold[1]:
        raise UsageError(f"play: hold = {list(hold)}; expected two positive times, the smaller one first")


def _bounds(names: Sequence[str], ranges: Mapping[str, tuple[float, float]]) -> tuple[Array, Array]:
    pairs = np.array([ranges.get(n, (0.0, 0.0)) for n in names], dtype=np.float64).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def _drawn(zone: Zone, x: Array, before: Array, low: Array, high: Array, rng: np.random.Generator) -> Array:
    """A new input at x; the one before, where the relations leave none that was found."""
    found = low + (high - low) * rng.random((THRESHOLDS.input_tries if zone.relations else 1, len(low)))
    if not zone.relations:
        return np.asarray(found[0])
    good = zone.related(np.hstack([np.tile(x, (len(found), 1)), found]))
    return np.asarray(found[good.argmax()] if good.any() else before)


def _recording(system: System, x: Array, u: Array, channels: Collection[str] | None) -> Recording:
    shown = {s.name: j for j, s in enumerate(system.states) if channels is None or s.name in channels}
    t = np.asarray(np.arange(x.shape[1]) * system.period)
    given = {s.name: j for j, s in enumerate(system.inputs)}
    played = tuple(
        Trajectory(t, {n: x[i, :, j] for n, j in shown.items()} | {n: u[i, :, j] for n, j in given.items()}, str(i))
        for i in range(len(x))
    )
    e = system.rounding(np.abs(x).max(axis=(0, 1)))
    exact = {} if "seed" in system.capabilities else {n: float(e[j]) for n, j in shown.items()}
    units = {s.name: s.unit for s in (*system.states, *system.inputs) if s.name in shown or s.name in given}
    return Recording(played, units, "zero", noise=exact)
