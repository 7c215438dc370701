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
