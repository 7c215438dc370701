"""`verify` re-checks from data alone; every way of improving a stored certificate by hand is noticed."""

import hashlib
import json
import shutil

import numpy as np
import pytest
from forging import edit_arrays, edit_json

import gapcert as gc
from gapcert.certification.routes import Request
from gapcert.certification.samples.designs import GridSampling
from gapcert.testing.toys import Drift, Perturbed, ripple
from gapcert_verify.evidence import load
from gapcert_verify.proofs import _exceeds
from gapcert_verify.verify import verify_run

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
    "supremum": {"family": "constant", "lipschitz": declared(2.0)},
    "supremum of affine": {"family": "constant", "options": {"predictor": "affine"}, "lipschitz": declared(2.0)},
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
    certified(folder / "constant", family="constant", lipschitz=declared(2.0), request=Request("deterministic", 1e-2, 1e-3))
    certified(folder / "low", lipschitz=declared(0.8), family="envelope", options={"predictor": "none"})
    return folder


def edit_shard(run, name, change):
    path = run / "samples" / name / "chunk-000000.npy"
    np.save(path, change(np.load(path)))
    manifest = run / "samples" / name / "manifest.jsonl"
    header, line = manifest.read_text().splitlines()[:2]
    entry = json.loads(line) | {"sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    manifest.write_text(header + "\n" + json.dumps(entry) + "\n")


def scatter(run, keep=5):
    """Five samples in place of a grid, a cover a thousand times finer, and a margin to match; every digest mended."""
    folder = run / "samples" / "bound-0"
    grid = np.stack(
        np.meshgrid(*[np.linspace(-a * (1 - 1 / n), a * (1 - 1 / n), n) for a, n in ((1, 40), (2, 60))], indexing="ij"), -1
    )
    z, r = grid.reshape(-1, 2)[:keep], np.load(folder / "chunk-000000.npy")[:keep]
    np.save(folder / "points.npy", z)
    np.save(folder / "chunk-000000.npy", r)
    header = json.loads((folder / "manifest.jsonl").read_text().splitlines()[0])
    header["points"] = hashlib.sha256(z.tobytes() + str(z.shape).encode()).hexdigest()
    digest = hashlib.sha256((folder / "chunk-000000.npy").read_bytes()).hexdigest()
    (folder / "manifest.jsonl").write_text(json.dumps(header) + "\n" + json.dumps({"chunk": 0, "sha256": digest}) + "\n")
    total = hashlib.sha256(json.dumps([header, [digest]]).encode()).hexdigest()
    edit_json(run, cover=[40_000, 60_000], samples__bound=keep, digests=lambda d: d | {"bound-0": total})
    edit_arrays(run, gap__margin=lambda a: a * 0.01)


def add_array(run):
    """All that is asked for stays as it was."""
    with np.load(run / "certificate.npz") as stored:
        arrays = dict(stored)
    np.savez(run / "certificate.npz", **arrays, more=np.zeros(1))


def lower_constant(run):
    """γ between the largest residual and the envelope's largest value, which only an unseen point could refute."""
    r = np.concatenate([np.load(p) for p in (run / "samples").glob("*/chunk-*.npy")])
    edit_arrays(run, gap__gamma=lambda a: np.maximum(np.abs(r).max(axis=0), a * 0.9))


def renumber(run):
    """(seed, k) and (seed + 2³² k, 0) draw the same points; number 0 would spend β itself instead of β / 2^k."""
    data = json.loads((run / "certificate.json").read_text())
    k, seed = data["audit"]["number"], data["seed"]
    (run / "samples" / f"audit-{k}").rename(run / "samples" / "audit-0")
    moved = {("audit-0" if name == f"audit-{k}" else name): d for name, d in data["digests"].items()}
    beta = data["audit"]["beta"] / 2**k
    edit_json(run, audit__number=0, seed=seed + 2**32 * k, digests=moved, audit__beta=beta, claim__beta=beta)


FORGERIES = {
    "arrays without digest": ("envelope", lambda r: (r / "certificate.npz").write_bytes(b"PK"), None),
    "arrays changed beside their digest": ("envelope", lambda r: add_array(r), "digests"),
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
    "lower weights": ("theorem1", lambda r: edit_arrays(r, gap__weights=lambda a: a * 0.8), "every sample"),
    "scattered points for a grid": ("theorem1", lambda r: scatter(r), "margin covers"),
    "a route without a margin": (
        "theorem1",
        lambda r: (edit_json(r, route="dominate"), edit_arrays(r, gap__margin=lambda a: a * 0.5)),
        "stored function",
    ),
    "a margin for another quantity": ("theorem1", lambda r: edit_json(r, predictor="affine"), "margin covers"),
    "a constant below the envelope": ("constant", lambda r: lower_constant(r), "stored function"),
    "another envelope than checked": ("envelope", lambda r: edit_arrays(r, gap__L=lambda a: a * 0.1), "stored function"),
    "other remainders than checked": ("envelope", lambda r: edit_arrays(r, gap__g=lambda a: a * 0.9), "stored function"),
    "a resolution below rounding": (
        "envelope",
        lambda r: edit_arrays(r, remainder__resolution=lambda a: a * 0.0),
        "stored function",
    ),
    "negative constants": ("envelope", lambda r: edit_arrays(r, lipschitz=lambda a: -a), "contradict"),
    "figures that are no numbers": ("envelope", lambda r: edit_json(r, states__x0__tightness=float("nan")), "figures"),
    "a smaller maximum": ("envelope", lambda r: edit_json(r, states__x0__gamma_max=0.01), "figures"),
    "vacuous denied": ("envelope", lambda r: edit_json(r, states__x0__constant_bound=1e-3), "figures"),
    "vacuous hidden": ("envelope", lambda r: edit_json(r, states__x0__vacuous=True), "figures"),
    "negative probability": (
        "envelope",
        lambda r: edit_json(r, claim__epsilon=-0.5, audit__epsilon=-0.5, claim__beta=1e300, audit__beta=1e300),
        "enough points",
    ),
    "audit number 0": ("envelope", lambda r: renumber(r), "enough points"),
    "another distribution": ("envelope", lambda r: edit_json(r, claim__distribution="every closed loop"), "evidence allows"),
    "a level of its own": ("envelope", lambda r: edit_json(r, claim={"kind": "proved"}), "evidence allows"),
    "a provenance of its own": ("envelope", lambda r: edit_json(r, lipschitz__provenance="theorem"), "evidence allows"),
    "violations of γ denied": ("low", lambda r: edit_json(r, audit__gamma_violations=0), "as stated"),
    "more samples than stored": ("envelope", lambda r: edit_json(r, samples__bound=10**6), "enough points"),
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


def test_a_constant_that_is_no_number_is_not_proved(runs):
    e = load(runs / "constant")
    assert _exceeds(e, e.parts[0], 0, float(e.arrays["gap.gamma"][0]), 1000) == ""
    assert "could not be decided" in _exceeds(e, e.parts[0], 0, np.nan, 1000)


def test_an_honest_failure_verifies_as_what_it_is(runs):
    result = verify_run(runs / "low")
    assert result["claim"] == {"kind": "empirical"}


def test_nothing_stored_is_one_sentence(tmp_path):
    with pytest.raises(gc.UsageError, match=r"holds no certificate.json"):
        verify_run(tmp_path)
    (tmp_path / "certificate.json").write_text("{")
    with pytest.raises(gc.UsageError, match="cannot be read"):
        verify_run(tmp_path)


def test_a_diagnosis_says_where_its_certificates_are(tmp_path):
    for part in ("before", "after"):
        (tmp_path / part).mkdir()
        (tmp_path / part / "certificate.json").write_text("{}")
    with pytest.raises(gc.UsageError) as told:
        verify_run(tmp_path)
    assert str(told.value).endswith(f"; give {tmp_path / 'after'} or {tmp_path / 'before'}")


def test_what_no_data_can_show_is_listed(runs):
    trusted = verify_run(runs / "envelope")["trusted"]
    assert any("there is no spec beside the certificate" in s for s in trusted)
    assert any("declared" in s for s in trusted)
