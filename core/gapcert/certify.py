"""How wrong can it be? certify() carries out this theorem (proof: docs/theory.md).

Theorem. Let g = r − p with |g_i(z) − g_i(z′)| ≤ Σ_j L_ij |z_j − z′_j| + 2 e_i on Z, and let r be known at z_1, …, z_N. Then
u_i(z) = p_i(z) + min_k g_i(z_k) + Σ_j L_ij |z_j − z_kj| + 2 e_i and its mirror l_i enclose r_i on all of Z, and every γ that
dominates max(|l|, |u|) is a gap function: |f̂_i − f_i| ≤ γ_i, on points seen and unseen.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert.bound import supremum
from gapcert.certificate import Audit, Certificate, Claim, ClaimKind, Ledger, StateEvidence, audit_size, gap_digest
from gapcert.components import registry
from gapcert.domain import Domain, Points
from gapcert.errors import UsageError
from gapcert.events import Emit, Event, silent
from gapcert.gap import AffinePredictor, GapFamily, GapFunction, GapProblem, ModelPredictor, Predictor, Route, Samples
from gapcert.lipschitz import LipschitzBound, LipschitzEstimator, LipschitzProblem, Residual
from gapcert.sampling import AdaptiveSampling, Sampling, Store, processes
from gapcert.system import Array, Model, System, difference
from gapcert.version import __version__

Flags = npt.NDArray[np.bool_]

_YARDSTICK_SAMPLES = 20_000


@final
@dataclass(frozen=True)
class Request:
    """The level of the claim that is asked for, and how hard it is attacked: ε, β, and further fresh points."""

    claim: ClaimKind = "empirical"
    epsilon: float = 1e-3
    beta: float = 1e-6
    attack: int = 0


def certify(
    model: Model,
    backend: System,
    domain: Domain,
    *,
    sampling: Sampling | None = None,
    lipschitz: LipschitzEstimator | None = None,
    family: GapFamily | None = None,
    predictor: Predictor | Model | None = None,
    route: Route | None = None,
    request: Request | None = None,
    seed: int = 0,
    folder: Path | str = "runs/certify",
    ledger: Path | str | None = None,
    executor: Callable[[], Executor] = processes,
    emit: Emit = silent,
) -> Certificate:
    """A certificate of |f̂ − f| ≤ γ on the domain.

    Defaults: adaptive sampling, Wood–Zhang constants × 1.2, family `envelope`, the family's own predictor and first route, an
    empirical claim. `predictor` overrides the family's; a Model there is an extended model. Samples live in `folder`, the audit
    ledger in the file `ledger` (default: beside the folder). Raises UsageError where the ingredients cannot give the claim.
    """
    sampling, request = sampling or AdaptiveSampling(), request or Request()
    lipschitz = lipschitz or registry().build("lipschitz", "wood-zhang")
    family = family or registry().build("gap_family", "envelope")
    route = route or family.routes[0]
    refuse(model, backend, family, lipschitz, route, request)
    residual = Residual(backend, model)
    question = digest(model, backend, domain)
    store = Store(Path(folder) / "samples", residual, question, executor, sampling.chunk, emit)
    book = Ledger(Path(ledger) if ledger is not None else Path(folder).parent / "ledger.json")
    impurity(residual, domain, seed)

    problem = measure(store, domain, sampling, lipschitz, predictor or family.predictor, route, seed)  # r_k; |Δg| ≤ L |Δz| + 2e
    refuted = contradiction(problem)  # no two samples may break the assumption
    gap = family.fit(problem)  # l ≤ r ≤ u, so |r| ≤ γ, on Z
    audited = audit(gap, problem, request, store, book, question)  # attacked at points that no fit has seen
    return conclude(gap, problem, audited, request, refuted, residual, store)  # what may be said


def digest(model: Model, backend: System, domain: Domain) -> str:
    """Identity of the question: model, backend and domain alone."""
    return hashlib.sha256(json.dumps([model.digest(), backend.digest(), domain.digest_data()]).encode()).hexdigest()


def refuse(
    model: Model, backend: System, family: GapFamily, lipschitz: LipschitzEstimator, route: Route, request: Request
) -> None:
    """Raise UsageError for questions whose ingredients do not fit together."""
    for attribute in ("states", "inputs"):
        f, fhat = getattr(model, attribute), getattr(backend, attribute)
        if [s.name for s in f] != [s.name for s in fhat]:
            raise UsageError(f"certify: the model's {attribute} are {_names(f)}, the backend's {_names(fhat)}; they must agree")
    if abs(model.period - backend.period) > 1e-12 * model.period:
        raise UsageError(
            f"certify: the model's period is {model.period:g} s, the backend's {backend.period:g} s; set them equal"
        )
    if route not in family.routes:
        raise UsageError(f"certificate.route: family '{family.name}' certifies by {' or '.join(family.routes)}, not by {route}")
    if request.claim == "deterministic" and lipschitz.provenance == "estimated":
        raise UsageError(
            "certificate.claim: deterministic needs Lipschitz constants that are declared or proved by intervals, and an "
            "estimate is neither; ask for a statistical claim, or choose another lipschitz.residual"
        )
    for role, system in (("model", model), ("backend", backend)):
        if system.hidden:
            raise UsageError(
                f"certify: the {role} has hidden state ({_names(system.hidden)}), so its gap is no function of (x, u); "
                f"measure these states, or certify a {role} without them"
            )
        if "seed" in system.capabilities:
            raise UsageError(
                f"certify: the {role} is stochastic (capability 'seed'), so its gap is no function of (x, u); "
                f"certify a {role} whose noise is switched off, or whose draws are inputs"
            )


def _names(specs: Any) -> str:
    return ", ".join(s.name for s in specs)


def impurity(residual: Residual, domain: Domain, seed: int, n: int = 64) -> None:
    """Refuse a System whose answer depends on the order of queries: n points, repeated and permuted, must agree bit for bit."""
    rng = np.random.default_rng([seed, 0x9075])
    z = domain.draw(n, rng)
    order = rng.permutation(n)
    for role, system in (("model", residual.model), ("backend", residual.backend)):
        first = system.step(*domain.split(z)).x
        if (lost := ~np.isfinite(first).all(axis=1)).any():
            k = int(np.argmax(lost))
            raise UsageError(
                f"certify: the {role} steps from (x, u) = {z[k].tolist()} to {first[k].tolist()}; shrink the domain, or mend "
                f"the {role}"
            )
        again = np.empty_like(first)
        again[order] = system.step(*domain.split(z[order])).x
        if not np.array_equal(first, again):
            worst = float(np.abs(first - again).max())
            raise UsageError(
                f"certify: the {role} is not a function of (x, u): the same {n} queries in another order differ by up to "
                f"{worst:.3g}; make it restore its whole state before every query"
            )


def measure(
    store: Store,
    domain: Domain,
    sampling: Sampling,
    lipschitz: LipschitzEstimator,
    predictor: Predictor | Model | str,
    route: Route,
    seed: int,
) -> GapProblem:
    """Samples, predictor, constants: a first round fits p, the constants bound r − p, later rounds go to the loosest cells."""
    residual = store.residual
    first = sampling.first(domain)
    z, r = first.chunk(0, len(first)), store.collect("bound-0", first)
    p = _predictor(predictor, Samples(z, r), residual.model)
    e = residual.resolution(domain)
    store.emit(Event("stage-started", "lipschitz", {}))

    def query(name: str, points: Array) -> Array:
        return store.collect(name, Points(points))

    constants = lipschitz.bound(LipschitzProblem(domain, p, e, query, residual.model, residual.backend, seed))
    further = sampling.further(domain, z, r, constants.value)
    if further is not None:
        z, r = np.concatenate([z, further]), np.concatenate([r, store.collect("bound-1", Points(further))])
    cover = None if isinstance(first, Points) else first
    return GapProblem(Samples(z, r, cover), domain, constants, p, e, route, seed)


def _predictor(choice: Predictor | Model | str, samples: Samples, model: Model) -> Predictor:
    if isinstance(choice, Predictor):
        return choice
    if isinstance(choice, Model):
        return ModelPredictor(choice, model)
    if choice == "affine":
        return AffinePredictor.fit(samples)
    if choice == "none":
        return AffinePredictor.none(samples.r.shape[1], samples.z.shape[1])
    raise UsageError(f"certify: found predictor {choice!r}; expected 'none', 'affine', a Predictor or an extended Model")


def contradiction(problem: GapProblem, most: int = 2_000) -> dict[str, Any] | None:
    """Two samples with |g_i − g′_i| > Σ_j L_ij |z_j − z′_j| + 2 e_i, which refute the constants; None if there are none.

    All pairs of up to `most` samples are looked at (an even selection of them where there are more). Both computed remainders
    may err by their resolution e, hence 4 e in all.
    """
    pick = np.linspace(0, len(problem.samples) - 1, min(most, len(problem.samples))).astype(int)
    z = problem.samples.z[pick]
    g, e = problem.samples.r[pick] - problem.predictor(z), problem.remainder_resolution
    worst: dict[str, Any] | None = None
    for i in range(g.shape[1]):
        for a in range(0, len(z), 500):
            allowed = (np.abs(z[a : a + 500, None] - z[None]) * problem.lipschitz.value[i]).sum(axis=2)
            excess = np.abs(g[a : a + 500, None, i] - g[None, :, i]) - allowed * (1 + 1e-12) - 4 * e[i]
            k, m = np.unravel_index(int(np.argmax(excess)), excess.shape)
            if excess[k, m] > (worst["excess"] if worst else 0.0):
                worst = {"state": i, "z": z[a + k].tolist(), "other": z[m].tolist(), "excess": float(excess[k, m])}
    return worst


def audit(gap: GapFunction, problem: GapProblem, request: Request, store: Store, ledger: Ledger, question: str) -> Audit:
    """Draw audit k's points from (seed, k), as many as ε and β_k = β / 2^k need; test l ≤ r ≤ u and |r| ≤ γ on them."""
    object_ = f"{gap_digest(gap, problem)}:{request.epsilon!r}:{request.beta!r}"
    k = ledger.enter(question, object_)
    n = audit_size(request.epsilon, request.beta / 2**k)
    z = problem.domain.draw(n, np.random.default_rng([problem.seed, k]))
    store.emit(Event("stage-started", "audit", {"number": k, "points": n}))
    r = store.collect(f"audit-{k}", Points(z))
    outside, above = _violations(gap, z, r)
    return Audit(z, r, k, request.epsilon, request.beta, outside, above)


def _violations(gap: GapFunction, z: Array, r: Array) -> tuple[Flags, Flags]:
    low, high = gap.interval(z)
    gamma = np.maximum(np.abs(low), np.abs(high))
    outside: Flags = np.any((r < low) | (r > high), axis=1)
    above: Flags = np.any(np.abs(r) > gamma, axis=1)
    return outside, above


def attack(gap: GapFunction, residual: Residual, domain: Domain, n: int, seed: int, emit: Emit = silent) -> dict[str, int]:
    """Count violations on n further uniform points, drawn block by block; nothing is stored."""
    rng, counts, block = np.random.default_rng([seed, 0xA77AC]), {"points": 0, "violations": 0, "gamma_violations": 0}, 100_000
    while counts["points"] < n:
        z = domain.draw(min(block, n - counts["points"]), rng)
        outside, above = _violations(gap, z, residual(z))
        counts["points"] += len(z)
        counts["violations"] += int(outside.sum())
        counts["gamma_violations"] += int(above.sum())
        emit(Event("progress", "attack", {"done": counts["points"], "total": n}))
    return counts


def conclude(
    gap: GapFunction,
    problem: GapProblem,
    audited: Audit,
    request: Request,
    refuted: dict[str, Any] | None,
    residual: Residual,
    store: Store,
) -> Certificate:
    """Evidence and the strongest claim, of those asked for, that the evidence allows."""
    if refuted is None and (low_by := _undershoot(gap, problem.samples)) > 0:
        raise UsageError(
            f"gap: family '{gap.family}' returned a γ below |r| on its own samples, by {low_by:.3g}; the family is broken"
        )
    attacked = attack(gap, residual, problem.domain, request.attack, problem.seed, store.emit) if request.attack else {}
    return Certificate(
        gap,
        problem,
        _claim(problem.lipschitz, audited, request, refuted, attacked),
        tuple(assumptions(problem, audited, residual, refuted)),
        evidence(gap, problem, audited, residual),
        audited,
        attacked,
        dict(store.digests),
        {"gapcert": __version__, "numpy": np.__version__, "python": platform.python_version()},
    )


def _undershoot(gap: GapFunction, samples: Samples) -> float:
    """max(|r| − γ) over the samples: a plugin's claim is data, and data are checked."""
    worst = -np.inf
    for a in range(0, len(samples), 100_000):
        worst = max(worst, float((np.abs(samples.r[a : a + 100_000]) - gap.gamma(samples.z[a : a + 100_000])).max()))
    return worst


def _claim(
    lipschitz: LipschitzBound, audited: Audit, request: Request, refuted: dict[str, Any] | None, attacked: dict[str, int]
) -> Claim:
    clean = audited.violations == 0 and refuted is None and not attacked.get("violations", 0)
    if request.claim == "deterministic" and clean and lipschitz.provenance != "estimated":
        return Claim("deterministic")
    if request.claim == "statistical" and clean:
        return Claim("statistical", request.epsilon, request.beta, "uniform on X × U")
    return Claim("empirical")


def assumptions(problem: GapProblem, audited: Audit, residual: Residual, refuted: dict[str, Any] | None) -> list[str]:
    """What the claim rests on, one sentence each, with provenance."""
    bound, p = problem.lipschitz, problem.predictor
    what = "r" if p.kind == "none" else f"r − p (p: {p.kind} predictor)"
    origin = {
        "analytic": "were derived analytically",
        "interval": "were proved by interval arithmetic from the equations of both systems",
        "declared": "were declared by the user and are taken on trust",
        "estimated": f"were estimated by {bound.method} from {bound.samples} transitions and multiplied by {bound.safety:g}; "
        f"an estimate is not a bound",
    }[bound.provenance]
    names = [s.name for s in residual.model.states]
    sentences = [
        f"The per-axis Lipschitz constants of {what} {origin}.",
        "One step of f̂ and of f, as computed, is within e of its exact value: "
        + ", ".join(f"e({n}) = {e:.2g}" for n, e in zip(names, problem.resolution, strict=True))
        + ".",
        "f̂ is a function of (x, u) alone: repeated and permuted queries agreed bit for bit; this was probed, not proved.",
        f"The claim is about one period of {residual.model.period:g} s with the input held, on Z = X × U; what happens between "
        f"samples and outside Z is not covered.",
        f"The audit's {len(audited.z)} points are independent and uniform on X × U (audit {audited.k} of this question); its "
        f"statement does not carry over to other distributions, nor to a closed loop.",
    ]
    if problem.route == "theorem1":
        ex, eu = problem.samples.cover.radii() if problem.samples.cover else (np.nan, np.nan)
        sentences.append(
            f"The samples cover Z with radius {ex:.6g} in the states and {eu:.6g} in the inputs (computed, rounded up)."
        )
    if refuted is not None:
        sentences.append(
            f"REFUTED: two samples contradict the constants of {names[refuted['state']]} by {refuted['excess']:.3g}."
        )
    return sentences


def evidence(gap: GapFunction, problem: GapProblem, audited: Audit, residual: Residual) -> dict[str, StateEvidence]:
    """Figures per state over the audit's points."""
    gamma, mean_gap = gap.gamma(audited.z), np.abs(audited.r).mean(axis=0)
    yardstick = _yardstick(gap, problem)
    envelope = None if yardstick is None else yardstick.gamma(audited.z).mean(axis=0)
    constant = _constant_bound(problem, yardstick)
    x, u = problem.domain.split(audited.z)
    nominal = residual.model.step(x, u).x
    still = np.abs(difference(residual.model.states, nominal, x) + audited.r).mean(axis=0)
    power = _overpowered(gamma, residual.model, problem.domain, x)
    out = {}
    for i, state in enumerate(residual.model.states):
        resolved = bool(mean_gap[i] >= 10 * problem.resolution[i])
        mean = float(gamma[:, i].mean())
        out[state.name] = StateEvidence(
            gap_mean=float(mean_gap[i]),
            gamma_mean=mean,
            gamma_max=float(gamma[:, i].max()),
            constant_bound=float(constant[i]),
            safety_factor=problem.lipschitz.safety,
            resolved=resolved,
            vacuous=resolved and bool(mean > constant[i] * (1 + 1e-9) or mean >= still[i]),
            envelope_mean=None if envelope is None else float(envelope[i]),
            tightness=mean / float(mean_gap[i]) if resolved else None,
            tightness_vs_envelope=None if envelope is None or not resolved else mean / float(envelope[i]),
            overpowered=power[i],
        )
    return out


def _yardstick(gap: GapFunction, problem: GapProblem) -> GapFunction | None:
    if gap.family == "envelope":
        return gap
    if problem.route == "theorem1" and len(problem.samples) > _YARDSTICK_SAMPLES:
        return None  # the envelope of millions of samples costs more than the certificate; the constant bound stands in
    fitted: GapFunction = registry().build("gap_family", "envelope").fit(problem)
    return fitted


def _constant_bound(problem: GapProblem, yardstick: GapFunction | None) -> Array:
    """The smallest constants that the same data and assumption certify: sup_Z max(|l|, |u|), or max|r| plus the margin."""
    if problem.route == "theorem1":
        return np.asarray(np.abs(problem.samples.r).max(axis=0) + problem.margin)
    assert yardstick is not None
    return supremum(yardstick, problem.domain)[0]


def _overpowered(gamma: Array, model: Model, domain: Domain, x: Array) -> list[float | None]:
    """Per state, the share of points where γ_i exceeds half the range of f_i over U's corners; None where f_i ignores u."""
    corners = np.stack(np.meshgrid(*zip(domain.inputs.low, domain.inputs.high, strict=True)), axis=-1).reshape(-1, model.nu)
    images = np.stack([model.step(x, np.broadcast_to(c, (len(x), model.nu))).x for c in corners])
    span = np.ptp(images, axis=0)
    # A range at rounding level means that the input does not reach the state within one step.
    moved = span.max(axis=0) > 1e-12 * np.maximum(np.abs(images).max(axis=(0, 1)), 1e-300)
    return [float((gamma[:, i] > span[:, i] / 2).mean()) if moved[i] else None for i in range(gamma.shape[1])]
