"""Training for route theorem1: networks above |r| on a cover, whose own Lipschitz constant is paid for.

Those of one hidden layer have free weights, and the constant that LipSDP proves of them. Others cannot exceed theirs, whatever
their parameters: sandwich layers (LBDN) and SDP-based ones (SLL), which become plain layers
y = W_l σ(… σ(W_0 z + b_0) …) + b_l, so that everything else sees a network like any other.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from gapcert import Array, UsageError
from gapcert_neural.thresholds import THRESHOLDS

from .training import Layers, Plan, Progress, Training

_ROOT2 = math.sqrt(2.0)


@final
@dataclass(frozen=True)
class Covered:
    """Points z (n, nz) in [−1, 1] with half-widths `half` of the domain, |r| (n, nx) in units of its mean, and the cover's
    joint radius (in units of z as measured); `active` (nz,) is 0 along axes on which nothing depends.
    """

    z: Array
    t: Array
    half: Array
    radius: float
    active: Array


class CoverTraining(Training):
    """What lies above t: by default a network with one hidden layer per state, W (nx, h, nz), b (nx, h), w (nx, h), c (nx,)."""

    def __init__(
        self,
        plan: Plan,
        points: Covered,
        checkpoint: Path | None,
        progress: Progress,
        shapes: Sequence[tuple[int, ...]] | None = None,
    ) -> None:
        super().__init__(plan, checkpoint, progress)
        self.points, nx, h, nz = points, points.t.shape[1], plan.hidden[0], points.z.shape[1]
        if shapes is None and len(plan.hidden) != 1:
            raise UsageError(
                f"neural: found {len(plan.hidden)} hidden layers; expected one on route theorem1, where its Lipschitz constant "
                f"is part of the training; use shape: lbdn, or route dominate"
            )
        self.shapes = shapes or [(nx, h, nz), (nx, h), (nx, h), (nx,)]
        self.z, self.t, self.active = (self.tensor(a) for a in (points.z, points.t, points.active))
        # Slopes per unit of z as measured: what the cover's radius multiplies.
        self.inverse = self.tensor(1 / points.half)
        self.scored = np.linspace(0, len(points.z) - 1, min(THRESHOLDS.scored_points, len(points.z))).astype(np.intp)

    def data(self) -> Sequence[Array]:
        p = self.points
        return p.z, p.t, p.half, np.array([p.radius]), p.active

    def drawn(self) -> Array:
        rng, (nx, h, nz) = np.random.default_rng([self.plan.seed, 0xC0E]), self.shapes[0]
        first = rng.standard_normal((nx, h, nz)) / np.sqrt(nz)
        parts = [first, rng.uniform(-1, 1, (nx, h)), 0.1 * rng.standard_normal((nx, h)) / np.sqrt(h), np.ones(nx)]
        return np.concatenate([p.ravel() for p in parts])

    def value(self, theta: Any, z: Any) -> Any:
        """(n, nx), above 0."""
        first, b, w, c = self.split(theta)[:4]
        hidden = self.activated(self.torch.einsum("nj,ihj->nih", z, first * self.active) + b)
        return self.torch.relu((hidden * w).sum(dim=2) + c)

    def batch(self) -> Any:
        rows = self.draws.integers(0, len(self.points.z), min(THRESHOLDS.cover_batch, len(self.points.z)))
        return self.torch.as_tensor(rows, device=self.z.device)

    def shortfall(self, theta: Any) -> tuple[Array, Array]:
        """(t − q, q) at the points that are looked at, (n, nx)."""
        found = []
        for rows in np.array_split(self.scored, max(1, len(self.scored) // THRESHOLDS.cover_batch)):
            at = self.torch.as_tensor(rows, device=self.z.device)
            q = self.value(theta, self.z[at])
            found.append(np.stack([(self.t[at] - q).cpu().numpy(), q.cpu().numpy()]))
        short, q = np.concatenate(found, axis=1).astype(np.float64)
        return short, q

    def layers(self, theta: Array) -> Layers:
        """As one network: the states' hidden layers beside each other."""
        first, b, w, c = self.split(theta)[:4]
        nx, h = b.shape
        last = np.zeros((nx, nx * h))
        for i in range(nx):
            last[i, i * h : (i + 1) * h] = w[i]
        return [((first * self.points.active).reshape(nx * h, -1), b.ravel()), (last, c.copy())]


class PaidTraining(CoverTraining):
    """What pays for its own Lipschitz constants: the loss is the certified mean, up to what no network changes."""

    @abstractmethod
    def constants(self, theta: Any, turns: int) -> Any:
        """(nx,): the Lipschitz constants that are paid for, in steps of a training with some turns towards them."""

    def loss(self, theta: Any, done: float) -> Any:
        """Σ_i mean q_i + max (t_i − q_i) + constant_i · radius over a batch, the largest softened, less so in time."""
        rows, sharpness = self.batch(), 10.0 + 90.0 * done
        q = self.value(theta, self.z[rows])
        short = (sharpness * (self.t[rows] - q)).logsumexp(dim=0) / sharpness
        return (q.mean(dim=0) + short + self.points.radius * self.constants(theta, THRESHOLDS.constant_turns)).sum()

    def score(self, theta: Any) -> float:
        short, q = self.shortfall(theta)
        own = self.constants(theta, 0).cpu().numpy()
        return float((q.mean(axis=0) + short.max(axis=0) + self.points.radius * own).sum())


@final
class CertifiedTraining(PaidTraining):
    """One hidden layer per state, with the exact optimum of LipSDP.

    L₁ = max over X ⪰ 0 with tr X = 1 of ½ (Σ_j |w_j| √(a_jᵀ X a_j) + √(gᵀ X g)), g = Σ_j w_j a_j.
    X follows the training by a fixed point, and the gradient at a fixed X is that of the maximum.
    """

    def __init__(self, plan: Plan, points: Covered, checkpoint: Path | None, progress: Progress) -> None:
        super().__init__(plan, points, checkpoint, progress)
        nz = points.z.shape[1]
        self.extra = np.tile(np.eye(nz) / nz, (points.t.shape[1], 1, 1))

    def constants(self, theta: Any, turns: int) -> Any:
        """(nx,): ½ F(X) after some turns of X ← M X M / tr, M = ∂F/∂X."""
        first, _, w, _ = self.split(theta)
        a = first * self.active * self.inverse
        g = (w[:, :, None] * a).sum(dim=1)
        x = self.tensor(self.extra)
        with self.torch.no_grad():
            for _ in range(turns):
                m = self._gradient(a.detach(), w.detach(), g.detach(), x)
                x = m @ x @ m
                x = x / x.diagonal(dim1=1, dim2=2).sum(dim=1)[:, None, None].clamp_min(1e-30)
            self.extra = x.cpu().numpy().astype(np.float64)
        return (w.abs() * self._root(a, x)).sum(dim=1) / 2 + self._root(g[:, None], x)[:, 0] / 2

    def _root(self, a: Any, x: Any) -> Any:
        return (((a @ x) * a).sum(dim=2) + 1e-12).sqrt()

    def _gradient(self, a: Any, w: Any, g: Any, x: Any) -> Any:
        weight = w.abs() / self._root(a, x)
        return (a * weight[:, :, None]).transpose(1, 2) @ a + g[:, :, None] * g[:, None] / self._root(g[:, None], x)[:, :, None]


@final
class PaperTraining(CoverTraining):
    """The published recipe: mean relu(t − q)² + mean relu(q − η)² − κ Σ_i log det M_i for a fixed L₁, η found by bisection.

    M is the matrix of LipSDP with ρ = L₁² and diagonal multipliers exp(τ), its hidden block eliminated; it stays positive
    definite, since steps that leave that set are halved. Eight phases of equal length try one η each: it is too small if more
    than 2 % of the largest |r| is missing at the end of the phase.
    """

    def __init__(
        self,
        plan: Plan,
        points: Covered,
        checkpoint: Path | None,
        progress: Progress,
        constants: Array,
        barrier: float,
    ) -> None:
        super().__init__(plan, points, checkpoint, progress)
        self.given, self.barrier = constants, barrier
        self.shapes = [*self.shapes, self.shapes[1]]
        self.top = points.t.max(axis=0)
        self.extra = np.stack([np.zeros_like(self.top), self.top, self.top])  # η is at least, at most; and tried now

    @property
    def patience(self) -> int:
        return self.plan.steps

    def data(self) -> Sequence[Array]:
        return [*super().data(), self.given, np.array([self.barrier])]

    def drawn(self) -> Array:
        """Weights so small that multipliers of 1 make M positive definite."""
        theta = super().drawn()
        first, _, w, c = (np.asarray(p) for p in self.split(np.concatenate([theta, np.zeros(np.prod(self.shapes[1]))]))[:4])
        own = first / self.points.half
        # Where the constant leaves room, weights stay as drawn: larger ones would put every kink on top of another.
        own *= np.minimum(1.0, 0.5 * self.given / np.maximum(np.linalg.norm(own, axis=(1, 2)), 1e-12))[:, None, None]
        w *= (0.5 / np.maximum(np.linalg.norm(w, axis=1), 1e-12))[:, None]
        b = np.random.default_rng([self.plan.seed, 1]).uniform(-1, 1, w.shape) * np.abs(own * self.points.half).sum(axis=2)
        parts = [own * self.points.half, b, w, c * self.top, np.zeros_like(w)]
        return np.concatenate([p.ravel() for p in parts])

    def matrices(self, theta: Any) -> Any:
        """(nx, nz + 1, nz + 1): [[ρ I − ½ AᵀTA, −½ Aᵀw], [·, 1 − ½ Σ w²/t]]."""
        first, _, w, _, tau = self.split(theta)
        a, t = first * self.active * self.inverse, tau.exp()
        nz = a.shape[2]
        square = self.tensor(self.given**2)[:, None, None] * self.torch.eye(nz, device=a.device)
        inner = square - (a * t[:, :, None]).transpose(1, 2) @ a / 2
        side = -(a * w[:, :, None]).sum(dim=1, keepdim=True) / 2
        corner = (1 - (w * w / t).sum(dim=1) / 2)[:, None, None]
        upper = self.torch.cat([inner, side.transpose(1, 2)], dim=2)
        return self.torch.cat([upper, self.torch.cat([side, corner], dim=2)], dim=1)

    def accepted(self, theta: Any) -> bool:
        """Definite, by Cholesky: the log-determinant of an indefinite matrix may be a number as well."""
        _, info = self.torch.linalg.cholesky_ex(self.matrices(theta))
        return not bool(info.any())

    def loss(self, theta: Any, done: float) -> Any:
        rows, eta = self.batch(), self.tensor(self.extra[2])
        q = self.value(theta, self.z[rows])
        fit = (self.torch.relu(self.t[rows] - q) ** 2).mean(dim=0) + (self.torch.relu(q - eta) ** 2).mean(dim=0)
        factor = self.torch.linalg.cholesky(self.matrices(theta))
        barrier = -2 * factor.diagonal(dim1=1, dim2=2).log().sum(dim=1)
        return (fit + self.barrier * barrier).sum()

    def score(self, theta: Any) -> float:
        """The newest θ stands. Where a phase ends, the half of [least, most] that cannot hold η is cut off."""
        short, _ = self.shortfall(theta)
        if self.step % max(1, self.plan.steps // THRESHOLDS.recipe_phases) == 0:
            feasible = short.max(axis=0) <= THRESHOLDS.phase_shortfall * self.top
            low, high, eta = self.extra
            ends = np.where(feasible, low, eta), np.where(feasible, eta, high)
            self.extra = np.stack([*ends, (ends[0] + ends[1]) / 2])
        return -float(self.step)


class ShapedTraining(PaidTraining):
    """The constant c = exp(θ_0) of all outputs is one of the parameters."""

    def __init__(self, plan: Plan, points: Covered, checkpoint: Path | None, progress: Progress) -> None:
        super().__init__(plan, points, checkpoint, progress, self.sizes(plan, points))
        self.half = self.tensor(points.half)

    @staticmethod
    @abstractmethod
    def sizes(plan: Plan, points: Covered) -> list[tuple[int, ...]]:
        """Shapes of the parameters, log c (1,) first."""

    @abstractmethod
    def plain(self, theta: Any) -> list[tuple[Any, Any]]:
        """(W_i, b_i), of slope at most exp(θ_0) per unit of z as measured."""

    def drawn(self) -> Array:
        rng, parts = np.random.default_rng([self.plan.seed, 0x1B]), []
        for shape in self.shapes:
            size = rng.standard_normal(shape) / np.sqrt(shape[-1])
            parts.append(np.zeros(shape) if shape == (1,) else 0.3 * size if len(shape) == 1 else size)
        # The constant starts at twice the mean size over the domain.
        parts[0] = np.full(1, np.log(2.0 / np.linalg.norm(self.points.half)))
        parts[-1] = np.ones(self.shapes[-1])  # above 0, where the output has a slope
        return np.concatenate([p.ravel() for p in parts])

    def value(self, theta: Any, z: Any) -> Any:
        layers = self.plain(theta)
        # Points are in units of the half-widths, weights are not.
        z = z * self.half * self.active
        for k, (w, b) in enumerate(layers):
            z = z @ w.T + b
            z = self.activated(z) if k < len(layers) - 1 else z
        return self.torch.relu(z)

    def constants(self, theta: Any, turns: int) -> Any:
        return theta[:1].exp().expand(self.points.t.shape[1])

    def layers(self, theta: Array) -> Layers:
        """In units of the half-widths, as trained weights of the other shapes are."""
        found = [(w.detach().cpu().numpy(), b.detach().cpu().numpy()) for w, b in self.plain(self.tensor(theta))]
        (w, b), *rest = [(np.asarray(w, dtype=np.float64), np.asarray(b, dtype=np.float64)) for w, b in found]
        return [(w * (self.points.half * self.points.active), b), *rest]


@final
class Sandwich(ShapedTraining):
    """h_i = √2 A_iᵀ Ψ_i σ(√2 Ψ_i⁻¹ B_i h_{i−1} + b_i) with A_i A_iᵀ + B_i B_iᵀ = I by Cayley's transform.

    Complete (Wang and Manchester 2023): every network that LipSDP proves to have the constant c has such parameters.
    """

    @staticmethod
    def sizes(plan: Plan, points: Covered) -> list[tuple[int, ...]]:
        found: list[tuple[int, ...]] = [(1,)]
        before = points.z.shape[1]
        for n in plan.hidden:
            found += [(n + before, n), (n,), (n,)]
            before = n
        nx = points.t.shape[1]
        return [*found, (nx + before, nx), (nx,)]

    def plain(self, theta: Any) -> list[tuple[Any, Any]]:
        log_c, *parts = self.split(theta)
        root, layers, after = (log_c / 2).exp(), [], None
        for k in range(0, len(parts) - 2, 3):
            x, d, b = parts[k : k + 3]
            a_t, inner = self._cayley(x)
            w = _ROOT2 * (inner / d.exp()[:, None])
            layers.append((root * w if after is None else w @ after, b))
            after = _ROOT2 * a_t * d.exp()
        _, last = self._cayley(parts[-2])
        layers.append((root * last @ after, parts[-1]))
        return layers

    def _cayley(self, x: Any) -> tuple[Any, Any]:
        """(Aᵀ, B) from X (n + m, n): A Aᵀ + B Bᵀ = I."""
        n = x.shape[1]
        u, v, eye = x[:n], x[n:], self.torch.eye(n, device=x.device)
        z = u - u.T + v.T @ v
        inverse = self.torch.linalg.inv(eye + z)
        return inverse @ (eye - z), (-2 * v @ inverse).T


@final
class Residual(ShapedTraining):
    """h′ = h − 2 W T⁻¹ relu(Wᵀ h + b), T_i = Σ_j |WᵀW|_ij q_j / q_i (Araujo et al. 2023): slope 1 for any W and q > 0.

    As plain layers h is carried on as relu(h) − relu(−h), which is exact; but LipSDP, which takes both parts for independent,
    proves a larger constant of these than they have. `lbdn` does not lose that.
    """

    @staticmethod
    def sizes(plan: Plan, points: Covered) -> list[tuple[int, ...]]:
        width = plan.hidden[0]
        nz, nx = points.z.shape[1], points.t.shape[1]
        each: list[tuple[int, ...]] = [s for n in plan.hidden for s in ((width, n), (n,), (n,))]
        return [(1,), (width, nz), *each, (nx, width), (nx,)]

    def plain(self, theta: Any) -> list[tuple[Any, Any]]:
        log_c, first, *parts, last, c = self.split(theta)
        root = (log_c / 2).exp()
        into, layers = root * self._short(first), []
        eye = self.torch.eye(first.shape[0], device=first.device)
        for k in range(0, len(parts), 3):
            w, q, b = parts[k], parts[k + 1].exp(), parts[k + 2]
            t = ((w.T @ w).abs() * q[None]).sum(dim=1) / q
            zero = self.torch.zeros(2 * len(eye), device=b.device)
            layers.append((self.torch.cat([w.T, eye, -eye]) @ into, self.torch.cat([b, zero])))
            into = self.torch.cat([-2 * w / (t + 1e-9), eye, -eye], dim=1)
        return [*layers, (root * self._short(last) @ into, c)]

    def _short(self, w: Any) -> Any:
        """Of spectral norm at most 1."""
        return w / self.torch.linalg.matrix_norm(w, 2).clamp_min(1.0)


SHAPES: dict[str, Callable[..., ShapedTraining]] = {"lbdn": Sandwich, "sll": Residual}
