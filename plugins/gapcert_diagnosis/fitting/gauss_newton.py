"""Gauss–Newton over numbers that windows share and the start of each window, which is eliminated: Schur complements."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array
from gapcert_diagnosis.thresholds import THRESHOLDS

from .hypothesis import Hypothesis


@final
@dataclass(frozen=True)
class Slopes:
    """A residual (W, L, ny) and, per window, what moving each number by `width` adds to it: rows (W, p + nx, L·ny).

    Numbers are theta, then the window's own start. gram (W, p + nx + 1, ·): products; the last are those of the residual.
    """

    theta: Array
    start: Array
    residual: Array
    rows: Array
    gram: Array
    width: Array

    @classmethod
    def of(cls, theta: Array, start: Array, r: Array, moved: Array, width: Array) -> Slopes:
        """From residuals moved (p + nx, W, L, ny). What is not finite says nothing: a model there has no slope."""
        rows = np.empty((len(r), len(moved) + 1, r[0].size))
        with np.errstate(invalid="ignore"):
            rows[:, :-1] = (moved - r).reshape(len(moved), len(r), -1).swapaxes(0, 1)
        rows[:, -1] = r.reshape(len(r), -1)
        if not np.abs(rows).max() <= THRESHOLDS.steepest:
            rows = np.clip(np.where(np.isfinite(rows), rows, 0.0), -THRESHOLDS.steepest, THRESHOLDS.steepest)
        return cls(theta, start, r, rows[:, :-1], rows @ rows.swapaxes(1, 2), width)

    def moved(self, theta: Array, start: Array, residual: Array) -> Slopes:
        """At numbers so near that a step there gains nothing: the slopes are the same."""
        flat, gram = residual.reshape(len(residual), -1).clip(-THRESHOLDS.steepest, THRESHOLDS.steepest), self.gram.copy()
        gram[:, :-1, -1] = gram[:, -1, :-1] = (self.rows @ flat[..., None])[..., 0]
        gram[:, -1, -1] = squares(flat)
        return replace(self, theta=theta, start=start, residual=residual, gram=gram)

    def near(self, h: Hypothesis) -> Array:
        """Difference steps (p,) that move the residual by no more than itself: a wider secant is no slope of what is left."""
        p, norms = len(h.step), np.sqrt(np.einsum("wii->i", self.gram))
        return np.asarray(np.minimum(h.step, np.abs(self.width[:p]) * norms[-1] / np.maximum(norms[:p], 1e-300)))

    def starts(self) -> Slopes:
        """Without theta."""
        p = len(self.theta)
        return Slopes(np.empty(0), self.start, self.residual, self.rows[:, p:], self.gram[:, p:, p:], self.width[p:])

    def take(self, which: npt.NDArray[np.bool_]) -> Slopes:
        """Of some windows."""
        start, residual, rows, gram = (a[which] for a in (self.start, self.residual, self.rows, self.gram))
        return Slopes(self.theta, start, residual, rows, gram, self.width)

    def falls(self) -> Array:
        """(W,): by how much Σ r² of each window would fall, if it were as linear in its start as here."""
        hxx, g = self.gram[:, :-1, :-1].copy(), self.gram[:, :-1, -1]
        nx = np.arange(g.shape[1])
        hxx[:, nx, nx] += _ridge(hxx)
        return np.asarray(np.sum(g * np.linalg.solve(hxx, g[..., None])[..., 0], axis=1))


def squares(r: Array) -> Array:
    """Σ over all but the first axis."""
    flat = r.reshape(len(r), -1)
    return np.asarray(np.einsum("ij,ij->i", flat, flat))


def reduced(h: Hypothesis, here: Slopes, temper: float, damping: Array) -> tuple[Array, Array, Array, Array]:
    """Normal equations in units of `width` with the starts eliminated, for every damping (k,), or (k, W) of the starts.

    Schur complement (k, p, p), its right side (k, p), H_xx⁻¹H_xθ (k, W, nx, p), H_xx⁻¹g_x (k, W, nx).
    """
    theta, gram = here.theta, here.gram
    p, k = len(theta), damping.reshape(len(damping), -1)
    scale = here.width[:p] / h.sd
    htt = gram[:, :p, :p].sum(axis=0) + np.diag(temper * scale**2)
    gt = gram[:, :p, -1].sum(axis=0) + temper * scale * (theta - h.value) / h.sd
    hxt, hxx = gram[:, p:-1, :p], np.tile(gram[:, p:-1, p:-1], (len(damping), 1, 1, 1))
    nx = np.arange(hxx.shape[-1])
    hxx[:, :, nx, nx] *= 1 + k[..., None]
    hxx[:, :, nx, nx] += _ridge(gram[:, p:-1, p:-1])
    solved = np.linalg.solve(hxx, np.broadcast_to(gram[:, p:-1, [*range(p), -1]], (*hxx.shape[:3], p + 1)))
    a, b = solved[..., :p], solved[..., p]
    with np.errstate(invalid="ignore", over="ignore"):
        schur = htt - np.einsum("wij,kwil->kjl", hxt, a)
        schur[:, np.arange(p), np.arange(p)] += k[:, :1] * np.diag(htt)
        side = np.einsum("wij,kwi->kj", hxt, b) - gt
    # Equations that overflow say nothing: no step, instead of one that is not finite.
    wild = ~(np.isfinite(schur).all(axis=(1, 2)) & np.isfinite(side).all(axis=1) & np.isfinite(solved).all(axis=(1, 2, 3)))
    schur[wild], side[wild], a[wild], b[wild] = np.eye(p), 0.0, 0.0, 0.0
    return np.asarray(schur), np.asarray(side), np.asarray(a), np.asarray(b)


def _ridge(hxx: Array) -> Array:
    """(W, 1): what keeps the normal equations of starts (W, nx, nx) regular where a window does not feel one of them."""
    return np.asarray(1e-12 * np.trace(hxx, axis1=1, axis2=2)[:, None] + 1e-300)


def fall(h: Hypothesis, here: Slopes, temper: float) -> float:
    """By how much Σ r² and the prior would fall at most, were all as linear as here."""
    schur, side, _, b = reduced(h, here, temper, np.zeros(1))
    starts = float(np.sum(here.gram[:, len(here.theta) : -1, -1] * b[0]))
    return starts + float(side[0] @ np.linalg.lstsq(schur[0], side[0], rcond=None)[0])


def steps(h: Hypothesis, here: Slopes, temper: float, damping: Array) -> tuple[Array, Array]:
    """Damped Gauss–Newton steps (k, p), (k, W, nx), with theta kept in its bounds by an active set."""
    schur, side, a, b = reduced(h, here, temper, damping)
    theta, p = here.theta, len(here.theta)
    limits = np.sort([(h.low - theta) / here.width[:p], (h.high - theta) / here.width[:p]], axis=0)
    moves = np.stack([bounded(s, r, *limits) for s, r in zip(schur, side, strict=True)])
    shifts = -(b + np.einsum("kwij,kj->kwi", a, moves))
    return np.clip(moves * here.width[:p], h.low - theta, h.high - theta), shifts * here.width[p:]


def bounded(schur: Array, side: Array, low: Array, high: Array) -> Array:
    """schur·move = side within bounds: what leaves them is held there, and the rest solved again."""
    free, move = np.ones(len(side), dtype=bool), np.zeros(len(side))
    for _ in range(len(side)):
        known = side[free] - schur[np.ix_(free, ~free)] @ move[~free]
        move[free] = np.linalg.lstsq(schur[np.ix_(free, free)], known, rcond=None)[0]
        out = free & ((move < low) | (move > high))
        if not out.any():
            break
        move[out] = np.clip(move, low, high)[out]
        free &= ~out
    return move
