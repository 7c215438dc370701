"""Functions of a saved certificate, made again from its data; and the proof that they contain its envelope."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gapcert.plugin import Array, Interval, UsageError, on_curvature
from gapcert_functions import Band, Cones, Function, Part, Side, Table, WeightedSum, lift
from gapcert_networks import Network, proved_balanced

from .evidence import Evidence
from .multilinear import follows, nodes

_BATCH, _MOST = 8192, 4_000_000  # boxes beyond those of the first proof, which is repeated as it was, and in all


def function(data: Mapping[str, Any], arrays: Mapping[str, Array], prefix: str) -> Function:
    """From what `Function.data` and, under names with the prefix, `Function.arrays` hold."""
    own = {k[len(prefix) :]: v for k, v in arrays.items() if k.startswith(prefix)}
    if data["kind"] == Network.kind:
        return Network.stored(data, own)
    if data["kind"] == WeightedSum.kind:
        return WeightedSum.stored(data, own)
    raise UsageError(f"the certificate's functions are of kind {data['kind']!r}, which is not known")


def sides(e: Evidence) -> tuple[Function, Function]:
    """The lower and the upper function of form `dominating`; ValueError unless both are bounded on the domain's box."""
    lower, upper = (function(e.data["form"][name], e.arrays, f"gap.{name}.") for name in ("lower", "upper"))
    box, nx = Interval(np.asarray(e.zone.low)[None], np.asarray(e.zone.high)[None]), len(e.arrays["lipschitz"])
    if any(q.n_out != nx for q in (lower, upper)):
        raise ValueError(f"a stored function has {lower.n_out} or {upper.n_out} outputs for {nx} states")
    if not all(np.isfinite(q.rounding(box)).all() for q in (lower, upper)):
        raise ValueError("a stored function is unbounded on the domain, or not defined there")
    return lower, upper


def table(e: Evidence) -> Table:
    """Its table; ValueError unless its cells tile the domain's box."""
    edges = tuple(e.arrays[f"gap.edges{j}"] for j in range(len(e.zone.low)))
    for own, low, high in zip(edges, e.zone.low, e.zone.high, strict=True):
        if not ((np.diff(own) > 0).all() and own[0] <= low and own[-1] >= high):
            raise ValueError("the table's edges do not tile the domain")
    return Table(edges)


def dominating(e: Evidence, z: Array, p: Interval) -> tuple[Interval, Interval]:
    """(l, u) at points z, each as an interval that contains the exact value p + q ∓ shift."""
    cell, points, (low, high) = table(e).locate(z), Interval.exact(z), e.arrays["gap.shifts"]
    lower, upper = sides(e)
    return p + lower.over(points) - low[:, cell].T, p + upper.over(points) + high[:, cell].T


def network(e: Evidence, z: Array) -> Interval:
    """γ_i(z) = max(0, q_i(z) + margin_i) of form `network`."""
    q = _network(e)
    return (q.over(Interval.exact(z)) + e.arrays["gap.margin"]).maximum(0.0)


def own_constant(e: Evidence, i: int) -> float:
    """A constant of output i of form `network` in the Euclidean norm, proved by the stored multipliers; ∞ where they do not."""
    q = _network(e)
    weights = [*q.weights[:-1], q.weights[-1][i : i + 1]]
    multipliers = [e.arrays[f"gap.multipliers{i}.{k}"] for k in range(len(weights) - 1)]
    found = proved_balanced(weights, multipliers, float(e.arrays["gap.squares"][i]), q.exponent)
    return np.inf if found is None else found


def _network(e: Evidence) -> Network:
    q, nx = function(e.data["form"]["q"], e.arrays, "gap.q."), len(e.arrays["lipschitz"])
    # An output too few would serve several states, and its constant would be sought beyond the last weights.
    if not isinstance(q, Network) or q.n_out != nx:
        raise ValueError(f"the stored function is no network with {nx} outputs")
    return q


def dominates(e: Evidence) -> str:
    """ "" where branch and bound proves that both functions with their shifts contain the envelope on Z."""
    if on_curvature(e.data["form"]) and (text := follows(e)):
        return text
    cells, shifts = table(e), e.arrays["gap.shifts"]
    if shifts.shape != (2, len(e.arrays["lipschitz"]), len(cells)) or not np.isfinite(shifts).all():
        return f"there are shifts of shape {shifts.shape} for {len(cells)} cells, or some are not finite"
    for k, q in enumerate(sides(e)):
        sign = 1 if k else -1
        for i, known in enumerate(shifts[k]):
            budget = min(int(e.arrays["gap.boxes"][k, i]) + _BATCH, _MOST)
            found = lift(Side(_parts(e, i, sign), q, i, sign), cells, e.zone, 0.0, budget, known)
            if not (found.shift <= known).all():
                c = int(np.argmax(found.shift - known))
                end = "above the lower" if sign < 0 else "below the upper"
                return f"state {i}: in cell {c} of the table the envelope was not proved to lie {end} function"
    return ""


def _parts(e: Evidence, i: int, sign: int) -> Sequence[Part]:
    if on_curvature(e.data["form"]):
        axes, whole = nodes(e, "gap"), e.parts[0]
        counts = [len(a) for a in axes]
        g = whole.g[-int(np.prod(counts)) :, i].reshape(*counts)
        bends = [e.arrays[f"gap.H{j}"][i] for j in range(len(axes))]
        g, slack = g if sign > 0 else -g, float(whole.slack.hi[i])
        return [Band.of(whole.box, axes, g, bends, whole.constants[i], slack)]
    made = []
    for part in e.parts:
        ends = part.g[:, i].hi if sign > 0 else -part.g[:, i].lo
        made.append(Cones(part.box, part.z, ends, part.constants[i], float(part.slack.hi[i])))
    return made
