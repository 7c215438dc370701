"""`gapcert plugins new`: what it writes is a plugin that is installed, keeps its contract and runs, of every kind."""

import ast
import importlib
import inspect
import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import gapcert.testing
from gapcert.cli.main import main
from gapcert.contracts.plugins.component import KINDS
from gapcert_scaffold.scaffold import OFFERED, scaffold

ROOT = Path(__file__).parents[2]
SHORT, LONG = "ab", "a-name-as-long-as-one-may-have"


def new(*arguments):
    return main(["plugins", "new", *map(str, arguments)])


def run(*arguments, path=(), **options):
    """A command of this Python, with more on its path."""
    env = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, path)), "OMP_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, "-m", *map(str, arguments)], env=env, capture_output=True, text=True, **options)


def done(*arguments, **options):
    result = run(*arguments, **options)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


# --- what is written


@pytest.mark.parametrize("kind", OFFERED)
def test_files_of_a_plugin(kind, tmp_path):
    folder = tmp_path / "mine"
    assert new(kind, "my-part", "--out", folder) == 0
    assert {p.name for p in tmp_path.iterdir()} == {"mine"}
    files = {p.relative_to(folder).as_posix(): p.read_text() for p in folder.rglob("*") if p.is_file()}
    package = "gapcert_my_part"
    wanted = {
        "pyproject.toml",
        "README.md",
        "example.yaml",
        f"{package}/plugin.py",
        f"{package}/py.typed",
        "tests/test_my_part.py",
    }
    assert wanted <= set(files)
    for name, text in files.items():
        assert not re.search(r"@\w+@|\bPACKAGE\b|\bSNAKE\b", text), name
        if name.endswith(".py"):
            ast.parse(text)
    project = tomllib.loads(files["pyproject.toml"])["project"]
    assert project["name"] == "gapcert-my-part"
    assert project["entry-points"]["gapcert"] == {"my_part": f"{package}.plugin"}
    imported = {m.partition(".")[0] for text in files.values() for m in re.findall(r"^(?:from|import) (\w[\w.]*)", text, re.M)}
    imported = {"gapcert" if module.startswith("gapcert_") and module != package else module for module in imported}  # kits
    assert set(project["dependencies"]) >= imported - set(sys.stdlib_module_names) - {"pytest", package, "numpy"}
    assert "my-part" in files["README.md"]
    assert "Make it yours" in files["README.md"]


def test_plugins_import_gapcert_and_nothing_deeper():
    for kind in OFFERED:
        for name, text in scaffold(kind, SHORT).texts.items():
            if name.startswith("gapcert_"):
                assert not re.search(r"^(?:from|import) gapcert\.", text, re.M), name


@pytest.mark.parametrize("kind", KINDS)
def test_the_readme_names_methods_that_the_contract_has(kind):
    texts = scaffold(kind, SHORT).texts
    (contract,) = {c for c in re.findall(r"\((\w+Contract)\)", texts["tests/test_ab.py"]) if c != "PluginContract"}
    asked = re.findall(r"`def (\w+)\(self(?:, )?([^)]*)\)", texts["README.md"])
    for method, arguments in asked:
        there = inspect.signature(getattr(getattr(gapcert.testing, contract), method)).parameters
        assert ["self", *(re.split("[:=]", a)[0] for a in arguments.split(", ") if a)] == list(there), method
    for option in re.findall(r"`(\w+) = [^`]+`", texts["README.md"]) if kind == "reader" else ():
        assert hasattr(getattr(gapcert.testing, contract), option)


@pytest.mark.exam
@pytest.mark.parametrize("name", [SHORT, LONG])
def test_what_is_written_is_clean(name, tmp_path):
    for kind in OFFERED:
        scaffold(kind, name).write(tmp_path / kind)
    for check in (["check"], ["format", "--check"]):
        for kind in OFFERED:
            done("ruff", *check, "--no-cache", ".", cwd=tmp_path / kind)


@pytest.mark.contract
@pytest.mark.parametrize("kind", ["backend", "model"])
def test_other_physics_is_another_digest(kind, tmp_path):
    """What is edited is what samples are kept for: with the digest of its attributes alone they would be used again."""
    scaffold(kind, "my-part").write(tmp_path)
    source = tmp_path / "gapcert_my_part" / f"{kind}.py"
    ask = ["-c", f"from gapcert_my_part.{kind} import *; print(MyPart{kind.capitalize()}().digest())"]
    told = []
    for text in (source.read_text(), source.read_text() + "\n# other physics\n"):
        source.write_text(text)
        told.append(subprocess.run([sys.executable, *ask], cwd=tmp_path, capture_output=True, text=True, check=True).stdout)
    assert told[0] != told[1]


@pytest.mark.parametrize(
    ("kind", "name", "reason"),
    [
        ("engine", "my-robot", "'engine' is no kind of component; expected one of model, backend"),
        ("controller", "my-robot", "observer, study; did you mean 'synthesizer'?"),
        ("effekt", "my-robot", "did you mean 'effect'?"),
        ("backend", "My_Robot", "did you mean 'my-robot'?"),
        ("backend", "../escape", "did you mean 'escape'?"),
        ("backend", "", "expected up to 30 lower-case letters"),
        ("backend", "-x", "did you mean 'x'?"),
        ("backend", "x" * 31, "expected up to 30"),
        ("backend", "naïve", "did you mean 'na-ve'?"),
        ("effect", "drag2", "without digits in an effect's first word"),
        ("backend", "mujoco", "backend 'mujoco' is there already, in gapcert "),
        ("backend", "equations", "model 'equations' is there already"),
        ("gap_family", "envelope", "gapcert_bounds.families.envelope:Envelope"),
        ("study", "diagnose", "study 'diagnose' is there already, in gapcert "),
        ("study", "play", "section 'play' is there already"),
        ("study", "domain", "section 'domain' is Gapcert's own"),
        ("reader", "bounds", "there is a package gapcert_bounds"),
    ],
)
def test_names_that_cannot_be_used(kind, name, reason, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert new("--", kind, name) == 2
    assert reason in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_folder_with_anything_in_it_is_left_alone(tmp_path, capsys):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    assert new("backend", "my-robot", "--out", tmp_path / "mine") == 2
    assert new("backend", "my-robot", "--out", tmp_path / "mine" / "notes.txt") == 2
    assert "not an empty folder" in capsys.readouterr().err
    assert [p.name for p in tmp_path.rglob("*")] == ["mine", "notes.txt"]


def test_an_empty_folder_is_used(tmp_path):
    assert new("backend", "my-robot", "--out", tmp_path) == 0
    assert (tmp_path / "pyproject.toml").exists()


def test_a_full_disk_leaves_nothing(tmp_path, monkeypatch):
    opened, count = Path.open, [0]

    def full(self, *arguments, **options):
        count[0] += 1
        if count[0] == 5:
            raise OSError(28, "No space left on device", str(self))
        return opened(self, *arguments, **options)

    made = scaffold("backend", "my-robot")
    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(OSError, match="No space left"):
        made.write(tmp_path / "mine")
    assert not [p for p in tmp_path.rglob("*") if p.is_file()]


@pytest.mark.run
def test_the_answer_as_data_and_in_words(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert new("reader", "our-log", "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["folder"] == "gapcert-our-log"
    assert {"kind": "reader", "name": "our-log", "package": "gapcert_our_log"}.items() <= answer.items()
    assert all(Path(f).is_file() for f in answer["files"])
    assert main(["plugins", "--json", "new", "reader", "other-log"]) == 0
    assert json.loads(capsys.readouterr().out)["name"] == "other-log"
    assert new("reader", "third-log") == 0
    assert "pip install -e '.[test]'" in capsys.readouterr().out


def test_help_names_every_kind(capsys):
    assert new("--help") == 0
    assert set(OFFERED) <= set(re.findall(r"\w+", capsys.readouterr().out))


def test_listing_is_what_it_was(capsys):
    assert main(["plugins", "--json"]) == 0
    assert {"kind", "name", "distribution", "available", "reason"} == set(json.loads(capsys.readouterr().out)[0])


# --- what it is worth


@pytest.fixture(scope="module")
def distributions(tmp_path_factory):
    """One of every kind, and the folder that all of them are installed in, beside this environment."""
    folder, site = tmp_path_factory.mktemp("new"), tmp_path_factory.mktemp("site")
    for kind in OFFERED:
        scaffold(kind, f"my-{kind.replace('_', '-')}").write(folder / kind)
    quiet = ("--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check")
    done("pip", "install", *quiet, "--target", site, *(folder / kind for kind in OFFERED))
    return folder, site


@pytest.mark.exam
def test_every_kind_keeps_its_contract_and_its_example_runs(distributions):
    folder, site = distributions
    tests = [folder / kind / "tests" for kind in OFFERED]
    options = ("-q", "-W", "error", "--import-mode=importlib", "-p", "no:cacheprovider", f"--rootdir={folder}")
    out = done("pytest", *options, *tests, path=[site], cwd=folder)
    assert int(re.search(r"(\d+) passed", out)[1]) > 20 * len(KINDS)
    assert "skipped" not in out


VALIDATE = """
import sys, gapcert.cli.main
for spec in sys.argv[1:]:
    assert gapcert.cli.main.main(["validate", spec]) == 0, spec
"""


@pytest.mark.exam
def test_every_kind_is_listed_and_its_example_is_valid(distributions):
    folder, site = distributions
    rows = {(r["kind"], r["name"]): r for r in json.loads(done("gapcert", "plugins", "--json", path=[site]))}
    for kind in OFFERED:
        name = f"my-{kind.replace('_', '-')}"
        assert rows[kind, name]["available"] is True
        assert rows[kind, name]["distribution"] == f"gapcert-{name} 0.1.0"
    (folder / "validate_all.py").write_text(VALIDATE)
    done("validate_all", *(folder / kind / "example.yaml" for kind in OFFERED), path=[site, folder])
    again = run("gapcert", "plugins", "new", "backend", "my-backend", path=[site], cwd=folder)
    assert again.returncode == 2
    assert "in gapcert-my-backend 0.1.0 (gapcert_my_backend.backend:MyBackendBackend)" in again.stderr


@pytest.mark.parametrize("kind", ["backend", "model"])
def test_a_period_may_have_a_unit(kind, tmp_path, monkeypatch):
    made = scaffold(kind, f"timed-{kind}")
    made.write(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    config = getattr(importlib.import_module(f"{made.package}.config"), f"Timed{kind.capitalize()}Config")
    assert [config(kind=f"timed-{kind}", period=p).period for p in ("5 ms", 0.005, "0.005")] == [0.005] * 3
    with pytest.raises(ValueError, match="unit 'm' does not fit; expected s"):
        config(kind=f"timed-{kind}", period="5 m")
    with pytest.raises(ValueError, match="greater than 0"):
        config(kind=f"timed-{kind}", period="0 ms")


@pytest.mark.exam
def test_every_kind_is_typed(distributions):
    folder, site = distributions
    files = [*(site / f"gapcert_my_{kind}" for kind in OFFERED), *(folder / kind / "tests" for kind in OFFERED)]
    # What is known of Gapcert and of the libraries is kept between runs.
    kept = f"--cache-dir={ROOT / '.mypy_cache' / 'scaffold'}"
    options = ("--strict", kept, "--explicit-package-bases", "--follow-imports=silent")
    env = os.environ | {"MYPYPATH": os.pathsep.join(map(str, (ROOT / "core", site)))}
    command = [sys.executable, "-m", "mypy", *options, *files]
    result = subprocess.run(command, env=env, capture_output=True, text=True, cwd=folder)
    assert result.returncode == 0, result.stdout + result.stderr


FAULTS = {
    "backend": ("backend.py", "/ mass", "/ (mass + id(self) % 97 * 1e-9)", "fresh_instance_gives_the_same_bits"),
    "model": ("model.py", "-(way * heading.sin())", "way * heading.sin()", "jacobian_is_the_slope"),
    "gap_family": ("family.py", "(problem, self.name", '(problem, "another"', "declares_itself"),
    "lipschitz": ("estimator.py", "asked += 2 * len(start)", "asked += len(start)", "queries_are_counted"),
    "effect": ("effect.py", "-{peak.name}*log", "-(0.01 + {peak.name})*log", "off_changes_nothing"),
    "reader": ("reader.py", "float(word) for word", "abs(float(word)) for word", "numbers_come_back"),
    "executor": ("executor.py", "self.workers = workers", 'self.workers = "all"', "says_how_many_work"),
    "observer": ("observer.py", "print(text, file=file)", "print(text)", "leaves_standard_output_alone"),
    "study": ("config.py", "    points:", '    model_config = {"frozen": False}\n    points:', "options_are_frozen"),
    "synthesizer": ("synthesizer.py", "problem.gap.interval_over(z)", "0.0", "gap_shrinks_the_domain"),
}


@pytest.mark.exam
def test_planted_faults_fail_the_contracts(tmp_path):
    assert set(FAULTS) == set(OFFERED)
    for kind, (file, old, fault, _) in FAULTS.items():
        made = scaffold(kind, f"faulty-{kind.replace('_', '-')}")
        path = f"{made.package}/{file}"
        assert old in made.texts[path]
        made.write(tmp_path / kind)
        (tmp_path / kind / path).write_text(made.texts[path].replace(old, fault))
    options = ("-q", "-p", "no:cacheprovider", "--import-mode=importlib", f"--rootdir={tmp_path}", "--tb=no", "-rfE")
    chosen = " or ".join(check for *_, check in FAULTS.values())
    tests, path = [tmp_path / kind / "tests" for kind in OFFERED], [tmp_path / kind for kind in OFFERED]
    result = run("pytest", *options, "-k", chosen, *tests, path=path, cwd=tmp_path)
    failed = [line for line in result.stdout.splitlines() if line.startswith("FAILED ")]
    for kind, (*_, check) in FAULTS.items():
        assert any(f"test_faulty_{kind}.py" in line and f"test_{check}" in line for line in failed), (kind, result.stdout)
