"""Training on the certified integral: deterministic by seed, interruptible, resumed from a checkpoint to the same bits."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]

_EVERY = 5.0  # seconds between checkpoints
_LOOKS = 20  # at the loss of all points, in the course of a training
_PATIENCE = 5  # looks without a gain of a thousandth
_ENOUGH = 1e-3  # loss, in units of the targets' spread, that is not worth reducing
_CELLS, _POINTS = 128, 16  # of a batch: cells, and points of each


@final
@dataclass(frozen=True)
class Pool:
    """Points z (n, nz) in [−1, 1], targets t (n, m) of size 1, sorted by the cell of the table that they lie in.

    signs (m,): +1 where the network has to lie above its target, −1 below. starts (cells + 1,): where each cell begins.
    """

    z: Array
    t: Array
    signs: Array
    starts: Index

    @classmethod
    def sorted(cls, z: Array, t: Array, signs: Array, cell: Index) -> Pool:
        order = np.argsort(cell, kind="stable")
        _, first = np.unique(cell[order], return_index=True)
        return cls(z[order], t[order], signs, np.append(first, len(z)))

    def batch(self, rng: np.random.Generator) -> Index:
        """(cells, points): numbers of points, drawn with replacement within cells drawn without."""
        cells = rng.permutation(len(self.starts) - 1)[:_CELLS]
        count = np.diff(self.starts)[cells]
        return np.asarray(self.starts[cells][:, None] + (rng.random((len(cells), _POINTS)) * count[:, None]).astype(np.intp))


@final
@dataclass(frozen=True)
class Plan:
    """What is trained and for how long."""

    hidden: tuple[int, ...]
    activation: str
    steps: int
    seed: int
    device: str
    rate: float = 5e-3

    def digest(self, pool: Pool) -> str:
        h = hashlib.sha256(repr(self).encode())
        for a in (pool.z, pool.t, pool.signs, pool.starts):
            h.update(np.ascontiguousarray(a).tobytes())
        return h.hexdigest()


def train(plan: Plan, pool: Pool, checkpoint: Path | None, progress: Callable[[int, int], None]) -> list[tuple[Array, Array]]:
    """Weights and biases (float64, from float32) of a network z → t that is best in the loss over all points.

    loss = Σ over targets of the mean over cells of (largest − mean) of sign · (t − q): by that much q, with its shift, lies
    beyond t on average. The largest is softened, less so as the training goes on.
    """
    with _alone():
        return _Training(plan, pool, checkpoint, progress).run()


@contextlib.contextmanager
def _alone() -> Iterator[None]:
    """One thread: sums are then done in one order, whatever the machine."""
    torch: Any = importlib.import_module("torch")
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@final
class _Training:
    def __init__(self, plan: Plan, pool: Pool, checkpoint: Path | None, progress: Callable[[int, int], None]) -> None:
        self.plan, self.pool, self.checkpoint, self.progress = plan, pool, checkpoint, progress
        self.torch: Any = importlib.import_module("torch")
        self.key = plan.digest(pool)
        sizes = (pool.z.shape[1], *plan.hidden, pool.t.shape[1])
        self.shapes = [shape for a, b in itertools.pairwise(sizes) for shape in ((b, a), (b,))]
        self.z, self.t = (self._tensor(a) for a in (pool.z, pool.t))
        self.signs = self._tensor(pool.signs)
        # θ, its Adam moments, and the best θ so far.
        self.state = np.zeros((4, sum(int(np.prod(s)) for s in self.shapes)), dtype=np.float32)
        self.state[0] = self.state[3] = self._drawn()
        self.step, self.best, self.stale = 0, np.inf, 0

    def _tensor(self, a: Any) -> Any:
        return self.torch.as_tensor(np.ascontiguousarray(a, dtype=np.float32), device=self._device())

    def _device(self) -> str:
        if self.plan.device == "auto":
            return "cuda" if self.torch.cuda.is_available() else "cpu"
        return self.plan.device

    def _drawn(self) -> npt.NDArray[np.float32]:
        """He's weights, and biases that put the kinks all over the cube."""
        rng, parts = np.random.default_rng([self.plan.seed, 0x4E7]), []
        for shape in self.shapes:
            fan = shape[1] if len(shape) == 2 else 3
            parts.append(rng.standard_normal(shape).ravel() * np.sqrt((2.0 if len(shape) == 2 else 1.0) / fan))
        return np.concatenate(parts).astype(np.float32)

    def run(self) -> list[tuple[Array, Array]]:
        self._resume()
        theta, m, v = (self._tensor(row) for row in self.state[:3])
        theta.requires_grad_(True)
        look, saved = max(1, self.plan.steps // _LOOKS), time.monotonic()
        try:
            while self.step < self.plan.steps and self.stale < _PATIENCE:
                self._advance(theta, m, v)
                if self.step % look == 0 or self.step == self.plan.steps:
                    self._look(theta)
                    self.progress(self.step, self.plan.steps)
                if time.monotonic() - saved > _EVERY:
                    self._save(theta, m, v)
                    saved = time.monotonic()
        except KeyboardInterrupt:
            self._save(theta, m, v)
            raise
        self._save(theta, m, v)
        return self._layers(self.state[3])

    def _advance(self, theta: Any, m: Any, v: Any) -> None:
        """One step of Adam; its rate falls like a cosine, and its batch depends on nothing but seed and step."""
        done = self.step / self.plan.steps
        rows = self.torch.as_tensor(self.pool.batch(np.random.default_rng([self.plan.seed, self.step])), device=theta.device)
        theta.grad = None
        self._loss(theta, rows, 3.0 + 27.0 * done).backward()
        self.step += 1
        with self.torch.no_grad():
            m.mul_(0.9).add_(theta.grad, alpha=0.1)
            v.mul_(0.999).addcmul_(theta.grad, theta.grad, value=0.001)
            rate = self.plan.rate * (0.5 + 0.5 * np.cos(np.pi * done)) / (1 - 0.9**self.step)
            theta.sub_(m / ((v / (1 - 0.999**self.step)).sqrt() + 1e-8), alpha=rate)

    def _loss(self, theta: Any, rows: Any, sharpness: float) -> Any:
        d = self.signs * (self.t[rows] - self._value(theta, self.z[rows]))
        return ((sharpness * d).logsumexp(dim=1) / sharpness - d.mean(dim=1)).mean(dim=0).sum()

    def _value(self, theta: Any, z: Any) -> Any:
        layers = _pairs(self._split(theta))
        for k, (w, b) in enumerate(layers):
            z = z @ w.T + b
            if k < len(layers) - 1:
                z = _activation(self.torch, self.plan.activation, z)
        return z

    def _split(self, theta: Any) -> list[Any]:
        sizes = [int(np.prod(s)) for s in self.shapes]
        starts = np.cumsum([0, *sizes])
        return [theta[a : a + n].reshape(s) for a, n, s in zip(starts, sizes, self.shapes, strict=False)]

    def _look(self, theta: Any) -> None:
        """The loss of all points, with the largest as it is; the best θ is kept."""
        with self.torch.no_grad():
            d = self.signs * (self.t - self._value(theta, self.z))
            d = d.cpu().numpy().astype(np.float64)
        largest = np.maximum.reduceat(d, self.pool.starts[:-1])
        loss = float((largest.mean(axis=0) - d.mean(axis=0)).sum())
        self.stale = 0 if loss < self.best * (1 - 1e-3) and self.best > _ENOUGH else self.stale + 1
        if loss < self.best:
            self.best, self.state[3] = loss, theta.detach().cpu().numpy()

    def _layers(self, theta: npt.NDArray[np.float32]) -> list[tuple[Array, Array]]:
        parts = [np.asarray(p, dtype=np.float64) for p in self._split(theta)]
        return _pairs(parts)

    def _save(self, theta: Any, m: Any, v: Any) -> None:
        if self.checkpoint is None:
            return
        self.state[:3] = [a.detach().cpu().numpy() for a in (theta, m, v)]
        self.checkpoint.parent.mkdir(parents=True, exist_ok=True)
        partial = self.checkpoint.with_suffix(".tmp.npz")
        np.savez(partial, state=self.state, numbers=np.array([self.step, self.best, self.stale]), key=np.array(self.key))
        partial.replace(self.checkpoint)

    def _resume(self) -> None:
        """From the checkpoint, where there is one of the same plan and points."""
        if self.checkpoint is None or not self.checkpoint.exists():
            return
        with np.load(self.checkpoint, allow_pickle=False) as stored:
            if str(stored["key"]) == self.key:
                self.state, (step, self.best, stale) = stored["state"], stored["numbers"].tolist()
                self.step, self.stale = int(step), int(stale)


def _pairs(parts: Sequence[Any]) -> list[tuple[Any, Any]]:
    return list(zip(parts[::2], parts[1::2], strict=True))


def _activation(torch: Any, name: str, v: Any) -> Any:
    if name == "leaky-relu":
        return torch.maximum(v, 0.01 * v)
    if name == "softplus":
        return torch.nn.functional.softplus(v)
    return {"relu": torch.relu, "tanh": torch.tanh, "sigmoid": torch.sigmoid, "arctan": torch.arctan}[name](v)
