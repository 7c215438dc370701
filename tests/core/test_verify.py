"""`verify` re-checks from data alone; every way of improving a stored certificate by hand is noticed."""

import hashlib
import json
import shutil

import numpy as np
import pytest

import gapcert as gc
from gapcert.certify import Request
from gapcert.sampling import GridSampling
from gapcert.testing.toys import Drift, Perturbed, ripple
from gapcert.verify import verify_run

VALUES = {"x0": {"x0": 0.03, "u0": 0.08}}
RANGES = {"x0": (-1.0, 1.0), "u0": (-2.0, 2.0)}


def declared(factor: float = 1.0):
    scaled = {"x0": {k: v * factor for k, v in VALUES["x0"].items()}}
    return gc.registry().get("lipschitz", "declared").load()(values=scaled)


def certified(folder, **options):
    model = Drift(1)
    family = gc.registry().get("gap_family", options.pop("family", "envelope")).load()(**options.pop("options", {}))
    options = {"lipschitz": declared(), "request": Request("statistical", 1e-2, 1e-3), **options}
    c = gc.certify(model, Perturbed(model, ripple), gc.Domain.of(model, RANGES), family=family, folder=folder, **options)
    c.save(folder)
    return c


FORMS = {
    "envelope": {"family": "envelope", "options": {"predictor": "none"}},
    "affine": {"family": "envelope", "options": {"predictor": "affine"}, "lipschitz": declared(2.0)},
    "constant": {"family": "constant", "route": "theorem1", "sampling": GridSampling((20, 30))},
    "basis": {
        "family": "basis",
        "options": {"functions": ["1", "abs(x0)", "u0^2", "cos(u0)*abs(x0)"]},
        "route": "theorem1",
        "sampling": GridSampling((24, 36)),
    },
}


@pytest.mark.parametrize("form", FORMS)
def test_honest_certificates_verify(tmp_path, form):
    certified(tmp_path / "run", **FORMS[form])
    result = verify_run(tmp_path / "run")
    assert result["verdict"] == "holds", [c for c in result["checks"] if not c["passed"]]
    margin = [c for c in result["checks"] if "margin" in c["check"]]
    assert bool(margin) == (FORMS[form].get("route") == "theorem1")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("verify")
    certified(folder / "envelope", **FORMS["envelope"])
    certified(folder / "theorem1", **FORMS["basis"])
    certified(folder / "low", lipschitz=declared(0.8), family="envelope", options={"predictor": "none"})
    return folder


def edit_json(run, **changes):
    data = json.loads((run / "certificate.json").read_text())
    for path, value in changes.items():
        node = data
        *parents, last = path.split("__")
        for p in parents:
            node = node[p]
        node[last] = value(node[last]) if callable(value) else value
    (run / "certificate.json").write_text(json.dumps(data))


def edit_arrays(run, **changes):
    """Change arrays and mend the digest, as a forger would."""
    with np.load(run / "certificate.npz") as stored:
        arrays = dict(stored)
    for name, change in changes.items():
        key = name.replace("__", ".")
        arrays[key] = change(arrays[key])
    np.savez(run / "certificate.npz", **arrays)
    edit_json(run, arrays=hashlib.sha256((run / "certificate.npz").read_bytes()).hexdigest())


def edit_shard(run, name, change):
    path = run / "samples" / name / "chunk-000000.npy"
    np.save(path, change(np.load(path)))
    manifest = run / "samples" / name / "manifest.jsonl"
    header, line = manifest.read_text().splitlines()[:2]
    entry = json.loads(line) | {"sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    manifest.write_text(header + "\n" + json.dumps(entry) + "\n")


FORGERIES = {
    "arrays without digest": ("envelope", lambda r: (r / "certificate.npz").write_bytes(b"PK"), None),
    "smaller constants": ("envelope", lambda r: edit_arrays(r, lipschitz=lambda a: a * 0.5), "contradict"),
    "no resolution": ("envelope", lambda r: edit_arrays(r, gap__e=lambda a: a * 0.0), "contradict"),
    "slightly smaller constants": ("envelope", lambda r: edit_arrays(r, lipschitz=lambda a: a * 0.98), "figures"),
    "audit residuals softened": ("envelope", lambda r: edit_shard(r, "audit-1", lambda a: a * 0.5), "digests"),
    "samples softened": ("envelope", lambda r: edit_shard(r, "bound-0", lambda a: a * 0.9), "digests"),
    "violations hidden": ("low", lambda r: edit_json(r, audit__violations=0), "as stated"),
    "violations hidden and claim raised": (
        "low",
        lambda r: edit_json(r, audit__violations=0, claim={"kind": "statistical", "epsilon": 1e-2, "beta": 1e-3}),
        "as stated",
    ),
    "claim raised": (
        "low",
        lambda r: edit_json(r, claim={"kind": "statistical", "epsilon": 1e-2, "beta": 1e-3}),
        "evidence allows",
    ),
    "deterministic from an estimate": (
        "envelope",
        lambda r: edit_json(r, claim={"kind": "deterministic"}, lipschitz__provenance="estimated"),
        "evidence allows",
    ),
    "smaller epsilon": ("envelope", lambda r: edit_json(r, claim__epsilon=1e-3, audit__epsilon=1e-3), "enough points"),
    "claim beyond its audit": ("envelope", lambda r: edit_json(r, claim__epsilon=1e-3), "evidence allows"),
    "an earlier audit's number": ("envelope", lambda r: edit_json(r, audit__beta=1e-4, claim__beta=1e-4), "enough points"),
    "better tightness": ("envelope", lambda r: edit_json(r, states__x0__tightness=1.0), "figures"),
    "smaller mean": ("envelope", lambda r: edit_json(r, states__x0__gamma_mean=lambda v: v * 0.99), "figures"),
    "another seed's points": ("envelope", lambda r: edit_json(r, seed=7), "its seed draws"),
    "no margin": ("theorem1", lambda r: edit_arrays(r, gap__margin=lambda a: a * 0.0), "margin covers"),
    "half a margin": ("theorem1", lambda r: edit_arrays(r, gap__margin=lambda a: a * 0.5), "margin covers"),
    "a finer grid than sampled": ("theorem1", lambda r: edit_json(r, cover=[48, 72]), None),
    "a larger domain than sampled": ("theorem1", lambda r: edit_json(r, domain__high=[2.0, 2.0]), None),
    "lower weights": ("theorem1", lambda r: edit_arrays(r, gap__weights=lambda a: a * 0.9), "every sample"),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_forgeries_are_caught(runs, tmp_path, name):
    base, forge, caught_by = FORGERIES[name]
    run = tmp_path / "run"
    shutil.copytree(runs / base, run)
    forge(run)
    try:
        result = verify_run(run)
    except gc.UsageError:
        assert caught_by is None
        return
    assert result["verdict"] == "fails"
    failed = [c["check"] for c in result["checks"] if not c["passed"]]
    assert caught_by is None or any(caught_by in check for check in failed), failed


def test_an_honest_failure_verifies_as_what_it_is(runs):
    result = verify_run(runs / "low")
    assert result["claim"] == {"kind": "empirical"}


def test_nothing_stored_is_one_sentence(tmp_path):
    with pytest.raises(gc.UsageError, match=r"holds no certificate.json"):
        verify_run(tmp_path)
    (tmp_path / "certificate.json").write_text("{")
    with pytest.raises(gc.UsageError, match="cannot be read"):
        verify_run(tmp_path)
