"""The restricted grammar of equation text: a checked Python syntax tree, never evaluated."""

from __future__ import annotations

import ast
import difflib
import functools
import math
import re
import unicodedata
import warnings
from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from keyword import iskeyword
from typing import final

from gapcert import UsageError
from gapcert_equations.thresholds import THRESHOLDS

FUNCTIONS: dict[str, Callable[..., float]] = {
    "sin": math.sin,
    "cos": math.cos,
    "tan": math.tan,
    "exp": math.exp,
    "log": math.log,
    "sqrt": math.sqrt,
    "abs": abs,
    "tanh": math.tanh,
    "atan": math.atan,
    "asin": math.asin,
    "acos": math.acos,
    "sign": lambda x: float(x > 0) - float(x < 0),
    "round": lambda x: float(round(x)),
    "min": min,
    "max": max,
}
_STRANGE = re.compile(r"[^\w\s+\-*/().,]")
_HINTS = {"^": "write ** for powers", "=": "write only the right-hand side", "'": "no text", '"': "no text"}


@final
class ExpressionError(UsageError):
    """An expression that cannot be used; `offset` is the column of the token in its text, from 0.

    lacking: of a term in another unit than it should be, the dimension that it has to be multiplied with.
    """

    def __init__(self, message: str, offset: int = 0, lacking: Mapping[str, Fraction] | None = None) -> None:
        super().__init__(message)
        self.offset, self.lacking = offset, lacking


@functools.lru_cache(maxsize=1 << 14)
def parse(text: str) -> ast.expr:
    """Text → a tree of numbers, names, + − * / **, and calls of FUNCTIONS; `col_offset` counts characters of the text.

    Trees are kept, since effects are tried on one model many times; nobody changes them.
    """
    if not text.strip():
        raise ExpressionError("the expression is empty; write one such as -k*q")
    if len(text) > THRESHOLDS.characters:
        raise ExpressionError(f"the expression has {len(text)} characters; at most {THRESHOLDS.characters} are allowed")
    if (strange := _STRANGE.search(text)) is not None:
        hint = _HINTS.get(strange[0], "use numbers, names, + - * / ** and " + ", ".join(FUNCTIONS))
        raise ExpressionError(f"'{strange[0]}' is not allowed here; {hint}", strange.start())
    lead = len(text) - len(text.lstrip())
    source = re.sub(r"\s", " ", text)[lead:].rstrip()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tree = ast.parse(source, mode="eval").body
    except SyntaxError as error:
        raise ExpressionError(
            f"cannot read the expression here ({error.msg})", lead + max((error.offset or 1) - 1, 0)
        ) from None
    except (ValueError, MemoryError, RecursionError):
        raise ExpressionError("the expression is nested too deeply; write it flatter") from None
    encoded = source.encode()
    for node in ast.walk(tree) if lead or len(encoded) > len(source) else ():
        if isinstance(node, ast.expr):
            node.col_offset = lead + len(encoded[: node.col_offset].decode())
    _check(tree, 0)
    return tree


def _check(node: ast.expr, depth: int) -> float | None:
    """Refuse everything outside the grammar; the value where the subtree is constant, which its node keeps."""
    vars(node)["folded"] = value = _fold(node, depth)
    return value


def _fold(node: ast.expr, depth: int) -> float | None:
    if depth > THRESHOLDS.depth:
        raise ExpressionError("the expression is nested too deeply; write it flatter", node.col_offset)
    if isinstance(node, ast.Constant) and isinstance(number := node.value, int | float) and not isinstance(number, bool):
        return _finite(node, lambda: float(number))
    if isinstance(node, ast.Name):
        if node.id in FUNCTIONS:
            raise ExpressionError(f"'{node.id}' is a function; write {node.id}(...)", node.col_offset)
        return math.pi if node.id == "pi" else None
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.UAdd | ast.USub):
        value = _check(node.operand, depth + 1)
        return None if value is None else -value if isinstance(node.op, ast.USub) else value
    if isinstance(node, ast.BinOp):
        return _check_binary(node, depth)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        return _check_call(node, node.func.id, depth)
    word = {"Attribute": "an attribute ('.')", "Tuple": "a list"}.get(type(node).__name__, f"a {type(node).__name__.lower()}")
    raise ExpressionError(f"{word} is not allowed; use numbers, names, + - * / ** and functions", node.col_offset)


def _check_binary(node: ast.BinOp, depth: int) -> float | None:
    left, right = _check(node.left, depth + 1), _check(node.right, depth + 1)
    if isinstance(node.op, ast.Pow):
        if right is not None and abs(right) > THRESHOLDS.exponent:
            raise ExpressionError(f"the exponent {right:g} is too large; at most {THRESHOLDS.exponent}", node.right.col_offset)
        # Only a constant base can grow while it is read.
        return None if left is None or right is None else _finite(node, lambda: left**right)
    if isinstance(node.op, ast.Div):
        if right == 0:
            raise ExpressionError("division by zero", node.right.col_offset)
        return None if left is None or right is None else _finite(node, lambda: left / right)
    operation = {ast.Add: float.__add__, ast.Sub: float.__sub__, ast.Mult: float.__mul__}.get(type(node.op))
    if operation is None:
        raise ExpressionError("this operator is not allowed; use + - * / **", node.right.col_offset)
    return None if left is None or right is None else _finite(node, lambda: operation(left, right))


def _check_call(node: ast.Call, name: str, depth: int) -> float | None:
    if name not in FUNCTIONS:
        raise ExpressionError(f"unknown function '{name}'; {near(name, FUNCTIONS)}", node.col_offset)
    if node.keywords or any(isinstance(a, ast.Starred) for a in node.args):
        raise ExpressionError(f"{name} takes plain arguments only", node.col_offset)
    low, high = (2, THRESHOLDS.arguments) if name in ("min", "max") else (1, 1)
    if not low <= len(node.args) <= high:
        wanted = f"{low} to {high} arguments" if high > 1 else "one argument"
        raise ExpressionError(f"{name} has {len(node.args)} arguments; expected {wanted}", node.col_offset)
    values = [_check(a, depth + 1) for a in node.args]
    constants = [v for v in values if v is not None]
    return _finite(node, lambda: FUNCTIONS[name](*constants)) if len(constants) == len(values) else None


def _finite(node: ast.expr, compute: Callable[[], float]) -> float:
    try:
        value = compute()
    except (OverflowError, ValueError, ZeroDivisionError):
        value = math.nan
    if isinstance(value, complex) or not math.isfinite(value):
        raise ExpressionError("this number is not finite and real", node.col_offset)
    return float(value)


def constant(node: ast.expr) -> float | None:
    """The value of a subtree of `parse` that contains no names (π counts as a number), else None."""
    folded: float | None = vars(node)["folded"]
    return folded


@functools.lru_cache(maxsize=1 << 14)
def names(tree: ast.expr) -> tuple[tuple[str, int], ...]:
    """(name, offset) of every variable, in the order of the text; functions and pi are none."""
    found, open_ = list[tuple[str, int]](), [tree]
    while open_:
        node = open_.pop()
        if isinstance(node, ast.BinOp):
            open_ += (node.left, node.right)
        elif isinstance(node, ast.UnaryOp):
            open_.append(node.operand)
        elif isinstance(node, ast.Call):
            open_ += node.args
        elif isinstance(node, ast.Name) and node.id != "pi":
            found.append((node.id, node.col_offset))
    return tuple(sorted(found, key=lambda item: item[1]))


def check_names(tree: ast.expr, known: Iterable[str]) -> None:
    """ExpressionError at the first name that is not known, with the nearest one."""
    known = set(known)
    for name, offset in names(tree):
        if name not in known:
            raise ExpressionError(f"unknown name '{name}'; {near(name, known)}", offset)


def near(name: str, known: Iterable[str]) -> str:
    """`did you mean 'x'?`, or what there is."""
    known = sorted(known)
    match = difflib.get_close_matches(name, known, 1, 0.6)
    return f"did you mean '{match[0]}'?" if match else f"there are {', '.join(known) or 'none'}"


def name_problem(name: str) -> str | None:
    """Why a name cannot stand in an expression, or None."""
    if not name.isidentifier() or unicodedata.normalize("NFKC", name) != name:
        return f"'{name}' cannot be used as a name; use letters, digits and _, with a letter first"
    if name.startswith("__") or iskeyword(name) or name in FUNCTIONS or name == "pi":
        return f"'{name}' is reserved; choose another name"
    return None


def substitute(text: str, replacements: Mapping[str, str]) -> str:
    """The text with names replaced by expressions, in parentheses where needed."""
    for name, offset in reversed(names(parse(text))):
        if (new := replacements.get(name)) is not None:
            bracketed = new if new.isidentifier() else f"({new})"
            text = text[:offset] + bracketed + text[offset + len(name) :]
    return text
