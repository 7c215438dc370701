"""What samples say against constants: pairs that contradict them, and slopes that grow as the distance shrinks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from gapcert.certification.bounds.curvature import kinks
from gapcert.certification.bounds.slope_growth import growth, steepest
from gapcert.contracts.gaps.gap import GapProblem
from gapcert.contracts.gaps.lipschitz import LipschitzBound, LipschitzProblem
from gapcert.contracts.gaps.predictor import Samples
from gapcert.contracts.plugins.events import Emit, Event, silent
from gapcert.contracts.systems.system import StateSpec
from gapcert.numerics.arrays import Array
from gapcert.numerics.order_statistics import NO_CONSTANTS

_PAIRS = 1_000_000  # that are looked at together
ADVICE = "use lipschitz.residual: {kind: piecewise}"


def contradiction(
    problem: GapProblem, most: int = 2_000, suspects: npt.NDArray[np.intp] | None = None
) -> dict[str, Any] | None:
    """Two samples with |g_i − g′_i| > Σ_j L_ij |z_j − z′_j| + J_i + 2 e_i, which refute the constants; None if there are none.

    All pairs of up to `most` samples are looked at (an even selection of them where there are more), of each closed cell where
    the constants hold per cell. Both computed remainders may err by their arithmetic's part of e, which counts twice more for
    that. Or pairs of some samples, the `suspects` (by number), with all others, as computed: what a band of 2 e cannot contain.
    """
    z, r = problem.samples.z, problem.samples.r
    spread = problem.resolution - problem.arithmetic
    noise = 4 * problem.remainder_resolution - 2 * spread if suspects is None else 2 * problem.remainder_resolution
    worst: dict[str, Any] | None = None
    for rows, constants, jumps in _parts(problem.lipschitz, z):
        pick = rows[np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int)] if suspects is None else rows
        first = None if suspects is None else np.flatnonzero(np.isin(pick, suspects))
        found = _worst_pair(z[pick], r[pick] - problem.predictor(z[pick]), constants, jumps + noise, first)
        if found is not None and found["excess"] > (worst["excess"] if worst else 0.0):
            worst = found
    return worst


def _parts(bound: LipschitzBound, z: Array) -> Iterator[tuple[Any, Array, Array]]:
    """(rows of z, constants, jumps) of each closed cell, or of the whole domain."""
    if bound.cells is None:
        yield np.arange(len(z)), bound.value, np.zeros(len(bound.value))
        return
    for c, rows in enumerate(bound.cells.closures(z)):
        yield rows, bound.cells.constants[c], bound.cells.jumps[c]


def _worst_pair(z: Array, g: Array, constants: Array, slack: Array, first: Any = None) -> dict[str, Any] | None:
    """Among all pairs, or those that begin with a row of `first`."""
    worst: dict[str, Any] | None = None
    first = np.arange(len(z)) if first is None else first
    block = max(1, _PAIRS // max(1, len(z)))
    for i in range(g.shape[1] if len(z) else 0):
        for a in range(0, len(first), block):
            rows = first[a : a + block]
            allowed = (np.abs(z[rows, None] - z[None]) * constants[i]).sum(axis=2)
            excess = np.abs(g[rows, None, i] - g[None, :, i]) - allowed * (1 + 1e-12) - slack[i] * (1 + 1e-12)
            k, m = np.unravel_index(int(np.argmax(excess)), excess.shape)
            if excess[k, m] > (worst["excess"] if worst else 0.0):
                worst = {"state": i, "z": z[rows[k]].tolist(), "other": z[m].tolist(), "excess": float(excess[k, m])}
    return worst


def watched(
    problem: LipschitzProblem, bound: LipschitzBound, samples: Samples, emit: Emit = silent, among: int = 1_000
) -> LipschitzBound:
    """The bound, with `diagnostics["growth"]` where one constant cannot hold: some slope grows as the distance shrinks.

    The pairs of samples that come closest to what the constants allow are followed, and the steepest that the estimator saw.
    Proved constants are left alone, and so are those per cell, whose estimator looks for jumps itself; where none were
    looked for, there is nothing to follow.
    """
    if bound.cells is not None or bound.provenance in ("analytic", "interval") or bound.method == NO_CONSTANTS:
        return bound
    pick = np.linspace(0, len(samples) - 1, min(among, len(samples))).astype(int)
    z = samples.z[pick]
    segments, state = steepest(z, samples.r[pick] - problem.predictor(z), bound.value)
    if bound.steep is not None:
        nx, k = bound.steep.shape[:2]
        segments = np.concatenate([segments, bound.steep.reshape(nx * k, 2, -1)])
        state = np.concatenate([state, np.repeat(np.arange(nx), k)])
    noise = 4 * (problem.resolution + problem.predictor.resolution(problem.domain))
    found, spent = growth(problem.remainder, problem.domain, segments, state, noise)
    diagnostics = dict(bound.diagnostics) | ({} if found is None else {"growth": found})
    bound = replace(bound, samples=bound.samples + spent, diagnostics=diagnostics)
    if (warning := growth_warning(bound, problem.domain.axes)) is not None:
        emit(Event("warning", "lipschitz", {"message": warning}))
    if (warning := kinks(bound)) is not None:
        emit(Event("warning", "lipschitz", {"message": warning}))
    return bound


def growth_warning(bound: LipschitzBound, axes: Sequence[StateSpec]) -> str | None:
    """Where a slope grew, as a sentence, or what the estimator's sweep over distances says; None where slopes settle."""
    sweep = bound.diagnostics.get("sweep", ())
    if (found := bound.diagnostics.get("growth")) is None:
        return _sweep_warning(sweep, axes)
    state, axis = axes[found["state"]], axes[found["axis"]]
    # One steep pair cannot tell noise from a jump; the sweep, which looks at random pairs too, can.
    noise = [s for s in sweep if (s["state"], s["axis"], s["kind"]) == (state.name, axis.name, "noise")]
    if noise:
        return _sweep_warning(noise, axes)
    (s0, s1), (d0, d1) = found["slopes"], found["distances"]
    return (
        f"The slope of {state.name} along {axis.name} grew from {s0:.3g} to {s1:.3g} as the distance shrank from {d0:.2g} to "
        f"{d1:.2g}{_unit(axis)} at {_at(found['where'], axes)}: f̂ − f seems to jump there, by "
        f"{found['size']:.3g}{_unit(state)}, and no constant bounds a jump; {ADVICE}."
    )


def _sweep_warning(sweep: Sequence[Mapping[str, Any]], axes: Sequence[StateSpec]) -> str | None:
    """`diagnostics["sweep"]` is a list of {"state", "axis", "distances", "slopes", "kind"}: of its jump or its noise that grew
    most, a sentence."""
    grown = [s for s in sweep if s["kind"] in ("jump", "noise")]
    if not grown:
        return None
    worst = max(grown, key=lambda s: (s["kind"] == "jump", s["slopes"][-1] / max(s["slopes"][0], np.finfo(float).tiny)))
    unit = _unit(next(a for a in axes if a.name == worst["axis"]))
    (s0, *_, s1), (d0, *_, d1) = worst["slopes"], worst["distances"]
    means = {
        "jump": f"f̂ − f seems to jump there, and no constant bounds a jump; {ADVICE}",
        "noise": "of random pairs too, so f̂ − f seems to be noisy beyond its resolution, and the constants measure noise",
    }
    return (
        f"The slope of {worst['state']} along {worst['axis']} grew from {s0:.3g} to {s1:.3g} as the distance shrank from "
        f"{d0:.2g} to {d1:.2g}{unit}: {means[worst['kind']]}."
    )


def jump_sentence(bound: LipschitzBound, axes: Sequence[StateSpec]) -> str | None:
    """How many cells there are, how many are marked, and the largest jump of each state; None for global constants."""
    if (cells := bound.cells) is None:
        return None
    many, marked = len(cells), int(cells.marked.sum())
    head = f"The constants hold per cell, of {many} that tile the domain"
    if not marked and bound.provenance == "interval":
        return f"{head}; they were proved in each of them."
    if not marked:
        return f"{head}; none of them is marked: no slope grew as the distance shrank."
    units = {a.name: _unit(a) for a in axes}
    sizes = [f"{j['state']} by {j['size']:.3g}{units[j['state']]} at {_named(j['where'])}" for j in bound.largest_jumps(axes)]
    share = float(cells.volume[cells.marked].sum())
    return (
        f"{head}; {marked} of them ({100 * share:.2g} % of its volume) are marked: there f̂ − f jumps, which is bounded on both "
        f"sides by jumps as large as those measured times {bound.safety:g}, and nowhere else. Largest jumps: "
        f"{'; '.join(sizes)}."
    )


def _unit(axis: StateSpec) -> str:
    return "" if axis.unit == "1" else f" {axis.unit}"


def _named(where: dict[str, float]) -> str:
    return "(" + ", ".join(f"{name} = {value:.4g}" for name, value in where.items()) + ")"


def _at(where: Sequence[float], axes: Sequence[StateSpec]) -> str:
    return _named(dict(zip((a.name for a in axes), where, strict=True)))
