"""The grammar of basis functions: sums, products and whole powers of axes, numbers and functions; read without NumPy."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import final

FUNCTIONS = ("abs", "atan", "cos", "exp", "log", "sin", "sqrt", "tanh")
ALLOWED = f"write sums, products and whole powers of axes, numbers and {', '.join(FUNCTIONS)}"

_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)|(?P<name>[^\W\d]\w*)|(?P<sign>\*\*|[-+*/^()]))\s*"
)
_POWER = re.compile(r"\([+-]?[\w.]*\)|[+-]?[\w.]+")
_REFUSED = {"tan": "has poles", "ln": "is written log", "arctan": "is written atan"}


@final
class MalformedError(ValueError):
    """A text outside the grammar; `offset` is where in it."""

    def __init__(self, message: str, offset: int) -> None:
        super().__init__(message)
        self.offset = offset


@final
@dataclass(frozen=True)
class Node:
    """`op` "number" or "axis" (with `name`); "+", "*" of parts; "^" (part^number); or a function of a part. At `offset`."""

    op: str
    offset: int
    parts: tuple[Node, ...] = ()
    number: float = 1.0
    name: str = ""


def read(text: str) -> Node:
    """The tree that a text writes. MalformedError where it is outside the grammar."""
    reader = _Reader(text)
    node = reader.sum()
    if reader.at < len(text):
        raise reader.unreadable()
    for part in node.parts if node.op == "*" else (node,):
        if part.op == "number" and (node.op == "*" or part.number != 1):
            said = f"the factor {part.number:g} is not needed, every function gets its own weight; {ALLOWED}"
            raise MalformedError(said, part.offset)
    return node


@final
class _Reader:
    """Recursive descent; `at` is where the next token begins."""

    def __init__(self, text: str) -> None:
        self.text, self.at = text, 0
        self.skip()

    def skip(self) -> None:
        while self.at < len(self.text) and self.text[self.at].isspace():
            self.at += 1

    def unreadable(self) -> MalformedError:
        if self.text[self.at : self.at + 1] == "/":
            return MalformedError(f"a quotient is unbounded where its divisor vanishes; {ALLOWED}", self.at)
        rest = self.text[self.at :].strip()
        return MalformedError(f"the text cannot be read at '{rest or 'its end'}'; {ALLOWED}", self.at)

    def take(self, *signs: str) -> str | None:
        """The next token where it is one of these signs."""
        match = _TOKEN.match(self.text, self.at)
        if match is None or match["sign"] not in signs:
            return None
        self.at = match.end()
        return match["sign"]

    def sum(self) -> Node:
        start, parts = self.at, []
        sign = self.take("-", "+")
        while True:
            offset, part = self.at, self.product()
            parts.append(Node("*", offset, (Node("number", offset, number=-1.0), part)) if sign == "-" else part)
            if (sign := self.take("-", "+")) is None:
                return parts[0] if len(parts) == 1 else Node("+", start, tuple(parts))

    def product(self) -> Node:
        start, parts = self.at, [self.power()]
        while self.take("*"):
            parts.append(self.power())
        return parts[0] if len(parts) == 1 else Node("*", start, tuple(parts))

    def power(self) -> Node:
        start, base = self.at, self.atom()
        if self.take("^", "**") is None:
            return base
        match = _POWER.match(self.text, self.at)
        written = match[0] if match else ""
        if not re.fullmatch(r"[1-9][0-9]?", written):
            said = f"the exponent '{written}' is no whole number from 1 to 99; {ALLOWED}"
            raise MalformedError(said, self.at)
        self.at += len(written)
        self.skip()
        return Node("^", start, (base,), number=float(written))

    def atom(self) -> Node:
        start = self.at
        if self.take("("):
            return self.closed()
        match = _TOKEN.match(self.text, start)
        if match is None or match["sign"]:
            raise self.unreadable()
        self.at = match.end()
        if match["number"]:
            return Node("number", start, number=float(match["number"]))
        if not self.take("("):
            return Node("axis", start, name=match["name"])
        if match["name"] not in FUNCTIONS:
            why = _REFUSED.get(match["name"], "is not in the set of functions that can be bounded")
            raise MalformedError(f"{match['name']} {why}; {ALLOWED}", start)
        return Node(match["name"], start, (self.closed(),))

    def closed(self) -> Node:
        inner = self.sum()
        if not self.take(")"):
            raise self.unreadable()
        return inner
