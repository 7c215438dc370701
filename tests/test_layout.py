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
from pathlib import Path

import pathspec
import pytest

import gapcert

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PLUGINS = sorted(p for p in (ROOT / "plugins").iterdir() if p.is_dir() and p.name != "__pycache__")
NAMES = [p.name for p in PLUGINS]
SOURCES = sorted([*ROOT.glob("core/**/*.py"), *ROOT.glob("plugins/**/*.py")])
SUBMODULES = {"collections.abc"}
TESTS = sorted(ROOT.glob("tests/**/*.py"))


def name(path):
    return str(path.relative_to(ROOT))


def module_of(path):
    parts = path.with_suffix("").relative_to(ROOT).parts[1:]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(path, tree=None):
    """Absolute names of the modules that a file (or a part of it) imports."""
    for node in ast.walk(tree or ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            package = module_of(path) if path.name == "__init__.py" else module_of(path).rpartition(".")[0]
            yield importlib.util.resolve_name("." * node.level + (node.module or ""), package)


# --- packaging traps


def test_no_line_of_gitignore_hides_a_source_file():
    spec = pathspec.PathSpec.from_lines("gitignore", (ROOT / ".gitignore").read_text().splitlines())
    hidden = [name(p) for p in SOURCES if spec.match_file(name(p))]
    assert hidden == []
    assert pathspec.PathSpec.from_lines("gitignore", ["core"]).match_file("core/gapcert/gap.py")


@pytest.mark.parametrize("plugin", PLUGINS, ids=NAMES)
def test_a_plugin_cannot_be_mistaken_for_the_library_it_wraps(plugin):
    assert re.fullmatch(r"gapcert_[a-z0-9_]+", plugin.name)
    assert {"__init__.py", "plugin.py", "py.typed"} <= {p.name for p in plugin.iterdir()}


def test_every_plugin_has_an_entry_point_that_is_installed():
    declared = PROJECT["project"]["entry-points"]["gapcert"]
    assert declared == {n.removeprefix("gapcert_"): f"{n}.plugin" for n in NAMES}
    found = {p.name: p.value for p in importlib.metadata.distribution("gapcert").entry_points if p.group == "gapcert"}
    assert found == declared, "the installed metadata are older than pyproject.toml; run `pip install -e .` again"


def test_import_linter_knows_every_plugin():
    linter = PROJECT["tool"]["importlinter"]
    contracts = {c["name"]: c for c in linter["contracts"]}
    assert linter["root_packages"] == ["gapcert", *NAMES]
    assert contracts["plugins use only the public API"]["source_modules"] == NAMES
    assert contracts["plugins do not import each other"]["modules"] == NAMES
    assert contracts["core never imports a plugin"]["forbidden_modules"] == NAMES


def test_every_dependency_is_imported_somewhere_and_every_import_is_declared():
    project = PROJECT["project"]
    lists = [project["dependencies"], *(v for k, v in project["optional-dependencies"].items() if k not in ("all", "dev"))]
    names = {re.match(r"[A-Za-z0-9_.-]+", line)[0] for lines in lists for line in lines}
    modules = {{"drake": "pydrake", "ruamel.yaml": "ruamel", "rerun-sdk": "rerun"}.get(n, n) for n in names}
    used = {m.split(".")[0] for p in SOURCES for m in imports(p)}
    # A distribution that adds to the package of another.
    used |= {name for name, module in {"mujoco-mjx": "mujoco.mjx"}.items() if any(module in imports(p) for p in SOURCES)}
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


def test_import_contracts_hold(sources):
    code, out = lint_imports(sources)
    assert code == 0, out


@pytest.mark.parametrize(
    ("file", "line", "contract"),
    [
        ("plugins/gapcert_bounds/__init__.py", "from gapcert.components import Registry", "public API"),
        ("plugins/gapcert_bounds/__init__.py", "import gapcert_effects", "each other"),
        ("core/gapcert/events.py", "def late():\n    import gapcert_bounds", "core never imports"),
        ("core/gapcert/verify.py", "from gapcert.gap import GapFunction", "shares no code"),
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


@pytest.mark.parametrize("plugin", PLUGINS, ids=NAMES)
def test_a_declaration_imports_only_gapcert(plugin):
    top = [n for n in ast.parse((plugin / "plugin.py").read_text()).body if isinstance(n, ast.Import | ast.ImportFrom)]
    assert set(imports(plugin / "plugin.py", ast.Module(top, []))) <= {"gapcert", *sys.stdlib_module_names} | SUBMODULES


@pytest.mark.parametrize("path", [p for p in SOURCES + TESTS if p.parts[-3:-1] != ("core", "gapcert")], ids=name)
def test_nothing_is_imported_through_the_folder_core(path):
    # `core.gapcert` would be a second copy of every class.
    assert not [m for m in imports(path) if m.split(".")[0] in ("core", "plugins")]


def runtime_imports(path, modules):
    """Modules of ours that are imported when `path` is: outside functions and outside `if TYPE_CHECKING`."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            for module in imports(path, ast.Module([node], [])):
                inner = [f"{module}.{alias.name}" for alias in node.names]
                yield from [m for m in inner if m in modules] or [m for m in [module] if m in modules]


def test_no_import_cycle():
    modules = {module_of(p): p for p in SOURCES}
    graph = {m: set(runtime_imports(p, modules)) for m, p in modules.items()}
    while free := {m for m, needs in graph.items() if not needs}:
        graph = {m: needs - free for m, needs in graph.items() if m not in free}
    assert graph == {}


# --- style that can be measured


def test_files_and_functions_are_small():
    texts = {name(p): p.read_text() for p in SOURCES}
    assert [p for p, text in texts.items() if len(text.splitlines()) > 400] == []
    functions = [(p, n) for p, text in texts.items() for n in ast.walk(ast.parse(text)) if isinstance(n, ast.FunctionDef)]
    assert [f"{p}:{n.lineno} {n.name}" for p, n in functions if n.end_lineno - n.lineno >= 60] == []


@pytest.mark.parametrize("path", SOURCES, ids=name)
def test_nothing_is_left_open_and_no_path_is_absolute(path):
    found = re.search(r"\b(TODO|FIXME|XXX|NotImplementedError)\b|[\"'](/home|/root|/work)/", path.read_text())
    assert found is None, found


# --- the public API


def public_names():
    return [n for n in gapcert.__all__ if not n.startswith("__")]


def test_the_table_of_names_and_the_imports_for_type_checkers_are_equal():
    tree = ast.parse(Path(gapcert.__file__).read_text())
    block = next(n for n in tree.body if isinstance(n, ast.If))
    assert ast.unparse(block.test) == "TYPE_CHECKING"
    checked = {
        alias.name: node.module.removeprefix("gapcert.")
        for node in block.body
        for alias in node.names
        if alias.asname == alias.name
    }
    assert checked == gapcert._HOME
    assert list(gapcert._HOME) == sorted(gapcert._HOME)


@pytest.mark.parametrize("public", public_names())
def test_public_names_are_documented_and_classes_are_abstract_or_final(public):
    value = getattr(gapcert, public)
    if inspect.isclass(value) or inspect.isfunction(value):
        assert inspect.getdoc(value), public
    if inspect.isclass(value) and not issubclass(value, Exception):
        abstract, final = inspect.isabstract(value), getattr(value, "__final__", False)
        assert abstract != final, f"{public}: mark it @final, or leave a method abstract"
        depth = len([c for c in value.__mro__[1:] if c.__module__.startswith("gapcert")])
        assert depth <= 2, f"{public}: {depth} levels of inheritance"
