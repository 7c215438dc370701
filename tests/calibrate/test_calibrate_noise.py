"""Route calibrate beside a stochastic backend: noise is part of the claim, from Python and from a spec."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibrating import RANGES, calibrated, noisy
from forging import failed

import gapcert as gc
from gapcert.certification.routes import Request
from gapcert.numerics.intervals import Interval
from gapcert.numerics.order_statistics import points_needed
from gapcert.testing.toys import Drift
from gapcert_calibrate.stochastic_backend import NoiseDraws
from gapcert_verify.verify import verify_run

Array = np.ndarray


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


@pytest.mark.exam
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
