"""What evidence supports, and what carries over: one test per rule."""

from itertools import product

import numpy as np
import pytest

import gapcert as gc
from gapcert.certification.routes import Request
from gapcert.contracts.gaps.claim import audit_size
from gapcert.testing.toys import Drift, Perturbed, ripple

KINDS = ("empirical", "statistical", "deterministic")
PROVENANCES = ("analytic", "interval", "declared", "estimated")
AUDIT = 1e-3, 1e-6, "uniform on X × U"


def supported(asked, provenance, refuted=False):
    return gc.Claim.supported(asked, provenance, refuted, *AUDIT)


@pytest.mark.parametrize(("asked", "provenance", "refuted"), [*product(KINDS, PROVENANCES, (False, True))])
def test_no_more_is_said_than_was_asked_for_or_than_the_evidence_allows(asked, provenance, refuted):
    claim = supported(asked, provenance, refuted)
    assert KINDS.index(claim.kind) <= KINDS.index(asked)
    if refuted:
        assert claim == gc.Claim("empirical")
    if provenance == "estimated":
        assert claim.kind != "deterministic"


@pytest.mark.parametrize("provenance", ["analytic", "interval", "declared"])
def test_constants_that_are_no_estimate_make_it_deterministic(provenance):
    assert supported("deterministic", provenance) == gc.Claim("deterministic")


@pytest.mark.parametrize("provenance", PROVENANCES)
def test_a_clean_audit_makes_it_statistical_whatever_the_constants_are(provenance):
    assert supported("statistical", provenance) == gc.Claim("statistical", *AUDIT)


def test_deterministic_carries_over_to_whatever_is_built_on_it():
    assert gc.Claim("deterministic").carried == gc.Claim("deterministic")


def test_a_pointwise_statistical_claim_does_not_carry_over():
    assert gc.Claim("statistical", *AUDIT).carried == gc.Claim("empirical")
    assert gc.Claim("empirical").carried == gc.Claim("empirical")


def test_an_audit_of_that_size_bounds_the_probability_and_one_point_less_does_not():
    for epsilon, beta in ((1e-3, 1e-6), (1e-2, 1e-6), (0.05, 1e-3)):
        n = audit_size(epsilon, beta)
        assert (1 - epsilon) ** n <= beta < (1 - epsilon) ** (n - 1)


def test_a_sample_counts_as_one_trial_over_all_states(tmp_path):
    """Both states leave their band at the same points: one violation each, not two."""

    class Still(gc.plugin.LipschitzEstimator):
        provenance = "declared"

        def bound(self, problem: gc.plugin.LipschitzProblem) -> gc.plugin.LipschitzBound:
            return gc.plugin.LipschitzBound(np.zeros((2, 4)), np.zeros((2, 4)), "declared", "nothing changes")

    model = Drift(2)
    domain = gc.Domain.of(model, dict.fromkeys(("x0", "x1", "u0", "u1"), (-1.0, 1.0)))
    made = gc.certify(
        model,
        Perturbed(model, ripple),
        domain,
        lipschitz=Still(),
        predictor=gc.plugin.AffinePredictor.none(2, 4),
        sampling=gc.GridSampling((1, 1, 1, 1)),
        request=Request("statistical", epsilon=0.01, beta=0.01),
        folder=tmp_path / "run",
    )
    low, high = made.gap.interval(made.audit.z)
    each = ((made.audit.r < low) | (made.audit.r > high)).sum()
    assert made.audit.violations == len(made.audit.z) < each
    assert made.claim == gc.Claim("empirical")
