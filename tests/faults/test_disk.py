"""Disks that are full, sealed, or lose what was written: a sentence, nothing lost, and the same bits once that is mended."""

import contextlib
import itertools
import json
import os
import re
import resource
import shutil
import time

import numpy as np
import pytest
from faults import TINY, clean, contents, digests, gapcert, told, written

import gapcert as gc
from gapcert.certification.samples.executors import threads
from gapcert.certification.samples.store import Store
from gapcert.numerics.atomic_files import write_atomic
from gapcert.testing.toys import Drift, Perturbed, ripple

fault, case = pytest.mark.fault, pytest.param


def store(folder, chunk=100):
    model = Drift(1)
    return Store(folder, gc.plugin.Residual(Perturbed(model, ripple), model), "key", lambda: threads(2), chunk)


def points(n=40):
    return gc.plugin.Cover(gc.Domain.of(Drift(1), {"x0": (-1, 1), "u0": (-2, 2)}), (n, 50))


@pytest.mark.run
@fault("the file system is full while shards are written", shows="shards that are there stay; more room, and the same bits")
def test_a_full_file_system(small_disk, tmp_path):
    disk, resize = small_disk
    cover = points(4000)
    with pytest.raises(gc.UsageError, match=r"the disk is full; free some room .* \(finished shards are kept\)"):
        store(disk / "a", chunk=20_000).collect("r", cover)
    kept = {p: p.read_bytes() for p in disk.rglob("chunk-*")}
    assert kept
    assert not list(disk.rglob("*.tmp"))
    resize("8M")
    again, whole = store(disk / "a", chunk=20_000), store(tmp_path / "b", chunk=20_000)
    np.testing.assert_array_equal(again.collect("r", cover), whole.collect("r", cover))
    assert again.digests == whole.digests
    assert all(p.read_bytes() == content for p, content in kept.items())


@pytest.mark.run
@fault("the file system is full while a run is saved", shows="the samples stay; the same command ends in the same digests")
def test_a_full_file_system_at_the_end_of_a_run(small_disk, tmp_path, capsys, tiny_digests):
    disk, resize = small_disk
    spec, out = written(tmp_path), str(disk / "runs")
    for room in (0, 60, 160, 240):
        (disk / "filling").unlink(missing_ok=True)
        with (disk / "filling").open("wb") as file, contextlib.suppress(OSError):
            file.write(b"0" * ((1024 - 40 - room) << 10 if room else 1 << 20))
        assert re.search("is full|o space left", told(capsys, "run", str(spec), "--out", out, "--quiet"))
        assert not list(disk.rglob("*.tmp"))
    shards = {p: p.read_bytes() for p in disk.rglob("chunk-*")}
    assert shards
    (disk / "filling").unlink()
    resize("8M")
    assert told(capsys, "run", str(spec), "--out", out, "--quiet", code=0) == ""
    assert digests(disk / "runs") == tiny_digests
    assert all(p.read_bytes() == content for p, content in shards.items())


@pytest.mark.exam
@fault("a quota (`ulimit -f`) ends the growth of files", shows="the folder is named; without the limit the same bits")
def test_a_limit_on_the_size_of_files(tmp_path, tiny_digests):
    spec = written(tmp_path)
    limit = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (2048, {resource.RLIM_INFINITY}))"
    clean(gapcert("run", spec, "--out", tmp_path / "runs", "--quiet", before=limit), 2, "cannot write (File too large)")
    assert not list(tmp_path.rglob("*.tmp"))
    assert gc.run(TINY, out=tmp_path / "runs").exit_code == 0
    assert digests(tmp_path / "runs") == tiny_digests


@pytest.mark.run
@fault("the folder for runs cannot be written", shows="choose another with --out; nothing was changed")
def test_a_sealed_folder_for_runs(sealed, tmp_path, capsys):
    (tmp_path / "runs").mkdir()
    sealed(tmp_path / "runs")
    told(capsys, "run", str(written(tmp_path)), "--out", str(tmp_path / "runs"), says="choose another folder with --out")
    assert list((tmp_path / "runs").iterdir()) == []


@pytest.mark.run
@fault("a finished run became read-only (an archive)", shows="verify, check and export read it; writing again is refused")
def test_a_sealed_run(sealed, run_folder, tmp_path, capsys):
    before = contents(run_folder)
    sealed(run_folder)
    assert told(capsys, "verify", str(run_folder), code=0) == ""
    told(capsys, "export", str(run_folder), "--to", "c", "--out", str(tmp_path / "c"), code=0)
    told(capsys, "report", str(run_folder), says="cannot write (Read-only file system); choose another folder with --out")
    assert contents(run_folder) == before


@pytest.mark.run
@fault("the ledger of audits cannot be written", shows="no audit is drawn that would not be counted")
def test_a_sealed_ledger(sealed, tiny_folder, capsys, tmp_path):
    spec = written(tmp_path, seed=1)
    (tmp_path / "runs" / "tiny-new").mkdir()
    out = tmp_path / "sealed"
    shutil.copytree(tmp_path / "runs", out)
    ledgers = {p: p.read_bytes() for p in out.glob("*.json")}
    assert ledgers
    folder = gc.load_spec(spec)
    place = out / f"tiny-{folder.digest[:8]}"
    place.mkdir()
    sealed(out)
    told(capsys, "run", str(spec), "--out", str(out), "--quiet", says="--out")
    assert {p: p.read_bytes() for p in out.glob("*.json")} == ledgers


@pytest.mark.exam
@fault("the ledger of audits is damaged", shows="it is never begun anew, which would spend β twice; restored, all goes on")
@pytest.mark.parametrize("text", ["", "{", "[1]", '{"a": [1]}', "[" * 10_000])
def test_a_damaged_ledger(tiny_folder, tmp_path, capsys, text):
    (ledger,) = (p for p in (tmp_path / "runs").glob("*.json"))
    before = ledger.read_text()
    ledger.write_text(text)
    spec = written(tmp_path, seed=1)
    told(capsys, "run", str(spec), "--out", str(tmp_path / "runs"), says="the ledger of audits cannot be read")
    assert ledger.read_text() == text
    ledger.write_text(before)
    assert told(capsys, "run", str(spec), "--out", str(tmp_path / "runs"), "--quiet", code=0) == ""
    assert sum(kind == "audit" for _, kind, _, _ in json.loads(ledger.read_text())["lines"]) == 2


FOREIGN = '[1]\n{"chunk": "x"}\n{"chunk": -1, "sha256": "0"}\n{}\n'
DAMAGE = {
    "header": lambda folder: cut(folder / "manifest.jsonl", 40),
    "empty manifest": lambda folder: (folder / "manifest.jsonl").write_text(""),
    "no manifest": lambda folder: (folder / "manifest.jsonl").unlink(),
    "foreign bytes": lambda folder: (folder / "manifest.jsonl").write_bytes(b"\xff\xfe\x00" * 50),
    "foreign lines": lambda folder: append(
        folder / "manifest.jsonl", '[1]\n{"chunk": "x"}\n{"chunk": -1, "sha256": "0"}\n{}\n'
    ),
    "shard of nobody": lambda folder: (folder / "chunk-000999.npy").write_bytes(b"x"),
    "no points": lambda folder: (folder / "points.npy").unlink(),
    "damaged points": lambda folder: cut(folder / "points.npy", 100),
}


def cut(path, size):
    path.write_bytes(path.read_bytes()[:size])


def append(path, text):
    with path.open("a") as file:
        file.write(text)


@pytest.mark.exam
@pytest.mark.parametrize(
    "damage",
    [
        case("header", id="header", marks=fault("the header of a manifest is cut off", shows="all is computed again")),
        case("empty manifest", id="empty manifest", marks=fault("a manifest is empty", shows="all is computed again")),
        case("no manifest", id="no manifest", marks=fault("a manifest is missing", shows="all is computed again")),
        case("foreign bytes", id="foreign bytes", marks=fault("a manifest is no text", shows="all is computed again")),
        case(
            "foreign lines", id="foreign lines", marks=fault("a manifest has lines of something else", shows="they are ignored")
        ),
        case("shard of nobody", id="shard of nobody", marks=fault("a shard that no manifest names", shows="it is ignored")),
        case("no points", id="no points", marks=fault("the points of a round are missing", shows="they are written again")),
        case(
            "damaged points",
            id="damaged points",
            marks=fault("the points of a round are damaged", shows="they are written again"),
        ),
    ],
)
def test_damaged_samples_are_mended(tiny_folder, tmp_path, capsys, damage, tiny_digests):
    (folder,) = (tiny_folder / "samples").glob("bound-0")
    DAMAGE[damage](folder)
    (tiny_folder / "certificate.json").unlink()
    assert gc.run(TINY, out=tmp_path / "runs").exit_code == 0
    assert digests(tmp_path / "runs") == tiny_digests
    assert told(capsys, "verify", str(tiny_folder), code=0) == ""


@pytest.mark.exam
@fault("run.json or spec.json is damaged or missing, as after a kill between them", shows="they are written again")
@pytest.mark.parametrize("text", [None, "", "[1]", "{}"])
def test_the_marks_of_a_folder(tiny_folder, tmp_path, text, tiny_digests):
    before = contents(tiny_folder)
    for name in ("run.json", "spec.json"):
        (tiny_folder / name).unlink() if text is None else (tiny_folder / name).write_text(text)
    gc.run(TINY, out=tmp_path / "runs")
    assert digests(tmp_path / "runs") == tiny_digests
    assert all(contents(tiny_folder)[name] == before[name] for name in ("run.json", "spec.json"))


@fault("the clock jumps back by years between two runs", shows="no result depends on when it was made")
def test_a_clock_that_jumps(tiny_folder, tmp_path, monkeypatch, tiny_digests):
    before = contents(tiny_folder / "samples")
    for k, path in enumerate(sorted(tiny_folder.rglob("*"))):
        os.utime(path, (0, 0) if k % 2 else (4e9, 4e9))
    ticks = itertools.count()
    monkeypatch.setattr(time, "time", lambda: (4e9, -1e9)[next(ticks) % 2])
    (tiny_folder / "certificate.json").unlink()
    gc.run(TINY, out=tmp_path / "runs")
    assert digests(tmp_path / "runs") == tiny_digests
    after = contents(tiny_folder / "samples")
    assert all(after[name] == content for name, content in before.items() if not name.endswith("jsonl"))


@pytest.mark.run
@fault("a write is cut off by a disk without room", shows="the old file is whole, and no other is left")
def test_a_write_without_room(small_disk):
    disk, _ = small_disk
    write_atomic(disk / "x", b"old")
    with pytest.raises(gc.UsageError, match="the disk is full"):
        write_atomic(disk / "x", b"new" * (1 << 20))
    assert {p.name: p.read_bytes() for p in disk.iterdir()} == {"x": b"old"}
