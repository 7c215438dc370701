"""Places where faults happen: a file system that is full, one that cannot be written, and runs to be damaged."""

import shutil
import subprocess

import pytest
from faults import TINY, digests, mounted

import gapcert as gc


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 1 MiB, and a function that gives it another size."""
    disk = mounted(tmp_path / "disk", "-t", "tmpfs", "-o", "size=1M", "tmpfs")

    def resize(size: str) -> None:
        subprocess.run(["mount", "-o", f"remount,size={size}", str(disk)], check=True)

    yield disk, resize
    subprocess.run(["umount", "-l", str(disk)], check=True)


@pytest.fixture
def sealed(tmp_path):
    """Seals a folder: whatever is in it can be read and nothing be written, not by root either; undone by calling it again."""
    sealed = []

    def seal(folder) -> None:
        if folder in sealed:
            sealed.remove(folder)
            subprocess.run(["umount", "-l", str(folder)], check=True)
            return
        mounted(folder, "--bind", str(folder))
        sealed.append(folder)
        subprocess.run(["mount", "-o", "remount,ro,bind", str(folder)], check=True)

    yield seal
    for folder in sealed:
        seal(folder)


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory):
    return gc.run(TINY, out=tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="session")
def tiny_digests(tiny_run):
    return digests(tiny_run.folder)


@pytest.fixture
def run_folder(small_run, tmp_path):
    """A copy of a finished run with everything in it."""
    return shutil.copytree(small_run.folder, tmp_path / "runs" / small_run.folder.name)


@pytest.fixture
def tiny_folder(tiny_run, tmp_path):
    """A copy of the folder of a small run, with its ledger, in `tmp_path / "runs"`."""
    shutil.copytree(tiny_run.folder.parent, tmp_path / "runs")
    return tmp_path / "runs" / tiny_run.folder.name
