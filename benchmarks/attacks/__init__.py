"""Attacks on each kind of claim: a claim is drawn, made by the front door, and everything is tried that could break it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Attempt:
    """One claim, attacked.

    claim: what was claimed, or `refused`. tries: points, steps or words; broken: those that contradict it. level: the
    share ε that a statistical claim leaves, doubt: its β. drawn: of a claim with a level, tries as its audit draws them, and
    those that contradict it; the others were aimed. case: what was drawn, enough to see what it is about.
    """

    claim: str
    tries: int = 0
    broken: int = 0
    level: float | None = None
    doubt: float | None = None
    drawn: tuple[int, int] = (0, 0)
    case: dict[str, Any] = field(default_factory=dict)


KINDS = {
    "certificates": 2000,
    "games": 500,
    "mpc": 200,
    "networks": 2000,
    "formulas": 10_000,
    "calibrations": 300,
    "forgeries": 120,
}
"""Kind, which is the name of its module here → how many claims are drawn."""
