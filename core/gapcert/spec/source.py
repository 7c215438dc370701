"""YAML text → plain data, with the place of every key and value, and errors drawn at those places."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, final

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from gapcert.numerics.errors import GapcertError, MissingDependency, SpecError, clipped
from gapcert.spec.thresholds import THRESHOLDS

Key = str | int
At = tuple[Key, ...]
SHOWN = 200  # characters of the line of a mistake: a spec that is all one line has its mistakes side by side
_TAG = "tag:yaml.org,2002:"
_MISTYPED = re.compile(r"did you mean '([^']+)'\?")
_PLAIN = ("map", "seq", "str", "int", "float", "bool", "null", "timestamp", "merge")


@final
@dataclass(frozen=True)
class Source:
    """A text that a value was read from; `folder` is where its relative paths start."""

    label: str
    text: str = ""
    folder: Path = field(default_factory=Path)

    def line(self, number: int) -> str:
        lines = self.text.splitlines()
        return lines[number] if number < len(lines) else ""


@final
@dataclass(frozen=True)
class Mark:
    """Where a value and its key stand: (line, column), counted from 0; `inner` is where a scalar's own text begins."""

    source: Source
    value: tuple[int, int]
    key: tuple[int, int] | None = None
    inner: tuple[int, int] | None = None


@final
@dataclass(frozen=True)
class Tree:
    """Plain data, the mark of each path in it, and what was wrong with single values."""

    data: Any
    marks: Mapping[At, Mark]
    problems: tuple[Problem, ...] = ()

    def mark(self, path: At) -> Mark | None:
        """The mark of the deepest part of `path` that was written down."""
        return next((m for n in range(len(path), -1, -1) if (m := self.marks.get(path[:n])) is not None), None)


@final
@dataclass(frozen=True)
class Problem:
    """One thing wrong with a spec: at the key or the value of `path`, `offset` characters into a scalar's text."""

    path: At
    message: str
    hint: str = ""
    where: Literal["key", "value"] = "value"
    offset: int = 0
    missing: bool = False

    def place(self, tree: Tree) -> tuple[Source, int, int] | None:
        """(source, line, column) counted from 0."""
        if (mark := tree.mark(self.path)) is None:
            return None
        if self.where == "key" and mark.key is not None:
            return mark.source, *mark.key
        if self.offset and mark.inner is not None:
            return mark.source, *_advance(mark, self.offset)
        return mark.source, *mark.value

    def render(self, tree: Tree) -> str:
        """`file:line:col: error: path: message`, the line, and a caret with the hint."""
        place = self.place(tree)
        name = f"{clipped(dotted(self.path))[0]}: " if self.path else ""
        message = clipped(self.message)[0]
        if place is None or not place[0].text:
            label = place[0].label if place else "spec"
            return f"{label}: error: {name}{message}" + (f"; {self.hint}" if self.hint else "")
        source, line, column = place
        head = f"{source.label}:{line + 1}:{column + 1}: error: {name}{message}"
        shown, at = clipped(source.line(line), column, SHOWN)
        return f"{head}\n{line + 1:>7} | {shown}\n{'':>7} | {' ' * at}^ {self.hint}".rstrip()

    def as_dict(self, tree: Tree) -> dict[str, object]:
        """For `--json`."""
        place = self.place(tree)
        where = {"file": place[0].label, "line": place[1] + 1, "column": place[2] + 1} if place and place[0].text else {}
        return {**where, "path": dotted(self.path), "message": self.message, "hint": self.hint}


def _advance(mark: Mark, offset: int) -> tuple[int, int]:
    """`offset` characters on from where a scalar's text begins; a block scalar's indentation does not count."""
    line, column = mark.inner or mark.value
    if line > mark.value[0]:
        while offset > (length := max(len(mark.source.line(line)) - column, 0)):
            offset -= length + 1
            line += 1
    return line, column + offset


def dotted(path: At) -> str:
    """`backends[0].kind`."""
    return "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in path).removeprefix(".")


def failure(problems: Iterable[Problem], tree: Tree) -> GapcertError:
    """All problems of one tree in one error."""
    return failures((p, tree) for p in problems)


def failures(problems: Iterable[tuple[Problem, Tree]]) -> GapcertError:
    """All problems in one error, in the order of the files; MissingDependency where that is all that is wrong."""
    found: dict[object, tuple[tuple[int, int, int], Problem, Tree]] = {}
    labels: dict[str, int] = {}
    given = list(problems)
    mistyped = {(p.path[:-1], f"add {m[1]}:") for p, _ in given if (m := _MISTYPED.fullmatch(p.hint)) and p.path}
    for p, tree in given:
        # What is missing under a name that was mistyped is not missing.
        if (p.path, p.hint) in mistyped or ((), p.hint) in mistyped:
            continue
        for mark in tree.marks.values():
            labels.setdefault(mark.source.label, len(labels))
        place = p.place(tree)
        at = (labels[place[0].label], *place[1:]) if place else (-1, 0, 0)
        # Later checks may stumble over a value that an earlier one has reported: the first word about it stands.
        same = (at, p.path) if p.where == "value" and p.path else (at, p.path, p.message)
        found.setdefault(same, (at, p, tree))
    ordered = sorted(found.values(), key=lambda item: item[0])
    text = "\n".join(p.render(tree) for _, p, tree in ordered)
    error: GapcertError = MissingDependency(text) if all(p.missing for _, p, _ in ordered) else SpecError(text)
    error.problems = tuple(p.as_dict(tree) for _, p, tree in ordered)
    return error


def read(path: Path) -> Tree:
    """Parse a file; SpecError for one that is missing, unreadable, not UTF-8 or not YAML."""
    label = os.path.normpath(path)
    try:
        with open(path, "rb") as file:
            content = file.read(THRESHOLDS.spec_bytes + 1)
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise SpecError(f"{label}: error: byte {error.start} is not UTF-8; save the spec as UTF-8 text") from None
    except OSError as error:
        raise SpecError(f"{label}: error: {(error.strerror or str(error)).lower()}; give the path of a spec file") from None
    except ValueError as error:  # a path that no file can have
        raise SpecError(f"{label}: error: {error}; give the path of a spec file") from None
    if len(content) > THRESHOLDS.spec_bytes:
        raise SpecError(
            f"{label}: error: it is larger than {THRESHOLDS.spec_bytes:,} bytes; a spec names its data, it does not hold them"
        )
    return parse(Source(label, text, path.parent))


def parse(source: Source, base: At = (), origin: tuple[int, int] = (0, 0)) -> Tree:
    """Parse YAML 1.2 text. `base` prefixes all paths; `origin` shifts the marks of a text that begins inside its source."""
    text = source.text if origin == (0, 0) else source.text[origin[1] :]
    if _depth(text) > THRESHOLDS.spec_depth:
        raise _too_deep(source)
    if text.count(",") + text.count("\n") > THRESHOLDS.spec_values:
        raise _too_many(source)
    try:
        node = YAML(typ="safe", pure=True).compose(text)
    except RecursionError:
        raise _too_deep(source) from None
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        at = (0, 0) if mark is None else (mark.line, mark.column + origin[1])
        tree = Tree(None, {(): Mark(source, at)})
        since = error.context_mark.line if error.context_mark is not None else None
        place = (0, 0) if mark is None else (mark.line, mark.column)
        hint = _advice(str(error.problem), str(error.context or ""), text.splitlines(), place, since)
        raise failure([Problem((), f"not YAML: {error.problem}", hint)], tree) from None
    except YAMLError as error:
        raise SpecError(f"{source.label}: error: not YAML: {' '.join(str(error).split())}") from None
    reader = _Reader(source, origin[1])
    if node is None:
        return Tree(None, {base: Mark(source, origin)})
    data = reader.value(node, base, None)
    return Tree(data, reader.marks, tuple(reader.problems))


_QUOTES = "put quotes around it"
# Slips that are often made, by what the parser says of them.
_SAID = (
    (r"found character '\\t'", "indent with spaces, not with tabs"),
    (r"that cannot start any token|alphabetic or numeric character", _QUOTES),
    (r"undefined alias", f"{_QUOTES} if it is text"),
    (r"unknown escape", "use single quotes, or write \\\\ for a backslash"),
    (r"a comment or a line break", "begin the text in the next line, or put quotes around it"),
    (r"another document", "a file holds one spec; remove the line ---"),
    (r"but found '<scalar>'", "a quote within quotes is written twice, or the quotes are of the other kind"),
    (r"but found '<block mapping start>'|but found '(-|\?)'", "indent it as the keys beside it"),
    (r"but found '[\]}]'", "it closes what was not opened; remove it"),
    (r"sequence entries are not allowed", "begin a list in the next line, or write [a, b]"),
)
_TIGHT = re.compile(r"^[^#'\"]*?[\w\])]:[^\s:/\\]")  # `kind:csv`, but neither a path nor an address


def _advice(said: str, context: str, lines: Sequence[str], at: tuple[int, int], since: int | None) -> str:
    """What to do: `said` by the parser at (line, column) of the text, about something that began in line `since`, from 0."""
    above = "" if since is None else f" in line {since + 1}"
    here = lines[at[0]] if at[0] < len(lines) else ""
    if "quoted scalar" in context and "end of stream" in said:
        return f"close the quote that was opened{above}"
    if said.startswith("expected ',' or"):
        if re.search(r"but got '\['", said) and re.match(r".*\w[^,:]*$", here[: at[1]]):
            return "put quotes around a name that has brackets in it"
        mark = "]" if "]" in said.partition("but got")[0] else "}"
        return f"put a comma before it, or close with {mark} what was opened{above}"
    if "mapping values" in said:
        return _second_colon(lines, here[: at[1]], at[0])
    if "expected ':'" in said and since is not None:
        tight = since < len(lines) and _TIGHT.match(lines[since])
        return f"write a blank after the colon{above}" if tight else f"write key: value{above}"
    return next((hint for pattern, hint in _SAID if re.search(pattern, said)), context)


def _second_colon(lines: Sequence[str], before: str, line: int) -> str:
    """A colon where none may be: in a text, or since the line above is no key or is indented otherwise."""
    if re.match(r"\s*(- +)?[^\s:][^:]*:\s+\S", before):
        return "put quotes around a text that has a colon and a blank in it"
    above = next((n for n in range(line - 1, -1, -1) if lines[n].strip() and not lines[n].lstrip().startswith("#")), None)
    if above is not None and _TIGHT.match(lines[above]):
        return f"write a blank after the colon in line {above + 1}"
    return "indent it as the keys beside it"


def _depth(text: str) -> int:
    """How many brackets are open at once, strings and comments included: what opens many is no spec, and slow to parse."""
    depth = deepest = 0
    for mark in re.findall(r"[\[\]{}]", text):
        depth = depth + 1 if mark in "[{" else max(depth - 1, 0)
        deepest = max(deepest, depth)
    return deepest


def _too_many(source: Source) -> SpecError:
    what = f"it has more than {THRESHOLDS.spec_values:,} lines or values, what aliases repeat included"
    return SpecError(f"{source.label}: error: {what}; a spec names its data, it does not hold them")


def _too_deep(source: Source) -> SpecError:
    return SpecError(f"{source.label}: error: values are nested too deeply; a spec has at most {THRESHOLDS.spec_depth} levels")


@final
class _Reader:
    """Turns nodes into plain data. Only the plain types of YAML 1.2 exist here: no tag makes an object."""

    def __init__(self, source: Source, shift: int) -> None:
        self.source, self.shift = source, shift
        self.marks: dict[At, Mark] = {}
        self.problems: list[Problem] = []
        self.open: list[Node] = []
        self.count = 0
        self.scalars = YAML(typ="safe", pure=True).constructor

    def value(self, node: Node, path: At, key: Node | None) -> Any:
        self.count += 1
        if self.count > THRESHOLDS.spec_values or len(path) > THRESHOLDS.spec_depth:
            raise _too_many(self.source) if self.count > THRESHOLDS.spec_values else _too_deep(self.source)
        self.marks[path] = Mark(self.source, self.at(node), self.at(key) if key else None, self.inner(node))
        if any(node is outer for outer in self.open):
            self.problems.append(Problem(path, "an alias of the value that contains it", "write the value out"))
            return None
        tag = str(node.tag).removeprefix(_TAG)
        if tag not in _PLAIN:
            self.problems.append(Problem(path, f"the tag '!!{tag}' is not allowed", "a spec holds plain values only"))
        self.open.append(node)
        try:
            if isinstance(node, MappingNode):
                return self.mapping(node, path)
            if isinstance(node, SequenceNode):
                return [self.value(item, (*path, i), None) for i, item in enumerate(node.value)]
            return self.scalar(node, path)
        finally:
            self.open.pop()

    def mapping(self, node: MappingNode, path: At) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for key, value in node.value:
            name = key.value if isinstance(key, ScalarNode) else "?"
            if str(key.tag) == _TAG + "merge":
                self.marks[(*path, name)] = Mark(self.source, self.at(value), self.at(key))
                hint = "write its keys out; a spec that builds on another names it under `extends:`"
                self.problems.append(Problem((*path, name), "YAML 1.2 has no merge key '<<'", hint, "key"))
            elif name in out:
                first = self.marks[(*path, name)].key or (0, 0)
                self.marks[(*path, name)] = replace(self.marks[(*path, name)], key=self.at(key))
                self.problems.append(
                    Problem((*path, name), f"duplicate key '{name}'", f"first given in line {first[0] + 1}", "key")
                )
            else:
                out[name] = self.value(value, (*path, name), key)
                if (
                    ":" in name
                    and isinstance(value, ScalarNode)
                    and not value.value
                    and value.start_mark.line == key.end_mark.line
                ):
                    self.problems.append(
                        Problem((*path, name), f"'{name}' has no value", "write a blank after the colon", "key")
                    )
        return out

    def scalar(self, node: Node, path: At) -> Any:
        tag = str(node.tag).removeprefix(_TAG)
        if tag in ("int", "float", "bool", "null"):
            try:
                value = self.scalars.construct_object(node)
            except (ValueError, YAMLError):
                self.problems.append(Problem(path, f"'{node.value}' is no {tag}", "write a plain value"))
                return None
            if isinstance(value, float) and not math.isfinite(value):
                self.problems.append(Problem(path, f"found {node.value}; expected a finite number"))
            return None if value is None else {"int": int, "float": float, "bool": bool}[tag](value)
        return str(node.value)

    def at(self, node: Node) -> tuple[int, int]:
        line, column = node.start_mark.line, node.start_mark.column
        return line, column + (self.shift if line == 0 else 0)

    def inner(self, node: Node) -> tuple[int, int] | None:
        line, column = self.at(node)
        if not isinstance(node, ScalarNode):
            return None
        if node.style in ("|", ">"):
            text = self.source.line(line + 1)
            return line + 1, len(text) - len(text.lstrip())
        return line, column + (1 if node.style else 0)


def plain(value: Any, path: At, problems: list[Problem]) -> Any:
    """Python data as YAML would have given it: mappings, lists, finite numbers, text; anything else is a problem."""
    if isinstance(value, Mapping):
        return {str(k): plain(v, (*path, str(k)), problems) for k, v in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [plain(v, (*path, i), problems) for i, v in enumerate(value)]
    if hasattr(value, "tolist"):  # numpy arrays and scalars, without importing numpy
        return plain(value.tolist(), path, problems)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        problems.append(Problem(path, f"found {value}; expected a finite number"))
    elif not (value is None or isinstance(value, str | bool | int | float)):
        problems.append(Problem(path, f"found a {type(value).__name__}; expected plain data"))
    return value
