"""A recording in a model's terms: noise floor, first guesses of the states, and windows."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from scipy.signal import savgol_filter

from gapcert.errors import UsageError
from gapcert.recording import Recording, Trajectory
from gapcert.system import Array, Model, StateSpec

HISTORY = 0.1  # s of input before a window that effects with memory may look back on
SMOOTHING = 0.03  # s on either side, for the starts of the fits only


def noise_floor(y: Array) -> float:
    """σ of white noise on a smooth signal y (T,): the k-th difference has variance C(2k, k)·σ² once k is high enough.

    The lowest order k = 2…7 within 3 % of the least value at higher orders; a plain minimum is 4 % low.
    """
    values = [float(np.sqrt(np.mean(np.diff(y, k) ** 2) / math.comb(2 * k, k))) for k in range(2, 8)]
    for k, value in enumerate(values[:-1]):
        if value <= 1.03 * min(values[k + 1 :]):
            return value
    return values[-1]


@final
@dataclass(frozen=True)
class Measured:
    """A recording in the model's terms, per trajectory: times (T,), outputs (T, ny), inputs (T, nu), smoothed states (T, nx).

    columns: where the measured channels are in `model.output`; repeat: model periods per sample; sigma, spread (ny,): noise
    floor and standard deviation of each channel.
    """

    channels: tuple[StateSpec, ...]
    columns: tuple[int, ...]
    period: float
    repeat: int
    times: tuple[Array, ...]
    outputs: tuple[Array, ...]
    inputs: tuple[Array, ...]
    states: tuple[Array, ...]
    sigma: Array
    spread: Array

    @classmethod
    def of(cls, model: Model, recording: Recording) -> Measured:
        """UsageError where a needed channel is missing, or where the samples are not a whole number of model periods apart."""
        channels, columns = _channels(model, recording)
        specs = {s.name: s.unit for s in (*channels, *model.inputs)}
        recording = recording.converted(specs)
        period = recording.period
        repeat = round(period / model.period)
        if repeat < 1 or abs(repeat * model.period - period) > 1e-3 * period:
            raise UsageError(
                f"recording: samples are {period:.6g} s apart, the model steps by {model.period:.6g} s; expected a whole "
                f"number of steps per sample; set the model's period to {period:.6g} s or a whole fraction of it"
            )
        outputs, inputs, states = [], [], []
        for tr in recording.trajectories:
            y = _stack(tr, channels)
            outputs.append(y)
            inputs.append(_stack(tr, model.inputs))
            states.append(_smoothed(model, channels, y, period))
        spread = np.std(np.concatenate(outputs), axis=0)
        if (still := np.flatnonzero(spread == 0)).size:
            raise UsageError(f"recording: '{channels[still[0]].name}' never changes; record a motion, or leave the channel out")
        sizes = np.array([len(y) for y in outputs])
        floors = np.array([[noise_floor(y[:, c]) for c in range(len(channels))] for y in outputs])
        # Data without noise would otherwise ask the model for more digits than any integrator has.
        sigma = np.maximum(np.sqrt(sizes @ floors**2 / sizes.sum()), 1e-5 * spread)
        times = tuple(tr.t for tr in recording.trajectories)
        return cls(channels, columns, period, repeat, times, tuple(outputs), tuple(inputs), tuple(states), sigma, spread)

    @property
    def history(self) -> int:
        """Samples of input kept before every window."""
        return math.ceil(HISTORY / self.period - 1e-6)

    def samples(self, seconds: float) -> int:
        return max(1, round(seconds / self.period))

    def windows(self, length: int, stride: int | None = None) -> Windows:
        """Windows of `length` samples: as many as fit side by side, or one every `stride` samples."""
        parts = []
        for i, y in enumerate(self.outputs):
            last = len(y) - length
            count = (len(y) - self.history) // length
            starts = self.history + length * np.arange(count) if stride is None else np.arange(self.history, last + 1, stride)
            parts += [(i, int(s)) for s in starts]
        if not parts:
            need, window = (length + self.history) * self.period, length * self.period
            raise UsageError(
                f"recording: no stretch of {need:.3g} s, which a window of {window:.3g} s needs; record for longer"
            )
        h, reach = self.history, np.arange(length)
        return Windows(
            self,
            np.array([self.times[i][s] for i, s in parts]),
            np.array([i for i, _ in parts]),
            np.stack([self.outputs[i][s + reach] for i, s in parts]),
            np.stack([self.inputs[i][s - h : s + length] for i, s in parts]),
            np.stack([self.states[i][s - h] for i, s in parts]),
            np.stack([self.states[i][s] for i, s in parts]),
        )


@final
@dataclass(frozen=True)
class Windows:
    """W stretches of L samples: outputs y (W, L, ny), inputs with their history u (W, H + L, nu), guessed states (W, nx)."""

    measured: Measured
    t: Array
    trajectory: Array
    y: Array
    u: Array
    before: Array
    start: Array

    def __len__(self) -> int:
        return len(self.t)

    @property
    def length(self) -> int:
        return int(self.y.shape[1])

    def take(self, rows: Array) -> Windows:
        return Windows(self.measured, *(getattr(self, n)[rows] for n in ("t", "trajectory", "y", "u", "before", "start")))

    def head(self, length: int) -> Windows:
        """Their first `length` samples."""
        return replace(self, y=self.y[:, :length], u=self.u[:, : self.measured.history + length])

    def guard(self, share: float = 0.25) -> tuple[Windows, Windows]:
        """(earlier, later): the last quarter of every trajectory's windows, in time order, judges what the rest suggests."""
        late = np.zeros(len(self), dtype=bool)
        for i in np.unique(self.trajectory):
            rows = np.flatnonzero(self.trajectory == i)
            late[rows[len(rows) - round(share * len(rows)) :]] = True
        if late.all() or not late.any():
            raise UsageError(
                f"recording: {len(self)} windows are too few to fit on some and check on others; record for longer"
            )
        return self.take(~late), self.take(late)


def _channels(model: Model, recording: Recording) -> tuple[tuple[StateSpec, ...], tuple[int, ...]]:
    if missing := [u.name for u in model.inputs if u.name not in recording.names]:
        found = ", ".join(recording.names)
        raise UsageError(f"recording: no channel for the input '{missing[0]}' (there are {found}); add it to `columns`")
    names = {s.name for s in (*model.inputs, *model.outputs)}
    if unknown := [n for n in recording.names if n not in names]:
        there = ", ".join(sorted(names))
        raise UsageError(f"recording: channel '{unknown[0]}' is no input or output of the model; there are {there}")
    columns = tuple(i for i, s in enumerate(model.outputs) if s.name in recording.names)
    if not columns:
        outputs = ", ".join(s.name for s in model.outputs)
        raise UsageError(f"recording: no output is measured; add one of {outputs} to `columns`")
    return tuple(model.outputs[i] for i in columns), columns


def _stack(tr: Trajectory, specs: tuple[StateSpec, ...]) -> Array:
    """Channels as columns (T, k), angles unwrapped."""
    columns = [np.unwrap(tr.channels[s.name]) if s.kind == "angle" else tr.channels[s.name] for s in specs]
    return np.stack(columns, axis=-1) if columns else np.zeros((len(tr), 0))


def _smoothed(model: Model, channels: tuple[StateSpec, ...], y: Array, period: float) -> Array:
    """First guesses of the states (T, nx): smoothed where measured, the slope of what they drive where not, else zero."""
    width = min(2 * max(2, round(SMOOTHING / period)) + 1, len(y) - 1 + len(y) % 2)
    at = {c.name: i for i, c in enumerate(channels)}
    smooth = savgol_filter(y, width, 3, axis=0)
    slope = savgol_filter(y, width, 3, deriv=1, delta=period, axis=0)
    jacobian = model.jacobian(np.zeros((1, model.nx)), np.zeros((1, model.nu)))[0] / model.period
    x = np.zeros((len(y), model.nx))
    for j, state in enumerate(model.states):
        if state.name in at:
            x[:, j] = smooth[:, at[state.name]]
            continue
        for i, other in enumerate(model.states):
            # ∂xᵢ⁺/∂xⱼ ≈ period: xⱼ is the velocity of xᵢ.
            if i != j and other.name in at and abs(jacobian[i, j] - 1) < 0.05:
                x[:, j] = slope[:, at[other.name]]
    return x
