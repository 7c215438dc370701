"""How fast a residual can change: bounds with a provenance, what makes them, and axes along which it does not change at all."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, final

import numpy as np

from gapcert.contracts.gaps.predictor import Predictor
from gapcert.contracts.systems.arithmetic import Arithmetic
from gapcert.contracts.systems.cells import Cells
from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.system import Backend, Model, StateSpec, System, difference
from gapcert.contracts.thresholds import THRESHOLDS
from gapcert.numerics.arrays import Array
from gapcert.numerics.errors import UsageError
from gapcert.numerics.interpolation import worst
from gapcert.numerics.intervals import norm

Provenance = Literal["analytic", "interval", "declared", "estimated"]


@final
@dataclass(frozen=True)
class Residual:
    """r(z) = f̂(z) − f(z), (n, nx) of z (n, nx + nu), state by state, in the geometry of each state (angles on the circle)."""

    backend: System
    model: Model

    def __call__(self, z: Array) -> Array:
        nx = self.model.nx
        x, u = np.ascontiguousarray(z[:, :nx]), np.ascontiguousarray(z[:, nx:])  # once, and not for each system again
        return difference(self.model.states, self.backend.step(x, u).x, self.model.step(x, u).x)

    def resolution(self, domain: Domain) -> Array:
        """e (nx,): bound on |computed r − r| over Z, from both arithmetics."""
        return np.asarray(sum(a.e for a in self.arithmetic(domain)))

    def arithmetic(self, domain: Domain, jitter: Array | None = None) -> tuple[Arithmetic, Arithmetic]:
        """Those of f̂, covering its jitter (nx,) where that is known, and of f on Z."""
        return Arithmetic.of(self.backend, domain).covering(jitter), Arithmetic.of(self.model, domain)


@final
@dataclass(frozen=True)
class LipschitzBound:
    """|g_i(z) − g_i(z′)| ≤ Σ_j value_ij |z_j − z′_j| + 2 e_i for all z, z′ in Z, per state i and axis j; g = r − p.

    value, lower: (nx, nz); `lower` is a proved lower bound on the true constant (a slope that was seen). `safety` is the factor
    already contained in `value`. `samples` counts simulator transitions spent. An `estimated` value is no bound by itself:
    it makes a claim empirical unless an audit upgrades it. With `cells` the inequality is the one of `Cells`, in each closed
    cell apart, and `value` holds the largest constants of all cells: it bounds g across cells only where nothing jumps.
    `steep` (nx, k, 2, nz): per state, close pairs with the steepest slopes that were seen. `curvature` (nx, nz), of the same
    provenance: |∂²g_i/∂z_j²| ≤ curvature_ij on Z, or ∞ where none is known (at a kink, say).
    `slabs`: per axis None, or (cuts, H (nx, m)): |∂²g_i/∂z_j²| ≤ H_ik where z_j is between cuts k, k + 1.
    """

    value: Array
    lower: Array
    provenance: Provenance
    method: str
    safety: float = 1.0
    samples: int = 0
    target: Literal["residual", "network", "expression"] = "residual"
    cells: Cells | None = None
    steep: Array | None = None
    curvature: Array | None = None
    slabs: tuple[tuple[Array, Array] | None, ...] | None = None
    diagnostics: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.value).all() and (self.value >= 0).all()):
            raise UsageError(f"lipschitz {self.method}: {self.value.tolist()} holds a negative or non-finite constant")
        if (h := self.curvature) is not None and not (h.shape == self.value.shape and (h >= 0).all()):
            raise UsageError(f"lipschitz {self.method}: {h.tolist()} is no curvature; give numbers ≥ 0 per state and axis")

    def bend(self, j: int, nodes: Array) -> Array:
        """(nx, cells): bounds of |∂²g_i/∂z_j²| between neighbouring nodes of axis j; ∞ where nothing is known."""
        unknown = np.full(self.value.shape, np.inf)
        whole = (unknown if self.curvature is None else self.curvature)[:, j : j + 1]
        slab = None if self.slabs is None else self.slabs[j]
        return np.repeat(whole, max(0, len(nodes) - 1), axis=1) if slab is None else worst(nodes, *slab)

    @property
    def scope(self) -> Literal["global", "cell"]:
        return "global" if self.cells is None else "cell"

    @property
    def jumps(self) -> bool:
        """Is there a cell in which something jumps?"""
        return self.cells is not None and bool(self.cells.marked.any())

    def largest_jumps(self, axes: Sequence[StateSpec]) -> list[dict[str, Any]]:
        """[{"state", "where": {axis: value}, "size"}]: for each state that jumps, the largest jump that was measured."""
        names = [a.name for a in axes]
        return [
            {"state": names[j["state"]], "where": dict(zip(names, j["where"], strict=True)), "size": j["size"]}
            for j in self.diagnostics.get("jumps", ())
        ]

    def summary(self, axes: Sequence[StateSpec]) -> dict[str, Any]:
        """Where the constants come from, and, where they hold per cell, how many cells there are and what jumps."""
        out: dict[str, Any] = {"method": self.method, "provenance": self.provenance, "safety": self.safety}
        if self.cells is not None:
            marked = self.cells.marked
            out |= {"cells": len(self.cells), "marked": int(marked.sum())}
            out |= {"marked_share": float(self.cells.volume[marked].sum()), "jumps": self.largest_jumps(axes)}
        return out

    def joint(self, columns: slice) -> Array:
        """(nx,) Euclidean constant over a block of axes: |Δg_i| ≤ ‖L_i,block‖₂ ‖Δz_block‖₂ (Cauchy–Schwarz), rounded up."""
        return norm(self.value[:, columns])


@final
@dataclass(frozen=True)
class LipschitzProblem:
    """What an estimator may use: the residual, the predictor to subtract, the domain, and a recorder of simulator queries.

    `query(name, z)` returns r at points z (n, nz); the answers are stored in the run folder under `name`, so that a resumed run
    asks again for nothing. `white_box` is f̂ as a Model where it is one. Where hidden state is drawn, `resolution` contains the
    spread of the draws; `paired(name, both)` (nx columns) then answers r(end) − r(start) under one hidden state for pairs
    (n, 2 nz), within the `rounding` of arithmetic. Along the axes `held` (by number) r does not change: their constants are not
    asked for.
    """

    domain: Domain
    predictor: Predictor
    resolution: Array
    query: Callable[[str, Array], Array]
    model: Model
    backend: Backend | Model | System
    seed: int = 0
    paired: Callable[[str, Array], Array] | None = None
    rounding: Array | None = None
    held: tuple[int, ...] = ()

    @property
    def white_box(self) -> Model | None:
        return self.backend if isinstance(self.backend, Model) else None

    def remainder(self, name: str, z: Array) -> Array:
        """g(z) = r(z) − p(z), shape (n, nx)."""
        return self.query(name, z) - self.predictor(z)

    def change(self, name: str, start: Array, end: Array) -> tuple[Array, Array]:
        """(g(end) − g(start), its resolution (nx,)) of pairs (n, nz): what slopes are made of."""
        if self.paired is None:
            g = self.remainder(name, np.concatenate([start, end]))
            moved = g[len(start) :] - g[: len(start)]
        else:
            moved = self.paired(name, np.hstack([start, end])) - (self.predictor(end) - self.predictor(start))
        return moved, self.change_resolution

    @property
    def change_resolution(self) -> Array:
        """(nx,) that of `change`."""
        e = self.resolution if self.rounding is None else self.rounding
        return np.asarray(e + self.predictor.resolution(self.domain))


class LipschitzEstimator(ABC):
    """Makes a LipschitzBound of the remainder r − p on the domain (`lipschitz` plugins)."""

    provenance: Provenance

    @abstractmethod
    def bound(self, problem: LipschitzProblem) -> LipschitzBound:
        """Per state and per axis; any safety factor included and stated."""


@final
@dataclass(frozen=True)
class Symmetry:
    """r(z) = r(z′) for all z, z′ in Z that differ along `axes` (by number) alone: declared, and checked on `pairs` pairs.

    deviation (nx): the largest |r_i(z) − r_i(z′)| that was seen, at most 4 e. proved: by the equations of both systems.
    """

    names: tuple[str, ...]
    axes: tuple[int, ...]
    pairs: int
    deviation: tuple[float, ...]
    proved: bool = False

    @classmethod
    def checked(cls, names: Sequence[str], problem: LipschitzProblem, pairs: int = THRESHOLDS.symmetry_pairs) -> Symmetry:
        """The symmetry under shifts along named axes; UsageError with the worst pair where r changes by more than 4 e.

        Points are drawn from Z, their partners differ along the axes, uniformly. Each computed residual errs by at most e, and
        r itself may change by 2 e, as between any two samples.
        """
        domain, axes = problem.domain, _numbers(names, problem.domain)
        rng = np.random.default_rng([problem.seed, 0x5E77])
        start = domain.draw(pairs, rng)
        end = start.copy()
        end[:, axes] = (domain.low + domain.width * rng.random(start.shape))[:, axes]
        change, e = problem.change("symmetry", start, end)
        deviation = np.abs(change)
        over = deviation / (4 * e)
        if (over > 1).any():
            k, i = np.unravel_index(int(np.argmax(over)), over.shape)
            raise UsageError(
                f"symmetries.translation: the residual of {domain.axes[i].name} changes by {deviation[k, i]:.3g} from (x, u) = "
                f"{start[k].tolist()} to {end[k].tolist()}, which differ along {', '.join(names)} alone, and in "
                f"{int((over > 1).any(axis=1).sum())} of {pairs} pairs by more than the resolution allows "
                f"(4 e = {4 * e[i]:.3g}); leave out the symmetry, or mend the system"
            )
        return cls(tuple(names), tuple(axes), pairs, tuple(deviation.max(axis=0).tolist()))

    def applied(self, bound: LipschitzBound, predictor: Predictor, domain: Domain) -> LipschitzBound:
        """The constants of g = r − p with those along the axes set to what p alone changes, which is mostly nothing."""
        axes, slope = list(self.axes), predictor.jacobian_over(domain.interval).mag[0]
        value, lower, cells = bound.value.copy(), bound.lower.copy(), bound.cells
        slabs = None if bound.slabs is None else tuple(None if j in axes else s for j, s in enumerate(bound.slabs))
        value[:, axes], lower[:, axes] = slope[:, axes], 0.0
        if cells is not None:
            constants = cells.constants.copy()
            constants[:, :, axes] = slope[:, axes]
            cells = replace(cells, constants=constants)
        if (curvature := bound.curvature) is not None:
            curvature = curvature.copy()
            curvature[:, axes] = np.where(slope[:, axes] > 0, np.inf, 0.0)
        return replace(bound, value=value, lower=lower, cells=cells, curvature=curvature, slabs=slabs)

    def sentence(self) -> str:
        """What a certificate assumes because of it."""
        what = f"{' and '.join(self.names)} {'are' if len(self.names) > 1 else 'is'} shifted"
        proof = "interval arithmetic proves it from the equations of both systems" if self.proved else "nothing proves it"
        return (
            f"The residual does not change when {what}: declared by the user, and checked on {self.pairs} pairs of points of "
            f"Z, which differed by up to {max(self.deviation):.3g}; {proof}; the audit does not use it."
        )

    @property
    def exception(self) -> str:
        """What is no proof in a sentence that calls constants proved: those that the declaration has replaced."""
        return "" if self.proved else f", but for those along {' and '.join(self.names)}, which rest on the declared symmetry"

    def to_data(self) -> dict[str, Any]:
        """JSON-able."""
        return {"axes": list(self.axes), "names": list(self.names), "pairs": self.pairs, "deviation": list(self.deviation)} | (
            {"proved": True} if self.proved else {}
        )


def _numbers(names: Sequence[str], domain: Domain) -> list[int]:
    known = [a.name for a in domain.axes]
    for name in names:
        if name not in known:
            raise UsageError(f"symmetries.translation: '{name}' is no state or input; there are {', '.join(known)}")
        # Along an axis that relations involve, a shift may leave Z, where nothing is known of r.
        for relation in domain.relations:
            if relation.coefficients[known.index(name)]:
                raise UsageError(
                    f"symmetries.translation: '{name}' stands in the relation '{relation.text}', so that Z is not the same for "
                    f"all its values; leave it out of one of them"
                )
    return [known.index(name) for name in names]
