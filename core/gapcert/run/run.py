"""One execution of a spec: question → certificate → controller → closed loop, or recording → diagnosis → certificate again."""

from __future__ import annotations

import json
import resource
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, final

from gapcert.certification.certificate import Certificate, saved_digest
from gapcert.certification.gates.augment import forgets, widen
from gapcert.certification.samples.executors import named
from gapcert.contracts.controllers.control import Controller, SynthesisProblem, Synthesizer
from gapcert.contracts.controllers.goal import Goal
from gapcert.contracts.gaps.claim import Claim
from gapcert.contracts.plugins.events import Emit, Event, Stages, broadcast
from gapcert.contracts.plugins.presentation import Shown
from gapcert.contracts.plugins.registry import registry
from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.system import Model
from gapcert.numerics.atomic_files import write_atomic
from gapcert.numerics.errors import Undecided, UsageError
from gapcert.run.build import Build
from gapcert.run.folder import ROOT, enter, opened, owned, place, sealed, spec_of
from gapcert.run.journal import Journal
from gapcert.run.status import RunFolder
from gapcert.run.verdict import beside_nominal, code_of, nothing_won, refutations
from gapcert.spec.expect import evaluate_expectations
from gapcert.spec.sections.plugin_sections import contributed
from gapcert.spec.spec import Spec, load_spec


@final
@dataclass(frozen=True, repr=False)
class Run(Shown):
    """A finished run: its folder, the JSON summary, and the objects behind it. A matrix has its runs in `runs`."""

    folder: Path
    summary: Mapping[str, Any]
    artifacts: Mapping[str, Any] = field(default_factory=dict)
    runs: tuple[Run, ...] = ()

    @property
    def certificate(self) -> Any:
        """A `Certificate`, a `Declaration` or a `CalibratedRecording`; None where none was made."""
        return self.artifacts.get("certificate")

    @property
    def controller(self) -> Controller | None:
        """The one that trusts γ."""
        found: Controller | None = self.artifacts.get("controllers", {}).get("with_gamma")
        return found

    @property
    def closed_loop(self) -> Any:
        """A `ClosedLoop`, or None."""
        return self.artifacts.get("closed_loop")

    @property
    def diagnosis(self) -> Any:
        """A `Diagnosis`, or None."""
        return self.artifacts.get("diagnosis")

    @property
    def comparison(self) -> Any:
        """A `Comparison`, or None."""
        return self.artifacts.get("comparison")

    @property
    def exit_code(self) -> int:
        """With `expect:` 0 if all are met, else 1; without, by the verdict (diagnosis and comparison: 0, whatever found)."""
        return max(r.exit_code for r in self.runs) if self.runs else code_of(self.summary)


@final
@dataclass(frozen=True)
class Outcome:
    """What was found: the JSON summary, the objects behind it by name, and in a sentence each what refutes a claim."""

    summary: Mapping[str, Any]
    artifacts: Mapping[str, Any] = field(default_factory=dict)
    failures: tuple[str, ...] = ()


class Study(ABC):
    """A component of kind `study`, called like the section of a spec that asks for it."""

    @abstractmethod
    def run(self, build: Build, folder: Path, stages: Stages, made: Outcome) -> Outcome:
        """Carry it out in a run folder, and say what it adds.

        Where its section answers `alone`, `made` is empty and the summary has `verdict` and `reason`; else it is what the
        certificate's own run has made, with artifacts model, backend, domain, certificate and controllers.
        """


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
    builds = [Build(s, executor, Path(out), allow_code) for s in loaded.expand()]
    made = [_run_one(build, observers, view, loaded.members) for build in builds]
    return Run(Path(out), {"runs": [r.summary for r in made]}, runs=tuple(made)) if loaded.is_matrix else made[0]


def resume(
    folder: Path | str,
    *,
    executor: str | None = None,
    allow_code: bool = False,
    observers: Sequence[Emit] = (),
    view: bool = False,
) -> Run:
    """Go on with an interrupted or failed run, to the same digests as without interruption; a finished one is returned.

    executor: another one than the run was begun with. UsageError where the folder is none of a run, where a process runs in it,
    or where the files of its spec have changed.
    """
    found = RunFolder.at(folder)
    if found.standing.state == "running":
        pid = (found.standing.owner or {}).get("pid")
        raise UsageError(f"{folder}: process {pid} runs it already; follow it with: gapcert watch {folder}")
    if found.standing.state == "finished" and "verdict" in found.summary:
        return Run(found.path, found.summary)
    chosen = executor if executor is not None else found.mark.get("executor")
    home = found.path if found.path.name else found.path.resolve()
    return run(spec_of(found.path), out=home.parent, executor=chosen, allow_code=allow_code, observers=observers, view=view)


def _run_one(build: Build, observers: Sequence[Emit], view: bool, matrix: Sequence[Spec]) -> Run:
    folder = opened(build.spec, build.out)
    with owned(folder), Journal(folder) as journal:
        enter(folder, build.spec, build.executor_name)
        if matrix:
            beside = [{"folder": place(s, build.out).name, "values": dict(s.variant)} for s in matrix]
            write_atomic(folder / "matrix.json", json.dumps(beside, indent=1, default=str).encode())
        done = _execute(build, folder, journal, observers, view)
        journal.finished(done.summary, done.exit_code)
        return done


def _execute(build: Build, folder: Path, journal: Journal, observers: Sequence[Emit], view: bool) -> Run:
    spec = build.spec
    tell = broadcast(journal, *observers, *registry().observers())
    for part in registry().of("illustrator"):
        tell = part.load()(folder, tell)
    stages = Stages(tell)
    rerun = str(folder / "run.rrd") if spec.config.report.rerun else None
    told = {"name": spec.config.name, "spec": spec.data, "folder": folder, "rerun": rerun, "view": view}
    stages.emit(Event("run-started", "run", told))
    begin = cpu_seconds()
    try:
        made = _answer(build, stages, folder)
    except Undecided as error:
        made = Run(folder, {"verdict": "unknown", "reason": str(error)})
    except UsageError as error:
        raise spec.placed(error) from None
    timings = {**stages.timings, "cpu": round(cpu_seconds() - begin, 3)}
    summary = {"name": spec.config.name, "run_dir": str(folder), **made.summary, "timings": timings}
    # The verdict is about claims only; expectations are answered beside it.
    if spec.config.expect:
        summary["expectations"] = evaluate_expectations(spec.config.expect, summary)
    write_atomic(folder / "summary.json", json.dumps(summary, indent=1, default=str).encode())
    stages.emit(Event("run-finished", "run", {"summary": summary, "folder": folder}))
    write_atomic(folder / ROOT, json.dumps(sealed(folder), indent=1).encode())
    if spec.config.report.html:
        journal(Event("stage-started", "report"))
        registry().get("report", "html").load()(folder)
    return replace(made, summary=summary)


def _answer(build: Build, stages: Stages, folder: Path) -> Run:
    """What the spec asks for: a study that answers alone; or a certificate, controllers, and the studies that follow them."""
    config, none = build.spec.config, Outcome({})
    if config.study:
        found = _study(config.study).run(build, folder, stages, none)
        return Run(folder, found.summary, found.artifacts)
    made = (_declared if config.backend is None else _certify)(build, stages, folder)
    for name in (n for n in registry().names("study") if n in config.sections):
        more = _study(name).run(build, folder, stages, made)
        made = Outcome({**made.summary, **more.summary}, {**made.artifacts, **more.artifacts}, made.failures + more.failures)
    head = {
        "verdict": "fails" if made.failures else "holds",
        "reason": made.failures[0] if made.failures else made.artifacts["certificate"].reason,
    }
    return Run(folder, {**head, **made.summary}, made.artifacts)


def _study(name: str) -> Study:
    study: Study = registry().get("study", name).load()()
    return study


def cpu_seconds() -> float:
    """Of this process, and of its children that have ended."""
    return sum(u.ru_utime + u.ru_stime for u in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)))


def _certify(build: Build, stages: Stages, folder: Path) -> Outcome:
    """The first question: certificate, and controllers with and without γ."""
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
    refuted = tuple(refutations(certificate, build.spec.config.certificate))
    artifacts = {"certificate": certificate, "model": model, "backend": backend, "domain": domain}
    return _controlled(build, stages, folder, asked, Outcome(summary, artifacts, refuted))


def _declared(build: Build, stages: Stages, folder: Path) -> Outcome:
    """The first question, answered by a person: γ is declared, and no backend is there to be asked."""
    model: Model = build.make("model")
    domain = Domain.of(model, dict(build.spec.config.domain or {}), build.spec.config.relations)
    asked = _asked(build, model, domain)
    with stages.stage("certificate"):
        certificate = build.declare(model, domain)
        certificate.save(folder)
    stages.finished("certificate", certificate=certificate, model=certificate.model, domain=certificate.domain)
    artifacts = {"certificate": certificate, "model": model, "domain": domain}
    return _controlled(build, stages, folder, asked, Outcome({"certificate": certificate.summary()}, artifacts))


def _controlled(build: Build, stages: Stages, folder: Path, asked: tuple[Synthesizer, Goal] | None, made: Outcome) -> Outcome:
    """With the controllers, with and without γ, where they are asked for."""
    if asked is None:
        return made
    certificate = made.artifacts["certificate"]
    controllers = _synthesize(build, stages, folder, *asked, made)
    controller, carried = controllers["with_gamma"], certificate.claim.carried
    # What a synthesis takes on trust is no part of what was certified.
    if controller.evidence.get("assumptions") and carried.kind != "assumed":
        carried = Claim("empirical")
    facts, trusting = controller.facts(), controllers["without_gamma"].facts()
    said = {"kind": controller.kind, "claim": carried.summary(), **facts, **beside_nominal(facts, trusting)}
    nothing = not controller.wins or "reason" in controller.evidence
    failures = (*made.failures, *((nothing_won(controller.evidence),) if nothing else ()))
    return Outcome({**made.summary, "controller": said}, {**made.artifacts, "controllers": controllers}, failures)


def _beside(build: Build, stages: Stages, own: Certificate, folder: Path) -> list[dict[str, Any]]:
    """This certificate and those of the specs named in `report.beside`, one row each; only their bounds are made."""
    rows = [_row(build.spec.config.name, own, stages.timings["certificate"])]
    alone = [f"{section}=null" for section in ("controller", *contributed(registry()))]
    for path in build.spec.config.report.beside:
        other = load_spec(build.spec.folder / path, (*alone, "certificate.attack=0", "expect=null"))
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
    synthesizer: Synthesizer = build.make("controller")
    goal = build.spec.goal(domain)
    synthesizer.check(model, domain, goal)
    return synthesizer, goal


def _synthesize(
    build: Build, stages: Stages, folder: Path, synthesizer: Synthesizer, goal: Goal, found: Outcome
) -> dict[str, Controller]:
    model, domain, certificate = (found.artifacts[k] for k in ("model", "domain", "certificate"))
    made: dict[str, Controller] = {}
    trusting = SynthesisProblem(model, None, domain, goal, build.spec.config.seed, stages.emit)
    careful = replace(trusting, gap=build.absolute(certificate.gap, model), certificate=saved_digest(folder))
    with stages.stage("controller"):
        for name, problem in (("with_gamma", careful), ("without_gamma", trusting)):
            made[name] = synthesizer.synthesize(problem)
            made[name].save(folder / "controller" / name)
    stages.finished("controller", **made)
    return made
