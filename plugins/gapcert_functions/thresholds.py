"""Numbers that decide or bound what is tried, accepted or refused in this room, each with its reason."""

from dataclasses import dataclass
from typing import final

from gapcert.plugin import chosen


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    # majorants
    majorant_cells: int = chosen(4096, "at most: more are tighter, and take longer")
    least_cut: int = chosen(16, "cells cut in a round")
    cut_share: int = chosen(3, "of all cells, one in so many is cut in a round")
    cut_tried: int = chosen(4, "cells of a round of which every axis is tried")
    majorant_gain: float = chosen(0.01, "of the mean, with four times as many cells: it ends where less was gained")
    # bounds over boxes
    quadrature_points: int = chosen(1 << 16, "of a quadrature over all axes, at most: more cost time")
    cut_boxes: int = chosen(4096, "that are cut in a round: more need more memory, fewer are slower each")
    near_samples: int = chosen(24, "that a box looks at: more tighten its bound, and cost time")


THRESHOLDS = Thresholds()
