"""Numbers that decide or bound what is tried, accepted or refused in this room, each with its reason."""

from dataclasses import dataclass
from typing import final

from gapcert.plugin import chosen, threshold


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    batch_cells: int = chosen(128, "of a batch")
    batch_points: int = chosen(16, "of each of them")
    cover_batch: int = chosen(4096, "points of a step: fewer are noisier, more cost time")
    scored_points: int = chosen(100_000, "at which a network is judged between steps")
    constant_turns: int = chosen(2, "of the fixed point for X in each step: it begins where the last one ended")
    recipe_phases: int = threshold(8, "as published, one for each value of η")
    phase_shortfall: float = chosen(0.02, "of the largest |r|, that may be missing at the end of a phase")
    asked_per_cell: int = chosen(16, "points that the band is asked at")
    asked_points: int = chosen(65_536, "at most")
    table_cells: int = chosen(4096, "of the default table, at most")
    checkpoint_seconds: float = chosen(5.0, "between two checkpoints")
    training_looks: int = chosen(20, "at the loss of all points, in the course of a training")
    step_halvings: int = chosen(12, "of a step that is not accepted")
    patience: int = chosen(5, "looks without a gain of a thousandth, after which a training ends")
    small_loss: float = chosen(1e-3, "in units of the targets' spread: what is not worth reducing")


THRESHOLDS = Thresholds()
