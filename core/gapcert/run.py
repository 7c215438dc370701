"""One execution of a spec: question → certificate → controller → closed loop, or recording → diagnosis → certificate again."""

from __future__ import annotations

import json
import resource
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from gapcert.atomic_files import write_atomic
from gapcert.build import Build
from gapcert.certificate import Certificate, identity
from gapcert.claim import Claim, beta_of
from gapcert.components import registry
from gapcert.control import Controller, SynthesisProblem, Synthesizer
from gapcert.declared import Declaration
from gapcert.domain import Domain
from gapcert.errors import NoStart, Undecided, UsageError
from gapcert.events import Emit, Event, broadcast
from gapcert.executors import named
from gapcert.folders.journal import Journal
from gapcert.folders.mark import enter, opened, place
from gapcert.folders.owner import owned
from gapcert.gates import forgets, widen
from gapcert.goal import Goal
from gapcert.presentation import Shown
from gapcert.recorded import CalibratedRecording
from gapcert.replay import Oracle
from gapcert.spec import Spec, evaluate_expectations, load_spec
from gapcert.system import Model, System
from gapcert.verdict import beside_nominal, loop_failures, nothing_won, reason, refutations

if TYPE_CHECKING:
    from gapcert.closed_loop import ClosedLoop
    from gapcert.compare import Comparison
    from gapcert.effect import Diagnosis
    from gapcert.gates import Law
    from gapcert.spec.sections import ClosedLoopConfig

_EXIT = {"holds": 0, "fails": 1, "unknown": 5}


@final
@dataclass(frozen=True, repr=False)
class Run(Shown):
    """A finished run: its folder, the JSON summary, and the objects behind it. A matrix has its runs in `runs`."""

    folder: Path
    summary: Mapping[str, Any]
    certificate: Certificate | CalibratedRecording | Declaration | None = None
    controller: Controller | None = None
    closed_loop: ClosedLoop | None = None
    diagnosis: Diagnosis | None = None
    runs: tuple[Run, ...] = ()
    comparison: Comparison | None = None

    @property
    def exit_code(self) -> int:
        """With `expect:` 0 if all are met, else 1; without, by the verdict (diagnosis and comparison: 0, whatever found)."""
        if self.runs:
            return max(r.exit_code for r in self.runs)
        expectations = self.summary.get("expectations", [])
        if expectations:
            return 0 if all(e["met"] for e in expectations) else 1
        return _EXIT.get(self.summary["verdict"], 0)


@final
@dataclass
class _Stages:
    """The clock of a run, and its voice."""

    emit: Emit
    timings: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        self.emit(Event("stage-started", name))
        begin = time.perf_counter()
        yield
        self.timings[name] = round(time.perf_counter() - begin, 3)

    def finished(self, name: str, **results: Any) -> None:
        self.emit(Event("stage-finished", name, {**results, "seconds": self.timings.get(name)}))


def run(
    spec: Spec | str | Path | Mapping[str, Any],
    *,
    overrides: Sequence[str] = (),
    out: Path | str = "runs",
    executor: str | None = None,
    allow_code: bool = False,
    observers: Sequence[Emit] = (),
    view: bool = False,
) -> Run:
    """Execute a spec (a path, YAML data as a mapping, or a loaded Spec); results go to `out`/<name>-<digest>.

    The same spec again goes on where it was interrupted, and ends in the same digests.
    """
    loaded = spec if isinstance(spec, Spec) else load_spec(spec, overrides)
    if executor is not None:
        named(executor)
    made = [_run_one(s, Path(out), executor, allow_code, observers, view, loaded.members) for s in loaded.expand()]
    return Run(Path(out), {"runs": [r.summary for r in made]}, runs=tuple(made)) if loaded.is_matrix else made[0]


def _run_one(
    spec: Spec, out: Path, executor: str | None, allow_code: bool, observers: Sequence[Emit], view: bool, matrix: Sequence[Spec]
) -> Run:
    folder = opened(spec, out)
    with owned(folder), Journal(folder) as journal:
        enter(folder, spec, executor)
        if matrix:
            beside = [{"folder": place(s, out).name, "values": dict(s.variant)} for s in matrix]
            write_atomic(folder / "matrix.json", json.dumps(beside, indent=1, default=str).encode())
        done = _execute(spec, out, folder, executor, allow_code, journal, observers, view)
        journal.finished(done.summary, done.exit_code)
        return done


def _execute(
    spec: Spec,
    out: Path,
    folder: Path,
    executor: str | None,
    allow_code: bool,
    journal: Journal,
    observers: Sequence[Emit],
    view: bool,
) -> Run:
    tell = broadcast(journal, *observers, *registry().observers())
    for part in registry().of("illustrator"):
        tell = part.load()(folder, tell)
    stages = _Stages(tell)
    rerun = str(folder / "run.rrd") if spec.config.report.rerun else None
    stages.emit(
        Event(
            "run-started", "run", {"name": spec.config.name, "spec": spec.data, "folder": folder, "rerun": rerun, "view": view}
        )
    )
    begin = _cpu()
    build = Build(spec, executor, out, allow_code)
    try:
        made = _answer(build, stages, folder)
    except Undecided as error:
        made = Run(folder, {"verdict": "unknown", "reason": str(error)})
    except UsageError as error:
        raise spec.placed(error) from None
    timings = {**stages.timings, "cpu": round(_cpu() - begin, 3)}
    summary = {"name": spec.config.name, "run_dir": str(folder), **made.summary, "timings": timings}
    # The verdict is about claims only; expectations are answered beside it.
    if spec.config.expect:
        summary["expectations"] = evaluate_expectations(spec.config.expect, summary)
    write_atomic(folder / "summary.json", json.dumps(summary, indent=1, default=str).encode())
    stages.emit(Event("run-finished", "run", {"summary": summary, "folder": folder}))
    if spec.config.report.html:
        journal(Event("stage-started", "report"))
        registry().get("report", "html").load()(folder)
    return replace(made, summary=summary)


def _answer(build: Build, stages: _Stages, folder: Path) -> Run:
    """What the spec asks for."""
    config = build.spec.config
    if config.compare is not None:
        from gapcert.compare import compare

        compared = compare(build, config.compare, folder, stages)
        return Run(folder, compared.summary, comparison=compared)
    if config.diagnose is not None:
        from gapcert.diagnosis.asked import answer

        found = answer(build, config.diagnose, folder, stages)
        return Run(folder, found.summary, found.certificate, diagnosis=found.diagnosis)
    if config.backend is None:
        return (_declared if config.recording is None else _measured)(build, stages, folder)
    return _certify(build, stages, folder)


def _cpu() -> float:
    return sum(u.ru_utime + u.ru_stime for u in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)))


def _certify(build: Build, stages: _Stages, folder: Path) -> Run:
    """The first question: certificate, controllers with and without γ, closed loop."""
    model: Model = build.make("model")
    backend, domain = build.against(model)
    model, backend = widen(model, backend, domain)
    asked = _asked(build, model, domain)
    model, backend = build.remembered(model, backend)
    with stages.stage("certificate"):
        certificate = build.certify(model, backend, domain, folder, stages.emit)
        certificate.save(folder)
    f, fhat, z = build.relative(model, backend, domain)
    fhat = fhat if certificate.gate is None else certificate.gate.system
    stages.finished("certificate", certificate=certificate, model=f, backend=fhat, domain=z)
    summary: dict[str, Any] = {"certificate": certificate.summary()}
    if build.spec.config.report.beside:
        summary["beside"] = _beside(build, stages, certificate, folder)
    failures = refutations(certificate, build.spec.config.certificate)
    controllers = _controlled(build, stages, model, domain, certificate, folder, asked, summary, failures)
    loop, asked_loop = None, build.spec.config.closed_loop
    # Without a domain there is no start; `reason` says why nothing wins.
    if asked_loop is not None and all(c.wins for c in controllers.values()):
        try:
            law = certificate.gate.law if certificate.gate is not None else None
            oracle = Oracle(model, build.absolute(certificate.gap, model))
            loop = _close(build, asked_loop, stages, backend, controllers, law, domain, oracle)
        except NoStart as error:
            failures.append(str(error))
        else:
            loop.save(folder)
            summary["closed_loop"] = loop.summary()
            failures += loop_failures(summary["closed_loop"], certificate.claim.kind)
    return _concluded(folder, certificate, controllers, summary, failures, loop)


def _declared(build: Build, stages: _Stages, folder: Path) -> Run:
    """The first question, answered by a person: γ is declared, and no backend is there to be asked."""
    model: Model = build.make("model")
    domain = Domain.of(model, dict(build.spec.config.domain or {}), build.spec.config.relations)
    asked = _asked(build, model, domain)
    with stages.stage("certificate"):
        certificate = build.declare(model, domain)
        certificate.save(folder)
    stages.finished("certificate", certificate=certificate, model=certificate.model, domain=certificate.domain)
    summary: dict[str, Any] = {"certificate": certificate.summary()}
    failures: list[str] = []
    controllers = _controlled(build, stages, model, domain, certificate, folder, asked, summary, failures)
    return _concluded(folder, certificate, controllers, summary, failures)


def _controlled(
    build: Build,
    stages: _Stages,
    model: Model,
    domain: Domain,
    certificate: Certificate | Declaration,
    folder: Path,
    asked: tuple[Synthesizer, Goal] | None,
    summary: dict[str, Any],
    failures: list[str],
) -> dict[str, Controller]:
    """The controllers with and without γ, none where none is asked for; what they say is added to `summary` and `failures`."""
    if asked is None:
        return {}
    controllers = _synthesize(build, stages, model, domain, certificate, folder, *asked)
    controller, carried = controllers["with_gamma"], certificate.claim.carried
    # What a synthesis takes on trust is no part of what was certified.
    if controller.evidence.get("assumptions") and carried.kind != "assumed":
        carried = Claim("empirical")
    facts, trusting = controller.facts(), controllers["without_gamma"].facts()
    summary["controller"] = {"kind": controller.kind, "claim": carried.summary(), **facts, **beside_nominal(facts, trusting)}
    if not controller.wins or "reason" in controller.evidence:
        failures.append(nothing_won(controller.evidence))
    return controllers


def _concluded(
    folder: Path,
    certificate: Certificate | Declaration,
    controllers: Mapping[str, Controller],
    summary: Mapping[str, Any],
    failures: Sequence[str],
    loop: ClosedLoop | None = None,
) -> Run:
    head = {"verdict": "fails" if failures else "holds", "reason": failures[0] if failures else reason(certificate)}
    return Run(folder, {**head, **summary}, certificate, controllers.get("with_gamma"), loop)


def _measured(build: Build, stages: _Stages, folder: Path) -> Run:
    """The first question of a recording: its windows are what no fit has seen, in place of fresh points of a backend."""
    model: Model = build.make("model")
    with stages.stage("recording"):
        recording = build.make("recording", model).read()
    with stages.stage("certificate"):
        certificate = build.calibrate(model, recording)
        certificate.save(folder)
    stages.finished("certificate", certificate=certificate, model=model, recording=recording, domain=certificate.domain)
    summary = {"verdict": "holds", "reason": reason(certificate), "certificate": certificate.summary()}
    return Run(folder, summary, certificate)


def _beside(build: Build, stages: _Stages, own: Certificate, folder: Path) -> list[dict[str, Any]]:
    """This certificate and those of the specs named in `report.beside`, one row each; only their bounds are made."""
    rows = [_row(build.spec.config.name, own, stages.timings["certificate"])]
    for path in build.spec.config.report.beside:
        other = load_spec(
            build.spec.folder / path, ("controller=null", "closed_loop=null", "certificate.attack=0", "expect=null")
        )
        if other.config.backend is None:
            raise UsageError(f"report.beside: {path} has no backend, so that no gap is found there; expected a spec with one")
        built = Build(other, build.executor_name, build.out, build.allow_code)
        model: Model = built.make("model")
        backend, domain = built.against(model)
        with stages.stage(f"beside-{other.name}"):
            certificate = built.certify(model, backend, domain, folder / "beside" / other.name, stages.emit)
        rows.append(_row(other.name, certificate, stages.timings[f"beside-{other.name}"]))
    return rows


def _row(name: str, certificate: Certificate, seconds: float) -> dict[str, Any]:
    c = certificate.summary()
    states = {s: {k: v for k, v in e.items() if k in ("tightness", "gamma_mean", "gap_mean")} for s, e in c["states"].items()}
    return {"name": name, **{k: c[k] for k in ("family", "route", "claim", "samples")}, "states": states, "seconds": seconds}


def _asked(build: Build, model: Model, domain: Domain) -> tuple[Synthesizer, Goal] | None:
    """Who makes the controller, and its goal; what they would refuse is refused before a sample is drawn."""
    if build.spec.config.controller is None:
        return None
    if model.hidden:
        raise UsageError(f"controller: {forgets(model)}")
    synthesizer, goal = build.controller(), build.spec.goal(domain)
    synthesizer.check(model, domain, goal)
    return synthesizer, goal


def _synthesize(
    build: Build,
    stages: _Stages,
    model: Model,
    domain: Domain,
    certificate: Certificate | Declaration,
    folder: Path,
    synthesizer: Synthesizer,
    goal: Goal,
) -> dict[str, Controller]:
    made: dict[str, Controller] = {}
    trusting = SynthesisProblem(model, None, domain, goal, build.spec.config.seed, stages.emit)
    careful = replace(trusting, gap=build.absolute(certificate.gap, model), certificate=identity(folder))
    with stages.stage("controller"):
        for name, problem in (("with_gamma", careful), ("without_gamma", trusting)):
            made[name] = synthesizer.synthesize(problem)
            made[name].save(folder / "controller" / name)
    stages.finished("controller", **made)
    return made


def _close(
    build: Build,
    config: ClosedLoopConfig,
    stages: _Stages,
    backend: System,
    controllers: dict[str, Controller],
    law: Law | None,
    domain: Domain,
    oracle: Oracle,
) -> ClosedLoop:
    from gapcert.closed_loop import compare_loops

    seed = build.spec.config.seed if config.seed is None else config.seed
    knows = controllers["with_gamma"].policies
    headline = getattr(build.spec.config.controller, "policy", next((p for p in config.policies if p in knows), knows[0]))
    with stages.stage("closed_loop"):
        loop = compare_loops(
            backend,
            controllers["with_gamma"],
            controllers["without_gamma"],
            starts=config.starts,
            steps=config.steps,
            policies=tuple(config.policies) if "policies" in config.model_fields_set else None,
            policy=headline,
            starts_from=config.starts_from,
            seed=seed,
            law=law,
            domain=domain,
            oracle=oracle,
            beta=beta_of(config.confidence),
            emit=stages.emit,
        )
    stages.finished("closed_loop", closed_loop=loop, backend=backend)
    return loop
