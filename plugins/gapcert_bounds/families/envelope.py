"""Family `envelope`: one band for all of the domain, or, where constants hold per cell, one for each."""

from __future__ import annotations

from typing import Any, final

from gapcert import GapFunction, UsageError
from gapcert.plugin import GapFamily, GapProblem

from .envelope_gap import EnvelopeGap
from .multilinear_predictor import made
from .piecewise_envelope import PiecewiseEnvelope


@final
class Envelope(GapFamily):
    """Family `envelope`. `predictor`: "none", "affine", a Predictor, or an extended model."""

    name = "envelope"
    routes = ("dominate",)

    def __init__(self, predictor: Any = "affine") -> None:
        self.predictor = made(predictor)

    def fit(self, problem: GapProblem) -> GapFunction:
        if len(problem.samples) == 0:
            raise UsageError("envelope: there are no samples; give at least one")
        z, g, e = problem.samples.z, problem.remainder, problem.remainder_resolution
        if (cells := problem.lipschitz.cells) is not None:
            return PiecewiseEnvelope(z, g, cells, e, problem.predictor)
        return EnvelopeGap(z, g, problem.lipschitz.value, e, problem.predictor)
