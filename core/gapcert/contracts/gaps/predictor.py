"""Samples of a residual, and what is known of it: functions that are subtracted before anything is bounded."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert.contracts.systems.arithmetic import Arithmetic
from gapcert.contracts.systems.domain import Box, Cover, Domain
from gapcert.contracts.systems.system import Model, StateSpec, difference
from gapcert.numerics.arrays import Array
from gapcert.numerics.intervals import Interval


@final
@dataclass(frozen=True)
class Samples:
    """Residuals r (n, nx) at points z (n, nz). `cover` is set where the points are a uniform grid whose radius is exact.

    `taken` counts the transitions behind them where only some were kept: of each coarse cell those with the smallest and the
    largest r_i, so that max_k |r_ki| is that of all, and the cover's radius still holds for it. `lattice`: nodes of each axis
    whose product, in C order, the last of the points are.
    """

    z: Array
    r: Array
    cover: Cover | None = None
    taken: int | None = None
    lattice: tuple[Array, ...] | None = None

    def __len__(self) -> int:
        return len(self.z)

    @property
    def total(self) -> int:
        """Transitions taken, kept or not."""
        return len(self.z) if self.taken is None else self.taken


class Predictor(ABC):
    """A known function p of z that is subtracted before anything is bounded: g = r − p."""

    kind: str

    @abstractmethod
    def __call__(self, z: Array) -> Array:
        """p(z), (n, nz) → (n, nx)."""

    @abstractmethod
    def over(self, boxes: Interval) -> Interval:
        """Contains p over each box: (n, nz) → (n, nx), rounded outwards."""

    @abstractmethod
    def jacobian_over(self, boxes: Interval) -> Interval:
        """Contains ∂p_i/∂z_j over each box: (n, nz) → (n, nx, nz), rounded outwards."""

    def curvature_over(self, boxes: Interval, axis: int) -> Interval:
        """Contains ∂²p_i/∂z_axis² over each box: (n, nz) → (n, nx), rounded outwards; [−∞, ∞] where a slope may jump, or by
        default."""
        unknown = np.full(self.over(boxes).shape, np.inf)
        return Interval(-unknown, unknown)

    @abstractmethod
    def resolution(self, domain: Domain) -> Array:
        """(nx,): bound on |computed p − p| over Z."""

    @final
    def error_over(self, boxes: Interval) -> Array:
        """(nx,): bound on |computed p − p| over all of the boxes."""
        low, high = np.nextafter(boxes.lo.min(axis=0), -np.inf), np.nextafter(boxes.hi.max(axis=0), np.inf)
        axes = tuple(StateSpec(f"z{j}") for j in range(len(low)))
        return self.resolution(Domain(Box(axes, tuple(low.tolist()), tuple(high.tolist())), Box((), (), ())))

    @abstractmethod
    def arrays(self) -> dict[str, Array]:
        """What a certificate stores of it."""


@final
@dataclass(frozen=True)
class AffinePredictor(Predictor):
    """p_i(z) = offset_i + Σ_j slope_ij z_j. offset (nx,), slope (nx, nz); zeros are the predictor `none`."""

    offset: Array
    slope: Array
    kind: str = "affine"

    @classmethod
    def none(cls, nx: int, nz: int) -> AffinePredictor:
        return cls(np.zeros(nx), np.zeros((nx, nz)), "none")

    @classmethod
    def fit(cls, samples: Samples) -> AffinePredictor:
        """Least squares on the samples; 0 along axes on which they do not differ."""
        slope = np.zeros((samples.r.shape[1], samples.z.shape[1]))
        varied = np.ptp(samples.z, axis=0) > 0
        design = np.column_stack([np.ones(len(samples)), samples.z[:, varied]])
        coefficients = np.linalg.lstsq(design, samples.r, rcond=None)[0]
        slope[:, varied] = coefficients[1:].T
        return cls(np.ascontiguousarray(coefficients[0]), slope)

    def __call__(self, z: Array) -> Array:
        # Summed axis by axis: BLAS may order a row's sum differently in batches of different size, and p must be pure.
        out = np.broadcast_to(self.offset, (len(z), len(self.offset))).copy()
        for j in range(z.shape[1]):
            out += z[:, j : j + 1] * self.slope[:, j]
        return out

    def over(self, boxes: Interval) -> Interval:
        total = Interval.exact(np.broadcast_to(self.offset, (len(boxes.lo), len(self.offset))))
        for j in range(boxes.lo.shape[1]):
            total = total + boxes[:, j : j + 1] * Interval.exact(self.slope[:, j])
        return total

    def jacobian_over(self, boxes: Interval) -> Interval:
        return Interval.exact(np.broadcast_to(self.slope, (len(boxes.lo), *self.slope.shape)))

    def curvature_over(self, boxes: Interval, axis: int) -> Interval:
        return Interval.exact(np.zeros((len(boxes), len(self.offset))))

    def resolution(self, domain: Domain) -> Array:
        # n products and n sums of terms t_j err by at most n eps (|offset| + Σ |t_j|), rounding of the bound included.
        terms = np.abs(self.slope) @ np.maximum(np.abs(domain.low), np.abs(domain.high))
        return np.asarray((self.slope.shape[1] + 1) * np.finfo(float).eps * (np.abs(self.offset) + terms))

    def arrays(self) -> dict[str, Array]:
        return {"offset": self.offset, "slope": self.slope}


@final
@dataclass(frozen=True)
class ModelPredictor(Predictor):
    """p(z) = f_extended(z) − f(z): an extended model explains the residual, what is left gets bounded."""

    extended: Model
    nominal: Model
    kind: str = "model"

    def __call__(self, z: Array) -> Array:
        x, u = z[:, : self.nominal.nx], z[:, self.nominal.nx :]
        return difference(self.nominal.states, self.extended.step(x, u).x, self.nominal.step(x, u).x)

    def over(self, boxes: Interval) -> Interval:
        # Mean value form p(c) + p′(box)(z − c): the difference of two ranges alone is as wide as f itself, not as p.
        centre = Interval.exact(boxes.mid)
        moved = (self.jacobian_over(boxes) * (boxes - centre)[:, None, :]).sum(-1)
        return (self._range(centre) + moved).intersect(self._range(boxes))

    def _range(self, boxes: Interval) -> Interval:
        return self.extended.enclosure(boxes) - self.nominal.enclosure(boxes)

    def jacobian_over(self, boxes: Interval) -> Interval:
        return self.extended.jacobian_enclosure(boxes) - self.nominal.jacobian_enclosure(boxes)

    def curvature_over(self, boxes: Interval, axis: int) -> Interval:
        return self.extended.curvature_enclosure(boxes, axis) - self.nominal.curvature_enclosure(boxes, axis)

    def resolution(self, domain: Domain) -> Array:
        return np.asarray(Arithmetic.of(self.extended, domain).e + Arithmetic.of(self.nominal, domain).e)

    def arrays(self) -> dict[str, Array]:
        return {}
