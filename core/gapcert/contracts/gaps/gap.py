"""How wrong: samples of the residual, predictors, and gap functions that dominate it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, final

import numpy as np

from gapcert.contracts.plugins.events import Emit, silent
from gapcert.contracts.systems.domain import Box, Cover, Domain
from gapcert.contracts.systems.system import Model, StateSpec, difference
from gapcert.numerics.arrays import Array
from gapcert.numerics.errors import UsageError
from gapcert.numerics.intervals import Interval

if TYPE_CHECKING:
    from gapcert.contracts.gaps.lipschitz import LipschitzBound
    from gapcert.contracts.gaps.symmetry import Symmetry

FitRoute = Literal["theorem1", "dominate", "declared"]
"""By which routes a family may be fitted."""


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
        magnitudes = (model.enclosure(domain.interval).mag[0] for model in (self.extended, self.nominal))
        e = [model.resolution(m) for model, m in zip((self.extended, self.nominal), magnitudes, strict=True)]
        return np.asarray(e[0] + e[1])

    def arrays(self) -> dict[str, Array]:
        return {}


class GapFunction(ABC):
    """γ and the signed interval [l, u] with l(z) ≤ r(z) ≤ u(z); γ_i = max(|l_i|, |u_i|). Points z (n, nz).

    predictor: the known part p of the residual around which the interval lies; None is p = 0.
    """

    family: str
    predictor: Predictor | None = None

    @abstractmethod
    def interval(self, z: Array) -> tuple[Array, Array]:
        """(l, u), each (n, nx); the predictor and every margin included, rounded outwards."""

    @abstractmethod
    def interval_over(self, boxes: Interval) -> Interval:
        """Contains [l(z), u(z)] for all z of each box: (n, nz) → (n, nx)."""

    @abstractmethod
    def arrays(self) -> dict[str, Array]:
        """Everything that determines the function, for the certificate; see `form`."""

    @property
    @abstractmethod
    def form(self) -> Mapping[str, Any]:
        """JSON-able description by which `verify` evaluates it, `{"form": ..., ...}`: a form that it knows."""

    @final
    def gamma(self, z: Array) -> Array:
        """γ(z) (n, nx)."""
        low, high = self.interval(np.atleast_2d(np.asarray(z, dtype=np.float64)))
        return np.asarray(np.maximum(np.abs(low), np.abs(high)))

    def gamma_over(self, boxes: Interval) -> Array:
        """An upper bound of γ over each box, (n, nx)."""
        return np.asarray(self.interval_over(boxes).mag)

    def ends_over(self, boxes: Interval) -> tuple[Interval, Interval]:
        """Contains l, and u, over each box, (n, nx) each; by default both are `interval_over`."""
        both = self.interval_over(boxes)
        return both, both

    @final
    def remainder_over(self, boxes: Interval) -> Interval:
        """Contains [l(z) − p(z), u(z) − p(z)] for all z of each box, p exact or as computed: (n, nz) → (n, nx), outwards.

        p varies over a box, and what is known of it does not count here: over wide boxes this is thin where `interval_over` is
        as wide as the range of p. A controller takes f + p as its nominal model and only this as uncertain.
        """
        if self.predictor is None:
            return self.interval_over(boxes)
        return Interval.hull(*self.remainder_ends_over(boxes))

    def remainder_ends_over(self, boxes: Interval) -> tuple[Interval, Interval]:
        """Contains l − p, and u − p, over each box, (n, nx) each; by default from `ends_over` and the range of p, as wide."""
        low, high = self.ends_over(boxes)
        if self.predictor is None:
            return low, high
        known = self.predictor.over(boxes) + Interval.around(0.0, self.predictor.error_over(boxes))
        return low - known, high - known

    def gamma_of(self, boxes: Interval, i: int) -> Array:
        """Column i of `gamma_over` (n,), where one state is wanted and costs less than all."""
        return np.asarray(self.gamma_over(boxes)[:, i])

    def majorant_over(self, boxes: Interval, cells: int = 4096) -> tuple[Array, Array]:
        """(c, A): γ_i(z) ≤ c_i + Σ_j A_ij |z_j| on each box, c, A ≥ 0 of shapes (n, nx), (n, nx, nz).

        The better, in its mean over the box, of `majorant` from cells in it, and of the slopes of `lipschitz`; at worst it is
        constant. cells: about how many there are, shared by the boxes.
        """
        from gapcert.numerics.majorant import majorants

        return majorants(self.gamma_over, self.lipschitz, boxes, cells)

    @abstractmethod
    def lipschitz(self, boxes: Interval) -> Array:
        """L (n, nx, nz): |γ_i(z) − γ_i(z′)| ≤ Σ_j L_ij |z_j − z′_j| on each box; ∞ along an axis across which γ may jump."""

    def pieces(self, domain: Domain) -> Iterator[tuple[Interval, GapFunction]]:
        """Boxes (1, nz) that tile the domain, each with a function of finite `lipschitz` that equals this one inside."""
        yield domain.interval, self


@final
@dataclass(frozen=True)
class GapProblem:
    """What a family is fitted to. `lipschitz` bounds g = r − p; `resolution` is e (nx,), of which `rounding` (nx,) is the part
    of arithmetic where the rest is the spread over hidden states. `emit` takes the progress of a long
    fit, and `folder` what it may be resumed from.
    """

    samples: Samples
    domain: Domain
    lipschitz: LipschitzBound
    predictor: Predictor
    resolution: Array
    route: str
    seed: int = 0
    rounding: Array | None = None
    symmetry: Symmetry | None = None
    emit: Emit = silent
    folder: Path | None = None

    @property
    def arithmetic(self) -> Array:
        """(nx,): the resolution without the spread over hidden states, against which gaps are judged."""
        return self.resolution if self.rounding is None else self.rounding

    @property
    def spread(self) -> bool:
        """Does e contain a spread over hidden states?"""
        return bool((self.resolution > self.arithmetic).any())

    @property
    def remainder(self) -> Array:
        """g_k = r_k − p(z_k), (n, nx)."""
        return np.asarray(self.samples.r - self.predictor(self.samples.z))

    @property
    def remainder_resolution(self) -> Array:
        """(nx,): bound on |computed g − g|, e of the residual plus that of the predictor."""
        return np.asarray(self.resolution + self.predictor.resolution(self.domain))

    @property
    def margin(self) -> Array:
        """(nx,) data part of the theorem-1 margin: L₂x εx + L₂u εu + 2 e, rounded up; needs a cover, no predictor and no jumps.

        Constants that hold per cell enter with the worst cell's.
        """
        if self.lipschitz.jumps:
            raise UsageError(
                "route theorem1: its margin needs a residual without jumps, and it jumps in "
                f"{int(self.lipschitz.cells.marked.sum() if self.lipschitz.cells else 0)} cells; use route: dominate"
            )
        if self.predictor.kind != "none":
            raise UsageError(
                f"route theorem1: its margin bounds r itself, found predictor: {self.predictor.kind}; set it to none"
            )
        if self.samples.cover is None:
            raise UsageError("route theorem1: the samples are no uniform cover; use `sampling: {kind: grid, ...}`")
        nx = self.domain.nx
        # Along an axis without a constant g does not change, so that its part of the radius does not count.
        ex, eu = self.samples.cover.radii(np.asarray((self.lipschitz.value > 0).any(axis=0)))
        x = Interval.exact(self.lipschitz.joint(slice(None, nx))) * ex
        u = Interval.exact(self.lipschitz.joint(slice(nx, None))) * eu
        return np.asarray((x + u + Interval.exact(self.resolution) * 2.0).hi)


class GapFamily(ABC):
    """Fits a GapFunction (`gap_family` plugins).

    Any subset of the samples is enough on route dominate. `extremes` says that on route theorem1 the extremes of coarse cells
    are enough, too: that γ needs of the samples only max_k |r_ki|. `lattice` says that the samples must be nodes of a lattice.
    `predictor` is what it asks to be subtracted before: a Predictor, an extended Model, or `none`, `affine` or `multilinear`.
    """

    name: str
    routes: tuple[FitRoute, ...]
    predictor: Any = "none"
    extremes: bool = False
    lattice: bool = False

    @abstractmethod
    def fit(self, problem: GapProblem) -> GapFunction:
        """A gap function that certifies under the problem's assumptions, by the problem's route."""

    def stated(self, states: Sequence[str]) -> GapFunction | None:
        """γ as a person declares it for states of these names, without a look at a backend; None where the family fits.

        A family that answers has the route `declared` alone, which looks for no constants: its claim is `assumed`.
        """
        return None
