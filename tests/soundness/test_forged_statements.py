"""What a stored certificate says beside its bounds: forged hidden state, symmetries, cells and relations, and damage."""

from __future__ import annotations

import hashlib
import json
import shutil

import numpy as np
import pytest
from faulty import Coasting
from rough_fields import Contact, slide

import gapcert as gc
from gapcert.certification.gates.hidden_state import HiddenPlan
from gapcert.certification.routes import Request
from gapcert.certification.samples.executors import threads
from gapcert.testing.toys import Drift, Perturbed, ripple
from gapcert_bounds.constants.piecewise import Piecewise
from gapcert_bounds.families.constant import Constant
from gapcert_bounds.testing.fields import Nothing
from gapcert_verify.verify import verify_run

ASKED = Request("statistical", 1e-2, 1e-3)
REST = {"kind": "statistical", "epsilon": 1e-2, "beta": 1e-3, "distribution": "uniform on X × U, hidden state at its default"}
PLAIN = {**REST, "distribution": "uniform on X × U"}


def inputs_alone(z):
    n = z.shape[1] // 2
    return 0.02 * z[:, n:] ** 2 + 0.005


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    out = tmp_path_factory.mktemp("stated")

    def certify(name, model, backend, domain, **options):
        folder = out / name
        options = {"request": ASKED, "executor": threads, "ledger": folder / "ledger.json", **options}
        gc.certify(model, backend, domain, folder=folder, **options).save(folder)

    drift, field = Drift(2), Contact(slide)
    domain = gc.Domain.of(drift, dict.fromkeys(("x0", "x1", "u0", "u1"), (-1.0, 1.0)))
    cut = gc.Domain(domain.states, domain.inputs, (gc.plugin.Relation("u0 + u1 <= 1 m/s", (0.0, 0.0, 1.0, 1.0), 1.0),))
    model = Drift(1)
    model.states, model.inputs, model.outputs = Coasting().states, Coasting().inputs, Coasting().states
    line = gc.Domain.of(model, {"p": (-1.0, 1.0), "u": (-1.0, 1.0)})
    certify("symmetry", drift, Perturbed(drift, inputs_alone), domain, symmetries=("x0", "x1"))
    certify("relations", drift, Perturbed(drift, ripple), cut)
    certify("sample", model, Coasting(), line, hidden=HiddenPlan("sample", {"v": (-1.0, 1.0)}))
    certify("default", model, Coasting(), line, hidden=HiddenPlan("default"))
    certify("cells", Nothing(field), field, field.domain, lipschitz=Piecewise(budget=4_000))
    return out


def put(run, path, value):
    """Change one entry of certificate.json; a value of None removes it."""
    data = json.loads((run / "certificate.json").read_text())
    *parents, last = path.split(".")
    node = data
    for key in parents:
        node = node[key]
    if value is None:
        del node[last]
    else:
        node[last] = value(node[last]) if callable(value) else value
    (run / "certificate.json").write_text(json.dumps(data))


def scale(run, name, by):
    """Change one array, and mend the digest."""
    with np.load(run / "certificate.npz") as stored:
        arrays = dict(stored)
    np.savez(run / "certificate.npz", **{**arrays, name: arrays[name] * by})
    put(run, "arrays", hashlib.sha256((run / "certificate.npz").read_bytes()).hexdigest())


FORGERIES = {
    "hidden state forgotten": ("sample", {"hidden": None, "claim": PLAIN}, "none is stated"),
    "drawn, and not said": ("sample", {"hidden.distribution": "", "claim": PLAIN}, "does not say how"),
    "drawn, and said to be at rest": (
        "sample",
        {"hidden.distribution": REST["distribution"].removeprefix("uniform on X × U"), "claim": REST},
        "not say how",
    ),
    "another mode": ("sample", {"hidden.mode": "augment"}, "the bound over hidden states is stated as"),
    "a smaller bound": ("sample", {"hidden.bound.p": 1e-9}, "the bound over hidden states is stated as"),
    "a harmless spread": ("sample", {"hidden.spread.p": 0.0}, "harmless is stated otherwise"),
    "harmless": (
        "sample",
        {"hidden.harmless": True, "hidden.distribution": "", "claim": PLAIN},
        "harmless is stated otherwise",
    ),
    "proved over drawn hidden state": (
        "sample",
        {"hidden": None, "claim": {"kind": "deterministic"}, "lipschitz.provenance": "declared"},
        "a deterministic claim rests on drawn hidden states",
    ),
    "never attacked": ("default", {"hidden.attack": None, "claim": REST}, "KeyError: 'attack'"),
    "attacked without success": ("default", {"hidden.attack.violations": 0, "claim": REST}, "share or its witness"),
    "at rest, and harmless": (
        "default",
        {"hidden.harmless": True, "hidden.distribution": "", "hidden.attack": None, "claim": PLAIN},
        "harmless is stated otherwise",
    ),
    "an axis that was not looked at": (
        "symmetry",
        {"symmetry.axes": [0, 1, 2], "symmetry.names": ["x0", "x1", "u0"]},
        "do not differ along every axis",
    ),
    "other names": ("symmetry", {"symmetry.names": ["u0", "u1"]}, "are not called u0, u1"),
    "no symmetry": ("symmetry", {"symmetry": lambda _: None}, "a symmetry that is not stated"),
    "a smaller deviation": ("symmetry", {"symmetry.deviation": [0.0, 0.0]}, "the largest change of the pairs is another one"),
    "fewer cells": ("cells", {"lipschitz.cells": 1}, "and others are stated"),
    "fewer that jump": ("cells", {"lipschitz.marked": 0}, "and others are stated"),
    "a smaller share": ("cells", {"lipschitz.marked_share": 0.0}, "and others are stated"),
    "no relation": ("relations", {"domain.relations": []}, "other points were audited"),
    "a relation that leaves nothing": ("relations", {"domain.relations": lambda r: [{**r[0], "b": -50.0}]}, "satisfy them"),
    "names that are no names": ("relations", {"domain.axes": ["x0", "x1", "u0", "u0"]}, "are no names of 4 axes"),
    "an audit without a digest": ("relations", {"digests.audit-1": None}, "stored without a digest"),
    "an unknown predictor": ("relations", {"predictor": "best"}, "is no predictor"),
    "no tightness": ("relations", {"states.x0.tightness": None}, "x0.resolved is stated wrongly"),
}


@pytest.mark.parametrize("kind", ["symmetry", "relations", "sample", "default", "cells"])
def test_honest_certificates_verify(runs, kind):
    assert [c for c in verify_run(runs / kind)["checks"] if not c["passed"]] == []


@pytest.mark.parametrize("name", FORGERIES)
def test_forgeries_are_caught(runs, tmp_path, name):
    base, changes, detail = FORGERIES[name]
    run = tmp_path / "run"
    shutil.copytree(runs / base, run)
    for path, value in changes.items():
        put(run, path, value)
    failed = [c["detail"] for c in verify_run(run)["checks"] if not c["passed"]]
    assert any(detail in text for text in failed), failed


def test_arithmetic_that_errs_by_less_hides_a_spread(runs, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(runs / "relations", run)
    scale(run, "rounding", 0.5)
    failed = [c["detail"] for c in verify_run(run)["checks"] if not c["passed"]]
    assert any("none is stated" in text for text in failed), failed


@pytest.mark.parametrize("kind", ["sample"])
def test_damage_is_no_crash(runs, tmp_path, kind):
    run = tmp_path / "run"
    shutil.copytree(runs / kind, run)
    whole = (run / "certificate.json").read_text()
    for key in ("audit", "claim", "digests", "domain", "form", "hidden", "lipschitz", "samples", "states", "symmetry", "seed"):
        for value in (7, [], {"a": []}):
            (run / "certificate.json").write_text(json.dumps({**json.loads(whole), key: value}))
            if not refused(run):
                assert verify_run(run)["verdict"] == "fails" or (key, value) == ("seed", 7)


def refused(run):
    """In one sentence, since what is left is no certificate."""
    try:
        verify_run(run)
    except gc.UsageError as error:
        return "damaged" in str(error)
    return False


@pytest.mark.exam
def test_a_constant_over_a_cell_without_samples_is_not_certified(tmp_path):
    field = Contact(slide)
    folder = tmp_path / "run"
    made = gc.certify(
        Nothing(field),
        field,
        field.domain,
        lipschitz=Piecewise(budget=4_000),
        family=Constant(),
        folder=folder,
        executor=threads,
    )
    made.save(folder)
    assert verify_run(folder)["verdict"] == "holds"
    with np.load(folder / "certificate.npz") as stored:
        arrays = dict(stored)
    # A thin slice of a cell, between two samples, as a cell of its own.
    cells = made.lipschitz.cells
    c = int(np.flatnonzero(~cells.marked)[0])
    x = np.unique(made.samples.z[:, 0])
    x = x[(x > cells.boxes.lo[c, 0]) & (x < cells.boxes.hi[c, 0])]
    k = int(np.diff(x).argmax())
    cuts = x[k] + np.array([1, 2]) / 3 * (x[k + 1] - x[k])
    m, n = len(cells), len(cells.axis)
    child = np.where(arrays["cells.child"] == -1 - c, n, arrays["cells.child"])
    arrays["cells.child"] = np.vstack([child, [[-1.0 - c, n + 1], [-1.0 - m, -2.0 - m]]])
    arrays["cells.axis"], arrays["cells.cut"] = np.append(arrays["cells.axis"], [0, 0]), np.append(arrays["cells.cut"], cuts)
    for name in ("cells.L", "cells.J"):
        arrays[name] = np.concatenate([arrays[name], arrays[name][[c, c]]])
    np.savez(folder / "certificate.npz", **arrays)
    put(folder, "arrays", hashlib.sha256((folder / "certificate.npz").read_bytes()).hexdigest())
    put(folder, "lipschitz.cells", m + 2)
    failed = [c["detail"] for c in verify_run(folder)["checks"] if not c["passed"]]
    assert any("has no sample" in text for text in failed), failed


def test_a_cell_without_samples_is_refused_before_anything_is_fitted(tmp_path):
    """An estimator's anchors are a claim, and claims are checked."""

    class Careless(gc.plugin.LipschitzEstimator):
        provenance = "estimated"

        def bound(self, problem):
            d, child = problem.domain, np.array([[-1, -2]])
            constants, jumps = np.ones((2, 2, 3)), np.zeros((2, 2))
            cells = gc.plugin.Cells(d.low, d.high, np.array([0]), np.array([0.9]), child, constants, jumps, d.centre[None])
            return gc.plugin.LipschitzBound(cells.worst, np.zeros((2, 3)), "estimated", "careless", cells=cells)

    field = Contact(slide)
    with pytest.raises(gc.UsageError, match="1 of 2 cells may meet Z and have no sample; the estimator is broken"):
        gc.certify(
            Nothing(field),
            field,
            field.domain,
            lipschitz=Careless(),
            folder=tmp_path / "run",
            executor=threads,
            sampling=gc.GridSampling((2, 2, 2)),
        )
