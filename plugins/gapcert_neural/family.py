"""The family `neural`: two networks with a common trunk, one for each side of the band."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, final

import numpy as np

from gapcert.plugin import Array, GapFamily, GapFunction, GapProblem, Pulse, UsageError
from gapcert_functions import Table, band, dominate
from gapcert_networks import Network, raised
from gapcert_neural.thresholds import THRESHOLDS

from .banded import BandTraining, Pool
from .covered import SHAPES, CertifiedTraining, Covered, CoverTraining, PaperTraining
from .training import Plan, Progress


@final
class Neural(GapFamily):
    """Family `neural`, route dominate: networks l′ and u′ of r − p are trained to follow both sides of the tightest band, on
    the integral of u′ − l′ with the shifts that will be needed; shifts per cell of a table then lift them over it, which is
    proved on the whole domain. With `sides: one` a single network per state is trained above |r − p|, on the integral of γ
    itself, and its negative is the lower side; shifts are each side's own.

    The band is that of the family `multilinear` where samples and constants allow it, else the envelope. It is asked at random
    points, which costs no simulation.

    Route theorem1: one hidden layer per state above |r| at the samples of a cover, whose own Lipschitz constant is paid for.
    `training: certified` minimises the certified mean with the exact constant in it, or, for any number of layers, that of
    networks which cannot exceed their constant (`shape`: lbdn or sll); `paper` is the published recipe, with a fixed
    constant `lipschitz` (per state, or one for all) and the weight `barrier` of its log-determinant. Training draws from
    the problem's seed alone.
    """

    name = "neural"
    routes = ("dominate", "theorem1")

    def __init__(
        self,
        hidden: Sequence[int] = (64,),
        activation: str = "relu",
        steps: int = 2000,
        cells: Sequence[int] | None = None,
        tolerance: float = 0.01,
        boxes: int = 200_000,
        device: str = "auto",
        predictor: Any = "none",
        training: Literal["certified", "paper"] = "certified",
        lipschitz: float | Sequence[float] = 1.0,
        barrier: float = 1e-4,
        shape: Literal["free", "lbdn", "sll"] = "free",
        sides: Literal["two", "one"] = "two",
    ) -> None:
        self.hidden, self.activation, self.steps, self.device = tuple(hidden), activation, steps, device
        self.cells, self.tolerance, self.boxes, self.predictor = cells, tolerance, boxes, predictor
        self.training, self.lipschitz, self.barrier, self.shape, self.sides = training, lipschitz, barrier, shape, sides

    def fit(self, problem: GapProblem) -> GapFunction:
        """Trained, lifted and proved; what was trained is resumed from a checkpoint in the problem's folder."""
        if self.training == "paper" and problem.route != "theorem1":
            raise UsageError("neural: training: paper is for route theorem1; set certificate.route: theorem1, or certified")
        if self.shape != "free" and (problem.route != "theorem1" or self.training == "paper"):
            raise UsageError(f"neural: shape: {self.shape} is for route theorem1 with training: certified; set it to free")
        if self.shape == "sll" and self.activation != "relu":
            raise UsageError(f"neural: shape: sll carries its state on through relu, found activation: {self.activation}")
        plan = Plan(self.hidden, self.activation, self.steps, problem.seed, self.device)
        return self._covered(problem, plan) if problem.route == "theorem1" else self._banded(problem, plan)

    def _banded(self, problem: GapProblem, plan: Plan) -> GapFunction:
        nz, nx = len(problem.domain.low), problem.domain.nx
        counts = tuple(self.cells or (max(1, min(8, int(THRESHOLDS.table_cells ** (1 / nz) + 1e-9))),) * nz)
        units, pool = self._pool(problem, counts)
        layers = units.restored(BandTraining(plan, pool, *_followed(problem)).run())
        upper = self._network(layers, slice(-nx, None))
        if self.sides == "two":
            lower = self._network(layers, slice(nx))
        else:
            lower = Network((*upper.weights[:-1], -upper.weights[-1]), (*upper.biases[:-1], -upper.biases[-1]), self.activation)
        return dominate(problem, self.name, lower, upper, counts, self.tolerance, self.boxes)

    def _covered(self, problem: GapProblem, plan: Plan) -> GapFunction:
        domain, samples = problem.domain, problem.samples
        if samples.cover is None:
            raise UsageError("neural: the samples are no uniform cover; use `sampling: {kind: grid, ...}`, or route dominate")
        size = np.abs(samples.r)
        unit = np.asarray(np.maximum(size.mean(axis=0), np.finfo(float).tiny))
        active = np.asarray((problem.lipschitz.value > 0).any(axis=0))
        zero = np.zeros(domain.nx)
        units = _Units((domain.low + domain.high) / 2, (domain.high - domain.low) / 2, zero, unit)
        radius = float(np.hypot(*samples.cover.radii(active)))
        points = Covered(units.inputs(samples.z), size / unit, units.half, radius, active.astype(np.float64))
        trained: CoverTraining
        if self.shape != "free":
            trained = SHAPES[self.shape](plan, points, *_followed(problem))
        elif self.training == "certified":
            trained = CertifiedTraining(plan, points, *_followed(problem))
        else:
            given = np.asarray(self.lipschitz, dtype=np.float64)
            if given.shape not in ((), (domain.nx,)):
                raise UsageError(
                    f"gap.lipschitz: found {given.tolist()}; expected one number, or one for each of {domain.nx} states"
                )
            given = np.broadcast_to(given, (domain.nx,))
            trained = PaperTraining(plan, points, *_followed(problem), given / unit, self.barrier)
        weights, biases = zip(*units.restored(trained.run()), strict=True)
        return raised(problem, self.name, Network(tuple(weights), tuple(biases), self.activation, "relu"))

    def _network(self, layers: list[tuple[Array, Array]], rows: slice) -> Network:
        *hidden, (w, b) = layers
        weights = (*(v for v, _ in hidden), w[rows])
        return Network(weights, (*(v for _, v in hidden), b[rows]), self.activation)

    def _pool(self, problem: GapProblem, counts: Sequence[int]) -> tuple[_Units, Pool]:
        domain, nx = problem.domain, problem.domain.nx
        table = Table.uniform(domain.low.tolist(), domain.high.tolist(), counts)
        n = int(np.clip(THRESHOLDS.asked_per_cell * len(table), 4096, THRESHOLDS.asked_points))
        z = domain.draw(n, np.random.default_rng([problem.seed, 0x9001]))
        low, high = band(problem).interval(z)
        p = problem.predictor(z)
        two = self.sides == "two"
        targets = np.hstack([low - p, high - p]) if two else np.maximum(high - p, p - low)
        units = _Units.of(domain.low, domain.high, targets, nx)
        signs = np.repeat([-1.0, 1.0], nx) if two else np.ones(nx)
        return units, Pool.sorted(units.inputs(z), units.outputs(targets), signs, table.locate(z))


def _followed(problem: GapProblem) -> tuple[Path | None, Progress]:
    """Where a training leaves its checkpoints, and whom it tells how far it is."""

    pulse = Pulse(problem.emit, "training", unit="steps")

    def progress(done: int, total: int, best: float) -> None:
        pulse(done, {"loss": best} if 0 <= best < np.inf else None, total=total)

    return (None if problem.folder is None else problem.folder / "training.npz"), progress


@final
@dataclass(frozen=True)
class _Units:
    """Inputs are trained in units of the domain's half-widths about its middle, outputs in those of their spread."""

    middle: Array
    half: Array
    mean: Array
    spread: Array

    @classmethod
    def of(cls, low: Array, high: Array, targets: Array, nx: int) -> _Units:
        spread = targets.std(axis=0).reshape(-1, nx)
        # Both sides of a state share a unit, so that a loss weighs what they cost alike.
        joint = np.tile(spread.max(axis=0), len(spread))
        return cls((low + high) / 2, (high - low) / 2, targets.mean(axis=0), np.where(joint > 0, joint, 1.0))

    def inputs(self, z: Array) -> Array:
        return np.asarray((z - self.middle) / self.half)

    def outputs(self, t: Array) -> Array:
        return np.asarray((t - self.mean) / self.spread)

    def restored(self, layers: list[tuple[Array, Array]]) -> list[tuple[Array, Array]]:
        """The same network in the problem's units. Rounding here changes the network, which is proved as it is."""
        (w, b), *rest = layers
        out = [(w / self.half, b - (w / self.half) @ self.middle), *rest]
        w, b = out[-1]
        out[-1] = (w * self.spread[:, None], b * self.spread + self.mean)
        return out
