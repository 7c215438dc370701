"""Declares what this package offers; imports nothing but gapcert."""

from gapcert.plugin import Component, hookimpl


@hookimpl
def gapcert_components() -> list[Component]:
    return [
        Component(
            "route",
            "calibrate",
            "a band that fresh points have moved",
            "gapcert_calibrate.route:Calibrate",
            claim="statistical",
        ),
        Component(
            "lipschitz",
            "none",
            "no constants, for route calibrate: the band is what samples and predictor make of it, and then calibrated",
            "gapcert_calibrate.route:NoConstants",
            claim="statistical",
        ),
        Component(
            "backend",
            "stochastic",
            "any backend with sensor noise, timing jitter and parameters drawn per step",
            "gapcert_calibrate.stochastic_backend:Stochastic",
            "gapcert_calibrate.config:StochasticConfig",
            of=("backend", "model"),
        ),
        Component("study", "recording", "the certificate of a recording", "gapcert_calibrate.study:RecordingStudy"),
    ]
