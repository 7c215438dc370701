"""Route calibrate: any band, moved until fresh points say how often it fails; what it claims, and what it does not."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibrating import TOO_LARGE, TOO_SMALL, UNIFORM, calibrated, declared, family
from forging import edit_json, failed

import gapcert as gc
import gapcert_functions
import gapcert_networks
from gapcert.certification.certificate import gap_digest
from gapcert.certification.routes import Request
from gapcert.numerics.intervals import Interval
from gapcert.numerics.order_statistics import drawing, points_needed, surprising
from gapcert.testing.toys import Drift, Perturbed, ripple
from gapcert_calibrate.route import CalibratedGap, NoConstants, ends
from gapcert_compare.compare import _figures
from gapcert_verify.verify import verify_run

Array = np.ndarray


def spike(z: Array) -> Array:
    """The ripple, and a spike on 0.2 % of the domain that hardly any sample meets."""
    return np.asarray(ripple(z) + np.where((np.abs(z[:, :1] - 0.3) < 0.002) & (z[:, 1:] > 0), 5.0, 0.0))


class Drawn(gc.plugin.GapFamily):
    """A family that takes any two networks, whose sides cross where constants are too small."""

    name = "drawn"
    routes = ("dominate",)

    def fit(self, problem: gc.plugin.GapProblem) -> gc.GapFunction:
        def network(seed: int) -> gapcert_networks.Network:
            rng = np.random.default_rng(seed)
            weights = rng.standard_normal((8, 2)), rng.standard_normal((1, 8)) / 8
            return gapcert_networks.Network(weights, (rng.standard_normal(8), np.zeros(1)), "tanh")

        return gapcert_functions.dominate(problem, self.name, network(1), network(2), counts=(2, 2), budget=5_000)


FAMILIES: dict[str, dict[str, Any]] = {
    "too small constants": {},
    "too large constants": {"lipschitz": declared(TOO_LARGE)},
    "no predictor": {"family": family("envelope", predictor="none")},
    "constant": {"family": family("constant")},
    "basis": {"family": family("basis", functions=["1", "u0^2"])},
    "multilinear without constants": {"family": family("multilinear"), "lipschitz": NoConstants()},
    "networks whose sides cross": {"family": Drawn(), "lipschitz": NoConstants()},
    "exceedances": {"request": Request("statistical", 1e-2, 1e-3, exceedances=20)},
}


@pytest.mark.exam
@pytest.mark.parametrize("name", FAMILIES)
def test_any_family_gets_a_claim_that_its_distribution_keeps(tmp_path: Path, name: str) -> None:
    c = calibrated(tmp_path, **FAMILIES[name])
    made = c.calibration
    assert made is not None
    assert c.claim == gc.Claim("statistical", 1e-2, 1e-3, "uniform on X × U")
    assert c.holds
    assert len(made.z) == points_needed(1e-2, 1e-3 / 2, made.exceedances)  # calibration 1 of the question
    z = c.domain.draw(100_000, np.random.default_rng(99))
    low, high = c.gap.interval(z)
    r = ripple(z)
    share = float(((r < low) | (r > high)).mean())
    assert share <= 1e-2
    # 0 exceedances may give away much; 20 leave 20/n in the mean, and half of that in one question of hundreds.
    assert share > 10 / len(made.z) or not made.exceedances
    boxes = Interval(np.maximum(z[:500] - 0.05, c.domain.low), np.minimum(z[:500] + 0.05, c.domain.high))
    over, (low, high) = c.gap.interval_over(boxes), c.gap.interval(z[:500])
    assert isinstance(c.gap, CalibratedGap)
    inner = ends(c.gap.inner, z[:500])
    possible = inner[0] - c.gap.widening <= inner[1] + c.gap.widening
    assert possible.mean() > 0.9
    assert (over.lo <= low)[possible].all()
    assert (high <= over.hi)[possible].all()
    assert (low <= high).all()
    assert verify_run(tmp_path / "run")["verdict"] == "holds", verify_run(tmp_path / "run")


def test_bands_move_outwards_and_inwards_as_far_as_the_points_ask(tmp_path: Path) -> None:
    wide = calibrated(tmp_path / "wide", lipschitz=declared(TOO_SMALL)).calibration
    narrow = calibrated(tmp_path / "narrow", lipschitz=declared(TOO_LARGE), family=family("constant")).calibration
    assert wide is not None
    assert narrow is not None
    assert wide.widening > 0 > narrow.widening
    moved = calibrated(tmp_path / "again", lipschitz=declared(TOO_LARGE), family=family("constant"))
    assert gc.plugin.supremum(moved.gap, moved.domain)[0] == moved.gap.gamma(np.zeros((1, 2)))[0]
    more = calibrated(tmp_path / "more", request=Request("statistical", 1e-2, 1e-3, exceedances=20)).calibration
    assert more is not None
    assert more.widening < wide.widening
    assert "exceeded with probability above 0.01 only with probability β/2^1" in calibrated(tmp_path / "wide").assumptions[0]


def test_it_does_not_rest_on_constants_which_samples_refute(tmp_path: Path) -> None:
    low = {"lipschitz": declared(TOO_SMALL), "family": family("envelope", predictor="none")}
    honest = calibrated(tmp_path / "route", route=None, **low)
    assert honest.claim.kind == "empirical"  # refuted
    assert calibrated(tmp_path / "calibrate", **low).claim.kind == "statistical"


def test_a_calibration_spends_what_an_audit_spends(tmp_path: Path) -> None:
    counts = []
    for k, seed in enumerate((0, 1, 1, 2)):
        c = calibrated(tmp_path / str(k), seed=seed, ledger=tmp_path / "ledger.json")
        assert c.calibration is not None
        counts.append((c.calibration.k, len(c.calibration.z)))
    assert counts == [(k, points_needed(1e-2, 1e-3 / 2**k)) for k in (1, 2, 2, 3)]


def test_an_audit_may_find_violations_but_not_more_than_the_claim_allows(tmp_path: Path) -> None:
    c = narrow(tmp_path, request=Request("statistical", 1e-2, 1e-3, attack=50_000))
    assert 0 < c.attack["violations"] <= c.attack["allowed"]
    assert _figures(c)["violations"] == c.summary()["audit"]["violations"] + c.attack["violations"]
    assert c.holds
    assert c.claim.kind == "statistical"


def often(z: Array) -> Array:
    """The ripple, and 5 beside it on 3 % of the domain."""
    return np.asarray(ripple(z) + np.where(np.abs(z[:, :1] - 0.3) < 0.03, 5.0, 0.0))


def coarse(magnitude: Array) -> Array:
    """e far above what close answers show, so that it is the same whatever points are looked at."""
    return np.full_like(magnitude, 1e-12)


def unlucky(c: gc.Certificate, request: Request) -> int:
    """A seed with which the calibration of the same function meets none of the 3 %, and its audit meets many."""
    n = points_needed(request.epsilon, request.beta / 2)
    limit, key, asked = surprising(n, request.epsilon), c.audit.entry.question, f"{request.epsilon!r}:{request.beta!r}:0:1"
    assert isinstance(c.gap, CalibratedGap)
    for seed in range(10_000):
        text = f"calibrate:{gap_digest(c.gap.inner, replace(c.problem, seed=seed))}:{key}:{asked}"
        own = {"question": key, "audited": hashlib.sha256(text.encode()).hexdigest()}
        z, fresh = (c.domain.draw(n, drawing(seed, 1, stream, **own)) for stream in ("calibration", "audit"))
        if (often(z) < 1).all() and (often(fresh) > 1).sum() >= limit:
            return seed
    raise AssertionError("no seed is so unlucky")


def narrow(tmp_path: Path, **options: Any) -> gc.Certificate:
    """The first of drawn calibrations that meets nothing of the spike: which one that is no fit can tell."""
    for seed in range(50):
        c = calibrated(tmp_path / str(seed), Perturbed(Drift(1), spike), seed=seed, ledger=tmp_path / f"{seed}.json", **options)
        assert c.calibration is not None
        if np.max(c.calibration.widening) < 1:
            return c
    raise AssertionError("all of them meet it")


def test_an_audit_refutes_a_calibration_that_was_lucky(tmp_path: Path) -> None:
    asked = Request("statistical", 1e-2, 0.9)
    backend = Perturbed(Drift(1), often)
    vars(backend)["resolution"] = coarse
    options = {"backend": backend, "request": asked, "sampling": gc.GridSampling((12, 12))}
    seed = unlucky(calibrated(tmp_path / "first", **options), asked)
    c = calibrated(tmp_path, **options, seed=seed)
    assert c.audit.violations > c.audit.limit
    assert not c.holds
    assert c.claim.kind == "empirical"
    assert "witness" in c.summary()["audit"]
    result = verify_run(tmp_path / "run")
    assert result["verdict"] == "holds"  # as the empirical claim that it is
    claim = {"kind": "statistical", "epsilon": 1e-2, "beta": 0.9, "distribution": UNIFORM}
    edit_json(tmp_path / "run", claim=claim)
    assert "the claim is one that its evidence allows" in failed(tmp_path / "run")


# --- what it does not claim


def test_the_claim_is_about_its_distribution_alone(tmp_path: Path) -> None:
    c = narrow(tmp_path)
    rng = np.random.default_rng(3)
    shifted = np.stack([0.3 + 0.001 * rng.standard_normal(5_000), 2 * rng.random(5_000)], axis=1)
    low, high = c.gap.interval(shifted)
    r = spike(shifted)
    assert ((r < low) | (r > high)).mean() > 0.9
    assert any("does not carry over to others, nor to a closed loop" in s for s in c.assumptions)


def test_a_closed_loop_may_sit_in_what_was_missed(tmp_path: Path) -> None:
    c = narrow(tmp_path)
    assert c.claim.kind == "statistical"
    x, inside = np.array([[0.29]]), []
    for _ in range(200):  # a regulator of the model to x = 0.3, which is where the spike is
        u = np.clip((0.3 - x) / 0.1, 1e-6, 2.0)
        z = np.hstack([x, u])
        low, high = c.gap.interval(z)
        inside.append(bool(((low <= spike(z)) & (spike(z) <= high)).all()))
        x = Drift(1).step(x, u).x
    assert not any(inside[1:])
    assert c.claim.carried.kind == "empirical"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"request": Request("deterministic")}, "route calibrate gives a statistical claim at most"),
        ({"request": Request("statistical", repeats=3)}, "answers the same when it is asked again"),
        ({"request": Request("statistical", exceedances=3), "route": "dominate"}, "only route calibrate has them"),
        ({"request": Request("statistical", exceedances=-1)}, "whole number"),
    ],
)
def test_what_does_not_fit_is_one_sentence(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(gc.UsageError, match=message):
        calibrated(tmp_path, **options)
