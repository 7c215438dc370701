"""certify(): the statements of the theorem, what is refused, and what the evidence says."""

import json
import math
from typing import Any

import numpy as np
import pytest

import gapcert as gc
from gapcert.certification.certify import _violations
from gapcert.certification.fingerprint import Fingerprint
from gapcert.certification.ledger import Ledger
from gapcert.certification.routes import Request
from gapcert.certification.samples.designs import AdaptiveSampling, GridSampling
from gapcert.contracts.gaps.claim import audit_size
from gapcert.contracts.systems.system import Step
from gapcert.testing.toys import Drift, Perturbed, ripple, ripple_lipschitz
from gapcert_cells.testing import Band

RANGES = {"x0": (-1.0, 1.0), "u0": (-2.0, 2.0)}


class Known(gc.plugin.LipschitzEstimator):
    """The true constants times a factor, under any provenance."""

    def __init__(self, factor: float = 1.0, provenance: Any = "declared") -> None:
        self.factor, self.provenance = factor, provenance

    def bound(self, problem) -> gc.plugin.LipschitzBound:
        value = ripple_lipschitz(1, 2.0) * self.factor
        # The affine predictor changes a slope by at most its own.
        slope = np.abs(getattr(problem.predictor, "slope", np.zeros_like(value)))
        return gc.plugin.LipschitzBound(value + slope * self.factor, 0 * value, self.provenance, "known", self.factor)


def certify(tmp_path, **options):
    model = options.pop("model", Drift(1))
    backend = options.pop("backend", Perturbed(model, ripple))
    options = {"lipschitz": Known(), "family": gc.registry().build("gap_family", "envelope"), **options}
    options.setdefault("folder", tmp_path / "run")
    return gc.certify(model, backend, gc.Domain.of(model, RANGES), **options)


def question(period: float = 0.1) -> Fingerprint:
    model = Drift(1, period)
    return Fingerprint(model, Perturbed(model, ripple), gc.Domain.of(model, RANGES))


def test_the_bound_holds_on_points_nobody_sampled(tmp_path):
    c = certify(tmp_path, request=Request("deterministic", attack=50_000))
    assert c.claim.kind == "deterministic"
    assert c.holds
    assert c.attack["violations"] == 0
    z = c.domain.draw(20_000, np.random.default_rng(99))
    assert (ripple(z) <= c.gap.interval(z)[1]).all()
    assert (np.abs(ripple(z)) <= c.gamma(z[:, :1], z[:, 1:])).all()


def test_constants_that_are_too_small_are_caught_by_the_audit(tmp_path):
    c = certify(
        tmp_path, lipschitz=Known(0.9, "estimated"), predictor=None, request=Request("statistical"), family=envelope("none")
    )
    assert c.audit.violations > 0
    assert not c.holds
    assert c.claim.kind == "empirical"
    witness = c.audit.witness(c.gap)
    assert not witness["low"] <= witness["residual"] <= witness["high"]
    assert np.isclose(ripple(np.array([witness["z"]]))[0, 0], witness["residual"])


def pinched(z):
    """A spike that one point in a thousand meets."""
    return np.where(np.abs(z[:, :1] - 0.3) < 1e-3, 1.0, 0.0)


def test_what_only_the_further_attack_finds_refutes_the_claim(tmp_path):
    options = {"backend": Perturbed(Drift(1), pinched), "sampling": GridSampling((8, 8)), "lipschitz": Known(1e-6)}
    c = certify(tmp_path, request=Request("statistical", 0.5, 0.5, attack=20_000), family=envelope("none"), **options)
    assert (c.audit.violations, c.attack["violations"] > 0) == (0, True)
    assert (c.holds, c.claim.kind) == (False, "empirical")


def test_a_band_that_is_no_number_holds_nothing(tmp_path):
    z = np.zeros((3, 2))
    low, high = np.array([-1.0, np.nan, -1.0]), np.array([1.0, 1.0, np.nan])
    bands = [Band([a], [b]) for a, b in zip(low, high, strict=True)]
    assert [[bool(v[0]) for v in _violations(b, z[:1], np.zeros((1, 1)))] for b in bands] == [
        [False] * 2,
        [True] * 2,
        [True] * 2,
    ]


def envelope(predictor: str):
    family = gc.registry().build("gap_family", "envelope")
    family.predictor = predictor
    return family


def test_samples_that_contradict_the_constants_refute_the_claim(tmp_path):
    c = certify(
        tmp_path,
        lipschitz=Known(0.3),
        family=gc.registry().build("gap_family", "constant"),
        request=Request("deterministic"),
        route="theorem1",
        sampling=GridSampling((15, 15)),
    )
    assert c.claim.kind == "empirical"
    assert any(a.startswith("REFUTED") for a in c.assumptions)


def test_claims_that_the_ingredients_cannot_give_are_refused(tmp_path):
    with pytest.raises(gc.UsageError, match="deterministic needs Lipschitz constants that are declared or proved"):
        certify(tmp_path, lipschitz=Known(1.2, "estimated"), request=Request("deterministic"))
    with pytest.raises(gc.UsageError, match=r"no uniform cover"):
        certify(tmp_path, family=gc.registry().build("gap_family", "constant"), route="theorem1")
    with pytest.raises(gc.UsageError, match="certifies by dominate, not by theorem1"):
        certify(tmp_path, route="theorem1")


class Stateful(gc.Backend):
    """Remembers its last query: the answer depends on the order."""

    def __init__(self, model) -> None:
        self.states, self.inputs, self.period, self.model, self.last = model.states, model.inputs, model.period, model, 0.0

    def _step(self, x, u, **options):
        out = self.model.step(x, u).x + 1e-9 * np.vstack([[[self.last]], x[:-1]])
        self.last = float(x[-1, 0])
        return out


class Buffered(gc.Backend):
    def __init__(self, model) -> None:
        self.states, self.inputs, self.period = model.states, model.inputs, model.period
        self.hidden, self.hidden_default, self.capabilities = (gc.StateSpec("delayed"),), (0.0,), frozenset({"hidden"})

    def _step(self, x, u, *, hidden, **options):
        return Step(x + hidden, u)


def test_impure_and_hidden_systems_are_refused(tmp_path):
    model = Drift(1)
    with pytest.raises(gc.UsageError, match=r"not a function of \(x, u\).*differ by up to"):
        certify(tmp_path, backend=Stateful(model))
    with pytest.raises(gc.UsageError, match=r"hidden state \(delayed\)"):
        certify(tmp_path, backend=Buffered(model))


class Diverging(gc.Backend):
    """Not a number beyond a quarter of the domain."""

    def __init__(self, model):
        self.states, self.inputs, self.period = model.states, model.inputs, model.period

    def _step(self, x, u, **options):
        return np.where(x > 0.5, np.nan, x)


def test_a_system_that_is_not_finite_is_not_called_impure(tmp_path):
    with pytest.raises(gc.UsageError, match=r"the backend steps from \(x, u\) = .* to \[nan"):
        certify(tmp_path, backend=Diverging(Drift(1)))


def test_mismatched_systems_are_refused(tmp_path):
    with pytest.raises(gc.UsageError, match=r"its period is 0\.2 s, the model's 0\.1 s"):
        certify(tmp_path, backend=Perturbed(Drift(1, 0.2), ripple))
    with pytest.raises(gc.UsageError, match="its states are x0, x1, the model's x0; they must agree"):
        certify(tmp_path, backend=Perturbed(Drift(2), ripple))


def test_a_family_below_its_samples_is_found_out(tmp_path):
    class Low(gc.plugin.GapFamily):
        name, routes = "low", ("dominate",)

        def fit(self, problem):
            inner = gc.registry().build("gap_family", "constant").fit(problem)
            inner.value = inner.value / 3
            return inner

    with pytest.raises(gc.UsageError, match=r"below \|r\| on \d+ of its own samples"):
        certify(tmp_path, family=Low())


def test_summary_carries_the_contract(tmp_path):
    s = certify(tmp_path, request=Request("statistical", 1e-2, 1e-3)).summary()
    json.dumps(s)
    assert set(s) >= {"claim", "states", "assumptions", "samples", "audit", "vacuous"}
    assert set(s["states"]["x0"]) >= {
        "gap_mean",
        "gamma_mean",
        "gamma_max",
        "constant_bound",
        "envelope_mean",
        "tightness",
        "tightness_vs_envelope",
        "safety_factor",
        "resolved",
        "vacuous",
    }
    assert s["claim"] == {"kind": "statistical", "epsilon": 1e-2, "beta": 1e-3, "distribution": "uniform on X × U"}
    spent = s["samples"].pop("lipschitz")
    assert 0 < spent < 500, (
        "declared constants cost nothing, but the steepest pairs of samples are followed to shorter distances"
    )
    assert s["samples"] == {"bound": 299, "audit": s["audit"]["points"]}
    assert s["states"]["x0"]["tightness_vs_envelope"] == 1.0


def test_audit_sizes_are_those_of_the_binomial():
    assert audit_size(1e-3, 1e-6) == 13_809
    assert [audit_size(1e-3, 1e-6 / 2**k) for k in (1, 2)] == [14_502, 15_195]
    for epsilon, beta in ((1e-3, 1e-6), (1e-2, 1e-3), (0.3, 0.1)):
        n = audit_size(epsilon, beta)
        assert n * math.log1p(-epsilon) <= math.log(beta) < (n - 1) * math.log1p(-epsilon)


def test_every_further_audit_of_a_question_costs_more(tmp_path):
    request = Request("statistical", 1e-2, 1e-3)
    first = certify(tmp_path, request=request)
    again = certify(tmp_path, request=request)
    other = certify(tmp_path, request=request, seed=1, folder=tmp_path / "other")
    assert (first.audit.k, again.audit.k, other.audit.k) == (1, 1, 2)
    np.testing.assert_array_equal(first.audit.z, again.audit.z)
    assert len(other.audit.z) == audit_size(1e-2, 1e-3 / 4)
    assert not np.isin(first.audit.z, other.audit.z).any()


def test_an_audit_that_was_begun_counts(tmp_path):
    ledger, asked = Ledger(tmp_path / "ledger.json"), question()
    assert [ledger.enter(asked, "audit", d).k for d in ("a", "b", "a", "c")] == [1, 2, 1, 3]
    assert Ledger(tmp_path / "ledger.json").enter(question(), "audit", "d").k == 4
    assert ledger.enter(asked, "calibration", "a").k == 1
    assert ledger.enter(question(0.2), "audit", "a").k == 1


def test_no_fit_sees_the_audit(tmp_path):
    c = certify(tmp_path)
    assert not np.isin(c.audit.z, c.samples.z).all(axis=1).any()


def zero(z: np.ndarray) -> np.ndarray:
    return np.zeros((len(z), 1))


def half_step(z: np.ndarray) -> np.ndarray:
    return -0.1 * z[:, 1:]


def test_a_gap_below_the_resolution_is_no_tightness(tmp_path):
    s = certify(tmp_path, backend=Perturbed(Drift(1), zero)).states["x0"]
    assert not s.resolved
    assert s.tightness is None
    assert not s.vacuous


def test_a_gap_as_large_as_the_motion_is_vacuous(tmp_path):
    # f̂ = x: the gap of "nothing moves" is zero, so any bound on |f̂ − f| = |τ u| is worth nothing.
    c = certify(tmp_path, backend=Perturbed(Drift(1), half_step))
    assert c.vacuous


def test_theorem1_margin_is_the_published_one(tmp_path):
    family = gc.registry().build("gap_family", "constant")
    c = certify(tmp_path, family=family, route="theorem1", sampling=GridSampling((40, 50)), request=Request("deterministic"))
    ex, eu = c.samples.cover.radii()
    expected = np.abs(c.samples.r).max() + 0.03 * ex + 0.08 * eu
    assert c.gap.arrays()["gamma"][0] == pytest.approx(expected, rel=1e-9)
    assert c.states["x0"].tightness >= 1


def test_adaptive_sampling_spends_at_most_its_budget(tmp_path):
    assert len(certify(tmp_path, sampling=AdaptiveSampling(60)).samples) in (59, 60)


def test_an_unknown_predictor_is_not_taken_for_none(tmp_path):
    with pytest.raises(gc.UsageError, match="found predictor 'afine'; expected 'none', 'affine'"):
        certify(tmp_path, predictor="afine")
