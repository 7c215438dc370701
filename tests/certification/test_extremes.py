"""`keep: extremes`: what is kept, that no chunk or worker can change it, and what may be built on it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from forgeries import Forger, Forgery
from hypothesis import given, settings
from hypothesis import strategies as st

import gapcert as gc
from gapcert.certification.samples.executors import threads
from gapcert.certification.samples.extremes import Extremes
from gapcert.certification.samples.store import Store
from gapcert.contracts.gaps.predictor import Samples
from gapcert.testing.toys import Drift
from gapcert_bounds.testing.fields import Nothing, Waves
from gapcert_verify.verify import verify_run

FIELD = Waves.smooth()


def slow(kept: Extremes, z, r) -> list[int]:
    """Cell by cell and point by point."""
    cells: dict[tuple[int, ...], list[int]] = {}
    for k, point in enumerate(z):
        place = ((point - kept.domain.low) * (np.array(kept.cells) / kept.domain.width)).astype(int)
        cells.setdefault(tuple(np.minimum(place, np.array(kept.cells) - 1)), []).append(k)
    keep = set()
    for rows in cells.values():
        for i in range(r.shape[1]):
            keep |= {min(rows, key=lambda k, i=i: (r[k, i], k)), min(rows, key=lambda k, i=i: (-r[k, i], k))}
    return sorted(keep)


@settings(max_examples=30)
@given(
    counts=st.tuples(st.integers(1, 7), st.integers(1, 9), st.integers(1, 6)),
    cells=st.tuples(st.integers(1, 4), st.integers(1, 9), st.integers(1, 3)),
    chunk=st.integers(1, 60),
    seed=st.integers(0, 1000),
)
def test_kept_as_cell_by_cell_and_associative(counts, cells, chunk, seed):
    cover, kept = gc.plugin.Cover(FIELD.domain, counts), Extremes(FIELD.domain, cells)
    z = cover.chunk(0, len(cover))
    r = np.random.default_rng(seed).integers(-2, 3, (len(z), 2)).astype(float)  # small numbers, so that there are ties
    whole = kept.of_chunk(0, kept.cell(z), r)
    assert whole["index"].tolist() == slow(kept, z, r)
    parts = [kept.of_chunk(a, kept.cell(z[a : a + chunk]), r[a : a + chunk]) for a in range(0, len(z), chunk)]
    merged = kept.merge(cover, parts, 2)
    nested = kept.merge(cover, [kept.merge(cover, parts[:2], 2), kept.merge(cover, parts[2:], 2)], 2)
    assert merged.tobytes() == whole.tobytes() == nested.tobytes()


def test_at_most_two_samples_per_state_and_cell_and_each_is_real(tmp_path):
    cover = gc.plugin.Cover(FIELD.domain, (30, 31, 32))
    samples = Store(tmp_path, gc.plugin.Residual(FIELD, Nothing(FIELD)), "key", threads, chunk=4000).samples(
        "bound-0", cover, Extremes(FIELD.domain, (5, 6, 4))
    )
    assert 5 * 6 * 4 <= len(samples) <= 5 * 6 * 4 * 4
    assert samples.total == len(cover)
    np.testing.assert_array_equal(samples.r, FIELD(samples.z))
    every = FIELD(cover.chunk(0, len(cover)))
    np.testing.assert_array_equal(np.abs(samples.r).max(axis=0), np.abs(every).max(axis=0))


def test_points_of_a_cover_by_number(tmp_path):
    cover = gc.plugin.Cover(FIELD.domain, (4, 5, 6))
    numbers = np.random.default_rng(0).integers(0, len(cover), 50)
    np.testing.assert_array_equal(cover.at(numbers), cover.chunk(0, len(cover))[numbers])
    for a, b in ((0, 7), (5, 6), (3, 119), (118, 500), (17, 17)):
        np.testing.assert_array_equal(cover.chunk(a, b), cover.chunk(0, len(cover))[a:b])


def run(tmp_path, name, **spec):
    model = {"kind": "equations", "states": {"x": "rad"}, "inputs": {"u": "rad"}, "period": "1 s"}
    return gc.run(
        {
            "version": 1,
            "name": name,
            "model": model | {"next": {"x": "0.5*x + u"}},
            "backend": model | {"next": {"x": "0.5*x + u + 0.1*sin(2*x)*cos(u)"}},
            "domain": {"x": [-1, 1], "u": [-1, 1]},
            "lipschitz": {"residual": {"kind": "interval"}},
            "certificate": {"claim": "deterministic", "route": "theorem1", "violation": 1e-2, "attack": 10_000},
            "gap": {"kind": "constant"},
            "report": {"html": False, "rerun": False},
            **spec,
        },
        out=tmp_path,
    )


GRID = {"kind": "grid", "counts": {"x": 60, "u": 50}, "chunk": 700, "executor": "threads"}
EXTREMES = GRID | {"keep": "extremes", "cells": {"x": 5, "u": 7}}


def test_the_constant_family_is_the_same_and_every_sample_is_counted(tmp_path):
    every, kept = run(tmp_path, "all", sampling=GRID), run(tmp_path, "kept", sampling=EXTREMES)
    assert kept.certificate.gap.value.tobytes() == every.certificate.gap.value.tobytes()
    assert len(every.certificate.samples) == 3000
    assert len(kept.certificate.samples) <= 2 * 5 * 7
    assert kept.summary["certificate"]["samples"] == every.summary["certificate"]["samples"]
    assert kept.summary["verdict"] == "holds"
    sizes = [sum(p.stat().st_size for p in r.folder.glob("samples/bound-0/chunk-*")) for r in (every, kept)]
    assert sizes[1] < sizes[0] / 3


def test_cells_by_default(tmp_path):
    assert Extremes.default_cells((1000, 1000, 7)) == (40, 40, 7)
    kept = run(tmp_path, "default", sampling=GRID | {"keep": "extremes"})
    assert len(kept.certificate.samples) == 3000  # 256 cells per axis would be allowed: the grid's own counts are fewer


def test_the_envelope_may_use_the_kept_ones(tmp_path):
    route = {"claim": "deterministic", "route": "dominate", "violation": 1e-2, "attack": 10_000}
    done = run(tmp_path, "envelope", sampling=EXTREMES, gap={"kind": "envelope"}, certificate=route)
    assert done.summary["verdict"] == "holds"
    assert done.summary["certificate"]["samples"]["bound"] == 3000
    assert verify_run(done.folder)["verdict"] == "holds"


def test_a_family_that_needs_every_sample_refuses(tmp_path):
    with pytest.raises(gc.UsageError, match=r"family 'basis' on route theorem1 needs every sample"):
        run(tmp_path, "basis", sampling=EXTREMES, gap={"kind": "basis", "functions": ["1", "x^2"]})
    assert not list(tmp_path.glob("*/samples/*"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"keep": "all"}, r"found `cells` with `keep: all`"),
        ({"cells": {"x": 61, "u": 7}}, r"found 61 cells for x; expected at most its 60 counts"),
        ({"cells": {"x": 5}}, r"sampling.cells"),
        ({"keep": "some"}, r"sampling.keep"),
    ],
)
def test_wrong_specs(tmp_path, change, message):
    with pytest.raises(gc.SpecError, match=message):
        run(tmp_path, "wrong", sampling=EXTREMES | change)


def test_more_cells_than_a_radius_gives_points(tmp_path):
    sampling = {k: v for k, v in EXTREMES.items() if k != "counts"} | {"radius": {"states": 0.3, "inputs": 0.3}}
    with pytest.raises(gc.UsageError, match=r"sampling.cells: found \[5, 7\]; expected one number per axis, at most"):
        run(tmp_path, "radius", sampling=sampling)


def damage(folder, how):
    """Change the shard of chunk 2 and every digest that follows from it, as a forger would."""
    import hashlib

    path = folder / "samples" / "bound-0" / "chunk-000002.npy"
    records = np.load(path)
    manifest = path.parent / "manifest.jsonl"
    lines = [json.loads(line) for line in manifest.read_text().splitlines()]
    if how == "smaller residuals":
        records["r"] /= 2
    elif how == "left out":
        records = records[:0]
    np.save(path, records)
    shown = next(line for line in lines[1:] if line["chunk"] == 2)
    shown["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    manifest.write_text("".join(json.dumps(line) + "\n" for line in lines))
    entries = [[line["sha256"], line["residuals"]] for line in sorted(lines[1:], key=lambda line: line["chunk"])]
    certificate = json.loads((folder / "certificate.json").read_text())
    certificate["digests"]["bound-0"] = hashlib.sha256(json.dumps([lines[0], entries]).encode()).hexdigest()
    (folder / "certificate.json").write_text(json.dumps(certificate))
    Forger(np.random.default_rng(0)).mend(folder, Forgery("samples"))


def test_verify_takes_part(tmp_path):
    done = run(tmp_path, "kept", sampling=EXTREMES)
    answer = verify_run(done.folder)
    assert answer["verdict"] == "holds", answer
    assert any("3000 samples those that are not stored" in sentence for sentence in answer["trusted"])
    damage(done.folder, "nothing")
    assert verify_run(done.folder)["verdict"] == "holds"
    damage(done.folder, "left out")
    failed = [c["detail"] for c in verify_run(done.folder)["checks"] if not c["passed"]]
    assert "the samples are not the grid that the certificate states" in failed


def test_a_changed_shard_is_seen(tmp_path):
    done = run(tmp_path, "kept", sampling=EXTREMES)
    path = done.folder / "samples" / "bound-0" / "chunk-000001.npy"
    path.write_bytes(path.read_bytes()[:-8] + bytes(8))
    assert any("shard 1 of round bound-0 was changed" in c["detail"] for c in verify_run(done.folder)["checks"])


def test_without_the_cell_extremes_the_constant_would_be_too_small():
    """Necessity: of each cell one arbitrary sample is not enough."""
    cover = gc.plugin.Cover(FIELD.domain, (40, 40, 40))
    z = cover.chunk(0, len(cover))
    kept = Extremes(FIELD.domain, (4, 4, 4))
    _, some = np.unique(kept.cell(z), return_index=True)
    assert (np.abs(FIELD(z[some])).max(axis=0) < np.abs(FIELD(z)).max(axis=0)).all()


def test_samples_without_a_count_are_all_there():
    samples = Samples(np.zeros((3, 2)), np.zeros((3, 1)))
    assert samples.total == 3
    assert replace(samples, taken=10).total == 10


def test_a_grid_of_another_number_of_axes_is_refused():
    with pytest.raises(gc.UsageError, match=r"sampling.cells: found \[2\]"):
        gc.GridSampling((5, 5), cells=(2,)).kept(gc.Domain.of(Drift(1), {"x0": (-1, 1), "u0": (-2, 2)}))
