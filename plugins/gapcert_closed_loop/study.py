"""The section `closed_loop:` of a spec, carried out: the controllers, with γ and without, on the backend."""

from __future__ import annotations

from pathlib import Path
from typing import Any, final

from pydantic import Field

from gapcert.plugin import POLICIES, Build, NoStart, Outcome, Policy, SpecSection, Stages, Study, beta_of, of_config
from gapcert.plugin import sections as s

from .closed_loop import ClosedLoop, StartsFrom, compare_loops
from .loop_audit import Oracle, loop_failures


@final
class ClosedLoopConfig(s.Section):
    """Runs of the controller on the backend, with γ beside without γ; those with γ are an audit, with a confidence 1 − β.

    Starts are drawn where both win, or with `starts_from: without_gamma` where the controller without γ does; of these,
    those that the controller with γ refuses are counted. `policies`: by default all that the controllers know.
    """

    steps: s.Count = Field(600, description="of each run, in periods")
    starts: s.Count = Field(100, description="runs per policy, at most")
    confidence: s.Probability = Field(0.999, description="1 − β of what the runs with γ show")
    policies: list[Policy] = Field(list(POLICIES), min_length=1, description="which valid inputs are applied, in turn")
    starts_from: StartsFrom = Field("both", description="where both controllers win, or where the one without γ does")
    seed: s.Whole | None = Field(None, description="of the starts; default: the spec's")


@final
class ClosedLoopSection(SpecSection):
    model = ClosedLoopConfig
    about = "runs of the controller on the simulator"
    needs = ("controller",)
    simulated = True


@final
class ClosedLoopStudy(Study):
    def run(self, build: Build, folder: Path, stages: Stages, made: Outcome) -> Outcome:
        """Nothing where a controller starts from nowhere: that is told by what refutes it."""
        if not all(c.wins for c in made.artifacts["controllers"].values()):
            return Outcome({})
        try:
            loop = _close(build, build.spec.config.sections["closed_loop"], stages, made.artifacts)
        except NoStart as error:
            return Outcome({}, failures=(str(error),))
        loop.save(folder)
        summary = loop.summary()
        failures = loop_failures(summary, made.artifacts["certificate"].claim.kind)
        return Outcome({"closed_loop": summary}, {"closed_loop": loop}, tuple(failures))


def _close(build: Build, asked: ClosedLoopConfig, stages: Stages, made: Any) -> ClosedLoop:
    certificate, model, backend, controllers = (made[k] for k in ("certificate", "model", "backend", "controllers"))
    knows = controllers["with_gamma"].policies
    headline = of_config(build.spec.config.controller, "headline") or next((p for p in asked.policies if p in knows), knows[0])
    with stages.stage("closed_loop"):
        loop = compare_loops(
            backend,
            controllers["with_gamma"],
            controllers["without_gamma"],
            starts=asked.starts,
            steps=asked.steps,
            policies=tuple(asked.policies) if "policies" in asked.model_fields_set else None,
            policy=headline,
            starts_from=asked.starts_from,
            seed=build.spec.config.seed if asked.seed is None else asked.seed,
            law=None if certificate.gate is None else certificate.gate.law,
            domain=made["domain"],
            oracle=Oracle(model, build.absolute(certificate.gap, model)),
            beta=beta_of(asked.confidence),
            emit=stages.emit,
        )
    stages.finished("closed_loop", closed_loop=loop, backend=backend)
    return loop
