"""Units of names and expressions, through pint's registry, which is imported and built on first use."""

from __future__ import annotations

import ast
import functools
import importlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, final

from .grammar import ExpressionError, constant

_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\d\s.+-].*?|1\s*/.*?|(?<=\s)1)?\s*")
_LETTERS = re.compile(r"[\w%°*/^(). -]{1,60}")
# Pint evaluates powers of numbers while it reads: only a name or a bracket may have an exponent, and a short one.
_POWER = re.compile(r"(?<=[^\W\d])\d*\)?(?:\*\*|\^)\(?-?\d{1,2}(?:[./]\d)?\)?(?![\w^.]|\*\*)")
_BASE = {
    "[mass]": "kg",
    "[length]": "m",
    "[time]": "s",
    "[current]": "A",
    "[temperature]": "K",
    "[substance]": "mol",
    "[luminosity]": "cd",
}

Dimension = Mapping[str, Fraction]
NONE: Dimension = {}
SECOND: Dimension = {"[time]": Fraction(1)}
METRE: Dimension = {"[length]": Fraction(1)}
KILOGRAM: Dimension = {"[mass]": Fraction(1)}
INERTIA: Dimension = {"[mass]": Fraction(1), "[length]": Fraction(2)}
ACCELERATION: Dimension = {"[length]": Fraction(1), "[time]": Fraction(-2)}


@functools.cache
def _registry() -> Any:
    return importlib.import_module("pint").get_application_registry()


@functools.cache
def unit(text: str) -> tuple[Dimension, float]:
    """(dimension, factor to the coherent SI unit); ValueError if there is no such unit."""
    if text.strip() in ("", "1"):
        return NONE, 1.0
    squeezed = re.sub(r"\s*(\*\*|\^)\s*", r"\1", text.strip())
    powers = len(re.findall(r"\*\*|\^", squeezed))
    if _LETTERS.fullmatch(squeezed) is None or len(_POWER.findall(squeezed)) != powers:
        raise ValueError(f"unknown unit '{text[:60]}'; write one such as N*m, rad/s, m/s^2")
    registry = _registry()
    try:
        quantity = registry.Quantity(1.0, registry.parse_units(squeezed))
        zero = registry.Quantity(0.0, quantity.units).to_base_units().magnitude
        factor = float(quantity.to_base_units().magnitude)
        dimension = {str(k): Fraction(v).limit_denominator(100) for k, v in quantity.dimensionality.items() if v}
    except Exception:  # pint raises whatever its tokenizer and its definitions raise
        raise ValueError(f"unknown unit '{text}'; write one such as N*m, rad/s, m/s^2") from None
    if zero != 0:
        raise ValueError(f"unit '{text}' has an offset; use K")
    return dimension, 1.0 if math.isclose(factor, 1.0, rel_tol=1e-12) else factor


def coherent(text: str) -> Dimension:
    """The dimension of a unit whose factor is one; ValueError otherwise, since states and inputs are not converted."""
    dimension, factor = unit(text)
    if factor != 1.0:
        raise ValueError(f"unit '{text}' is not an SI base or derived unit; use {base_text(dimension, text)}")
    return dimension


def base_text(dimension: Dimension, like: str = "") -> str:
    """The coherent unit of a dimension as text, e.g. kg*m^2/s^2."""
    if not dimension:
        return "rad" if re.search(r"deg|rev|turn|°|grad", like) else "1"

    def power(name: str, exponent: Fraction) -> str:
        symbol = _BASE.get(name, name.strip("[]"))
        return symbol if exponent == 1 else f"{symbol}^{exponent}" if exponent.denominator == 1 else f"{symbol}^({exponent})"

    over = "*".join(power(k, v) for k, v in dimension.items() if v > 0) or "1"
    return over + "".join(f"/{power(k, -v)}" for k, v in dimension.items() if v < 0)


def quantity(value: float | str) -> tuple[float, str]:
    """(number, unit text) of `9.81 m/s^2` or a bare number; ValueError if it is neither, or not finite."""
    if not isinstance(value, str):
        number, text = float(value), ""
    elif (match := _QUANTITY.fullmatch(value)) is not None:
        number, text = float(match[1]), match[2] or ""
    else:
        raise ValueError(f"found '{value}'; expected a number with a unit, such as 9.81 m/s^2")
    if not math.isfinite(number):
        raise ValueError(f"found '{value}'; expected a finite number")
    return number, text


def convert(number: float, factor: float) -> float:
    """number · factor, correctly rounded where the factor is one over a whole number (milli, centi, …)."""
    inverse = round(1 / factor) if 0 < factor < 1 else 0
    return number / inverse if inverse and math.isclose(inverse * factor, 1.0, rel_tol=1e-12) else number * factor


def times(a: Dimension, b: Dimension, power: Fraction | int = 1) -> Dimension:
    """a · b^power."""
    total = {k: a.get(k, Fraction(0)) + power * b.get(k, Fraction(0)) for k in {**a, **b}}
    return {k: v for k, v in total.items() if v}


@final
@dataclass(frozen=True)
class Checker:
    """Dimensions of expressions. `names` gives that of each variable; `shown` the units in which messages speak."""

    names: Mapping[str, Dimension]
    shown: Mapping[str, Dimension]

    def text(self, dimension: Dimension) -> str:
        """The unit in which a message speaks of a dimension."""
        return next((t for t, d in self.shown.items() if d == dimension), base_text(dimension))

    def require(self, node: ast.expr, wanted: Dimension, what: str) -> None:
        """ExpressionError at the first term whose dimension is not `wanted`; the number 0 fits everywhere."""
        if isinstance(node, ast.UnaryOp):
            self.require(node.operand, wanted, what)
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub):
            self.require(node.left, wanted, what)
            self.require(node.right, wanted, what)
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("min", "max", "abs"):
            for argument in node.args:
                self.require(argument, wanted, what)
        elif (found := self.infer(node)) is not None and found != wanted:
            message = f"found {self.text(found)}; expected {self.text(wanted)}" + (f", {what}" if what else "")
            raise ExpressionError(message, _start(node), times(wanted, found, -1))

    def infer(self, node: ast.expr) -> Dimension | None:
        """The dimension of an expression; None for the number 0."""
        if (value := constant(node)) is not None:
            return None if value == 0 else NONE
        if isinstance(node, ast.Name):
            return self.names[node.id]
        if isinstance(node, ast.UnaryOp):
            return self.infer(node.operand)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            return self._call(node, node.func.id)
        assert isinstance(node, ast.BinOp)
        if isinstance(node.op, ast.Add | ast.Sub):
            return self._same([node.left, node.right])
        if isinstance(node.op, ast.Pow):
            return self._power(node)
        left, right = self.infer(node.left), self.infer(node.right)
        if left is None or right is None:
            return None
        return times(left, right, -1 if isinstance(node.op, ast.Div) else 1)

    def _same(self, terms: list[ast.expr]) -> Dimension | None:
        first: Dimension | None = None
        for term in terms:
            if first is None:
                first = self.infer(term)
            else:
                self.require(term, first, "like the term before it")
        return first

    def _power(self, node: ast.BinOp) -> Dimension | None:
        self.require(node.right, NONE, "since exponents are numbers")
        base = self.infer(node.left)
        if not base:
            return base
        if (exponent := constant(node.right)) is None:
            raise ExpressionError(f"a base in {self.text(base)} needs a constant exponent", _start(node.right))
        return times(NONE, base, Fraction(exponent).limit_denominator(100))

    def _call(self, node: ast.Call, name: str) -> Dimension | None:
        if name in ("min", "max"):
            return self._same(node.args)
        if name == "abs":
            return self.infer(node.args[0])
        if name == "sqrt":
            inner = self.infer(node.args[0])
            return None if inner is None else times(NONE, inner, Fraction(1, 2))
        if name == "sign":
            self.infer(node.args[0])
            return NONE
        self.require(node.args[0], NONE, f"since {name} takes a pure number or an angle")
        return NONE


def _start(node: ast.expr) -> int:
    """Where the text of a subtree begins."""
    return min(n.col_offset for n in ast.walk(node) if isinstance(n, ast.expr))
