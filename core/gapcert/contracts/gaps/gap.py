"""How wrong: gap functions that dominate a residual, and the families that fit them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, final

import numpy as np

from gapcert.contracts.gaps.lipschitz import LipschitzBound, Symmetry
from gapcert.contracts.gaps.predictor import Predictor, Samples
from gapcert.contracts.plugins.events import Emit, silent
from gapcert.contracts.systems.arithmetic import Arithmetic
from gapcert.contracts.systems.domain import Domain
from gapcert.numerics.arrays import Array
from gapcert.numerics.errors import UsageError
from gapcert.numerics.intervals import Interval

FitRoute = Literal["theorem1", "dominate", "declared"]
"""By which routes a family may be fitted."""


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
    """What a family is fitted to. `lipschitz` bounds g = r − p; `resolution` is e (nx,), of which `arithmetics`, of f̂ and f,
    are the part of arithmetic where the rest is the spread over hidden states. `emit` takes the progress of a long fit, and
    `folder` what it may be resumed from.
    """

    samples: Samples
    domain: Domain
    lipschitz: LipschitzBound
    predictor: Predictor
    resolution: Array
    route: str
    seed: int = 0
    symmetry: Symmetry | None = None
    arithmetics: tuple[Arithmetic, Arithmetic] | None = None
    emit: Emit = silent
    folder: Path | None = None

    @property
    def arithmetic(self) -> Array:
        """(nx,): the resolution without the spread over hidden states, against which gaps are judged."""
        return self.resolution if self.arithmetics is None else np.asarray(self.arithmetics[0].e + self.arithmetics[1].e)

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
    `predictor` is what it asks to be subtracted before: `none`, `affine`, a Predictor, what makes one of (Samples, Domain), or
    an extended Model.
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
