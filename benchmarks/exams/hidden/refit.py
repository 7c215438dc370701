"""Noiseless fits to the true motion: Gauss–Newton over parameters, the numbers of effects, and the starts of all windows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import final

import numpy as np

from exams.hidden.laws import Hidden
from exams.hidden.plants import TOLERANCE
from exams.hidden.rig import COARSE, DRY, STICKING, Motion, Rig
from gapcert.numerics.arrays import Array

WINDOW = 1.0  # s
SEEN = 0.75  # of a log: a diagnosis holds out the rest, and learns nothing from it
STEPS = 8
FAR = 1e6  # σ
POLL = (0.9, 0.97, 1.03, 1.1)  # times a number of an effect
SLOW = 0.8  # of the cost before: what a step must get below
LOST = 100.0  # times the limit: a fit that ends beyond it is not polled
REACH = 3  # tolerances that a parameter may be off in a fit with a prior
POSITIVE = ("level", "width", "mass", "delay", "time_constant", "rate", "traction", "displacement", "velocity", "ratio")


@final
@dataclass(frozen=True)
class Fitted:
    """The best that a hypothesis can do: its cost, its numbers, the misfit (rows, channels) in σ, and the slopes there.

    theta: the plant's parameters, then the numbers of effects; weight, off: 1/tolerance of each (0: free), distance from its
    stated value.
    """

    cost: float
    theta: Array
    residual: Array
    slopes: Array
    starts: Array
    weight: Array
    off: Array


@final
@dataclass(frozen=True)
class Numbers:
    """What is free in a fit: first values, bounds, weights; `names` say which number of which effect follows the parameters."""

    free: tuple[Hidden, ...]
    names: tuple[tuple[int, str], ...]
    value: Array
    prior: Array
    low: Array
    high: Array
    weight: Array

    def effects(self, theta: Array) -> tuple[Hidden, ...]:
        """The effects with the numbers of theta; a freed parameter is none."""
        p = len(theta) - len(self.names)
        found: list[dict[str, float]] = [{} for _ in self.free]
        for (i, name), value in zip(self.names, theta[p:], strict=True):
            found[i][name] = float(value)
        return tuple(Hidden(h.effect, h.site, n) for h, n in zip(self.free, found, strict=True) if h.effect != "parameter")


class Refit:
    """Noiseless data of one rig with effects, seen through the measured channels with noise `sigma` (name → σ).

    Cost: Σ ((y − y_truth)/σ)² over windows of 1 s whose starts are free, in the part of the log that is not held out, and
    Σ ((p − stated)/tolerance)² for parameters that keep their tolerance.
    """

    def __init__(self, rig: Rig, effects: tuple[Hidden, ...], sigma: Mapping[str, float]) -> None:
        self.rig, self.effects = rig, effects
        names = (*rig.plant.positions, *rig.plant.velocities)
        self.columns = np.array([names.index(c) for c in sigma])
        self.sigma = np.array(list(sigma.values()))
        # At 1 ms a dry joint that reverses shows differences between laws that finer steps do not have.
        self.step = DRY if any(h.effect in STICKING for h in effects) else COARSE
        self.motion: Motion = rig.play(effects, self.step)
        length = max(1, round(WINDOW / rig.period))
        count = max(1, int(SEEN * len(self.motion.t)) // length)
        self.resets = np.arange(count) * length
        self.length = length
        # Samples in between tell nothing new about slow motion; each that is kept stands for `thin` of them.
        self.thin = max(t for t in (1, 2, 4, 5) if length % t == 0 and t * rig.period <= 0.0101)
        self.rows = np.arange(0, count * length, self.thin)
        self._inputs = self.motion.u[: count * length]
        self.starts = self.motion.x[self.resets]
        self.stated = np.array([v for v, _ in rig.plant.stated.values()])
        spread = np.std(self.motion.x, axis=0)
        self.widths = 1e-4 * np.maximum(spread, 1e-3 * max(float(spread.max()), 1e-6))

    def misfit(self, effects: tuple[Hidden, ...], parameters: Array, starts: Array) -> Array:
        """(rows, channels) in σ of `thin` samples together, at most FAR."""
        y = self.rig.replay(effects, self._inputs, self.resets, starts, parameters, self.step)
        at = np.ix_(self.rows, self.columns)
        r = (y[at] - self.motion.y[at]) / self.sigma * np.sqrt(self.thin)
        return np.asarray(np.clip(np.nan_to_num(r, nan=FAR), -FAR, FAR))

    @property
    def true(self) -> Fitted:
        """The true parameters and starts, as a place to begin at."""
        none = np.empty(0)
        return Fitted(np.inf, self.rig.parameters, none, none, self.starts, none, none)

    def numbers(self, free: tuple[Hidden, ...], bounded: bool, base: Fitted | None) -> Numbers:
        """Parameters and the numbers of effects; bounded: no prior, but hard bounds at the tolerance."""
        p, tolerance = len(self.stated), TOLERANCE * np.abs(self.stated)
        names = tuple((i, k) for i, h in enumerate(free) if h.effect != "parameter" for k in h.numbers)
        first = np.array([free[i].numbers[k] for i, k in names])
        reach = (1 if bounded else REACH) * tolerance
        low = np.concatenate([self.stated - reach, [1e-9 if k in POSITIVE else -np.inf for _, k in names]])
        high = np.concatenate([self.stated + reach, np.full(len(names), np.inf)])
        weight = np.concatenate([np.zeros(p) if bounded else 1 / tolerance, np.zeros(len(names))])
        value = np.concatenate([self.stated if base is None else base.theta[:p], first])
        for h in free:
            if h.effect == "parameter":
                i = list(self.rig.plant.stated).index(h.site)
                value[i], weight[i], low[i], high[i] = h.numbers["value"], 0.0, 0.02 * self.stated[i], 50 * self.stated[i]
        return Numbers(free, names, value, np.concatenate([self.stated, np.zeros(len(names))]), low, high, weight)

    def fit(
        self, free: tuple[Hidden, ...] = (), bounded: bool = False, base: Fitted | None = None, limit: float = 0.0
    ) -> Fitted:
        """From the numbers of `free` (and from where `base` ended); gives up where `limit` is out of reach."""
        at = _Descent(self, self.numbers(free, bounded, base), self.starts if base is None else base.starts)
        for _ in range(STEPS):
            before = at.cost
            at.step()
            if limit < at.cost < LOST * limit and at.cost > SLOW * before:
                at.poll()
            hopeless = limit > 0 and at.cost > 4 * limit and at.cost > SLOW * before
            if at.cost <= limit or hopeless or at.settled(before):
                break
        return Fitted(at.cost, at.theta, at.r, at.slopes, at.starts, at.z.weight, at.theta - at.z.prior)

    def slopes(self, run: Callable[[Array, Array], Array], theta: Array, starts: Array, r: Array) -> Array:
        """(rows, channels, numbers + 2n)."""
        nx = starts.shape[1]
        out = np.empty((*r.shape, len(theta) + nx))
        for i in range(len(theta)):
            step = 2e-3 * max(abs(theta[i]), 1e-9)
            moved = theta.copy()
            moved[i] += step
            out[..., i] = (run(moved, starts) - r) / step
        for j in range(nx):
            moved_starts = starts.copy()
            moved_starts[:, j] += self.widths[j]
            out[..., len(theta) + j] = (run(theta, moved_starts) - r) / self.widths[j]
        return out

    def tangent(self, base: Fitted) -> Callable[[Array | None], Array]:
        """Projects a change (None: the misfit itself) off the numbers and starts of a fit, prior rows included."""
        k, count = len(base.theta), len(self.resets)
        j = base.slopes.reshape(count, -1, base.slopes.shape[-1])
        q, _ = np.linalg.qr(j[..., k:])

        def off(a: Array) -> Array:
            return np.asarray(a - q @ (q.transpose(0, 2, 1) @ a))

        u, size, _ = np.linalg.svd(np.concatenate([off(j[..., :k]).reshape(-1, k), np.diag(base.weight)]), full_matrices=False)
        u = u[:, size > 1e-10 * size[0]]

        def project(change: Array | None) -> Array:
            tail = base.weight * base.off if change is None else np.zeros(k)
            values = base.residual if change is None else change
            rows = np.concatenate([off(values.reshape(count, -1, 1)).ravel(), tail])
            return np.asarray(rows - u @ (u.T @ rows))

        return project


@final
class _Descent:
    """Where a fit is: theta, starts (W, 2n), misfit r (rows, channels), cost; slopes: at the last step."""

    def __init__(self, data: Refit, z: Numbers, starts: Array) -> None:
        self.data, self.z, self.theta, self.starts = data, z, z.value, starts
        self.r, self.damping, self.slopes = self._run(self.theta, starts), 1e-4, np.empty(0)
        self.cost = self._total(self.r, self.theta)

    def step(self) -> None:
        """Gauss–Newton, damped until it pays."""
        self.slopes = self.data.slopes(self._run, self.theta, self.starts, self.r)
        for attempt in range(4):
            move, shift = self._move()
            if self._taken(np.clip(self.theta + move, self.z.low, self.z.high), shift, each=attempt in (1, 3)):
                self.damping *= 0.3
                return
            self.damping = max(10 * self.damping, 1e-3)

    def poll(self) -> None:
        """Numbers of effects by shares of themselves: dry friction has kinks at which no slope leads on."""
        for i, factor in product(range(len(self.theta) - len(self.z.names), len(self.theta)), POLL):
            trial = self.theta.copy()
            trial[i] = np.clip(factor * trial[i], self.z.low[i], self.z.high[i])
            _, follow, alone = self._normal()
            self._taken(trial, -(alone + np.einsum("wij,j->wi", follow, trial - self.theta)), each=True)

    def settled(self, before: float) -> bool:
        return before - self.cost < 1e-3 * self.cost + 1e-3

    def _run(self, theta: Array, starts: Array) -> Array:
        return self.data.misfit(self.z.effects(theta), theta[: len(self.data.stated)], starts)

    def _total(self, r: Array, theta: Array) -> float:
        return float(np.sum(r**2) + np.sum((self.z.weight * (theta - self.z.prior)) ** 2))

    def _taken(self, theta: Array, shift: Array, each: bool) -> bool:
        """Goes there if that pays; each: a window whose own cost would rise keeps its start."""
        starts = self.starts + shift
        r = self._run(theta, starts)
        if each and not self._total(r, theta) < self.cost:
            still = self._run(theta, self.starts)
            rises = np.sum((r**2 - still**2).reshape(len(starts), -1), axis=1) > 0
            starts = np.where(rises[:, None], self.starts, starts)
            r = self._run(theta, starts)
        if paid := (now := self._total(r, theta)) < self.cost:
            self.theta, self.starts, self.r, self.cost = theta, starts, r, now
        return paid

    def _normal(self) -> tuple[Array, Array, Array]:
        """Products of starts with theta, and by what starts follow a unit of theta (W, 2n, p) and the misfit (W, 2n)."""
        p, count = len(self.theta), len(self.starts)
        j, e = self.slopes.reshape(count, -1, self.slopes.shape[-1]), self.r.reshape(count, -1)
        jt, jx = j[..., :p], j[..., p:]
        hxx = jx.transpose(0, 2, 1) @ jx
        axis = np.arange(hxx.shape[1])
        hxx[:, axis, axis] *= 1 + self.damping
        hxx[:, axis, axis] += 1e-9 * np.trace(hxx, axis1=1, axis2=2)[:, None] + 1e-300
        hxt = jx.transpose(0, 2, 1) @ jt
        gx = (jx.transpose(0, 2, 1) @ e[..., None])[..., 0]
        solved = np.linalg.solve(hxx, np.concatenate([hxt, gx[..., None]], axis=-1))
        return hxt, solved[..., :p], solved[..., p]

    def _move(self) -> tuple[Array, Array]:
        """Steps of theta and starts."""
        p, weight = len(self.theta), self.z.weight
        hxt, a, b = self._normal()
        flat = self.slopes[..., :p].reshape(-1, p)
        htt = flat.T @ flat
        schur = htt - np.einsum("wij,wik->jk", hxt, a) + np.diag(weight**2)
        schur[np.arange(p), np.arange(p)] += self.damping * np.diag(htt) + 1e-12 * max(float(np.trace(htt)), 1e-300)
        off = weight**2 * (self.theta - self.z.prior)
        side = -(flat.T @ self.r.ravel() + off - np.einsum("wij,wi->j", hxt, b))
        move = np.linalg.lstsq(schur, side, rcond=None)[0]
        return move, -(b + np.einsum("wij,j->wi", a, move))
