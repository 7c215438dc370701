"""The stages of a run as lanes over its events."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final


@final
@dataclass(frozen=True)
class Lane:
    """The states of one stage, each from the event with that number on."""

    stage: str
    at: tuple[int, ...]
    states: tuple[str, ...]

    def then(self, number: int, state: str) -> Lane:
        """This lane with a new state; the same state again changes nothing."""
        if self.states and self.states[-1] == state:
            return self
        return Lane(self.stage, (*self.at, number), (*self.states, state))
