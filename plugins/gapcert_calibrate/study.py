"""A spec whose recording stands where others have a backend: its windows are what no fit has seen, instead of fresh points."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import final

from gapcert.plugin import Build, Domain, Fingerprint, Ledger, Model, Outcome, Recording, Stages, Study

from .recording_certificate import FIT, CalibratedRecording, calibrate_recording, content


@final
class RecordingStudy(Study):
    def run(self, build: Build, folder: Path, stages: Stages, made: Outcome) -> Outcome:
        model: Model = build.make("model")
        with stages.stage("recording"):
            recording = build.make("recording", model).read()
        with stages.stage("certificate"):
            certificate = calibrated(build, model, recording)
            certificate.save(folder)
        stages.finished("certificate", certificate=certificate, model=model, recording=recording, domain=certificate.domain)
        summary = {"verdict": "holds", "reason": certificate.reason, "certificate": certificate.summary()}
        return Outcome(summary, {"certificate": certificate})


def calibrated(build: Build, model: Model, recording: Recording) -> CalibratedRecording:
    """The certificate that the spec asks for; the ledger beside the run folders says which calibration it is."""
    c, asked = build.spec.config, build.spec.config.certificate
    assert asked is not None, "such a spec has a certificate"
    domain = Domain.of(model, dict(c.domain or {}), c.relations)
    made = calibrate_recording(
        model,
        recording,
        domain,
        violation=asked.violation,
        confidence=asked.confidence if "confidence" in asked.model_fields_set else None,
        window=asked.window,
        fit=asked.fit or FIT,
        family=build.family(),
        lipschitz=build.make("lipschitz.residual") if "residual" in c.lipschitz else None,
        seed=c.seed,
    )
    question = json.dumps([model.digest(), recording.digest(), domain.digest_data()])
    named = hashlib.sha256(question.encode()).hexdigest()
    of = Fingerprint(model, model, domain, content(made), named)
    entry = Ledger(build.out / "ledger.json").enter(of, "calibration", made.digest())
    return replace(made, entry=entry, versions={**made.versions, **build.versions()})
