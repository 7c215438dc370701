"""The rules of the repository itself: which room may know which, names, sizes, and what every public class is."""

import ast
import importlib.metadata
import importlib.util
import inspect
import os
import re
import shutil
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pathspec
import pytest
import rooms
import stubs

import gapcert
import gapcert.plugin

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PLUGINS = sorted(p for p in (ROOT / "plugins").iterdir() if p.is_dir() and p.name != "__pycache__")
NAMES = [p.name for p in PLUGINS]
SOURCES = sorted([*ROOT.glob("core/**/*.py"), *ROOT.glob("plugins/**/*.py")])
SUBMODULES = {"collections.abc"}
DECLARING = [p.name for p in PLUGINS if (p / "plugin.py").is_file()]
"""All but the kits, which declare nothing."""
TESTS = sorted(ROOT.glob("tests/**/*.py"))


def name(path):
    return str(path.relative_to(ROOT))


def module_of(path):
    parts = path.with_suffix("").relative_to(ROOT).parts[1:]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def tree(path):
    return ast.parse(path.read_text())


def imports(path, part=None):
    """Absolute names of the modules that a file (or a part of it) imports."""
    for node in ast.walk(part or tree(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            package = module_of(path) if path.name == "__init__.py" else module_of(path).rpartition(".")[0]
            yield importlib.util.resolve_name("." * node.level + (node.module or ""), package)


@cache
def imported(path):
    """All that a file imports, wherever in it."""
    return frozenset(imports(path))


# --- packaging traps


def test_no_line_of_gitignore_hides_a_source_file():
    spec = pathspec.PathSpec.from_lines("gitignore", (ROOT / ".gitignore").read_text().splitlines())
    hidden = [name(p) for p in SOURCES if spec.match_file(name(p))]
    assert hidden == []
    assert pathspec.PathSpec.from_lines("gitignore", ["core"]).match_file("core/gapcert/contracts/gaps/gap.py")


def test_a_plugin_cannot_be_mistaken_for_the_library_it_wraps():
    assert [n for n in NAMES if not re.fullmatch(r"gapcert_[a-z0-9_]+", n)] == []
    assert [n for n, p in zip(NAMES, PLUGINS, strict=True) if not (p / "__init__.py").is_file()] == []
    assert len(NAMES) > 10


def test_every_plugin_has_an_entry_point_that_is_installed():
    declared = PROJECT["project"]["entry-points"]["gapcert"]
    assert declared == {n.removeprefix("gapcert_"): f"{n}.plugin" for n in DECLARING}
    kits = set(NAMES) - set(DECLARING)
    assert kits == {f"gapcert_{n}" for n in ("cells", "engines", "figures", "functions", "networks", "recordings", "verify")}
    found = {p.name: p.value for p in importlib.metadata.distribution("gapcert").entry_points if p.group == "gapcert"}
    assert found == declared, "the installed metadata are older than pyproject.toml; run `pip install -e .` again"


def test_import_linter_has_the_packages_and_the_order_of_the_rooms():
    linter = PROJECT["tool"]["importlinter"]
    assert linter["root_packages"] == ["gapcert", *NAMES]
    (layers,) = [c["layers"] for c in linter["contracts"] if c["name"] == "packages stand in layers"]
    order = [" | ".join(line) for line in rooms.MAP["order"] if not line[0].startswith("core.")]
    assert layers == [*reversed(order), "gapcert"]
    (inner,) = [c["layers"] for c in linter["contracts"] if c["name"] == "the core has rooms"]
    core = [line[0] for line in rooms.MAP["order"] if line[0].startswith("core.")]
    assert inner == [f"gapcert.{room.removeprefix('core.')}" for room in reversed(core)]


def test_every_dependency_is_imported_somewhere_and_every_import_is_declared():
    project = PROJECT["project"]
    lists = [project["dependencies"], *(v for k, v in project["optional-dependencies"].items() if k not in ("all", "dev"))]
    names = {re.match(r"[A-Za-z0-9_.-]+", line)[0] for lines in lists for line in lines}
    modules = {{"drake": "pydrake", "ruamel.yaml": "ruamel", "rerun-sdk": "rerun"}.get(n, n) for n in names}
    used = {m.split(".")[0] for p in SOURCES for m in imported(p)}
    # A distribution that adds to the package of another.
    used |= {name for name, module in {"mujoco-mjx": "mujoco.mjx"}.items() if any(module in imported(p) for p in SOURCES)}
    used |= {m.split(".")[0] for c in gapcert.registry().components.values() for m in c.requires}
    # What only the tests of a plugin author need.
    assert used - set(sys.stdlib_module_names) - {"gapcert", *NAMES} - {"pytest", "hypothesis"} == modules


# --- who may import whom


def lint_imports(folder):
    done = subprocess.run(
        [Path(sys.executable).with_name("lint-imports"), "--no-cache"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": f"{folder}/core:{folder}/plugins", "COLUMNS": "200"},
        capture_output=True,
        text=True,
    )
    return done.returncode, done.stdout + done.stderr


@pytest.fixture(scope="session")
def sources(tmp_path_factory):
    folder = tmp_path_factory.mktemp("layout")
    for part in ("core", "plugins"):
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


@pytest.mark.run
def test_import_contracts_hold(sources):
    code, out = lint_imports(sources)
    assert code == 0, out


@pytest.mark.run
@pytest.mark.parametrize(
    ("file", "line", "contract"),
    [
        ("plugins/gapcert_bounds/__init__.py", "import gapcert_effects", "packages stand in layers"),
        ("plugins/gapcert_engines/contract.py", "import gapcert_mujoco", "packages stand in layers"),
        ("core/gapcert/contracts/plugins/events.py", "def late():\n    import gapcert_bounds", "packages stand in layers"),
        ("core/gapcert/numerics/texts.py", "def late():\n    import gapcert.spec.spec", "the core has rooms"),
    ],
)
def test_a_planted_import_is_caught(sources, file, line, contract):
    path = sources / file
    text = path.read_text()
    path.write_text(f"{text}\n\n{line}\n")
    try:
        code, out = lint_imports(sources)
    finally:
        path.write_text(text)
    assert code != 0
    assert any(contract in row for row in out.splitlines() if row.endswith("BROKEN")), out


def test_a_declaration_imports_only_gapcert():
    allowed, foreign = {"gapcert", "gapcert.plugin", *sys.stdlib_module_names} | SUBMODULES, []
    for path in (ROOT / "plugins" / n / "plugin.py" for n in DECLARING):
        top = [n for n in tree(path).body if isinstance(n, ast.Import | ast.ImportFrom)]
        foreign += [(name(path), m) for m in imports(path, ast.Module(top, [])) if m not in allowed]
    assert foreign == []


def test_nothing_is_imported_through_the_folder_core():
    # `core.gapcert` would be a second copy of every class.
    paths = [p for p in SOURCES + TESTS if p.parts[-3:-1] != ("core", "gapcert")]
    through = re.compile(r"^\s*(?:from\s+|import\s+(?:[^#\n]*,\s*)?)(?:core|plugins)\b.*", re.MULTILINE)
    assert [(name(p), line[0]) for p in paths for line in through.finditer(p.read_text())] == []
    assert len(paths) > 600


# --- style that can be measured


def test_nothing_is_left_open_and_no_path_is_absolute():
    wrong = re.compile(r"\b(TODO|FIXME|XXX|NotImplementedError)\b|[\"'](/home|/root|/work)/")
    assert [(name(p), found[0]) for p in SOURCES for found in wrong.finditer(p.read_text())] == []
    assert len(SOURCES) > 400


# --- the public API


def test_stubs_say_what_packages_offer():
    written = dict(stubs.stubs())
    assert [name(p) for p, text in written.items() if not p.exists() or p.read_text() != text] == [], (
        "run tests/support/stubs.py"
    )
    assert {Path(gapcert.__file__).with_suffix(".pyi"), Path(gapcert.__file__).with_name("plugin.pyi")} <= written.keys()
    for table in (gapcert._HOME, gapcert.plugin._HOME):
        assert [n for n, home in table.items() if not hasattr(importlib.import_module(home), n)] == []


def test_public_names_are_documented_and_classes_are_abstract_or_final():
    public = {n: getattr(gapcert, n) for n in gapcert.__all__ if not n.startswith("__")}
    told = {n: v for n, v in public.items() if inspect.isclass(v) or inspect.isfunction(v)}
    classes = {n: v for n, v in public.items() if inspect.isclass(v) and not issubclass(v, Exception)}

    def depth(cls):
        return max((1 + depth(c) for c in cls.__bases__ if c.__module__.startswith("gapcert")), default=0)

    assert [n for n, v in told.items() if not inspect.getdoc(v)] == []
    neither = [n for n, v in classes.items() if inspect.isabstract(v) == getattr(v, "__final__", False)]
    assert neither == [], "mark it @final, or leave a method abstract"
    assert [n for n, cls in classes.items() if depth(cls) > 2] == [], "too many levels of inheritance"
    assert len(classes) > 35


# --- the tests themselves

HEAVY = {m.split(".")[0] for c in gapcert.registry().components.values() for m in c.requires} - {"numba", "scipy"} | {
    *("matplotlib", "pint", "sympy"),
    *("IPython", "docutils", "jaxlib", "nbclient", "networkx", "pandas", "playwright", "pyarrow", "sphinx", "trimesh"),
}


@pytest.mark.exam
def test_collecting_the_tests_imports_no_engine_and_nothing_else_that_is_heavy(collected):
    names, modules = collected
    assert sorted(HEAVY & modules) == []
    assert len(names) > 5000
    assert {"pytest", "numpy"} <= modules
    assert {"mujoco", "pybullet", "pydrake", "dartpy", "torch"} <= HEAVY


@cache
def bound(path):
    """All names that a file gives something, at whatever place."""
    nodes = list(ast.walk(tree(path)))
    stored = {n.id for n in nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    return stored | {n.name for n in tree(path).body if hasattr(n, "name")} | {a.asname or a.name for a in aliases(nodes)}


def aliases(nodes):
    return [a for n in nodes if isinstance(n, ast.Import | ast.ImportFrom) for a in n.names]


def test_what_benchmarks_take_from_ours_is_there():
    """They run rarely, so that a name that has moved would be missed late."""
    modules = rooms.files()
    offered = rooms.offered(modules)

    def has(module, name):
        return f"{module}.{name}" in modules or name in offered.get(module, ()) or name in bound(modules[module])

    lost = []
    for path in sorted(ROOT.glob("benchmarks/**/*.py")):
        nodes = list(ast.walk(tree(path)))
        froms = (n for n in nodes if isinstance(n, ast.ImportFrom) and str(n.module).split(".")[0] in ("gapcert", *NAMES))
        taken = [(node.module, a.name) for node in froms for a in node.names]
        ours = {a.asname for a in aliases(nodes) if a.name == "gapcert" and a.asname}
        attributes = (n for n in nodes if isinstance(n, ast.Attribute) and isinstance(n.value, ast.Name) and n.value.id in ours)
        taken += [("gapcert", n.attr) for n in attributes]
        lost += [(name(path), *what) for what in taken if what[0] not in modules or not has(*what)]
    assert lost == []
