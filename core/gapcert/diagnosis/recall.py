"""What hidden states remember where the history of a window begins: they are carried there along the measured motion."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import final

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
        past = _Past(model, windows.measured, {p: first[r] for p, r in rows.items()}, parameters, count)
        for piece, hidden in past.found().items():
            out[:, rows[piece]] = hidden
    return out.reshape(count * len(windows), -1)


@final
@dataclass(frozen=True)
class _Past:
    """Motions of all pieces at once, put back onto the measured states every STRETCH and at their stops (piece → samples)."""

    model: Model
    measured: Measured
    stops: Mapping[int, Array]
    parameters: Mapping[str, Array | float]
    count: int

    def found(self) -> dict[int, Array]:
        """Per piece, hidden states (count, stops, nh)."""
        known = self._at_once()
        if known is None:
            known = self._stepwise()
        return {p: np.stack([known[s][:, i] for s in self.stops[p].tolist()], axis=1) for i, p in enumerate(self.pieces)}

    @cached_property
    def pieces(self) -> list[int]:
        """Those that end last come first."""
        return sorted(self.stops, key=lambda p: -int(self.stops[p].max()))

    @cached_property
    def own(self) -> list[set[int]]:
        """The samples at which each piece is put back."""
        last = int(self.stops[self.pieces[0]].max())
        every = {0, *range(0, last, self.measured.samples(STRETCH))}
        return [every | set(self.stops[p].tolist()) for p in self.pieces]

    @cached_property
    def marks(self) -> list[int]:
        return sorted(set().union(*self.own))

    @cached_property
    def blind(self) -> Array:
        """States (nx,) that no channel shows: they go on as the model has them."""
        return np.asarray(~np.any(np.concatenate(self.measured.states), axis=0))

    @cached_property
    def start(self) -> Array:
        """Hidden states (count, pieces, nh) at the first sample."""
        hidden = np.tile(self.model.hidden_default, (self.count, len(self.pieces), 1))
        names = [s.name for s in self.model.hidden]
        if "time" in names:
            hidden[:, :, names.index("time")] = [self.measured.times[p][0] for p in self.pieces]
        return hidden

    def _rows(self, pieces: int) -> dict[str, Array | float]:
        return {n: np.repeat(v, pieces) if np.ndim(v) else v for n, v in self.parameters.items()}

    def _at_once(self) -> dict[int, Array] | None:
        """Mark → hidden states (count, pieces, nh), where the model knows a way."""
        m, w, steps = self.measured, len(self.pieces), max(1, self.marks[-1] * self.measured.repeat)
        path, u = np.full((w, steps, self.model.nx), np.nan), np.zeros((w, steps, self.model.nu))
        for i, p in enumerate(self.pieces):
            drive = m.drives[m.hold or "zero"][p][:steps]
            u[i, : len(drive)] = drive
            at = np.array([a for a in self.own[i] if a * m.repeat < steps and a < len(m.states[p])])
            path[i, at * m.repeat] = np.where(self.blind, np.nan, m.states[p][at])
        hidden = self.start.reshape(self.count * w, -1)
        found = self.model.fast_memories(path, u, [a * m.repeat for a in self.marks], self._rows(w), hidden)
        return None if found is None else {a: found[:, k].reshape(self.start.shape) for k, a in enumerate(self.marks)}

    def _stepwise(self) -> dict[int, Array]:
        """The same, by rollouts from mark to mark; pieces that end first leave first."""
        m, hidden, last = self.measured, self.start, np.array([self.stops[p].max() for p in self.pieces])
        known, x = {0: hidden}, np.tile([m.states[p][0] for p in self.pieces], (self.count, 1, 1))
        for a, b in itertools.pairwise(self.marks):
            here = self.pieces[: int(np.count_nonzero(last >= b))]
            w, steps = len(here), (b - a) * m.repeat
            free = self.blind | np.array([[a not in self.own[i]] for i in range(w)])
            x = np.where(free, np.nan_to_num(x[:, :w]), [m.states[p][a] for p in here])
            hidden = hidden[:, :w]
            moved = self.model.fast_rollout(
                x.reshape(self.count * w, -1),
                np.stack([m.drives[m.hold or "zero"][p][a * m.repeat : b * m.repeat] for p in here]),
                parameters=self._rows(w),
                hidden=hidden.reshape(self.count * w, -1),
                every=steps,
            )
            assert moved.hidden is not None
            new = moved.hidden.reshape(hidden.shape)
            x, hidden = moved.x[:, -1].reshape(x.shape), np.where(np.isfinite(new), new, hidden)
            known[b] = hidden
        return known
