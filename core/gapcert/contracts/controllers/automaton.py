"""Deterministic Büchi automata over named regions: which sequences of labels a goal accepts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from gapcert.numerics.arrays import Bools, Ints
from gapcert.numerics.errors import UsageError

MOST = 8  # propositions: an automaton has two to their number letters


@final
@dataclass(frozen=True)
class Automaton:
    """A word of letters is accepted if its run visits accepting states again and again.

    A letter is the set of propositions that hold, as a number: bit p is proposition p. after[q][letter] is the next state, −1
    where none is left. `text`: what it was made of.
    """

    propositions: tuple[str, ...]
    after: tuple[tuple[int, ...], ...]
    accepting: tuple[bool, ...]
    start: int = 0
    text: str = ""

    def __post_init__(self) -> None:
        letters, states = 1 << len(self.propositions), len(self.after)
        if len(self.propositions) > MOST:
            raise UsageError(f"automaton: {len(self.propositions)} propositions; at most {MOST} are supported")
        fits = all(len(row) == letters and all(-1 <= q < states for q in row) for row in self.after)
        if not fits or not 0 <= self.start < states or len(self.accepting) != states:
            raise UsageError(f"automaton: its table does not fit {states} states and {letters} letters")

    @property
    def table(self) -> Ints:
        """`after` as numbers (states, letters)."""
        return np.array(self.after, dtype=np.int64)

    @property
    def done(self) -> Bools:
        """(states,): accepting, and every letter leads back: what comes later does not matter."""
        own = np.arange(len(self.after))[:, None]
        return np.asarray(np.array(self.accepting) & (self.table == own).all(axis=1))

    @property
    def ends(self) -> bool:
        """Does every accepted word have a beginning that suffices?"""
        return bool((self.done == np.array(self.accepting)).all())

    def advance(self, state: Ints, letter: Ints) -> Ints:
        """States after one more letter; −1 stays."""
        return np.where(state < 0, -1, self.table[state, letter])

    def to_data(self) -> dict[str, Any]:
        """JSON-able; `from_data` is its inverse."""
        return {
            "propositions": list(self.propositions),
            "after": [list(row) for row in self.after],
            "accepting": list(self.accepting),
            "start": self.start,
            "text": self.text,
        }

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> Automaton:
        after = tuple(tuple(row) for row in data["after"])
        return cls(tuple(data["propositions"]), after, tuple(data["accepting"]), data["start"], data["text"])


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
