"""What a claim rests on, in sentences."""

from __future__ import annotations

from collections.abc import Sequence

from gapcert.certification.bounds.refutation import jump_sentence
from gapcert.certification.certificate import Audit
from gapcert.certification.coordinates import in_words
from gapcert.certification.gates import Gate
from gapcert.contracts.gaps.gap import GapFunction, GapProblem
from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.system import Model


def _zone(domain: Domain) -> str:
    texts = ", ".join(dict.fromkeys(r.text for r in domain.relations))
    return f"X × U with {texts}" if texts else "X × U"


def assumptions(basis: Sequence[str], problem: GapProblem, audited: Audit, model: Model, gate: Gate) -> list[str]:
    """What the claim rests on, one sentence each, with provenance; `basis` is what γ itself does."""
    names = [s.name for s in model.states]
    return [
        *basis,
        "One step of f̂ and of f, as computed, is within e of its exact value: "
        + ", ".join(f"e({n}) = {e:.2g}" for n, e in zip(names, problem.arithmetic, strict=True))
        + ".",
        f"f̂ is a function of its arguments alone: {gate.purity}; this was probed, not proved.",
        *gate.sentences(),
        *([problem.symmetry.sentence()] if problem.symmetry is not None else []),
        scope(model, problem.domain),
        f"The audit's {len(audited.z)} points are independent and uniform on {problem.domain.words}{gate.distribution} (audit "
        f"{audited.k} of this question); its statement does not carry over to other distributions, nor to a closed loop.",
    ]


def origin(problem: GapProblem) -> list[str]:
    """Whence the constants are, and where they jump."""
    bound, p = problem.lipschitz, problem.predictor
    what = "r" if p.kind == "none" else f"r − p (p: {p.kind} predictor)"
    from_where = {
        "analytic": "were derived analytically",
        "interval": "were proved by interval arithmetic from the equations of both systems",
        "declared": "were declared by the user and are taken on trust",
        "estimated": f"were estimated by {bound.method} from {bound.samples} transitions and multiplied by {bound.safety:g}; "
        f"an estimate is not a bound",
    }[bound.provenance]
    jumps = jump_sentence(bound, problem.domain.axes)
    return [f"The per-axis Lipschitz constants of {what} {from_where}.", *filter(None, (jumps,))]


def declaration(gap: GapFunction, states: Sequence[str], domain: Domain) -> str:
    """What a person said of γ."""
    each = zip(states, gap.gamma_over(domain.interval)[0], strict=True)
    return f"γ was declared by the user, and is assumed: |f̂ − f| ≤ {', '.join(f'{g:.6g} in {n}' for n, g in each)} on Z."


def scope(model: Model, domain: Domain) -> str:
    """What a claim is about."""
    return (
        f"The claim is about one period of {model.period:g} s with the input held, on Z = {_zone(domain)}; "
        f"what happens between samples and outside Z is not covered. X × U: {in_words(model, domain)}."
    )
