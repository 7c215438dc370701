"""Gap functions by route theorem1: any network, raised by its own Lipschitz constant times the cover's radius."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, final

import numpy as np

from gapcert.plugin import Array, GapFunction, GapProblem, Interval, Undecided, registry

from .bounds import NetworkCertifier
from .network import Network
from .network_constant import proved_balanced

_EPS = float(np.finfo(np.float64).eps)
_ROWS = 1 << 16
_SPARE = 1e-9  # on each constant: the proof may round otherwise where it is repeated


@final
class NetworkGap(GapFunction):
    """γ_i(z) = max(0, q_i(z) + margin_i), and [−γ, γ]. squares (nx,): ρ_i with |q_i(z) − q_i(z′)| ≤ √ρ_i ‖z − z′‖₂, as the
    multipliers of each state prove; rounding (nx,): bound on the error of the computed q on the domain.
    """

    def __init__(
        self, family: str, q: Network, margin: Array, squares: Array, multipliers: list[tuple[Array, ...]], rounding: Array
    ) -> None:
        self.family, self.q, self.margin, self.squares = family, q, margin, squares
        self.multipliers, self.rounding = multipliers, rounding

    def interval(self, z: Array) -> tuple[Array, Array]:
        q = self.q(z)
        high = np.maximum(q + self.margin + self.rounding + 4 * _EPS * (np.abs(q) + np.abs(self.margin)), 0.0)
        return -high, high

    def interval_over(self, boxes: Interval) -> Interval:
        high = self.ends_over(boxes)[1].hi
        return Interval(-high, high)

    def ends_over(self, boxes: Interval) -> tuple[Interval, Interval]:
        q = self.q.tight_over(boxes)
        # Twice what `interval` adds at a point of the box, for the rounding here.
        pad = 2 * (self.rounding + 4 * _EPS * (q.mag + np.abs(self.margin)))
        high = Interval(np.maximum(q.lo + self.margin - pad, 0.0), np.maximum(q.hi + self.margin + pad, 0.0))
        return -high, high

    def lipschitz(self, boxes: Interval) -> Array:
        slope = np.stack([self.q.gradient_over(boxes, i).mag for i in range(len(self.margin))], axis=1)
        return np.asarray(slope * (1 + 1e-12))

    def arrays(self) -> dict[str, Array]:
        named = {f"q.{k}": v for k, v in self.q.arrays().items()}
        for i, own in enumerate(self.multipliers):
            named |= {f"multipliers{i}.{k}": m for k, m in enumerate(own)}
        return {**named, "margin": self.margin, "squares": self.squares}

    @property
    def form(self) -> Mapping[str, Any]:
        """`q` as `Function.data`, with its kind; the numbers are arrays."""
        return {"form": "network", "q": {"kind": self.q.kind, **self.q.data()}}


def raised(problem: GapProblem, family: str, q: Network) -> NetworkGap:
    """γ = q plus the smallest margin that certifies on route theorem1: L₁ √(εx² + εu²) + L₂x εx + L₂u εu + 2 e, and by what
    the samples exceed q (or less, where they all lie below it). Every L₁ is proved by multipliers of `lipsdp`.
    """
    data, domain, samples = problem.margin, problem.domain, problem.samples
    squares, constants, multipliers = np.empty(domain.nx), np.empty(domain.nx), []
    for i in range(domain.nx):
        squares[i], constants[i], own = _constant(q, i)
        multipliers.append(own)
    assert samples.cover is not None
    ex, eu = (Interval.exact(e) for e in samples.cover.radii(np.asarray(q.weights[0].any(axis=0))))
    rounding = q.rounding(domain.interval)
    short = np.full(domain.nx, -np.inf)
    for a in range(0, len(samples), _ROWS):
        rows = slice(a, a + _ROWS)
        short = np.maximum(short, (np.abs(samples.r[rows]) - q(samples.z[rows])).max(axis=0))
    steep = Interval.exact(constants) * (ex * ex + eu * eu).sqrt()
    # The samples' q is computed, so its error counts once more.
    margin = steep + Interval.exact(data) + Interval.exact(short) + Interval.exact(2 * rounding)
    return NetworkGap(family, q, margin.hi, squares, multipliers, rounding)


def _constant(q: Network, i: int) -> tuple[float, float, tuple[Array, ...]]:
    """(ρ, L, multipliers) of output i."""
    weights = [*q.weights[:-1], q.weights[-1][i : i + 1]]
    certifier: NetworkCertifier = registry().build("lipschitz", "lipsdp")
    one = Network(tuple(weights), (*q.biases[:-1], q.biases[-1][i : i + 1]), q.activation, q.output)
    bound = certifier.bound(one, axes=False)
    square = bound.value**2
    found = proved_balanced(weights, bound.multipliers, square, one.exponent)
    if found is None:
        raise Undecided(
            f"theorem1: no multipliers prove the Lipschitz constant {bound.value:.3g} of output {i} a second time; use a "
            f"smaller network, or route dominate"
        )
    return square, found * (1 + _SPARE), bound.multipliers
