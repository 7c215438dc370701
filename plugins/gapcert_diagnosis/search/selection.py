"""Stepwise selection of causes: the best move is added while it pays, and what later ones make superfluous is dropped.

`search.stepwise` asks so about models in equations, `native.stepwise` about engines, which are rolled out.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from typing import Any, Protocol, TypeVar

from gapcert_diagnosis.thresholds import THRESHOLDS

S = TypeVar("S")


class Selection(Protocol[S]):
    """What stepwise selection asks about fitted sets of causes S; `nothing` is that of no cause."""

    nothing: S

    def key(self, found: S) -> Hashable:
        """What tells sets of causes apart, whatever their order."""

    def grow(self, parent: S, width: int) -> Sequence[S]:
        """At most so many sets with one move more that may pay, best first.

        Equations: those that pay beside the parent, refined by drops and exchanges at once, since a fit is cheap. Engines: the
        one that fits best, as rollouts are dear; drops come once, in the end.
        """

    def rank(self, found: Sequence[S]) -> list[S]:
        """Best first."""

    def outdoes(self, new: S, best: S) -> bool:
        """Is a grown set better than the best one so far, and does it pay for what it has more?"""

    def without(self, found: S, cause: Any) -> S:
        """The set of the other causes, fitted again."""

    def pays(self, found: S, rest: S) -> bool:
        """Is a set worth more than one that lacks some of its causes?"""


def forward(sets: Selection[S], width: int = 1, enough: Callable[[S], bool] = lambda found: False) -> S:
    """What steps lead to that add the best move while it pays.

    width: sets that are grown at once; enough: is the best of them so good that it is grown alone from there on?
    """
    best = sets.nothing
    beam = [best]
    for _ in range(THRESHOLDS.most_moves):
        grown = {sets.key(found): found for parent in beam for found in sets.grow(parent, width)}
        new = [f for f in sets.rank(list(grown.values())) if sets.key(f) != sets.key(best)]
        if not new or not sets.outdoes(new[0], best):
            break
        best = new[0]
        beam = new[: 1 if enough(best) else width]
    return best


def drop(sets: Selection[S], found: S, causes: Sequence[Any]) -> S | None:
    """Without the first of some causes that does not pay beside all others; None where all of them do."""
    for cause in causes:
        rest = sets.without(found, cause)
        if not sets.pays(found, rest):
            return rest
    return None
