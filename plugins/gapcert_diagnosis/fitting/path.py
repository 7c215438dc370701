"""The measured, smoothed motion of windows, and how a model that is linearised along it moves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert.plugin import Array, Model, difference
from gapcert_diagnosis.data.dataset import Windows

from .fit import Fit
from .memory_states import recalled

NUDGE = 1e-5  # of a state's size, for slopes


def cut(windows: Windows, parts: int) -> Windows:
    """Each window as `parts` shorter ones, in order."""
    m, length = windows.measured, windows.length // parts
    place = np.repeat(windows.place, parts, axis=0)
    place[:, 1] += np.tile(length * np.arange(parts), len(windows))
    rows = place.tolist()
    y, weight, offset = (shortened(a, parts) for a in (windows.y, windows.weight, windows.offset))
    return Windows(
        m,
        np.array([m.times[i][s] for i, s in rows]),
        np.repeat(windows.trajectory, parts),
        y,
        np.stack([m.inputs[i][s - m.history : s + length] for i, s in rows]),
        np.stack([m.states[i][s - m.history] for i, s in rows]),
        np.stack([m.states[i][s] for i, s in rows]),
        weight,
        offset,
        place,
    )


def shortened(a: Array, parts: int) -> Array:
    """(W, L, …) → (W·parts, L // parts, …)."""
    length = a.shape[1] // parts
    return np.asarray(a[:, : parts * length].reshape(len(a) * parts, length, *a.shape[2:]))


@final
class Path:
    """The measured motion of windows at every model step, history first: x (W, P + S, nx), u (W, P + S, nu)."""

    def __init__(self, windows: Windows, guess: Fit) -> None:
        m, repeat = windows.measured, windows.measured.repeat
        self.windows, self.lead = windows, m.history * repeat
        steps = self.lead + (windows.length - 1) * repeat
        self.u = windows.drive()[:, :steps]
        samples = np.stack([m.states[i][s - m.history : s + windows.length] for i, s in windows.place.tolist()])
        self._fill(samples, guess)
        share = np.arange(repeat) / repeat
        between = samples[:, :-1, None] + share[:, None] * np.diff(samples, axis=1)[:, :, None]
        self.x, self.samples = between.reshape(len(windows), steps, -1), samples

    def _fill(self, samples: Array, guess: Fit) -> None:
        """States that no channel shows are those of the fit."""
        blind, history = ~np.any(samples, axis=(0, 1)), self.windows.measured.history
        if blind.any():
            motion = guess.hypothesis.motion(self.windows, guess.theta[None], guess.start[None])
            found = np.nan_to_num(motion[:, :: max(1, motion.shape[1] // self.windows.length)][:, : self.windows.length])
            samples[:, history:, blind] = found[..., blind]
            samples[:, :history, blind] = found[:, :1, blind]

    def next(
        self, model: Model, parameters: Mapping[str, Array], copies: int = 1, moved: Array | None = None, every: int = 1
    ) -> Array:
        """One step of a model from every state of the path, (copies, W, S, nx); parameters: name → (copies,).

        every: without hidden states, from every so many states only.
        """
        w, first, every = len(self.windows), 0 if model.hidden else self.lead, 1 if model.hidden else every
        x, u = (a[:, first::every] for a in (self.x, self.u))
        x, u = (np.broadcast_to(a, (copies, *a.shape)) for a in (x, u))
        if moved is not None:
            x = x + moved[:, None, None]
        new = model.along(
            x.reshape(copies * w, *x.shape[2:]),
            u.reshape(copies * w, *u.shape[2:]),
            parameters={n: np.repeat(v, w) for n, v in parameters.items()} or None,
            hidden=recalled(model, self.windows, parameters, copies) if model.hidden else None,
        )
        return np.asarray(new.reshape(copies, w, *new.shape[1:])[:, :, self.lead - first :])

    def output(self, model: Model, parameters: Mapping[str, float], moved: Array | float = 0.0) -> Array:
        """Measured channels (W, L, ny) of the path, late where the model says so."""
        m, count = self.windows.measured, self.samples.shape[1]
        x = (self.samples + moved).reshape(-1, model.nx)
        u = self.windows.u.reshape(len(x), model.nu)
        y = model.output(x, u, parameters or None).reshape(len(self.windows), count, -1)
        late, at, out = model.output_delays(parameters or None) / m.period, np.arange(count), y.copy()
        for c in np.flatnonzero(late).tolist():
            for w in range(len(y)):
                out[w, :, c] = np.interp(at - late[c], at, y[w, :, c])
        return np.asarray(out[:, m.history :][..., m.columns])


@final
@dataclass(frozen=True)
class Motion:
    """The linearised motion along the path: A (W, S, nx, nx), observe (W, L, ny, nx), and slopes in the free numbers of a fit.

    free (W, S, nx, p) per step; shown (W, L, ny, p) at the output.
    """

    A: Array
    observe: Array
    free: Array
    shown: Array

    @classmethod
    def of(cls, path: Path, fit: Fit) -> Motion:
        h, model, nx, p = fit.hypothesis, fit.hypothesis.model, fit.hypothesis.model.nx, len(fit.theta)
        size = NUDGE * np.maximum(np.sqrt(np.mean(path.x**2, axis=(0, 1))), 1e-3)
        width = np.where(fit.theta + h.step > h.high, -h.step, h.step)
        theta = np.tile(fit.theta, (1 + nx + p, 1))
        theta[1 + nx + np.arange(p), np.arange(p)] += width
        moved = np.zeros((1 + nx + p, nx))
        moved[1 + np.arange(nx), np.arange(nx)] = size
        scale = np.concatenate([size, width])
        new = path.next(model, dict(zip(h.names, theta.T, strict=True)), 1 + nx + p, moved)
        state = np.moveaxis(difference(model.states, new[1:], new[:1]), 0, -1) / scale
        values = [dict(zip(h.names, row, strict=True)) for row in theta.tolist()]
        plain, *others = (path.output(model, v, d) for v, d in zip(values, moved, strict=True))
        channels = path.windows.measured.channels
        shown = np.stack([difference(channels, y, plain) for y in others], axis=-1) / scale
        parts = state[..., :nx], shown[..., :nx], state[..., nx:], shown[..., nx:]
        return cls(*(np.ascontiguousarray(np.nan_to_num(a, nan=0.0, posinf=0.0, neginf=0.0)) for a in parts))
