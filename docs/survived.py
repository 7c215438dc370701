"""Tables of the faults and attacks that tests carry as markers: read from their text, so that a listing runs nothing."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from generate import Generated, table
from sphinx.application import Sphinx

ROOT = Path(__file__).parents[1]
HEADS = {"fault": ["what goes wrong", "what the test shows", "test"], "attack": ["where", "what is tried", "test"]}


@dataclass(frozen=True)
class Row:
    """One marker: its texts, and the node id of the test that carries it."""

    texts: tuple[str, ...]
    test: str


def rows(marker: str) -> list[Row]:
    """Every `fault(…)` or `attack(…)` of the tests; those of the room for faults come first."""
    paths = sorted(ROOT.glob("tests/**/test_*.py"), key=lambda p: ("faults" not in p.parts, str(p)))
    return [row for path in paths for row in _of(path, marker)]


def _of(path: Path, marker: str) -> Iterator[Row]:
    name = str(path.relative_to(ROOT))
    for test in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(test, ast.FunctionDef) and test.name.startswith("test_"):
            for decorator in test.decorator_list:
                yield from _below(decorator, marker, f"{name}::{test.name}")


def _below(node: ast.AST, marker: str, test: str) -> Iterator[Row]:
    """The markers in a decorator; those of one parameter set name its id."""
    if isinstance(node, ast.Call):
        called = getattr(node.func, "attr", getattr(node.func, "id", ""))
        if called == marker:
            yield Row(tuple(ast.literal_eval(v) for v in (*node.args, *(k.value for k in node.keywords))), test)
            return
        given = [k.value.value for k in node.keywords if k.arg == "id" and isinstance(k.value, ast.Constant)]
        if called in ("param", "case") and given:
            test += f"[{given[0]}]"
    for inner in ast.iter_child_nodes(node):
        yield from _below(inner, marker, test)


def _named(test: str) -> str:
    """A test's file and name, between which a line may end: a column must not be as wide as both."""
    path, _, name = test.removeprefix("tests/").partition("::")
    return f"`{path}` `{name}`"


class Survived(Generated):
    """The table of one marker, each row with its test."""

    def markdown(self) -> str:
        marker = self.arguments[0]
        self.env.note_reread()  # tests are no dependency of the last build
        found = [[*row.texts, _named(row.test)] for row in rows(marker)]
        return f"{len(found)} rows.\n\n{table(HEADS[marker], found)}"


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("survived", Survived)
    return {"parallel_read_safe": True}
