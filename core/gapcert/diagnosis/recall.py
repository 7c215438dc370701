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
        rows = {piece: np.flatnonzero(windows.place[:, 0] == piece) for piece in np.unique(windows.place[:, 0]).tolist()}
        for piece, hidden in _along(model, windows.measured, {p: first[r] for p, r in rows.items()}, parameters, count).items():
            out[:, rows[piece]] = hidden
    return out.reshape(count * len(windows), -1)


def _along(
    model: Model, m: Measured, stops: Mapping[int, Array], parameters: Mapping[str, Array | float], count: int
) -> dict[int, Array]:
    """Per piece, hidden states (count, stops, nh) of a motion that is put back onto the measured states every STRETCH.

    All pieces go at once; those that end first leave first.
    """
    pieces = sorted(stops, key=lambda p: -int(stops[p].max()))
    last = np.array([stops[p].max() for p in pieces])
    blind, drives = ~np.any(np.concatenate(m.states), axis=0), m.drives[m.hold or "zero"]
    hidden = np.tile(model.hidden_default, (count, len(pieces), 1))
    names = [s.name for s in model.hidden]
    if "time" in names:
        hidden[:, :, names.index("time")] = [m.times[p][0] for p in pieces]
    every = {0, *range(0, int(last[0]), m.samples(STRETCH))}
    own = [every | set(stops[p].tolist()) for p in pieces]
    marks = sorted(set().union(*own))
    known, x = {0: hidden}, np.tile([m.states[p][0] for p in pieces], (count, 1, 1))
    for a, b in itertools.pairwise(marks):
        here = pieces[: int(np.count_nonzero(last >= b))]
        w, steps = len(here), (b - a) * m.repeat
        # What no channel shows goes on as the model has it.
        free = blind | np.array([[a not in own[i]] for i in range(w)])
        x = np.where(free, np.nan_to_num(x[:, :w]), [m.states[p][a] for p in here])
        hidden = hidden[:, :w]
        moved = model.fast_rollout(
            x.reshape(count * w, -1),
            np.stack([drives[p][a * m.repeat : b * m.repeat] for p in here]),
            parameters={n: np.repeat(v, w) if np.ndim(v) else v for n, v in parameters.items()},
            hidden=hidden.reshape(count * w, -1),
            every=steps,
        )
        assert moved.hidden is not None
        new = moved.hidden.reshape(hidden.shape)
        x, hidden = moved.x[:, -1].reshape(x.shape), np.where(np.isfinite(new), new, hidden)
        known[b] = hidden
    return {p: np.stack([known[s][:, i] for s in stops[p].tolist()], axis=1) for i, p in enumerate(pieces)}
