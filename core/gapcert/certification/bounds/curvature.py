"""Curvature of a remainder: what nodes say against it, what is said of it, and a warning where there is none."""

from __future__ import annotations

from typing import Any

import numpy as np

from gapcert.contracts.gaps.gap import GapFunction, GapProblem
from gapcert.contracts.gaps.lipschitz import LipschitzBound
from gapcert.numerics.interpolation import on_curvature


def second(problem: GapProblem) -> dict[str, Any] | None:
    """Three neighbouring nodes whose slopes differ by more than (H a + H′ b) / 2 + 4 e / min(a, b); None if there are none.

    The two slopes, over gaps a and b, differ by the integral of ∂²g times a hat of height 1 over both gaps, which is at most
    H a / 2 + H′ b / 2 where |∂²g| ≤ H and H′ there; each of the three values errs by at most e.
    """
    axes, bound = problem.samples.lattice, problem.lipschitz
    if axes is None or bound.curvature is None:
        return None
    counts = [len(a) for a in axes]
    size = int(np.prod(counts))
    z, g = problem.samples.z[-size:], problem.remainder[-size:].reshape(*counts, -1)
    worst: dict[str, Any] | None = None
    for j, a in enumerate(axes):
        if len(a) < 3:
            continue
        values, gaps = np.moveaxis(g, j, 0), np.diff(a).reshape(-1, *(1,) * len(axes))
        slope = np.diff(values, axis=0) / gaps
        bent = bound.bend(j, a).T.reshape(len(a) - 1, *(1,) * (len(axes) - 1), -1) * gaps
        allowed = (bent[1:] + bent[:-1]) / 2 + 4 * problem.remainder_resolution / gaps.min()
        excess = np.abs(np.diff(slope, axis=0)) - allowed * (1 + 1e-9)
        at = np.unravel_index(int(np.argmax(excess)), excess.shape)
        if excess[at] > (worst["excess"] if worst else 0.0):
            points = np.moveaxis(z.reshape(*counts, -1), j, 0)
            first, last = points[(at[0], *at[1:-1])], points[(at[0] + 2, *at[1:-1])]
            worst = {"state": int(at[-1]), "z": first.tolist(), "other": last.tolist(), "excess": float(excess[at])}
    return worst


def refuted(problem: GapProblem, gap: GapFunction) -> dict[str, Any] | None:
    """`second`, where the gap function rests on curvature."""
    return second(problem) if on_curvature(gap.form) else None


def sentences(problem: GapProblem, gap: GapFunction) -> list[str]:
    """What a gap function assumes of curvature."""
    h = problem.lipschitz.curvature
    if not on_curvature(gap.form) or h is None:
        return []
    origin = {
        "estimated": "estimated",
        "declared": "declared and taken on trust",
        "interval": "proved by interval arithmetic from the equations of both systems",
    }.get(problem.lipschitz.provenance, problem.lipschitz.provenance)
    bare = [s.name for s, row in zip(problem.domain.axes, h, strict=False) if np.isinf(row).any()]
    known = problem.lipschitz.provenance == "interval"  # then kinks have no curvature
    rest = f"; where none is known ({', '.join(bare)}) it rests on the Lipschitz constants instead" if bare else ""
    return [
        f"The band rests on bounds of the second derivative of g = r − p along each axis on Z, with a first derivative that is "
        f"Lipschitz there (C¹·¹); they are {origin}{rest}."
        + ("" if known else " At a kink or a jump that they do not show, it is no bound.")
    ]


def kinks(bound: LipschitzBound) -> str | None:
    """Of the sweep of second differences, what has no curvature, as a sentence."""
    found = [
        s for s in bound.diagnostics.get("curvature", ()) if s["kind"] in ("kink", "noise", "unresolved") and not s["inert"]
    ]
    if not found:
        return None
    names = ", ".join(f"{s['state']} along {s['axis']} ({s['kind']})" for s in found)
    return (
        f"Second differences do not settle as the distance shrinks: {names}. No curvature is used there; a bound along these "
        f"axes rests on the Lipschitz constants."
    )
