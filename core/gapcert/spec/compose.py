"""From files to one tree: `extends:`, `--set a.b=c`, and the specs of a `matrix:`."""

from __future__ import annotations

import difflib
import itertools
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from gapcert.spec.source import At, Key, Mark, Problem, Source, Tree, failure, parse, read
from gapcert.spec.thresholds import THRESHOLDS


def load_tree(path: Path) -> Tree:
    """A file merged over the files that it extends."""
    try:
        found = path.exists()
    except OSError:  # a name that the system refuses
        found = False
    if not found:
        near = near_file(path.name, [p.name for p in path.parent.glob("*.y*ml")])
        hint = f"did you mean '{path.with_name(near)}'?" if near else "give the path of a spec file"
        raise failure([Problem((), "no such file", hint)], read_nothing(str(path)))
    return extend(read(path), path.parent, (path.resolve(),))


def near_file(name: str, names: Iterable[str]) -> str | None:
    """The file that may have been meant: its name is nearly the same, whatever follows the last point."""
    stems = {Path(n).stem: n for n in names}
    found = difflib.get_close_matches(Path(name).stem, stems, 1, cutoff=0.75)
    return stems[found[0]] if found else None


def regular(path: Path) -> bool:
    """Is there a file with an end? A device or a pipe may never end, and no name that a system refuses is one."""
    try:
        return path.is_file() and path.resolve().parts[1:2] not in (("proc",), ("sys",), ("dev",))
    except (OSError, ValueError):
        return False


def matching(path: Path) -> list[Path]:
    """The regular files of one folder whose names match the last part of `path`."""
    return sorted(p for p in path.parent.glob(re.sub(r"\*+", "*", path.name)) if regular(p))


def data_files(path: Path) -> list[Path]:
    """A file, those of a pattern, or those of a folder (a bag, a data set; not its videos): of these at most one too many."""
    if path.is_dir():
        every = (Path(at, name) for at, _, names in os.walk(path) for name in names)  # without folders that cannot be read
        found = (p for p in every if p.suffix not in (".mp4", ".png") and regular(p))
        return sorted(itertools.islice(found, THRESHOLDS.folder_files + 1))
    return [path] if path.is_file() else matching(path) if "*" in path.name else []


def crowded(folder: Path) -> str:
    """Why a folder cannot be the data of a spec, or ""."""
    if folder.resolve().parts[1:2] in (("proc",), ("sys",), ("dev",)):
        return "belongs to the system"
    return f"has more than {THRESHOLDS.folder_files:,} files" if len(data_files(folder)) > THRESHOLDS.folder_files else ""


def read_nothing(label: str) -> Tree:
    """A tree that errors about a missing text can point to."""
    return Tree(None, {(): Mark(Source(label), (0, 0))})


def extend(tree: Tree, folder: Path, seen: tuple[Path, ...] = ()) -> Tree:
    """Merge a tree over the file that its `extends:` names, relative to `folder`."""
    if not isinstance(tree.data, dict) or "extends" not in tree.data:
        return tree
    name = tree.data["extends"]
    if not isinstance(name, str):
        raise failure([Problem(("extends",), f"found {name!r}; expected the path of another spec")], tree)
    path = folder / name
    if not regular(path):
        raise failure([Problem(("extends",), f"no file '{name}'", "paths are relative to the spec that names them")], tree)
    if path.resolve() in seen:
        raise failure([Problem(("extends",), f"'{name}' extends this file", "break the circle")], tree)
    if len(seen) > THRESHOLDS.extending_files:
        raise failure(
            [Problem(("extends",), f"more than {THRESHOLDS.extending_files} files extend each other", "merge some")], tree
        )
    base = extend(read(path), path.parent, (*seen, path.resolve()))
    data = merge(base.data, {k: v for k, v in tree.data.items() if k != "extends"})
    # Problems of the base that the child has overwritten are gone with their values.
    kept = tuple(p for p in base.problems if p.path not in tree.marks)
    return Tree(data, {**base.marks, **tree.marks}, kept + tree.problems)


def merge(base: Any, top: Any) -> Any:
    """Mappings key by key; `null` removes a key; a section whose `kind` changes is replaced; all else is replaced."""
    if not (isinstance(base, dict) and isinstance(top, dict)) or (
        "kind" in top and top["kind"] != base.get("kind", top["kind"])
    ):
        return top
    merged = {k: merge(v, top[k]) if k in top else v for k, v in base.items()}
    merged |= {k: v for k, v in top.items() if k not in base}
    return {k: v for k, v in merged.items() if not (v is None and k in top and k in base)}


def override(tree: Tree, assignments: Iterable[str], folder: Path) -> Tree:
    """Apply `a.b=c` texts; values are YAML, `null` removes a key, paths among them are relative to `folder`."""
    for text in assignments:
        name, equals, _ = text.partition("=")
        source = Source("--set", text, folder)
        path = parse_path(name)
        if not equals or not name.strip():
            raise failure([Problem((), f"found '{text}'", "write --set path.to.key=value")], read_nothing("--set"))
        patch = parse(source, path, (0, len(name) + 1))
        tree = put(tree, path, patch)
    return tree


def put(tree: Tree, path: At, patch: Tree) -> Tree:
    """A tree with the value at `path` replaced; mappings on the way are made, lists are indexed."""
    marks = {p: m for p, m in tree.marks.items() if p[: len(path)] != path} | dict(patch.marks)
    kept = tuple(p for p in tree.problems if p.path[: len(path)] != path)
    try:
        return Tree(_put(tree.data, path, patch.data), marks, kept + patch.problems)
    except (TypeError, IndexError, ValueError):
        hint = "the path leads through a value that is no mapping"
        raise failure([Problem(path, "cannot be set", hint)], Tree(tree.data, marks)) from None


def _put(data: Any, path: At, value: Any) -> Any:
    if not path:
        return value
    head, rest = path[0], path[1:]
    if isinstance(data, list):
        index = range(len(data))[int(head)]
        return [_put(v, rest, value) if i == index else v for i, v in enumerate(data)]
    if data is None:
        data = {}
    if not isinstance(data, dict):
        raise TypeError
    name = str(head)
    if value is None and not rest:  # as in `extends`: null removes a key
        return {k: v for k, v in data.items() if k != name}
    return {**data, name: _put(data.get(name), rest, value)}


def parse_path(text: str) -> At:
    """`a.b[0].c` or `a.b.0.c`."""
    parts: list[Key] = [p for p in re.split(r"[.\[\]]+", text.strip()) if p]
    return tuple(int(p) if isinstance(p, str) and p.isdigit() else p for p in parts)


def variants(tree: Tree) -> Iterator[tuple[dict[str, Any], Tree]]:
    """Each combination of a matrix as ({path: value}, tree without `matrix`); one, unnamed, where there is no matrix."""
    if not isinstance(tree.data, dict):
        yield {}, tree
        return
    bare = replace(tree, data={k: v for k, v in tree.data.items() if k != "matrix"})
    if "matrix" not in tree.data or matrix_problems(tree.data):
        yield {}, bare
        return
    matrix = tree.data["matrix"]
    for picks in itertools.product(*(range(len(v)) for v in matrix.values())):
        out, chosen = bare, {}
        for (name, values), i in zip(matrix.items(), picks, strict=True):
            path = parse_path(name)
            out = put(out, path, _moved(tree, ("matrix", name, i), path, values[i]))
            chosen[name] = values[i]
        yield chosen, out


def matrix_problems(data: Any) -> list[Problem]:
    """What is wrong with the shape of a `matrix:` section."""
    hint = "write path.to.key: [value, value]"
    if not isinstance(data, Mapping) or "matrix" not in data:
        return []
    if not isinstance(data["matrix"], Mapping) or not data["matrix"]:
        return [Problem(("matrix",), "expected a mapping of at least one path", hint)]
    if math.prod(len(v) for v in data["matrix"].values() if isinstance(v, list)) > THRESHOLDS.matrix_specs:
        return [Problem(("matrix",), f"it stands for more than {THRESHOLDS.matrix_specs:,} specs", "split it")]
    return [
        Problem(("matrix", name), "expected a list of at least one value", hint)
        for name, values in data["matrix"].items()
        if not (isinstance(values, list) and values)
    ]


def variant_name(name: str, chosen: Mapping[str, Any]) -> str:
    """A name for one spec of a matrix, from the values that it has."""
    words = [re.sub(r"[^a-z0-9_]+", "-", str(v).lower()).strip("-") for v in chosen.values()]
    return "-".join([name, *(w for w in words if w)])


def _moved(tree: Tree, old: At, new: At, data: Any) -> Tree:
    marks = {new + p[len(old) :]: m for p, m in tree.marks.items() if p[: len(old)] == old}
    return Tree(data, marks)
