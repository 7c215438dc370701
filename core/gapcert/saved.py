"""A saved certificate as data: its sample rounds, and its bounds evaluated again with outward-rounded intervals."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert.errors import UsageError
from gapcert.intervals import Interval

Array = npt.NDArray[np.float64]
_BLOCK = 1 << 22


@final
@dataclass(frozen=True)
class Evidence:
    """What a run folder holds: certificate.json, certificate.npz, and the sample rounds by name."""

    folder: Path
    data: Mapping[str, Any]
    arrays: Mapping[str, Array]

    def round(self, name: str) -> tuple[Array, Array]:
        """(z, r) of a round; grid points are recomputed from the cover."""
        folder = self.folder / "samples" / name
        lines = [json.loads(line) for line in (folder / "manifest.jsonl").read_text(encoding="utf-8").splitlines()]
        r = np.concatenate(
            [np.load(folder / f"chunk-{line['chunk']:06d}.npy") for line in sorted(lines[1:], key=lambda x: x["chunk"])]
        )
        z = np.load(folder / "points.npy") if (folder / "points.npy").exists() else grid(self.data, len(r))
        return z, r

    @cached_property
    def samples(self) -> tuple[Array, Array]:
        """The bound's samples, of all rounds."""
        rounds = [self.round(name) for name in sorted(self.data["digests"]) if name.startswith("bound-")]
        return np.concatenate([z for z, _ in rounds]), np.concatenate([r for _, r in rounds])

    @cached_property
    def audit(self) -> tuple[Array, Array]:
        """(z, r) of the audit."""
        return self.round(f"audit-{self.data['audit']['number']}")

    @cached_property
    def audited(self) -> tuple[Interval, Interval]:
        """(l, u) at the audit's points."""
        return bounds(self, self.audit[0], "predictor.audit")


def grid(data: Mapping[str, Any], size: int) -> Array:
    """Cell centres of the cover: low + (2k + 1) width / (2 count), last axis fastest; ValueError unless there are `size`."""
    if math.prod(data["cover"]) != size:
        raise ValueError(f"{size} samples for a cover of {data['cover']} cells")
    axes = [
        lo + (hi - lo) * (2 * np.arange(n) + 1) / (2 * n)
        for lo, hi, n in zip(data["domain"]["low"], data["domain"]["high"], data["cover"], strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def load(folder: Path) -> Evidence:
    """What `Certificate.save` wrote; UsageError where it is missing or cannot be read."""
    path = folder / "certificate.json"
    if not path.is_file():
        raise UsageError(f"{folder}: holds no certificate.json; give the folder of a finished run")
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        with np.load(folder / "certificate.npz", allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        return Evidence(folder, data, arrays)
    except (OSError, ValueError, EOFError) as error:
        raise UsageError(f"{folder}: the certificate cannot be read ({error}); run the spec again") from None


def predictor(e: Evidence, z: Array, stored: str) -> Interval:
    """p(z) as intervals: recomputed where it is affine, taken from the stored values where it is a model's."""
    if e.data["predictor"] == "model":
        return Interval.exact(e.arrays[stored])
    if e.data["predictor"] == "none":
        return Interval.exact(np.zeros((len(z), len(e.arrays["resolution"]))))
    total = Interval.exact(np.broadcast_to(e.arrays["predictor.offset"], (len(z), len(e.arrays["predictor.offset"]))))
    for j in range(z.shape[1]):
        total = total + Interval.exact(z[:, j : j + 1]) * Interval.exact(e.arrays["predictor.slope"][:, j])
    return total


def distance(constants: Array, a: Array, b: Array) -> Interval:
    """Σ_j L_j |a_j − b_j| for all pairs, (na, nb)."""
    total = Interval.exact(np.zeros((len(a), len(b))))
    for j, c in enumerate(constants):
        total = total + abs(Interval.exact(a[:, None, j]) - b[None, :, j]) * float(c)
    return total


def envelope(e: Evidence, z: Array, p: Interval) -> tuple[Interval, Interval]:
    """(l, u) at points z, each as an interval that contains the exact value, from samples, constants and resolution."""
    points, r = e.samples
    g = Interval.exact(r) - predictor(e, points, "predictor.samples")
    nx = r.shape[1]
    low, high = [], []
    rows = max(1, _BLOCK // max(len(points), 1))
    for a in range(0, len(z), rows):
        lows, highs = [], []
        for i in range(nx):
            d = distance(e.arrays["lipschitz"][i], z[a : a + rows], points)
            above = Interval(g.lo[None, :, i], g.hi[None, :, i]) + d
            below = Interval(g.lo[None, :, i], g.hi[None, :, i]) - d
            highs.append(Interval(above.lo.min(axis=1), above.hi.min(axis=1)))
            lows.append(Interval(below.lo.max(axis=1), below.hi.max(axis=1)))
        low.append(_columns(lows))
        high.append(_columns(highs))
    two_e = Interval.exact(e.arrays["remainder.resolution"]) * 2.0
    return p + _rows(low) - two_e, p + _rows(high) + two_e


def _columns(parts: list[Interval]) -> Interval:
    return Interval(np.stack([p.lo for p in parts], axis=1), np.stack([p.hi for p in parts], axis=1))


def _rows(parts: list[Interval]) -> Interval:
    return Interval(np.concatenate([p.lo for p in parts]), np.concatenate([p.hi for p in parts]))


def bounds(e: Evidence, z: Array, stored: str) -> tuple[Interval, Interval]:
    """(l, u) of the stored gap function at points z, as intervals around the exact values."""
    form = e.data["form"]["form"]
    if form == "envelope":
        return envelope(e, z, predictor(e, z, stored))
    if form == "constant":
        gamma = Interval.exact(np.broadcast_to(e.arrays["gap.gamma"], (len(z), len(e.arrays["gap.gamma"]))))
        return -gamma, gamma
    if form == "basis":
        gamma = basis(e, z)
        return -gamma, gamma
    raise UsageError(f"{e.folder}: no check is known for gap functions of form '{form}'")


def basis(e: Evidence, z: Array) -> Interval:
    """γ_i(z) = max(0, Σ_l w_il p_l(z) + margin_i)."""
    w, margin = e.arrays["gap.weights"], e.arrays["gap.margin"]
    total = Interval.exact(np.broadcast_to(margin, (len(z), len(margin))))
    for k, factors in enumerate(e.data["form"]["functions"]):
        value = Interval.exact(np.ones((len(z), 1)))
        for axis, kind, number in factors:
            value = value * factor(kind, number, Interval.exact(z[:, axis : axis + 1]))
        total = total + value * Interval.exact(w[:, k])
    return Interval(np.maximum(total.lo, 0), np.maximum(total.hi, 0))


def factor(kind: str, number: float, x: Interval) -> Interval:
    """One-dimensional factor: x^n, |x|^n, sin(a x), cos(a x)."""
    if kind == "power":
        return x ** int(number)
    if kind == "abs":
        return abs(x) ** int(number)
    return (x * float(number)).sin() if kind == "sin" else (x * float(number)).cos()


def exceeds(e: Evidence, i: int, gamma: float, budget: int = 400_000) -> str:
    """ "" where branch and bound proves that the envelope of state i stays within ±gamma on Z, else what stands against it.

    Over a box with centre c and half-widths h, u ≤ max p + min_k g_k + Σ_j L_j (|c_j − z_kj| + h_j) + 2 e, and l likewise.
    """
    points, r = e.samples
    constants, affine = e.arrays["lipschitz"][i], e.data["predictor"] == "affine"
    g = (Interval.exact(r) - predictor(e, points, "predictor.samples"))[:, i]
    weight = constants + (np.abs(e.arrays["predictor.slope"][i]) if affine else 0.0)
    two_e = Interval.exact(e.arrays["remainder.resolution"][i]) * 2.0
    boxes = Interval(np.asarray(e.data["domain"]["low"])[None], np.asarray(e.data["domain"]["high"])[None])
    rows, spent = max(1, _BLOCK // len(points)), 0
    while True:
        if (spent := spent + len(boxes)) > budget:
            return f"state {i}: γ ≤ {gamma:.6g} could not be decided with {budget} boxes"
        bound = np.concatenate([_largest(e, i, boxes[a : a + rows], g, two_e) for a in range(0, len(boxes), rows)])
        # The stored value was rounded outwards by some ulp more than these intervals, or less.
        boxes = boxes[~(bound <= gamma * (1 + 1e-12))]
        if not len(boxes):
            return ""
        middle = Interval.exact(boxes.mid)
        at = np.concatenate([_smallest(e, i, middle[a : a + rows], g, two_e) for a in range(0, len(boxes), rows)])
        if (at > gamma * (1 + 1e-12)).any():
            k = int(at.argmax())
            return f"state {i} at {boxes.mid[k].tolist()}: the envelope reaches {at[k]:.6g}, above γ = {gamma:.6g}"
        boxes = _halves(boxes, weight)


def _halves(boxes: Interval, weight: Array) -> Interval:
    """Each box cut in two across its axis with the largest weight_j · width_j."""
    axis, k = (weight * (boxes.hi - boxes.lo)).argmax(axis=1), np.arange(len(boxes))
    low, high = boxes.lo.copy(), boxes.hi.copy()
    low[k, axis] = high[k, axis] = boxes.mid[k, axis]
    return Interval.concatenate([Interval(boxes.lo, high), Interval(low, boxes.hi)])


def _band(e: Evidence, i: int, boxes: Interval, g: Interval, two_e: Interval) -> tuple[Interval, Interval]:
    """Over each box, p + max_k (g_k − d) − 2 e and p + min_k (g_k + d) + 2 e at its centre, and Σ_j L_j h_j wider."""
    d = distance(e.arrays["lipschitz"][i], boxes.mid, e.samples[0])
    reach = (Interval.exact(boxes.rad) * Interval.exact(e.arrays["lipschitz"][i])).sum(-1) + two_e
    above, below, p = g[None, :] + d, g[None, :] - d, _over(e, i, boxes)
    high = Interval(above.lo.min(axis=1), above.hi.min(axis=1)) + reach + p
    return Interval(below.lo.max(axis=1), below.hi.max(axis=1)) - reach + p, high


def _largest(e: Evidence, i: int, boxes: Interval, g: Interval, two_e: Interval) -> Array:
    low, high = _band(e, i, boxes, g, two_e)
    return np.asarray(np.maximum(-low.lo, high.hi))


def _smallest(e: Evidence, i: int, points: Interval, g: Interval, two_e: Interval) -> Array:
    low, high = _band(e, i, points, g, two_e)
    return np.asarray(np.maximum(-low.hi, high.lo))


def _over(e: Evidence, i: int, boxes: Interval) -> Interval:
    total = Interval.exact(np.zeros(len(boxes)))
    if e.data["predictor"] == "affine":
        total = total + (boxes * Interval.exact(e.arrays["predictor.slope"][i])).sum(-1)
        total = total + float(e.arrays["predictor.offset"][i])
    return total
