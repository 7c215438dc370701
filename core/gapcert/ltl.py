"""Co-safe linear temporal logic as a deterministic automaton, by progression: what is left of a formula after a letter.

A state is a positive Boolean combination of subformulas, as its smallest set of smallest clauses. That form is unique, so there
are finitely many states; a word is accepted once nothing is left to do.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, final

from gapcert.automaton import MOST, Automaton, smallest
from gapcert.errors import UsageError

_TOKEN = re.compile(r"\s*(?:(?P<name>[A-Za-z_]\w*)|(?P<one>[01])(?!\w)|(?P<sign>&&?|\|\|?|->|!|\(|\)))")
OPERATORS = ("X", "F", "U", "G", "R", "W", "M")
STATES = 2000
Formula = tuple[Any, ...]  # ("p", name, bool), ("and" | "or", f, g), ("X" | "F", f), ("U", f, g), ("const", bool)
Clauses = frozenset[frozenset[Formula]]
TRUE: Clauses = frozenset([frozenset()])
FALSE: Clauses = frozenset()


@final
class _Reader:
    """Loosest first: ->, |, &, U; to the right."""

    def __init__(self, text: str) -> None:
        self.text, self.tokens, at = text, list[str](), 0
        while text[at:].strip():
            found = _TOKEN.match(text, at)
            if found is None:
                rest = text[at:].lstrip()
                raise UsageError(f"ltl: '{text}': '{rest[:1]}' is not understood; use X, F, U, &, |, !, -> and regions")
            self.tokens.append(found.group().strip())
            at = found.end()

    def formula(self) -> Formula:
        made = self._implies()
        if self.tokens:
            raise UsageError(f"ltl: '{self.text}': '{self.tokens[0]}' is not expected there; join formulas with &, | or U")
        return made

    def _take(self, *tokens: str) -> bool:
        if self.tokens and self.tokens[0] in tokens:
            self.tokens.pop(0)
            return True
        return False

    def _implies(self) -> Formula:
        left = self._or()
        return ("or", ("not", left), self._implies()) if self._take("->") else left

    def _or(self) -> Formula:
        left = self._and()
        while self._take("|", "||"):
            left = ("or", left, self._and())
        return left

    def _and(self) -> Formula:
        left = self._until()
        while self._take("&", "&&"):
            left = ("and", left, self._until())
        return left

    def _until(self) -> Formula:
        left = self._unary()
        for operator in ("U", "R", "W", "M"):
            if self._take(operator):
                return (operator, left, self._until())
        return left

    def _unary(self) -> Formula:
        if not self.tokens:
            raise UsageError(f"ltl: '{self.text}' ends too early; a formula is missing")
        token = self.tokens.pop(0)
        if token == "!":
            return ("not", self._unary())
        if token in ("X", "F", "G"):
            return (token, self._unary())
        if token == "(":
            inner = self._implies()
            if not self._take(")"):
                raise UsageError(f"ltl: '{self.text}': a ) is missing")
            return inner
        if token in ("true", "false", "0", "1"):
            return ("const", token in ("true", "1"))
        if token in OPERATORS or not token[0].isidentifier():
            raise UsageError(f"ltl: '{self.text}': '{token}' is not expected there; a formula is missing before it")
        return ("p", token, True)


def _normal(f: Formula, positive: bool, text: str) -> Formula:
    """Negations pushed to the names; UsageError where that leaves an operator that no finite beginning decides."""
    kind = f[0]
    if kind == "not":
        return _normal(f[1], not positive, text)
    if kind == "const":
        return ("const", f[1] == positive)
    if kind == "p":
        return ("p", f[1], positive)
    if kind in ("and", "or"):
        flipped = kind if positive else {"and": "or", "or": "and"}[kind]
        return (flipped, _normal(f[1], positive, text), _normal(f[2], positive, text))
    if kind == "X":
        return ("X", _normal(f[1], positive, text))
    eventual = {"F": True, "U": True, "M": True, "G": False, "R": False, "W": False}[kind]
    if eventual != positive:
        raise UsageError(
            f"ltl: '{text}' is not co-safe ({kind if positive else f'a negated {kind}'} is decided by no finite beginning); "
            f"give a deterministic automaton in the HOA format instead, or the goal invariance or recurrence"
        )
    parts = [_normal(part, positive, text) for part in f[1:]]
    if kind in ("F", "G"):
        return ("F", parts[0])
    if kind in ("U", "R"):
        return ("U", *parts)
    # a M b, and !(a W b) = !a M !b: the second holds up to and with the first.
    return ("U", parts[1], ("and", *parts))


def _least(clauses: Iterable[frozenset[Formula]]) -> Clauses:
    kept: list[frozenset[Formula]] = []
    for clause in sorted(set(clauses), key=len):
        if not any(k <= clause for k in kept):
            kept.append(clause)
    return frozenset(kept)


def _or(a: Clauses, b: Clauses) -> Clauses:
    return _least(a | b)


def _and(a: Clauses, b: Clauses) -> Clauses:
    return _least(x | y for x in a for y in b)


def _clauses(f: Formula) -> Clauses:
    if f[0] == "const":
        return TRUE if f[1] else FALSE
    if f[0] in ("and", "or"):
        return (_and if f[0] == "and" else _or)(_clauses(f[1]), _clauses(f[2]))
    return frozenset([frozenset([f])])


def _progress(f: Formula, letter: frozenset[str]) -> Clauses:
    """What is left of a formula that is no combination of others."""
    if f[0] == "p":
        return TRUE if (f[1] in letter) == f[2] else FALSE
    if f[0] == "X":
        return _clauses(f[1])
    itself = frozenset([frozenset([f])])
    if f[0] == "F":
        return _or(_after(_clauses(f[1]), letter), itself)
    return _or(_after(_clauses(f[2]), letter), _and(_after(_clauses(f[1]), letter), itself))


def _after(state: Clauses, letter: frozenset[str]) -> Clauses:
    out = FALSE
    for clause in state:
        left = TRUE
        for f in clause:
            left = _and(left, _progress(f, letter))
        out = _or(out, left)
    return out


def _names(f: Formula) -> list[str]:
    return [f[1]] if f[0] == "p" else [n for part in f[1:] if isinstance(part, tuple) for n in _names(part)]


def automaton_of(text: str) -> Automaton:
    """The smallest automaton of a co-safe formula: X, F, U, &, |, !, -> over names. UsageError for any other formula."""
    formula = _normal(_Reader(text).formula(), True, text)
    names = tuple(dict.fromkeys(_names(formula)))
    if len(names) > MOST:
        raise UsageError(f"ltl: '{text}' has {len(names)} regions; at most {MOST} are supported")
    letters = [frozenset(n for p, n in enumerate(names) if number >> p & 1) for number in range(1 << len(names))]
    states, after = {_clauses(formula): 0}, list[tuple[int, ...]]()
    for state in (queue := list(states)):
        row = []
        for letter in letters:
            following = _after(state, letter)
            if following not in states:
                states[following] = len(states)
                queue.append(following)
            row.append(states[following])
        after.append(tuple(row))
        if len(states) > STATES:
            raise UsageError(f"ltl: '{text}' has more than {STATES} states; give a smaller automaton in the HOA format")
    return smallest(Automaton(names, tuple(after), tuple(s == TRUE for s in states), 0, text))
