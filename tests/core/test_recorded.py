"""Calibration on a recording: windows are the units, and what is claimed of a further one is marginal."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gapcert as gc
from gapcert.testing.toys import Drift, ripple
from gapcert.verify import verify_run

Array = np.ndarray
ROOT = Path(__file__).parents[2]
RANGES = {"x0": (-1.0, 1.0), "u0": (-2.0, 2.0)}
STEPS, PERIOD = 20, 0.1


def trajectory(rng: np.random.Generator, noise: float = 0.01) -> gc.Trajectory:
    """x⁺ = x + τ u + ripple, with a noise whose size is that of its whole trajectory."""
    x, u, out = rng.uniform(-0.8, 0.8), rng.uniform(-1, 1), []
    size = noise * rng.exponential()
    for _ in range(STEPS + 1):
        u = float(np.clip(u + rng.normal(scale=0.3) - x, -2, 2))
        out.append((x, u))
        z = np.array([[x, u]])
        x = float(x + PERIOD * u + ripple(z)[0, 0] + size * rng.normal())
    values = np.array(out)
    return gc.Trajectory(PERIOD * np.arange(STEPS + 1), {"x0": values[:, 0], "u0": values[:, 1]})


def recording(n: int, seed: int = 0) -> gc.Recording:
    rng = np.random.default_rng(seed)
    return gc.Recording(tuple(trajectory(rng) for _ in range(n)))


def calibrated(n: int = 90, data: int = 0, **options: Any) -> gc.CalibratedRecording:
    model = Drift(1)
    return gc.calibrate_recording(model, recording(n, data), gc.Domain.of(model, RANGES), **{"violation": 0.05} | options)


def broken(c: gc.CalibratedRecording, log: gc.Recording) -> bool:
    return gc.check(c.certified, log).band_violations > 0


def test_a_further_trajectory_stays_inside_as_often_as_is_said() -> None:
    missed = []
    for seed in range(60):
        c = calibrated(30, seed, violation=0.2, seed=seed)
        missed += [broken(c, gc.Recording((tr,))) for tr in recording(20, 10_000 + seed).trajectories]
    share = float(np.mean(missed))
    assert share <= 0.2 + 0.06  # four standard deviations of the mean of 60 calibrations
    assert share > 0.05  # it is a calibrated band, not a wide one


def test_the_claim_is_marginal_and_says_so() -> None:
    c = calibrated()
    assert c.claim.kind == "statistical"
    assert c.claim.beta is None
    assert c.claim.epsilon == 0.05
    assert c.claim.carried.kind == "empirical"
    assert "exchangeable" in c.assumptions[0]
    assert "assumed, not tested" in c.assumptions[0]
    assert "no confidence is stated" in c.assumptions[1]
    assert c.units == 90
    assert set(c.fit.window).isdisjoint(c.held.window)
    assert calibrated(seed=1).summary() != c.summary()
    assert calibrated().summary() == c.summary()


def test_transitions_of_one_window_are_no_units_of_their_own() -> None:
    """Were each transition a unit, the band would be that of the mean noise, and miss trajectories far too often."""
    c = calibrated(90)
    model = Drift(1)
    single = gc.calibrate_recording(model, recording(90), gc.Domain.of(model, RANGES), violation=0.05, window=PERIOD)
    assert single.units > 15 * 90
    fresh = [gc.Recording((tr,)) for tr in recording(200, 77).trajectories]
    assert np.mean([broken(c, log) for log in fresh]) < 0.12
    assert np.mean([broken(single, log) for log in fresh]) > 0.2


def test_windows_keep_their_transitions_whole() -> None:
    c = calibrated(60, window=0.5, violation=0.05)
    assert c.units == 60 * 4
    assert len(c.fit.z) + len(c.held.z) <= 60 * 4 * 5  # that which ends in the next window belongs to neither


def test_too_few_windows_say_how_many_are_needed() -> None:
    what = r"15 trajectories .* 5 of them for the fit; ε = 0\.05 needs 19 others, and 10 allow 0\.09091 at best"
    with pytest.raises(gc.UsageError, match=what):
        calibrated(15)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"window": 0.01}, "expected at least the period"),
        ({"fit": 1.0}, "expected a share"),
        ({"family": "multilinear"}, "points of its own choice"),
        ({"lipschitz": "wood-zhang"}, "a recording answers no questions"),
    ],
)
def test_what_does_not_fit_is_one_sentence(options: dict[str, Any], message: str) -> None:
    kinds = {"family": "gap_family", "lipschitz": "lipschitz"}
    made = {k: gc.registry().get(kinds[k], v).load()() if k in kinds else v for k, v in options.items()}
    with pytest.raises(gc.UsageError, match=message):
        calibrated(**made)


@pytest.mark.parametrize("name", ["envelope", "constant", "basis"])
def test_what_was_saved_verifies(tmp_path: Path, name: str) -> None:
    options = {"functions": ["1", "u0^2"]} if name == "basis" else {}
    c = calibrated(family=gc.registry().get("gap_family", name).load()(**options))
    c.save(tmp_path)
    result = verify_run(tmp_path)
    assert result["verdict"] == "holds", result
    assert any("exchangeable" in s for s in result["trusted"])


def edit(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    path = folder / "certificate.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def edit_arrays(folder: Path, change: Callable[[dict[str, Array]], Any]) -> None:
    import hashlib

    with np.load(folder / "certificate.npz") as stored:
        arrays = dict(stored)
    change(arrays)
    np.savez(folder / "certificate.npz", **arrays)
    digest = hashlib.sha256((folder / "certificate.npz").read_bytes()).hexdigest()
    edit(folder, lambda d: d.update(arrays=digest))


def without(folder: Path, window: int) -> None:
    """A held window removed, and every count mended."""

    def drop(arrays: dict[str, Array]) -> None:
        rows = arrays["held.window"] != arrays["held.window"][window]
        arrays.update({k: arrays[k][rows] for k in ("held.z", "held.r", "held.window")})

    edit_arrays(folder, drop)
    kept = np.load(folder / "certificate.npz")["held.window"]

    def mend(d: dict[str, Any]) -> None:
        d["recording"]["units"] -= 1
        d["recording"]["windows"]["calibration"] -= 1
        d["recording"]["transitions"]["calibration"] = len(kept)

    edit(folder, mend)


def narrower(folder: Path) -> None:
    edit_arrays(folder, lambda a: a.update({"gap.calibrated.widening": a["gap.calibrated.widening"] * 0.9}))
    w = np.load(folder / "certificate.npz")["gap.calibrated.widening"].tolist()
    edit(folder, lambda d: d["recording"].update(widening=w, score=d["recording"]["score"] * 0.9))


FORGERIES: dict[str, Callable[[Path], Any]] = {
    "a smaller widening": narrower,
    "a removed window": lambda f: without(f, 0),
    "a lower rank": lambda f: edit(f, lambda d: d["recording"].update(rank=d["recording"]["rank"] - 1)),
    "a negative ε": lambda f: edit(f, lambda d: d["claim"].update(epsilon=-1.0)),
    "a smaller ε": lambda f: edit(f, lambda d: d["claim"].update(epsilon=0.01)),
    "a confidence": lambda f: edit(f, lambda d: d["claim"].update(beta=1e-6)),
    "a deterministic claim": lambda f: edit(f, lambda d: d.update(claim={"kind": "deterministic"})),
    "another distribution": lambda f: edit(f, lambda d: d["claim"].update(distribution="every closed loop")),
    "another seed": lambda f: edit(f, lambda d: d.update(seed=5)),
    "a larger scale": lambda f: edit_arrays(f, lambda a: a.update({"calibration.scale": a["calibration.scale"] * 2})),
    "softened residuals": lambda f: edit_arrays(f, lambda a: a.update({"held.r": a["held.r"] * 0.5})),
    "an array without digest": lambda f: (f / "certificate.npz").write_bytes((f / "certificate.npz").read_bytes() + b" "),
}


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    calibrated().save(folder)
    return folder


@pytest.mark.parametrize("name", FORGERIES)
def test_forgeries_are_caught(saved: Path, tmp_path: Path, name: str) -> None:
    shutil.copytree(saved, tmp_path / "run")
    FORGERIES[name](tmp_path / "run")
    assert verify_run(tmp_path / "run")["verdict"] == "fails"


def test_a_real_double_pendulum() -> None:
    """80 s of a free double pendulum: in windows of 0.5 s, 107 of them left for the calibration."""
    spec = gc.load_spec(ROOT / "specs/diagnose/double_pendulum_free.yaml")
    one = {k: spec.data[k] for k in ("version", "name", "model")}
    model = gc.load_spec({**one, "model": {**one["model"], "period": "4 ms"}}).build("model")
    log = spec.build("recording").read()
    domain = gc.Domain.of(model, {"q1": (2.0, 4.3), "q2": (1.3, 4.95), "q1_dot": (-11, 12), "q2_dot": (-15.5, 15.5)})
    c = gc.calibrate_recording(model, log, domain, violation=0.01, window=0.5)
    assert (c.units, c.rank) == (160, 107)
    assert gc.check(c.certified, log).band_violations <= 0.001 * len(c.held.z)
    with pytest.raises(gc.UsageError, match=r"1 trajectories .* needs 99 others"):
        gc.calibrate_recording(model, log, domain, violation=0.01)
