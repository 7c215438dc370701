"""Route calibrate: any band, moved until fresh points say how often it fails; what it claims, and what it does not."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forging import edit_arrays, failed

import gapcert as gc
from gapcert.calibrated import CalibratedGap, NoConstants, ends
from gapcert.calibration import STREAM, points_needed, surprising
from gapcert.certify import Request
from gapcert.gates.noise import NoiseDraws
from gapcert.intervals import Interval
from gapcert.stochastic import Stochastic
from gapcert.testing.toys import Drift, Perturbed, ripple
from gapcert.verify import verify_run

Array = np.ndarray
UNIFORM = "uniform on X × U"
RANGES = {"x0": (-1.0, 1.0), "u0": (-2.0, 2.0)}
ASKED = Request("statistical", 1e-2, 1e-3)
TOO_SMALL, TOO_LARGE = 0.1, 3.0


def declared(factor: float) -> gc.LipschitzEstimator:
    estimator: gc.LipschitzEstimator = (
        gc.registry().get("lipschitz", "declared").load()(values={"x0": {"x0": 0.03 * factor, "u0": 0.08 * factor}})
    )
    return estimator


def family(name: str, **options: Any) -> gc.GapFamily:
    made: gc.GapFamily = gc.registry().get("gap_family", name).load()(**options)
    return made


def spike(z: Array) -> Array:
    """The ripple, and a spike on 0.2 % of the domain that hardly any sample meets."""
    return np.asarray(ripple(z) + np.where((np.abs(z[:, :1] - 0.3) < 0.002) & (z[:, 1:] > 0), 5.0, 0.0))


def calibrated(folder: Path, backend: gc.System | None = None, **options: Any) -> gc.Certificate:
    model = Drift(1)
    options = {
        "family": family("envelope"),
        "lipschitz": declared(TOO_SMALL),
        "request": ASKED,
        "route": "calibrate",
        **options,
    }
    backend = Perturbed(model, ripple) if backend is None else backend
    c = gc.certify(model, backend, gc.Domain.of(model, RANGES), folder=folder / "run", **options)
    c.save(folder / "run")
    return c


class Drawn(gc.GapFamily):
    """A family that takes any two networks, whose sides cross where constants are too small."""

    name = "drawn"
    routes = ("dominate",)

    def fit(self, problem: gc.GapProblem) -> gc.GapFunction:
        def network(seed: int) -> gc.Network:
            rng = np.random.default_rng(seed)
            weights = rng.standard_normal((8, 2)), rng.standard_normal((1, 8)) / 8
            return gc.Network(weights, (rng.standard_normal(8), np.zeros(1)), "tanh")

        return gc.dominate(problem, self.name, network(1), network(2), counts=(2, 2), budget=5_000)


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
    assert share > 4e-3 or not made.exceedances  # 0 exceedances may give away much, 20 less
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
    assert gc.supremum(moved.gap, moved.domain)[0] == moved.gap.gamma(np.zeros((1, 2)))[0]
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
    c = calibrated(tmp_path, Perturbed(Drift(1), spike), request=Request("statistical", 1e-2, 1e-3, attack=50_000))
    assert 0 < c.attack["violations"] <= c.attack["allowed"]
    assert c.holds
    assert c.claim.kind == "statistical"


def often(z: Array) -> Array:
    """The ripple, and 5 beside it on 3 % of the domain."""
    return np.asarray(ripple(z) + np.where(np.abs(z[:, :1] - 0.3) < 0.03, 5.0, 0.0))


def unlucky(domain: gc.Domain, request: Request) -> int:
    """A seed whose calibration meets none of the 3 %, and whose audit meets many."""
    n = points_needed(request.epsilon, request.beta / 2)
    limit = surprising(n, request.epsilon)
    for seed in range(10_000):
        z, fresh = (domain.draw(n, np.random.default_rng([seed, 1, *more])) for more in ([STREAM], []))
        if (often(z) < 1).all() and (often(fresh) > 1).sum() >= limit:
            return seed
    raise AssertionError("no seed is so unlucky")


def test_an_audit_refutes_a_calibration_that_was_lucky(tmp_path: Path) -> None:
    asked = Request("statistical", 1e-2, 0.9)
    model = Drift(1)
    seed = unlucky(gc.Domain.of(model, RANGES), asked)
    c = calibrated(tmp_path, Perturbed(model, often), request=asked, seed=seed)
    assert c.audit.violations > c.audit.limit
    assert not c.holds
    assert c.claim.kind == "empirical"
    assert "witness" in c.summary()["audit"]
    result = verify_run(tmp_path / "run")
    assert result["verdict"] == "holds"  # as the empirical claim that it is
    path = tmp_path / "run" / "certificate.json"
    data = json.loads(path.read_text())
    path.write_text(
        json.dumps(data | {"claim": {"kind": "statistical", "epsilon": 1e-2, "beta": 0.9, "distribution": UNIFORM}})
    )
    assert "the claim is one that its evidence allows" in failed(tmp_path / "run")


# --- what it does not claim


def test_the_claim_is_about_its_distribution_alone(tmp_path: Path) -> None:
    backend = Perturbed(Drift(1), spike)
    c = calibrated(tmp_path, backend)
    rng = np.random.default_rng(3)
    shifted = np.stack([0.3 + 0.001 * rng.standard_normal(5_000), 2 * rng.random(5_000)], axis=1)
    low, high = c.gap.interval(shifted)
    r = spike(shifted)
    assert ((r < low) | (r > high)).mean() > 0.9
    assert any("does not carry over to others, nor to a closed loop" in s for s in c.assumptions)


def test_a_closed_loop_may_sit_in_what_was_missed(tmp_path: Path) -> None:
    c = calibrated(tmp_path, Perturbed(Drift(1), spike))
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


# --- noise


def noisy() -> Stochastic:
    return Stochastic(Perturbed(Drift(1), ripple), noise={"x0": 0.02})


def test_only_this_route_takes_a_stochastic_backend(tmp_path: Path) -> None:
    with pytest.raises(gc.UsageError, match=r"is stochastic .*; or take route: calibrate"):
        calibrated(tmp_path, noisy(), route=None)
    with pytest.raises(gc.UsageError, match="model is stochastic"):
        gc.certify(StochasticDrift(1), noisy(), gc.Domain.of(Drift(1), RANGES), route="calibrate", folder=tmp_path / "m")


class StochasticDrift(gc.Model):
    """A model that says that it is stochastic."""

    def __init__(self, n: int) -> None:
        inner = Drift(n)
        self.states, self.inputs, self.outputs, self.period = inner.states, inner.inputs, inner.outputs, inner.period
        self.capabilities, self.inner = frozenset({"seed"}), inner

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        return self.inner.step(x, u).x

    def jacobian(self, x: Array, u: Array) -> Array:
        return self.inner.jacobian(x, u)

    def enclosure(self, z: Interval) -> Interval:
        return self.inner.enclosure(z)

    def jacobian_enclosure(self, z: Interval) -> Interval:
        return self.inner.jacobian_enclosure(z)

    def extend(self, extensions: Any) -> gc.Model:
        raise gc.UsageError("none")

    def equations(self) -> str:
        return self.inner.equations()

    def to_spec(self) -> dict[str, Any]:
        return self.inner.to_spec()

    def sites(self, kind: str) -> tuple[str, ...]:
        return ()


@pytest.mark.parametrize("repeats", [1, 8])
def test_of_a_stochastic_backend_noise_is_part_of_the_claim(tmp_path: Path, repeats: int) -> None:
    backend = noisy()
    request = Request("statistical", 2e-2, 1e-2, exceedances=10, repeats=repeats)
    c = calibrated(tmp_path, backend, lipschitz=None, request=request)
    assert c.claim.kind == "statistical"
    draws = "the noise drawn once at each point" if repeats == 1 else "all of 8 draws of the noise at each point"
    assert c.claim.distribution == f"uniform on X × U, {draws}"
    # Fresh points under fresh noise of the backend itself, one seed for all rows.
    z = c.domain.draw(40_000, np.random.default_rng(5))
    low, high = c.gap.interval(z)
    missed = np.zeros(len(z), dtype=bool)
    for seed in range(repeats):
        r = backend.step(z[:, :1], z[:, 1:], seed=seed).x - Drift(1).step(z[:, :1], z[:, 1:]).x
        missed |= ((r < low) | (r > high)).any(axis=1)
    assert 2e-3 < missed.mean() <= 2e-2
    assert verify_run(tmp_path / "run")["verdict"] == "holds", failed(tmp_path / "run")
    assert any("different seeds are independent" in s for s in verify_run(tmp_path / "run")["trusted"])


def test_draws_of_noise_are_pure_and_differ_from_point_to_point() -> None:
    system, z = NoiseDraws(noisy(), 3), np.random.default_rng(0).random((400, 2))
    z[1] = z[0]
    first = system.step(z[:, :1], z[:, 1:]).x
    assert first[0] == first[1]
    assert np.array_equal(system.step(z[::-1, :1], z[::-1, 1:]).x[::-1], first)
    other = NoiseDraws(noisy(), 3, draw=1).step(z[:, :1], z[:, 1:]).x
    plain = noisy().step(z[:, :1], z[:, 1:]).x
    for noise in (first - plain, other - plain):
        assert noise[1:].std() == pytest.approx(0.02, rel=0.15)
        assert len(np.unique(noise)) == 399
    assert abs(np.corrcoef((first - plain)[1:, 0], (other - plain)[1:, 0])[0, 1]) < 0.2


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


SPEC: dict[str, Any] = {
    "version": 1,
    "name": "noisy",
    "model": {
        "kind": "equations",
        "states": {"x0": "m"},
        "inputs": {"u0": "m/s"},
        "derivative": {"x0": "u0"},
        "period": "100 ms",
    },
    "backend": {
        "kind": "stochastic",
        "sensor_noise": {"x0": "2 mm"},
        "of": {
            "kind": "equations",
            "states": {"x0": "m"},
            "inputs": {"u0": "m/s"},
            "derivative": {"x0": "1.1*u0"},
            "period": "100 ms",
        },
    },
    "domain": {"x0": [-1, 1], "u0": [-2, 2]},
    "certificate": {"claim": "statistical", "violation": 0.02, "confidence": 0.99, "route": "calibrate", "exceedances": 5},
    "report": {"rerun": False},
    "expect": {"verdict": "holds"},
}


def test_a_spec_takes_the_route(tmp_path: Path) -> None:
    done = gc.run(SPEC, out=tmp_path)
    assert done.exit_code == 0, done.summary
    assert "audited points lie outside, as it allows" in done.summary["reason"]
    made = done.summary["certificate"]["calibration"]
    assert (made["points"], made["noise"]) == (points_needed(0.02, 0.01 / 2, 5), True)
    report = (done.folder / "report.html").read_text()
    assert "calibration points set γ" in report
    assert verify_run(done.folder)["verdict"] == "holds"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"claim": "deterministic"}, "route calibrate gives a statistical claim at most"),
        ({"route": "dominate"}, "only its points may leave the band"),
        ({"exceedances": -1}, "exceedances"),
        ({"repeats": 0}, "repeats"),
    ],
)
def test_a_spec_that_asks_for_what_cannot_be_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(gc.SpecError, match=message):
        gc.load_spec({**SPEC, "certificate": SPEC["certificate"] | change})


# --- forgeries


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("calibrated")
    calibrated(folder / "one", request=Request("statistical", 1e-2, 1e-3, exceedances=3))
    calibrated(folder / "noise", noisy(), lipschitz=None, request=Request("statistical", 2e-2, 1e-2, repeats=2))
    calibrated(folder / "plain", route=None, lipschitz=declared(TOO_LARGE))
    return folder


def edit(run: Path, change: Callable[[dict[str, Any]], None]) -> None:
    path = run / "certificate.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def smaller(run: Path, factor: float = 0.9) -> None:
    """A smaller widening, with the score that would give it."""
    edit_arrays(run, gap__calibrated__widening=lambda w: w * factor)
    w = np.load(run / "certificate.npz")["gap.calibrated.widening"].tolist()
    edit(run, lambda d: d["calibration"].update(widening=w, score=d["calibration"]["score"] * factor))


def dropped(run: Path, keep: Callable[[Array, Array], Any]) -> None:
    """Calibration points removed, every digest and count mended."""
    folder = run / "samples" / "calibration-1"
    z, r = np.load(folder / "points.npy"), np.load(folder / "chunk-000000.npy")
    rows = keep(z, r)
    z, r = z[rows], r[rows]
    np.save(folder / "points.npy", z)
    np.save(folder / "chunk-000000.npy", r)
    header = json.loads((folder / "manifest.jsonl").read_text().splitlines()[0])
    header |= {"points": hashlib.sha256(z.tobytes() + str(z.shape).encode()).hexdigest(), "count": len(z)}
    shard = hashlib.sha256((folder / "chunk-000000.npy").read_bytes()).hexdigest()
    (folder / "manifest.jsonl").write_text(json.dumps(header) + "\n" + json.dumps({"chunk": 0, "sha256": shard}) + "\n")
    total = hashlib.sha256(json.dumps([header, [shard]]).encode()).hexdigest()

    def mend(d: dict[str, Any]) -> None:
        d["digests"]["calibration-1"] = total
        d["calibration"]["points"] = d["samples"]["calibration"] = len(z)

    edit(run, mend)


def less(run: Path) -> None:
    """ε and β of claim and audit halved in ε."""
    edit(run, lambda d: (d["claim"].update(epsilon=5e-3), d["audit"].update(epsilon=5e-3)))


FORGERIES: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "a smaller widening": ("one", smaller),
    "a slightly smaller widening": ("one", lambda run: smaller(run, 1 - 1e-6)),
    "a smaller widening beside the score": ("one", lambda run: edit_arrays(run, gap__calibrated__widening=lambda w: w * 0.9)),
    "no widening": ("one", lambda run: smaller(run, 0.0)),
    "a larger scale": ("one", lambda run: edit_arrays(run, calibration__scale=lambda s: s * 2)),
    "another rank": ("one", lambda run: edit(run, lambda d: d["calibration"].update(exceedances=4))),
    "a better rank": ("one", lambda run: edit(run, lambda d: d["calibration"].update(exceedances=2))),
    "a negative rank": ("one", lambda run: edit(run, lambda d: d["calibration"].update(exceedances=-1))),
    "a removed point": ("one", lambda run: dropped(run, lambda z, r: np.arange(len(z) - 1))),
    "the worst point removed": ("one", lambda run: dropped(run, lambda z, r: np.arange(len(z)) != np.argmax(r[:, 0]))),
    "a larger number": ("one", lambda run: edit(run, lambda d: d["calibration"].update(points=10**6))),
    "another calibration's number": ("one", lambda run: edit(run, lambda d: d["calibration"].update(number=2))),
    "a smaller ε": ("one", less),
    "a negative ε": ("one", lambda r: edit(r, lambda d: (d["claim"].update(epsilon=-0.5), d["audit"].update(epsilon=-0.5)))),
    "a smaller β": ("one", lambda r: edit(r, lambda d: (d["claim"].update(beta=1e-4), d["audit"].update(beta=1e-4)))),
    "more violations allowed": ("one", lambda run: edit(run, lambda d: d["audit"].update(allowed=500))),
    "a deterministic claim": ("one", lambda run: edit(run, lambda d: d.update(claim={"kind": "deterministic"}))),
    "a route that is none": ("one", lambda run: edit(run, lambda d: d.update(route="dominate"))),
    "no draws of noise": ("noise", lambda run: edit(run, lambda d: d["calibration"].update(noise=False))),
    "fewer draws of noise": ("noise", lambda run: edit(run, lambda d: d["calibration"].update(repeats=1))),
    "violations allowed without a calibration": (
        "plain",
        lambda run: edit(run, lambda d: d["audit"].update(allowed=500, violations=3)),
    ),
    "a calibration that none was": ("plain", lambda run: edit(run, lambda d: d.update(route="calibrate"))),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_forgeries_are_caught(runs: Path, tmp_path: Path, name: str) -> None:
    base, forge = FORGERIES[name]
    shutil.copytree(runs / base / "run", tmp_path / "run")
    assert verify_run(tmp_path / "run")["verdict"] == "holds"
    forge(tmp_path / "run")
    assert verify_run(tmp_path / "run")["verdict"] == "fails"
