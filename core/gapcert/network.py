"""Proved bounds on how fast networks change, and what makes such bounds."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert.errors import UsageError
from gapcert.layers import ACTIVATIONS, Network
from gapcert.network_constant import proved

Array = npt.NDArray[np.float64]

SWEEPS = 10
CLOSE = 1e-10  # of ρ: what is not worth a further proof
APART = 1e100  # units further apart than this leave no room for the squares of both


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
        if s.shape != (network.n_in,) or not (np.isfinite(s).all() and (s > 0).all()) or s.max() > APART * s.min():
            raise UsageError(
                f"network units: found {s.tolist()}; expected {network.n_in} positive numbers within {APART:g} of each other; "
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
        steep = [ACTIVATIONS[network.activation][1]] * (len(network.weights) - 1)
        exponent = sum(steep) + (ACTIVATIONS[network.output][1] if network.output else 0)
        weights, kept = _trimmed([first, *network.weights[1:]])
        empty = tuple(np.zeros(len(w)) for w in network.weights[:-1])
        if any(not w.any() for w in weights):
            return 0.0, 0.0, empty, "constant"
        scaled, own, power, exponents = _balanced(weights, units)
        exponent += power
        found = self._proved(scaled, own)
        if found is None:
            return _shifted(_product(scaled, own), exponent, up=True), 0.0, empty, "spectral"
        value, lower, multipliers = found
        with np.errstate(over="ignore", under="ignore"):
            for whole, part, rows, each in zip(empty, multipliers, kept, exponents, strict=True):
                whole[rows] = np.ldexp(part, 2 * each)
        return _shifted(value, exponent, up=True), _shifted(lower, exponent, up=False), empty, self.name

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
            if best is not None and p.square * (1 + CLOSE) >= best[0] ** 2:
                break
            # What the next one may prove without more is not worth a larger addition to this one.
            room = {"most": max(CLOSE, proposals[i + 1].square / p.square - 1)} if i + 1 < len(proposals) else {}
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


def _trimmed(weights: Sequence[Array]) -> tuple[list[Array], list[npt.NDArray[np.bool_]]]:
    """Without the neurons that change with no input or that change no output; and which ones of each hidden layer are kept."""
    kept = [np.ones(len(w), dtype=bool) for w in weights[:-1]]
    moved, used = np.ones(weights[0].shape[1], dtype=bool), np.ones(len(weights[-1]), dtype=bool)
    for rows, w in zip(kept, weights, strict=False):
        rows &= w[:, moved].any(axis=1)
        moved = rows
    for rows, w in zip(kept[::-1], weights[:0:-1], strict=True):
        rows &= w[used].any(axis=0)
        used = rows
    ends = [np.ones(weights[0].shape[1], dtype=bool), *kept, np.ones(len(weights[-1]), dtype=bool)]
    return [w[np.ix_(ends[i + 1], ends[i])] for i, w in enumerate(weights)], kept


def _balanced(weights: Sequence[Array], units: Array) -> tuple[list[Array], Array, int, list[npt.NDArray[np.int64]]]:
    """(W′, s′, p, c): W′_i = C_{i+1} W_i C_i⁻¹, C_i = 2^c_i, so that what goes into each neuron is as large as what leaves it.
    The columns of W_0 are first divided by the powers of two above the units: s′ = s/2^k lies in [½, 1).

    The constant is 2^p times that of W′ and s′, and the multipliers are C_i² Λ′_i: the matrices of both are congruent.
    Every change is by powers of two, and checked to be exact.
    """
    inputs = np.frexp(units)[1].astype(np.int64)
    own = np.ldexp(units, -inputs)
    weights = [_exact(weights[0], -inputs[None], "weights[0]"), *weights[1:]]
    sizes = [_logarithm(w) for w in weights]
    c = [np.zeros(weights[0].shape[1]), *(np.zeros(len(w)) for w in weights)]
    for _ in range(SWEEPS):
        for i in range(1, len(weights)):
            into = (sizes[i - 1] - c[i - 1]).max(axis=1)
            c[i] = ((sizes[i] + c[i + 1][:, None]).max(axis=0) - into) / 2
    mean = float(np.mean([(z + c[i + 1][:, None] - c[i]).max() for i, z in enumerate(sizes)]))
    whole = [np.rint(each + (len(weights) - i) * mean).astype(np.int64) for i, each in enumerate(c)]
    scaled = [_exact(w, whole[i + 1][:, None] - whole[i], f"weights[{i}]") for i, w in enumerate(weights)]
    return scaled, own, int(whole[0][0]), whole[1:-1]


def _logarithm(a: Array) -> Array:
    """log₂|a|, and far below everything where a is 0."""
    return np.where(a == 0, -1e6, np.log2(np.where(a == 0, 1.0, np.abs(a))))


def _exact(a: Array, power: npt.NDArray[np.int64], where: str) -> Array:
    """a·2^power; UsageError where floats do not hold it."""
    with np.errstate(over="ignore", under="ignore"):
        out = np.ldexp(a, power)
        if not (np.isfinite(out).all() and (np.ldexp(out, -power) == a).all()):
            size = np.abs(a[a != 0])
            raise UsageError(
                f"network {where}: found {size.max():.3g} beside {size.min():.3g}, too far apart for floats once scaled; "
                f"expected sizes within 1e150 of each other; set the smaller ones to 0"
            )
    return np.asarray(out)


def _shifted(value: float, power: int, *, up: bool) -> float:
    """value·2^power, rounded up where it is not exact and up is asked for."""
    try:
        out = math.ldexp(value, power)
        if up and math.ldexp(out, -power) < value:
            out = math.nextafter(out, math.inf)
    except OverflowError:
        raise UsageError(f"network: its constant is about {value:.3g}·2^{power}, beyond floats; rescale the weights") from None
    return out
