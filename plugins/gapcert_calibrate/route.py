"""Route calibrate: any gap function, moved outwards or inwards until fresh points say how often it fails.

The claim rests on an order statistic of scores (`order_statistics`) and on no constants: whatever the function is, it was fixed
before the points were drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, final

import numpy as np

from gapcert.plugin import (
    Array,
    Audit,
    Domain,
    Entry,
    Event,
    Findings,
    Fingerprint,
    GapFamily,
    GapFunction,
    GapProblem,
    Gate,
    Interval,
    Ledger,
    LipschitzBound,
    LipschitzEstimator,
    LipschitzProblem,
    Model,
    Points,
    Record,
    Request,
    Residual,
    Route,
    Store,
    System,
    UsageError,
    gap_digest,
    in_words,
    order_statistics,
)
from gapcert_bounds import calibrated
from gapcert_functions import DominatingGap

from .stochastic_backend import NoiseDraws, again, drawn


@final
class CalibratedGap(GapFunction):
    """[l − w − e, u + w + e] of a gap function, w (nx,) of either sign; an end that w < 0 moves inwards stops at the middle."""

    def __init__(self, inner: GapFunction, widening: Array, resolution: Array) -> None:
        self.inner, self.widening, self.resolution, self.family = inner, widening, resolution, inner.family
        self.predictor = inner.predictor

    def interval(self, z: Array) -> tuple[Array, Array]:
        return calibrated(*ends(self.inner, z), self.widening, self.resolution)

    def interval_over(self, boxes: Interval) -> Interval:
        if self.form["form"] == "constant":
            return Interval(*self.interval(boxes.lo))
        return self._moved(*self.inner.ends_over(boxes))

    def remainder_ends_over(self, boxes: Interval) -> tuple[Interval, Interval]:
        if self.predictor is None:
            return self.ends_over(boxes)
        both = self._moved(*self.inner.remainder_ends_over(boxes))
        return both, both

    def _moved(self, low: Interval, high: Interval) -> Interval:
        # Inwards the ends stop at their middle, which is nowhere nearer to them than half of the least width. Where l > u and w
        # is too small to mend it, no residual lies in [l − w, u + w], and the box need not hold what stands for it.
        half = np.maximum((high - low).lo / 2, 0.0) * (1 - 1e-12)
        out = Interval.exact(np.maximum(self.widening, -half) + 2 * self.resolution)
        return Interval((low - out).lo, (high + out).hi)

    def lipschitz(self, boxes: Interval) -> Array:
        # Outwards γ is shifted; inwards its slope may become that of the middle, which is not known.
        inwards = (self.widening < 0)[None, :, None] & (self.form["form"] != "constant")
        return np.where(inwards, np.inf, self.inner.lipschitz(boxes))

    def pieces(self, domain: Domain) -> Iterator[tuple[Interval, GapFunction]]:
        for box, part in self.inner.pieces(domain):
            yield box, CalibratedGap(part, self.widening, self.resolution)

    def arrays(self) -> dict[str, Array]:
        return {**self.inner.arrays(), "calibrated.widening": self.widening, "calibrated.resolution": self.resolution}

    @property
    def form(self) -> Mapping[str, Any]:
        return self.inner.form


@final
@dataclass(frozen=True)
class Calibration(Record):
    """Points z (n, nz) that no fit has seen, r (draws, n, nx), and by how much they widen the band: score · scale, (nx,).

    The scale was fixed before; at most `exceedances` of the points' scores lie above `score`.
    """

    z: Array
    r: Array
    entry: Entry
    scale: Array
    exceedances: int
    score: float
    widening: Array
    noise: bool

    @property
    def draws(self) -> str:
        """Empty where f̂ has no noise."""
        n = len(self.r)
        return "" if not self.noise else order_statistics.NOISE if n == 1 else order_statistics.NOISE_OF.format(n)

    def reason(self, audit: Audit) -> str:
        seen = f"{audit.violations} of {len(audit.z)} audited points lie outside, as it allows"
        return f"{len(self.z)} calibration points; {seen}"

    def allowed(self, points: int, epsilon: float) -> int:
        return int(order_statistics.surprising(points, epsilon)) - 1

    def samples(self) -> int:
        return int(self.r.shape[0] * self.r.shape[1])

    def summary(self) -> dict[str, Any]:
        return {
            "points": len(self.z),
            "repeats": len(self.r),
            "exceedances": self.exceedances,
            "score": self.score,
            "widening": self.widening.tolist(),
            "number": self.k,
            "noise": self.noise,
        }

    def arrays(self, problem: GapProblem) -> dict[str, Array]:
        known = {"predictor.calibration": problem.predictor(self.z)} if problem.predictor.kind == "model" else {}
        return {"calibration.scale": self.scale, **known}

    def sentences(self, problem: GapProblem, audited: Audit, model: Model, gate: Gate) -> list[str]:
        """What the claim rests on."""
        n, domain = len(self.z), problem.domain
        drawn = f"uniform on {domain.words}{gate.distribution}{self.draws}"
        each = (
            f", each with {len(self.r)} independent draws of the noise, all of which count as one trial" if self.noise else ""
        )
        return [
            f"The claim rests on {n} calibration points, independent and {drawn}, "
            f"which no fit has seen (calibration {self.k} of this question){each}: the score that all but {self.exceedances} "
            f"of them keep is exceeded with probability above {audited.epsilon:g} only with probability β/2^{self.k} or less.",
            "It does not rest on the Lipschitz constants, nor on the samples: these gave the band that was calibrated, and the "
            "scale per state in which scores are counted, before any calibration point was drawn.",
            "Each point has its own draw of the backend's noise, whose seed is a hash of the point: independent draws are "
            "assumed of the backend for different seeds."
            if self.noise
            else f"f̂ is a function of its arguments alone: {gate.purity}; this was probed, not proved.",
            *gate.sentences(),
            f"The claim is about one period of {model.period:g} s with the input held, on Z = {domain.words}; what happens "
            f"between samples and outside Z is not covered. X × U: {in_words(model, domain)}.",
            f"It is about that distribution alone: it does not carry over to others, nor to a closed loop, which may stay in "
            f"the part that was missed. The audit's {len(audited.z)} points, drawn afterwards in the same way, are a second "
            f"look: {audited.violations} lie outside, and {audited.limit + 1} or more would refute the claim.",
            *(f"Warning: {w}." for w in self.entry.warnings),
        ]


@final
class Calibrate(Route):
    """The band of any family, moved until points that no fit has seen say how often it fails."""

    name = "calibrate"
    claim = "statistical"

    def prepared(self, request: Request, family: GapFamily, backend: System, seed: int) -> tuple[str, System]:
        """Route theorem1 asks for a cover, which a calibrated band has no use for; the backend has its noise drawn."""
        if "declared" in family.routes:
            raise UsageError(
                "certificate.route: a declared γ is taken as it is stated, and calibrate would move it; leave out the route, "
                "or take another gap family"
            )
        if request.claim == "deterministic":
            raise UsageError("certificate.claim: route calibrate gives a statistical claim at most; use claim: statistical")
        if request.repeats != 1 and (request.repeats < 1 or "seed" not in backend.capabilities):
            raise UsageError(
                f"certificate.repeats: found {request.repeats}; expected 1 of a backend that answers the same when it is asked "
                f"again, and at least 1 of a stochastic one"
            )
        return "dominate" if "dominate" in family.routes else family.routes[0], drawn(backend, seed)

    def band(
        self, gap: GapFunction, problem: GapProblem, request: Request, store: Store, ledger: Ledger, question: Fingerprint
    ) -> tuple[CalibratedGap, Calibration]:
        """Calibration k of a question, at points that no fit can know: as many as ε, β_k = β / 2^k and the exceedances need."""
        m, repeats = request.exceedances, request.repeats
        stores = [store, *(_again(store, draw) for draw in range(1, repeats))]
        object_ = f"calibrate:{gap_digest(gap, problem)}:{store.key}:{request.epsilon!r}:{request.beta!r}:{m}:{repeats}"
        entry = ledger.enter(question, "calibration", object_)
        k = entry.k
        n = order_statistics.points_needed(request.epsilon, request.beta / 2**k, m)
        z = problem.domain.draw(n, entry.draws(problem.seed, "calibration"))
        store.emit(Event("stage-started", "calibration", {"number": k, "points": n}))
        names = [f"calibration-{k}", *(f"calibration-{k}.{draw}" for draw in range(1, repeats))]
        r = np.stack([own.collect(name, Points(z)) for own, name in zip(stores, names, strict=True)])
        scale = scale_of(problem)
        each = scored(r, *ends(gap, z), scale)
        q = order_statistics.ranked(each, n - m)
        w = order_statistics.widening(q, scale)
        return CalibratedGap(gap, w, problem.arithmetic), Calibration(
            z, r, entry, scale, m, q, w, _noisy(store.residual.backend)
        )

    def refuted(self, problem: GapProblem, gap: GapFunction) -> None:
        """Nothing that its claim rests on: not the constants, nor the samples."""

    def sentences(self, found: Findings) -> list[str]:
        assert isinstance(found.record, Calibration), "its band has one"
        return found.record.sentences(found.problem, found.audit, found.model, found.gate)

    def yardsticks(self, gap: GapFunction, problem: GapProblem, record: Record | None, z: Array) -> tuple[Array, Array | None]:
        assert isinstance(record, Calibration), "its band has one"
        rank = len(record.z) - record.exceedances
        return constant(gap, problem, record.z, rank, partial(scored, record.r)), None


def ends(gap: GapFunction, z: Array) -> tuple[Array, Array]:
    """(l, u) as a function computes them, which cross where its constants do not hold; `interval` may put them in order."""
    return gap.ends(z) if isinstance(gap, DominatingGap) else gap.interval(z)


def scale_of(problem: GapProblem) -> Array:
    """(nx,) mean |r_i − p_i| over the samples, or the resolution where that is more."""
    tiny = np.finfo(float).tiny
    return np.asarray(np.maximum(np.maximum(np.abs(problem.remainder).mean(axis=0), problem.arithmetic), tiny))


def scored(r: Array, low: Array, high: Array, scale: Array) -> Array:
    """(n,) scores of points with residuals r (draws, n, nx), the largest of its draws each."""
    return np.asarray(np.max([order_statistics.scores(one, low, high, scale) for one in r], axis=0))


def constant(
    gap: GapFunction, problem: GapProblem, z: Array, rank: int, scored: Callable[[Array, Array, Array], Array]
) -> Array:
    """(nx,) what the points z of a calibration make of a constant, with the largest |r_i| of the samples as scale.

    scored: what (l, u) at the points and a scale make of their scores, of which the one of `rank` counts.
    """
    if gap.form["form"] == "constant":
        return np.asarray(gap.gamma(z[:1])[0])
    size = np.maximum(np.abs(problem.samples.r).max(axis=0), problem.arithmetic)
    none = np.zeros((len(z), len(size)))
    q = order_statistics.ranked(scored(none, none, size), rank)
    return np.asarray(order_statistics.widening(q, size) + problem.arithmetic)


def _noisy(system: Any) -> bool:
    """Is there a draw of noise in it, however it is wrapped?"""
    while not isinstance(system, NoiseDraws):
        if (system := getattr(system, "system", None)) is None:
            return False
    return True


def _again(store: Store, draw: int) -> Store:
    residual = Residual(again(store.residual.backend, draw), store.residual.model)
    return replace(store, residual=residual)


@final
class NoConstants(LipschitzEstimator):
    """No constants are looked for: 0, which claims nothing. Where residuals have noise, or no further ones can be had."""

    provenance = "estimated"

    def bound(self, problem: LipschitzProblem) -> LipschitzBound:
        zero = np.zeros((problem.domain.nx, len(problem.domain.low)))
        return LipschitzBound(zero, zero, "estimated", order_statistics.NO_CONSTANTS, curvature=zero)
