"""Quantities such as `-0.2 rad`: a number and a unit, converted with pint, which is imported on first use."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Iterable
from typing import Any

from gapcert.numerics.errors import clipped

_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*((?<=\s)1(?:/.*?)?|[^\d\s.].*?)?\s*")
_TRIED = (0.0, 1.0)  # a unit with an offset moves the one, one of another size the other
_ALIAS = {"s": 1.0, "ms": 1e-3}
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def magnitude(value: Any, unit: str) -> float:
    """The number of a value in `unit`; a bare number is in `unit` already. ValueError says what was found and expected."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError(f"found {shown(value)}; expected a number or a quantity in {unit}")
    if not isinstance(value, str):
        return float(value)
    if (match := _QUANTITY.fullmatch(value)) is None:
        raise ValueError(f"found '{value}'; expected a number or a quantity in {unit}")
    number, given = float(match[1]), match[2] or unit
    if given == unit:
        result = number
    elif unit == "s" and given in _ALIAS:
        result = number * _ALIAS[given]
    else:
        result = _convert(number, given, unit)
    if not math.isfinite(result):
        raise ValueError(f"found '{value}'; expected a finite number")
    return result


def grouped(unit: str) -> str:
    """A unit that more can be written after: in parentheses where it is more than one symbol."""
    return unit if re.fullmatch(r"[^\W\d_]+", unit) else f"({unit})"


def product(powers: Iterable[tuple[str, int]]) -> str:
    """The text of a product of powers of units; `1` for none."""
    given = [(unit, n) for unit, n in powers if unit != "1"]
    over = [unit if n == 1 else _power(unit, n) for unit, n in given if n > 0]
    under = ["/" + (grouped(unit) if n == -1 else _power(unit, -n)) for unit, n in given if n < 0]
    return ("*".join(over) or "1") + "".join(under)


def _power(unit: str, n: int) -> str:
    """Of what ends in an exponent of its own, as factors: readers of units take no power of a power."""
    return f"({'*'.join([grouped(unit)] * n)})" if unit[-1].isdigit() else f"{grouped(unit)}**{n}"


def _convert(number: float, given: str, unit: str) -> float:
    source, target = _unit(given, f"expected {unit}"), _unit(unit, "which a model declares; write one such as m/s")
    if source.dimensionality != target.dimensionality:
        raise ValueError(f"unit '{given}' does not fit; expected {unit}")
    return float(_registry().Quantity(number, source).to(target).magnitude)


def _unit(text: str, hint: str) -> Any:
    try:
        return _registry().parse_units(text)
    except Exception:  # pint raises whatever its tokenizer raises
        raise ValueError(f"unknown unit '{text}'; {hint}") from None


@functools.lru_cache(4096)
def same_unit(a: str, b: str) -> bool:
    """Does a number in one unit say the same in the other? `N*m`, `N m` and `J` are one, `degC` and `K` are not."""
    a, b = a.strip() or "1", b.strip() or "1"
    if a == b:
        return True
    registry = _registry()
    try:
        moved = [float(registry.Quantity(v, registry.parse_units(a)).to(registry.parse_units(b)).magnitude) for v in _TRIED]
    except Exception:  # unknown, of another dimension, or whatever pint's tokenizer raises
        return False
    return all(math.isclose(m, v, rel_tol=1e-12, abs_tol=1e-12) for m, v in zip(moved, _TRIED, strict=True))


def known_unit(text: str) -> bool:
    """Is it a unit in which twice the number is twice as much?"""
    try:
        unit = _unit(text, "")
        return bool(_registry().Quantity(0.0, unit).to_base_units().magnitude == 0)
    except Exception:  # pint raises whatever its definitions raise
        return False


_COHERENT = re.compile(r"(?:\b(?:1|m|s|kg|rad|A|K|N|J|W|V|C|Hz|Pa)\b|\*\*-?\d|\^-?\d|[*/ ()·])*")  # these need no pint


@functools.lru_cache(4096)
def base(unit: str) -> float:
    """How many SI base units it is; 1 where that is not known."""
    plain = _COHERENT.fullmatch(unit) or not known_unit(unit)
    return 1.0 if plain else float(_registry().Quantity(1.0, unit).to_base_units().magnitude)


@functools.cache
def _registry() -> Any:
    import pint

    registry: Any = pint.application_registry
    return registry


def shown(value: Any) -> str:
    """A value as the user knows it."""
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list):
        return "a list"
    if value is None or isinstance(value, bool):
        return {None: "nothing", True: "true", False: "false"}[value]
    return clipped(repr(value), longest=80)[0]


def pretty(unit: str) -> str:
    """A unit as it is written on an axis: `N*m` → `N·m`, `m/s**2` → `m/s²`."""
    return re.sub(r"(?:\*\*|\^)(-?\d+)", lambda n: n[1].translate(_SUPERSCRIPT), unit).replace("**", "^").replace("*", "·")


_LAST = re.compile(r"(.*[^\s\[(])\s*[\[(]\s*([^\[\]()\d\s-][^\[\]()]*?)\s*[\])]\s*")


def stated_units(columns: Iterable[str]) -> dict[str, str]:
    """Column → the unit in brackets that its name ends in; columns without one, an index or another word are left out."""
    found = {name: match[2] for name in columns if (match := _LAST.fullmatch(str(name)))}
    return {name: unit for name, unit in found.items() if known_unit(unit)}


def without_units(columns: Iterable[str]) -> dict[str, str]:
    """Name without its unit → column; a column that has the name as it is comes before one that states a unit."""
    names = list(columns)
    bare = {match[1].strip(): name for name in stated_units(names) if (match := _LAST.fullmatch(name))}
    return {**bare, **{name: name for name in names}}
