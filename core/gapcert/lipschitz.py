"""How fast a residual can change: bounds with a provenance, and what makes them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, final

import numpy as np

from gapcert.domain import Domain
from gapcert.errors import UsageError
from gapcert.gap import Predictor
from gapcert.intervals import Interval
from gapcert.system import Array, Backend, Model, System, difference

Provenance = Literal["analytic", "interval", "declared", "estimated"]


@final
@dataclass(frozen=True)
class Residual:
    """r(z) = f̂(z) − f(z), state by state, in the geometry of each state (angles on the circle).

    Calling it with z (n, nx + nu) returns r (n, nx).
    """

    backend: System
    model: Model

    def __call__(self, z: Array) -> Array:
        nx = self.model.nx
        x, u = z[:, :nx], z[:, nx:]
        return difference(self.model.states, self.backend.step(x, u).x, self.model.step(x, u).x)

    def resolution(self, domain: Domain) -> Array:
        """e (nx,): bound on |computed r − r|, from both arithmetics at the largest |x⁺| of each on Z's corners and centre."""
        corners = np.stack(np.meshgrid(*zip(domain.low, (domain.low + domain.high) / 2, domain.high, strict=True)), axis=-1)
        z = corners.reshape(-1, len(domain.low))
        x, u = domain.split(z)
        each = (s.resolution(np.abs(s.step(x, u).x).max(axis=0)) for s in (self.backend, self.model))
        return np.asarray(sum(each))


@final
@dataclass(frozen=True)
class LipschitzBound:
    """|g_i(z) − g_i(z′)| ≤ Σ_j value_ij |z_j − z′_j| + 2 e_i for all z, z′ in Z, per state i and axis j; g = r − p.

    value, lower: (nx, nz); `lower` is a proved lower bound on the true constant (a slope that was seen). `safety` is the factor
    already contained in `value`. `samples` counts simulator transitions spent. An `estimated` value is no bound by itself:
    it makes a claim empirical unless an audit upgrades it.
    """

    value: Array
    lower: Array
    provenance: Provenance
    method: str
    safety: float = 1.0
    samples: int = 0
    target: Literal["residual", "network", "expression"] = "residual"
    scope: Literal["global", "cell"] = "global"
    diagnostics: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.value).all() and (self.value >= 0).all()):
            raise UsageError(f"lipschitz {self.method}: {self.value.tolist()} holds a negative or non-finite constant")

    def joint(self, columns: slice) -> Array:
        """(nx,) Euclidean constant over a block of axes: |Δg_i| ≤ ‖L_i,block‖₂ ‖Δz_block‖₂ (Cauchy–Schwarz), rounded up."""
        v = Interval.exact(self.value[:, columns])
        square = (v * v).hi
        total = np.zeros(len(square))
        for j in range(square.shape[1]):
            total = np.nextafter(total + square[:, j], np.inf)
        return np.asarray(np.nextafter(np.sqrt(total), np.inf))


@final
@dataclass(frozen=True)
class LipschitzProblem:
    """What an estimator may use: the residual, the predictor to subtract, the domain, and a recorder of simulator queries.

    `query(name, z)` returns r at points z (n, nz); the answers are stored in the run folder under `name`, so that a resumed run
    asks again for nothing. `white_box` is f̂ as a Model where it is one.
    """

    domain: Domain
    predictor: Predictor
    resolution: Array
    query: Callable[[str, Array], Array]
    model: Model
    backend: Backend | Model | System
    seed: int = 0

    @property
    def white_box(self) -> Model | None:
        return self.backend if isinstance(self.backend, Model) else None

    def remainder(self, name: str, z: Array) -> Array:
        """g(z) = r(z) − p(z), shape (n, nx)."""
        return self.query(name, z) - self.predictor(z)


class LipschitzEstimator(ABC):
    """Makes a LipschitzBound of the remainder r − p on the domain (`lipschitz` plugins)."""

    provenance: Provenance

    @abstractmethod
    def bound(self, problem: LipschitzProblem) -> LipschitzBound:
        """Per state and per axis; any safety factor included and stated."""
