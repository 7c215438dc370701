"""A spec's `diagnose:` section carried out: the answer, what it leaves in the run folder, and what it buys a certificate."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from gapcert.plugin import (
    Controller,
    Domain,
    Model,
    Outcome,
    Stages,
    Study,
    SynthesisProblem,
    System,
    Undecided,
    UsageError,
    forgets,
    magnitude,
    saved_digest,
)
from gapcert_recordings import play

from .artifacts import left_behind
from .diagnose import diagnose
from .fitting.step_size import paced
from .section import DiagnoseConfig, PlayConfig

if TYPE_CHECKING:
    from gapcert.plugin import Build, Certificate, Recording

    from .results import Diagnosis


@final
class DiagnosisStudy(Study):
    """The second question: causes, extended model, gain; and γ before and after, where a backend and a domain are given."""

    def run(self, build: Build, folder: Path, stages: Stages, made: Outcome) -> Outcome:
        build, c = replace(build, hidden_later=True), build.spec.config
        asked: DiagnoseConfig = c.sections["diagnose"]
        with stages.stage("recording"):
            # A model without a period of its own has the recording's, which can be read without the model's units.
            left_out = getattr(c.model, "period", 1) is None
            model: Model = build.make("model", period=_period(build) if left_out else None)
            close, parts = _closer(build, model)
            seen: Model = close.make("model") if parts > 1 else model
            recording = _played(close, seen) if c.reality is not None else build.make("recording", model).read()
            # A backend, a domain or a goal that does not fit is refused here, before the diagnosis is paid for.
            asks = c.backend is not None or (c.reality is not None and c.certificate is not None)
            against = build.against(model) if asks and c.domain is not None else None
            if against is not None and c.controller is not None:
                build.make("controller").check(model, against[1], build.spec.goal(against[1]))
        with stages.stage("diagnosis"):
            held = asked.hold_out
            found = diagnose(
                seen,
                recording,
                asked.effects,
                hold_out=None if held is None else held.model_dump(exclude_none=True, by_alias=True),
                train=None if asked.train is None else asked.train.model_dump(exclude_none=True),
                horizons=None if asked.horizons is None else tuple(asked.horizons),
                window=asked.window,
                exact=asked.exact,
                experiment=None if asked.experiment is None else asked.experiment.model_dump(),
                seed=c.seed,
                emit=stages.emit,
                folder=folder,
            )
        if parts > 1:
            found = replace(found, extended_model=paced(found.extended_model, 1 / parts))
        stages.finished("diagnosis", diagnosis=found, recording=recording, bodies=(seen, *(against or ())[:1]))
        summary: dict[str, Any] = {"sentence": found.sentence(), **found.summary()}
        stages.timings |= {k: v for k, v in summary.pop("timings").items() if k not in stages.timings}
        summary |= left_behind(c.name, found, folder)
        certificate = None
        if against is not None:
            summary["recertified"], certificate = _recertify(build, stages, *against, model, found, folder)
        return Outcome(summary, {"diagnosis": found, "certificate": certificate})


def _period(build: Build) -> float:
    """That of the recording, or of the reality."""
    found: Any = build.make("reality") if build.spec.config.reality is not None else build.make("recording").read()
    return float(found.period)


def _closer(build: Build, model: Model) -> tuple[Build, int]:
    """The build with model and reality at the period `play.every`, and how many of these a period of the model has."""
    c = build.spec.config
    every = c.sections["play"].every if "play" in c.sections else None
    if every is None:
        return build, 1
    parts = round(model.period / every)
    if abs(parts * every - model.period) > 1e-9 * model.period or parts < 1:
        what = f"{every:g} s is no whole fraction of the model's period, {model.period:g} s"
        raise build.spec.error("play.every", what, "give a fraction of it, such as a tenth")
    changed = {}
    for section in ("model", "reality"):
        config = getattr(c, section)
        steps = getattr(config, "substeps", 0)
        if not steps or steps % parts:
            what = f"{section} has {steps or 'no'} substeps, which {parts} looks in a period do not divide"
            raise build.spec.error("play.every", what, f"set {section}.substeps to a multiple of {parts}")
        changed[section] = config.model_copy(update={"substeps": steps // parts, "period": f"{every!r} s"})
    return replace(build, spec=replace(build.spec, config=replace(c, **changed))), parts


def _played(build: Build, model: Model) -> Recording:
    """What the spec's reality does in the experiment that is played to it; ranges of the domain stand where `play` has none."""
    c, reality = build.spec.config, build.make("reality", model)
    asked, units = c.sections.get("play") or PlayConfig(), {s.name: s.unit for s in (*reality.states, *reality.inputs)}
    ranges = {n: (low, high) for n, (low, high) in (c.domain or {}).items() if n in units}
    for place, box in (("inputs", asked.inputs), ("start", asked.start)):
        for name, bounds in box.items():
            try:
                low, high = (magnitude(b, units.get(name, "1")) for b in bounds)
            except ValueError as error:
                raise build.spec.error(f"play.{place}.{name}", str(error)) from None
            ranges[name] = (low, high)
    return play(
        reality,
        ranges,
        seconds=asked.seconds,
        trajectories=asked.trajectories,
        hold=asked.hold,
        pause=asked.pause,
        relations=Domain.of(model, c.domain, c.relations).relations if c.domain and c.relations else (),
        channels=[s.name for s in model.outputs],
        seed=c.seed if asked.seed is None else asked.seed,
    )


def _recertify(
    build: Build, stages: Stages, backend: System, domain: Domain, model: Model, found: Diagnosis, folder: Path
) -> tuple[dict[str, Any], Certificate | None]:
    """γ of the nominal model, and of the extended one, against the same backend on the same domain; and what each γ leaves of
    the controller's winning domain.

    One that cannot be certified (an extended model with memory has no gap in (x, u)) says why; the diagnosis stands.
    """
    out: dict[str, Any] = {}
    certificate, controllers = None, dict[str, Controller]()
    models = {"before": model} | ({"after": found.extended_model} if found.causes else {})
    with stages.stage("certificate"):
        for name, f in models.items():
            place = folder / name
            try:
                certificate = build.certify(*build.remembered(f, backend), domain, place, stages.emit)
            except (UsageError, Undecided) as error:
                out[name] = {"refused": str(error)}
                continue
            certificate.save(place)
            out[name] = certificate.summary()
            if build.spec.config.controller is not None:
                out[name]["controller"] = _controlled(build, stages, f, domain, certificate, place, controllers)
    stages.finished("recertified", controllers=controllers, **out)
    return out, certificate


def _controlled(
    build: Build,
    stages: Stages,
    model: Model,
    domain: Domain,
    certificate: Certificate,
    place: Path,
    made: dict[str, Controller],
) -> dict[str, Any]:
    """What wins with the γ of this model; the controller joins `made`."""
    if model.hidden:
        return {"refused": forgets(model)}
    goal, gap = build.spec.goal(domain), build.absolute(certificate.gap, model)
    problem = SynthesisProblem(model, gap, domain, goal, build.spec.config.seed, stages.emit, saved_digest(place))
    try:
        controller = build.make("controller").synthesize(problem)
    except UsageError as error:
        return {"refused": str(error)}
    controller.save(place / "controller")
    made[place.name] = controller
    facts: dict[str, Any] = controller.facts()
    return facts
