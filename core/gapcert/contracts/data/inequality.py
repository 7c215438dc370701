"""A relation as text, `abs(ux - vx) <= 0.5 m/s`: a restricted grammar, read without evaluating anything.

relation: sum (<= | >=) sum; sum: terms joined by + and −; term: factors joined by * and /, at most one of which names states or
inputs; factor: number [unit] | name | abs(sum) | (sum).
"""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import final

from gapcert.contracts.data.units import magnitude
from gapcert.contracts.thresholds import THRESHOLDS
from gapcert.numerics.constraint_zone import Relation

_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)|(?P<name>[^\W\d]\w*)|(?P<sign><=|>=|\*\*|[-+*/^()<>=]))"
)


@final
class MalformedError(ValueError):
    """What is wrong with a relation, `offset` characters into its text."""

    def __init__(self, message: str, offset: int, hint: str = "") -> None:
        super().__init__(message)
        self.offset, self.hint = offset, hint


@final
@dataclass(frozen=True)
class _Term:
    """factor · axis, factor alone (axis ""), or factor · |inside|; `unit` is what was written with the factor, if anything."""

    factor: float
    unit: str = ""
    axis: str = ""
    inside: tuple[_Term, ...] = ()
    at: int = 0

    @property
    def plain(self) -> bool:
        return not self.axis and not self.inside

    def times(self, other: _Term, over: bool = False) -> _Term:
        """This term times (or over) a number."""
        unit = self.unit
        if other.unit:
            sign = "/" if over else "*"
            unit = f"({unit}){sign}({other.unit})" if unit else f"1/({other.unit})" if over else other.unit
        return replace(self, factor=self.factor / other.factor if over else self.factor * other.factor, unit=unit)


def parse(text: str, units: Mapping[str, str]) -> tuple[Relation, ...]:
    """The inequalities a·z ≤ b that a text stands for, with a in the order of `units` (unit of each state and input).

    A number without a unit counts in the units of the model; one with a unit is converted, and has to fit.
    """
    left, sign, right = _Reader(text, units).relation()
    terms = left + _scaled(right, -1.0)
    # >= is <= with both sides negated.
    terms = _converted(terms if sign == "<=" else _scaled(terms, -1.0), units)
    if bent := next((t for t in terms if t.inside and t.factor < 0), None):
        raise MalformedError("a lower bound on abs(...) leaves two pieces", bent.at, "bound it from above")
    folds = [t for t in terms if t.inside]
    if 2 ** len(folds) > THRESHOLDS.relation_texts:
        raise MalformedError(f"{len(folds)} times abs(...) in one relation", folds[3].at, "split it into several")
    found = []
    for signs in itertools.product((1.0, -1.0), repeat=len(folds)):
        flat = [t for t in terms if not t.inside]
        for s, fold in zip(signs, folds, strict=True):
            flat += _scaled(fold.inside, s * fold.factor)
        a = tuple(sum(t.factor for t in flat if t.axis == name) + 0.0 for name in units)
        if not any(a):
            raise MalformedError("no state or input is left in it", 0, f"known: {', '.join(units)}")
        found.append(Relation(text, a, sum(-t.factor for t in flat if t.plain) + 0.0))
    return tuple(dict.fromkeys(found))


def substitution(
    given: Mapping[str, str], states: Mapping[str, str], inputs: Mapping[str, str]
) -> tuple[dict[str, tuple[str, str, tuple[float, ...]]], list[tuple[str, MalformedError]]]:
    """Texts such as `{dx: ux - vx}`: of each input its coordinate's name, unit and coefficients over states and inputs; and
    what is wrong, by name ("" for all of them; a negative offset means the name itself).
    """
    units, faults = {**states, **inputs}, list[tuple[str, MalformedError]]()
    found = dict[str, tuple[str, str, tuple[float, ...]]]()
    for name, text in given.items():
        try:
            if name in units or re.fullmatch(r"[^\W\d]\w*", name) is None:
                raise MalformedError(f"'{name}' cannot be its name; expected a new one of letters, digits and _", -1)
            unit, row = _sum(text, units)
            own = [u for u, k in zip(units, row, strict=True) if u in inputs and k]
            if len(own) != 1:
                what = " and ".join(own) or "no input"
                raise MalformedError(f"found {what} in it; expected a sum of one input and states", 0)
            if own[0] in found:
                raise MalformedError(f"{own[0]} stands in {found[own[0]][0]} already; expected one name for each input", 0)
            found[own[0]] = name, unit, row
        except MalformedError as error:
            faults.append((name, error))
    if not faults and (missing := [u for u in inputs if u not in found]):
        what = f"nothing for {missing[0]}; expected one new name for each input ({', '.join(inputs)})"
        faults.append(("", MalformedError(what, -1, f"add d{missing[0]}: {missing[0]}, say")))
    return found, faults


def _sum(text: str, units: Mapping[str, str]) -> tuple[str, tuple[float, ...]]:
    """Unit and coefficients of a sum of states and inputs."""
    reader = _Reader(text, units)
    terms = reader.sum()
    if reader.now[0] != "end":
        raise reader.fail("a sum, and nothing behind it")
    if odd := next((t for t in terms if t.inside or t.plain), None):
        raise MalformedError("a constant or abs(...) in a sum of states and inputs", odd.at)
    unit = _common(terms, units)
    terms = _converted(terms, units)
    return unit, tuple(sum(t.factor for t in terms if t.axis == name) + 0.0 for name in units)


def _scaled(terms: Sequence[_Term], by: float) -> tuple[_Term, ...]:
    return tuple(replace(t, factor=t.factor * by) for t in terms)


def _converted(terms: Sequence[_Term], units: Mapping[str, str]) -> tuple[_Term, ...]:
    """All factors in one unit: that of the first state or input."""
    if not (wanted := _common(terms, units)):
        return tuple(terms)
    written = any(t.unit for t in _flat(terms))

    def convert(t: _Term) -> _Term:
        if t.inside:
            if t.unit:
                raise MalformedError("a number with a unit before abs(...)", t.at, "write it inside")
            return replace(t, inside=tuple(convert(inner) for inner in t.inside))
        have = _unit(t, units)
        if not have or have == wanted:
            return replace(t, unit="")
        try:
            # A factor of its own: the number itself may be too long or too short for a text.
            return replace(t, factor=t.factor * magnitude(f"1 {have}", wanted), unit="")
        except ValueError as error:
            if t.axis and not t.unit:
                if not written:
                    return t
                hint = "write its factor with a unit"
                raise MalformedError(f"{t.axis} is in {have}, and the relation in {wanted}", t.at, hint) from None
            what = f"{t.axis} times {t.unit} does not fit; expected {wanted}" if t.axis else str(error)
            raise MalformedError(what, t.at) from None

    return tuple(convert(t) for t in terms)


def _flat(terms: Sequence[_Term]) -> list[_Term]:
    return [t for term in terms for t in ((*term.inside, term) if term.inside else (term,))]


def _common(terms: Sequence[_Term], units: Mapping[str, str]) -> str:
    """The unit of the first state or input whose factor has none, else of the first; "" without any."""
    named = [t for t in _flat(terms) if t.axis]
    return _unit(next((t for t in named if not t.unit), named[0]), units) if named else ""


def _unit(t: _Term, units: Mapping[str, str]) -> str:
    if t.axis and t.unit:
        own = units[t.axis] if units[t.axis] != "1" else "dimensionless"
        return f"({t.unit})*({own})"
    return units[t.axis] if t.axis else t.unit


@final
class _Reader:
    """Recursive descent over the tokens of one text."""

    def __init__(self, text: str, units: Mapping[str, str]) -> None:
        self.units, self.tokens, at = units, list[tuple[str, str, int]](), 0
        while at < len(text.rstrip()):
            match = _TOKEN.match(text, at)
            if match is None:
                at += len(text[at:]) - len(text[at:].lstrip())
                raise MalformedError(f"unexpected '{text[at]}'", at, "write a linear relation, such as abs(u - v) <= 0.5")
            kind = str(match.lastgroup)
            self.tokens.append((kind, match[kind], match.start(kind)))
            at = match.end()
        self.tokens.append(("end", "the end", len(text.rstrip())))
        self.k = 0

    @property
    def now(self) -> tuple[str, str, int]:
        return self.tokens[self.k]

    def take(self, *values: str) -> str:
        """The current sign if it is one of these, else ""."""
        kind, value, _ = self.now
        if kind != "sign" or value not in values:
            return ""
        self.k += 1
        return value

    def fail(self, expected: str) -> MalformedError:
        return MalformedError(f"found {self.now[1]}; expected {expected}", self.now[2])

    def relation(self) -> tuple[tuple[_Term, ...], str, tuple[_Term, ...]]:
        left = self.sum()
        if not (sign := self.take("<=", ">=")):
            raise self.fail("<= or >=")
        right = self.sum()
        if self.now[0] != "end":
            raise self.fail("one comparison, and nothing behind it")
        return left, sign, right

    def sum(self) -> tuple[_Term, ...]:
        terms = _scaled(self.product(), -1.0) if self.take("-") else (self.take("+"), self.product())[1]
        while sign := self.take("+", "-"):
            terms += _scaled(self.product(), -1.0 if sign == "-" else 1.0)
        return terms

    def product(self) -> tuple[_Term, ...]:
        terms = self.factor()
        while sign := self.take("*", "/"):
            at = self.now[2]
            other = self.factor()
            if sign == "*" and len(terms) == 1 and terms[0].plain:
                terms, other = other, terms
            if len(other) != 1 or not other[0].plain:
                raise MalformedError("not linear: a product of states or inputs, or a quotient by one", at)
            if sign == "/" and other[0].factor == 0:
                raise MalformedError("division by zero", at)
            terms = tuple(t.times(other[0], sign == "/") for t in terms)
        return terms

    def factor(self) -> tuple[_Term, ...]:
        kind, value, at = self.now
        if self.take("("):
            inner = self.sum()
            if not self.take(")"):
                raise self.fail(")")
            return inner
        if kind == "number":
            self.k += 1
            return (_Term(float(value), self.unit(), at=at),)
        if kind != "name":
            raise self.fail("a number, a state or an input")
        self.k += 1
        if value == "abs" and self.now[1] == "(":
            inner = self.factor()
            if any(t.inside for t in inner):
                raise MalformedError("abs(...) inside abs(...)", at, "write the pieces as relations of their own")
            return (_Term(1.0, inside=inner, at=at),)
        if value not in self.units:
            near = difflib.get_close_matches(value, self.units, 1, cutoff=0.6)
            hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(self.units)}, abs"
            raise MalformedError(f"unknown name '{value}'", at, hint)
        return (_Term(1.0, axis=value, at=at),)

    def unit(self) -> str:
        """What follows a number up to the next state, input or operator that does not belong to a unit."""
        parts: list[str] = []
        while self.now[0] == "name" and self.now[1] != "abs":
            if self.now[1] in self.units:
                if parts:
                    break
                raise MalformedError(f"found {self.now[1]} behind a number", self.now[2], f"write *{self.now[1]}")
            parts.append(self.now[1])
            self.k += 1
            if self.take("**", "^"):
                minus = self.take("-")
                if self.now[0] != "number":
                    raise self.fail("an exponent")
                parts.append(f"**{minus}{self.now[1]}")
                self.k += 1
            kind, name, _ = self.tokens[min(self.k + 1, len(self.tokens) - 1)]
            if self.now[1] not in ("*", "/") or kind != "name" or name in self.units or name == "abs":
                break
            parts.append(self.take("*", "/"))
        return "".join(parts)
