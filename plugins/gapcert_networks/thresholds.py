"""Numbers that decide or bound what is tried, accepted or refused in this room, each with its reason."""

from dataclasses import dataclass
from typing import final

from gapcert.plugin import chosen, threshold


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    gain: float = chosen(1e-10, "of ρ: what is not worth a further proof")
    apart: float = threshold(1e100, "further apart, units leave no room in float64 for the squares of both")
    cell_steps: int = chosen(3, "of X, towards the best bound of a cell")
    cell_hope: float = chosen(1.15, "times the target: a bound above is not brought down to it by further steps")
    cell_stuck: float = chosen(0.9, "times the bound before: where a step won less, so will the next")
    least_square: float = chosen(1e-14, "of vᵀv: the least vᵀXv that is used")
    path_sums: float = threshold(1e60, "beyond it, or below its inverse, float64 leaves no room for squares")
    first_slack: float = chosen(1e-13, "of ρ: what is first added for rounding, until the proof succeeds")
    last_slack: float = chosen(1e-6, "of ρ: what is added at most")
    climb_points: int = chosen(1024, "where a large gradient is looked for first")
    climb_rounds: int = chosen(12, "of going on from the largest")
    climb_tries: int = chosen(64, "points of each round")
    few_gates: int = chosen(3, "open ones per input: they are told apart at once")
    some_gates: int = chosen(5, "open ones per input: they are told apart after `gate_boxes`")
    gate_boxes: int = chosen(4096, "that are bounded before some gates are told apart")
    most_gates: int = chosen(40, "open ones over the whole domain, above which they are never told apart")
    gate_nodes: int = chosen(2000, "over the patterns of a box, at most")
    split_boxes: int = chosen(4096, "open ones that are all split in a round, else the worse half")
    scaling_sweeps: int = chosen(10, "through the layers: each wins less")


THRESHOLDS = Thresholds()
