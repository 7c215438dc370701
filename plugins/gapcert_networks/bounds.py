"""Proved bounds on how fast networks change, and what makes such bounds."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert.plugin import Array, UsageError
from gapcert_networks.thresholds import THRESHOLDS

from .network import Network
from .network_constant import balanced, proved, shifted, trimmed


@final
@dataclass(frozen=True)
class NetworkBound:
    """‖y(x) − y(x′)‖₂ ≤ value·√(Σ_k units_k²(x_k − x′_k)²) for all x, x′, of the network in real arithmetic.

    value is proved and rounded up. lower is the value of the dual problem at the solver's last point, in floating point: no
    diagonal multipliers prove less than it, but the network itself may change more slowly (0 where only spectral norms were
    multiplied). axes (n_in,): ‖y(x) − y(x′)‖₂ ≤ axes_k |x_k − x′_k| where only input k differs (inf: not wanted).
    multipliers (h_i,) of each hidden layer are those of the proof (0 for neurons without effect; 0 or inf too where floats hold
    none). method: the certifier's name; `spectral`, where multipliers proved nothing, for the product of the scaled layers'
    spectral norms; or `constant`.
    """

    value: float
    lower: float
    multipliers: tuple[Array, ...]
    units: Array
    axes: Array
    method: str

    @property
    def gap(self) -> float:
        """value/lower − 1."""
        if self.lower > 0:
            return self.value / self.lower - 1
        return 0.0 if self.value == 0 else math.inf


@final
@dataclass(frozen=True)
class Proposal:
    """Multipliers (h_i,) of every hidden layer, and the ρ = L² that they are thought to prove."""

    multipliers: tuple[Array, ...]
    square: float


class NetworkCertifier(ABC):
    """Bounds a Network (`lipschitz` plugins for networks). A plugin proposes multipliers; what they prove is computed here."""

    name: str

    @abstractmethod
    def propose(self, weights: Sequence[Array]) -> tuple[Iterable[Proposal], float]:
        """(Proposals, the tightest first, and a lower bound on every ρ that diagonal multipliers prove).

        weights: of two layers or more, of balanced sizes, without neurons that have no effect, the first in units of the norm
        of the inputs.
        """

    def bound(self, network: Network, units: Sequence[float] | Array | None = None, *, axes: bool = True) -> NetworkBound:
        """units s (n_in,), 1 by default: the norm of the inputs is √(Σ s_k² x_k²). axes: also for each input alone."""
        s = np.ones(network.n_in) if units is None else np.array(units, dtype=np.float64)
        if s.shape != (network.n_in,) or not (np.isfinite(s).all() and (s > 0).all()) or s.max() > THRESHOLDS.apart * s.min():
            raise UsageError(
                f"network units: found {s.tolist()}; expected {network.n_in} positive numbers within "
                f"{THRESHOLDS.apart:g} of each other; "
                f"give one per input"
            )
        value, lower, multipliers, method = self._joint(network, network.weights[0], s)
        each = np.full(network.n_in, math.inf)
        if axes:
            for k in range(network.n_in):
                alone = self._joint(network, network.weights[0][:, k : k + 1], np.ones(1))[0]
                each[k] = min(alone, float(np.nextafter(value * s[k], np.inf))) if value > 0 else 0.0
        return NetworkBound(value, lower, multipliers, s, each, method)

    def _joint(self, network: Network, first: Array, units: Array) -> tuple[float, float, tuple[Array, ...], str]:
        """(value, lower, multipliers, method) of the network with another first layer."""
        exponent = network.exponent
        weights, kept = trimmed([first, *network.weights[1:]])
        empty = tuple(np.zeros(len(w)) for w in network.weights[:-1])
        if any(not w.any() for w in weights):
            return 0.0, 0.0, empty, "constant"
        scaled, own, power, exponents = balanced(weights, units)
        exponent += power
        found = self._proved(scaled, own)
        if found is None:
            return shifted(_product(scaled, own), exponent, up=True), 0.0, empty, "spectral"
        value, lower, multipliers = found
        with np.errstate(over="ignore", under="ignore"):
            for whole, part, rows, each in zip(empty, multipliers, kept, exponents, strict=True):
                whole[rows] = np.ldexp(part, 2 * each)
        return shifted(value, exponent, up=True), shifted(lower, exponent, up=False), empty, self.name

    def _proved(self, weights: Sequence[Array], units: Array) -> tuple[float, float, Sequence[Array]] | None:
        """(value, lower, multipliers) of scaled weights, by the proposal that proves the smallest constant."""
        if len(weights) == 1:
            size = float(np.linalg.norm(weights[0] / units, 2))
            value = proved(weights, [], size**2, units)
            return None if value is None else (value, size, [])
        given, least = self.propose([weights[0] / units, *weights[1:]])
        proposals = sorted((p for p in given if math.isfinite(p.square) and p.square > 0), key=lambda p: p.square)
        best: tuple[float, Sequence[Array]] | None = None
        for i, p in enumerate(proposals):
            if best is not None and p.square * (1 + THRESHOLDS.gain) >= best[0] ** 2:
                break
            # What the next one may prove without more is not worth a larger addition to this one.
            room = {"most": max(THRESHOLDS.gain, proposals[i + 1].square / p.square - 1)} if i + 1 < len(proposals) else {}
            value = proved(weights, p.multipliers, p.square, units, **room)
            if value is not None and (best is None or value < best[0]):
                best = value, p.multipliers
        return None if best is None else (best[0], math.sqrt(max(least, 0.0)), best[1])


def _product(weights: Sequence[Array], units: Array) -> float:
    """The product of spectral norms, each proved."""
    product = 1.0
    for i, w in enumerate(weights):
        own = units if i == 0 else np.ones(w.shape[1])
        size = proved([w], [], float(np.linalg.norm(w / own, 2)) ** 2, own)
        if size is None:
            raise UsageError("network: no constant could be proved; expected weights of comparable sizes; rescale them")
        product = float(np.nextafter(product * size, np.inf))
    return product
