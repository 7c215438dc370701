"""Whose code an unexpected exception comes from: a plugin's, or Gapcert's own."""

from __future__ import annotations

import ast
import importlib.util
import re
import sys
import traceback
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from gapcert.numerics.errors import clipped

OWN = "gapcert"
"""The distribution whose faults are ours."""
_REMOTE = re.compile(r'^ *File "([^"\n]+)", line (\d+), in (.+)$', re.MULTILINE)


def told(error: BaseException) -> str | None:
    """`error in plugin acme 1.0 (file.py:12, Class.method): RuntimeError: …`; None: not known as a plugin's."""
    where = culprit(error)
    return None if where is None else f"error in plugin {where}: {type(error).__name__}: {clipped(str(error))[0]}"


def culprit(error: BaseException) -> str | None:
    """`acme 1.0 (file.py:12, Class.method)` where the innermost frame that is no library's is a third party's plugin's."""
    with suppress(Exception):  # what tells of an error must not be one
        homes = _homes()
        for file, line, name in reversed(list(_frames(error))):
            path = Path(file).resolve()
            owner = next((homes[p] for p in (path, *path.parents) if p in homes), None)
            if owner is not None:
                own = owner.partition(" ")[0] == OWN
                return None if own else f"{owner} ({path.name}:{line}, {_qualified(path, line) or name})"
    return None


def _frames(error: BaseException) -> Iterator[tuple[str, int, str]]:
    """(file, line, function), the innermost last; a worker process sends its own as text."""
    for frame in traceback.extract_tb(error.__traceback__):
        yield frame.filename, frame.lineno or 0, frame.name
    if (text := getattr(error.__cause__, "tb", None)) is not None:
        yield from ((file, int(line), name) for file, line, name in _REMOTE.findall(str(text)))


def _homes() -> Mapping[Path, str]:
    """Folders of packages, and files of modules, of all plugins and of Gapcert: path → distribution with version."""
    from gapcert.contracts.plugins.registry import installed

    known, tops = installed(), dict[str, str]()
    for key, module in known.manager.list_name_plugin():
        tops[str(getattr(module, "__name__", "")).partition(".")[0]] = key.rpartition(":")[0]
    for c in known.components.values():
        tops.setdefault(c.target.partition(":")[0].partition(".")[0], c.distribution)
    found = dict[Path, str]()
    for name, owner in (tops | {OWN: OWN}).items():
        found |= dict.fromkeys(_places(name) if name else (), owner)
    return found


def _places(top: str) -> list[Path]:
    module = sys.modules.get(top)
    spec = getattr(module, "__spec__", None) or importlib.util.find_spec(top)
    if spec is None:
        return []
    inside = list(spec.submodule_search_locations or ())
    return [Path(p).resolve() for p in inside or ([spec.origin] if spec.origin else [])]


def _qualified(path: Path, line: int) -> str:
    """`Class.method` of a line of a source file; nothing where that cannot be said."""
    names = list[str]()
    with suppress(OSError, SyntaxError, ValueError):
        node: ast.AST | None = ast.parse(path.read_bytes())
        while node is not None:
            node = next((n for n in ast.walk(node) if n is not node and _holds(n, line)), None)
            names += [node.name] if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) else []
    return ".".join(names)


def _holds(node: ast.AST, line: int) -> bool:
    """Is it a definition around the line? `ast.walk` comes to the outer ones first."""
    return isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and (
        node.lineno <= line <= (node.end_lineno or line)
    )
