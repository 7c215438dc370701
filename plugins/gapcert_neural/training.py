"""The loop of a training: deterministic by seed, interruptible, resumed from a checkpoint to the same bits."""

from __future__ import annotations

import hashlib
import importlib
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, final
from zipfile import BadZipFile

import numpy as np

import gapcert
from gapcert import Array, UsageError
from gapcert_neural.thresholds import THRESHOLDS

Layers = list[tuple[Array, Array]]
Progress = Callable[[int, int, float], None]
"""Told the steps done, of how many, and the best loss so far."""


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


class Training(ABC):
    """Adam on a flat θ in float32, on one thread: sums are then done in one order, however many cores there are.

    Another processor, a GPU or another version of PyTorch may round otherwise, and then trains another network; the same ones
    train the same to the last bit.

    Each step's batch depends on nothing but seed and step; the rate falls like a cosine. Twenty times in the course of the
    training all points are looked at, and the best θ is kept; five looks in a row without a gain end it.
    """

    shapes: Sequence[tuple[int, ...]]

    def __init__(self, plan: Plan, checkpoint: Path | None, progress: Progress) -> None:
        self.plan, self.checkpoint, self.progress = plan, checkpoint, progress
        self.torch: Any = importlib.import_module("torch")
        self.step, self.best, self.stale = 0, np.inf, 0
        self.extra = np.zeros(0)  # what else a training carries from step to step

    @abstractmethod
    def data(self) -> Sequence[Array]:
        """What the answer depends on beside the plan."""

    @abstractmethod
    def drawn(self) -> Array:
        """The first θ."""

    @abstractmethod
    def loss(self, theta: Any, done: float) -> Any:
        """Of the batch of this step; `done` is the share of the steps."""

    @abstractmethod
    def score(self, theta: Any) -> float:
        """The loss of all points."""

    @abstractmethod
    def layers(self, theta: Array) -> Layers:
        """Weights and biases in float64."""

    @final
    def run(self) -> Layers:
        """The best layers that were found."""
        before = self.torch.get_num_threads()
        self.torch.set_num_threads(1)
        try:
            return self._run()
        finally:
            self.torch.set_num_threads(before)

    def _run(self) -> Layers:
        self.key = self._digest()
        # θ, its Adam moments, and the best θ so far.
        self.state = np.zeros((4, sum(int(np.prod(s)) for s in self.shapes)), dtype=np.float32)
        self.state[0] = self.state[3] = self.drawn()
        self._resume()
        theta, m, v = (self.tensor(row) for row in self.state[:3])
        theta.requires_grad_(True)
        look, saved = max(1, self.plan.steps // THRESHOLDS.training_looks), time.monotonic()
        try:
            while self.step < self.plan.steps and self.stale < self.patience:
                self._advance(theta, m, v)
                if self.step % look == 0 or self.step == self.plan.steps:
                    self._look(theta)
                self.progress(self.step, self.plan.steps, self.best)
                if time.monotonic() - saved > THRESHOLDS.checkpoint_seconds:
                    self._save(theta, m, v)
                    saved = time.monotonic()
        except KeyboardInterrupt:
            self._save(theta, m, v)
            raise
        self._save(theta, m, v)
        return self.layers(np.asarray(self.state[3], dtype=np.float64))

    def tensor(self, a: Any) -> Any:
        """float32, on the device."""
        return self.torch.as_tensor(np.ascontiguousarray(a, dtype=np.float32), device=self.device)

    @property
    def patience(self) -> int:
        """Looks without a gain after which it ends."""
        return THRESHOLDS.patience

    def accepted(self, theta: Any) -> bool:
        """May θ be where a step has led it?"""
        return True

    @cached_property
    def device(self) -> str:
        """`cpu` or `cuda`: whether there is a GPU is asked once, and only where it matters."""
        if self.plan.device == "cpu":
            return "cpu"
        found = "cuda" if self.torch.cuda.is_available() else "cpu"
        if self.plan.device not in ("auto", found):
            raise UsageError(
                f"gap.device: found {self.plan.device}, and PyTorch sees no GPU; expected one, and a PyTorch that is "
                f"built for it; set device: auto or cpu"
            )
        return found

    @property
    def draws(self) -> np.random.Generator:
        """Of this step."""
        return np.random.default_rng([self.plan.seed, self.step])

    def split(self, theta: Any) -> list[Any]:
        """θ in its shapes."""
        sizes = [int(np.prod(s)) for s in self.shapes]
        starts = np.cumsum([0, *sizes])
        return [theta[a : a + n].reshape(s) for a, n, s in zip(starts, sizes, self.shapes, strict=False)]

    def activated(self, v: Any) -> Any:
        name = self.plan.activation
        if name == "leaky-relu":
            return self.torch.maximum(v, 0.01 * v)
        if name == "softplus":
            return self.torch.nn.functional.softplus(v)
        return getattr(self.torch, name)(v)

    def _advance(self, theta: Any, m: Any, v: Any) -> None:
        done = self.step / self.plan.steps
        theta.grad = None
        self.loss(theta, done).backward()
        self.step += 1
        with self.torch.no_grad():
            m.mul_(0.9).add_(theta.grad, alpha=0.1)
            v.mul_(0.999).addcmul_(theta.grad, theta.grad, value=0.001)
            rate = self.plan.rate * (0.5 + 0.5 * np.cos(np.pi * done)) / (1 - 0.9**self.step)
            before = theta.clone()
            theta.sub_(m / ((v / (1 - 0.999**self.step)).sqrt() + 1e-8), alpha=rate)
            for _ in range(THRESHOLDS.step_halvings):
                if self.accepted(theta):
                    return
                theta.copy_((theta + before) / 2)
            theta.copy_(before)

    def _look(self, theta: Any) -> None:
        with self.torch.no_grad():
            loss = self.score(theta)
        self.stale = 0 if loss < self.best * (1 - 1e-3) and self.best > THRESHOLDS.small_loss else self.stale + 1
        if loss < self.best:
            self.best, self.state[3] = loss, theta.detach().cpu().numpy()

    def _digest(self) -> str:
        what = f"{gapcert.__version__} {type(self).__name__} {self.plan!r} {self.shapes} {self.device}"
        h = hashlib.sha256(what.encode())
        for a in self.data():
            h.update(np.ascontiguousarray(a).tobytes())
        return h.hexdigest()

    def _save(self, theta: Any, m: Any, v: Any) -> None:
        if self.checkpoint is None:
            return
        self.state[:3] = [a.detach().cpu().numpy() for a in (theta, m, v)]
        self.checkpoint.parent.mkdir(parents=True, exist_ok=True)
        partial = self.checkpoint.with_suffix(".tmp.npz")
        numbers = np.array([self.step, self.best, self.stale])
        np.savez(partial, state=self.state, numbers=numbers, extra=self.extra, key=np.array(self.key))
        partial.replace(self.checkpoint)

    def _resume(self) -> None:
        """From the checkpoint, where there is one of the same plan and data."""
        if self.checkpoint is None or not self.checkpoint.exists():
            return
        # One that is damaged is begun again.
        with (
            suppress(OSError, ValueError, KeyError, EOFError, BadZipFile),
            np.load(self.checkpoint, allow_pickle=False) as stored,
        ):
            if str(stored["key"]) == self.key:
                state, (step, best, stale), extra = stored["state"], stored["numbers"].tolist(), stored["extra"]
                self.state, self.step, self.best, self.stale, self.extra = state, int(step), best, int(stale), extra
