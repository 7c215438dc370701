"""How wrong can it be? certify() carries out this theorem (proof: docs/theory.md).

Theorem. Let g = r − p with |g_i(z) − g_i(z′)| ≤ Σ_j L_ij |z_j − z′_j| + 2 e_i on Z, and let r be known at z_1, …, z_N. Then
u_i(z) = p_i(z) + min_k g_i(z_k) + Σ_j L_ij |z_j − z_kj| + 2 e_i and its mirror l_i enclose r_i on all of Z, and every γ that
dominates max(|l|, |u|) is a gap function: |f̂_i − f_i| ≤ γ_i, on points seen and unseen.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert import curvature, gates
from gapcert.arrays import Array, Bools
from gapcert.assumptions import assumptions
from gapcert.bound import supremum
from gapcert.calibrated import Calibration, calibrate, distribution, prepared, spread
from gapcert.calibration import surprising
from gapcert.certificate import Audit, Certificate, Ledger, StateEvidence, gap_digest
from gapcert.claim import Claim, ClaimKind, audit_size
from gapcert.components import registry
from gapcert.designs import AdaptiveSampling, LatticeSampling, Sampling, axes_of
from gapcert.domain import Domain, Points
from gapcert.errors import UsageError
from gapcert.events import Emit, Event, Pulse, silent
from gapcert.executors import Kept, processes
from gapcert.gap import AffinePredictor, GapFamily, GapFunction, GapProblem, ModelPredictor, Predictor, Route, Samples
from gapcert.gates import Gate, HiddenPlan
from gapcert.lipschitz import LipschitzBound, LipschitzEstimator, LipschitzProblem, Residual
from gapcert.multilinear import MultilinearPredictor
from gapcert.pairing import unpaired
from gapcert.per_state import figures
from gapcert.refining import refined
from gapcert.refute import contradiction as contradiction
from gapcert.refute import watched
from gapcert.sampling import Store
from gapcert.symmetry import checked
from gapcert.system import Model, System
from gapcert.version import __version__

_PLAIN: dict[Route, ClaimKind] = {"calibrate": "statistical", "declared": "assumed"}
_YARDSTICK_SAMPLES = 20_000
_SUSPECTS = 200
_LOOKS = 4e8
_JUDGED = 25_000


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
    hidden: HiddenPlan | None = None,
    symmetries: Sequence[str] = (),
    seed: int = 0,
    folder: Path | str = "runs/certify",
    ledger: Path | str | None = None,
    question: str | None = None,
    executor: Callable[[], Executor] = processes,
    emit: Emit = silent,
) -> Certificate:
    """A certificate of |f̂ − f| ≤ γ on the domain.

    Defaults: adaptive sampling, Wood–Zhang constants × 1.2, family `envelope`, the family's own predictor and first route, an
    empirical claim; route `calibrate` has a statistical one, and stochastic backends with a grid and without constants. Route
    `declared` takes γ as it is stated, without constants: samples, audit and attack may refute it, and its claim is `assumed`.
    `predictor` overrides the family's; a Model there is an extended model. `hidden`: what is done where hidden state matters
    (default: refuse); hidden states that the domain names become states. `symmetries`: axes along which the residual is
    declared not to change; that is checked on pairs before it saves samples. Samples live in `folder`, the audit ledger in the
    file `ledger` (default: beside the folder), under the digest `question` (default: that of model, backend and domain).
    UsageError where the ingredients cannot give the claim.
    """
    family = family or registry().build("gap_family", "envelope")
    route = route or family.routes[0]
    request = request or Request(_PLAIN.get(route, "empirical"))
    bounded = "seed" not in backend.capabilities and route != "declared"
    if lipschitz is None or route == "declared":
        lipschitz = registry().build("lipschitz", "wood-zhang" if bounded else "none")
    sampling = _sampling(sampling, family, domain, bounded)
    if isinstance(predictor, Model):
        predictor, _ = gates.widen(predictor, backend, domain)
    gates.contain(model, domain)
    model, backend = gates.widen(model, backend, domain)
    question = question or digest(model, backend, domain)
    fitted, backend = prepared(route, request, family, backend, seed)
    gates.refuse(model, backend, family, lipschitz, fitted, request.claim, sampling.kept(domain) is not None)
    plan = replace(hidden or HiddenPlan(), ignore=(*(hidden or HiddenPlan()).ignore, *symmetries))
    gate = gates.enter(model, backend, domain, plan, request.claim, executor, seed, emit)
    residual = Residual(gate.system, model)
    with Kept(executor) as pools:
        store = Store(Path(folder) / "samples", residual, digest(model, gate.system, domain), pools, sampling.chunk, emit)
        book = Ledger(Path(folder).parent / "ledger.json" if ledger is None else Path(ledger))
        problem = measure(store, gate, domain, sampling, lipschitz, predictor or family.predictor, fitted, seed, symmetries)
        refuted = contradiction(problem) if route == fitted != "declared" else None  # no two r_k may break |Δg| ≤ L |Δz| + 2e
        store.emit(Event("stage-started", "fit", {}))
        problem, gap, made = replace(problem, route=route), family.fit(problem), None  # l ≤ r ≤ u, so |r| ≤ γ, on Z
        if route == "calibrate":
            gap, made = calibrate(gap, problem, request, store, book, question)
        audited = audit(gap, problem, request, store, book, question, made)  # attacked at points that no fit has seen
    refuted = refuted or (curvature.refuted(problem, gap) if made is None else None)
    return conclude(gap, problem, audited, request, refuted, residual, gate, store, made)  # what may be said


def _sampling(given: Sampling | None, family: GapFamily, domain: Domain, bounded: bool) -> Sampling:
    """What is given, else a default; without constants (`bounded` false) no cell is known to be looser than another."""
    even = LatticeSampling(budget=300) if family.lattice else AdaptiveSampling() if bounded else spread(domain)
    sampling = given or even
    if family.lattice and not isinstance(sampling, LatticeSampling):
        raise UsageError(f"gap: family '{family.name}' needs nodes of a lattice; use sampling: {{kind: lattice, budget: ...}}")
    return sampling


def digest(model: Model, backend: System, domain: Domain) -> str:
    """Identity of the question: model, backend and domain alone."""
    return hashlib.sha256(json.dumps([model.digest(), backend.digest(), domain.digest_data()]).encode()).hexdigest()


def measure(
    store: Store,
    gate: Gate,
    domain: Domain,
    sampling: Sampling,
    lipschitz: LipschitzEstimator,
    predictor: Predictor | Model | str,
    route: Route,
    seed: int,
    symmetries: Sequence[str] = (),
) -> GapProblem:
    """Samples, predictor, constants: a first round fits p, the constants bound r − p, later rounds go to the loosest cells."""
    residual = store.residual
    # |r(z, h) − r(z′, h′)| ≤ L |z − z′| + 2 (e + s): the spread s over hidden states acts as a further resolution.
    rounding = residual.resolution(domain)
    e = rounding + gate.bound

    def query(name: str, points: Array) -> Array:
        return store.collect(name, Points(points))

    none = AffinePredictor.none(domain.nx, len(domain.low))
    asked = LipschitzProblem(domain, none, e, query, residual.model, residual.backend, seed)
    asked = replace(asked, paired=gates.paired(store, gate), rounding=rounding)
    symmetry = checked(symmetries, asked) if symmetries else None
    held = () if symmetry is None else symmetry.axes
    sampling = sampling.holding(held)
    samples = store.samples("bound-0", sampling.first(domain), sampling.kept(domain))
    p = _predictor(predictor, samples, residual.model, domain)
    store.emit(Event("stage-started", "lipschitz", {}))
    asked = replace(asked, predictor=p, held=held)
    constants = watched(asked, lipschitz.bound(asked), samples, store.emit)
    constants = constants if symmetry is None else symmetry.applied(constants, p, domain)
    further: Array | None
    if constants.cells is not None and route == "dominate":
        further = constants.cells.points(domain, samples.r, getattr(sampling, "budget", 0) - len(samples))
    else:
        further = sampling.further(domain, samples.z, samples.r, constants.value, constants)
    if further is not None:
        known = GapProblem(samples, domain, constants, p, e, route, seed, rounding=rounding)
        samples = refined(known, further, getattr(sampling, "tightness", None), query)
    if isinstance(sampling, LatticeSampling):
        samples = replace(samples, lattice=axes_of(samples.z if further is None else further))
    if constants.cells is not None and route == "dominate" and len(bare := constants.cells.bare(domain, samples.z)):
        raise UsageError(
            f"lipschitz {constants.method}: {len(bare)} of {len(constants.cells)} cells may meet Z and have no sample; the "
            f"estimator is broken: its anchors must hold a point of every cell that meets Z"
        )
    problem = GapProblem(samples, domain, constants, p, e, route, seed, rounding=rounding, symmetry=symmetry)
    return replace(problem, emit=store.emit, folder=store.folder.parent / "fit")


def _predictor(choice: Predictor | Model | str, samples: Samples, model: Model, domain: Domain) -> Predictor:
    if isinstance(choice, Predictor):
        return choice
    if isinstance(choice, Model):
        if said := unpaired(model, choice):
            raise UsageError(f"certify: the predictor's model does not fit the model: {said}")
        return ModelPredictor(choice, model)
    if choice == "affine":
        return AffinePredictor.fit(samples)
    if choice == "multilinear":
        return MultilinearPredictor.fit(samples, domain)
    if choice == "none":
        return AffinePredictor.none(samples.r.shape[1], samples.z.shape[1])
    raise UsageError(
        f"certify: found predictor {choice!r}; expected 'none', 'affine', 'multilinear', a Predictor or an extended Model"
    )


def audit(
    gap: GapFunction,
    problem: GapProblem,
    request: Request,
    store: Store,
    ledger: Ledger,
    question: str,
    made: Calibration | None = None,
) -> Audit:
    """Draw audit k's points from (seed, k), as many as ε and β_k = β / 2^k need; test l ≤ r ≤ u and |r| ≤ γ on them.

    After a calibration k is its number: that has spent β_k, and the audit can only refute.
    """
    # The same function about other hidden states, or drawn in other coordinates, is audited at other points or answers.
    object_ = f"{gap_digest(gap, problem)}:{store.key}:{request.epsilon!r}:{request.beta!r}"
    k = ledger.enter(question, object_) if made is None else made.k
    n = audit_size(request.epsilon, request.beta / 2**k)
    z = problem.domain.draw(n, np.random.default_rng([problem.seed, k]))
    store.emit(Event("stage-started", "audit", {"number": k, "points": n}))
    r = store.collect(f"audit-{k}", Points(z))
    outside, above = _judged(gap, z, r, Pulse(store.emit, "audit", n, "points"))
    limit = 0 if made is None else surprising(n, request.epsilon) - 1
    return Audit(z, r, k, request.epsilon, request.beta, outside, above, limit)


def _violations(gap: GapFunction, z: Array, r: Array) -> tuple[Bools, Bools]:
    low, high = gap.interval(z)
    gamma = np.maximum(np.abs(low), np.abs(high))
    # Asked so that NaN is a violation.
    outside: Bools = ~np.all((r >= low) & (r <= high), axis=1)
    above: Bools = ~np.all(np.abs(r) <= gamma, axis=1)
    return outside, above


def _judged(gap: GapFunction, z: Array, r: Array, pulse: Pulse) -> tuple[Bools, Bools]:
    """`_violations` in blocks, so that one sees how far it is."""
    both = np.empty((2, len(z)), dtype=bool)
    for a in range(0, len(z), _JUDGED):
        rows = slice(a, a + _JUDGED)
        both[:, rows] = _violations(gap, z[rows], r[rows])
        pulse(min(a + _JUDGED, len(z)), {"violations": int(both[0, : a + _JUDGED].sum())})
    return both[0], both[1]


def attack(gap: GapFunction, residual: Residual, domain: Domain, n: int, seed: int, emit: Emit = silent) -> dict[str, int]:
    """Count violations on n further uniform points, drawn block by block; nothing is stored."""
    rng, counts, block = np.random.default_rng([seed, 0xA77AC]), {"points": 0, "violations": 0, "gamma_violations": 0}, 100_000
    while counts["points"] < n:
        z = domain.draw(min(block, n - counts["points"]), rng)
        outside, above = _violations(gap, z, residual(z))
        counts["points"] += len(z)
        counts["violations"] += int(outside.sum())
        counts["gamma_violations"] += int(above.sum())
        best = {"violations": counts["violations"]}
        emit(Event("progress", "attack", {"done": counts["points"], "total": n, "unit": "points", "best": best}))
    return counts


def conclude(
    gap: GapFunction,
    problem: GapProblem,
    audited: Audit,
    request: Request,
    refuted: dict[str, Any] | None,
    residual: Residual,
    gate: Gate,
    store: Store,
    made: Calibration | None = None,
) -> Certificate:
    """Evidence and the strongest claim, of those asked for, that the evidence allows."""
    low = _undershoot(gap, problem.samples) if made is None and refuted is None else np.zeros(0, dtype=np.intp)
    if low.size and problem.route == "declared":
        refuted = {"samples": low.size, "z": problem.samples.z[low[0]].tolist()}
    elif low.size:
        # Where two samples contradict the constants no band contains both; else it is the family that is wrong.
        refuted = contradiction(problem, suspects=low[:_SUSPECTS])
        if refuted is None:
            raise UsageError(
                f"gap: family '{gap.family}' returned a γ below |r| on {low.size} of its own samples, the first at (x, u) = "
                f"{problem.samples.z[low[0]].tolist()}; the family is broken"
            )
    gate = gates.attacked(gate, gap, problem, residual.model, store.emit)
    attacked = attack(gap, residual, problem.domain, request.attack, problem.seed, store.emit) if request.attack else {}
    if made is not None and attacked:
        attacked["allowed"] = surprising(request.attack, request.epsilon) - 1
    rests = made.sentences(problem, audited, residual.model, gate) if made is not None else None
    drawn = distribution(problem, gate, made is not None and made.noise, request.repeats)
    return Certificate(
        gap,
        problem,
        _claim(problem.lipschitz, audited, request, refuted, attacked, gate, drawn),
        tuple(rests or (*curvature.sentences(problem, gap), *assumptions(problem, audited, residual, refuted, gate, gap))),
        evidence(gap, problem, audited, residual, made),
        audited,
        attacked,
        dict(store.digests),
        {"gapcert": __version__, "numpy": np.__version__, "python": platform.python_version()},
        gate,
        residual.model,
        made,
    )


def _undershoot(gap: GapFunction, samples: Samples) -> npt.NDArray[np.intp]:
    """Samples (by number) with |r| > γ: a plugin's claim is data, and data are checked."""
    blocks = range(0, len(samples), 100_000)
    low = [np.any(np.abs(samples.r[a : a + 100_000]) > gap.gamma(samples.z[a : a + 100_000]), axis=1) for a in blocks]
    return np.flatnonzero(np.concatenate([*low, np.zeros(0, dtype=bool)]))


def _claim(
    lipschitz: LipschitzBound,
    audited: Audit,
    request: Request,
    refuted: dict[str, Any] | None,
    attacked: dict[str, int],
    gate: Gate,
    drawn: str,
) -> Claim:
    if request.claim == "assumed":
        return Claim("assumed")
    over = attacked.get("violations", 0) > attacked.get("allowed", 0)
    outside = audited.refutes or over or gate.attack.get("violations", 0)
    return Claim.supported(
        request.claim,
        lipschitz.provenance,
        bool(outside) or refuted is not None,
        request.epsilon,
        request.beta,
        drawn,
    )


def evidence(
    gap: GapFunction, problem: GapProblem, audited: Audit, residual: Residual, made: Calibration | None = None
) -> dict[str, StateEvidence]:
    """Figures per state over the audit's points."""
    stated = problem.route == "declared"
    yardstick = _yardstick(gap, problem) if made is None and not stated else None
    envelope = None if yardstick is None else yardstick.gamma(audited.z).mean(axis=0)
    if stated:  # no constants allow a smaller one
        constant = gap.gamma_over(problem.domain.interval).max(axis=0)
    else:
        constant = _constant_bound(problem, yardstick) if made is None else made.constant(gap, problem)
    return figures(gap, problem, residual.model, audited.z, audited.r, constant, envelope)


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
    # A box costs a look at every sample; with fewer boxes the bound is proved as well, only less tight.
    budget = int(np.clip(_LOOKS / max(1, len(problem.samples)), 10_000, 200_000))
    return supremum(yardstick, problem.domain, budget=budget, pulse=Pulse(problem.emit, "constant bound", unit="boxes"))[0]
