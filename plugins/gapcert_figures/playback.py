"""Runs of a robot to be looked at: where its links were, in a few runs, as its engine says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from gapcert.plugin import Array, Scene, Shape, System

if TYPE_CHECKING:
    from gapcert_closed_loop import ClosedLoop, Trace

RATE, FRAMES = 60.0, 900  # pictures per second; pictures of a motion


@final
@dataclass(frozen=True)
class Channel:
    """One measured channel on held-out data, beside the simulation before and after the named causes were added."""

    name: str
    unit: str
    t: Array
    measured: Array
    before: Array
    after: Array


@final
@dataclass(frozen=True)
class Motion:
    """One motion: poses (frames, links, 7) at times t (frames,), s; ended: when it broke the specification, −1 if it did not.

    name: `with γ`, `without γ`, `measured`, `before` or `after`.
    """

    name: str
    t: Array
    poses: Array
    ended: float = -1.0


@final
@dataclass(frozen=True)
class Playback:
    """Motions of one robot: its links, their shapes, and where they were."""

    links: tuple[str, ...]
    shapes: tuple[Shape, ...]
    motions: tuple[Motion, ...]


def loop_playback(loop: ClosedLoop, system: System, row: int) -> Playback | None:
    """Run `row` of a closed loop without and with γ; None where the simulator has no body.

    Hidden state is handed on along the run once more: a trace keeps the states alone.
    """
    both = (("without γ", loop.without_gamma), ("with γ", loop.with_gamma))
    return _playback([(name, *_played(system, one, row), one.violation[row]) for name, one in both if row < len(one.x)])


def channel_playback(channels: Sequence[Channel], systems: Sequence[System]) -> Playback | None:
    """Held-out channels as motions of the first of these systems that has a body: measured, and simulated before and after.

    None where no system has one, or where the channels do not say where its links are.
    """
    known = {c.name: c for c in channels}
    for system in systems if channels else ():
        blank = np.full(len(channels[0].t), np.nan)
        states = (
            (name, np.stack([getattr(known[s.name], name) if s.name in known else blank for s in system.states], axis=1))
            for name in ("measured", "before", "after")
            if all(s.size == 1 for s in system.states)
        )
        if (found := state_playback(dict(states), channels[0].t, system)) is not None:
            return found
    return None


def state_playback(states: Mapping[str, Array], t: Array, system: System) -> Playback | None:
    """Motions by name, states (T, nx) at times t (T,); NaN where a state is not known, which a velocity need not be."""
    frames = _frames(len(t), float(np.median(np.diff(t))) if len(t) > 1 else 1.0)
    return _playback([(name, system.scene(x[frames]), (t - t[0])[frames], False) for name, x in states.items()])


def _playback(found: Sequence[tuple[str, Scene | None, Array, bool]]) -> Playback | None:
    scenes = [(name, s, t, ended) for name, s, t, ended in found if s is not None and s.shapes]
    if not scenes:
        return None
    # 32 bits hold a place in a room to a micrometre.
    motions = (
        Motion(name, t, s.poses.astype(np.float32).astype(np.float64), float(t[-1]) if ended else -1.0)
        for name, s, t, ended in scenes
    )
    first = scenes[0][1]
    return Playback(first.links, tuple(shape.bounded() for shape in first.shapes), tuple(motions))


def _played(system: System, trace: Trace, row: int) -> tuple[Scene | None, Array]:
    x, u = trace.x[row], trace.u[row]
    steps = int(np.isfinite(x).all(axis=1).sum())
    frames = _frames(steps, system.period)
    hidden = None
    if system.hidden and system.scene(x[:1]) is not None:
        hidden = _hidden(system, x[:steps], u, None if trace.hidden is None else trace.hidden[row : row + 1])[frames]
    return system.scene(x[frames], hidden), np.asarray(system.period * frames, dtype=np.float64)


def _hidden(system: System, x: Array, u: Array, first: Array | None) -> Array:
    """Hidden states (steps, nh) along a run."""
    out = [np.array([system.hidden_default]) if first is None else first]
    for k in range(len(x) - 1):
        handed = system.step(x[k : k + 1], u[k : k + 1], hidden=out[-1]).hidden
        assert handed is not None, "a system with hidden state hands it on"
        out.append(handed)
    return np.concatenate(out)


def _frames(steps: int, period: float) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Which states are drawn: the first and the last, and evenly in between."""
    every = max(1, int(np.ceil(1 / (RATE * period) - 1e-9)), -(-steps // FRAMES))
    frames = np.arange(0, steps, every, dtype=np.intp)
    return frames if frames[-1] == steps - 1 else np.append(frames, steps - 1)
