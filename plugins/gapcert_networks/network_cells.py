"""How large the gradient of a network can be on a box: what is proved of many boxes at once; imports nothing that fits.

f(x) = w σ(W_{l−1} … σ(W_0 x + b_0) … ) + b has the gradient Dᵀ with D = w G_l W_{l−1} … G_1 W_0, G_i the slopes at x. On a box
c ± r every pre-activation is p + P(x − c) ± q with floats p, P, q, so that each slope is α + βP(x − c) ± ρ. To first order in
the deviations of the slopes, D is g = wα_lW_{l−1} … α_1W_0 plus a sum of vectors times numbers in [−1, 1], one for each neuron
whose slope varies and one for each input; what is of higher order lies in a box. Of Σ ε_j v_j, |ε_j| ≤ 1, the norm is at most
√(Σ t_j · λmax(Σ v_j v_jᵀ/t_j)) for any t_j > 0 (Cauchy–Schwarz), near the least for t_j = √(v_jᵀXv_j) where X comes from a few
steps X ← MXM/tr, M the matrix above. Nothing is asked of X, and t is what the floats say.

Rounding. With u = 2⁻⁵³, S = |w||W_{l−1}| … |W_0|1 (units of the inputs divided out) and K above the number of operations that
any entry passes through, every computed vector errs, summed over neurons, by at most γ_K times a multiple of S: all slopes lie
in [0, 1]. First-order terms give 3l + 1 of these; the box, whose own recursion adds l terms for each of l layers, (l + 2)³ at
most. A bound is raised by 4(l + 2)³ γ_K S for all of them. M is a sum of positive semidefinite terms, so its entries' errors
have a Frobenius norm of at most γ_K tr M. Pre-activations add what their last step may err by to q.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Bools, Ints
from gapcert_networks.thresholds import THRESHOLDS

from .network_constant import gamma
from .network_slopes import EPS, PIECEWISE, TINY, gates, lines

# Sizes (h, k), F and P (h, 1 or k, n), and where F is one for all boxes the products of its entries (h, n²).
_Block = tuple[Array, Array, Array, Array | None]
# Per layer (h, 1): 1 or −1 where all that is asked about has the pre-activation on that side of 0, else 0.
Held = list[npt.NDArray[np.int8]]


@final
@dataclass
class _Layer:
    """Neurons first, boxes second, inputs last: α, β, ρ and |slope − α| ≤ dev (h, k); P, F = ∂(pre-activation)/∂x at the slopes
    α, E ≥ |its deviation| (h, k or 1, n); p as z, q (h, k)."""

    alpha: Array
    beta: Array | None
    rho: Array
    dev: Array
    z: Array
    P: Array
    q: Array
    F: Array
    E: Array | None


@final
class Cells:
    """Bounds of a network with one output. weights W_0 … W_l, biases, activations of the hidden layers, units of the inputs."""

    def __init__(self, weights: Sequence[Array], biases: Sequence[Array], activations: Sequence[str], units: Array) -> None:
        self.names, self.last = list(activations), weights[-1][0]
        self.W, self.b, self.units = list(weights[:-1]), list(biases[:-1]), units
        self.n, self.depth = weights[0].shape[1], len(self.W)
        self.F = self.W[0] / units
        self.constant = np.zeros(self.n)  # a part of the gradient that is known
        total = sum(len(w) for w in self.W)
        paths, large = np.abs(self.F).sum(axis=1), [self.F, 1 / units]
        moved = np.any(weights[0], axis=1)
        for w in [*self.W[1:], weights[-1]]:
            large.append(paths)
            paths = np.abs(w) @ paths
            moved = np.any(w[:, moved], axis=1)
        back = np.abs(self.last)
        for w in self.W[:0:-1]:
            large.append(back)
            back = back @ np.abs(w)
        self.size, self.moves = float(paths[0]), bool(np.all(moved))
        sizes = [float(np.max(np.abs(a))) for a in [*large, back, *self.W, *self.b, self.last]]
        # NaN is refused too.
        self.usable = not self.moves or (
            max(sizes) * total <= THRESHOLDS.path_sums and 1 / THRESHOLDS.path_sums <= self.size <= THRESHOLDS.path_sums
        )
        self.error = gamma(2 * total + 32 * (self.depth + 1) + self.n**2)
        self.margin = 4 * (self.depth + 2) ** 3 * self.error * self.size * (1 + 1e-6)

    def within(self, lo: Array, hi: Array) -> Cells:
        """The same for boxes (k, n), of one hidden layer: neurons whose slope is one number on all of them are added up."""
        if self.depth > 1 or self.names[0] not in PIECEWISE:
            return self
        c, r = middle(lo.min(axis=0)[None], hi.max(axis=0)[None])
        z, q = self._first(c)
        alpha, _, rho = gates(self.names[0], z, _reach(np.abs(self.W[0]) @ r, q, z, self.n))
        open_, small = rho[:, 0] > 0, object.__new__(Cells)
        small.__dict__.update(self.__dict__)
        small.W, small.b, small.last, small.F = [self.W[0][open_]], [self.b[0][open_]], self.last[open_], self.F[open_]
        small.constant = self.constant + (self.last * alpha[:, 0])[~open_] @ self.F[~open_]
        return small

    def bounds(
        self, lo: Array, hi: Array, target: float = 0.0, before: Array | None = None, held: Held | None = None
    ) -> tuple[Array, Ints]:
        """(Above every gradient norm on each box, the axis along which to split it) of boxes (k, n).

        Bounds below a target, or far above it, are not made tighter, unless they are hardly below those known before.
        """
        c, r = middle(lo, hi)
        layers = self._layers(c, r, held)
        back, vectors, blocks, box, higher = self.last[:, None], [], [], *np.zeros((2, len(lo), self.n))
        g = self.constant + _combined(back * layers[-1].alpha, layers[-1].F)
        for i in range(self.depth - 1, -1, -1):
            here = layers[i]
            weight = np.abs(back)
            varied = weight * here.dev
            if here.E is not None:
                box += _combined(varied, here.E)
                # What a split along an input saves of it, as for the terms of first order.
                higher += _combined(varied * here.E.sum(axis=2) / (_spread(here.P, r) + TINY), np.abs(here.P)) * r.T
            bent = here.rho
            if here.beta is not None:
                bent = bent + np.abs(here.beta) * here.q
                vectors.append(_bent(back * here.beta, here.P, here.F, self.n) * r.T[:, :, None])
            moved = np.flatnonzero(bent.any(axis=1))
            pick = slice(None) if len(moved) == len(bent) else moved
            size = np.broadcast_to(weight, bent.shape)[pick] * bent[pick]
            F = np.ascontiguousarray(here.F[pick])
            pairs = (F[:, 0, :, None] * F[:, 0, None]).reshape(len(F), self.n**2) if F.shape[1] == 1 else None
            blocks.append((size, F, here.P[pick], pairs))
            if i:
                back = self.W[i].T @ (here.alpha * back)
        extra = [g[:, None], *([np.sum(vectors, axis=0)] if vectors else [])]
        if self.depth > 1:
            extra.append(box[:, :, None] * np.eye(self.n))
        square, score = self._norm(np.concatenate(extra, axis=1), blocks, r, bent=bool(vectors), target=target, before=before)
        score += higher
        # Where nothing varies that a split would make smaller, the longest side.
        axis = np.where(score.max(axis=1, keepdims=True) > 0, score, r.T).argmax(axis=1)
        value = np.sqrt(square) * (1 + 4 * EPS) + self.margin
        return np.where(np.isnan(value), np.inf, value), axis

    def attained(self, x: Array) -> Array:
        """(k,) below the gradient norm at points (k, n); 0 where a kink may be there."""
        z, q = self._first(x.T)
        q = _reach(0.0, q, z, self.n)
        found, off = [], np.zeros(len(x))
        for i, name in enumerate(self.names):
            if i:
                z, older, newer, _ = self._next(i, lines(self.names[i - 1], z, q), z, q, 0.0)
                q = _reach(older, newer, z, self.n)
            alpha, beta, rho = gates(name, z, q)
            found.append(alpha)
            off = np.maximum(off, (rho + (0.0 if beta is None else np.abs(beta) * q)).max(axis=0, initial=0.0))
        back = self.last[:, None] * found[-1]
        for w, alpha in zip(self.W[:0:-1], found[-2::-1], strict=True):
            back = alpha * (w.T @ back)
        g = self.constant + back.T @ self.F
        # Π(α + δ) − Πα ≤ 2lδ in every path where lδ is small.
        low = np.sqrt(np.sum(g * g, axis=1)) * (1 - 4 * self.n * EPS) - self.margin - 4 * self.depth * off * self.size
        return np.where(off < 1e-3 / self.depth, np.maximum(low, 0.0), 0.0)

    def _first(self, c: Array) -> tuple[Array, Array]:
        """(p, q) of the first layer at c (n, k)."""
        w, b = np.abs(self.W[0]), np.abs(self.b[0])
        wrong = 2 * gamma(self.n + 8) * (w @ np.abs(c).max(axis=1) + b) + TINY * (w.any(axis=1) | (b > 0))
        z = self.W[0] @ c + self.b[0][:, None]
        return z, wrong[:, None]

    def _next(self, i: int, line: tuple[Array, Array, Array], z: Array, q: Array, spread: Array | float) -> tuple[Array, ...]:
        """(p, older, newer) of layer i where the one before it is αv + μ ± δ: q = older + newer, newer from δ, older all other.

        spread ≥ |P|r of these lines.
        """
        a, mu, delta = line
        w, terms = np.abs(self.W[i]), 2 * gamma(self.W[i].shape[1] + 8)
        most = (np.abs(a * z) + np.abs(mu) + spread).max(axis=1, initial=0.0)
        wrong = 2 * gamma(w.shape[1] + self.n + 8) * (w @ most + np.abs(self.b[i])) + TINY * w.any(axis=1)
        p = self.W[i] @ (a * z + mu) + self.b[i][:, None]
        return p, (w @ (a * q)) * (1 + terms) + wrong[:, None], (w @ delta) * (1 + terms), wrong[:, None]

    def _both(self, i: int, a: Array, varies: Array) -> tuple[Array, Ints]:
        """(|W_i·a·W_{i−1}| (k, h, m), the m columns): of the neurons two layers before that vary on one of the boxes.

        What they do is added up over the layer between, signs and all.
        """
        columns = np.flatnonzero((varies > 0).any(axis=1))
        inner = a[:, :, None] * self.W[i - 1][:, None, columns]
        return np.abs(_product(self.W[i], inner, a.shape[1])).transpose(1, 0, 2), columns

    def layers(self, lo: Array, hi: Array, held: Held) -> list[_Layer]:
        """What `bounds` knows of the neurons."""
        return self._layers(*middle(lo, hi), held)

    def _layers(self, c: Array, r: Array, held: Held | None = None) -> list[_Layer]:
        k = c.shape[1]
        z, q = self._first(c)
        P, F = self.W[0][:, None], self.F[:, None]
        E: Array | None = None
        older, past = q, np.zeros((1, 1, 1))  # the parts of q and E that are not from the layer before
        reach = _reach(np.abs(self.W[0]) @ r, q, z, self.n)
        out: list[_Layer] = []
        delta = np.zeros((1, 1))
        for i, name in enumerate(self.names):
            if i:
                w, before, line, last = np.abs(self.W[i]), out[-1], self._line(i - 1, z, reach, held), delta
                a, _, delta = line
                sloped = a[:, :, None] * P
                z, bound, newer, wrong = self._next(i, line, z, q, _spread(sloped, r))
                changed = before.dev[:, :, None] * np.abs(F)
                E_before, E = E, _product(w, changed, k)
                if i > 1 and E_before is not None:
                    two, terms = out[-2], 4 * gamma(sum(self.W[i - 1].shape) + 16)
                    both, m = self._both(i, a, last)
                    finer = np.matmul(both, np.broadcast_to(last, two.dev.shape)[m].T[:, :, None])[:, :, 0].T
                    older = np.minimum(bound, (finer + w @ (a * older)) * (1 + terms) + terms * bound + wrong)
                    both, m = self._both(i, before.alpha, two.dev)
                    finer = np.matmul(both, (two.dev[m][:, :, None] * np.abs(two.F[m])).transpose(1, 0, 2)).transpose(1, 0, 2)
                    rest = before.alpha[:, :, None] * past + before.dev[:, :, None] * E_before
                    plain = np.minimum(before.alpha + before.dev, 1.0)[:, :, None] * E_before
                    past = np.minimum(finer + _product(w, rest, k), _product(w, plain, k))
                    E += past
                else:
                    older, past = bound, np.zeros_like(E)
                q = (older + newer) * (1 + 2 * EPS)
                P = _product(self.W[i], sloped, k)
                F = _product(self.W[i], before.alpha[:, :, None] * F, k)
                reach = _reach(_spread(P, r), q, z, self.n)
            alpha, beta, rho = gates(name, z, reach)
            if held is not None:
                alpha, rho = _sided(name, held[i], alpha), np.where(held[i] == 0, rho, 0.0)
            dev = rho if beta is None else np.minimum(np.abs(beta) * reach + rho, 1.0)
            out.append(_Layer(alpha, beta, rho, dev, z, P, q, F, E))
        return out

    def _line(self, i: int, z: Array, reach: Array, held: Held | None) -> tuple[Array, Array, Array]:
        """The values between two lines; of those on one side of 0, one line through 0."""
        a, mu, delta = lines(self.names[i], z, reach)
        if held is None:
            return a, mu, delta
        free = held[i] == 0
        return _sided(self.names[i], held[i], a), np.where(free, mu, 0.0), np.where(free, delta, 0.0)

    def _norm(
        self, V: Array, blocks: list[_Block], r: Array, *, bent: bool, target: float, before: Array | None
    ) -> tuple[Array, Array]:
        """(Above the square of the norm (k,), how much of it varies along each input (k, n)): of vectors V (k, m, n), where
        bent the 2nd to (n + 1)th those of the inputs, and of the blocks. Steps are spent where they may bring it below target,
        or where a split did little: there the first step may be what is loose.
        """
        k, n = len(V), self.n
        g = V[:, 0]
        X = 0.8 * g[:, :, None] * g[:, None] / (np.sum(g * g, axis=1) + TINY)[:, None, None] + 0.2 / n * np.eye(n)
        best, M, own, times = self._once(V, blocks, X)
        score = own[:, 1 : n + 1].copy() if bent else np.zeros((k, n))
        for t, (_, _, P, _) in zip(times, blocks, strict=True):
            score += _combined(t / (_spread(P, r) + TINY), np.abs(P)) * r.T
        rows = np.arange(k)
        for _ in range(THRESHOLDS.cell_steps - 1):
            keep = np.arange(len(rows))
            if before is not None:
                useful = (best < (THRESHOLDS.cell_hope * target) ** 2) | (best > (THRESHOLDS.cell_stuck * before) ** 2)
                keep = np.flatnonzero(((best > target**2) & useful)[rows])
            if len(keep) == 0:
                break
            rows, V, X, M = rows[keep], V[keep], X[keep], M[keep]
            blocks = [(size[:, keep], F if s is not None else F[:, keep], P, s) for size, F, P, s in blocks]
            X = np.matmul(np.matmul(M, X), M)
            X /= np.einsum("kii->k", X)[:, None, None] + TINY
            value, M, _, _ = self._once(V, blocks, X)
            best[rows] = np.fmin(best[rows], value)
        return best, score

    def _once(self, V: Array, blocks: list[_Block], X: Array) -> tuple[Array, Array, Array, list[Array]]:
        """(Σt·λmax(M), M, t of V, t of each block) for one X."""
        k, n = len(V), self.n
        own = _roots(np.sum(np.matmul(V, X) * V, axis=2), np.sum(V * V, axis=2))
        total = own.sum(axis=1)
        M = np.matmul((V / own[:, :, None]).transpose(0, 2, 1), V)
        flat, times = X.reshape(k, n * n).T, []
        for size, F, _, pairs in blocks:
            if pairs is not None:
                root = _roots(pairs @ flat, pairs[:, :: n + 1].sum(axis=1)[:, None])
                M += ((size / root).T @ pairs).reshape(k, n, n)
            else:
                G = F.transpose(1, 0, 2)
                root = _roots(np.sum(np.matmul(G, X) * G, axis=2), np.sum(G * G, axis=2)).T
                M += np.matmul(G.transpose(0, 2, 1), (size / root).T[:, :, None] * G)
            times.append(size * root)
            total = total + times[-1].sum(axis=0)
        trace = np.einsum("kii->k", M)
        return total * (largest(M, trace) + 2 * self.error * trace) * (1 + 4 * self.error), M, own, times


def largest(M: Array, trace: Array) -> Array:
    """(k,) above the largest eigenvalue of positive semidefinite M (k, n, n), near it; only the lower triangles are read.

    What is guessed is proved: λI − M/tr M less c·I has a Cholesky factor in floating point, c above all that rounding does
    (Rump 2006, Theorem 2.3: at most γ_{n+1}/(1 − γ_{n+1}) times the trace). Else λmax ≤ tr M.
    """
    n = M.shape[1]
    whole = np.where(trace > 0, trace, 1.0)
    A = M / whole[:, None, None]
    power = A
    for _ in range(4):
        power = np.matmul(power, power)
        power /= np.einsum("kii->k", power)[:, None, None] + TINY
    v = power[np.arange(len(M)), np.einsum("kii->ki", power).argmax(axis=1)]
    guess = np.sum(np.matmul(A, v[:, :, None])[:, :, 0] * v, axis=1) / (np.sum(v * v, axis=1) + TINY)
    found = np.where(trace > 0, np.fmin(guess * (1 + 1e-5) + 1e-12, 1.0), 0.0)
    open_ = np.flatnonzero((trace > 0) & ~_below(A, found))
    if len(open_):
        sharp = np.fmin(np.linalg.eigvalsh(A[open_])[:, -1] * (1 + 1e-9) + 1e-12, 1.0)
        found[open_] = np.where(_below(A[open_], sharp), sharp, 1.0)
    return np.asarray(found * whole * (1 + 8 * n * EPS))


def _below(A: Array, value: Array) -> Bools:
    """Is λI − A positive definite for certain? A of trace 1 within rounding, λ ≤ 1."""
    n = A.shape[1]
    B = np.ascontiguousarray(-A.transpose(1, 2, 0))
    B[np.arange(n), np.arange(n)] += value - 8 * (n + 1) * gamma(n + 4)
    proved = np.isfinite(value)
    for j in range(n):
        proved &= B[j, j] > 0
        column = B[j + 1 :, j] / np.sqrt(np.where(proved, B[j, j], 1.0))
        B[j + 1 :, j + 1 :] -= column[:, None] * column[None]
    return proved


def _sided(name: str, held: npt.NDArray[np.int8], alpha: Array) -> Array:
    """The slope of that side, where one is said."""
    below, above = PIECEWISE[name]
    return np.where(held > 0, above, np.where(held < 0, below, alpha))


def middle(lo: Array, hi: Array) -> tuple[Array, Array]:
    """(c, r), inputs first: c ± r contains the box."""
    c = lo / 2 + hi / 2
    return c.T, (np.maximum(hi - c, c - lo) * (1 + EPS) + TINY).T


def _reach(spread: Array | float, q: Array, z: Array, n: int) -> Array:
    """Above |P|r + q, so far that p ± it, rounded, still contains the pre-activations."""
    return np.asarray((spread + q) * (1 + (n + 16) * EPS) + 4 * EPS * np.abs(z))


def _roots(square: Array, whole: Array) -> Array:
    """√(vᵀXv), kept away from 0 beside vᵀv."""
    return np.sqrt(np.maximum(square, THRESHOLDS.least_square * whole + 1e-200))


def _spread(P: Array, r: Array) -> Array:
    """|P|r (h, k) of P (h, 1 or k, n)."""
    return np.abs(P[:, 0]) @ r if P.shape[1] == 1 else np.einsum("hkn,nk->hk", np.abs(P), r)


def _combined(weight: Array, F: Array) -> Array:
    """Σ_j weight_j F_j (k, n) of weight (h, k), F (h, 1 or k, n)."""
    return np.asarray(weight.T @ F[:, 0] if F.shape[1] == 1 else np.einsum("hk,hkn->kn", weight, F))


def _bent(weight: Array, P: Array, F: Array, n: int) -> Array:
    """Σ_j weight_j P_j F_jᵀ (k, n, n)."""
    if P.shape[1] == 1:
        return np.asarray((weight.T @ (P[:, 0, :, None] * F[:, 0, None]).reshape(len(P), n * n)).reshape(-1, n, n))
    return np.asarray(np.matmul((weight[:, :, None] * P).transpose(1, 2, 0), F.transpose(1, 0, 2)))


def _product(w: Array, a: Array, k: int) -> Array:
    return np.asarray((w @ a.reshape(len(a), -1)).reshape(len(w), a.shape[1], a.shape[2]))
