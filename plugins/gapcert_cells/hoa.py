"""Deterministic Büchi automata from text in the Hanoi Omega-Automata format (HOA v1)."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any, NoReturn, final

import numpy as np

from gapcert.plugin import MOST, Automaton, Bools, Ints, UsageError

_TOKEN = re.compile(
    r'\s*(?:(?P<text>"(?:\\.|[^"\\])*")|(?P<mark>--[A-Z]+--)|(?P<header>[A-Za-z_][\w-]*:)|(?P<number>\d+)'
    r"|(?P<name>@?[A-Za-z_][\w-]*)|(?P<sign>[\[\](){}!&|]))"
)
IGNORED = ("tool:", "name:", "properties:", "acc-name:")  # none of them changes what is accepted
NUMBER, LONGEST = re.compile("[0-9]{1,9}"), 300_000


@final
@dataclass
class _Reader:
    name: str
    tokens: list[str] = field(default_factory=list)

    def fail(self, why: str) -> NoReturn:
        raise UsageError(f"{self.name}: {why}")

    def read(self, text: str) -> None:
        if len(text) > LONGEST:
            self.fail(f"it has {len(text):,} characters; at most {LONGEST:,} are read")
        text, at = re.sub(r"/\*.*?\*/", " ", text, flags=re.DOTALL).rstrip(), 0
        while at < len(text):
            found = _TOKEN.match(text, at)
            if found is None:
                self.fail(f"'{text[at:].split()[0][:20]}' is not HOA; expected HOA: v1")
            self.tokens.append(found.group().strip())
            at = found.end()

    @property
    def next(self) -> str:
        return self.tokens[0] if self.tokens else "--END--"

    def take(self, *wanted: str) -> str:
        token = self.next
        if not self.tokens or (wanted and token not in wanted):
            self.fail(f"found '{token}'; expected {' or '.join(wanted) or 'more'}")
        return self.tokens.pop(0)

    def number(self) -> int:
        if NUMBER.fullmatch(self.next) is None:
            self.fail(f"found '{self.next[:20]}'; expected a number of at most 9 digits")
        return int(self.take())

    def line(self) -> list[str]:
        """The values of a header."""
        values = []
        while not self.next.endswith(":") and not self.next.startswith("--"):
            values.append(self.take())
        return values

    def label(self, propositions: int) -> Bools:
        """(letters,): those that it holds of."""
        letters = np.arange(1 << propositions)
        self.take("[")
        made = self._or(letters)
        self.take("]")
        return made

    def _or(self, letters: Ints) -> Bools:
        found = self._and(letters)
        while self.next == "|":
            self.take()
            found = found | self._and(letters)
        return found

    def _and(self, letters: Ints) -> Bools:
        found = self._atom(letters)
        while self.next == "&":
            self.take()
            found = found & self._atom(letters)
        return found

    def _atom(self, letters: Ints) -> Bools:
        if self.next == "!":
            self.take()
            return ~self._atom(letters)
        if self.next == "(":
            self.take()
            inner = self._or(letters)
            self.take(")")
            return inner
        if self.next in ("t", "f"):
            return np.full(len(letters), self.take() == "t")
        if self.next.startswith("@"):
            self.fail("aliases are not supported; write the labels out")
        if (p := self.number()) >= (n := len(letters).bit_length() - 1):
            self.fail(f"a label names proposition {p}; AP: has {n}")
        return np.asarray(letters >> p & 1 > 0)

    def marked(self) -> bool:
        """Is there an acceptance set?"""
        if self.next != "{":
            return False
        self.take()
        sets = []
        while self.next != "}":
            sets.append(self.number())
        self.take("}")
        return bool(sets)


def read_hoa(text: str, name: str = "automaton") -> Automaton:
    """A deterministic automaton with acceptance Büchi (`1 Inf(0)`) or all (`0 t`); UsageError for any other."""
    reader = _Reader(name)
    try:
        return _read(reader, text)
    except RecursionError:
        reader.fail("a label is nested too deeply; write it flatter")


def _read(reader: _Reader, text: str) -> Automaton:
    reader.read(text)
    states, start, propositions, buchi = _header(reader)
    edges: list[list[tuple[Bools, int, bool]]] = [[] for _ in range(states)]
    accepting = [False] * states
    while reader.next == "State:":
        reader.take()
        if reader.next == "[":
            reader.fail("labels of states are not supported; label the edges")
        if (q := reader.number()) >= states:
            reader.fail(f"state {q} is not one of the {states} states")
        if reader.next.startswith('"'):
            reader.take()
        accepting[q] = reader.marked()
        while reader.next not in ("State:", "--END--"):
            if reader.next != "[":
                reader.fail(f"state {q} has an edge without a label; label every edge")
            label, target = reader.label(len(propositions)), reader.number()
            if target >= states:
                reader.fail(f"state {target} is not one of the {states} states")
            edges[q].append((label, target, reader.marked()))
    reader.take("--END--")
    if reader.tokens:
        reader.fail(f"found '{reader.next}' after --END--; give one automaton")
    return _made(reader, edges, [a or not buchi for a in accepting], start, propositions)


def _header(reader: _Reader) -> tuple[int, int, tuple[str, ...], bool]:
    reader.take("HOA:")
    if (version := reader.line()) != ["v1"]:
        reader.fail(f"version {' '.join(version)} is not supported; expected HOA: v1")
    found: dict[str, list[str]] = {}
    while reader.next != "--BODY--":
        key = reader.take()
        if key not in ("States:", "Start:", "AP:", "Acceptance:", *IGNORED):
            reader.fail(f"'{key}' is not supported; expected States:, Start:, AP:, Acceptance: and --BODY--")
        if key in found and key not in IGNORED:
            reader.fail(f"'{key}' is there more than once; a deterministic automaton has one")
        found[key] = reader.line()
    reader.take()
    for key in ("States:", "Start:", "AP:", "Acceptance:"):
        if key not in found:
            reader.fail(f"'{key}' is missing")
    one = {key: values[0] for key, values in found.items() if len(values) == 1 and NUMBER.fullmatch(values[0])}
    if "States:" not in one or "Start:" not in one or int(one["Start:"]) >= int(one["States:"]):
        reader.fail(f"Start: {' '.join(found['Start:'])[:20]} is not one of {' '.join(found['States:'])[:20]} states")
    if int(one["States:"]) > len(reader.tokens):
        reader.fail(f"States: says {one['States:']}, and the body has fewer; list every state")
    acceptance = "".join(found["Acceptance:"])
    if acceptance not in ("1Inf(0)", "0t"):
        reader.fail(f"acceptance {' '.join(found['Acceptance:'])} is not supported; make it Büchi, 1 Inf(0)")
    count, *names = found["AP:"]
    if count != str(len(names)) or len(names) > MOST:
        reader.fail(f"AP: says {count} and names {len(names)} propositions; at most {MOST} are supported")
    return int(one["States:"]), int(one["Start:"]), tuple(n.strip('"') for n in names), acceptance == "1Inf(0)"


def _made(reader: _Reader, edges: Any, accepting: list[bool], start: int, propositions: tuple[str, ...]) -> Automaton:
    """Marks on edges become marks on the states they lead to, which are then there twice."""
    moves: list[list[tuple[int, bool]]] = []
    for q, outgoing in enumerate(edges):
        row = []
        for letter in range(1 << len(propositions)):
            found = {(target, marked) for label, target, marked in outgoing if label[letter]}
            if len(found) > 1:
                holds = [n for p, n in enumerate(propositions) if letter >> p & 1]
                reader.fail(f"state {q} is not deterministic ({', '.join(holds) or 'nothing'} holds); determinise it first")
            row.append(found.pop() if found else (-1, False))
        moves.append(row)
    if not any(marked for row in moves for _, marked in row):
        after = tuple(tuple(t for t, _ in row) for row in moves)
        return Automaton(propositions, after, tuple(accepting), start, reader.name)
    # A state's mark is one of all edges that leave it.
    order: list[tuple[int, bool]] = [(start, False)]
    number = {order[0]: 0}
    after_rows = []
    for q, _ in order:
        row_out = []
        for target, marked in moves[q]:
            key = (target, marked or accepting[q])
            if target >= 0 and key not in number:
                number[key] = len(order)
                order.append(key)
            row_out.append(number[key] if target >= 0 else -1)
        after_rows.append(tuple(row_out))
    return Automaton(propositions, tuple(after_rows), tuple(marked for _, marked in order), 0, reader.name)
