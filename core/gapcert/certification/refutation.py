"""What samples say against constants: pairs and bends that contradict them, and slopes that grow as the distance shrinks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.gaps.gap import GapFunction, GapProblem
from gapcert.contracts.gaps.lipschitz import LipschitzBound, LipschitzProblem
from gapcert.contracts.gaps.predictor import Samples
from gapcert.contracts.plugins.events import Emit, Event, silent
from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.system import StateSpec
from gapcert.numerics.arrays import Array, Bools, Ints
from gapcert.numerics.interpolation import on_curvature
from gapcert.numerics.order_statistics import NO_CONSTANTS

_PAIRS = 100_000  # that are looked at together
ADVICE = "use lipschitz.residual: {kind: piecewise}"


def contradiction(
    problem: GapProblem, most: int = 2_000, suspects: Ints | None = None, noise: int = 2
) -> dict[str, Any] | None:
    """Two samples with |g_i − g′_i| > Σ_j L_ij |z_j − z′_j| + J_i + 2 e_i, which refute the constants; None if there are none.

    All pairs of up to `most` samples are looked at (an even selection of them where there are more), of each closed cell where
    the constants hold per cell. Both computed remainders may err by their arithmetic's part of e, which counts twice more for
    that. Or pairs of some samples, the `suspects` (by number), with all others; by default as computed: what a band of 2 e
    cannot contain. `change` and `allowed` of the worst pair are what was found and what the constants allow.
    """
    z, r = problem.samples.z, problem.samples.r
    spread = problem.resolution - problem.arithmetic
    noise = 4 if suspects is None else noise
    slack = noise * problem.remainder_resolution - (noise - 2) * spread
    found = list[dict[str, Any] | None]()
    for rows, constants, jumps in _parts(problem.lipschitz, z):
        pick = rows[np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int)] if suspects is None else rows
        first = np.arange(len(pick)) if suspects is None else np.flatnonzero(np.isin(pick, suspects))
        found.append(_worst_pair(z[pick], r[pick] - problem.predictor(z[pick]), constants, jumps + slack, first))
    return max(filter(None, found), key=lambda pair: pair["excess"], default=None)


def _parts(bound: LipschitzBound, z: Array) -> Iterator[tuple[Any, Array, Array]]:
    """(rows of z, constants, jumps) of each closed cell, or of the whole domain."""
    if bound.cells is None:
        yield np.arange(len(z)), bound.value, np.zeros(len(bound.value))
        return
    for c, rows in enumerate(bound.cells.closures(z)):
        yield rows, bound.cells.constants[c], bound.cells.jumps[c]


def _worst_pair(z: Array, g: Array, constants: Array, slack: Array, first: Ints) -> dict[str, Any] | None:
    """Among the pairs that begin with a row of `first`."""
    worst: dict[str, Any] | None = None
    block, finite = max(1, _PAIRS // max(1, len(z))), np.minimum(constants, 1e300)
    for a in range(0, len(first), block):
        rows = first[a : a + block]
        allowed, change = np.abs(z[rows, None] - z[None]) @ finite.T, np.abs(g[rows, None] - g[None])
        excess = change - (allowed + slack) * (1 + 1e-12)
        at = k, m, i = np.unravel_index(int(np.argmax(excess)), excess.shape)
        if excess[at] > (worst["excess"] if worst else 0.0):
            worst = {"state": int(i), "z": z[rows[k]].tolist(), "other": z[m].tolist(), "excess": float(excess[at])}
            worst |= {"change": float(change[at]), "allowed": float(allowed[at] + slack[i])}
    return worst


def curvature_contradiction(problem: GapProblem) -> dict[str, Any] | None:
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


@final
@dataclass(frozen=True)
class Trails:
    """Where the steepest part of each segment lies: ends z (n, 2, nz) and g (n, 2, nx) of the last, shortest part.

    slope (n, k): |Δg_state| over the length, relative to the first segment's length, after each step; NaN once a trail ended.
    settled (n,): ended at a slope that is allowed, `enough`. `queried` counts transitions.
    """

    z: Array
    g: Array
    state: Ints
    slope: Array
    settled: Bools
    queried: int

    @property
    def change(self) -> Array:
        """(n, nx) |Δg| over the last part."""
        return np.asarray(np.abs(self.g[:, 1] - self.g[:, 0]))

    @property
    def steps(self) -> Ints:
        """(n,) how often each was shortened by four."""
        return np.asarray(np.isfinite(self.slope).sum(axis=1) - 1)

    @property
    def growing(self) -> Bools:
        """(n,) where the slope grew in each of the last two steps, threefold in both: a jump has 16, a slope 1."""
        last, rows = self.steps, np.arange(len(self.slope))
        end, middle, before = (self.slope[rows, np.maximum(last - k, 0)] for k in range(3))
        lately = (end >= 1.5 * middle) & (middle >= 1.5 * before) & (end >= 3 * before)
        return np.asarray((last >= 2) & lately & (end >= 4 * self.slope[:, 0]) & ~self.settled)


def follow(
    query: Callable[[int, Array], Array],
    z: Array,
    g: Array,
    state: Ints,
    noise: Array,
    steps: int | Ints,
    enough: Array | None = None,
) -> Trails:
    """Cut segments z (n, 2, nz) with remainders g (n, 2, nx) in four and go on with the quarter in which g_state changes most.

    query(k, points) returns g at the points of step k; noise (nx,) is what arithmetic alone may change g by; `steps` limits
    each trail, which ends before where the change drowns in the noise, or, after two steps, where the slope is at most `enough`
    (n,): a change that is allowed over the whole segment.
    """
    z, g, rows, queried = z.copy(), g.copy(), np.arange(len(z)), 0
    most = np.broadcast_to(np.asarray(steps), (len(z),))
    slope = np.full((len(z), int(most.max(initial=0)) + 1), np.nan)
    slope[:, 0] = np.abs(g[rows, 1, state] - g[rows, 0, state])
    settled = np.zeros(len(z), dtype=bool)
    t = (np.arange(1, THRESHOLDS.trail_parts) / THRESHOLDS.trail_parts)[:, None]
    for k in range(slope.shape[1] - 1):
        rows = rows[most[rows] > k]
        if not len(rows):
            break
        a, b = z[rows, :1], z[rows, 1:]
        inner = np.clip(a * (1 - t) + b * t, np.minimum(a, b), np.maximum(a, b))
        values = query(k, inner.reshape(-1, z.shape[2])).reshape(len(rows), THRESHOLDS.trail_parts - 1, -1)
        queried += inner.shape[0] * inner.shape[1]
        at = np.concatenate([g[rows, :1], values, g[rows, 1:]], axis=1)
        points = np.concatenate([a, inner, b], axis=1)
        each, own = np.arange(len(rows)), state[rows]
        change = np.abs(np.diff(at[each, :, own], axis=1))
        best = change.argmax(axis=1)
        most_change = change[each, best]
        clear = (most_change > THRESHOLDS.trail_clear * noise[own]) & (points[each, best] != points[each, best + 1]).any(axis=1)
        rows, each, best, most_change = rows[clear], each[clear], best[clear], most_change[clear]
        z[rows] = np.stack([points[each, best], points[each, best + 1]], axis=1)
        g[rows] = np.stack([at[each, best], at[each, best + 1]], axis=1)
        slope[rows, k + 1] = most_change * float(THRESHOLDS.trail_parts) ** (k + 1)
        if enough is not None and k > 0:
            settled[rows] = slope[rows, k + 1] <= enough[rows]
            rows = rows[~settled[rows]]
    return Trails(z, g, state, slope, settled, queried)


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
    segments, state = _steepest(z, samples.r[pick] - problem.predictor(z), bound.value)
    if bound.steep is not None:
        nx, k = bound.steep.shape[:2]
        segments = np.concatenate([segments, bound.steep.reshape(nx * k, 2, -1)])
        state = np.concatenate([state, np.repeat(np.arange(nx), k)])
    noise = 4 * (problem.resolution + problem.predictor.resolution(problem.domain))
    found, spent = growth(problem.remainder, problem.domain, segments, state, noise)
    diagnostics = dict(bound.diagnostics) | ({} if found is None else {"growth": found})
    bound = replace(bound, samples=bound.samples + spent, diagnostics=diagnostics)
    for warning in warnings(bound, problem.domain.axes):
        emit(Event("warning", "lipschitz", {"message": warning}))
    return bound


def _steepest(z: Array, g: Array, constants: Array, most: int = 4) -> tuple[Array, Ints]:
    """Segments (n, 2, nz) and their states (n,): per state the pairs of samples that use most of what the constants allow."""
    upper = np.triu_indices(len(z), 1)
    apart = np.abs(z[upper[0]] - z[upper[1]])
    segments, states = [], []
    for i in range(g.shape[1]):
        allowed = apart @ constants[i]
        used = np.abs(g[upper[0], i] - g[upper[1], i]) / np.maximum(allowed, np.finfo(float).tiny)
        for k in np.argsort(-used, kind="stable")[:most]:
            segments.append(z[[upper[0][k], upper[1][k]]])
            states.append(i)
    return np.array(segments).reshape(-1, 2, z.shape[1]), np.array(states, dtype=np.intp)


def _along_axes(segments: Array, domain: Domain) -> tuple[Array, Ints]:
    """Each segment (n, 2, nz) as the steps of a staircase, one axis after the other: (m, 2, nz), and whose each step is."""
    steps, owner = [], []
    for k, (a, b) in enumerate(segments):
        corner = a
        for j in np.flatnonzero(a != b):
            after = corner.copy()
            after[j] = b[j]
            if domain.contains(np.stack([corner, after])).all():
                steps.append((corner, after))
                owner.append(k)
            corner = after
    return np.array(steps).reshape(-1, 2, segments.shape[2]), np.array(owner, dtype=np.intp)


def growth(
    remainder: Callable[[str, Array], Array], domain: Domain, segments: Array, state: Ints, noise: Array, steps: int = 8
) -> tuple[dict[str, Any] | None, int]:
    """The largest jump on the way from one end of a segment to the other, or None where all settled, and transitions spent.

    remainder(name, z) returns g; every segment is followed for its own state along each of the axes that it crosses.
    """
    stairs, owner = _along_axes(segments, domain)
    if not len(stairs):
        return None, 0
    ends = remainder("growth-ends", stairs.reshape(-1, stairs.shape[2])).reshape(len(stairs), 2, -1)
    t = follow(lambda k, z: remainder(f"growth-{k}", z), stairs, ends, state[owner], noise, steps)
    rows = np.arange(len(stairs))
    size = np.where(t.growing, t.change[rows, t.state] / np.maximum(noise[t.state], np.finfo(float).tiny), 0.0)
    spent = 2 * len(stairs) + t.queried
    if not size.any():
        return None, spent
    k = int(size.argmax())
    i, j = int(t.state[k]), int(np.flatnonzero(stairs[k, 0] != stairs[k, 1])[0])
    lengths = [float(np.abs(s[k, 1, j] - s[k, 0, j])) for s in (stairs, t.z)]
    changes = [float(np.abs(e[k, 1, i] - e[k, 0, i])) for e in (ends, t.g)]
    found = {"state": i, "axis": j, "where": t.z[k].mean(axis=0).tolist(), "size": changes[1]}
    return {**found, "distances": lengths, "slopes": [c / n for c, n in zip(changes, lengths, strict=True)]}, spent


def warnings(bound: LipschitzBound, axes: Sequence[StateSpec]) -> list[str]:
    """What a reader of the constants is told: slopes that grew, and second differences that do not settle."""
    return [w for w in (growth_warning(bound, axes), kinks(bound)) if w is not None]


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
    (s0, s1), (d0, d1), at = found["slopes"], found["distances"], dict(zip((a.name for a in axes), found["where"], strict=True))
    return (
        f"The slope of {state.name} along {axis.name} grew from {s0:.3g} to {s1:.3g} as the distance shrank from {d0:.2g} to "
        f"{d1:.2g}{_unit(axis)} at {_named(at)}: f̂ − f seems to jump there, by "
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


def jump_sentence(bound: LipschitzBound, axes: Sequence[StateSpec], but: str = "") -> str | None:
    """How many cells there are, how many are marked, and the largest jump of each state; None for global constants."""
    if (cells := bound.cells) is None:
        return None
    many, marked = len(cells), int(cells.marked.sum())
    head = f"The constants hold per cell, of {many} that tile the domain"
    if not marked and bound.provenance == "interval":
        return f"{head}; they were proved in each of them{but}."
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


def curvature_sentences(problem: GapProblem, gap: GapFunction) -> list[str]:
    """What a gap function assumes of curvature."""
    h = problem.lipschitz.curvature
    if not on_curvature(gap.form) or h is None:
        return []
    but = "" if problem.symmetry is None else problem.symmetry.exception
    origin = {
        "estimated": "estimated",
        "declared": "declared and taken on trust",
        "interval": f"proved by interval arithmetic from the equations of both systems{but}",
    }.get(problem.lipschitz.provenance, problem.lipschitz.provenance)
    bare = [s.name for s, row in zip(problem.domain.axes, h, strict=False) if np.isinf(row).any()]
    known = problem.lipschitz.provenance == "interval"  # then kinks have no curvature
    rest = f"; where none is known ({', '.join(bare)}) it rests on the Lipschitz constants instead" if bare else ""
    return [
        f"The band rests on bounds of the second derivative of g = r − p along each axis on Z, with a first derivative that is "
        f"Lipschitz there (C¹·¹); they are {origin}{rest}."
        + ("" if known else " At a kink or a jump that they do not show, it is no bound.")
    ]


def _unit(axis: StateSpec) -> str:
    return "" if axis.unit == "1" else f" {axis.unit}"


def _named(where: dict[str, float]) -> str:
    return "(" + ", ".join(f"{name} = {value:.4g}" for name, value in where.items()) + ")"
