"""Equation text → SymPy: a walk over the checked tree; constants are folded first, so nothing large is ever evaluated."""

from __future__ import annotations

import ast
import functools
from typing import Any

import sympy

from .grammar import FUNCTIONS, ExpressionError, constant, parse

# SymPy's own Min and Max compare all arguments with each other, and its tanh expands its own to learn whether it is real: both
# can take very long; it has no rounding.
_PLAIN = ("round", "min", "max", "tanh")
_SYMBOLIC: dict[str, Any] = {
    name: sympy.Function(name, real=True) if name in _PLAIN else getattr(sympy, "Abs" if name == "abs" else name)
    for name in FUNCTIONS
}


@functools.cache
def symbol(name: str) -> Any:
    """A real SymPy symbol."""
    return sympy.Symbol(name, real=True)


@functools.lru_cache(maxsize=1 << 14)
def expression(text: str) -> Any:
    """The SymPy expression of a text; ExpressionError where simplification shows a division by zero or a complex number."""
    out = _walk(parse(text))
    if out.has(sympy.zoo, sympy.nan, sympy.oo, sympy.I):
        raise ExpressionError(f"'{text}' simplifies to {out}, which is not a finite real number")
    return out


def written(e: Any) -> str:
    """An expression as text of the grammar."""
    return str(sympy.sstr(e)).replace("Abs(", "abs(")


def _walk(node: ast.expr) -> Any:
    if (value := constant(node)) is not None:
        return _number(node, value)
    if isinstance(node, ast.Name):
        return symbol(node.id)
    if isinstance(node, ast.UnaryOp):
        inner = _walk(node.operand)
        return -inner if isinstance(node.op, ast.USub) else inner
    if isinstance(node, ast.Call):
        assert isinstance(node.func, ast.Name)
        return _SYMBOLIC[node.func.id](*(_walk(a) for a in node.args))
    assert isinstance(node, ast.BinOp)
    left, right = _walk(node.left), _walk(node.right)
    if isinstance(node.op, ast.Add):
        return left + right
    if isinstance(node.op, ast.Sub):
        return left - right
    if isinstance(node.op, ast.Mult):
        return left * right
    return left / right if isinstance(node.op, ast.Div) else left**right


def _number(node: ast.expr, value: float) -> Any:
    """Whole numbers and their ratios stay exact; everything else is the float64 that it folds to."""
    if value.is_integer() and abs(value) < 2**53:
        return sympy.Integer(int(value))
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
        p, q = constant(node.left), constant(node.right)
        if p is not None and q is not None and p.is_integer() and q.is_integer() and max(abs(p), abs(q)) < 2**53:
            return sympy.Rational(int(p), int(q))
    return sympy.Float(value)
