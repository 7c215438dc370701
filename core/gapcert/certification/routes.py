"""Routes: how a band that a family has fitted becomes a claim. A component of kind `route`; the core has three."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from gapcert.certification.certificate import Audit, Record
from gapcert.certification.coordinates import in_words
from gapcert.certification.fingerprint import Fingerprint
from gapcert.certification.gates.hidden_state import Gate
from gapcert.certification.ledger import Ledger
from gapcert.certification.refutation import contradiction, curvature_contradiction, curvature_sentences, jump_sentence
from gapcert.certification.samples.store import Store
from gapcert.certification.supremum import supremum
from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.gaps.claim import ClaimKind
from gapcert.contracts.gaps.gap import GapFamily, GapFunction, GapProblem
from gapcert.contracts.gaps.predictor import Samples
from gapcert.contracts.plugins.events import Pulse
from gapcert.contracts.plugins.registry import registry
from gapcert.contracts.systems.arithmetic import sentence
from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.system import Model, System
from gapcert.numerics.arrays import Array, Ints
from gapcert.numerics.errors import UsageError
from gapcert.numerics.interpolation import on_curvature

Refuted = dict[str, Any]


@final
@dataclass(frozen=True)
class Request:
    """The level of the claim that is asked for, and how hard it is attacked: ε, β, and further fresh points.

    On route calibrate, so many `exceedances` of the calibrated band among its points are allowed (more of them take more points
    and give a tighter band), and a trial is `repeats` draws of a stochastic backend at one point.
    """

    claim: ClaimKind = "empirical"
    epsilon: float = 1e-3
    beta: float = 1e-6
    attack: int = 0
    exceedances: int = 0
    repeats: int = 1


@final
@dataclass(frozen=True)
class Findings:
    """What a claim is judged by, when its points have been audited and attacked."""

    problem: GapProblem
    gap: GapFunction
    record: Record | None
    audit: Audit
    model: Model
    gate: Gate
    refuted: Refuted | None


class Route(ABC):
    """How a band becomes a claim. The methods are asked in the order in which they stand here.

    `claim` is what a certificate claims where nothing is asked for. `constants`: they are found for it. `cells`: it works cell
    by cell where constants hold per cell. `cover`: its samples have to cover Z.
    """

    name: str
    claim: ClaimKind = "empirical"
    constants: bool = True
    cells: bool = False
    cover: bool = False

    def prepared(self, request: Request, family: GapFamily, backend: System, seed: int) -> tuple[str, System]:
        """(by which of its routes the family is fitted, the backend as it is asked); UsageError for what a route has not."""
        if (request.exceedances, request.repeats) != (0, 1):
            raise UsageError(
                "certificate.exceedances, repeats: only route calibrate has them, whose points may leave the band; use route: "
                "calibrate, or leave them out"
            )
        return self.name, backend

    def band(
        self, gap: GapFunction, problem: GapProblem, request: Request, store: Store, ledger: Ledger, question: Fingerprint
    ) -> tuple[GapFunction, Record | None]:
        """What is claimed of a fitted function, and the record of how it came about; here the function itself."""
        return gap, None

    @abstractmethod
    def refuted(self, problem: GapProblem, gap: GapFunction) -> Refuted | None:
        """A sample, or two, that contradict what the claim rests on; UsageError where it is the family that is wrong."""

    @abstractmethod
    def sentences(self, found: Findings) -> list[str]:
        """All that the claim rests on."""

    @abstractmethod
    def yardsticks(self, gap: GapFunction, problem: GapProblem, record: Record | None, z: Array) -> tuple[Array, Array | None]:
        """(nx,) each: the smallest constants that are certified in the same way, and the envelope's mean over z, if known."""


class _Audited(Route):
    """What its claim rests on can be refuted by samples, and its audit may find nothing."""

    @abstractmethod
    def basis(self, problem: GapProblem, gap: GapFunction, states: Sequence[str]) -> list[str]:
        """What γ rests on besides what was probed, in sentences."""

    def rest(self, problem: GapProblem) -> list[str]:
        """What of that is told last."""
        return []

    @abstractmethod
    def refutation(self, problem: GapProblem, refuted: Refuted, states: Sequence[str]) -> str:
        """What was refuted, in a sentence."""

    def sentences(self, found: Findings) -> list[str]:
        problem, gap, names = found.problem, found.gap, [s.name for s in found.model.states]
        said = [self.refutation(problem, found.refuted, names)] if found.refuted is not None else []
        probed = _assumptions(self.basis(problem, gap, names), problem, found.audit, found.model, found.gate)
        return [*curvature_sentences(problem, gap), *probed, *self.rest(problem), *said]


class _Bounded(_Audited):
    """By Lipschitz constants of the residual."""

    def refuted(self, problem: GapProblem, gap: GapFunction) -> Refuted | None:
        # No two r_k may break |Δg| ≤ L |Δz| + 2 e.
        found = contradiction(problem) or (curvature_contradiction(problem) if on_curvature(gap.form) else None)
        if found is not None or not (low := undershoot(gap, problem.samples)).size:
            return found
        # Where two samples contradict the constants no band contains both; else it is the family that is wrong.
        found = contradiction(problem, suspects=low[: THRESHOLDS.suspects])
        if found is None:
            raise UsageError(
                f"gap: family '{gap.family}' returned a γ below |r| on {low.size} of its own samples, the first at (x, u) = "
                f"{problem.samples.z[low[0]].tolist()}; the family is broken"
            )
        return found

    def basis(self, problem: GapProblem, gap: GapFunction, states: Sequence[str]) -> list[str]:
        return _origin(problem)

    def refutation(self, problem: GapProblem, refuted: Refuted, states: Sequence[str]) -> str:
        both = f": g changes by {refuted['change']:.6g}, and they allow {refuted['allowed']:.6g}" if "change" in refuted else ""
        return f"REFUTED: two samples contradict the constants of {states[refuted['state']]} by {refuted['excess']:.3g}{both}."


@final
class Theorem1(_Bounded):
    """γ ≥ |r| on a cover of Z, plus 𝓛_i = L₁ √(εx² + εu²) + L₂x εx + L₂u εu + 2 e_i."""

    name = "theorem1"
    cover = True

    def yardsticks(self, gap: GapFunction, problem: GapProblem, record: Record | None, z: Array) -> tuple[Array, Array | None]:
        constant = np.asarray(np.abs(problem.samples.r).max(axis=0) + problem.margin)
        if gap.family != "envelope" and len(problem.samples) > THRESHOLDS.yardstick_samples:
            return constant, None  # the envelope of millions of samples costs more than the certificate
        return constant, _envelope(gap, problem).gamma(z).mean(axis=0)

    def rest(self, problem: GapProblem) -> list[str]:
        ex, eu = problem.samples.cover.radii() if problem.samples.cover else (np.nan, np.nan)
        return [f"The samples cover Z with radius {ex:.6g} in the states and {eu:.6g} in the inputs (computed, rounded up)."]


@final
class Dominate(_Bounded):
    """γ dominates the envelope on all of Z, as branch and bound has proved."""

    name = "dominate"
    cells = True

    def yardsticks(self, gap: GapFunction, problem: GapProblem, record: Record | None, z: Array) -> tuple[Array, Array | None]:
        envelope = _envelope(gap, problem)
        # A box costs a look at every sample; with fewer boxes the bound is proved as well, only less tight.
        budget = int(np.clip(THRESHOLDS.constant_looks / max(1, len(problem.samples)), 10_000, 200_000))
        pulse = Pulse(problem.emit, "constant bound", unit="boxes")
        mean = envelope.gamma(z).mean(axis=0)
        return supremum(envelope, problem.domain, budget=budget, pulse=pulse)[0], mean


@final
class Declared(_Audited):
    """γ as a person states it: samples, audit and attack may refute it, and nothing can make it more than assumed."""

    name = "declared"
    claim = "assumed"
    constants = False

    def refuted(self, problem: GapProblem, gap: GapFunction) -> Refuted | None:
        low = undershoot(gap, problem.samples)
        return {"samples": low.size, "z": problem.samples.z[low[0]].tolist()} if low.size else None

    def yardsticks(self, gap: GapFunction, problem: GapProblem, record: Record | None, z: Array) -> tuple[Array, Array | None]:
        return gap.gamma_over(problem.domain.interval).max(axis=0), None  # no constants allow a smaller one

    def basis(self, problem: GapProblem, gap: GapFunction, states: Sequence[str]) -> list[str]:
        return [declaration(gap, states, problem.domain)]

    def refutation(self, problem: GapProblem, refuted: Refuted, states: Sequence[str]) -> str:
        return (
            f"REFUTED: at {refuted['samples']} of {len(problem.samples)} samples |f̂ − f| lies above the declared γ, first at "
            f"(x, u) = {refuted['z']}."
        )


def undershoot(gap: GapFunction, samples: Samples) -> Ints:
    """Samples (by number) with |r| > γ: a plugin's claim is data, and data are checked."""
    blocks = range(0, len(samples), 100_000)
    low = [np.any(np.abs(samples.r[a : a + 100_000]) > gap.gamma(samples.z[a : a + 100_000]), axis=1) for a in blocks]
    return np.flatnonzero(np.concatenate([*low, np.zeros(0, dtype=bool)]))


def _envelope(gap: GapFunction, problem: GapProblem) -> GapFunction:
    made: GapFunction = gap if gap.family == "envelope" else registry().build("gap_family", "envelope").fit(problem)
    return made


def _assumptions(basis: Sequence[str], problem: GapProblem, audited: Audit, model: Model, gate: Gate) -> list[str]:
    """What the claim rests on, one sentence each, with provenance; `basis` is what γ itself does."""
    names = [s.name for s in model.states]
    assert problem.arithmetics is not None, "certify looks at both"
    return [
        *basis,
        sentence(*problem.arithmetics, names),
        f"f̂ is a function of its arguments alone: {gate.purity}; this was probed, not proved.",
        *gate.sentences(),
        *([problem.symmetry.sentence()] if problem.symmetry is not None else []),
        scope(model, problem.domain),
        f"The audit's {len(audited.z)} points are independent and uniform on {problem.domain.words}{gate.distribution} (audit "
        f"{audited.k} of this question); its statement does not carry over to other distributions, nor to a closed loop.",
        *(f"Warning: {w}." for w in audited.entry.warnings),
    ]


def _origin(problem: GapProblem) -> list[str]:
    """Whence the constants are, and where they jump."""
    bound, p = problem.lipschitz, problem.predictor
    but = "" if problem.symmetry is None else problem.symmetry.exception
    what = "r" if p.kind == "none" else f"r − p (p: {p.kind} predictor)"
    from_where = {
        "analytic": f"were derived analytically{but}",
        "interval": f"were proved by interval arithmetic from the equations of both systems{but}",
        "declared": "were declared by the user and are taken on trust",
        "estimated": f"were estimated by {bound.method} from {bound.samples} transitions and multiplied by {bound.safety:g}; "
        f"an estimate is not a bound",
    }[bound.provenance]
    jumps = jump_sentence(bound, problem.domain.axes, but)
    return [f"The per-axis Lipschitz constants of {what} {from_where}.", *filter(None, (jumps,))]


def declaration(gap: GapFunction, states: Sequence[str], domain: Domain) -> str:
    """What a person said of γ."""
    each = zip(states, gap.gamma_over(domain.interval)[0], strict=True)
    return f"γ was declared by the user, and is assumed: |f̂ − f| ≤ {', '.join(f'{g:.6g} in {n}' for n, g in each)} on Z."


def scope(model: Model, domain: Domain) -> str:
    """What a claim is about."""
    texts = ", ".join(dict.fromkeys(r.text for r in domain.relations))
    zone = f"X × U with {texts}" if texts else "X × U"
    return (
        f"The claim is about one period of {model.period:g} s with the input held, on Z = {zone}; "
        f"what happens between samples and outside Z is not covered. X × U: {in_words(model, domain)}."
    )
