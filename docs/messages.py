"""The index of messages: every error that Gapcert raises and every problem that it finds in a spec, read from the code.

`python docs/messages.py "the words of a message"` names the place that says them.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import cache
from itertools import product
from pathlib import Path

ROOT = Path(__file__).parents[1]
# Errors by name, and the exit code of the command that they end. A ValueError of a config is a problem of the spec.
CODES = {
    "UsageError": 2, "NoStart": 2, "SpecError": 2, "ExpressionError": 2, "MalformedError": 2, "Problem": 2, "ValueError": 2,
    "MissingDependency": 3, "Interrupted": 4, "Undecided": 5,
}  # fmt: skip
# Calls whose arguments are (place, message, hint), and functions that return a sentence for someone else to place.
PLACED = {"Problem", "say", "error"}
SENTENCES = {"_sentence", "key_problem", "missing"}
# Where a message appears: title, page that explains it, and the paths of its code; the first that fits has it.
AREAS = tuple(
    (title, page, tuple(paths.split()))
    for title, page, paths in (
        ("Spec files", "spec", "core/gapcert/spec/ plugins/*/config.py plugins/*/section.py plugins/*/model_config.py"),
        ("Equations", "spec", "plugins/gapcert_equations/ plugins/gapcert_functions/expression.py"),
        (
            "Recordings and logs",
            "tutorial_log",
            "core/gapcert/contracts/data/recor plugins/gapcert_recordings/ plugins/gapcert_readers/",
        ),
        (
            "Diagnosis",
            "diagnosis",
            "plugins/gapcert_diagnosis/ plugins/gapcert_effects/ core/gapcert/contracts/data/effect.py "
            "core/gapcert/contracts/systems/extension.py",
        ),
        ("Comparison", "compare", "plugins/gapcert_compare/"),
        (
            "Engines",
            "backends",
            "plugins/gapcert_engines/ plugins/gapcert_calibrate/stochastic_backend.py plugins/gapcert_mujoco/ "
            "plugins/gapcert_dart/ plugins/gapcert_gazebo/ plugins/gapcert_pybullet/",
        ),
        (
            "Probes before a certificate",
            "concepts",
            "core/gapcert/certification/gates/ core/gapcert/contracts/systems/system.py",
        ),
        (
            "Controllers",
            "controllers",
            "core/gapcert/contracts/controllers/ core/gapcert/contracts/systems/region.py plugins/gapcert_cells/ "
            "plugins/gapcert_closed_loop/ plugins/gapcert_symbolic/ plugins/gapcert_mpc/",
        ),
        ("Checking a certificate and a log", "cli", "plugins/gapcert_verify/ plugins/gapcert_monitor/"),
        (
            "Running, files and plugins",
            "cli",
            "core/gapcert/cli/ core/gapcert/run/ core/gapcert/contracts/plugins/ core/gapcert/lazy.py "
            "core/gapcert/certification/samples/executors.py core/gapcert/certification/samples/store.py "
            "plugins/gapcert_report/ plugins/gapcert_dask/ plugins/gapcert_rerun/",
        ),
        ("Sampling, constants, gap functions and certificates", "choose", ""),
    )
)
MEANINGS = {
    2: "something cannot be used",
    3: "something is not installed",
    4: "interrupted",
    5: "not decided",
}
Node = ast.expr | None
_TUPLES = re.compile(r"\bProblem\b|tuple\[tuple\[str \| int")  # what the `check` of a config returns: (path, message, offset)


@dataclass(frozen=True)
class Message:
    """One place in the code that says something: its words, with ⟨placeholders⟩ for what it found."""

    path: str
    line: int
    error: str
    text: str
    hint: str = ""

    @property
    def code(self) -> int:
        return CODES[self.error]

    @property
    def carried(self) -> bool:
        """Whether it has no words of its own, and gives a place to what another one says."""
        own = re.sub(r"^(\S+: )+", "", self.text)
        return not words(own) and not words(self.hint)

    @property
    def area(self) -> int:
        fits = (k for k, (_, _, paths) in enumerate(AREAS) if any(_within(self.path, p) for p in paths))
        return next(fits, len(AREAS) - 1)  # the last one has the rest

    def says(self, text: str) -> bool:
        """Whether a message that a user has read can be one of these."""
        parts = re.split(r"⟨[^⟩]*⟩", " ".join(self.text.split()))
        return re.search(".*?".join(map(re.escape, parts)), " ".join(text.split()), re.DOTALL) is not None


def _within(path: str, pattern: str) -> bool:
    return fnmatch(path, pattern) if "*" in pattern else path.startswith(pattern)


def words(text: str) -> list[str]:
    """The words of a template outside of its placeholders."""
    return re.findall(r"[^\W\d_]{2,}", re.sub(r"⟨[^⟩]*⟩", " ", text))


def messages(root: Path = ROOT) -> tuple[Message, ...]:
    """All messages of core and plugins, in the order of their files."""
    return _read(root)


@cache
def _read(root: Path) -> tuple[Message, ...]:
    found: list[Message] = []
    for path in sorted([*root.glob("core/**/*.py"), *root.glob("plugins/**/*.py")]):
        name = path.relative_to(root).as_posix()
        if "/testing" not in name:  # what tests of plugins say is for pytest
            found += _of_module(name, ast.parse(path.read_text(encoding="utf-8")))
    return tuple(dict.fromkeys(found))


def find(text: str, root: Path = ROOT) -> list[Message]:
    """The messages that `text`, as a user has read it, can be; the one with the most words of its own first."""
    fits = [m for m in messages(root) if not m.carried and m.says(text)]
    return sorted(fits, key=lambda m: -len(words(m.text)))


def _of_module(path: str, tree: ast.Module) -> Iterator[Message]:
    constants: dict[str, list[ast.expr]] | None = None
    for scope in (tree, *(n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef))):
        said = [(node, *one) for node in _own(scope) for one in _said(path, scope, node)]
        if not said:
            continue
        constants = _assigned(tree.body) if constants is None else constants
        names = constants | _assigned(_own(scope))
        for node, error, text, hint in said:
            first, second = _texts(text, names), _texts(hint, names) if hint is not None else [""]
            yield from (Message(path, node.lineno, error, t, h) for t, h in product(first, second))


def _own(scope: ast.AST) -> Iterator[ast.AST]:
    """What is inside a module or function and in no function inside that."""
    left = list(ast.iter_child_nodes(scope))
    while left:
        node = left.pop()
        if not isinstance(node, ast.FunctionDef):
            yield node
            left += ast.iter_child_nodes(node)


def _said(path: str, scope: ast.AST, node: ast.AST) -> Iterator[tuple[str, Node, Node]]:
    """(error, message, hint) of a node that makes one."""
    spec = AREAS[0][2]
    if isinstance(node, ast.Call):
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        ours = name != "ValueError" or any(_within(path, p) for p in spec) or path.endswith("equations/units.py")
        if name in PLACED and len(node.args) >= 2 and not (name == "error" and _others(node)):
            lost = any(k.arg == "missing" for k in node.keywords)
            yield ("MissingDependency" if lost else "Problem"), node.args[1], node.args[2] if len(node.args) > 2 else None
        elif name in CODES and name != "Problem" and node.args and ours:
            hint = node.args[2] if name == "MalformedError" and len(node.args) > 2 else None
            yield name, node.args[0], hint
    elif (
        isinstance(node, ast.Tuple) and len(node.elts) == 3 and path.startswith("plugins/") and _TUPLES.search(_returns(scope))
    ):
        if isinstance(node.elts[1], ast.JoinedStr) or (
            isinstance(node.elts[1], ast.Constant) and " " in str(node.elts[1].value)
        ):
            yield "Problem", node.elts[1], None
    elif isinstance(node, ast.Return) and getattr(scope, "name", "") in SENTENCES and isinstance(node.value, ast.JoinedStr):
        yield "Problem" if path.startswith("core/gapcert/spec") else "MissingDependency", node.value, None


def _others(call: ast.Call) -> bool:
    """Whether `.error(a, b)` is something else than `spec.error(place, message)`."""
    return "spec" not in ast.unparse(call.func)


def _returns(scope: ast.AST) -> str:
    return ast.unparse(scope.returns) if isinstance(scope, ast.FunctionDef) and scope.returns else ""


def _assigned(nodes: Iterator[ast.AST] | list[ast.stmt]) -> dict[str, list[ast.expr]]:
    """Name → what is assigned to it."""
    out: dict[str, list[ast.expr]] = {}
    for node in nodes:
        if isinstance(node, ast.Assign):
            for target in node.targets:
                pairs = [(target, node.value)]
                if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                    pairs = list(zip(target.elts, node.value.elts, strict=False))
                for name, value in pairs:
                    if isinstance(name, ast.Name):
                        out.setdefault(name.id, []).append(value)
        elif isinstance(node, ast.AnnAssign | ast.NamedExpr) and isinstance(node.target, ast.Name) and node.value:
            out.setdefault(node.target.id, []).append(node.value)
    return out


def _texts(node: Node, names: dict[str, list[ast.expr]], depth: int = 0) -> list[str]:
    """The templates that an expression can give; what is no text of the code becomes a ⟨placeholder⟩."""
    if isinstance(node, ast.Constant):
        return [node.value if isinstance(node.value, str) else "" if node.value is None else f"{node.value}"]
    if isinstance(node, ast.JoinedStr):
        return _joined([_texts(v, names, depth) for v in node.values])
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _joined([_texts(node.left, names, depth), _texts(node.right, names, depth)])
    if isinstance(node, ast.IfExp):
        return _texts(node.body, names, depth) + _texts(node.orelse, names, depth)
    if isinstance(node, ast.BoolOp):
        return [t for v in node.values for t in _texts(v, names, depth)]
    if isinstance(node, ast.FormattedValue):
        node = node.value
        if isinstance(node, ast.IfExp):
            return _texts(node, names, depth)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "format":
        return [re.sub(r"\{\w*\}", "⟨…⟩", t) for t in _texts(node.func.value, names, depth)]
    if isinstance(node, ast.Name) and depth < 4 and any(_is_text(v) for v in names.get(node.id, ())):
        return [t for v in names[node.id] for t in _texts(v, names, depth + 1)]
    return [f"⟨{_placeholder(node)}⟩"]


def _is_text(node: ast.expr) -> bool:
    if isinstance(node, ast.IfExp):
        return _is_text(node.body) or _is_text(node.orelse)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _is_text(node.left) or _is_text(node.right)
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def _joined(parts: list[list[str]]) -> list[str]:
    """All readings of a text in parts; of more than 16 the first ones, since each has the same words around it."""
    out = [""]
    for part in parts:
        out = [a + b for a in out for b in dict.fromkeys(part)][:16]
    return out


def _placeholder(node: Node) -> str:
    """A short name for what an expression stands for: the last name in it that says something."""
    if isinstance(node, ast.Call):
        named = [a for a in node.args if not isinstance(a, ast.Constant)]
        return _placeholder(named[0]) if named else _placeholder(node.func)
    if isinstance(node, ast.Subscript | ast.Starred | ast.GeneratorExp | ast.ListComp):
        return _placeholder(getattr(node, "value", None) or getattr(node, "elt", None))
    if isinstance(node, ast.Attribute):
        return node.attr.strip("_").replace("_", " ")
    if isinstance(node, ast.Name):
        return node.id.strip("_").replace("_", " ") if len(node.id) > 1 else "…"
    if isinstance(node, ast.BinOp):
        return _placeholder(node.left)
    return "…"


def markdown(root: Path = ROOT) -> str:
    """The index: by exit code, then by where a message appears; last the places that only pass one on."""
    lines: list[str] = []
    for code, meaning in MEANINGS.items():
        here = [(m, m.area) for m in messages(root) if m.code == code and not m.carried]
        lines += [f"## Exit {code}: {meaning}", ""]
        for k, (title, page, _) in enumerate(AREAS):
            if rows := sorted(
                {(m.text, m.hint, f"{m.path}:{m.line}") for m, at in here if at == k}, key=lambda r: r[0].lower()
            ):
                lines += [f"### {title} ({code})", "", f"{len(rows)} messages; explained in {{doc}}`{page}`.", ""]
                lines += ["| message | said by |", "| --- | --- |"]
                lines += [f"| {_cell(t)}{f'<br>*{_cell(h)}*' if h else ''} | `{p}` |" for t, h, p in rows] + [""]
    carried = sorted({(f"{m.path}:{m.line}", m.error) for m in messages(root) if m.carried})
    lines += [
        "## Passed on",
        "",
        "These places give another message a place in a spec or a file, and have no words of their own.",
        "",
    ]
    return "\n".join([*lines, ", ".join(f"`{p}`" for p, _ in carried)])


def _cell(text: str) -> str:
    """Text in a Markdown table: nothing in it is markup."""
    return re.sub(r"([\\`*_{}\[\]<>#|$~])", r"\\\1", " ".join(text.split()))


def main(text: str) -> None:
    """Print the messages that `text` can be."""
    for hit in find(text):
        print(f"exit {hit.code}  {AREAS[hit.area][0]}  {hit.path}:{hit.line}\n    {hit.text}")
        if hit.hint:
            print(f"    {hit.hint}")


if __name__ == "__main__":
    main(" ".join(sys.argv[1:]))
