"""Neural networks as functions: values, and enclosures of values and slopes over boxes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from gapcert.plugin import Array, Interval, UsageError
from gapcert_functions import Function, Sloped, mean_value

from .network_slopes import VALUES, lines, slopes

_EPS = float(np.finfo(np.float64).eps)
_TINY = float(np.finfo(np.float64).tiny)
_ROWS = 1 << 16  # numbers of a layer that are held at once: they stay in the second-level cache

# Elementwise with slopes in [0, 2^k]: the function, and k.
ACTIVATIONS: dict[str, tuple[Callable[[Array], Array], int]] = {
    name: (VALUES[name], -2 if name == "sigmoid" else 0) for name in sorted(VALUES)
}
REFUSED = {
    "absolute": "its slopes are -1 and 1",
    "gelu": "its slopes reach from -0.129 to 1.129",
    "silu": "its slopes reach from -0.0999 to 1.0999",
    "softmax": "it is not elementwise: each output depends on every input",
    "swish": "its slopes reach from -0.0999 to 1.0999",
}


@final
@dataclass(frozen=True)
class Network(Function):
    """y = W_l σ(… σ(W_0 x + b_0) …) + b_l, and σ_out of it where `output` names one.

    weights W_i (n_{i+1}, n_i), biases b_i (n_{i+1},). `activation` and `output` are elementwise with slopes in [0, 1]: relu,
    leaky-relu (slope 0.01 below 0), tanh, sigmoid, softplus, arctan, identity. float32 weights become float64 exactly.
    """

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]
    activation: str = "relu"
    output: str | None = None
    kind = "network"

    def __post_init__(self) -> None:
        for where, found in (("activation", self.activation), ("output", self.output or "identity")):
            if found not in ACTIVATIONS:
                reason = REFUSED.get(found, "nothing is known of its slopes")
                raise UsageError(
                    f"network {where}: found '{found}', and {reason}; expected elementwise slopes in [0, 1]; "
                    f"use one of {', '.join(ACTIVATIONS)}"
                )
        for name in ("weights", "biases"):
            arrays = tuple(np.array(a, dtype=np.float64) for a in getattr(self, name))
            object.__setattr__(self, name, arrays)
            for array in arrays:
                array.setflags(write=False)
        self._check()

    def _check(self) -> None:
        if not self.weights or len(self.weights) != len(self.biases):
            raise UsageError(
                f"network: found {len(self.weights)} weights and {len(self.biases)} biases; expected one bias per weight "
                f"and at least one; give zeros where a layer has no bias"
            )
        before = None
        for i, (w, b) in enumerate(zip(self.weights, self.biases, strict=True)):
            if w.ndim != 2 or 0 in w.shape or before not in (None, w.shape[1]):
                n = "n" if before is None else before
                raise UsageError(
                    f"network weights[{i}]: found shape {w.shape}; expected (h, {n}); transpose it or give all layers"
                )
            if b.shape != (len(w),):
                raise UsageError(
                    f"network biases[{i}]: found shape {b.shape}; expected ({len(w)},); give one number per neuron"
                )
            for name, a in (("weights", w), ("biases", b)):
                if not np.isfinite(a).all():
                    at = np.argwhere(~np.isfinite(a))[0].tolist()
                    raise UsageError(
                        f"network {name}[{i}]: found {a[tuple(at)]} at {at}; expected finite numbers; train it again"
                    )
            before = len(w)

    @property
    def n_in(self) -> int:
        return int(self.weights[0].shape[1])

    @property
    def n_out(self) -> int:
        return len(self.weights[-1])

    @property
    def _widest(self) -> int:
        return max(len(w) for w in self.weights)

    @property
    def _layers(self) -> Iterator[tuple[Array, Array, str | None]]:
        """(weights, biases, the activation behind them) of each layer."""
        names = (*(self.activation,) * (len(self.weights) - 1), self.output)
        return zip(self.weights, self.biases, names, strict=True)

    @property
    def exponent(self) -> int:
        """2^exponent bounds the product of the largest slopes of all activations."""
        inner = ACTIVATIONS[self.activation][1] * (len(self.weights) - 1)
        return inner + (ACTIVATIONS[self.output][1] if self.output else 0)

    def __call__(self, z: Array) -> Array:
        """y (n, n_out) of z (n, n_in). Sums run over inputs in their order, so the bits of a row depend on no other row."""
        z = np.asarray(z, dtype=np.float64)
        if z.ndim != 2 or z.shape[1] != self.n_in:
            raise UsageError(f"network input: found shape {z.shape}; expected (n, {self.n_in}); give one row per point")
        for w, b, name in self._layers:
            v = np.tile(b, (len(z), 1))
            for k in range(w.shape[1]):
                v += z[:, k : k + 1] * w[:, k]
            z = v if name is None else ACTIVATIONS[name][0](v)
        return z

    def over(self, boxes: Interval) -> Interval:
        return self._gathered(boxes, lambda part: _activated(self.output, self._entering(part)[-1]))

    def gradient_over(self, boxes: Interval, i: int) -> Interval:
        return self._gathered(boxes, lambda part: self._gradient(part, i))

    def line_over(self, boxes: Interval, i: int) -> tuple[Array, Interval]:
        parts = [self._lines(part, slice(i, i + 1)) for part in self._parts(boxes)]
        return np.concatenate([slope[:, 0] for slope, _ in parts]), Interval.concatenate([rest[:, 0] for _, rest in parts])

    def tight_over(self, boxes: Interval, plus: Sloped | None = None) -> Interval:
        """By the tighter of slopes over the box and of lines through every neuron's range (Zhang et al. 2018, CROWN).

        The layers' ranges are asked for only where they may be narrower.
        """
        parts = [self._sloped(part) for part in self._parts(boxes)]
        lines = np.concatenate([p[0] for p in parts])
        rest, steep = (Interval.concatenate([p[k] for p in parts]) for k in (1, 2))
        least, slope, value = np.concatenate([p[3] for p in parts]), Interval.exact(lines), lambda z: self._at(z.lo)
        if plus is not None:
            shared, least, value = plus.jacobian_over(boxes), 0 * least, lambda z: self._at(z.lo) + plus.over(z)
            slope, steep, rest = shared + lines, shared + steep, rest + plus.over(Interval.exact(boxes.mid))
        found = (slope * (boxes - boxes.mid)[:, None, :]).sum(-1) + rest
        found = found.intersect(mean_value(boxes, steep, value))
        if len(wide := np.flatnonzero((found.width > least).any(axis=1))):
            low, high, ranges = found.lo.copy(), found.hi.copy(), self.over(boxes[wide])
            ranges = ranges if plus is None else ranges + plus.over(boxes[wide])
            low[wide], high[wide] = np.maximum(low[wide], ranges.lo), np.minimum(high[wide], ranges.hi)
            return Interval(low, high)
        return found

    def _sloped(self, boxes: Interval) -> tuple[Array, Interval, Interval, Array]:
        """Lines of all outputs as (slope, rest), enclosures of their slopes (n, m, nz), and what `over` is wide at least."""
        between: list[tuple[Array, Array]] = []
        slope, rest = self._lines(boxes, slice(None), between)
        return slope, rest, self._steep(between, len(boxes)), self._least(boxes.rad, between)

    def _parts(self, boxes: Interval) -> list[Interval]:
        """As many boxes at once as leave a layer's numbers, and its slopes behind the first, in the cache."""
        each = self._widest * (1 if len(self.weights) <= 2 else self.n_in)
        rows = max(1, _ROWS // each)
        return [boxes[a : a + rows] for a in range(0, max(len(boxes), 1), rows)]

    def _lines(
        self, boxes: Interval, outputs: slice, between: list[tuple[Array, Array]] | None = None
    ) -> tuple[Array, Interval]:
        """Slopes a (n, m, nz) and what q − a (z − c) lies in, (n, m); `between` takes the slopes that activations have.

        Every neuron is within e of A (z − c) + m; activations are replaced by lines, whose distance is added to e.
        A = diag(α) B with B (h, nz) common to all boxes in the first layer, (n, h, nz) behind it; size = |A| h.
        """
        centre, h = boxes.mid, boxes.rad
        slope, alpha = np.eye(self.n_in), np.ones((1, self.n_in))
        m, e, size, known = centre, np.zeros_like(centre), h, None
        for k, (w, b, name) in enumerate(self._layers):
            last = k == len(self.weights) - 1
            w, b = (w[outputs], b[outputs]) if last else (w, b)
            across = np.abs(w).T
            # Sums of n products err by γ_{n+1} of the sum of sizes, in A, weighted by h, as in m; g is twice that.
            g = (w.shape[1] + 2) * _EPS
            e = (e + g * (size + np.abs(m))) @ across * (1 + 4 * g) + (g * np.abs(b) + (w.shape[1] + 2) * _TINY)
            m = m @ w.T + b
            if k == 0:
                slope, size = w, h @ across * (1 + 4 * g)
            else:
                # Few rows alone need no (n, h, nz) of a common B.
                alone = last and slope.ndim == 2
                slope = (alpha[:, None] * w) @ slope if alone else w @ (alpha[:, :, None] * slope)
                size = (np.abs(slope) * h[:, None, :]).sum(axis=2) * (1 + 4 * g)
            alpha = np.ones((1, len(w)))
            if name is not None:
                r = (size + e) * (1 + 4 * _EPS)
                if between is not None:
                    between.append(known := slopes(name, m, r))
                alpha, mu, distance = lines(name, m, r, known)
                # α ≤ 1; products and sums round by an eps of their sizes, twice over.
                e = (alpha * e + distance) * (1 + 4 * _EPS) + (2 * _EPS * (size + np.abs(m) + np.abs(mu)) + _TINY)
                m, size = alpha * m + mu, alpha * size * (1 + 2 * _EPS)
        whole = np.broadcast_to(alpha[:, :, None] * slope, (len(boxes), len(w), self.n_in))
        return np.ascontiguousarray(whole), Interval.around(m, e)

    def _least(self, h: Array, between: list[tuple[Array, Array]]) -> Array:
        """Below the widths (n, m) of `over`, with one hidden layer: slopes of at least s make a range of 2 s r; else 0."""
        if len(self.weights) != 2 or self.output is not None:
            return np.zeros((len(h), self.n_out))
        first, last = (np.abs(w).T for w in self.weights)
        return np.asarray(1.99 * (between[0][0] * (h @ first)) @ last)

    def _steep(self, between: list[tuple[Array, Array]], n: int) -> Interval:
        """Slopes (n, m, nz) of all outputs, backwards, with those of every activation between two bounds ≥ 0."""
        weights, hidden = self.weights[::-1], between[: len(self.weights) - 1][::-1]
        g = Interval.exact(np.broadcast_to(weights[0], (n, *weights[0].shape)))
        if self.output is not None:
            g = _gated(g, Interval(*(s[:, :, None] for s in between[-1])))
        for k, (w, (low, high)) in enumerate(zip(weights[1:], hidden, strict=True)):
            if k or self.output is not None:
                gated = _gated(g, Interval(low[:, None], high[:, None]))
                m, r = gated.mid, gated.rad
            else:
                # Slopes are at most 1: their middle, its distance and the product of both err by 2 eps at most.
                m, r = weights[0] * ((low + high) / 2)[:, None], np.abs(weights[0]) * ((high - low) / 2 + 4 * _EPS)[:, None]
            g = _mapped(w.T, np.zeros(w.shape[1]), m, r)
        return g

    def _at(self, z: Array) -> Interval:
        """q at points (n, nz), within `rounding` over all of them: it holds in any order of sums."""
        if not len(z):
            return Interval.exact(np.empty((0, self.n_out)))
        error, found, rows = (
            self.rounding(Interval(z.min(axis=0)[None], z.max(axis=0)[None])),
            [],
            max(1, _ROWS // self._widest),
        )
        for a in range(0, len(z), rows):
            v = z[a : a + rows]
            for w, b, name in self._layers:
                v = v @ w.T + b
                v = v if name is None else ACTIVATIONS[name][0](v)
            found.append(v)
        value = np.concatenate(found)
        return Interval.around(value, np.broadcast_to(error, value.shape))

    def rounding(self, box: Interval) -> Array:
        # With |â − a| ≤ error and |a| ≤ value before a layer, |fl(W â + b) − (W a + b)| ≤ |W| error + γ_{k+1} size.
        error, value = np.zeros(self.n_in), box.mag[0]
        for w, b, name in self._layers:
            size = np.abs(w) @ (value + error) + np.abs(b)
            error = (np.abs(w) @ error + (w.shape[1] + 2) * _EPS * size) * (1 + 1e-12) + w.shape[1] * _TINY
            value = size * (1 + 1e-12) + 1.0  # no activation but softplus exceeds its argument, and that by less than 1
            if name is not None:
                error = error + 8 * _EPS * value  # slopes are at most 1
        return np.asarray(error)

    def data(self) -> Mapping[str, Any]:
        return {"layers": len(self.weights), "activation": self.activation, "output": self.output}

    def arrays(self) -> dict[str, Array]:
        return {f"{k}{i}": a for k, part in (("W", self.weights), ("b", self.biases)) for i, a in enumerate(part)}

    @classmethod
    def stored(cls, data: Mapping[str, Any], arrays: Mapping[str, Array]) -> Network:
        """From what `data` and `arrays` hold."""
        w, b = (tuple(arrays[f"{k}{i}"] for i in range(int(data["layers"]))) for k in "Wb")
        return cls(w, b, data["activation"], data["output"])

    def _gathered(self, boxes: Interval, of: Callable[[Interval], Interval]) -> Interval:
        rows = max(1, _ROWS // self._widest)
        return Interval.concatenate([of(boxes[a : a + rows]) for a in range(0, max(len(boxes), 1), rows)])

    def _entering(self, boxes: Interval) -> list[Interval]:
        """What enters the activations of each layer, (n, h_i), the output's last."""
        found, v = [], boxes
        for w, b, name in self._layers:
            found.append(_affine(w, b, v))
            v = _activated(name, found[-1])
        return found

    def _gradient(self, boxes: Interval, i: int) -> Interval:
        """Backwards, from the row of output i: slopes, then the weights before them, layer by layer."""
        entering = self._entering(boxes)
        row = np.broadcast_to(self.weights[-1][i], (len(boxes), self.weights[-1].shape[1]))
        g = Interval.exact(row)
        if self.output is not None:
            g = _gated(g, _slopes(self.output, entering[-1][:, i : i + 1]))
        for w, v in zip(self.weights[-2::-1], entering[-2::-1], strict=True):
            g = _affine(w.T, np.zeros(w.shape[1]), _gated(g, _slopes(self.activation, v)))
        return g


def _affine(w: Array, b: Array, v: Interval) -> Interval:
    """Contains W v + b, (n, k) → (n, h): W m + b about the middles m, and |W| times the radii r to either side."""
    return _mapped(w, b, v.mid, v.rad)


def _mapped(w: Array, b: Array, m: Array, r: Array) -> Interval:
    # |fl(W m + b) − (W m + b)| ≤ γ_{k+1} (|W| |m| + |b|) in any order of sums, γ_k = k u / (1 − k u), u = eps / 2: g is twice
    # that. The radius is a sum of nonnegative numbers, whose own rounding is relative, and is covered by 1 + 4 g.
    g = (w.shape[1] + 2) * _EPS
    radius = ((r + g * np.abs(m)) @ np.abs(w).T + g * np.abs(b)) * (1 + 4 * g) + (w.shape[1] + 2) * _TINY
    return Interval.around(m @ w.T + b, radius)


def _gated(g: Interval, slope: Interval) -> Interval:
    """g · slope where slope ≥ 0."""
    low, high = np.minimum(g.lo * slope.lo, g.lo * slope.hi), np.maximum(g.hi * slope.lo, g.hi * slope.hi)
    return Interval(low - (_EPS * np.abs(low) + _TINY), high + (_EPS * np.abs(high) + _TINY))


def _activated(name: str | None, v: Interval) -> Interval:
    """The range of an activation, all of which are monotone."""
    if name is None or name == "identity":
        return v
    if name == "relu":
        return v.maximum(0.0)
    if name == "leaky-relu":
        return v.maximum(v * 0.01)
    if name == "tanh":
        return v.tanh()
    if name == "arctan":
        return v.arctan()
    if name == "sigmoid":
        return _logistic(v)
    return Interval(np.maximum(_softplus(v.lo).lo, 0.0), _softplus(v.hi).hi)


def _softplus(v: Array) -> Interval:
    """log(1 + e^v) = max(v, 0) + log(1 + e^−|v|) at points."""
    x = Interval.exact(v)
    return x.maximum(0.0) + ((-abs(x)).exp() + 1.0).log()


def _logistic(v: Interval) -> Interval:
    return (v * 0.5).tanh() * 0.5 + 0.5


def _slopes(name: str, v: Interval) -> Interval:
    return Interval(*slopes(name, v.mid, v.rad))
