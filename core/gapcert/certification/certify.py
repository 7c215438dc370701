"""How wrong can it be? certify() carries out this theorem (proof: docs/theory.md).

Theorem. Let g = r − p with |g_i(z) − g_i(z′)| ≤ Σ_j L_ij |z_j − z′_j| + 2 e_i on Z, and let r be known at z_1, …, z_N. Then
u_i(z) = p_i(z) + min_k g_i(z_k) + Σ_j L_ij |z_j − z_kj| + 2 e_i and its mirror l_i enclose r_i on all of Z, and every γ that
dominates max(|l|, |u|) is a gap function: |f̂_i − f_i| ≤ γ_i, on points seen and unseen.
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.random import Generator

from gapcert.certification import contradiction
from gapcert.certification.certificate import Audit, Certificate, Record, figures, gap_digest, points_refute
from gapcert.certification.compatibility import refuse, unpaired
from gapcert.certification.fingerprint import Fingerprint, digest
from gapcert.certification.gates import entry, hidden_state
from gapcert.certification.gates.again import again
from gapcert.certification.gates.augment import widen
from gapcert.certification.gates.circle import repeating
from gapcert.certification.gates.hidden_state import Gate, HiddenPlan
from gapcert.certification.gates.purity import unchanged
from gapcert.certification.ledger import Ledger
from gapcert.certification.refutation import watched
from gapcert.certification.routes import Findings, Request, Route
from gapcert.certification.samples.designs import AdaptiveSampling, GridSampling, LatticeSampling, Sampling, axes_of, refined
from gapcert.certification.samples.executors import Kept, processes
from gapcert.certification.samples.store import Store
from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.gaps.claim import Claim, audit_size
from gapcert.contracts.gaps.gap import GapFamily, GapFunction, GapProblem
from gapcert.contracts.gaps.lipschitz import LipschitzEstimator, LipschitzProblem, Residual, Symmetry
from gapcert.contracts.gaps.predictor import AffinePredictor, ModelPredictor, Predictor, Samples
from gapcert.contracts.plugins.events import Emit, Event, Pulse, silent
from gapcert.contracts.plugins.registry import registry
from gapcert.contracts.systems.arithmetic import named
from gapcert.contracts.systems.domain import Domain, Points
from gapcert.contracts.systems.system import Model, System
from gapcert.numerics.arrays import Array, Bools
from gapcert.numerics.errors import UsageError
from gapcert.version import __version__


def certify(
    model: Model,
    backend: System,
    domain: Domain,
    *,
    sampling: Sampling | None = None,
    lipschitz: LipschitzEstimator | None = None,
    family: GapFamily | None = None,
    predictor: Predictor | Model | None = None,
    route: str | None = None,
    request: Request | None = None,
    hidden: HiddenPlan | None = None,
    symmetries: Sequence[str] = (),
    seed: int = 0,
    folder: Path | str = "runs/certify",
    ledger: Path | str | None = None,
    question: Fingerprint | None = None,
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
    file `ledger` (default: beside the folder), under `question` (default: that of model, backend and domain). UsageError where
    the ingredients cannot give the claim.
    """
    known = registry()
    family = family or known.build("gap_family", "envelope")
    by: Route = known.build("route", route or family.routes[0])
    request = request or Request(by.claim)
    bounded = by.constants and "seed" not in backend.capabilities
    if lipschitz is None or not by.constants:
        lipschitz = known.build("lipschitz", "wood-zhang" if bounded else "none")
    sampling = _sampling(sampling, family, domain, bounded)
    p = predictor or family.predictor
    if isinstance(p, Model):
        p, _ = widen(p, backend, domain)
    entry.contain(model, domain)
    model, backend = widen(model, backend, domain)
    question = question or Fingerprint(model, backend, domain)
    name, drawn = by.prepared(request, family, backend, seed)
    fit = by if name == by.name else known.build("route", name)
    refuse(model, drawn, family, lipschitz, fit, request.claim, sampling.kept(domain) is not None)
    asked = Question(model, domain, sampling, lipschitz, family, p, by, fit, request, symmetries, seed, question)

    plan = replace(hidden or HiddenPlan(), ignore=(*(hidden or HiddenPlan()).ignore, *symmetries))
    gate = entry.enter(model, drawn, domain, plan, request.claim, executor, seed, emit)  # r = f̂ − f is a function of (x, u)
    gate = replace(gate, turns=repeating(model, backend, domain, seed), jitter=gate.jitter if drawn is backend else None)
    with Kept(executor) as pools:
        key = digest(model, gate.system, domain)
        store = Store(Path(folder) / "samples", Residual(gate.system, model), key, pools, sampling.chunk, emit)
        book = Ledger(Path(folder).parent / "ledger.json" if ledger is None else Path(ledger))
        problem = measure(asked, store, gate)  # r at z_1, …, z_N, and constants of g
        strong = stricter(store, gate, domain)
        gap, problem, record = fitted(asked, problem, strong, book)  # l ≤ r ≤ u, so |r| ≤ γ, on Z
        audited = audit(gap, problem, asked, strong, book, record)  # attacked at points that no fit has seen
    told = ((store.residual, problem.samples.z, problem.samples.r), (strong.residual, audited.z, audited.r))
    gate = replace(gate, purity=f"{gate.purity}; {again(told, domain, problem.arithmetic, seed)}")
    unchanged(drawn, gate.first, seed)
    return conclude(asked, gap, problem, record, audited, gate, strong, book)  # what may be said


@final
@dataclass(frozen=True)
class Question:
    """What is asked of model and domain, with all defaults filled in. `fit`: the route by which the family is fitted."""

    model: Model
    domain: Domain
    sampling: Sampling
    lipschitz: LipschitzEstimator
    family: GapFamily
    predictor: Any
    route: Route
    fit: Route
    request: Request
    symmetries: Sequence[str]
    seed: int
    identity: Fingerprint


def _sampling(given: Sampling | None, family: GapFamily, domain: Domain, bounded: bool) -> Sampling:
    """What is given, else a default; without constants (`bounded` false) no cell is known to be looser than another."""
    even = LatticeSampling(budget=300) if family.lattice else AdaptiveSampling() if bounded else GridSampling.spread(domain)
    sampling = given or even
    if family.lattice and not isinstance(sampling, LatticeSampling):
        raise UsageError(f"gap: family '{family.name}' needs nodes of a lattice; use sampling: {{kind: lattice, budget: ...}}")
    return sampling


def stricter(store: Store, gate: Gate, domain: Domain) -> Store:
    """Where points come from that no fit has seen: asked in calls of many sizes, harmless hidden state drawn."""
    system, model = gate.audited or gate.system, store.residual.model
    key = digest(model, system, domain) if gate.audited else store.key
    return replace(store, residual=Residual(system, model), key=key, in_calls=True)


def measure(question: Question, store: Store, gate: Gate) -> GapProblem:
    """Samples, predictor, constants: a first round fits p, the constants bound r − p, later rounds go to the loosest cells."""
    domain, sampling, seed, symmetries = question.domain, question.sampling, question.seed, question.symmetries
    residual = store.residual
    # |r(z, h) − r(z′, h′)| ≤ L |z − z′| + 2 (e + s): the spread s over hidden states acts as a further resolution.
    both = residual.arithmetic(domain, gate.jitter if question.route.constants else None)
    rounding = both[0].e + both[1].e
    e = rounding + gate.bound
    for message in named(*both, [s.name for s in residual.model.states]):
        store.emit(Event("warning", "certificate", {"message": message}))

    def query(name: str, points: Array) -> Array:
        return store.collect(name, Points(points))

    none = AffinePredictor.none(domain.nx, len(domain.low))
    pairs = entry.paired(store, gate)
    asked = LipschitzProblem(domain, none, e, query, residual.model, residual.backend, seed, pairs, rounding)
    symmetry = contradiction.symmetric(asked, Symmetry.checked(symmetries, asked)) if symmetries else None
    held = () if symmetry is None else symmetry.axes
    sampling = sampling.holding(held)
    samples = store.samples("bound-0", sampling.first(domain), sampling.kept(domain))
    p = predictor_of(question.predictor, samples, residual.model, domain)
    store.emit(Event("stage-started", "lipschitz", {}))
    asked = replace(asked, predictor=p, held=held)
    constants = watched(asked, question.lipschitz.bound(asked), samples, store.emit)
    constants = constants if symmetry is None else symmetry.applied(constants, p, domain)
    further: Array | None
    if constants.cells is not None and question.fit.cells:
        further = constants.cells.points(domain, samples.r, (sampling.budget or 0) - len(samples))
    else:
        further = sampling.further(domain, samples.z, samples.r, constants.value, constants)
    problem = GapProblem(samples, domain, constants, p, e, question.fit.name, seed, symmetry, both)
    if further is not None:
        samples = refined(problem, further, sampling.tightness, query)
    if isinstance(sampling, LatticeSampling):
        samples = replace(samples, lattice=axes_of(samples.z if further is None else further))
    if constants.cells is not None and question.fit.cells and len(bare := constants.cells.bare(domain, samples.z)):
        raise UsageError(
            f"lipschitz {constants.method}: {len(bare)} of {len(constants.cells)} cells may meet Z and have no sample; the "
            f"estimator is broken: its anchors must hold a point of every cell that meets Z"
        )
    return replace(problem, samples=samples, emit=store.emit, folder=store.folder.parent / "fit")


def predictor_of(choice: Any, samples: Samples, model: Model, domain: Domain, caller: str = "certify") -> Predictor:
    """What is taken off before bounding: `none`, `affine`, a Predictor, what makes one of samples, or an extended Model."""
    if isinstance(choice, Predictor):
        return choice
    if isinstance(choice, Model):
        if said := unpaired(model, choice):
            raise UsageError(f"{caller}: the predictor's model does not fit the model: {said}")
        return ModelPredictor(choice, model)
    if choice == "affine":
        return AffinePredictor.fit(samples)
    if callable(choice):
        if not isinstance(made := choice(samples, domain), Predictor):
            raise UsageError(f"{caller}: what makes the predictor gave {made!r}; expected a Predictor")
        return made
    if choice == "none":
        return AffinePredictor.none(samples.r.shape[1], samples.z.shape[1])
    raise UsageError(
        f"{caller}: found predictor {choice!r}; expected 'none', 'affine', a Predictor, what makes one, or an extended Model"
    )


def fitted(
    question: Question, problem: GapProblem, store: Store, ledger: Ledger
) -> tuple[GapFunction, GapProblem, Record | None]:
    """The band of the family, as the route claims it."""
    store.emit(Event("stage-started", "fit", {}))
    problem = replace(problem, route=question.route.name)
    made = question.family.fit(replace(problem, route=question.fit.name))
    gap, record = question.route.band(made, problem, question.request, store, ledger, question.identity)
    return gap, problem, record


def audit(
    gap: GapFunction, problem: GapProblem, question: Question, store: Store, ledger: Ledger, record: Record | None
) -> Audit:
    """Draw audit k's points, which no fit can know, as many as ε and β_k = β / 2^k need; test l ≤ r ≤ u and |r| ≤ γ on them.

    Where the route has made a record, its entry is that of the audit: it has spent β_k, and the audit can only refute.
    """
    request = question.request
    # The same function about other hidden states, or drawn in other coordinates, is audited at other points or answers.
    object_ = f"{gap_digest(gap, problem)}:{store.key}:{request.epsilon!r}:{request.beta!r}"
    entry = ledger.enter(question.identity, "audit", object_) if record is None else record.entry
    k = entry.k
    n = audit_size(request.epsilon, request.beta / 2**k)
    z = problem.domain.draw(n, entry.draws(problem.seed, "audit"))
    store.emit(Event("stage-started", "audit", {"number": k, "points": n}))
    r = store.collect(f"audit-{k}", Points(z))
    outside, above = _judged(gap, z, r, Pulse(store.emit, "audit", n, "points"))
    limit = 0 if record is None else record.allowed(n, request.epsilon)
    return Audit(z, r, entry, request.epsilon, request.beta, outside, above, limit)


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
    for a in range(0, len(z), THRESHOLDS.judged_points):
        rows = slice(a, a + THRESHOLDS.judged_points)
        both[:, rows] = _violations(gap, z[rows], r[rows])
        pulse(min(a + THRESHOLDS.judged_points, len(z)), {"violations": int(both[0, : a + THRESHOLDS.judged_points].sum())})
    return both[0], both[1]


def attack(gap: GapFunction, residual: Residual, domain: Domain, n: int, rng: Generator, emit: Emit) -> dict[str, int]:
    """Count violations on n further uniform points, drawn block by block; nothing is stored."""
    counts, block = {"points": 0, "violations": 0, "gamma_violations": 0}, 100_000
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
    question: Question,
    gap: GapFunction,
    problem: GapProblem,
    record: Record | None,
    audited: Audit,
    gate: Gate,
    store: Store,
    ledger: Ledger,
) -> Certificate:
    """Evidence and the strongest claim, of those asked for, that the evidence allows."""
    route, request, model = question.route, question.request, question.model
    refuted = route.refuted(problem, gap)
    if refuted is None and record is None and route.constants:  # else the claim rests on points alone, or on γ as declared
        refuted = contradiction.by_audit(problem, audited.z, audited.r)
    moved = partial(ledger.enter, question.identity, "hidden state", f"{gap_digest(gap, problem)}:{store.key}")
    gate = hidden_state.attacked(gate, gap, problem, model, moved, store.emit)
    fresh = audited.entry.draws(problem.seed, "attack")
    attacked = attack(gap, store.residual, problem.domain, request.attack, fresh, store.emit) if request.attack else {}
    if record is not None and attacked:
        attacked["allowed"] = record.allowed(request.attack, request.epsilon)
    rests = route.sentences(Findings(problem, gap, record, audited, model, gate, refuted))
    drawn = f"uniform on {problem.domain.words}{gate.distribution}{'' if record is None else record.draws}"
    constant, envelope = route.yardsticks(gap, problem, record, audited.z)
    over = refuted is not None or points_refute(audited, attacked, gate)
    if not over and record is None:
        contradiction.declared(problem, gap, store.residual, route.claim == "assumed")
    return Certificate(
        gap,
        problem,
        Claim.supported(request.claim, problem.lipschitz.provenance, over, request.epsilon, request.beta, drawn),
        tuple(rests),
        figures(gap, problem, model, audited.z, audited.r, constant, envelope),
        audited,
        attacked,
        dict(store.digests),
        {"gapcert": __version__, "numpy": np.__version__, "python": platform.python_version()},
        gate,
        model,
        record,
    )
