"""Forged calibrations: `gapcert verify` catches each of them."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibrating import TOO_LARGE, calibrated, declared, noisy
from forging import edit_arrays, edit_json

from gapcert.certification.routes import Request
from gapcert_verify.verify import verify_run

Array = np.ndarray


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("calibrated")
    calibrated(folder / "one", request=Request("statistical", 1e-2, 1e-3, exceedances=3))
    calibrated(folder / "noise", noisy(), lipschitz=None, request=Request("statistical", 2e-2, 1e-2, repeats=2))
    calibrated(folder / "plain", route=None, lipschitz=declared(TOO_LARGE))
    return folder


def smaller(run: Path, factor: float = 0.9) -> None:
    """A smaller widening, with the score that would give it."""
    edit_arrays(run, gap__calibrated__widening=lambda w: w * factor)
    w = np.load(run / "certificate.npz")["gap.calibrated.widening"].tolist()
    edit_json(run, calibration__widening=w, calibration__score=lambda score: score * factor)


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

    edit_json(run, **{"digests__calibration-1": total, "calibration__points": len(z), "samples__calibration": len(z)})


def less(run: Path) -> None:
    """ε of claim and audit halved."""
    edit_json(run, claim__epsilon=5e-3, audit__epsilon=5e-3)


FORGERIES: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "a smaller widening": ("one", smaller),
    "a slightly smaller widening": ("one", lambda run: smaller(run, 1 - 1e-6)),
    "a smaller widening beside the score": ("one", lambda run: edit_arrays(run, gap__calibrated__widening=lambda w: w * 0.9)),
    "no widening": ("one", lambda run: smaller(run, 0.0)),
    "a larger scale": ("one", lambda run: edit_arrays(run, calibration__scale=lambda s: s * 2)),
    "another rank": ("one", lambda run: edit_json(run, calibration__exceedances=4)),
    "a better rank": ("one", lambda run: edit_json(run, calibration__exceedances=2)),
    "a negative rank": ("one", lambda run: edit_json(run, calibration__exceedances=-1)),
    "a removed point": ("one", lambda run: dropped(run, lambda z, r: np.arange(len(z) - 1))),
    "the worst point removed": ("one", lambda run: dropped(run, lambda z, r: np.arange(len(z)) != np.argmax(r[:, 0]))),
    "a larger number": ("one", lambda run: edit_json(run, calibration__points=10**6)),
    "another calibration's number": ("one", lambda run: edit_json(run, calibration__number=2)),
    "a smaller ε": ("one", less),
    "a negative ε": ("one", lambda r: edit_json(r, claim__epsilon=-0.5, audit__epsilon=-0.5)),
    "a smaller β": ("one", lambda r: edit_json(r, claim__beta=1e-4, audit__beta=1e-4)),
    "more violations allowed": ("one", lambda run: edit_json(run, audit__allowed=500)),
    "a deterministic claim": ("one", lambda run: edit_json(run, claim={"kind": "deterministic"})),
    "a route that is none": ("one", lambda run: edit_json(run, route="dominate")),
    "no draws of noise": ("noise", lambda run: edit_json(run, calibration__noise=False)),
    "fewer draws of noise": ("noise", lambda run: edit_json(run, calibration__repeats=1)),
    "violations allowed without a calibration": (
        "plain",
        lambda run: edit_json(run, audit__allowed=500, audit__violations=3),
    ),
    "a calibration that none was": ("plain", lambda run: edit_json(run, route="calibrate")),
}


@pytest.mark.exam
@pytest.mark.parametrize("name", FORGERIES)
def test_forgeries_are_caught(runs: Path, tmp_path: Path, name: str) -> None:
    base, forge = FORGERIES[name]
    shutil.copytree(runs / base / "run", tmp_path / "run")
    assert verify_run(tmp_path / "run")["verdict"] == "holds"
    forge(tmp_path / "run")
    assert verify_run(tmp_path / "run")["verdict"] == "fails"
