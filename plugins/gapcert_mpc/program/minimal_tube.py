"""The smallest tube and terminal set of a trajectory: what a program leaves free is determined, and small, and pays no cost."""

from __future__ import annotations

from typing import final

import numpy as np
from scipy.linalg.blas import dtbsv

from gapcert import Array

from .program import Program


@final
class Least:
    """z → z with a_k = |z̄_k − ẑ_k| + ε, s by its recursion, and the least σ ≥ Mσ + |H|(c + G a_s + ε) that holds s_N.

    Rows ask for smaller s, a and σ, so that a trajectory that keeps them with any tube keeps them with this one. Of two such σ
    the pointwise least is another: there is a least one. Policy iteration finds it.
    """

    def __init__(self, program: Program) -> None:
        self.program = p = program
        at, st, on, N, n = p.at, p.stages, p.on, p.N, p.n
        self.xs, self.kappa = int(at["xs"][0]), int(at["size"][0])
        self.inverse = np.linalg.inv(p.terminal[1])
        self.need = p.constant[N] - p.terminal[0] + p.tolerance
        if p.variable:
            last = np.append(at["u"], at["us"])
            columns = np.hstack([at["x"][:, None] + np.arange(n), last[:, None] + np.arange(p.m)])
            columns[N, :n] = self.xs + np.arange(n)
            self.inputs, self.centre = columns[:, on], st.centre[:, on]
            self.band, self.spread = _lower_band(p.grown[1:N]), (p.spread[:N] + p.tolerance).ravel()
            self.spread[: p.p] += p.grown[0] @ p.s0
            self.grows = np.abs(p.section.H) @ st.G[:N][:, :, on]

    def __call__(self, z: Array) -> Array:
        p, z = self.program, z.copy()
        end, xs, kappa = p.N * p.n, self.xs, self.kappa
        need = self.need + np.abs(p.section.H @ (z[end : end + p.n] - z[xs : xs + p.n]))
        if p.variable:
            a = np.abs(z[self.inputs] - self.centre) + p.tolerance
            s = dtbsv(len(self.band) - 1, self.band, self.spread + (self.grows @ a[:-1, :, None]).ravel(), lower=1, diag=1)
            z[kappa + p.p :] = np.concatenate([s, a.ravel()])
            need += s[-p.p :] - p.terminal[2] @ a[-1]
        z[kappa : kappa + p.p] = self._kappa(need)
        return z

    def _kappa(self, need: Array) -> Array:
        """κ ≥ 0 of the least σ = more κ ≥ need, where `more` is the inverse of an M-matrix up to a diagonal."""
        held = need > 0
        if not held.any():
            return np.zeros(len(need))
        kappa, more = np.asarray(self.inverse @ need), self.program.terminal[1]
        # Each round raises σ, so that no set comes twice but by rounding.
        for _ in range(4 * len(need) if kappa.min() < 0 else 0):
            kappa = np.zeros(len(need))
            kappa[held] = np.linalg.solve(more[np.ix_(held, held)], need[held])
            then = np.where(held, kappa > 0, more @ kappa < need - 1e-12)
            if (then == held).all():
                break
            held = then
        return np.asarray(np.maximum(kappa, 0.0))


def _lower_band(blocks: Array) -> Array:
    """I with −blocks (k, p, p) below its diagonal blocks, as the bands that BLAS takes: [i − j, j]."""
    k, p = blocks.shape[:2]
    band = np.zeros((2 * p, (k + 1) * p))
    band[0] = 1.0
    for i, j in np.ndindex(p, p):
        band[p + i - j, j : k * p : p] = -blocks[:, i, j]
    return np.asfortranarray(band)
