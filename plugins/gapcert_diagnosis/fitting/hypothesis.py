"""A model with free numbers, and what it predicts for windows of a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Model, difference
from gapcert_diagnosis.data.dataset import Windows
from gapcert_diagnosis.thresholds import THRESHOLDS

from .memory_states import recalled


@final
@dataclass(frozen=True)
class Hypothesis:
    """A model with free numbers: first values, bounds, difference steps; sd: of a normal prior about `value`, inf for none."""

    model: Model
    names: tuple[str, ...] = ()
    value: Array = field(default_factory=lambda: np.empty(0))
    low: Array = field(default_factory=lambda: np.empty(0))
    high: Array = field(default_factory=lambda: np.empty(0))
    step: Array = field(default_factory=lambda: np.empty(0))
    sd: Array = field(default_factory=lambda: np.empty(0))
    fixed: Mapping[str, float] = field(default_factory=dict)

    @property
    def charged(self) -> int:
        """Free numbers that the nominal model does not have."""
        return int(np.isinf(self.sd).sum())

    def prior(self, theta: Array) -> Array:
        """Σ ((θ − θ₀)/sd)² of theta (…, p)."""
        return np.asarray(np.sum(((theta - self.value) / self.sd) ** 2, axis=-1))

    def holding(self, theta: Array, keep: Sequence[str] = ()) -> Hypothesis:
        """With the numbers fixed at theta, except those named in `keep`."""
        free = np.array([n in keep for n in self.names], dtype=bool)
        fixed = {**self.fixed, **{n: float(v) for n, v, f in zip(self.names, theta, free, strict=True) if not f}}
        names = tuple(n for n in self.names if n in keep)
        value, low, high, step, sd = (p[free] for p in (self.value, self.low, self.high, self.step, self.sd))
        return Hypothesis(self.model, names, value, low, high, step, sd, fixed)

    def simulate(self, windows: Windows, theta: Array, start: Array) -> Array:
        """Outputs (b, W, L, ny) from theta (b, p) and starts (b, W, nx), at the times of the samples.

        Not finite where a motion blows up.
        """
        b, (w, length, _), m = len(theta), windows.y.shape, windows.measured
        with np.errstate(all="ignore"):
            x = self.motion(windows, theta, start, every=m.repeat).reshape(b * w * length, -1)
            shown, values = x, self._values(theta, w)
            if not self._shows_states():
                u = np.broadcast_to(windows.u[None, :, m.history :], (b, w, length, self.model.nu))
                rows = {n: np.repeat(v, length) if np.ndim(v) else v for n, v in values.items()}
                shown = self.model.output(x, u.reshape(b * w * length, -1), rows)
            every = m.columns == tuple(range(shown.shape[1]))
            y = (shown if every else shown[:, m.columns]).reshape(b, w, length, -1)
            late = np.broadcast_to(self.model.output_delays(values), (b * w, len(self.model.outputs)))[:, m.columns]
            if late.any() or windows.offset.any():
                ahead = windows.offset[None, :, :, None] - late.reshape(b, w, 1, -1)
                y = between(y, ahead / m.period)
        return np.asarray(y)

    def motion(self, windows: Windows, theta: Array, start: Array, every: int = 1) -> Array:
        """States (b·W, (L − 1)·repeat // every + 1, nx) at every `every`-th model step."""
        b, w, m = len(theta), len(windows), windows.measured
        hidden = None if windows.memory is None else np.tile(windows.memory, (b, 1))
        if self.model.hidden and hidden is None:
            # Rows that differ in their starts alone have one past.
            given = [tuple(row) for row in theta.tolist()]
            different = sorted(set(given))
            hidden = self.hidden(windows, np.array(different)).reshape(len(different), w, -1)
            hidden = hidden[[different.index(row) for row in given]].reshape(b * w, -1)
        u = windows.drive[:, m.past : m.past + (windows.length - 1) * m.repeat]
        start = start.reshape(b * w, -1)
        return self.model.fast_rollout(start, u, parameters=self._values(theta, w), hidden=hidden, every=every).x

    def led(self, windows: Windows, theta: Array, start: Array, rows: npt.NDArray[np.bool_]) -> Windows:
        """Windows whose history begins, in these rows, with the state (nx,) that leads to their start: Newton's shooting.

        At the edge of a recording speeds are guessed worst, and a bristle is bent by whatever they lead to.
        """
        part = windows.take(rows)
        past, nx = part.measured.past, start.shape[1]
        u, before, values = part.drive[:, :past], part.before.copy(), self._values(theta[None], len(part))
        hidden = recalled(self.model, part, self._values(theta[None], 1), 1)
        size = nudges(start)
        many = {n: np.tile(v, nx + 1) if np.ndim(v) else v for n, v in values.items()}
        for _ in range(THRESHOLDS.history_shots):
            tried = np.concatenate([before, *(before + size * e for e in np.eye(nx))])
            with np.errstate(all="ignore"):
                moved = self.model.fast_rollout(tried, u, parameters=many, hidden=np.tile(hidden, (nx + 1, 1)), every=past)
            end = moved.x[:, -1].reshape(nx + 1, len(part), nx)
            slope = np.moveaxis(difference(self.model.states, end[1:], end[0]), 0, -1) / size
            miss = difference(self.model.states, start[rows], end[0])
            if not (np.isfinite(slope).all() and np.isfinite(miss).all()):
                return windows
            before = before + (np.linalg.pinv(slope, rcond=THRESHOLDS.history_cutoff) @ miss[..., None])[..., 0]
        return windows.begun(before, rows)

    def remembering(self, windows: Windows, theta: Array) -> Windows:
        """Windows for rollouts at one theta (p,) only: what the model remembers where they begin is found once."""
        return replace(windows, memory=self.hidden(windows, theta[None]) if self.model.hidden else None)

    def hidden(self, windows: Windows, theta: Array) -> Array:
        """Hidden states (b·W, nh) at the windows' beginnings, from motions through the history before them."""
        b, w, u = len(theta), len(windows), windows.drive[:, : windows.measured.past]
        hidden = recalled(self.model, windows, self._values(theta, 1), b)
        before, values = np.tile(windows.before, (b, 1)), self._values(theta, w)
        after = self.model.fast_rollout(before, u, parameters=values, hidden=hidden, every=max(1, u.shape[1])).hidden
        return hidden if after is None else after

    def _values(self, theta: Array, w: int) -> dict[str, Array | float]:
        """Of the parameters, one per row where they are free."""
        return {**self.fixed, **{n: np.repeat(theta[:, i], w) for i, n in enumerate(self.names)}}

    def _shows_states(self) -> bool:
        x = np.zeros((1, self.model.nx))
        return self.model.output(x, np.zeros((1, self.model.nu))) is x


def nudges(x: Array, share: float = THRESHOLDS.start_nudge) -> Array:
    """Difference steps (nx,) of states (…, nx)."""
    return np.asarray(share * np.maximum(np.sqrt(np.mean(x**2, axis=tuple(range(x.ndim - 1)))), 1e-3))


def between(y: Array, ahead: Array) -> Array:
    """Values of signals y (b, W, L, ny) `ahead` samples after each (broadcast to y): cubic through the four nearest."""
    length = y.shape[2]
    nodes = min(THRESHOLDS.sample_nodes, length)
    at = np.arange(length)[:, None] + np.broadcast_to(ahead, y.shape)
    first = np.clip(np.floor(np.nan_to_num(at)) - (nodes // 2 - 1), 0, length - nodes)
    inside, base = at - first, first.astype(np.int64)
    out = np.zeros_like(y)
    for j in range(nodes):
        weight = np.ones_like(y)
        for k in range(nodes):
            if k != j:
                weight *= (inside - k) / (j - k)
        out += weight * np.take_along_axis(y, base + j, axis=2)
    return out
