"""Forged calibrations on a recording: `gapcert verify` catches each of them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forging import edit_arrays, edit_json
from measuring import calibrated

from gapcert.numerics.order_statistics import DRAWN_WINDOWS, WINDOWS
from gapcert_verify.verify import verify_run


def without(folder: Path, window: int) -> None:
    """A held window removed, and every count mended."""
    with np.load(folder / "certificate.npz") as stored:
        of = stored["held.window"]
    rows = of != of[window]
    edit_arrays(folder, **{f"held__{k}": lambda values: values[rows] for k in ("z", "r", "window")})
    edit_json(folder, recording__units=lambda n: n - 1, recording__windows__calibration=lambda n: n - 1)
    edit_json(folder, recording__transitions__calibration=int(rows.sum()), samples__calibration=int(rows.sum()))


def narrower(folder: Path) -> None:
    edit_arrays(folder, gap__calibrated__widening=lambda w: w * 0.9)
    w = np.load(folder / "certificate.npz")["gap.calibrated.widening"].tolist()
    edit_json(folder, recording__widening=w, recording__score=lambda score: score * 0.9)


def confident(folder: Path, beta: float) -> None:
    """A confidence, with the distribution that goes with one."""
    edit_json(folder, claim=lambda claim: claim | {"beta": beta, "distribution": DRAWN_WINDOWS})


FORGERIES: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "a smaller widening": ("average", narrower),
    "a removed window": ("average", lambda f: without(f, 0)),
    "a lower rank": ("average", lambda f: edit_json(f, recording__rank=lambda rank: rank - 1)),
    "a negative ε": ("average", lambda f: edit_json(f, claim__epsilon=-1.0)),
    "a smaller ε": ("average", lambda f: edit_json(f, claim__epsilon=0.01)),
    "a confidence beside exchangeable windows": ("average", lambda f: edit_json(f, claim=lambda c: c | {"beta": 0.5})),
    "a confidence": ("average", lambda f: confident(f, 1e-6)),
    "a deterministic claim": ("average", lambda f: edit_json(f, claim={"kind": "deterministic"})),
    "another distribution": ("average", lambda f: edit_json(f, claim__distribution="every closed loop")),
    "another seed": ("average", lambda f: edit_json(f, seed=5)),
    "a larger scale": ("average", lambda f: edit_arrays(f, calibration__scale=lambda s: s * 2)),
    "softened residuals": ("average", lambda f: edit_arrays(f, held__r=lambda r: r * 0.5)),
    "a smaller mean γ": ("average", lambda f: edit_json(f, states__x0__gamma_mean=lambda g: g * 0.99)),
    "fewer transitions": ("average", lambda f: edit_json(f, samples__bound=3)),
    "an array without digest": (
        "average",
        lambda f: (f / "certificate.npz").write_bytes((f / "certificate.npz").read_bytes() + b" "),
    ),
    "a lower rank at β": ("confident", lambda f: edit_json(f, recording__rank=lambda rank: rank - 1)),
    "a smaller β": ("confident", lambda f: edit_json(f, claim__beta=lambda beta: beta / 4)),
    "β of 1": ("confident", lambda f: edit_json(f, claim__beta=1.0)),
    "dependent windows": ("confident", lambda f: edit_json(f, claim__distribution=WINDOWS)),
}


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    calibrated().save(folder / "average")
    calibrated(violation=0.1, confidence=0.9).save(folder / "confident")
    return folder


@pytest.mark.exam
@pytest.mark.parametrize("name", FORGERIES)
def test_forgeries_are_caught(saved: Path, tmp_path: Path, name: str) -> None:
    base, forge = FORGERIES[name]
    shutil.copytree(saved / base, tmp_path / "run")
    assert verify_run(tmp_path / "run")["verdict"] == "holds"
    forge(tmp_path / "run")
    assert verify_run(tmp_path / "run")["verdict"] == "fails"
