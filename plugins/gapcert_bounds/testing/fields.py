"""Residual fields whose Lipschitz constants are known exactly: what bounds are tested against, and attacked with."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
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
class Bump(Field):
    """Waves plus height · max(0, 1 − Σ_j |z_j − centre_j| / radius) in every state: narrow, so that few pairs meet it.

    constants: those of the waves plus height / radius, at most; exact where the waves are flat.
    """

    def __init__(self, waves: Waves, height: float, radius: float, centre: Array) -> None:
        super().__init__(waves.nx, waves.nu, waves.half_width)
        self.waves, self.height, self.radius, self.centre = waves, height, radius, centre
        self.constants = np.nextafter(waves.constants + np.nextafter(abs(height) / radius, np.inf), np.inf)

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        z = np.hstack([x, u])
        hat = np.maximum(0.0, 1 - np.abs(z - self.centre).sum(axis=1) / self.radius)
        return np.asarray(self.waves(z) + self.height * hat[:, None])

    def enclosure(self, z: Interval) -> Interval:
        hat = (1.0 - abs(z - self.centre).sum(-1) / self.radius).maximum(0.0)
        return self.waves.enclosure(z) + hat[:, None] * self.height

    def jacobian_enclosure(self, z: Interval) -> Interval:
        near = abs(z - self.centre).sum(-1).lo <= self.radius
        side = (z - self.centre).sign() * (-self.height / self.radius)
        low, high = np.minimum(side.lo, 0.0), np.maximum(side.hi, 0.0)
        slope = Interval(np.where(near[:, None], low, 0.0), np.where(near[:, None], high, 0.0))
        return self.waves.jacobian_enclosure(z) + slope[:, None, :]


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


@final
class Coarse(Backend):
    """A field whose answers are rounded to multiples of `quantum`, as coarse arithmetic would: resolution quantum / 2."""

    def __init__(self, field: Field, quantum: float) -> None:
        self.states, self.inputs, self.period = field.states, field.inputs, field.period
        self.field, self.quantum = field, quantum

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        return np.asarray(np.round(self.field.step(x, u).x / self.quantum) * self.quantum)

    def resolution(self, magnitude: Array) -> Array:
        return np.asarray(self.quantum / 2 + self.field.resolution(magnitude))


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


def bounce(z: Array) -> Array:
    """A step that would end below the floor turns velocity round: a jump across a plane that is tilted to all axes."""
    speed = z[:, 1] + 0.3 * (0.3 * z[:, 2] - 1)
    height = z[:, 0] + 1 + 0.3 * speed
    turned = np.where(height < 0, -0.8, 1.0)
    return np.stack([turned * height - z[:, 0] - 1 - 0.3 * z[:, 1], turned * speed - z[:, 1]], axis=1)


def slide(z: Array) -> Array:
    """Coulomb friction by the sign of the velocity at the start of a step: a jump across the plane of no velocity."""
    change = 0.1 * (2 * z[:, 2] - np.sign(z[:, 1]))
    return np.stack([0.1 * change, change], axis=1)


def stick(z: Array) -> Array:
    """Coulomb friction that stops what it can stop within a step: kinks, and no jump."""
    free = z[:, 1] + 0.2 * z[:, 2]
    change = np.sign(free) * np.maximum(np.abs(free) - 0.1, 0.0) - z[:, 1]
    return np.stack([0.1 * change, change], axis=1)


def stop(z: Array) -> Array:
    """A wall that ends within the domain, and a steep slope that is none."""
    return np.stack([np.where((z[:, 0] > 0.5) & (z[:, 1] > 0.6), 1.0, 0.1 * z[:, 1]), np.tanh(20 * z[:, 2])], axis=1)


@final
class Contact(Field):
    """r(z) = law(z) on [−1, 1]³, two states and one input; a black box, and no constants bound it where it jumps."""

    def __init__(self, law: Callable[[Array], Array]) -> None:
        super().__init__(2, 1)
        self.law, self.constants = law, np.full((2, 3), np.inf)

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        return self.law(np.hstack([x, u]))

    def enclosure(self, z: Interval) -> Interval:
        raise UsageError("Contact: a black box; it has no enclosures")

    def jacobian_enclosure(self, z: Interval) -> Interval:
        raise UsageError("Contact: a black box; it has no enclosures")
