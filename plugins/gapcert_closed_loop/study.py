"""The section `closed_loop:` of a spec carried out: the controllers, with γ and without, on the backend."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, final

from gapcert.plugin import (
    Build,
    Entry,
    Fingerprint,
    Ledger,
    NoStart,
    Outcome,
    Stages,
    Study,
    beta_of,
    json_digest,
    of_config,
)

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
            loop = _close(build, folder, build.spec.config.sections["closed_loop"], stages, made.artifacts)
        except NoStart as error:
            return Outcome({}, failures=(str(error),))
        loop.save(folder)
        summary = loop.summary()
        failures = loop_failures(summary, made.artifacts["certificate"].claim.kind)
        return Outcome({"closed_loop": summary}, {"closed_loop": loop}, tuple(failures))


def _counted(build: Build, folder: Path, made: Any) -> Entry:
    """By what the book counts it among the closed loops of the question: the controller as it is saved, and what is asked."""
    saved = folder / "controller" / "with_gamma"
    controller = made["controllers"]["with_gamma"]
    if callable(known := getattr(controller, "digest", None)):
        of = known()
    else:
        of = json_digest(
            *((p.name, hashlib.sha256(p.read_bytes()).hexdigest()) for p in sorted(saved.iterdir()) if p.is_file())
        )
    asked = build.spec.config.sections["closed_loop"].model_dump_json()
    f, fhat, domain = (made[k] for k in ("model", "backend", "domain"))
    audited = json_digest(of, asked, build.spec.config.seed, fhat.digest())
    return Ledger(build.out / "ledger.json").enter(Fingerprint(f, fhat, domain), "closed loop", audited)


def _close(build: Build, folder: Path, asked: ClosedLoopConfig, stages: Stages, made: Any) -> ClosedLoop:
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
            entry=_counted(build, folder, made),
            emit=stages.emit,
        )
    stages.finished("closed_loop", closed_loop=loop, backend=backend)
    return loop
