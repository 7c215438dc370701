"""Networks that cannot exceed a Lipschitz constant, whatever their parameters: sandwich layers (LBDN) and SDP-based ones (SLL).

Both become plain layers y = W_l σ(… σ(W_0 z + b_0) …) + b_l, so that everything else sees a network like any other.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any, final

import numpy as np

from gapcert import Array

from .covered import Covered, PaidTraining
from .training import Layers, Plan, Progress

_ROOT2 = math.sqrt(2.0)


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
