"""A disk that is full while results are saved: one sentence that names the folder, and what was there is still whole."""

import errno
import shutil

import pytest

from gapcert import UsageError
from gapcert_figures.data import Figures
from gapcert_report.pages.page import write_report


@pytest.fixture
def folder(small_run, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(small_run.folder, copy)
    return copy


WRITERS = {
    "certificate": (lambda run, to: run.certificate.save(to), "", "certificate.npz"),
    "figures": (lambda run, to: Figures.load(run.folder).save(to), "", "figures.npz"),
    "controller": (
        lambda run, to: run.controller.save(to / "controller/with_gamma"),
        "controller/with_gamma",
        "controller.npz",
    ),
    "report": (lambda run, to: write_report(to), "", "report.html"),
}


@pytest.mark.exam
@pytest.mark.fault(
    "the disk is full while certificate, figures, controller or report are replaced", shows="the old files are whole"
)
@pytest.mark.parametrize("name", WRITERS)
def test_nothing_is_half_written(small_run, folder, monkeypatch, name):
    write, place, file = WRITERS[name]
    (folder / place / file).write_bytes(b"what was there")
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}

    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as m:
        m.setattr("gapcert.numerics.atomic_files.os.fsync", full)
        with pytest.raises(UsageError) as caught:
            write(small_run, folder)
    assert str(caught.value).startswith(f"{folder / place}: the disk is full")
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before
    write(small_run, folder)
    assert len((folder / place / file).read_bytes()) > 500
