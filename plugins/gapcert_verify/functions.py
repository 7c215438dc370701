"""Functions of a saved certificate, made again from its data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from gapcert.plugin import Array, Interval, UsageError, Zone
from gapcert_functions import Function, Table, WeightedSum
from gapcert_networks import Network, proved_balanced

Arrays = Mapping[str, Array]


def function(data: Mapping[str, Any], arrays: Arrays, prefix: str) -> Function:
    """From what `Function.data` and, under names with the prefix, `Function.arrays` hold."""
    own = {k[len(prefix) :]: v for k, v in arrays.items() if k.startswith(prefix)}
    if data["kind"] == Network.kind:
        return Network.stored(data, own)
    if data["kind"] == WeightedSum.kind:
        return WeightedSum.stored(data, own)
    raise UsageError(f"the certificate's functions are of kind {data['kind']!r}, which is not known")


def sides(form: Mapping[str, Any], arrays: Arrays, zone: Zone) -> tuple[Function, Function]:
    """The lower and the upper function of form `dominating`; ValueError unless both are bounded on the domain's box."""
    lower, upper = (function(form[name], arrays, f"gap.{name}.") for name in ("lower", "upper"))
    box, nx = Interval(np.asarray(zone.low)[None], np.asarray(zone.high)[None]), len(arrays["lipschitz"])
    if any(q.n_out != nx for q in (lower, upper)):
        raise ValueError(f"a stored function has {lower.n_out} or {upper.n_out} outputs for {nx} states")
    if not all(np.isfinite(q.rounding(box)).all() for q in (lower, upper)):
        raise ValueError("a stored function is unbounded on the domain, or not defined there")
    return lower, upper


def table(arrays: Arrays, zone: Zone) -> Table:
    """Its table; ValueError unless its cells tile the domain's box."""
    edges = tuple(arrays[f"gap.edges{j}"] for j in range(len(zone.low)))
    for own, low, high in zip(edges, zone.low, zone.high, strict=True):
        if not ((np.diff(own) > 0).all() and own[0] <= low and own[-1] >= high):
            raise ValueError("the table's edges do not tile the domain")
    return Table(edges)


def dominating(form: Mapping[str, Any], arrays: Arrays, zone: Zone, z: Array, p: Interval) -> tuple[Interval, Interval]:
    """(l, u) at points z, each as an interval that contains the exact value p + q ∓ shift."""
    cell, points, (low, high) = table(arrays, zone).locate(z), Interval.exact(z), arrays["gap.shifts"]
    lower, upper = sides(form, arrays, zone)
    return p + lower.over(points) - low[:, cell].T, p + upper.over(points) + high[:, cell].T


def own_constant(form: Mapping[str, Any], arrays: Arrays, i: int) -> float:
    """A constant of output i of form `network` in the Euclidean norm, proved by the stored multipliers; ∞ where they do not."""
    q = network(form, arrays)
    weights = [*q.weights[:-1], q.weights[-1][i : i + 1]]
    multipliers = [arrays[f"gap.multipliers{i}.{k}"] for k in range(len(weights) - 1)]
    found = proved_balanced(weights, multipliers, float(arrays["gap.squares"][i]), q.exponent)
    return np.inf if found is None else found


def network(form: Mapping[str, Any], arrays: Arrays) -> Network:
    """q of form `network`; ValueError unless it has one output for each state."""
    q, nx = function(form["q"], arrays, "gap.q."), len(arrays["lipschitz"])
    # An output too few would serve several states, and its constant would be sought beyond the last weights.
    if not isinstance(q, Network) or q.n_out != nx:
        raise ValueError(f"the stored function is no network with {nx} outputs")
    return q
