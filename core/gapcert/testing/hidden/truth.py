"""How clear a hidden effect is, and which others would do the same: from noiseless motions alone.

Cost of a hypothesis: Σ ((y − y_truth)/σ)² over windows of 1 s whose starts are free, and Σ ((p − stated)/tolerance)² for
parameters that it leaves within their tolerance. With noise, a difference of costs is what the best test could see; one that
charges ln n for a number, as every sound one does, cannot see less than that between a law and a shorter one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from gapcert.testing.hidden.laws import KIND, NAMES, Hidden, shape, sites
from gapcert.testing.hidden.plants import TOLERANCE
from gapcert.testing.hidden.rig import COARSE, Motion, Rig
from gapcert.testing.hidden.slots import Array

WINDOW = 1.0  # s
SAME = 9.0  # difference of costs below which no test tells two hypotheses apart: three standard deviations
GRID = (0.1, 0.4, 1.0)  # shares of an alternative's largest strength from which its fit starts
HOPE = 0.25  # an alternative is fitted if, to first order, it takes this share of the cost away
STEPS = 8
FAR = 1e6  # σ
POSITIVE = ("level", "width", "mass", "delay", "time_constant", "rate", "traction", "displacement", "velocity", "ratio")


@final
@dataclass(frozen=True)
class Fitted:
    """The best that a hypothesis can do: its cost, its parameters, its own numbers, and the misfit (T, channels) in σ."""

    cost: float
    parameters: Array
    numbers: Mapping[str, float]
    residual: Array
    slopes: Array
    starts: Array


@final
class Truth:
    """Noiseless data of one rig with effects, seen through the measured channels with noise `sigma` (name → σ)."""

    def __init__(self, rig: Rig, effects: tuple[Hidden, ...], sigma: Mapping[str, float]) -> None:
        self.rig, self.effects = rig, effects
        names = (*rig.plant.positions, *rig.plant.velocities)
        self.columns = np.array([names.index(c) for c in sigma])
        self.sigma = np.array(list(sigma.values()))
        self.motion: Motion = rig.play(effects, COARSE)
        length = max(1, round(WINDOW / rig.period))
        count = max(1, len(self.motion.t) // length)
        self.resets = np.arange(count) * length
        self.length = length
        # Samples in between tell nothing new about slow motion; each that is kept stands for `thin` of them.
        self.thin = max(t for t in (1, 2, 4, 5) if length % t == 0 and t * rig.period <= 0.0101)
        self.rows = np.arange(0, count * length, self.thin)
        self.starts = self.motion.x[self.resets]
        self.stated = np.array([v for v, _ in rig.plant.stated.values()])
        spread = np.std(self.motion.x, axis=0)
        self.widths = 1e-4 * np.maximum(spread, 1e-3 * max(float(spread.max()), 1e-6))

    def misfit(self, effects: tuple[Hidden, ...], parameters: Array, starts: Array) -> Array:
        """(rows, channels) in σ of `thin` samples together, at most FAR."""
        y = self.rig.replay(effects, self.motion.u, self.resets, starts, parameters)
        at = np.ix_(self.rows, self.columns)
        r = (y[at] - self.motion.y[at]) / self.sigma * np.sqrt(self.thin)
        return np.asarray(np.clip(np.nan_to_num(r, nan=FAR), -FAR, FAR))

    def strength(self) -> float:
        """RMS change of 1 s rollouts by the effects, in σ, of the channel that shows them best."""
        change = self.misfit((), self.rig.parameters, self.starts)
        return float(np.sqrt(np.mean(change**2, axis=0) / self.thin).max())

    def share(self) -> float:
        """RMS of the effects' acceleration over that of the whole effort (motion and inputs together), of the most moved.

        From single steps along the true motion, on which all memories go on; 1 for faults of sensors.
        """
        if all(KIND[h.effect] == "output" for h in self.effects):
            return 1.0
        n, u = self.rig.plant.n, self.motion.u
        every = np.arange(0, len(u) - 1, 2)
        before = self.motion.x[every, n:]

        def after(effects: tuple[Hidden, ...], inputs: Array) -> Array:
            """Speeds one sample later."""
            y = self.rig.replay(effects, inputs, every, self.motion.x[every], self.rig.parameters)
            return np.asarray(y[every + 1, n:])

        changed, without, idle = after(self.effects, u), after((), u), after((), np.zeros_like(u))
        moved, driven, moved_more = (_rms(d) for d in (without - before, without - idle, changed - without))
        return float(np.max(moved_more / np.maximum(np.hypot(moved, driven), 1e-12)))

    def remains(self) -> float:
        """RMS misfit in σ once parameters within tolerance and starts have been refitted without the effects."""
        fitted = self.fit((), {}, bounded=True)
        return float(np.sqrt(np.mean(fitted.residual**2, axis=0) / self.thin).max())

    def fit(
        self,
        others: tuple[Hidden, ...],
        numbers: Mapping[str, float],
        effect: tuple[str, str] | None = None,
        bounded: bool = False,
        base: Fitted | None = None,
        steps: int = STEPS,
        limit: float = 0.0,
    ) -> Fitted:
        """Gauss–Newton over parameters, starts, and the numbers of one more effect; bounded: no prior, but hard bounds."""
        keys = list(numbers)
        p = len(self.stated)
        freed = list(self.rig.plant.stated).index(effect[1]) if effect and effect[0] == "parameter" else -1
        tolerance = TOLERANCE * np.abs(self.stated)
        weight = np.concatenate([np.zeros(p) if bounded else 1 / tolerance, np.zeros(len(keys))])
        if freed >= 0:
            weight[freed], keys = 0.0, []
            weight = weight[:p]
        theta = np.concatenate([base.parameters if base else self.stated, [numbers[k] for k in keys]])
        if freed >= 0:
            theta[freed] = numbers["value"]
        starts = base.starts if base else self.starts
        least = [1e-9 if k in POSITIVE else -np.inf for k in keys]
        low = np.concatenate([self.stated - (1 if bounded else 3) * tolerance, least])
        high = np.concatenate([self.stated + (1 if bounded else 3) * tolerance, np.full(len(keys), np.inf)])
        if freed >= 0:
            low[freed], high[freed] = 0.02 * self.stated[freed], 50 * self.stated[freed]
        prior = np.concatenate([self.stated, np.zeros(len(keys))])

        def run(theta: Array, starts: Array) -> Array:
            mine = (Hidden(*effect, dict(zip(keys, theta[p:], strict=True))),) if effect and freed < 0 else ()
            return self.misfit((*others, *mine), theta[:p], starts)

        def cost(r: Array, theta: Array) -> float:
            return float(np.sum(r**2) + np.sum((weight * (theta - prior)) ** 2))

        r, damping = run(theta, starts), 1e-4
        now = cost(r, theta)
        slopes = np.empty((0,))
        for _ in range(steps):
            slopes = self._slopes(run, theta, starts, r)
            improved = False
            for _ in range(4):
                move, shift = self._step(slopes, r, weight, theta - prior, damping)
                trial = np.clip(theta + move, low, high)
                there = run(trial, starts + shift)
                if cost(there, trial) < now:
                    improved = True
                    break
                damping = max(10 * damping, 1e-3)
            if not improved:
                break
            before, now = now, cost(there, trial)
            theta, starts, r, damping = trial, starts + shift, there, 0.3 * damping
            if before - now < 1e-3 * now + 1e-3 or (limit and now > limit and now * (now / before) ** 3 > limit):
                break
        found = dict(zip(keys, theta[p:], strict=True)) if freed < 0 else {"value": float(theta[freed])}
        return Fitted(now, theta[:p], found, r, slopes, starts)

    def _slopes(self, run: Callable[[Array, Array], Array], theta: Array, starts: Array, r: Array) -> Array:
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

    def _step(self, slopes: Array, r: Array, weight: Array, off: Array, damping: float) -> tuple[Array, Array]:
        p, count = len(weight), len(self.resets)
        j = slopes.reshape(count, -1, slopes.shape[-1])
        e = r.reshape(count, -1)
        jt, jx = j[..., :p], j[..., p:]
        hxx = jx.transpose(0, 2, 1) @ jx
        axis = np.arange(hxx.shape[1])
        hxx[:, axis, axis] *= 1 + damping
        hxx[:, axis, axis] += 1e-9 * np.trace(hxx, axis1=1, axis2=2)[:, None] + 1e-300
        hxt = jx.transpose(0, 2, 1) @ jt
        gx = (jx.transpose(0, 2, 1) @ e[..., None])[..., 0]
        solved = np.linalg.solve(hxx, np.concatenate([hxt, gx[..., None]], axis=-1))
        a, b = solved[..., :p], solved[..., p]
        flat = jt.reshape(-1, p)
        htt = flat.T @ flat
        schur = htt - np.einsum("wij,wik->jk", hxt, a) + np.diag(weight**2)
        schur[np.arange(p), np.arange(p)] += damping * np.diag(htt) + 1e-12 * max(float(np.trace(htt)), 1e-300)
        side = -(flat.T @ e.ravel() + weight**2 * off - np.einsum("wij,wi->j", hxt, b))
        move = np.linalg.lstsq(schur, side, rcond=None)[0]
        return move, -(b + np.einsum("wij,j->wi", a, move))

    def rivals(self, truth: Hidden, rng: np.random.Generator) -> tuple[tuple[str, str], ...]:
        """Effects at sites with no more numbers than the truth that fit as well within the noise: its class."""
        keys = [(e, site) for e in NAMES for site in sites(self.rig.plant, e)]
        others = [k for k in keys if k != truth.key and self._visible(*k)]
        return (truth.key, *(k for k in others if self.resembles(truth, k, rng)))

    def resembles(self, truth: Hidden, other: tuple[str, str], rng: np.random.Generator) -> bool:
        """Does another effect, with no more numbers, fit these data as well as the truth does, within the noise?"""
        if self.evidence() <= SAME:
            return False
        start = self._start(*other, len(truth.numbers), rng)
        if start is None:
            return False
        spared = len(truth.numbers) - len(start)
        limit = self._own + SAME + spared * float(np.log(self.rows.size * self.thin * len(self.columns)))
        return self.fit((), start, other, base=self.nothing, limit=limit).cost <= limit

    def evidence(self) -> float:
        """By how much the cost without any effect exceeds that of the truth."""
        return self.nothing.cost - self._own

    @property
    def _own(self) -> float:
        """Cost of the truth: how far its parameters are from the stated ones."""
        off = (self.rig.parameters - self.stated) / (TOLERANCE * np.abs(self.stated))
        return float(off @ off)

    @cached_property
    def nothing(self) -> Fitted:
        """Without any effect."""
        return self.fit((), {})

    @cached_property
    def _free(self) -> Motion:
        return self.rig.play((), COARSE)

    def _visible(self, effect: str, site: str) -> bool:
        return effect != "sensor-quantisation" and (KIND[effect] != "output" or site in self._seen())

    def _seen(self) -> Sequence[str]:
        names = (*self.rig.plant.positions, *self.rig.plant.velocities)
        return [names[c] for c in self.columns]

    def _start(self, effect: str, site: str, most: int, rng: np.random.Generator) -> Mapping[str, float] | None:
        """First numbers of an alternative, or None where it has too many, or none of its signs and sizes helps."""
        z = self.rig.scales(self._free, KIND[effect], site)
        best, numbers = HOPE * self.nothing.cost, None
        for sign in (1.0, -1.0):
            drawn = shape(effect, z, rng, sign)
            if len(drawn.at(drawn.most)) > most:
                return None
            for share in GRID:
                at = drawn.at(share * drawn.most)
                left, scale = self._left(effect, site, at)
                if left < best and scale > 0:
                    best, numbers = left, drawn.at(float(np.clip(scale * share, 0.01, 1.0)) * drawn.most)
        return numbers

    def _left(self, effect: str, site: str, numbers: Mapping[str, float]) -> tuple[float, float]:
        """Cost that remains to first order if a multiple of the alternative's change is added, and that multiple."""
        nothing = self.nothing
        parameters = nothing.parameters
        mine: tuple[Hidden, ...] = (Hidden(effect, site, numbers),)
        if effect == "parameter":
            parameters = parameters.copy()
            parameters[list(self.rig.plant.stated).index(site)] = numbers["value"]
            mine = ()
        change = self.misfit(mine, parameters, nothing.starts) - nothing.residual
        rows, target = self._tangent(change), self._tangent(None)
        inner = float(rows @ rows)
        gain = -float(rows @ target) / inner if inner > 0 else 0.0
        return float(target @ target) + 2 * gain * float(rows @ target) + gain**2 * inner, gain

    @cached_property
    def _tangent(self) -> Callable[[Array | None], Array]:
        """Projects a change (None: the misfit itself) off the parameters and starts, prior rows included."""
        nothing, p, count = self.nothing, len(self.stated), len(self.resets)
        weight = 1 / (TOLERANCE * np.abs(self.stated))
        j = nothing.slopes.reshape(count, -1, nothing.slopes.shape[-1])
        q, _ = np.linalg.qr(j[..., p:])

        def off(a: Array) -> Array:
            return np.asarray(a - q @ (q.transpose(0, 2, 1) @ a))

        u, size, _ = np.linalg.svd(np.concatenate([off(j[..., :p]).reshape(-1, p), np.diag(weight)]), full_matrices=False)
        u = u[:, size > 1e-10 * size[0]]

        def project(change: Array | None) -> Array:
            tail = weight * (nothing.parameters - self.stated) if change is None else np.zeros(p)
            values = nothing.residual if change is None else change
            rows = np.concatenate([off(values.reshape(count, -1, 1)).ravel(), tail])
            return np.asarray(rows - u @ (u.T @ rows))

        return project


def _rms(a: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(a**2, axis=0)))
