"""Numbers that decide or bound what is tried, accepted or refused in this room, each with its reason."""

from dataclasses import dataclass
from typing import final

from gapcert.plugin import chosen


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    interior_gap: float = chosen(1e-9, "of ρ, between both sides, at which the method ends")
    interior_rounds: int = chosen(100, "at most")
    step_back: float = chosen(0.8, "of a step that left the cone")
    interior_start: float = chosen(1.3, "times the smallest ρ that the first multipliers admit")
    boundary_step: float = chosen(0.95, "share of the way to the boundary")
    late_boundary_step: float = chosen(0.98, "the same, where the mean product is below `late_product`")
    late_product: float = chosen(1e-6, "mean product from which steps go nearer to the boundary")
    krylov_steps: int = chosen(60, "to the smallest eigenvalue")
    eigenvalue_error: float = chosen(0.02, "relative, at which they end")
    free_eigenvalue: float = chosen(0.9, "above −1 a whole step is inside; the rest is room for `eigenvalue_error`")
    start_above: float = chosen(1.3, "times the smallest ρ of the start, so that it lies inside")
    search_rounds: int = chosen(300, "of a quasi-Newton search, at most")
    corrections: int = chosen(20, "that it remembers: each costs an array")
    search_restarts: int = chosen(3, "from where the last one stopped")
    search_gap: float = chosen(5e-9, "of ρ between both sides, at which it ends")
    newton_steps: int = chosen(20, "at most: it converges by squares")
    newton_gap: float = chosen(1e-10, "of ρ between both sides, at which it ends")
    newton_halvings: int = chosen(8, "of a step that wins nothing")
    rounding: float = chosen(1e-14, "relative: what rounding may take from a step")
    newton_unknowns: int = chosen(66, "up to which Newton's method is the faster one")
    least_eigenvalue: float = chosen(1e-12, "of the largest, that the first X has at least")


THRESHOLDS = Thresholds()
