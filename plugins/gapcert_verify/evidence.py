"""A saved certificate as data: its sample rounds, and its bounds evaluated again with outward-rounded intervals."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import DAMAGE, Array, Interval, Ints, Relation, UsageError, Zone, clipped, grid_at, grid_size
from gapcert_functions import Expression, Factor

from .multilinear import band, predicted

BLOCK = 1 << 17  # entries of a working array, which a cache then holds


@final
@dataclass(frozen=True)
class Evidence:
    """What a run folder holds: certificate.json, certificate.npz, and the sample rounds by name."""

    folder: Path
    data: Mapping[str, Any]
    arrays: Mapping[str, Array]

    def stored(self, name: str) -> tuple[dict[str, Any], npt.NDArray[Any]]:
        """The header of a round's manifest, and its shards: r, or records (index, r) where only extremes were kept."""
        folder = self.folder / "samples" / name
        header, *lines = [json.loads(line) for line in (folder / "manifest.jsonl").read_text(encoding="utf-8").splitlines()]
        numbers = sorted(line["chunk"] for line in lines)
        return header, np.concatenate([np.load(folder / f"chunk-{i:06d}.npy") for i in numbers])

    def header(self, name: str) -> dict[str, Any]:
        """The first line of a round's manifest."""
        with open(self.folder / "samples" / name / "manifest.jsonl", encoding="utf-8") as lines:
            found: dict[str, Any] = json.loads(lines.readline())
        return found

    def round(self, name: str) -> tuple[Array, Array]:
        """(z, r) of a round; grid points are recomputed from the cover."""
        header, r = self.stored(name)
        path = self.folder / "samples" / name / "points.npy"
        if "extremes" not in header:
            return np.load(path) if path.exists() else grid(self.data, len(r)), r
        z = np.load(path)[r["index"]] if path.exists() else grid_at(self.zone, tuple(self.data["cover"]), r["index"])
        rows = extremes(self.data, header["extremes"], z, r)
        return z[rows], np.ascontiguousarray(r["r"][rows])

    @property
    def older(self) -> bool:
        """Was it written before format 2, so that it holds less than its sentences say?"""
        return "format" not in self.data

    @cached_property
    def taken(self) -> int:
        """Transitions behind the bound, stored or not."""
        rounds = [self.stored(name) for name in self.data["digests"] if name.startswith("bound-")]
        return sum(header["count"] if "extremes" in header else len(r) for header, r in rounds)

    @property
    def reduced(self) -> bool:
        """Were only the extremes of coarse cells kept? As the manifests say, where they can be read."""
        for name in self.data["digests"]:
            with suppress(OSError, ValueError):
                if "extremes" in self.header(name):
                    return True
        return False

    def covers(self) -> bool:
        """The bound's samples are the stated grid: every point of it, or extremes of every chunk of it."""
        header, r = self.stored("bound-0")
        if "extremes" not in header:
            return np.array_equal(self.samples[0], grid(self.data, len(self.samples[0])))
        if header["count"] != grid_size(self.zone, tuple(self.data["cover"])):
            return False
        found = np.unique(r["index"] // header["chunk"])
        return np.array_equal(found, np.arange(-(-header["count"] // header["chunk"])))

    @property
    def rounding(self) -> Array:
        """(nx,): e without the spread over hidden states."""
        return self.arrays.get("rounding", self.arrays["resolution"])

    @cached_property
    def zone(self) -> Zone:
        """Z: the box and its relations."""
        return zone(self.data)

    @cached_property
    def samples(self) -> tuple[Array, Array]:
        """The bound's samples, of all rounds; those of a recording are stored beside its band."""
        if "recording" in self.data:
            return self.arrays["fit.z"], self.arrays["fit.r"]
        rounds = [self.round(name) for name in sorted(self.data["digests"]) if name.startswith("bound-")]
        return np.concatenate([z for z, _ in rounds]), np.concatenate([r for _, r in rounds])

    @cached_property
    def parts(self) -> list[Part]:
        """The cells that the constants hold in, or all of Z as one."""
        points, r = self.samples
        g = Interval.exact(r) - predictor(self, points, "predictor.samples")
        if "cells.L" not in self.arrays:
            box = Interval(np.asarray(self.data["domain"]["low"])[None], np.asarray(self.data["domain"]["high"])[None])
            return [Part(box, points, g, self.arrays["lipschitz"], np.zeros(g.shape[1]), self.arrays["remainder.resolution"])]
        made = []
        for box, constants, jumps in zip(leaves(self), self.arrays["cells.L"], self.arrays["cells.J"], strict=True):
            own = ((points >= box.lo) & (points <= box.hi)).all(axis=1)
            made.append(Part(box, points[own], g[own], constants, jumps, self.arrays["remainder.resolution"]))
        return made

    @cached_property
    def audit(self) -> tuple[Array, Array]:
        """(z, r) of the audit."""
        return self.round(f"audit-{self.data['audit']['number']}")

    @cached_property
    def audited(self) -> tuple[Interval, Interval]:
        """(l, u) at the audit's points."""
        return bounds(self, self.audit[0], "predictor.audit")


@final
@dataclass(frozen=True)
class Part:
    """A closed box (1, nz), its samples (z, g), |g_i(z) − g_i(z′)| ≤ Σ_j constants_ij |z_j − z′_j| + jumps_i + 2 e_i in it."""

    box: Interval
    z: Array
    g: Interval
    constants: Array
    jumps: Array
    e: Array

    @property
    def slack(self) -> Interval:
        return Interval.exact(self.e) * 2.0 + Interval.exact(self.jumps)


def leaves(e: Evidence) -> list[Interval]:
    """The closed cells of the stored tree of cuts, each (1, nz); ValueError unless these are cuts of Z into that many boxes.

    Node k sends z_axis ≤ cut to child[k, 0] and the rest to child[k, 1]; −1 − c is cell c.
    """
    axis, cut, child = (e.arrays[f"cells.{name}"] for name in ("axis", "cut", "child"))
    root = np.asarray(e.data["domain"]["low"]), np.asarray(e.data["domain"]["high"])
    found: dict[int, Interval] = {}
    waiting = [(0 if len(axis) else -1, *root)]
    while waiting:
        node, low, high = waiting.pop()
        if node < 0:
            found[-1 - node] = Interval(low[None], high[None])
            continue
        j, below, above = int(axis[node]), high.copy(), low.copy()
        if not low[j] < cut[node] < high[j] or len(found) + len(waiting) > len(axis):
            raise ValueError("the cells' cuts are no tree of boxes")
        if any(0 <= c <= node for c in child[node]):
            raise ValueError("the cells' cuts are no tree of boxes: one comes before the cut that it belongs to")
        below[j] = above[j] = cut[node]
        waiting += [(int(child[node, 0]), low, below), (int(child[node, 1]), above, high)]
    if sorted(found) != list(range(len(e.arrays["cells.L"]))):
        raise ValueError("the cells' cuts do not make the cells")
    return [found[c] for c in sorted(found)]


def located(e: Evidence, z: Array) -> Ints:
    """(n,) which of the parts each point belongs to; on a shared face, the lower one."""
    if "cells.L" not in e.arrays or not len(e.arrays["cells.axis"]):
        return np.zeros(len(z), dtype=np.int64)
    at = np.zeros(len(z), dtype=np.int64)
    for k, (j, cut, child) in enumerate(zip(*(e.arrays[f"cells.{name}"] for name in ("axis", "cut", "child")), strict=True)):
        rows = at == k
        at[rows] = np.where(z[rows, int(j)] <= cut, child[0], child[1])
    return -1 - at


def zone(data: Mapping[str, Any]) -> Zone:
    """Z of a stored certificate; one without relations may lack the entry."""
    stored = data["domain"].get("relations", [])
    relations = tuple(Relation(r["text"], tuple(float(a) for a in r["a"]), float(r["b"])) for r in stored)
    return Zone(tuple(data["domain"]["low"]), tuple(data["domain"]["high"]), relations)


def grid(data: Mapping[str, Any], size: int) -> Array:
    """Cell centres of the cover: low + (2k + 1) width / (2 count), last axis fastest; ValueError unless there are `size`.

    With relations, the points of `relation.grid_at`.
    """
    cut, counts = zone(data), tuple(data["cover"])
    if grid_size(cut, counts) != size:
        raise ValueError(f"{size} samples for a cover of {data['cover']} cells")
    if cut.relations:
        return grid_at(cut, counts, np.arange(size))
    axes = [
        lo + (hi - lo) * (2 * np.arange(n) + 1) / (2 * n)
        for lo, hi, n in zip(data["domain"]["low"], data["domain"]["high"], data["cover"], strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def extremes(data: Mapping[str, Any], cells: Sequence[int], z: Array, records: npt.NDArray[Any]) -> Ints:
    """Rows that hold the smallest or the largest r_i of a coarse cell; of equal ones that with the lowest index."""
    low, width = np.asarray(data["domain"]["low"]), np.subtract(data["domain"]["high"], data["domain"]["low"])
    place = np.minimum(((z - low) * (np.asarray(cells) / width)).astype(np.int64), np.asarray(cells) - 1)
    cell = np.ravel_multi_index(tuple(place.T), tuple(cells))
    keep = []
    for r in records["r"].T:
        for values in (r, -r):
            order = np.lexsort((records["index"], values, cell))
            keep.append(order[np.diff(cell[order], prepend=-1) != 0])
    return np.unique(np.concatenate(keep))


def load(folder: Path) -> Evidence:
    """What `Certificate.save` wrote; UsageError where it is missing or cannot be read."""
    path = folder / "certificate.json"
    if not path.is_file():
        within = " or ".join(str(p.parent) for p in sorted(folder.glob("*/certificate.json")))
        todo = within or "the folder of a run that has finished and has a certificate"
        raise UsageError(f"{folder}: holds no certificate.json; give {todo}")
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        with open(folder / "certificate.npz", "rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        if not isinstance(data, dict):
            raise TypeError("certificate.json holds no object")
        return Evidence(folder, data, arrays)
    except DAMAGE as error:
        raise UsageError(f"{folder}: the certificate cannot be read ({clipped(str(error))[0]}); run the spec again") from None


def predictor(e: Evidence, z: Array, stored: str) -> Interval:
    """p(z) as intervals: recomputed where it is affine, taken from the stored values where it is a model's."""
    if e.data["predictor"] == "model":
        return Interval.exact(e.arrays[stored])
    if e.data["predictor"] == "none":
        return Interval.exact(np.zeros((len(z), len(e.arrays["resolution"]))))
    if e.data["predictor"] == "multilinear":
        return predicted(e.arrays, e.zone, z)
    total = Interval.exact(np.broadcast_to(e.arrays["predictor.offset"], (len(z), len(e.arrays["predictor.offset"]))))
    for j in range(z.shape[1]):
        total = total + Interval.exact(z[:, j : j + 1]) * Interval.exact(e.arrays["predictor.slope"][:, j])
    return total


def another(e: Evidence, g: Interval) -> bool:
    """Are the stored remainders for certain other ones than g = r − p? Computing them errs by the predictor's resolution."""
    stored = e.arrays["gap.g"]
    whole, own = e.arrays["remainder.resolution"], e.arrays["resolution"]
    allowed = np.maximum(whole - own, 0.0) + 4 * np.spacing(np.maximum(np.abs(stored), whole))
    return bool((abs(g - stored).lo > allowed).any())


def distance(constants: Array, a: Array, b: Array) -> Interval:
    """Σ_j L_j |a_j − b_j| for all pairs, (na, nb)."""
    total = Interval.exact(np.zeros((len(a), len(b))))
    for j, c in enumerate(constants):
        total = total + abs(Interval.exact(a[:, None, j]) - b[None, :, j]) * float(c)
    return total


def envelope(e: Evidence, z: Array, p: Interval) -> tuple[Interval, Interval]:
    """(l, u) at points z, each as an interval that contains the exact value, from samples, constants and resolution."""
    at = located(e, z)
    ends = np.empty((4, len(z), p.shape[1]))
    for c in np.unique(at):
        part, rows = e.parts[c], np.flatnonzero(at == c)
        size = max(1, BLOCK // max(len(part.z), 1))
        for a in range(0, len(rows), size):
            low, high = cones(part, z[rows[a : a + size]])
            ends[:, rows[a : a + size]] = low.lo, low.hi, high.lo, high.hi
    return p + Interval(ends[0], ends[1]), p + Interval(ends[2], ends[3])


def cones(part: Part, z: Array) -> tuple[Interval, Interval]:
    """(max_k g_k − d, min_k g_k + d) at points z of the part, widened by 2 e and jumps; (n, nx)."""
    lows, highs = [], []
    for i, constants in enumerate(part.constants):
        d, g = distance(constants, z, part.z), part.g[:, i]
        above, below = g[None, :] + d, g[None, :] - d
        highs.append(Interval(above.lo.min(axis=1, initial=np.inf), above.hi.min(axis=1, initial=np.inf)))
        lows.append(Interval(below.lo.max(axis=1, initial=-np.inf), below.hi.max(axis=1, initial=-np.inf)))
    return Interval.stack(lows, axis=1) - part.slack, Interval.stack(highs, axis=1) + part.slack


def bounds(e: Evidence, z: Array, stored: str) -> tuple[Interval, Interval]:
    """(l, u) of the stored gap function at points z, as intervals around the exact values; moved as its calibration says."""
    low, high = uncalibrated(e, z, stored)
    if e.data["route"] != "calibrate":
        return low, high
    w, rounding = (Interval.exact(e.arrays[f"gap.calibrated.{name}"]) for name in ("widening", "resolution"))
    middle = (low + high) * 0.5
    lower, upper = low - w, high + w
    return lower.minimum(middle) - rounding, upper.maximum(middle) + rounding


def uncalibrated(e: Evidence, z: Array, stored: str) -> tuple[Interval, Interval]:
    """(l, u) as the family made them."""
    form = str(e.data["form"]["form"])
    if form in _BANDS:
        return _BANDS[form](e, z, predictor(e, z, stored))
    if form in _BOUNDS:
        gamma = _BOUNDS[form](e, z)
        return -gamma, gamma
    raise UsageError(f"{e.folder}: no check is known for gap functions of form '{form}'")


def interpolation(e: Evidence, z: Array, p: Interval) -> tuple[Interval, Interval]:
    """(l, u) between the nodes of a lattice, whose samples are the last ones."""
    size = int(np.prod([len(e.arrays[f"gap.axis{j}"]) for j in range(len(e.zone.low))]))
    return band(e.arrays, e.zone, z, p, e.parts[0].g[-size:])


def basis(e: Evidence, z: Array) -> Interval:
    """γ_i(z) = max(0, Σ_l w_il p_l(z) + margin_i)."""
    w, margin = e.arrays["gap.weights"], e.arrays["gap.margin"]
    total = Interval.exact(np.broadcast_to(margin, (len(z), len(margin))))
    for k, data in enumerate(e.data["form"]["functions"]):
        value = Interval.exact(np.ones((len(z), 1)))
        if (expression := written(data)) is not None:
            value = expression.over(Interval.exact(z))[:, None]
        for axis, kind, number in data if expression is None else ():
            value = value * factor(kind, number, Interval.exact(z[:, axis : axis + 1]))
        total = total + value * Interval.exact(w[:, k])
    return total.maximum(0.0)


def written(data: Any) -> Expression | None:
    """The expression that a basis function's data hold; None where they are factors. ValueError where they are neither."""
    if not (isinstance(data, list) and all(isinstance(f, list) for f in data)):
        return Expression("", data)
    for f in data:
        Factor(*f)
    return None


def factor(kind: str, number: float, x: Interval) -> Interval:
    """One-dimensional factor: x^n, |x|^n, sin(a x), cos(a x)."""
    if kind == "power":
        return x ** int(number)
    if kind == "abs":
        return abs(x) ** int(number)
    return (x * float(number)).sin() if kind == "sin" else (x * float(number)).cos()


def dominated(e: Evidence, z: Array, p: Interval) -> tuple[Interval, Interval]:
    """(l, u) of two functions, lifted over the envelope."""
    from .functions import dominating  # late: networks need SciPy

    return dominating(e.data["form"], e.arrays, e.zone, z, p)


def of_network(e: Evidence, z: Array) -> Interval:
    """γ_i(z) = max(0, q_i(z) + margin_i)."""
    from .functions import network

    return (network(e.data["form"], e.arrays).over(Interval.exact(z)) + e.arrays["gap.margin"]).maximum(0.0)


_BANDS: Mapping[str, Callable[[Evidence, Array, Interval], tuple[Interval, Interval]]] = {
    "envelope": envelope,
    "multilinear": interpolation,
    "dominating": dominated,
}
_BOUNDS: Mapping[str, Callable[[Evidence, Array], Interval]] = {
    "constant": lambda e, z: Interval.exact(np.broadcast_to(e.arrays["gap.gamma"], (len(z), len(e.arrays["gap.gamma"])))),
    "basis": basis,
    "network": of_network,
}
"""Forms of gap functions: those with a predictor and two ends, and those with γ alone."""
