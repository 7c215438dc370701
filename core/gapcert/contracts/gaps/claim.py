"""The levels of a claim: what evidence supports, and what carries over to that which is built on it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import Decimal
from typing import TYPE_CHECKING, Any, Literal, final

if TYPE_CHECKING:
    from gapcert.contracts.gaps.lipschitz import Provenance

ClaimKind = Literal["deterministic", "statistical", "empirical", "assumed"]


@final
@dataclass(frozen=True)
class Claim:
    """What is claimed of l ≤ r ≤ u on Z.

    `deterministic`: everywhere, under the named assumptions. `statistical`: outside a set of probability ε under
    `distribution`, with confidence 1 − β; without β: on average over calibrations. `empirical`: on the points that were looked
    at. `assumed`: a person says so; checks may refute it, and do not make it more.
    """

    kind: ClaimKind
    epsilon: float | None = None
    beta: float | None = None
    distribution: str | None = None

    def summary(self) -> dict[str, Any]:
        return {k: v for k, v in vars(self).items() if v is not None}

    @classmethod
    def supported(
        cls, asked: ClaimKind, provenance: Provenance, refuted: bool, epsilon: float, beta: float, distribution: str
    ) -> Claim:
        """What may be said where `asked` was asked for; never more than that.

        Anything that refutes it (a point of the audit or the attack outside [l, u], two samples against the constants) leaves
        `empirical`, except of `assumed`. `deterministic` rests on constants that are no estimate; `statistical` on the audit
        alone, with its ε, β and distribution, whatever the constants are.
        """
        if asked == "assumed":
            return cls("assumed")
        if not refuted and asked == "deterministic" and provenance != "estimated":
            return cls("deterministic")
        if not refuted and asked == "statistical":
            return cls("statistical", epsilon, beta, distribution)
        return cls("empirical")

    @property
    def carried(self) -> Claim:
        """That of a controller, or of anything else that visits points of its own choice, built on this one.

        `deterministic` carries over, and so does `assumed`. A `statistical` claim about points drawn from a distribution does
        not: a regulator may sit for ever in the ε that was missed.
        """
        return self if self.kind in ("deterministic", "assumed") else Claim("empirical")


def audit_size(epsilon: float, beta: float) -> int:
    """⌈ln β / ln(1 − ε)⌉: as many independent points without a violation bound its probability by ε at confidence 1 − β."""
    return math.ceil(math.log(beta) / math.log1p(-epsilon))


def beta_of(confidence: float) -> float:
    """1 − confidence, from the decimal that was written: 0.999999 means 1e-6, not 1.00000000002876e-6."""
    return float(1 - Decimal(repr(confidence)))
