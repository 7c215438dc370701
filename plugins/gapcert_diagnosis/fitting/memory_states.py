"""What hidden states remember where the history of a window begins: they are carried there along the measured motion."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import final
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Model
from gapcert_diagnosis.data.dataset import Dataset, Windows
from gapcert_diagnosis.thresholds import THRESHOLDS


def recalled(model: Model, windows: Windows, parameters: Mapping[str, Array | float], count: int) -> Array:
    """Hidden states (count·W, nh), `history` samples before each window, for parameters of shape (count,) or ().

    A lag, a play or a sagging supply knows more of the past than the history before a window tells.
    """
    out = _defaults(model, count, windows.t - windows.measured.history * windows.measured.period)
    if model.remembers:
        if windows not in _WAYS:
            first = windows.place[:, 1] - windows.measured.history
            rows = {piece: np.flatnonzero(windows.place[:, 0] == piece) for piece in np.unique(windows.place[:, 0]).tolist()}
            _WAYS[windows] = _Way(windows.measured, rows, {p: first[r] for p, r in rows.items()})
        for piece, hidden in _Past(model, _WAYS[windows], parameters, count).found().items():
            out[:, _WAYS[windows].rows[piece]] = hidden
    return out.reshape(count * len(windows), -1)


def _defaults(model: Model, count: int, t: Array) -> Array:
    """Hidden states (count, n, nh) at times (n,) of which nothing is remembered."""
    out = np.tile(model.hidden_default, (count, len(t), 1))
    names = [s.name for s in model.hidden]
    if "time" in names:
        out[:, :, names.index("time")] = t
    return out


@final
@dataclass(frozen=True)
class _Way:
    """The measured motion of all pieces, onto which models are put back every `free_stretch` and at their stops (piece →
    samples).

    rows: piece → the windows that begin in it. It is the same for every model and all its numbers.
    """

    measured: Dataset
    rows: Mapping[int, npt.NDArray[np.intp]]
    stops: Mapping[int, Array]

    @cached_property
    def pieces(self) -> list[int]:
        """Those that end last come first."""
        return sorted(self.stops, key=lambda p: -int(self.stops[p].max()))

    @cached_property
    def own(self) -> list[set[int]]:
        """The samples at which each piece is put back."""
        last = int(self.stops[self.pieces[0]].max())
        every = {0, *range(0, last, self.measured.samples(THRESHOLDS.free_stretch))}
        return [every | set(self.stops[p].tolist()) for p in self.pieces]

    @cached_property
    def marks(self) -> list[int]:
        return sorted(set().union(*self.own))

    @cached_property
    def blind(self) -> Array:
        """States (nx,) that no channel shows: they go on as the model has them."""
        return np.asarray(~np.any(np.concatenate(self.measured.states), axis=0))

    @cached_property
    def path(self) -> tuple[Array, Array]:
        """(states (pieces, steps, nx), NaN where the motion is free; inputs (pieces, steps, nu)) at every model step."""
        m, w, steps = self.measured, len(self.pieces), max(1, self.marks[-1] * self.measured.repeat)
        path, u = np.full((w, steps, m.states[0].shape[1]), np.nan), np.zeros((w, steps, m.driven[0].shape[1]))
        for i, p in enumerate(self.pieces):
            drive = m.driven[p][:steps]
            u[i, : len(drive)] = drive
            at = np.array([a for a in self.own[i] if a * m.repeat < steps and a < len(m.states[p])])
            path[i, at * m.repeat] = np.where(self.blind, np.nan, m.states[p][at])
        return path, u


_WAYS = WeakKeyDictionary[Windows, _Way]()


@final
@dataclass(frozen=True)
class _Past:
    """Motions along a way."""

    model: Model
    way: _Way
    parameters: Mapping[str, Array | float]
    count: int

    def found(self) -> dict[int, Array]:
        """Per piece, hidden states (count, stops, nh)."""
        known, way = self._at_once() or self._stepwise(), self.way
        return {p: np.stack([known[s][:, i] for s in way.stops[p].tolist()], axis=1) for i, p in enumerate(way.pieces)}

    @cached_property
    def start(self) -> Array:
        """Hidden states (count, pieces, nh) at the first sample."""
        return _defaults(self.model, self.count, np.array([self.way.measured.times[p][0] for p in self.way.pieces]))

    def _rows(self, pieces: int) -> dict[str, Array | float]:
        return {n: np.repeat(v, pieces) if np.ndim(v) else v for n, v in self.parameters.items()}

    def _at_once(self) -> dict[int, Array] | None:
        """Mark → hidden states (count, pieces, nh), where the model knows a way."""
        way, (path, u) = self.way, self.way.path
        hidden = self.start.reshape(self.count * len(way.pieces), -1)
        stops = [a * way.measured.repeat for a in way.marks]
        found = self.model.fast_memories(path, u, stops, self._rows(len(way.pieces)), hidden)
        return None if found is None else {a: found[:, k].reshape(self.start.shape) for k, a in enumerate(way.marks)}

    def _stepwise(self) -> dict[int, Array]:
        """The same, by rollouts from mark to mark; pieces that end first leave first."""
        way, m, hidden = self.way, self.way.measured, self.start
        last = np.array([way.stops[p].max() for p in way.pieces])
        known, x = {0: hidden}, np.tile([m.states[p][0] for p in way.pieces], (self.count, 1, 1))
        for a, b in itertools.pairwise(way.marks):
            here = way.pieces[: int(np.count_nonzero(last >= b))]
            w, steps = len(here), (b - a) * m.repeat
            free = way.blind | np.array([[a not in way.own[i]] for i in range(w)])
            x = np.where(free, np.nan_to_num(x[:, :w]), [m.states[p][a] for p in here])
            hidden = hidden[:, :w]
            moved = self.model.fast_rollout(
                x.reshape(self.count * w, -1),
                np.stack([m.driven[p][a * m.repeat : b * m.repeat] for p in here]),
                parameters=self._rows(w),
                hidden=hidden.reshape(self.count * w, -1),
                every=steps,
            )
            assert moved.hidden is not None
            new = moved.hidden.reshape(hidden.shape)
            x, hidden = moved.x[:, -1].reshape(x.shape), np.where(np.isfinite(new), new, hidden)
            known[b] = hidden
        return known
