"""The restricted grammar of basis functions: products of powers, sin, cos and abs of single axes; read without NumPy."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, final

ALLOWED = "write products of axis^n, abs(axis)^n, sin(a*axis) and cos(a*axis), or 1"

_FACTOR = re.compile(
    r"\s*(?:(?P<function>[^\W\d]\w*)\s*\(\s*(?:(?P<scale>[0-9.]+(?:[eE][+-]?[0-9]+)?)\s*\*\s*)?(?P<argument>[^\W\d]\w*)\s*\)"
    r"|(?P<name>[^\W\d]\w*+)(?!\s*\())"
    r"\s*(?:(?:\^|\*\*)\s*(?P<power>\(?[+-]?[\w.]*\)?))?\s*"
)
_CALL = re.compile(r"\s*([^\W\d]\w*)\s*\(")
_REFUSED = {
    "log": "is unbounded near 0",
    "ln": "is unbounded near 0",
    "tan": "has poles",
    "sqrt": "has an unbounded slope at 0",
}


@final
class MalformedError(ValueError):
    """A text outside the grammar; `offset` is where in it."""

    def __init__(self, message: str, offset: int) -> None:
        super().__init__(message)
        self.offset = offset


@final
@dataclass(frozen=True)
class Written:
    """One factor as written: name^number, |name|^number, sin(number name) or cos(number name), at `offset`."""

    name: str
    kind: Literal["power", "abs", "sin", "cos"]
    number: float
    offset: int


def read(text: str) -> list[Written]:
    """The factors of a product; none for the constant 1. MalformedError where no bound of it or of its slope is known."""
    if text.strip() in ("1", "1.0"):
        return []
    factors: list[Written] = []
    position = 0
    while True:
        match = _FACTOR.match(text, position)
        if match is None:
            raise _unreadable(text, position)
        factors += _factors(match)
        position = match.end()
        if position == len(text):
            return factors
        if text[position] == "/":
            raise MalformedError(f"a quotient is unbounded where its divisor vanishes; {ALLOWED}", position)
        if text[position] != "*":
            raise _unreadable(text, position)
        position += 1


def _unreadable(text: str, position: int) -> MalformedError:
    rest = text[position:].strip()
    if (call := _CALL.match(text, position)) is not None:
        if call[1] in _REFUSED:
            return MalformedError(f"{call[1]} {_REFUSED[call[1]]}; {ALLOWED}", call.start(1))
        return MalformedError(f"'{rest}' is no function of a single axis; {ALLOWED}", call.start(1))
    if re.match(r"[0-9.]+\s*/", rest):
        return MalformedError(f"a quotient is unbounded where its divisor vanishes; {ALLOWED}", position)
    if re.match(r"[0-9.]+\s*\*", rest):
        return MalformedError(f"the factor in '{rest}' is not needed, every function gets its own weight; {ALLOWED}", position)
    return MalformedError(f"cannot be read at '{rest or 'its end'}'; {ALLOWED}", position)


def _factors(match: re.Match[str]) -> list[Written]:
    """What one match writes: several factors for a power of sin or cos."""
    function, name, power = match["function"], match["argument"] or match["name"], match["power"]
    offset = match.start("argument") if function else match.start("name")
    if function is not None and function not in ("sin", "cos", "abs"):
        why = _REFUSED.get(function, "is not in the set of functions that can be bounded")
        raise MalformedError(f"{function} {why}; {ALLOWED}", match.start("function"))
    if power is not None and not re.fullmatch(r"[1-9][0-9]?", power):
        raise MalformedError(f"the exponent '{power}' is no whole number from 1 to 99; {ALLOWED}", match.start("power"))
    n = int(power or 1)
    if function in ("sin", "cos"):
        try:
            scale = float(match["scale"] or 1.0)
        except ValueError:
            raise MalformedError(f"'{match['scale']}' is no number; {ALLOWED}", match.start("scale")) from None
        return [Written(name, "sin" if function == "sin" else "cos", scale, offset)] * n
    if match["scale"] is not None:
        raise MalformedError(f"a factor inside abs changes nothing; write abs({name})", match.start("scale"))
    return [Written(name, "abs" if function == "abs" else "power", n, offset)]
