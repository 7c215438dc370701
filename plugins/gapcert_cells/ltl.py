"""Linear temporal logic as a deterministic Büchi automaton, by progression: what is left of a formula after a letter.

What is left is a positive Boolean combination of subformulas, as its smallest set of smallest clauses. That form is unique, so
there are finitely many. A state is all that is left, and what of it is due: of what was left when nothing was due last, that
without what lasts for ever (R taken as kept). A word is accepted if again and again nothing is due; where nothing lasts for
ever, that is once nothing is left. It is the construction for the class Π₂ of J. Esparza, J. Křetínský and S. Sickert,
"A Unified Translation of Linear Temporal Logic to ω-Automata", J. ACM 67(6), 2020.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import Any, final

import numpy as np

from gapcert.plugin import MOST, Automaton, UsageError, clipped

_TOKEN = re.compile(r"\s*(?:(?P<name>[A-Za-z_]\w*)|(?P<one>[01])(?!\w)|(?P<sign>&&?|\|\|?|->|!|\(|\)))")
OPERATORS = ("X", "F", "U", "G", "R", "W", "M")
STATES, LONGEST = 2000, 4000
_DUAL = {"F": "G", "G": "F", "U": "R", "R": "U", "W": "M", "M": "W"}
Formula = tuple[Any, ...]  # ("p", name, bool), ("and" | "or", f, g), ("X" | "F", f), ("U" | "R", f, g), ("const", bool)
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


def _normal(f: Formula, positive: bool, text: str, within: bool = False) -> Formula:
    """Negations pushed to the names. UsageError for what lasts for ever `within` what need only come at some time: no
    deterministic Büchi automaton decides, say, F G a.
    """
    kind = f[0]
    if kind == "not":
        return _normal(f[1], not positive, text, within)
    if kind == "const":
        return ("const", f[1] == positive)
    if kind == "p":
        return ("p", f[1], positive)
    if kind in ("and", "or"):
        kind = kind if positive else {"and": "or", "or": "and"}[kind]
    elif kind != "X":
        lasts = (kind in "GRW") == positive
        if lasts and within:
            named = kind if positive else f"a negated {kind}"
            raise UsageError(
                f"ltl: '{text}' asks for something to hold for ever ({named}) from a moment on that is not known beforehand, "
                f"which no deterministic Büchi automaton decides in general; use the goal reach_and_stay, or give an automaton "
                f"in the HOA format"
            )
        kind, within = (kind if positive else _DUAL[kind]), within or not lasts
    parts = [_normal(part, positive, text, within) for part in f[1:]]
    if kind == "G":
        return ("R", ("const", False), parts[0])
    # a M b: the second holds up to and with the first. a W b: the first does up to the second, or for ever.
    if kind == "M":
        return ("U", parts[1], ("and", *parts))
    return ("R", parts[1], ("or", *parts)) if kind == "W" else (kind, *parts)


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
    if f[0] == "R":
        return _and(_after(_clauses(f[2]), letter), _or(_after(_clauses(f[1]), letter), itself))
    return _or(_after(_clauses(f[2]), letter), _and(_after(_clauses(f[1]), letter), itself))


def _each(state: Clauses, change: Callable[[Formula], Clauses]) -> Clauses:
    """A state in which every formula has become what `change` makes of it."""
    out = FALSE
    for clause in state:
        left = TRUE
        for f in clause:
            left = _and(left, change(f))
        out = _or(out, left)
    return out


def _after(state: Clauses, letter: frozenset[str]) -> Clauses:
    return _each(state, lambda f: _progress(f, letter))


def _due(state: Clauses) -> Clauses:
    return _each(state, lambda f: _clauses(_kept(f)))


def _kept(f: Formula) -> Formula:
    """A formula in which all that lasts for ever is true."""
    if f[0] == "R":
        return ("const", True)
    return (f[0], *map(_kept, f[1:])) if f[0] in ("and", "or", "X") else f


def _names(f: Formula) -> list[str]:
    return [f[1]] if f[0] == "p" else [n for part in f[1:] if isinstance(part, tuple) for n in _names(part)]


def automaton_of(text: str) -> Automaton:
    """An automaton of a formula with X, F, G, U, R, W, M, &, |, !, -> over names; the smallest one where it is co-safe, that is
    without G, R and W. UsageError where one of these stands inside of F, U or M, once negations are at the names.
    """
    if len(text) > LONGEST:
        raise UsageError(f"ltl: the formula has {len(text):,} characters; at most {LONGEST:,} are read; write it shorter")
    try:
        return _automaton(text)
    except RecursionError:
        raise UsageError(f"ltl: '{clipped(text)[0]}' is nested too deeply; write it flatter") from None


def _automaton(text: str) -> Automaton:
    formula = _normal(_Reader(text).formula(), True, text)
    names = tuple(dict.fromkeys(_names(formula)))
    if len(names) > MOST:
        raise UsageError(f"ltl: '{text}' has {len(names)} regions; at most {MOST} are supported")
    letters = [frozenset(n for p, n in enumerate(names) if number >> p & 1) for number in range(1 << len(names))]
    start = _clauses(formula)
    states, after = {(start, _due(start)): 0}, list[tuple[int, ...]]()
    for whole, due in (queue := list(states)):
        row = []
        for letter in letters:
            left = _after(whole, letter)
            following = left, _due(left) if due == TRUE else _after(due, letter)
            if left != FALSE and following not in states:
                states[following] = len(states)
                queue.append(following)
            row.append(states[following] if left != FALSE else -1)
        after.append(tuple(row))
        if len(states) > STATES:
            raise UsageError(f"ltl: '{text}' has more than {STATES} states; give a smaller automaton in the HOA format")
    return smallest(Automaton(names, tuple(after), tuple(due == TRUE for _, due in states), 0, text))


def smallest(automaton: Automaton) -> Automaton:
    """States from which no accepting one can be reached are left out, and those that agree on every word become one.

    The language stays; where all accepting states are `done`, no automaton of it has fewer states.
    """
    table, states = automaton.table, len(automaton.after)
    live = np.array(automaton.accepting)
    while True:
        more = live | (live[table] & (table >= 0)).any(axis=1)
        if (more == live).all():
            break
        live = more
    if not live[automaton.start]:
        raise UsageError(f"automaton: '{automaton.text}' accepts nothing; no controller can keep it")
    table = np.where((table >= 0) & live[table], table, -1)
    block = np.unique(automaton.accepting, return_inverse=True)[1]
    while True:
        signature = np.column_stack([block, np.where(table < 0, -1, block[table])])
        _, finer = np.unique(signature, axis=0, return_inverse=True)
        finer = finer.reshape(states)
        if finer.max() == block.max():
            break
        block = finer
    order = [automaton.start]
    for q in order:
        found = [int(t) for t in table[q] if t >= 0 and block[t] not in {int(block[o]) for o in order}]
        order += list({int(block[t]): t for t in found}.values())
    number = {int(block[q]): i for i, q in enumerate(order)}
    after = tuple(tuple(-1 if t < 0 else number[int(block[t])] for t in table[q]) for q in order)
    return Automaton(automaton.propositions, after, tuple(bool(automaton.accepting[q]) for q in order), 0, automaton.text)
