"""Which room imports which: from the sources, against tests/rooms.toml. `python tests/support/rooms.py` prints the table."""

import ast
import importlib.util
import tomllib
from collections.abc import Container, Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

from stubs import homes

ROOT = Path(__file__).parents[2]
MAP = tomllib.loads((ROOT / "tests" / "rooms.toml").read_text())
ORDER = {room: level for level, line in enumerate(MAP["order"]) for room in line}
FACADES = ("gapcert", "gapcert.plugin")
"""Strings that name what is anywhere."""
PARTS = {name: room for room, names in MAP["modules"].items() for name in names} | {
    r: r for r in ORDER if r.startswith("gapcert_")
}


class Import(NamedTuple):
    """One module of ours imports another: when it is imported itself, only for types, or later."""

    source: str
    target: str
    when: str

    @property
    def rooms(self) -> tuple[str, str]:
        return room(self.source), room(self.target)


def files() -> dict[str, Path]:
    """All modules of core and plugins."""
    found = {}
    for top in ("core", "plugins"):
        for path in sorted((ROOT / top).rglob("*.py")):
            parts = path.relative_to(ROOT / top).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def folders() -> dict[Path, int]:
    """Folder → modules in it, of core and plugins; templates are no modules."""
    counts: dict[Path, int] = {}
    for path in files().values():
        if "templates" not in path.parts:
            folder = path.parent.relative_to(ROOT)
            counts[folder] = counts.get(folder, 0) + 1
    return counts


@cache
def room(module: str) -> str:
    """The longest name in the map that begins the module's own."""
    parts = module.split(".")
    names = (".".join(parts[:n]) for n in range(len(parts), 0, -1))
    return next((PARTS[name] for name in names if name in PARTS), "")


def offered(modules: Mapping[str, Path]) -> dict[str, dict[str, str]]:
    """Package → name → where that is, of all that import lazily."""
    texts = {module: path.read_text() for module, path in modules.items()}
    return {m: homes(ast.parse(text)) for m, text in texts.items() if "__class__ = LazyPackage" in text}


def imports(modules: Mapping[str, Path]) -> list[Import]:
    """All of them, but the facades'."""
    lazy = offered(modules)
    return [i for module, path in modules.items() if module not in FACADES for i in imported(module, path, modules, lazy)]


def imported(module: str, path: Path, modules: Container[str], lazy: Mapping[str, Mapping[str, str]]) -> Iterator[Import]:
    """By one file; what a package offers counts as imported from where it is."""
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node, when in _statements(ast.parse(path.read_text()).body, "now"):
        for target in _targets(node, package, modules, lazy):
            if target != module and target not in FACADES:
                yield Import(module, target, when)


def _statements(body: Iterable[ast.stmt], when: str) -> Iterator[tuple[ast.Import | ast.ImportFrom, str]]:
    for node in body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node, when
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield from _statements(node.body, "later")
        elif isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            yield from _statements(node.body, "types")
            yield from _statements(node.orelse, when)
        else:
            for part in ("body", "orelse", "finalbody"):
                yield from _statements(getattr(node, part, ()), when)
            for handler in (*getattr(node, "handlers", ()), *getattr(node, "cases", ())):
                yield from _statements(handler.body, when)


def _targets(
    node: ast.Import | ast.ImportFrom, package: str, modules: Container[str], lazy: Mapping[str, Mapping[str, str]]
) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names if alias.name in modules)
        return
    module = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
    for alias in node.names:
        inner = f"{module}.{alias.name}"
        if (home := lazy.get(module, {}).get(alias.name)) is not None:
            yield home
        elif inner in modules:
            yield inner
        elif module in modules:
            yield module


def inner(modules: Mapping[str, Path]) -> list[tuple[str, str]]:
    """(module, what it names) wherever a package names more of another than its `__init__`, or of the core than its doors."""
    lazy = {package: dict.fromkeys(table, package) for package, table in offered(modules).items()}
    found = [i for m, path in modules.items() for i in imported(m, path, modules, lazy) if m.startswith("gapcert_")]
    apart = [(i.source, i.target) for i in found if i.source.partition(".")[0] != i.target.partition(".")[0]]
    return [(a, b) for a, b in apart if "." in b and b not in FACADES]


def reached(found: Iterable[Import], start: Iterable[str]) -> set[str]:
    """All that these modules import when they run, and what that imports."""
    graph: dict[str, set[str]] = {}
    for i in found:
        if i.when != "types":
            graph.setdefault(i.source, set()).add(i.target)
    seen, todo = set[str](), list(start)
    while todo:
        if (module := todo.pop()) not in seen:
            seen.add(module)
            todo += graph.get(module, ())
    return seen


def upward(found: Iterable[Import]) -> list[Import]:
    """Imports of a room that is not below: what the order forbids."""
    return [i for i in found if (a := i.rooms[0]) != (b := i.rooms[1]) and ORDER[b] >= ORDER[a]]


def knots(edges: Iterable[tuple[str, str]]) -> list[list[str]]:
    """Cycles: the strongly connected components of more than one node (Tarjan 1972)."""
    graph: dict[str, set[str]] = {}
    for a, b in edges:
        graph.setdefault(a, set()).add(b)
        graph.setdefault(b, set())
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(a: str) -> None:
        index[a] = low[a] = len(index)
        stack.append(a)
        for b in sorted(graph[a]):
            if b not in index:
                visit(b)
                low[a] = min(low[a], low[b])
            elif b in stack:
                low[a] = min(low[a], index[b])
        if low[a] == index[a]:
            part = stack[stack.index(a) :]
            del stack[stack.index(a) :]
            if len(part) > 1:
                found.append(sorted(part))

    for a in sorted(graph):
        if a not in index:
            visit(a)
    return sorted(found)


def totals() -> dict[str, int]:
    """Lines of the core, and of core and plugins together."""
    core, plugins = (sum(len(p.read_text().splitlines()) for p in (ROOT / top).rglob("*.py")) for top in ("core", "plugins"))
    return {"core": core, "together": core + plugins}


def main() -> None:
    modules = files()
    found = imports(modules)
    print(f"{'room':24}{'files':>6}{'lines':>8}")
    for name in ORDER:
        own = [path for module, path in modules.items() if room(module) == name]
        print(f"{name:24}{len(own):6}{sum(len(p.read_text().splitlines()) for p in own):8}")
    print(", ".join(f"{what} {n}" for what, n in totals().items()), "lines")
    print(f"most files in one folder: {max(folders().values())}")
    pairs = {(i.source, i.target) for i in upward(found)}
    print(f"{len(pairs)} pairs of files import upwards")
    for a, b in sorted(pairs):
        print(f"  {a} -> {b}")
    print("cycles of rooms:", knots({i.rooms for i in found if i.rooms[0] != i.rooms[1]}))
    print("cycles of files when imported:", knots({i[:2] for i in found if i.when == "now"}))
    print("cycles of files, all imports:", knots({i[:2] for i in found}))


if __name__ == "__main__":
    main()
