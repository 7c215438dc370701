"""Numbers that decide or bound what is tried, accepted or refused in this room, each with its reason."""

from dataclasses import dataclass
from typing import final

from gapcert.plugin import chosen


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    # the package itself
    delays: int = chosen(10_000, "of an input, at most: each is a state")
    whole_ratio: float = chosen(1e-9, "relative: ratios of periods that were stated as whole differ by rounding alone")
    instant: float = chosen(1e-6, "of a sub-step: over it nothing arrives, and differences still have half of their digits")
    # mechanics
    expanded_operations: int = chosen(100, "of a text up to which it is expanded")
    # text
    characters: int = chosen(160_000, "of an expression, at most: all effects at one coordinate write 112,000")
    depth: int = chosen(150, "of nesting: what reads it recurses")
    exponent: int = chosen(64, "larger ones overflow, and SymPy multiplies them out")
    arguments: int = chosen(8, "of min and max: cases double with each")
    printed_operations: int = chosen(400, "of a mechanical model, from which parts are printed by names")


THRESHOLDS = Thresholds()
