"""What data say for a hypothesis: fits over windows whose starts are profiled out, and a score that charges for parameters.

Nothing here is judged on one-step residuals: differentiating noise would drown every cause that matters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np

from gapcert.plugin import Array, UsageError, difference
from gapcert_diagnosis.data.dataset import Windows
from gapcert_diagnosis.thresholds import THRESHOLDS

from .gauss_newton import Slopes, fall, reduced, squares, steps
from .hypothesis import Hypothesis, nudges

TRIALS = np.array([0.1, 1.0, 10.0, 100.0])


@final
@dataclass(frozen=True)
class Fit:
    """The best numbers theta (p,) and starts (W, nx) of a hypothesis on some windows.

    residual (W, L, ny): in units of the noise floor, times the weights of the windows. covariance (p, p): of theta with the
    starts profiled out, per unit of residual variance.
    """

    hypothesis: Hypothesis
    theta: Array
    start: Array
    residual: Array
    prior: float
    covariance: Array
    windows: Windows

    @cached_property
    def counts(self) -> Array:
        """Samples (ny,) that took part."""
        return np.asarray(np.sum(self.windows.weight**2, axis=(0, 1)))

    @cached_property
    def chi(self) -> Array:
        """Mean squared residual per channel, in units of the noise floor."""
        return np.asarray(np.sum(self.residual**2, axis=(0, 1)) / np.maximum(self.counts, 1))

    @cached_property
    def whiteness(self) -> Array:
        """κ (ny,) = (1 − ρ₁)/(1 + ρ₁): the share of samples that count as independent, from the lag-1 autocorrelation."""
        w = self.windows.weight
        # Of as many neighbours as there would be without gaps.
        whole = self.counts * (w.shape[1] - 1) / w.shape[1]
        rho = lag_one(self.residual) * whole / np.maximum(np.sum((w[:, 1:] * w[:, :-1]) ** 2, axis=(0, 1)), 1)
        return np.asarray(np.clip((1 - rho) / (1 + rho), 0.02, 1.0))

    @cached_property
    def each(self) -> Array:
        """χ (W, ny) of every window; less than the noise floor counts as the floor."""
        chi = np.sum(self.residual**2, axis=1) / np.maximum(np.sum(self.windows.weight**2, axis=1), 1)
        return np.asarray(np.maximum(chi, THRESHOLDS.counted_floor))

    @cached_property
    def typical(self) -> Array:
        """χ (ny,) of a typical window: the geometric mean, in which a window that nothing fits has one voice."""
        return np.asarray(np.exp(np.mean(np.log(self.each), axis=0)))

    @property
    def values(self) -> dict[str, float]:
        """Name → fitted number."""
        return dict(zip(self.hypothesis.names, self.theta.tolist(), strict=True))

    @property
    def rough(self) -> bool:
        """Is something left that is no noise? Then the worst windows say least about the rest."""
        return bool(self.chi.max() > THRESHOLDS.rough)

    def score(self, closest: Fit, robust: bool = False) -> float:
        """S = Σ_c κ_c n_c ln χ_c + prior + k ln n, with κ of the closest of the fits that are compared.

        Misfits below the noise floor count as the floor. robust: χ is that of a typical window.
        """
        n = self.counts
        chi = self.typical if robust else self.chi
        fit = float(np.sum(closest.whiteness * n * np.log(np.maximum(chi, THRESHOLDS.counted_floor))))
        return fit + self.prior + self.hypothesis.charged * math.log(max(float(n.max()), 1.0))

    def interval(self) -> Array:
        """Half widths (p,) of 95 % intervals; coloured residuals widen them."""
        variance = np.diag(self.covariance) * max(1.0, float(self.chi.mean())) / float(self.whiteness.min())
        return np.asarray(1.959964 * np.sqrt(np.maximum(variance, 0)))

    def estimates(self) -> dict[str, tuple[float, float]]:
        """Name → (value, half width of its 95 % interval)."""
        rows = zip(self.hypothesis.names, self.theta.tolist(), self.interval().tolist(), strict=True)
        return {name: (value, half) for name, value, half in rows}


def lag_one(r: Array) -> Array:
    """The correlation (ny,) of neighbouring samples of r (W, L, ny)."""
    return np.asarray(np.sum(r[:, 1:] * r[:, :-1], axis=(0, 1)) / np.maximum(np.sum(r**2, axis=(0, 1)), 1e-300))


def fit(
    h: Hypothesis, windows: Windows, *, theta: Array | None = None, start: Array | None = None, iterations: int = 15
) -> Fit:
    """Levenberg–Marquardt over theta and the start of every window, by finite differences in one rollout per iteration.

    Windows share theta only, so component i of *all* starts is perturbed at once. Minimises
    Σ r² + max(1, Σ r²/n)·Σ ((θ − θ₀)/sd)²: untempered, a large unknown effect would drag the nuisances away first.
    """
    theta = np.clip(h.value if theta is None else theta, h.low, h.high)
    part = _leaning(h, windows, theta)
    here = _linearise(h, part, theta, h.guessed(windows, theta, windows.start) if start is None else start)
    if not _followable(here.residual):
        theta = np.clip(h.value, h.low, h.high)
        part = _leaning(h, windows, theta)
        here = _linearise(h, part, theta, windows.start)
        if not _followable(here.residual):
            m = windows.measured
            raise UsageError(
                f"diagnose: the simulation blows up within {windows.length * m.period:.3g} s, from where the data are; "
                f"expected one that stays finite; samples are {m.period:.6g} s apart: if the time is in ms, say so, "
                "recording.units: {TIME: ms}; otherwise look at the model's units and signs, the recording's columns, or give "
                "a shorter diagnose.window"
            )
    ends, given, more = _Ends.of(windows), windows, max(THRESHOLDS.retraced_iterations, iterations // 2)
    if start is None and not windows.start.any(axis=0).all():
        # A state that no channel shows begins anywhere: numbers would go astray to make up for it.
        here = _settle(h, part, here, ends)[0]
    for k in range(THRESHOLDS.begun_rounds):
        if (begun := _begun(h, windows, here, ends)) is not None:
            h, part = begun, _leaning(begun, windows, here.theta)
            here = _linearise(h, part, here.theta, here.start)
        elif k:
            break
        here = _led_down(h, windows, part, here, ends, more if k else iterations)
    for _ in range(THRESHOLDS.retraced_memories if h.model.remembers else 0):
        if (again := _retraced(h, windows, here, ends)) is None:
            break
        windows, part, here = again
        here = _led_down(h, windows, part, here, ends, more)
    temper = max(1.0, float(squares(here.residual).sum()) / ends.n)
    schur = reduced(h, here, temper, np.zeros(1))[0][0]
    size = here.width[: len(theta)]
    covariance = np.asarray(np.linalg.pinv(schur) * np.outer(size, size))
    return Fit(h, here.theta, here.start, here.residual, float(h.prior(here.theta)), covariance, given)


def rescued(fitted: Fit) -> Fit:
    """The fit again from better starts of the windows that stand out, where that makes it better; else as it was.

    A start velocity that is off by the noise of a difference can lead a long window over an unstable equilibrium or around
    another turn; over a short one it cannot.
    """
    energy = np.mean(fitted.residual**2, axis=(1, 2))
    lost = np.flatnonzero(energy > THRESHOLDS.lost_window * max(1.0, float(np.median(energy))))
    if not len(lost):
        return fitted
    windows = fitted.windows
    some, fixed = windows.take(lost), fitted.hypothesis.holding(fitted.theta)
    start = some.start
    for part in THRESHOLDS.restart_parts:
        head = some.head(max(THRESHOLDS.window_samples, windows.length // part))
        led = fit(fixed, head, start=start)
        start = led.start
    gained, starts = energy[lost] - np.mean(led.residual**2, axis=(1, 2)), fitted.start.copy()
    whole = float(np.sum(fitted.residual**2))
    if np.maximum(gained, 0.0).sum() * fitted.residual[0].size <= _Ends.of(windows).enough(whole):
        return fitted
    starts[lost[gained > 0]] = start[gained > 0]
    again = fit(fitted.hypothesis, windows, theta=fitted.theta, start=starts)
    return again if np.sum(again.residual**2) + again.prior < np.sum(fitted.residual**2) + fitted.prior else fitted


def followed(h: Hypothesis, theta: Array, windows: Windows, start: Array | None = None) -> Fit:
    """Other windows with the numbers of a fit held; the residual is `blown_residual` noise floors where the simulation blows up
    there.

    start: of another fit of these windows; each window begins from there, where that is nearer than what was measured.
    """
    fixed = h.holding(theta)
    own = fixed.guessed(windows, np.empty(0), windows.start)
    starts = own[None] if start is None else np.stack([own, start])
    r = _residual(fixed, windows, np.empty((len(starts), 0)), starts)
    with np.errstate(all="ignore"):
        left = np.nan_to_num(np.sum(r**2, axis=(2, 3)), nan=np.inf)
    rows = np.argmin(left, axis=0), np.arange(len(windows))
    if _followable(r[rows]):
        return fit(fixed, windows, start=starts[rows])
    lost, none = np.full(r.shape[1:], THRESHOLDS.blown_residual), np.empty((0, 0))
    return Fit(fixed, np.empty(0), windows.start, lost, 0.0, none, windows)


def carried(h: Hypothesis, theta: Array, other: Fit, windows: Windows, start: Array) -> Array:
    """Starts (W, nx) for numbers of a fit on other windows: its own where windows begin at the same samples, else followed.

    start: of a fit of these windows.
    """
    known = dict(zip(map(tuple, other.windows.place.tolist()), other.start, strict=True))
    rows = [known.get(tuple(place)) for place in windows.place.tolist()]
    new = np.array([row is None for row in rows])
    out = np.stack([own if row is None else row for row, own in zip(rows, start, strict=True)])
    if new.any():
        out[new] = followed(h, theta, windows.take(new), start[new]).start
    return out


def stepped(fitted: Fit, others: Sequence[Hypothesis]) -> list[Fit | None]:
    """Other simulations with the numbers of a fit on its windows, each one Gauss–Newton step from it; None: not finite.

    The slopes are those of the fit, which is all that many simulations cost that differ little from its own.
    """
    h, theta, start, windows = fitted.hypothesis, fitted.theta, fitted.start, fitted.windows
    thetas, starts, width = nearby(h, theta, start, _linearise(h, windows, theta, start).near(h))
    r = _residual(h, windows, thetas, starts)
    moved, n, out = r[1:] - r[0], max(1.0, float(np.count_nonzero(windows.weight))), list[Fit | None]()
    for other in others:
        now = _residual(other, windows, theta[None], start[None])[0]
        here = Slopes.of(theta, start, now, now + moved, width)
        temper = max(1.0, float(np.sum(now**2)) / n)
        moves, shifts = steps(other, here, temper, TRIALS * 1e-3)
        trials = _residual(other, windows, theta + moves, start + shifts)
        cost = squares(trials) + temper * other.prior(theta + moves)
        k = int(np.argmin(np.where(np.isfinite(cost), cost, np.inf)))
        ends = theta + moves[k], start + shifts[k], trials[k]
        known = Fit(other, *ends, float(other.prior(ends[0])), fitted.covariance, windows)
        out.append(known if np.isfinite(cost[k]) else None)
    return out


def _leaning(h: Hypothesis, windows: Windows, theta: Array) -> Windows:
    # Data of a simulator are hit to rounding, which no first order is.
    return h.leaning(windows, theta) if h.model.remembers and len(theta) and not windows.measured.exact else windows


def _led_down(h: Hypothesis, windows: Windows, part: Windows, here: Slopes, ends: _Ends, iterations: int) -> Slopes:
    """`_descended`, with memories that follow the numbers to first order, `part`, as far as these foretell the residual."""
    for k in range(THRESHOLDS.leaning_rounds if part is not windows else 0):
        first = min(iterations, THRESHOLDS.leaning_iterations)
        there, unused = _descended(h, part, here, ends, first)
        iterations -= first - unused
        r = _residual(h, windows, there.theta[None], there.start[None])[0]
        left, told, before = (float(np.sum(a**2)) for a in (r, there.residual, here.residual))
        # Within a difference step the slopes of the memories are those that were found there.
        settled = k > 0 or (np.abs(there.theta - here.theta) <= h.step).all()
        if settled and abs(left - told) < float(ends.small(np.array(left))):
            return there.moved(there.theta, there.start, r)
        temper = max(1.0, before / ends.n)
        if not left + temper * float(h.prior(there.theta)) <= before + temper * float(h.prior(here.theta)):
            break
        part = h.leaning(windows, there.theta)
        here = _linearise(h, part, there.theta, there.start, r, there.near(h))
    return _descended(h, windows, here, ends, iterations)[0]


def _descended(h: Hypothesis, windows: Windows, here: Slopes, ends: _Ends, iterations: int) -> tuple[Slopes, int]:
    """Common steps and the starts in turn, until neither gains; and how many iterations are left."""
    if not len(here.theta):
        return _settle(h, windows, here, ends, iterations)[0], 0
    while iterations > 0:
        here, taken = _descend(h, windows, here, ends, iterations)
        iterations -= taken
        before = float(squares(here.residual).sum())
        here, gained = _settle(h, windows, here, ends)
        if gained < ends.enough(before):
            break
    return here, iterations


def _begun(h: Hypothesis, windows: Windows, here: Slopes, ends: _Ends) -> Hypothesis | None:
    """With what acted before the pieces began: nothing, or their first inputs, whichever leaves less over their first windows,
    and another input where that leaves plainly less. None where little changes.
    """
    m, p, k = windows.measured, len(here.theta), THRESHOLDS.begun_values
    if m.exact or m.whole or not any(s.name != "time" for s in h.model.hidden):
        return None
    pieces, of = np.unique(windows.place[:, 0], return_inverse=True)
    keys, first = [m.beginning(i) for i in pieces.tolist()], np.stack([m.driven[i][0] for i in pieces.tolist()])
    if not p and all(key in h.acted for key in keys):
        return None
    rows = np.concatenate([np.flatnonzero(of == i)[: THRESHOLDS.begun_windows] for i in range(len(pieces))])
    part, start, held = windows.take(rows), here.start[rows][None], h.holding(here.theta)
    basis = np.linalg.qr(here.rows[rows][:, p:].swapaxes(1, 2))[0]

    def left(acted: Array) -> Array:
        r = _residual(replace(held, acted=dict(zip(keys, acted, strict=True))), part, np.empty((1, 0)), start)[0]
        flat = np.nan_to_num(r.reshape(len(rows), -1), nan=THRESHOLDS.steepest)
        flat = flat - (basis @ (flat[:, None] @ basis).swapaxes(1, 2))[..., 0]
        return np.asarray(np.bincount(of[rows], squares(flat)))

    ways = [0 * first, first]
    lost = [left(way) for way in ways]
    if np.array_equal(lost[0], lost[1]):
        return None
    best, square = (a[int(lost[1].sum() < lost[0].sum())] for a in (ways, lost))
    fitted, least, span = best.copy(), square.copy(), np.concatenate(m.inputs)
    for i, (low, high) in enumerate(zip(span.min(axis=0).tolist(), span.max(axis=0).tolist(), strict=True)):
        tried = np.stack([np.where(np.arange(first.shape[1]) == i, v, fitted) for v in np.linspace(low, high, k)])
        edges = left(tried[0]), left(tried[-1])
        if np.array_equal(*edges):  # nothing remembers this input
            continue
        over = np.stack([edges[0], *(left(way) for way in tried[1:-1]), edges[1]])
        at = np.clip(over.argmin(axis=0), 1, k - 2)
        a, b, c = (over[at + j, np.arange(len(at))] for j in (-1, 0, 1))
        vertex = 0.5 * (a - c) / np.where(a + c > 2 * b, a - 2 * b + c, np.inf)
        new = fitted.copy()
        new[:, i] = low + (high - low) / (k - 1) * (at + np.clip(vertex, -k, k))
        now = left(new)
        fitted, least = np.where((now < least)[:, None], new, fitted), np.minimum(now, least)
    each = np.maximum(1.0, least / np.bincount(of[rows], np.count_nonzero(part.weight, axis=(1, 2))))
    plain = square - least > (THRESHOLDS.number_score + 2 * math.log(len(pieces))) * each
    best = np.where(plain[:, None], fitted, best)
    now = np.stack([h.acted.get(key, way) for key, way in zip(keys, best, strict=True)])
    gained = left(now) - np.where(plain, least, square) if h.acted else np.maximum(np.abs(lost[0] - lost[1]), square - least)
    if gained.sum() < ends.enough(float(np.sum(here.residual**2))):
        return None
    return replace(h, acted={**h.acted, **dict(zip(keys, best, strict=True))}, begun=int(plain.sum()))


def _retraced(h: Hypothesis, windows: Windows, here: Slopes, ends: _Ends) -> tuple[Windows, Windows, Slopes] | None:
    """(windows, the same near the numbers, slopes), memories carried along the fitted motion; None where little changes.

    A bristle knows the last few hundredths of a radian, so noise of that size in its past is an error of its law.
    """
    x = h.motion(windows, here.theta[None], here.start[None], every=windows.measured.repeat)
    if not np.isfinite(x).all():
        return None
    again, reached = windows.retraced(x)
    if not reached.all():
        again = h.led(again, here.theta, here.start, ~reached)
    r = _residual(h, again, here.theta[None], here.start[None])[0]
    before = float(np.sum(here.residual**2))
    if not np.isfinite(r).all() or abs(float(np.sum(r**2)) - before) < ends.enough(before):
        return None
    part = _leaning(h, again, here.theta)
    return again, part, _linearise(h, part, here.theta, here.start, r, here.near(h))


def _descend(h: Hypothesis, windows: Windows, here: Slopes, ends: _Ends, iterations: int) -> tuple[Slopes, int]:
    """Steps in theta and all starts at once until they no longer pay, and how many."""
    damping = 1e-3
    for k in range(iterations):
        square = float(squares(here.residual).sum())
        temper = max(1.0, square / ends.n)
        moves, shifts = steps(h, here, temper, damping * TRIALS)
        thetas, starts = here.theta + moves, here.start + shifts
        trials = _residual(h, windows, thetas, starts)
        costs = np.nan_to_num(squares(trials) + temper * h.prior(thetas), nan=np.inf)
        cost = square + temper * float(h.prior(here.theta))
        best = int(np.argmin(costs))
        if not costs[best] < cost:
            if damping > 1e6:
                return here, k + 1
            damping *= 1e3
            continue
        damping, there = max(damping * TRIALS[best], 1e-9), (thetas[best], starts[best], trials[best])
        # A step that does what its slopes promise has found them hardly changed: new ones would promise about nothing more.
        reached = abs(costs[best] - cost + fall(h, here, temper)) < THRESHOLDS.step_fall * temper
        if reached or cost - costs[best] < float(ends.small(np.array(square))):
            return here.moved(*there), k + 1
        here = _linearise(h, windows, *there, here.near(h))
    return here, iterations


def _settle(
    h: Hypothesis, windows: Windows, here: Slopes, ends: _Ends, rounds: int = THRESHOLDS.settling_rounds
) -> tuple[Slopes, float]:
    """The starts alone, each window on its own: one that sticks or turns would hold up all others in a common step."""
    held, p = h.holding(here.theta), len(here.theta)
    known = h.remembering(windows, here.theta)
    start, residual, now = here.start.copy(), here.residual.copy(), squares(here.residual)
    before, damping, each = float(now.sum()), np.full(len(now), 1e-3), 1 / len(now)
    open_, slopes = np.arange(len(now)), here.starts()
    for _ in range(rounds):
        going = slopes.falls() > ends.small(now[open_], each)
        open_, slopes = open_[going], slopes.take(going)
        if not len(open_):
            break
        shifts = steps(held, slopes, 1.0, TRIALS[:, None] * damping[open_])[1]
        trials, part = start[open_] + shifts, known.take(open_)
        r = _residual(held, part, np.empty((len(trials), 0)), trials)
        costs = np.nan_to_num(squares(r.reshape(-1, *r.shape[2:])).reshape(r.shape[:2]), nan=np.inf)
        best, lower = np.argmin(costs, axis=0), costs.min(axis=0)
        fell, least = now[open_] - lower, ends.small(now[open_], each)
        better = fell > 0
        rows, chosen = open_[better], (best[better], np.flatnonzero(better))
        start[rows], residual[rows], now[rows] = trials[chosen], r[chosen], lower[better]
        damping[open_] *= np.where(better, TRIALS[best], 1e3)
        open_ = open_[(fell > least) | ~better & (damping[open_] < 1e3)]
        if not len(open_):
            break
        slopes = _linearise(held, known.take(open_), np.empty(0), start[open_], residual[open_])
    gained = before - float(now.sum())
    if gained < ends.enough(before) or not p:
        return here.moved(here.theta, start, residual), gained
    return _linearise(h, windows, here.theta, start, residual, here.near(h)), gained


def promising(h: Hypothesis, windows: Windows, thetas: Array, start: Array) -> tuple[Array, Array, float]:
    """(theta, starts, Σ r²): the one of several thetas (b, p) that fits best once the starts have followed, to first order."""
    count, nx, held = len(thetas), start.shape[1], h.holding(h.value)
    _, starts, width = nearby(held, np.empty(0), start, held.step)
    r = _residual(h, windows, np.repeat(thetas, 1 + nx, axis=0), np.tile(starts, (count, 1, 1)))
    r = r.reshape(count, 1 + nx, *windows.y.shape)
    best = h.value, start, np.inf
    for i in range(count):
        if np.isfinite(r[i]).all():
            here = Slopes.of(np.empty(0), start, r[i, 0], r[i, 1:], width)
            shift = reduced(held, here, 1.0, np.full(1, 1e-6))[3][0] * width
            left = float(np.sum((r[i, 0] - np.einsum("jwlc,wj->wlc", r[i, 1:] - r[i, 0], shift / width)) ** 2))
            if left < best[2]:
                best = thetas[i], start - shift, left
    return best


def slopes(fitted: Fit) -> tuple[Array, Array]:
    """What moving each number of a fit by a step adds to the residual, (W, L·ny, p), 0 where not finite; and the steps (p,)."""
    h, p, windows = fitted.hypothesis, len(fitted.theta), fitted.windows
    step = _linearise(h, windows, fitted.theta, fitted.start).near(h)
    thetas, starts, width = nearby(h, fitted.theta, fitted.start, step)
    r = _residual(h, windows, thetas[: 1 + p], starts[: 1 + p])
    rows = (r[1:] - r[0]).reshape(p, len(windows), r[0].size // len(windows)).transpose(1, 2, 0)
    return np.asarray(np.where(np.isfinite(rows), np.clip(rows, -THRESHOLDS.steepest, THRESHOLDS.steepest), 0.0)), width[:p]


@final
@dataclass(frozen=True)
class _Ends:
    """When a fit to n samples has nothing left to gain; rough: mean squares from which a law is plainly missing."""

    n: float
    rough: float

    @classmethod
    def of(cls, windows: Windows) -> _Ends:
        """Data of a simulator are hit exactly in the end, however far off a fit begins."""
        return cls(max(1.0, float(np.count_nonzero(windows.weight))), np.inf if windows.measured.exact else THRESHOLDS.rough)

    def small(self, square: Array, share: float = 1.0) -> Array:
        """Falls of Σ r², of a share of the samples, that no step is made for."""
        n = share * self.n
        return np.asarray(
            np.where(
                square > self.rough * n, THRESHOLDS.rough_step_fall * square, THRESHOLDS.step_fall * np.maximum(1.0, square / n)
            )
        )

    def enough(self, square: float) -> float:
        """A fall that is not worth another descent."""
        return max(THRESHOLDS.small_fall, float(self.small(np.array(square))))


def _followable(r: Array) -> bool:
    """Is a residual finite, and what is computed from it?"""
    return bool(np.abs(r).max(initial=0.0) < THRESHOLDS.wildest_residual)


def _residual(h: Hypothesis, windows: Windows, theta: Array, start: Array) -> Array:
    """weight·(simulated − measured)/σ, (b, W, L, ny)."""
    m = windows.measured
    with np.errstate(all="ignore"):
        r = difference(m.channels, h.simulate(windows, theta, start), windows.y[None]) * (windows.weight / m.sigma)
    return r if windows.weight.all() else np.where(windows.weight == 0, 0.0, r)


def _linearise(
    h: Hypothesis, windows: Windows, theta: Array, start: Array, r: Array | None = None, step: Array | None = None
) -> Slopes:
    """r: the residual there, where it is known; step (p,): of the differences, the hypothesis' own by default."""
    if r is None:
        r = _residual(h, windows, theta[None], start[None])[0]
    thetas, starts, width = nearby(h, theta, start, h.step if step is None else step)
    return Slopes.of(theta, start, r, _residual(h, windows, thetas[1:], starts[1:]), width)


def nearby(h: Hypothesis, theta: Array, start: Array, step: Array) -> tuple[Array, Array, Array]:
    """thetas (1 + p + nx, p), starts (1 + p + nx, W, nx): these, then each moved in one number, theta by `step` (p,).

    Also how far, (p + nx,).
    """
    p, nx = len(theta), start.shape[1]
    # Forward, or backward at an upper bound; the step of a dry law must be wide enough to see over its kinks.
    width = np.concatenate([np.where(theta + step > h.high, -step, step), nudges(start)])
    thetas, starts = np.tile(theta, (1 + p + nx, 1)), np.tile(start, (1 + p + nx, 1, 1))
    thetas[1 + np.arange(p), np.arange(p)] += width[:p]
    starts[1 + p + np.arange(nx), :, np.arange(nx)] += width[p:, None]
    return thetas, starts, width
