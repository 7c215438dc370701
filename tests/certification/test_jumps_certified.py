"""Jumps from certificate to verification: what is said, what is stored, what is warned of, and forgeries that are caught."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import pytest
from rough_fields import Contact, bounce, slide

import gapcert as gc
from gapcert.certification.samples.executors import threads
from gapcert.numerics.atomic_files import npz_bytes
from gapcert_bounds.constants.piecewise import Piecewise
from gapcert_bounds.constants.wood_zhang import WoodZhang
from gapcert_bounds.families.constant import Constant
from gapcert_bounds.testing.fields import Kink, Nothing, Waves
from gapcert_report.words.summary import in_words
from gapcert_report.words.words import jump_sentence
from gapcert_verify.verify import verify_run


def certified(folder, field, estimator, family=None, **more):
    certificate = gc.certify(
        Nothing(field), field, field.domain, lipschitz=estimator, family=family, folder=folder, executor=threads, **more
    )
    certificate.save(folder)
    return certificate


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("jumps") / "run"
    certified(folder, Contact(slide), Piecewise(budget=8_000), request=gc.Request("statistical", attack=100_000))
    return folder


def test_a_certificate_says_where_it_jumps(folder):
    data = json.loads((folder / "certificate.json").read_text())
    assert data["claim"]["kind"] == "statistical"
    assert data["attack"] == {"points": 100_000, "violations": 0, "gamma_violations": 0}
    stated = data["lipschitz"]
    assert 0 < stated["marked"] < stated["cells"]
    assert [j["state"] for j in stated["jumps"]] == ["x0", "x1"]
    assert stated["jumps"][1]["size"] == pytest.approx(0.2, rel=1e-3)
    assert set(stated["jumps"][1]["where"]) == {"x0", "x1", "u0"}
    sentence = next(a for a in data["assumptions"] if "hold per cell" in a)
    assert f"of {stated['cells']} that tile the domain; {stated['marked']} of them" in sentence
    assert "x1 by 0.2 at (x0 = " in sentence
    assert "warnings" not in data
    assert "x1 by 0.2 at u0 = " in jump_sentence(data)
    assert any("jumps in" in line for line in in_words({"verdict": "holds", "certificate": data}))


def test_it_verifies_without_the_code_that_made_it(folder):
    result = verify_run(folder)
    assert [c for c in result["checks"] if not c["passed"]] == []
    assert result["verdict"] == "holds"


@pytest.mark.exam
def test_a_certificate_with_a_tilted_jump_verifies_too(tmp_path):
    certificate = certified(tmp_path / "run", Contact(bounce), Piecewise(budget=9_000, cells=60), Constant())
    assert certificate.lipschitz.jumps
    assert certificate.holds
    assert verify_run(tmp_path / "run")["verdict"] == "holds"


FORGERIES = {
    "no jumps": lambda a: a | {"cells.J": 0 * a["cells.J"], "gap.cells.J": 0 * a["gap.cells.J"]},
    "jumps of the envelope alone": lambda a: a | {"gap.cells.J": a["gap.cells.J"] / 2},
    "a cut elsewhere": lambda a: {k: v * 0.5 if k.endswith("cells.cut") else v for k, v in a.items()},
    "cells that do not tile": lambda a: {k: 0 * v if k.endswith("cells.child") else v for k, v in a.items()},
    "smaller constants": lambda a: {k: v / 50 if k.endswith("cells.L") else v for k, v in a.items()},
    "a negative jump": lambda a: {k: v - 1 if k.endswith("cells.J") else v for k, v in a.items()},
}


@pytest.mark.parametrize("forgery", FORGERIES)
def test_forged_cells_are_caught(folder, tmp_path, forgery):
    copy = tmp_path / "run"
    copy.mkdir()
    (copy / "samples").symlink_to(folder / "samples")
    with np.load(folder / "certificate.npz") as stored:
        content = npz_bytes(FORGERIES[forgery]({k: stored[k] for k in stored.files}))
    data = json.loads((folder / "certificate.json").read_text()) | {"arrays": hashlib.sha256(content).hexdigest()}
    (copy / "certificate.npz").write_bytes(content)
    (copy / "certificate.json").write_text(json.dumps(data))
    result = verify_run(copy)
    assert result["verdict"] == "fails"
    assert next(c for c in result["checks"] if c["check"] == "stored data match their digests")["passed"]


@pytest.mark.parametrize("law", [slide, bounce])
def test_one_constant_and_a_jump_are_warned_of(tmp_path, law):
    said = []
    certificate = certified(tmp_path / "run", Contact(law), WoodZhang(pairs=500), emit=said.append)
    (warning,) = (w for w in certificate.summary()["warnings"] if "slope" in w)
    assert "f̂ − f seems to jump there" in warning
    assert "lipschitz.residual: {kind: piecewise}" in warning
    assert [e.data["message"] for e in said if e.name == "warning" and e.stage == "lipschitz"] == [warning]
    spent = json.loads((tmp_path / "run" / "certificate.json").read_text())["samples"]["lipschitz"]
    assert 3_000 < spent < 4_000


@pytest.mark.parametrize("field", [Waves.smooth(), Kink(np.array([[0.5, 0.25]]), np.array([0.11, -0.3]))])
def test_nothing_is_warned_of_where_slopes_settle(tmp_path, field):
    certificate = certified(tmp_path / "run", field, WoodZhang(pairs=500))
    assert "warnings" not in certificate.summary()
    assert "growth" not in certificate.lipschitz.diagnostics


def test_the_same_run_again_asks_for_nothing(tmp_path):
    field = Contact(slide)
    first = certified(tmp_path / "run", field, Piecewise(budget=6_000))
    written = {p: p.stat().st_mtime_ns for p in (tmp_path / "run" / "samples").rglob("chunk-*.npy")}
    again = certified(tmp_path / "run", field, Piecewise(budget=6_000))
    assert again.digests == first.digests
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "run" / "samples").rglob("chunk-*.npy")} == written
