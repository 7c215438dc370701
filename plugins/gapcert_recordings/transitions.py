"""From a log to transitions of one period: rows by the clock, with the input held."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Model, Recording, Trajectory, UsageError
from gapcert_recordings.thresholds import THRESHOLDS


@final
@dataclass(frozen=True)
class Transitions:
    """Steps of one period with the input held: t (n,) in s, x (n, nx), u (n, nu), x_next (n, nx), trajectory (n,) by number.

    `skipped` counts the rows that begin none: nothing was measured a period later, or the input moved meanwhile.
    """

    t: Array
    x: Array
    u: Array
    x_next: Array
    trajectory: npt.NDArray[np.intp]
    skipped: int

    @classmethod
    def of(cls, model: Model, recording: Recording, caller: str = "check") -> Transitions:
        """UsageError, told of the caller, where a state or an input is not measured, or no two rows are one period apart."""
        names = axes(model, caller)
        if missing := [n for n in names if n not in recording.names]:
            raise UsageError(
                f"{caller}: '{missing[0]}' is not in the log (there are {', '.join(recording.names)}); a certificate needs "
                f"every state and input: name columns so, or give the spec of a diagnosis, whose `recording:` maps others"
            )
        if recording.hold == "first":
            raise UsageError(f"{caller}: the log's inputs go in straight lines (hold: first), and γ is about held ones")
        units = {s.name: s.unit for s in (*model.states, *model.inputs)}
        recording = recording.converted({n: units[n] for n in recording.units if n in units})
        parts = [(i, *_steps(piece, names, model)) for i, tr in enumerate(recording.trajectories) for piece in _forward(tr)]
        rows = [part for part in parts if len(part[1])]
        if not rows:
            periods = sorted({f"{tr.period:.4g}" for tr in recording.trajectories})
            raise UsageError(
                f"{caller}: no two rows are one period of {model.period:g} s apart with the input held and every value there "
                f"(rows are {', '.join(periods)} s apart); log at that rate, or certify a model of the log's period"
            )
        t, x, u, after = (np.concatenate([r[k] for r in rows]) for k in (1, 2, 3, 4))
        of = np.concatenate([np.full(len(r[1]), r[0]) for r in rows])
        return cls(t, x, u, after, of, sum(len(tr) for tr in recording.trajectories) - len(t))

    def __len__(self) -> int:
        return len(self.t)

    def followed(self, rows: npt.NDArray[np.bool_], period: float) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
        """Among the chosen rows, counted anew: (k, m) where transition m begins as transition k ends."""
        t, of = self.t[rows], self.trajectory[rows]
        found: list[tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]] = []
        for i in np.unique(of):
            own = np.flatnonzero(of == i)
            own = own[np.argsort(t[own], kind="stable")]
            m = np.minimum(np.searchsorted(t[own], t[own] + period * (1 - THRESHOLDS.period_error)), len(own) - 1)
            good = np.abs(t[own[m]] - t[own] - period) <= THRESHOLDS.period_error * period
            found.append((own[good], own[m[good]]))
        none = np.zeros(0, dtype=np.intp)
        return np.concatenate([none, *(k for k, _ in found)]), np.concatenate([none, *(m for _, m in found)])


def _forward(tr: Trajectory) -> Iterator[tuple[Array, Mapping[str, Array]]]:
    """Stretches in which time goes forward."""
    cuts = [0, *(np.flatnonzero(~(np.diff(tr.t) > 0)) + 1).tolist(), len(tr.t)]
    for a, b in itertools.pairwise(cuts):
        yield tr.t[a:b], {n: v[a:b] for n, v in tr.channels.items()}


def _steps(piece: tuple[Array, Mapping[str, Array]], names: Sequence[str], model: Model) -> tuple[Array, Array, Array, Array]:
    """(t, x, u, x⁺) of every row with another one period later."""
    t, channels = piece
    z = np.stack([channels[n] for n in names], axis=1)
    nx, slack = model.nx, THRESHOLDS.period_error * model.period
    end = np.searchsorted(t, t + model.period - slack)
    k = np.flatnonzero(end < len(t))
    m = end[k]
    # NaN differs from itself, so an input that is missing counts as one that moved.
    moved = np.concatenate([[0], np.cumsum((z[1:, nx:] != z[:-1, nx:]).any(axis=1))])
    good = (np.abs(t[m] - t[k] - model.period) <= slack) & (moved[m - 1] == moved[k])
    good &= np.isfinite(z[k]).all(axis=1) & np.isfinite(z[m, :nx]).all(axis=1)
    k, m = k[good], m[good]
    return t[k], z[k, :nx], z[k, nx:], z[m, :nx]


def axes(model: Model, caller: str = "check") -> list[str]:
    """The names of what a log has to hold: states and inputs; UsageError where no log can."""
    if turned := [s.name for s in model.states if s.size > 1]:
        raise UsageError(f"{caller}: '{turned[0]}' is a rotation, and Z has no range for one")
    if model.hidden:
        raise UsageError(f"{caller}: the model remembers {model.hidden[0].name}, which no row of a log holds")
    return [s.name for s in (*model.states, *model.inputs)]
