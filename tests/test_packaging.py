"""The wheel: what it contains, and that a foreign plugin works beside it."""

import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from itertools import chain
from pathlib import Path

import pytest

import gapcert

ROOT = Path(__file__).parents[1]
ACME = ROOT / "tests" / "third_party" / "gapcert_acme"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PLUGINS = sorted(p.name for p in (ROOT / "plugins").glob("*/"))
LEFT_OUT = shutil.ignore_patterns("__pycache__", "_build", "_generated", "*.rrd")


def python(*arguments, **options):
    done = subprocess.run([sys.executable, *map(str, arguments)], capture_output=True, text=True, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def copy(folder):
    """The files that a build reads, in a folder of their own: a build must not see what else lies about."""
    for name in ("core", "plugins", "docs", ".ci", "benchmarks", "specs", "tests"):
        shutil.copytree(ROOT / name, folder / name, ignore=LEFT_OUT)
    for path in ROOT.iterdir():
        if path.is_file():
            shutil.copy(path, folder / path.name)
    return folder


def build(source, out, *formats):
    python("-m", "build", "--no-isolation", *formats, "--outdir", out, source)
    return out


def packages(wheel):
    """Top-level names in a wheel, without its metadata."""
    return {name.split("/")[0] for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}


@pytest.fixture(scope="session")
def sources(tmp_path_factory):
    return copy(tmp_path_factory.mktemp("sources"))


@pytest.fixture(scope="session")
def dist(sources, tmp_path_factory):
    """Wheel and source distribution of gapcert, and the wheel of the foreign plugin."""
    out = build(sources, tmp_path_factory.mktemp("dist"))
    return build(shutil.copytree(ACME, sources / "acme", ignore=LEFT_OUT), out, "--wheel")


@pytest.fixture(scope="session")
def site(dist, tmp_path_factory):
    """Both wheels, installed where neither has seen the sources; gives the environment that finds them first."""
    folder = tmp_path_factory.mktemp("site")
    python("-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", folder, *sorted(dist.glob("*.whl")))
    return os.environ | {"PYTHONPATH": str(folder), "RERUN_ANALYTICS": "0"}


@pytest.mark.exam
def test_wheel_holds_core_and_plugins_and_nothing_else(dist):
    (wheel,) = dist.glob("gapcert-*.whl")
    assert packages(wheel) == {"gapcert", *PLUGINS}
    names = set(zipfile.ZipFile(wheel).namelist())
    for room in (ROOT / "core", ROOT / "plugins"):
        files = {str(p.relative_to(room)) for p in room.rglob("*") if p.is_file() and "__pycache__" not in p.parts}
        assert files <= names
    assert any(name.endswith("licenses/LICENSE") for name in names)


@pytest.mark.exam
def test_source_distribution_builds_the_same_wheel(dist, tmp_path):
    (archive,) = dist.glob("gapcert-*.tar.gz")
    with tarfile.open(archive) as tar:
        tar.extractall(tmp_path, filter="data")
    (source,) = tmp_path.iterdir()
    for name in ("Makefile", ".ci/run", ".ci/dist", "constraints.txt", "README.md", "LICENSE"):
        assert (source / name).exists(), name
    # Elsewhere, at another time, with other permissions: what is built has the same bytes, so that anybody can check a release.
    for path in source.rglob("*"):
        path.chmod(path.stat().st_mode & 0o700)
        os.utime(path, (1.7e9, 1.7e9))
    again = build(source, tmp_path / "dist")
    for name in ("gapcert-*.whl", "gapcert-*.tar.gz"):
        (first,), (second,) = dist.glob(name), again.glob(name)
        assert first.name == second.name
        assert first.read_bytes() == second.read_bytes()


def test_the_version_stands_in_one_place_and_in_the_changelog():
    assert PROJECT["project"]["dynamic"] == ["version"]
    assert "version" not in PROJECT["project"]
    versions = re.findall(r"^## (\d+\.\d+\.\d+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert versions[0] == gapcert.__version__
    assert versions == sorted(set(versions), key=lambda v: [int(n) for n in v.split(".")], reverse=True)
    assert importlib.metadata.version("gapcert") == gapcert.__version__, "pip install -e . again"


@pytest.mark.exam
def test_an_ignored_core_would_be_seen(sources, tmp_path):
    # The build honours .gitignore and succeeds without the core: the wheel must be looked at, not the exit code.
    trapped = shutil.copytree(sources, tmp_path / "trapped", ignore=shutil.ignore_patterns("specs", "tests", "docs"))
    (trapped / ".gitignore").write_text("core\n")
    (wheel,) = build(trapped, tmp_path / "dist", "--wheel").glob("*.whl")
    assert "gapcert" not in packages(wheel)


@pytest.mark.exam
def test_a_foreign_plugin_is_found_beside_the_wheel(site, tmp_path):
    where = python("-c", "import gapcert; print(gapcert.__file__)", env=site, cwd=tmp_path)
    assert where.startswith(site["PYTHONPATH"])
    rows = json.loads(python("-m", "gapcert", "plugins", "--json", env=site, cwd=tmp_path))
    (puck,) = [row for row in rows if row["name"] == "acme-puck"]
    assert puck["kind"] == "backend"
    assert puck["distribution"] == "gapcert-acme 1.0"
    assert puck["available"] is True
    ours = {row["name"] for row in rows if row["distribution"].startswith("gapcert ")}
    assert {"equations", "pybullet", "envelope", "symbolic"} <= ours


@pytest.mark.exam
def test_a_foreign_plugin_passes_its_contract_tests(site, tmp_path):
    tests = shutil.copy(ROOT / "tests" / "third_party" / "test_acme.py", tmp_path)
    out = python("-m", "pytest", "-W", "error", "-p", "no:cacheprovider", tests, env=site, cwd=tmp_path)
    assert int(re.search(r"(\d+) passed", out)[1]) > 8
    assert "skipped" not in out


def test_the_foreign_plugin_is_small():
    files = [p for p in ACME.rglob("*") if p.is_file() and "__pycache__" not in p.parts]
    assert sorted(p.name for p in files) == ["gapcert_acme.py", "pyproject.toml"]
    assert sum(len(p.read_text().splitlines()) for p in files) <= 20


def requirement(line):
    return re.match(r"[A-Za-z0-9._-]+", line)[0].lower().replace("_", "-")


def test_every_requirement_is_pinned_inside_its_range():
    from packaging.requirements import Requirement

    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line and not line.startswith("#")]
    pins = {requirement(line): line.partition("==")[2] for line in lines}
    assert all(pins.values())
    extras = PROJECT["project"]["optional-dependencies"]
    for wanted in map(Requirement, chain(PROJECT["project"]["dependencies"], *extras.values())):
        if wanted.name != "gapcert":
            assert wanted.specifier.contains(pins[requirement(wanted.name)]), wanted


def test_extra_all_is_every_other_extra():
    extras = PROJECT["project"]["optional-dependencies"]
    named = re.findall(r"gapcert\[([a-z,]+)\]", " ".join(extras["all"]))
    assert sorted(",".join(named).split(",")) == sorted(set(extras) - {"all", "dev"})
