"""What data say for a hypothesis: fits over windows whose starts are profiled out, and a score that charges for parameters.

Nothing here is judged on one-step residuals: differentiating noise would drown every cause that matters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np

from gapcert.errors import UsageError
from gapcert.measured import Windows
from gapcert.system import Array, Model, difference

TRIALS = np.array([0.1, 1.0, 10.0, 100.0])


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
        """Outputs (b, W, L, ny) from theta (b, p) and starts (b, W, nx): one rollout for all. NaN where a motion blows up."""
        try:
            with np.errstate(all="ignore"):
                return self._simulate(windows, theta, start)
        except UsageError:
            # A System refuses non-finite states; one unstable trial must not take the others with it.
            if len(theta) == 1:
                return np.full((1, *windows.y.shape), np.nan)
            return np.concatenate([self.simulate(windows, theta[i : i + 1], start[i : i + 1]) for i in range(len(theta))])

    def motion(self, windows: Windows, theta: Array, start: Array) -> Array:
        """States (b·W, (L − 1)·repeat + 1, nx) at every model step."""
        b, w, m = len(theta), len(windows), windows.measured
        free = {n: np.repeat(theta[:, i], w) for i, n in enumerate(self.names)}
        values = {**{n: np.full(b * w, v) for n, v in self.fixed.items()}, **free} or None
        u = np.tile(np.repeat(windows.u, m.repeat, axis=1), (b, 1, 1))
        hidden, past = None, m.history * m.repeat
        if self.model.hidden:
            hidden = self.model.rollout(np.tile(windows.before, (b, 1)), u[:, :past], parameters=values).hidden
        u = u[:, past : past + (windows.length - 1) * m.repeat]
        return self.model.rollout(start.reshape(b * w, -1), u, parameters=values, hidden=hidden).x

    def _simulate(self, windows: Windows, theta: Array, start: Array) -> Array:
        b, (w, length, _), m = len(theta), windows.y.shape, windows.measured
        x = self.motion(windows, theta, start)[:, :: m.repeat]
        held = np.tile(windows.u[:, m.history :], (b, 1, 1))
        y = self.model.output(x.reshape(b * w * length, -1), held.reshape(b * w * length, -1))
        return y[:, m.columns].reshape(b, w, length, -1)


@final
@dataclass(frozen=True)
class Fit:
    """The best numbers theta (p,) and starts (W, nx) of a hypothesis; residual (W, L, ny) in units of the noise floor.

    covariance (p, p): of theta with the starts profiled out, per unit of residual variance.
    """

    hypothesis: Hypothesis
    theta: Array
    start: Array
    residual: Array
    prior: float
    covariance: Array

    @property
    def chi(self) -> Array:
        """Mean squared residual per channel, in units of the noise floor."""
        return np.asarray(np.mean(self.residual**2, axis=(0, 1)))

    @property
    def whiteness(self) -> Array:
        """κ (ny,) = (1 − ρ₁)/(1 + ρ₁): the share of samples that count as independent, from the lag-1 autocorrelation."""
        r = self.residual
        rho = np.sum(r[:, 1:] * r[:, :-1], axis=(0, 1)) / np.maximum(np.sum(r**2, axis=(0, 1)), 1e-300)
        return np.asarray(np.clip((1 - rho) / (1 + rho), 0.02, 1.0))

    def score(self, whiteness: Array) -> float:
        """S = Σ_c κ_c n ln χ_c + prior + k ln n. Misfits below the noise floor count as the floor."""
        n = self.residual.shape[0] * self.residual.shape[1]
        fit = float(np.sum(whiteness * n * np.log(np.maximum(self.chi, 0.5))))
        return fit + self.prior + self.hypothesis.charged * math.log(n)

    def interval(self) -> Array:
        """Half widths (p,) of 95 % intervals; coloured residuals widen them."""
        variance = np.diag(self.covariance) * max(1.0, float(self.chi.mean())) / float(self.whiteness.min())
        return np.asarray(1.959964 * np.sqrt(np.maximum(variance, 0)))


def fit(
    h: Hypothesis, windows: Windows, *, theta: Array | None = None, start: Array | None = None, iterations: int = 15
) -> Fit:
    """Levenberg–Marquardt over theta and the start of every window, by finite differences in one rollout per iteration.

    Windows share theta only, so component i of *all* starts is perturbed at once. Minimises
    Σ r² + max(1, Σ r²/n)·Σ ((θ − θ₀)/sd)²: untempered, a large unknown effect would drag the nuisances away first.
    """
    theta = np.clip(h.value if theta is None else theta, h.low, h.high)
    start = windows.start if start is None else start
    damping = 1e-3
    r, slopes = _linearise(h, windows, theta, start)
    if not np.isfinite(r).all():
        theta, start = np.clip(h.value, h.low, h.high), windows.start
        r, slopes = _linearise(h, windows, theta, start)
    for _ in range(iterations):
        if not np.isfinite(r).all():
            raise UsageError(
                "diagnose: the simulation is not finite on these data; check the model's units and the recording's columns"
            )
        temper = max(1.0, float(np.mean(r**2)))
        steps = [_step(h, slopes, r, theta, temper, damping * trial) for trial in TRIALS]
        thetas, starts = theta + np.stack([s[0] for s in steps]), start + np.stack([s[1] for s in steps])
        trials, next_slopes = _trials(h, windows, thetas, starts)
        costs = np.nan_to_num(np.sum(trials**2, axis=(1, 2, 3)) + temper * h.prior(thetas), nan=np.inf)
        cost = float(np.sum(r**2) + temper * h.prior(theta))
        best = int(np.argmin(costs))
        if costs[0] < costs[best] + 0.01 * temper:
            best = 0  # its slopes are known already
        if not costs[best] < cost:
            if damping > 1e6:
                break
            damping *= 1e3
            continue
        theta, start, damping = thetas[best], starts[best], max(damping * TRIALS[best], 1e-9)
        r, slopes = (trials[0], next_slopes) if best == 0 else _linearise(h, windows, theta, start)
        if cost - costs[best] < 0.01 * temper:
            break
    reduced = _reduced(h, slopes, r, theta, max(1.0, float(np.mean(r**2))), 0.0)[0]
    return Fit(h, theta, start, r, float(h.prior(theta)), np.asarray(np.linalg.pinv(reduced), dtype=np.float64))


def promising(h: Hypothesis, windows: Windows, thetas: Array, start: Array) -> tuple[Array, Array]:
    """(theta, starts): the one of several thetas (b, p) that fits best once the starts have followed, to first order."""
    count, nx = len(thetas), start.shape[1]
    _, starts, width = _nearby(h.holding(h.value), np.empty(0), start)
    r = _residual(h, windows, np.repeat(thetas, 1 + nx, axis=0), np.tile(starts, (count, 1, 1)))
    r = r.reshape(count, 1 + nx, *windows.y.shape)
    slopes = np.moveaxis((r[:, 1:] - r[:, :1]) / width[:, None, None, None], 1, -1)
    usable = np.isfinite(r).all(axis=(1, 2, 3, 4))
    best, cost = (h.value, start), np.inf
    for i in np.flatnonzero(usable).tolist():
        _, _, _, moved = _reduced(h.holding(h.value), slopes[i], r[i, 0], np.empty(0), 1.0, 1e-6)
        left = float(np.sum((r[i, 0] - np.einsum("wlcj,wj->wlc", slopes[i], moved)) ** 2))
        if left < cost:
            best, cost = (thetas[i], start - moved), left
    return best


def _residual(h: Hypothesis, windows: Windows, theta: Array, start: Array) -> Array:
    """(simulated − measured)/σ, (b, W, L, ny)."""
    m = windows.measured
    return difference(m.channels, h.simulate(windows, theta, start), windows.y[None]) / m.sigma


def _trials(h: Hypothesis, windows: Windows, thetas: Array, starts: Array) -> tuple[Array, Array]:
    """Residuals (b, W, L, ny) of b trials, and the slopes at the first of them, which most often is the next step."""
    first, nearby, width = _nearby(h, thetas[0], starts[0])
    r = _residual(h, windows, np.concatenate([thetas, first[1:]]), np.concatenate([starts, nearby[1:]]))
    b = len(thetas)
    return r[:b], np.moveaxis((r[b:] - r[0]) / width[:, None, None, None], 0, -1)


def _linearise(h: Hypothesis, windows: Windows, theta: Array, start: Array) -> tuple[Array, Array]:
    """Residual r (W, L, ny) and its slopes (W, L, ny, p + nx) in theta and in the window's own start."""
    thetas, starts, width = _nearby(h, theta, start)
    r = _residual(h, windows, thetas, starts)
    return r[0], np.moveaxis((r[1:] - r[0]) / width[:, None, None, None], 0, -1)


def _nearby(h: Hypothesis, theta: Array, start: Array) -> tuple[Array, Array, Array]:
    """thetas (1 + p + nx, p), starts (1 + p + nx, W, nx), each after the first moved in one number; how far (p + nx,)."""
    p, nx = len(theta), start.shape[1]
    size = np.maximum(np.sqrt(np.mean(start**2, axis=0)), 1e-3)
    # Forward, or backward at an upper bound; the step of a dry law must be wide enough to see over its kinks.
    h_theta = np.where(theta + h.step > h.high, -h.step, h.step)
    width = np.concatenate([h_theta, 1e-5 * size])
    thetas = np.tile(theta, (1 + p + nx, 1))
    starts = np.tile(start, (1 + p + nx, 1, 1))
    thetas[1 + np.arange(p), np.arange(p)] += h_theta
    starts[1 + p + np.arange(nx), :, np.arange(nx)] += (1e-5 * size)[:, None]
    return thetas, starts, width


def _reduced(
    h: Hypothesis, slopes: Array, r: Array, theta: Array, temper: float, damping: float
) -> tuple[Array, Array, Array, Array]:
    """Normal equations with the starts eliminated: (Schur complement, its right side, H_xx⁻¹H_xθ, H_xx⁻¹g_x)."""
    p = len(theta)
    jt, jx = slopes[..., :p], slopes[..., p:]
    htt = np.einsum("wlci,wlcj->ij", jt, jt) + np.diag(temper / h.sd**2)
    hxt = np.einsum("wlci,wlcj->wij", jx, jt)
    hxx = np.einsum("wlci,wlcj->wij", jx, jx)
    gt = np.einsum("wlci,wlc->i", jt, r) + temper * (theta - h.value) / h.sd**2
    gx = np.einsum("wlci,wlc->wi", jx, r)
    axis = np.arange(hxx.shape[1])
    hxx[:, axis, axis] *= 1 + damping
    hxx[:, axis, axis] += 1e-12 * np.trace(hxx, axis1=1, axis2=2)[:, None] + 1e-300
    solved = np.linalg.solve(hxx, np.concatenate([hxt, gx[..., None]], axis=-1))
    a, b = solved[..., :p], solved[..., p]
    schur = htt - np.einsum("wij,wik->jk", hxt, a)
    schur[np.arange(p), np.arange(p)] += damping * np.diag(htt)
    return schur, -(gt - np.einsum("wij,wi->j", hxt, b)), a, b


def _step(h: Hypothesis, slopes: Array, r: Array, theta: Array, temper: float, damping: float) -> tuple[Array, Array]:
    """The damped Gauss–Newton step (p,), (W, nx), with theta kept in its bounds by an active set."""
    schur, side, a, b = _reduced(h, slopes, r, theta, temper, damping)
    free = np.ones(len(theta), dtype=bool)
    move = np.zeros(len(theta))
    for _ in range(len(theta)):
        known = side[free] - schur[np.ix_(free, ~free)] @ move[~free]
        move[free] = np.linalg.lstsq(schur[np.ix_(free, free)], known, rcond=None)[0]
        out = free & ((theta + move < h.low) | (theta + move > h.high))
        if not out.any():
            break
        move[out] = (np.clip(theta + move, h.low, h.high) - theta)[out]
        free &= ~out
    return move, -(b + np.einsum("wij,j->wi", a, move))
