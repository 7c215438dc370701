"""What hidden states remember where the history of a window begins: they are carried there along the measured motion."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np

from gapcert.diagnosis.measured import Measured, Windows
from gapcert.system import Array, Model

STRETCH = 1.0  # s of free motion before the model is put back onto the measured one


def recalled(model: Model, windows: Windows, parameters: Mapping[str, Array | float], count: int) -> Array:
    """Hidden states (count·W, nh), `history` samples before each window, for parameters of shape (count,) or ().

    A lag, a play or a sagging supply knows more of the past than the history before a window tells.
    """
    out = np.tile(model.hidden_default, (count, len(windows), 1))
    names = [s.name for s in model.hidden]
    if "time" in names:
        out[:, :, names.index("time")] = windows.t - windows.measured.history * windows.measured.period
    if model.remembers:
        first = windows.place[:, 1] - windows.measured.history
        for piece in np.unique(windows.place[:, 0]).tolist():
            rows = np.flatnonzero(windows.place[:, 0] == piece)
            out[:, rows] = _along(model, windows.measured, piece, first[rows], parameters, count)
    return out.reshape(count * len(windows), -1)


def _along(model: Model, m: Measured, piece: int, stops: Array, parameters: Mapping[str, Array | float], count: int) -> Array:
    """Hidden states (count, stops, nh) of a motion that is put back onto the measured states every STRETCH."""
    states, drive = m.states[piece], m.drives[m.hold or "zero"][piece]
    blind = ~np.any(np.concatenate(m.states), axis=0)
    hidden = np.tile(model.hidden_default, (count, 1))
    names = [s.name for s in model.hidden]
    if "time" in names:
        hidden[:, names.index("time")] = m.times[piece][0]
    marks = sorted({0, *stops.tolist(), *range(0, int(stops.max()), m.samples(STRETCH))})
    known, x = {0: hidden}, np.tile(states[0], (count, 1))
    for a, b in itertools.pairwise(marks):
        # What no channel shows goes on as the model has it.
        x = np.where(blind, np.nan_to_num(x), states[a])
        steps = (b - a) * m.repeat
        moved = model.fast_rollout(
            x, drive[None, a * m.repeat : b * m.repeat], parameters=parameters, hidden=hidden, every=steps
        )
        assert moved.hidden is not None
        x, hidden = moved.x[:, -1], np.where(np.isfinite(moved.hidden), moved.hidden, hidden)
        known[b] = hidden
    return np.stack([known[s] for s in stops.tolist()], axis=1)
