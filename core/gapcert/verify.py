"""Re-checks a saved certificate from its data: no code of fitting, sampling or plugins takes part.

Every bound is recomputed with outward-rounded intervals from the stored samples and constants; a check that needs a number to
be large enough is made with its lower end, one that needs it small enough with its upper end.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
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
        z = np.load(folder / "points.npy") if (folder / "points.npy").exists() else grid(self.data)
        return z, r

    @cached_property
    def samples(self) -> tuple[Array, Array]:
        """The bound's samples, of all rounds."""
        rounds = [self.round(name) for name in sorted(self.data["digests"]) if name.startswith("bound-")]
        return np.concatenate([z for z, _ in rounds]), np.concatenate([r for _, r in rounds])

    @cached_property
    def audit(self) -> tuple[Array, Array]:
        return self.round(f"audit-{self.data['audit']['number']}")

    @cached_property
    def audited(self) -> tuple[Interval, Interval]:
        """(l, u) at the audit's points."""
        return bounds(self, self.audit[0], "predictor.audit")


def grid(data: Mapping[str, Any]) -> Array:
    """Cell centres of the cover: low + (2k + 1) width / (2 count), last axis fastest."""
    axes = [
        lo + (hi - lo) * (2 * np.arange(n) + 1) / (2 * n)
        for lo, hi, n in zip(data["domain"]["low"], data["domain"]["high"], data["cover"], strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def verify_run(folder: Path | str) -> dict[str, Any]:
    """{"verdict": "holds" | "fails", "claim", "checks": [{"check", "passed", "detail"}]}; UsageError without one."""
    evidence = _load(Path(folder))
    checks = [
        ("stored data match their digests", _digests),
        ("samples do not contradict the constants", _consistent),
        ("γ ≥ |r| on every sample of the bound", _samples),
        ("the margin covers the cover's radius", _margin),
        ("the audit's points are those that its seed draws", _drawn),
        ("the audit has enough points for its ε and β", _enough),
        ("l ≤ r ≤ u at every audited point, as stated", _audit),
        ("figures of the states follow from the audit", _figures),
        ("the claim is one that its evidence allows", _claim),
    ]
    results = []
    for name, check in checks:
        outcome = _attempt(check, evidence)
        if outcome is not None:
            results.append({"check": name, "passed": outcome == "", "detail": outcome})
    verdict = "holds" if all(r["passed"] for r in results) else "fails"
    return {"verdict": verdict, "claim": dict(evidence.data["claim"]), "checks": results}


def _attempt(check: Callable[[Evidence], str | None], evidence: Evidence) -> str | None:
    """ "" where a check passes, what is wrong where it fails, None where it does not apply."""
    try:
        return check(evidence)
    except (OSError, KeyError, ValueError, IndexError, EOFError) as error:
        return f"the stored data are incomplete: {type(error).__name__}: {error}"


def _load(folder: Path) -> Evidence:
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


def _digests(e: Evidence) -> str:
    """The arrays, and each shard against its manifest, have the SHA-256 that is stated."""
    if hashlib.sha256((e.folder / "certificate.npz").read_bytes()).hexdigest() != e.data["arrays"]:
        return "certificate.npz was changed"
    for name, stated in e.data["digests"].items():
        folder = e.folder / "samples" / name
        header, *lines = [json.loads(line) for line in (folder / "manifest.jsonl").read_text(encoding="utf-8").splitlines()]
        shards = {line["chunk"]: line["sha256"] for line in lines}
        for i, digest in shards.items():
            if hashlib.sha256((folder / f"chunk-{i:06d}.npy").read_bytes()).hexdigest() != digest:
                return f"shard {i} of round {name} was changed"
        total = hashlib.sha256(json.dumps([header, [shards[i] for i in range(len(shards))]]).encode()).hexdigest()
        if total != stated:
            return f"round {name} was changed"
        points = folder / "points.npy"
        if points.exists():
            z = np.load(points)
            if hashlib.sha256(np.ascontiguousarray(z).tobytes() + str(z.shape).encode()).hexdigest() != header["points"]:
                return f"the points of round {name} were changed"
    return ""


def _predictor(e: Evidence, z: Array, stored: str) -> Interval:
    """p(z) as intervals: recomputed where it is affine, taken from the stored values where it is a model's."""
    if e.data["predictor"] == "model":
        return Interval.exact(e.arrays[stored])
    if e.data["predictor"] == "none":
        return Interval.exact(np.zeros((len(z), len(e.arrays["resolution"]))))
    total = Interval.exact(np.broadcast_to(e.arrays["gap.offset"], (len(z), len(e.arrays["gap.offset"]))))
    for j in range(z.shape[1]):
        total = total + Interval.exact(z[:, j : j + 1]) * Interval.exact(e.arrays["gap.slope"][:, j])
    return total


def _distance(constants: Array, a: Array, b: Array) -> Interval:
    """Σ_j L_j |a_j − b_j| for all pairs, (na, nb)."""
    total = Interval.exact(np.zeros((len(a), len(b))))
    for j, c in enumerate(constants):
        total = total + abs(Interval.exact(a[:, None, j]) - b[None, :, j]) * float(c)
    return total


def envelope(e: Evidence, z: Array, p: Interval) -> tuple[Interval, Interval]:
    """(l, u) at points z, each as an interval that contains the exact value, from samples, constants and resolution."""
    points, r = e.samples
    g = Interval.exact(r) - _predictor(e, points, "predictor.samples")
    nx = r.shape[1]
    low, high = [], []
    rows = max(1, _BLOCK // max(len(points), 1))
    for a in range(0, len(z), rows):
        lows, highs = [], []
        for i in range(nx):
            d = _distance(e.arrays["lipschitz"][i], z[a : a + rows], points)
            above = Interval(g.lo[None, :, i], g.hi[None, :, i]) + d
            below = Interval(g.lo[None, :, i], g.hi[None, :, i]) - d
            highs.append(Interval(above.lo.min(axis=1), above.hi.min(axis=1)))
            lows.append(Interval(below.lo.max(axis=1), below.hi.max(axis=1)))
        low.append(_columns(lows))
        high.append(_columns(highs))
    two_e = Interval.exact(e.arrays["gap.e"]) * 2.0
    return p + _rows(low) - two_e, p + _rows(high) + two_e


def _columns(parts: list[Interval]) -> Interval:
    return Interval(np.stack([p.lo for p in parts], axis=1), np.stack([p.hi for p in parts], axis=1))


def _rows(parts: list[Interval]) -> Interval:
    return Interval(np.concatenate([p.lo for p in parts]), np.concatenate([p.hi for p in parts]))


def bounds(e: Evidence, z: Array, stored: str) -> tuple[Interval, Interval]:
    """(l, u) of the stored gap function at points z, as intervals around the exact values."""
    form = e.data["form"]["form"]
    if form == "envelope":
        return envelope(e, z, _predictor(e, z, stored))
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
            value = value * _factor(kind, number, Interval.exact(z[:, axis : axis + 1]))
        total = total + value * Interval.exact(w[:, k])
    return Interval(np.maximum(total.lo, 0), np.maximum(total.hi, 0))


def _factor(kind: str, number: float, x: Interval) -> Interval:
    """One-dimensional factor: x^n, |x|^n, sin(a x), cos(a x)."""
    if kind == "power":
        return x ** int(number)
    if kind == "abs":
        return abs(x) ** int(number)
    return (x * float(number)).sin() if kind == "sin" else (x * float(number)).cos()


def _consistent(e: Evidence) -> str:
    """|g_k − g_m| ≤ Σ L |z_k − z_m| + 4 e for (up to 2,000) pairs of samples: each stored value may err by e."""
    if "gap.e" in e.arrays and (e.arrays["gap.e"] < e.arrays["resolution"]).any():
        return "the envelope uses a smaller resolution than the certificate states"
    z, r = e.samples
    pick = np.linspace(0, len(z) - 1, min(2_000, len(z))).astype(int)
    p = _predictor(e, z, "predictor.samples")
    g = Interval.exact(r[pick]) - Interval(p.lo[pick], p.hi[pick])
    for i in range(r.shape[1]):
        for a in range(0, len(pick), 500):
            rows = slice(a, a + 500)
            d = _distance(e.arrays["lipschitz"][i], z[pick[rows]], z[pick])
            difference = Interval(g.lo[rows, None, i], g.hi[rows, None, i]) - Interval(g.lo[None, :, i], g.hi[None, :, i])
            # Refuted for certain: the smallest |Δg| lies above the largest bound.
            sure = np.maximum(difference.lo, -difference.hi) > d.hi + 4 * e.arrays["resolution"][i] * (1 + 1e-12)
            if sure.any():
                k, m = np.argwhere(sure)[0]
                return f"state {i}: samples at {z[pick[a + k]].tolist()} and {z[pick[m]].tolist()} refute the constants"
    return ""


def _samples(e: Evidence) -> str:
    z, r = e.samples
    rows = 100_000
    for a in range(0, len(z), rows):
        part = _part(e, z[a : a + rows], slice(a, a + rows))
        short = np.abs(r[a : a + rows]) > np.maximum(np.abs(part[0].lo), np.abs(part[1].hi))
        if short.any():
            k, i = np.argwhere(short)[0]
            return f"state {i} at {z[a + k].tolist()}: |r| = {abs(r[a + k, i]):.6g} lies above γ"
    return ""


def _part(e: Evidence, z: Array, rows: slice) -> tuple[Interval, Interval]:
    if e.data["predictor"] == "model":
        arrays = {**e.arrays, "predictor.rows": e.arrays["predictor.samples"][rows]}
        return bounds(Evidence(e.folder, e.data, arrays), z, "predictor.rows")
    return bounds(e, z, "")


def _margin(e: Evidence) -> str | None:
    """Route theorem1: margin ≥ L₁ √(εx² + εu²) + L₂x εx + L₂u εu + 2 e, all recomputed from grid, constants and weights."""
    if e.data["route"] != "theorem1":
        return None
    nx, constants = e.data["domain"]["states"], e.arrays["lipschitz"]
    h = _half_widths(e.data)
    ex, eu = _norm([h[j] for j in range(nx)]), _norm([h[j] for j in range(nx, len(h))])
    joint = _norm([ex, eu])
    z, r = e.samples
    for i in range(len(constants)):
        lx = _norm([Interval.exact(c) for c in constants[i, :nx]])
        lu = _norm([Interval.exact(c) for c in constants[i, nx:]])
        l1 = _own_slope(e, i)
        need = l1 * joint + lx * ex + lu * eu + Interval.exact(e.arrays["resolution"][i]) * 2.0
        have = _clearance(e, i, z, r)
        if have < float(need.lo):
            return f"state {i}: γ clears the samples by {have:.6g}, and {float(need.lo):.6g} is needed"
    return ""


def _clearance(e: Evidence, i: int, z: Array, r: Array) -> float:
    """min_k γ_i(z_k) − |r_ki|, from below."""
    worst = math.inf
    for a in range(0, len(z), 100_000):
        _, high = bounds(e, z[a : a + 100_000], "")
        worst = min(worst, float((high.hi[:, i] - np.abs(r[a : a + 100_000, i])).min()))
    return worst


def _half_widths(data: Mapping[str, Any]) -> list[Interval]:
    """Per axis, the largest distance from a point of Z to the nearest grid coordinate."""
    out = []
    for lo, hi, n in zip(data["domain"]["low"], data["domain"]["high"], data["cover"], strict=True):
        p = lo + (hi - lo) * (2 * np.arange(n) + 1) / (2 * n)
        between = Interval.exact(p[1:]) - p[:-1]
        ends = [Interval.exact(p[0]) - lo, Interval.exact(hi) - float(p[-1])]
        inner = [Interval(np.asarray(between.lo.max()), np.asarray(between.hi.max())) * 0.5] if n > 1 else []
        out.append(
            Interval(np.asarray(max(float(x.lo) for x in ends + inner)), np.asarray(max(float(x.hi) for x in ends + inner)))
        )
    return out


def _norm(parts: list[Interval]) -> Interval:
    total = Interval.exact(0.0)
    for part in parts:
        total = total + part * part
    return Interval(np.sqrt(np.maximum(np.nextafter(total.lo, -np.inf), 0)), np.nextafter(np.sqrt(total.hi), np.inf))


def _own_slope(e: Evidence, i: int) -> Interval:
    """L₁ of Σ_l w_l p_l: the norm over axes of Σ_l |w_l| sup |∂_j p_l|; zero for a constant."""
    if e.data["form"]["form"] != "basis":
        return Interval.exact(0.0)
    low, high = np.asarray(e.data["domain"]["low"]), np.asarray(e.data["domain"]["high"])
    slopes = [Interval.exact(0.0) for _ in low]
    for k, factors in enumerate(e.data["form"]["functions"]):
        weight = abs(Interval.exact(e.arrays["gap.weights"][i, k]))
        for j in range(len(low)):
            slopes[j] = slopes[j] + weight * _partial(factors, j, low, high)
    return _norm(slopes)


def _partial(factors: list[Any], j: int, low: Array, high: Array) -> Interval:
    """sup over the box of |∂_j Π factors|, by the product rule with each factor at its largest."""
    total = Interval.exact(0.0)
    for k, (axis, kind, number) in enumerate(factors):
        if axis != j:
            continue
        term = Interval.exact(_slope(kind, number, Interval(low[axis], high[axis])))
        for m, (other, kind_m, number_m) in enumerate(factors):
            if m != k:
                term = term * Interval.exact(_factor(kind_m, number_m, Interval(low[other], high[other])).mag)
        total = total + term
    return total


def _slope(kind: str, number: float, x: Interval) -> float:
    """sup |d factor / dx| over x: n |x|^(n−1) for powers, |a cos(a x)| for sin, |a sin(a x)| for cos."""
    if kind in ("power", "abs"):
        return float((abs(x) ** int(number - 1) * number).hi) if number >= 1 else 0.0
    inner = x * float(number)
    return float(abs((inner.cos() if kind == "sin" else inner.sin()) * float(number)).hi)


def _drawn(e: Evidence) -> str:
    z, _ = e.audit
    low, high = np.asarray(e.data["domain"]["low"]), np.asarray(e.data["domain"]["high"])
    rng = np.random.default_rng([e.data["seed"], e.data["audit"]["number"]])
    return (
        "" if np.array_equal(z, low + (high - low) * rng.random(z.shape)) else "other points were audited than (seed, k) draws"
    )


def _enough(e: Evidence) -> str:
    """(1 − ε)^N ≤ β / 2^k, in logarithms with a slack far above their rounding."""
    a = e.data["audit"]
    z, _ = e.audit
    left, right = len(z) * math.log1p(-a["epsilon"]), math.log(a["beta"]) - a["number"] * math.log(2)
    if len(z) != a["points"]:
        return f"{len(z)} points are stored, {a['points']} are stated"
    return "" if left <= right + 1e-9 * abs(right) else f"{len(z)} points do not give ε = {a['epsilon']:g} at β_k"


def _audit(e: Evidence) -> str:
    """The stated number of violations is neither hidden nor invented: counted with the bounds' outer and inner ends."""
    _, r = e.audit
    low, high = e.audited
    certain = int(((r < low.lo) | (r > high.hi)).any(axis=1).sum())
    # The stored function was rounded outwards by a few ulp; points between the two ends may count either way.
    slack = 64 * np.spacing(np.maximum(np.abs(low.lo), np.abs(high.hi)))
    possible = int(((r < low.hi + slack) | (r > high.lo - slack)).any(axis=1).sum())
    stated = e.data["audit"]["violations"]
    return "" if certain <= stated <= possible else f"{certain} points lie outside for certain; {stated} were stated"


def _figures(e: Evidence) -> str:
    """Means over the audit's points agree with what is stated, to 1e-9 relative; tightness is their ratio."""
    _, r = e.audit
    low, high = e.audited
    gamma = np.maximum(np.abs(low.lo), np.abs(high.hi)).mean(axis=0)
    gap = np.abs(r).mean(axis=0)
    for i, name in enumerate(e.data["domain"]["axes"][: e.data["domain"]["states"]]):
        s = e.data["states"][name]
        pairs = [("gap_mean", float(gap[i])), ("gamma_mean", float(gamma[i]))]
        if "tightness" in s:
            pairs.append(("tightness", float(gamma[i] / gap[i])))
        for key, value in pairs:
            if abs(s[key] - value) > 1e-9 * abs(value) + 1e-300:
                return f"{name}.{key} is stated as {s[key]:.12g} and follows as {value:.12g}"
        if s["resolved"] != bool(gap[i] >= 10 * e.arrays["resolution"][i]):
            return f"{name}.resolved is stated wrongly"
    return ""


def _claim(e: Evidence) -> str:
    kind, provenance = e.data["claim"]["kind"], e.data["lipschitz"]["provenance"]
    if kind == "deterministic" and provenance == "estimated":
        return "a deterministic claim rests on estimated constants"
    refuted = e.data["audit"]["violations"] or e.data.get("attack", {}).get("violations", 0) or _consistent(e)
    if kind != "empirical" and refuted:
        return f"a {kind} claim is refuted by its own evidence"
    if kind == "statistical" and (e.data["claim"]["epsilon"], e.data["claim"]["beta"]) != (
        e.data["audit"]["epsilon"],
        e.data["audit"]["beta"],
    ):
        return "the claim states another ε or β than its audit"
    return ""
