"""Training against both sides of a band, on the integral of the band that shifts per cell of a table will certify."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from gapcert.plugin import Array, Ints
from gapcert_neural.thresholds import THRESHOLDS

from .training import Layers, Plan, Progress, Training


@final
@dataclass(frozen=True)
class Pool:
    """Points z (n, nz) in [−1, 1], targets t (n, m) of size 1, sorted by the cell of the table that they lie in.

    signs (m,): +1 where the network has to lie above its target, −1 below. starts (cells + 1,): where each cell begins.
    """

    z: Array
    t: Array
    signs: Array
    starts: Ints

    @classmethod
    def sorted(cls, z: Array, t: Array, signs: Array, cell: Ints) -> Pool:
        order = np.argsort(cell, kind="stable")
        _, first = np.unique(cell[order], return_index=True)
        return cls(z[order], t[order], signs, np.append(first, len(z)))

    def batch(self, rng: np.random.Generator) -> Ints:
        """(cells, points): numbers of points, drawn with replacement within cells drawn without."""
        cells = rng.permutation(len(self.starts) - 1)[: THRESHOLDS.batch_cells]
        count = np.diff(self.starts)[cells]
        return np.asarray(
            self.starts[cells][:, None] + (rng.random((len(cells), THRESHOLDS.batch_points)) * count[:, None]).astype(np.intp)
        )


@final
class BandTraining(Training):
    """A network z → t whose loss is, summed over targets, the mean over cells of (largest − mean) of sign · (t − q): by that
    much q, with its shift, lies beyond t on average. The largest is softened, less so as the training goes on.
    """

    def __init__(self, plan: Plan, pool: Pool, checkpoint: Path | None, progress: Progress) -> None:
        super().__init__(plan, checkpoint, progress)
        self.pool = pool
        sizes = (pool.z.shape[1], *plan.hidden, pool.t.shape[1])
        self.shapes = [shape for a, b in itertools.pairwise(sizes) for shape in ((b, a), (b,))]
        self.z, self.t, self.signs = (self.tensor(a) for a in (pool.z, pool.t, pool.signs))

    def data(self) -> Sequence[Array]:
        return self.pool.z, self.pool.t, self.pool.signs, self.pool.starts.astype(np.float64)

    def drawn(self) -> Array:
        """He's weights, and biases that put the kinks all over the cube."""
        rng, parts = np.random.default_rng([self.plan.seed, 0x4E7]), []
        for shape in self.shapes:
            variance = 2.0 / shape[1] if len(shape) == 2 else 1.0 / 3
            parts.append(rng.standard_normal(shape).ravel() * np.sqrt(variance))
        return np.concatenate(parts)

    def loss(self, theta: Any, done: float) -> Any:
        rows = self.torch.as_tensor(self.pool.batch(self.draws), device=theta.device)
        d, sharpness = self.signs * (self.t[rows] - self._value(theta, self.z[rows])), 3.0 + 27.0 * done
        return ((sharpness * d).logsumexp(dim=1) / sharpness - d.mean(dim=1)).mean(dim=0).sum()

    def score(self, theta: Any) -> float:
        d = (self.signs * (self.t - self._value(theta, self.z))).cpu().numpy().astype(np.float64)
        largest = np.maximum.reduceat(d, self.pool.starts[:-1])
        return float((largest.mean(axis=0) - d.mean(axis=0)).sum())

    def _value(self, theta: Any, z: Any) -> Any:
        parts = self.split(theta)
        for k in range(0, len(parts), 2):
            z = z @ parts[k].T + parts[k + 1]
            z = self.activated(z) if k < len(parts) - 2 else z
        return z

    def layers(self, theta: Array) -> Layers:
        parts = self.split(theta)
        return list(zip(parts[::2], parts[1::2], strict=True))
