"""Residual fields whose Lipschitz constants are known exactly: what bounds are tested against, and attacked with."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, final

import numpy as np

from gapcert.plugin import (
    AffinePredictor,
    Array,
    Backend,
    Box,
    Cover,
    Domain,
    FitRoute,
    GapProblem,
    Interval,
    LipschitzBound,
    LipschitzProblem,
    Model,
    Predictor,
    Residual,
    Samples,
    StateSpec,
    UsageError,
)


class Field(Model):
    """f̂ with nx states and nu inputs, compared with f = 0, so that it is its own residual to the last bit.

    `constants` (nx, nz): exact suprema of |∂r_i/∂z_j| on `domain`, rounded up; `curvature`: of |∂²r_i/∂z_j²|, where known.
    """

    constants: Array
    curvature: Array | None = None

    def __init__(self, nx: int, nu: int, half_width: float = 1.0) -> None:
        self.states = tuple(StateSpec(f"x{i}") for i in range(nx))
        self.inputs = tuple(StateSpec(f"u{i}") for i in range(nu))
        self.outputs, self.period, self.half_width = self.states, 1.0, half_width

    @property
    def domain(self) -> Domain:
        """The cube of the given half-width."""

        def cube(axes: tuple[StateSpec, ...]) -> Box:
            return Box(axes, (-self.half_width,) * len(axes), (self.half_width,) * len(axes))

        return Domain(cube(self.states), cube(self.inputs))

    def __call__(self, z: Array) -> Array:
        """r(z), (n, nz) → (n, nx), as computed by a step."""
        return self.step(z[:, : self.nx], z[:, self.nx :]).x

    def resolution(self, magnitude: Array) -> Array:
        # Arguments of up to 16 and sums of a few terms of up to `magnitude`, or 1 where these cancel.
        return np.asarray(64 * np.spacing(np.maximum(np.abs(magnitude), 1.0)))

    def jacobian(self, x: Array, u: Array) -> Array:
        return self.jacobian_enclosure(Interval.exact(np.hstack([x, u]))).mid

    @abstractmethod
    def jacobian_enclosure(self, z: Interval) -> Interval: ...

    def equations(self) -> str:
        return f"r = {type(self).__name__}"

    def to_spec(self) -> dict[str, Any]:
        raise UsageError(f"{type(self).__name__}: a field has no spec; use an equations model")


@final
class Nothing(Field):
    """f = 0, with the names of another field."""

    def __init__(self, like: Field) -> None:
        super().__init__(like.nx, like.nu, like.half_width)
        self.states, self.constants = like.states, np.zeros_like(like.constants)

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        return np.zeros_like(x)

    def enclosure(self, z: Interval) -> Interval:
        return Interval.exact(np.zeros((len(z), self.nx)))

    def jacobian_enclosure(self, z: Interval) -> Interval:
        return Interval.exact(np.zeros((len(z), self.nx, z.shape[1])))

    def curvature_enclosure(self, z: Interval, axis: int) -> Interval:
        return self.enclosure(z)

    def resolution(self, magnitude: Array) -> Array:
        return np.zeros(self.nx)


@final
class Waves(Field):
    """r_i = offset_i + Σ_j A_ij sin(W_ij z_j + P_ij): smooth; amplitude A, rate W and phase P have shape (nx, nz).

    constants = |A W| and curvature = |A W²| wherever |W| · 2 half_width ≥ π, since every phase then passes a steepest point and
    one that is bent most (else upper bounds).
    """

    def __init__(self, amplitude: Array, rate: Array, phase: Array, offset: float = 0.0, half_width: float = 1.0) -> None:
        super().__init__(len(amplitude), amplitude.shape[1] - len(amplitude), half_width)
        self.amplitude, self.rate, self.phase, self.offset = amplitude, rate, phase, offset
        self.constants = np.nextafter(np.abs(amplitude * rate), np.inf)
        self.curvature = np.nextafter(self.constants * np.nextafter(np.abs(rate), np.inf), np.inf)

    @classmethod
    def smooth(cls) -> Waves:
        """Two states and one input, curved along every axis."""
        amplitude = np.array([[0.3, 0.1, 0.2], [0.05, 0.4, 0.1]])
        rate = np.array([[2.0, 3.0, 1.7], [2.5, 1.8, 4.0]])
        return cls(amplitude, rate, np.array([[0.3, 1.0, 0.0], [2.0, 0.1, 0.7]]))

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        z = np.hstack([x, u])
        out = np.full((len(z), len(self.amplitude)), self.offset)
        for j in range(z.shape[1]):
            out += self.amplitude[:, j] * np.sin(self.rate[:, j] * z[:, j : j + 1] + self.phase[:, j])
        return out

    def enclosure(self, z: Interval) -> Interval:
        angle = z[:, None, :] * self.rate + self.phase
        return (angle.sin() * self.amplitude).sum(-1) + self.offset

    def jacobian_enclosure(self, z: Interval) -> Interval:
        angle = z[:, None, :] * self.rate + self.phase
        return angle.cos() * self.amplitude * self.rate

    def curvature_enclosure(self, z: Interval, axis: int) -> Interval:
        rate = self.rate[:, axis]
        return (z[:, axis : axis + 1] * rate + self.phase[:, axis]).sin() * -self.amplitude[:, axis] * rate * rate


@final
class Kink(Field):
    """r_i = Σ_j a_ij |z_j − k_j|; constants |a_ij|, reached by every pair of points on one side of the kink."""

    def __init__(self, steepness: Array, kink: Array, half_width: float = 1.0) -> None:
        super().__init__(len(steepness), steepness.shape[1] - len(steepness), half_width)
        self.steepness, self.kink = steepness, kink
        self.constants = np.abs(steepness)

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        distance = np.abs(np.hstack([x, u]) - self.kink)
        return np.asarray((distance[:, None, :] * self.steepness).sum(axis=2))

    def enclosure(self, z: Interval) -> Interval:
        return (abs(z - self.kink)[:, None, :] * self.steepness).sum(-1)

    def jacobian_enclosure(self, z: Interval) -> Interval:
        return (z - self.kink).sign()[:, None, :] * self.steepness


def lattice(domain: Domain, counts: Sequence[int]) -> Array:
    """Grid points from edge to edge of the domain, (Π counts, nz); one point on an axis is its middle."""
    axes = [
        np.linspace(low, high, n) if n > 1 else np.array([(low + high) / 2])
        for low, high, n in zip(domain.low, domain.high, counts, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def gap_problem(
    field: Field,
    counts: Sequence[int],
    *,
    route: FitRoute = "dominate",
    affine: bool = False,
    factor: float = 1.0,
    bent: float = 1.0,
    backend: Backend | None = None,
) -> GapProblem:
    """Samples of a field with `factor` times its true constants, and `bent` times its curvature: a lattice, or on route
    theorem1 a cover of so many cells.
    """
    domain, residual = field.domain, Residual(backend or field, Nothing(field))
    cover = Cover(domain, tuple(counts)) if route == "theorem1" else None
    z = cover.chunk(0, len(cover)) if cover else lattice(domain, counts)
    axes = None if cover else tuple(np.unique(column) for column in z.T)
    samples = Samples(z, residual(z), cover, lattice=axes)
    p = AffinePredictor.fit(samples) if affine else AffinePredictor.none(field.nx, z.shape[1])
    value = factor * np.nextafter(field.constants + np.abs(p.slope), np.inf)
    curvature = None if field.curvature is None else bent * field.curvature
    method = f"{factor:g} × the exact constants"
    bound = LipschitzBound(value, np.zeros_like(value), "analytic", method, factor, curvature=curvature)
    return GapProblem(samples, domain, bound, p, residual.resolution(domain), route)


def lipschitz_problem(
    field: Field, *, predictor: Predictor | None = None, backend: Backend | None = None, seed: int = 0
) -> LipschitzProblem:
    """The field's remainder as an estimator sees it; queries are answered at once."""
    residual = Residual(backend or field, Nothing(field))
    p = predictor or AffinePredictor.none(field.nx, len(field.domain.low))
    e = residual.resolution(field.domain)
    return LipschitzProblem(field.domain, p, e, lambda name, z: residual(z), residual.model, residual.backend, seed)
