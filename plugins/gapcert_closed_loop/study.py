"""The section `closed_loop:` of a spec carried out: the controllers, with γ and without, on the backend."""

from __future__ import annotations

from pathlib import Path
from typing import Any, final

from gapcert.plugin import Build, NoStart, Outcome, Stages, Study, beta_of, of_config

from .closed_loop import ClosedLoop, compare_loops
from .loop_audit import Oracle, loop_failures
from .section import ClosedLoopConfig


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
            oracle=Oracle(model, build.absolute(certificate.gap, model), made["domain"].states),
            beta=beta_of(asked.confidence),
            emit=stages.emit,
        )
    stages.finished("closed_loop", closed_loop=loop, backend=backend)
    return loop
