"""Is an input a function of what is measured? Then a log was made under feedback, which hides what the controller cancels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert.plugin import Array, Bools, Model
from gapcert_diagnosis.thresholds import THRESHOLDS

from .dataset import Dataset, at_once


@final
@dataclass(frozen=True)
class Loop:
    """An input that follows what is measured, the share of it that tells, and the largest such share without feedback.

    by: `surprise`: of what the past of the input does not tell, by what is measured up to then; `state`: of the changes of the
    input, by those of the state, against the same spectrum played to the model without feedback; `switch`: of the moments at
    which the state would have the input switch, and it does not, against the same levels held as long in another order.
    """

    input: str
    by: str
    share: float
    chance: float

    @property
    def told(self) -> str:
        """What is known of it, and what it costs."""
        told, chance = f"{100 * self.share:.2g} %", f"{100 * self.chance:.2g} %"
        how = f"what is measured tells {told} of what its own past does not"
        if self.by == "state":
            how = f"the state tells {told} of its changes, and {chance} at most without a loop"
        if self.by == "switch":
            how = f"by the state it should switch at {told} of the moments at which it does not, and at {chance} without a loop"
        return (
            f"{self.input} is under feedback ({how}): what the controller cancels hides in it, and causes look smaller than "
            "they are where only the held error shows; a log in which it is commanded, or moves faster, shows more"
        )


def loops(model: Model, measured: Dataset, seed: int = 0) -> tuple[Loop, ...]:
    """The inputs that a controller computes from what is measured, as far as the log shows it."""
    rng, found = np.random.default_rng(seed), []
    for i, s in enumerate(model.inputs):
        values = np.concatenate([u[:, i] for u in measured.inputs])
        if np.ptp(values) <= THRESHOLDS.still * np.abs(values).max():
            continue
        share, chance = _surprise(model, measured, i, rng)
        if share > THRESHOLDS.loop_surprised + 2 * chance:
            found.append(Loop(s.name, "surprise", share, chance))
            continue
        share, chance = _of_state(model, measured, i, rng)
        if share > THRESHOLDS.loop_share and 1 - share < THRESHOLDS.loop_rest * (1 - chance):
            found.append(Loop(s.name, "state", share, chance))
            continue
        share, chance = _switched(model, measured, i, rng)
        if share < THRESHOLDS.loop_switch * chance:
            found.append(Loop(s.name, "switch", share, chance))
    return tuple(found)


def _surprise(model: Model, measured: Dataset, i: int, rng: np.random.Generator) -> tuple[float, float]:
    """(share, most by chance) of what an input's past does not tell of it that the measurement up to that sample does.

    Without feedback that is nothing. A channel that the input itself may have moved visibly within the sample starts one later.
    """
    (own_past, past), m = THRESHOLDS.loop_past, measured
    late = _at_once(model, m, i)
    mine, theirs, target = [], [], []
    for y, u in zip(m.outputs, m.inputs, strict=True):
        if len(y) <= 4 * own_past:
            continue
        rows = np.arange(own_past, len(y))
        y = np.where(np.isfinite(y), y, 0.0)
        mine.append(np.hstack([u[rows - k] for k in range(1, own_past + 1)]))
        theirs.append(np.stack([y[rows - k - late[c], c] for c in range(y.shape[1]) for k in range(past)], axis=1))
        target.append(u[rows, i])
    if not target:
        return 0.0, 0.0
    own, seen, u = (np.concatenate(a) for a in (mine, theirs, target))
    own, seen, u = (a[_even(u - own[:, i])] for a in (own, seen, u))
    if len(u) < THRESHOLDS.usual_samples * own_past:
        return 0.0, 0.0
    before = _left(own, u)
    if before <= THRESHOLDS.loop_surprise**2 * float(np.var(u)):
        return 0.0, 0.0
    share = 1 - _left(np.hstack([own, seen]), u) / before
    turns = rng.integers(len(u) // 4, 3 * len(u) // 4, THRESHOLDS.loop_turns).tolist()
    if share <= THRESHOLDS.loop_surprised:
        return share, 0.0  # which is none, whatever chance does
    return share, max(0.0, *(1 - _left(np.hstack([own, np.roll(seen, k, axis=0)]), u) / before for k in turns))


def _at_once(model: Model, m: Dataset, i: int) -> list[int]:
    """Per channel 1 where a sudden change of the input shows within the same sample, else 0."""
    x, u = (np.concatenate(a)[:: max(1, sum(map(len, m.inputs)) // 200)] for a in (m.states, m.inputs))
    sudden = float(np.sqrt(np.mean(np.concatenate([np.diff(a[:, i]) for a in m.inputs]) ** 2)))
    reached = at_once(model, x, u, sudden * (np.arange(model.nu) == i), m.repeat)
    moved = np.sqrt(np.mean(reached**2, axis=0))[list(m.columns)]
    return [int(a > THRESHOLDS.same_motion * s) for a, s in zip(moved, m.sigma, strict=True)]


def _of_state(model: Model, m: Dataset, i: int, rng: np.random.Generator) -> tuple[float, float]:
    """(share, most without feedback) of an input that is a linear function of the smoothed state.

    Without feedback: the model under inputs of the same spectrum, whose phases are drawn, from where the recording begins.
    """
    piece = int(np.argmax([len(u) for u in m.inputs]))
    count = min(len(m.inputs[piece]), THRESHOLDS.loop_samples)
    x, u = m.states[piece][:count], m.inputs[piece][:count]
    share = _told(x, u[:, i], m)
    if share < THRESHOLDS.loop_share or model.hidden:
        return 0.0, 0.0
    drawn = _surrogates(u, rng)
    held = np.repeat(drawn, m.repeat, axis=1)[:, : (count - 1) * m.repeat]
    with np.errstate(all="ignore"):
        moved = model.fast_rollout(np.repeat(x[:1], len(drawn), axis=0), held, every=m.repeat).x
    return share, max((_told(a, b[:, i], m) for a, b in zip(moved, drawn, strict=True) if np.isfinite(a).all()), default=0.0)


def _switched(model: Model, m: Dataset, i: int, rng: np.random.Generator) -> tuple[float, float]:
    """(share, least without feedback) of moments at which the state would have an input of few levels switch, and it does not.

    Without feedback: the model under the same levels, each held for as long as at another of its turns, anywhere or nearby.
    """
    piece = int(np.argmax([len(u) for u in m.inputs]))
    count = min(len(m.inputs[piece]), THRESHOLDS.loop_samples)
    x, u = m.states[piece][:count], m.inputs[piece][:count]
    at, number = np.flatnonzero(np.diff(u[:, i])) + 1, len(np.unique(u[:, i]))
    if number > THRESHOLDS.relay_levels or len(at) < THRESHOLDS.relay_switches * number or model.hidden:
        return 1.0, 0.0
    found = [(1.0, 0.0)]
    for nearby in (len(at), THRESHOLDS.relay_nearby):
        turns = np.arange(len(at)) // nearby
        drawn = np.repeat(u[None], THRESHOLDS.loop_turns, axis=0)
        for row in drawn:
            held = np.diff(at)
            for k in np.unique(turns):
                for level in np.unique(u[:, i]):
                    rows = np.flatnonzero((turns[:-1] == k) & (u[at[:-1], i] == level))
                    held[rows] = rng.permutation(held[rows])
            row[at[0] : at[-1], i] = np.repeat(u[at[:-1], i], held)
        with np.errstate(all="ignore"):
            fine = np.repeat(drawn, m.repeat, axis=1)[:, : (count - 1) * m.repeat]
            moved = model.fast_rollout(np.repeat(x[:1], len(drawn), axis=0), fine, every=m.repeat).x
        seen = [_early(a, b[:, i], nearby) for a, b in zip(moved, drawn, strict=True) if np.isfinite(a).all()]
        found.append((_early(x, u[:, i], nearby), min(seen, default=0.0)))
    return min(found, key=lambda f: f[0] / max(f[1], 1e-9))


def _early(x: Array, u: Array, nearby: int) -> float:
    """The share of (moment at which u switches, moment at which it does not) whose states are in the wrong order.

    Along the one direction that tells them apart, among moments of one level, about the mean of so many switches.
    """
    at = np.flatnonzero(np.diff(u)) + 1
    rows = np.arange(at[0], at[-1] + 1)
    now = np.isin(rows, at)
    x = (x - x.mean(axis=0))[rows] / np.maximum(x.std(axis=0), 1e-300)
    turn = np.minimum(np.searchsorted(at, rows, side="right") - 1, len(at) - 1) // nearby
    _, kind = np.unique(np.stack([turn, u[rows - 1]]), axis=1, return_inverse=True)
    counts = np.bincount(kind)
    x -= np.stack([np.bincount(kind, column) / counts for column in x.T], axis=-1)[kind]
    wrong = pairs = 0.0
    for level in np.unique(u[rows - 1]):
        own = u[rows - 1] == level
        law = np.linalg.lstsq(x[own], now[own] - now[own].mean(), rcond=THRESHOLDS.relay_cutoff)[0]
        yes, no = np.sort(x[own & now] @ law), np.sort(x[own & ~now] @ law)
        if len(yes) and len(no):
            wrong += float(np.sum(len(no) - np.searchsorted(no, yes)))
            pairs += len(yes) * len(no)
    return wrong / pairs if pairs else 1.0


def _surrogates(u: Array, rng: np.random.Generator) -> Array:
    """Inputs (n, T, nu) with the spectrum, the mean and the cross-spectrum of u (T, nu)."""
    spectrum = np.fft.rfft(u, axis=0)
    turns = np.exp(2j * np.pi * rng.random((THRESHOLDS.loop_turns, len(spectrum), 1)))
    turns[:, 0] = 1.0
    return np.asarray(np.fft.irfft(spectrum * turns, len(u), axis=1))


def _told(x: Array, u: Array, m: Dataset) -> float:
    """The share of the changes of an input over `loop_change` s that those of the state tell, jumps aside."""
    lag, step = m.samples(THRESHOLDS.loop_change), np.abs(np.diff(u, prepend=u[0], append=u[-1]))
    jumps = step[1:-1] > THRESHOLDS.loop_step * np.maximum(step[:-2], step[2:])
    rows = np.convolve(jumps, np.ones(lag), "valid") < 0.5
    x, u = x[lag:] - x[:-lag], u[lag:] - u[:-lag]
    if rows.sum() < THRESHOLDS.usual_samples or np.ptp(u[rows]) <= THRESHOLDS.still * np.ptp(u):
        return 0.0
    if _lines(np.where(rows, u, 0.0)) < THRESHOLDS.loop_lines * x.shape[1]:
        return 0.0
    return 1 - _left(x[rows], u[rows]) / max(float(np.var(u[rows])), 1e-300)


def _lines(u: Array) -> float:
    """How many frequencies a signal has: few of them are a function of the state of whatever they drive."""
    power = np.abs(np.fft.rfft(u - u.mean())) ** 2
    return float(power.sum() ** 2 / max(float(np.sum(power**2)), 1e-300))


def _even(change: Array) -> Bools:
    """Rows without jumps: a command that is set anew says nothing of the law that follows it."""
    usual = float(np.median(np.abs(change - np.median(change))))
    return np.asarray(np.abs(change - np.median(change)) <= THRESHOLDS.loop_jump * usual)


def _left(columns: Array, target: Array) -> float:
    """Mean square of what linear regressions on the other blocks leave of each block."""
    size = np.std(columns, axis=0)
    columns = np.hstack([(columns - columns.mean(axis=0)) / np.where(size > 0, size, 1.0), np.ones((len(columns), 1))])
    fold = np.arange(len(target)) * THRESHOLDS.folds // len(target)
    left = 0.0
    for k in range(THRESHOLDS.folds):
        fit, judge = fold != k, fold == k
        law = np.linalg.lstsq(columns[fit], target[fit], rcond=THRESHOLDS.loop_cutoff)[0]
        left += float(np.sum((target[judge] - columns[judge] @ law) ** 2))
    return left / len(target)
