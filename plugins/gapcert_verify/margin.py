"""The margin of route theorem1 in a saved certificate, recomputed from its grid, constants and weights."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from gapcert.plugin import Array, Interval, lattice

from .evidence import Evidence, bounds, factor, written, zone
from .functions import own_constant


def margin(e: Evidence) -> str | None:
    """Route theorem1: margin ≥ L₁ √(εx² + εu²) + L₂x εx + L₂u εu + 2 e, all recomputed from grid, constants and weights."""
    if e.data["route"] != "theorem1":
        return None
    if e.data["predictor"] != "none":
        return "the margin bounds r itself, and a predictor is stated"
    if e.data["cover"] is None or not e.covers():
        return "the samples are not the grid that the certificate states"
    if "cells.L" in e.arrays and (e.arrays["cells.J"].any() or (e.arrays["cells.L"] > e.arrays["lipschitz"]).any()):
        return "something jumps, or the constants are not those of the worst cell"
    nx, constants = e.data["domain"]["states"], e.arrays["lipschitz"]
    if nx != len(constants):
        return f"{nx} states are stated, and there are constants of {len(constants)}"
    if e.reduced and e.data["form"]["form"] != "constant":
        return "only extremes of coarse cells are stored, which say nothing of a bound that is no constant"
    h, whole = _half_widths(e.data), _half_widths(e.data)
    for j in np.flatnonzero((constants == 0).all(axis=0)):
        h[j] = Interval.exact(0.0)  # g does not change along it
    involved = set().union(*(_involved(data) for data in e.data["form"].get("functions", ())))
    if e.data["form"]["form"] == "network":
        involved = set(np.flatnonzero(e.arrays["gap.q.W0"].any(axis=0)).tolist())
    ex, eu = _norm([h[j] for j in range(nx)]), _norm([h[j] for j in range(nx, len(h))])
    joint = _norm([whole[j] for j in sorted(involved)])
    z, r = e.samples
    for i in range(len(constants)):
        lx = _norm([Interval.exact(c) for c in constants[i, :nx]])
        lu = _norm([Interval.exact(c) for c in constants[i, nx:]])
        l1 = _own_slope(e, i)
        need = l1 * joint + lx * ex + lu * eu + Interval.exact(e.arrays["resolution"][i]) * 2.0
        if not math.isfinite(need.hi):  # its lower end says nothing then
            return f"state {i}: no constant of the stored function is proved, and no margin is enough"
        have = _clearance(e, i, z, r)
        if not have >= float(need.lo):
            return f"state {i}: γ clears the samples by {have:.6g}, and {float(need.lo):.6g} is needed"
    return ""


def radii(e: Evidence) -> tuple[float, float]:
    """(εx, εu) of the stated grid, rounded up."""
    h, nx = _half_widths(e.data), e.data["domain"]["states"]
    return float(_norm(h[:nx]).hi), float(_norm(h[nx:]).hi)


def reach(e: Evidence) -> Array:
    """(nx,) L₂x εx + L₂u εu + 2 e, rounded up: what data alone leave between two points of the cover."""
    h, nx, constants = _half_widths(e.data), e.data["domain"]["states"], e.arrays["lipschitz"]
    h = [Interval.exact(0.0) if (constants[:, j] == 0).all() else h[j] for j in range(len(h))]
    ex, eu = _norm(h[:nx]), _norm(h[nx:])
    parts = [[_norm([Interval.exact(c) for c in row[part]]) for part in (slice(nx), slice(nx, None))] for row in constants]
    both = [x * ex + u * eu + Interval.exact(d) * 2.0 for (x, u), d in zip(parts, e.arrays["resolution"], strict=True)]
    return np.array([float(total.hi) for total in both])


def _clearance(e: Evidence, i: int, z: Array, r: Array) -> float:
    """min_k γ_i(z_k) − |r_ki|, from below."""
    worst = math.inf
    for a in range(0, len(z), 100_000):
        _, high = bounds(e, z[a : a + 100_000], "")
        worst = min(worst, float((high.hi[:, i] - np.abs(r[a : a + 100_000, i])).min()))
    return worst


def _half_widths(data: Mapping[str, Any]) -> list[Interval]:
    """Per axis, the largest distance from a point of Z to the nearest grid coordinate; where relations cut cells, that from
    any point of a cell to the cell's point, wherever it was moved to: cells that are left out do not meet Z.
    """
    out = []
    for lo, hi, n in zip(data["domain"]["low"], data["domain"]["high"], data["cover"], strict=True):
        p = lo + (hi - lo) * (2 * np.arange(n) + 1) / (2 * n)
        between = Interval.exact(p[1:]) - p[:-1]
        ends = [Interval.exact(p[0]) - lo, Interval.exact(hi) - float(p[-1])]
        inner = [Interval(np.asarray(between.lo.max()), np.asarray(between.hi.max())) * 0.5] if n > 1 else []
        out.append(
            Interval(np.asarray(max(float(x.lo) for x in ends + inner)), np.asarray(max(float(x.hi) for x in ends + inner)))
        )
    cut = zone(data)
    for j, half in zip(cut.axes, lattice(cut, tuple(data["cover"])).half if cut.relations else (), strict=True):
        out[j] = Interval.exact(half)
    return out


def _norm(parts: list[Interval]) -> Interval:
    total = Interval.exact(0.0)
    for part in parts:
        total = total + part * part
    return Interval(np.sqrt(np.maximum(np.nextafter(total.lo, -np.inf), 0)), np.nextafter(np.sqrt(total.hi), np.inf))


def _own_slope(e: Evidence, i: int) -> Interval:
    """L₁ of Σ_l w_l p_l: the norm over axes of Σ_l |w_l| sup |∂_j p_l|; of a network, what its multipliers prove; zero for a
    constant.
    """
    if e.data["form"]["form"] == "network":
        return Interval.exact(own_constant(e.data["form"], e.arrays, i))
    if e.data["form"]["form"] != "basis":
        return Interval.exact(0.0)
    low, high = np.asarray(e.data["domain"]["low"]), np.asarray(e.data["domain"]["high"])
    slopes = [Interval.exact(0.0) for _ in low]
    for k, data in enumerate(e.data["form"]["functions"]):
        weight = abs(Interval.exact(e.arrays["gap.weights"][i, k]))
        for j in range(len(low)):
            slopes[j] = slopes[j] + weight * _partial(data, j, low, high)
    return _norm(slopes)


def _involved(data: Any) -> set[int]:
    """The axes of a basis function."""
    return {axis for axis, *_ in data} if (expression := written(data)) is None else expression.axes


def _partial(factors: list[Any], j: int, low: Array, high: Array) -> Interval:
    """sup over the box of |∂_j Π factors|, by the product rule with each factor at its largest; that of an expression, which
    has to be bounded there."""
    if (expression := written(factors)) is not None:
        box = Interval(low[None], high[None])
        finite = math.isfinite(expression.error(box))
        return Interval.exact(expression.derivative_over(box, j).mag[0] if finite else np.inf)
    total = Interval.exact(0.0)
    for k, (axis, kind, number) in enumerate(factors):
        if axis != j:
            continue
        term = Interval.exact(_slope(kind, number, Interval(low[axis], high[axis])))
        for m, (other, kind_m, number_m) in enumerate(factors):
            if m != k:
                term = term * Interval.exact(factor(kind_m, number_m, Interval(low[other], high[other])).mag)
        total = total + term
    return total


def _slope(kind: str, number: float, x: Interval) -> float:
    """sup |d factor / dx| over x: n |x|^(n−1) for powers, |a cos(a x)| for sin, |a sin(a x)| for cos."""
    if kind in ("power", "abs"):
        return float((abs(x) ** int(number - 1) * number).hi) if number >= 1 else 0.0
    inner = x * float(number)
    return float(abs((inner.cos() if kind == "sin" else inner.sin()) * float(number)).hi)
