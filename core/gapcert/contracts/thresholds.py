"""Numbers that decide or bound what is tried, accepted or refused in this room, each with its reason."""

from dataclasses import dataclass
from typing import final

from gapcert.thresholds import chosen


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    # data
    relation_texts: int = chosen(8, "inequalities that one text may stand for: absolute values double them")
    epoch: float = chosen(1e6, "s: later times count from some epoch, and are counted from their first instead")
    # gaps
    symmetry_pairs: int = chosen(500, "of points at which a declared symmetry is held against the residual")
    # systems
    rounding_boxes: int = chosen(256, "over which arithmetic is followed, where fewer are too wide")
    rounding_points: int = chosen(256, "corners of Z at most, and points in it, with which the boxes are compared")
    rounding_wide: float = chosen(1024.0, "times the bound at points: above that, eight times as many boxes are tried")
    rounding_plain: float = chosen(16.0, "times 4 ulp of the state: a larger error is that of a term within, and names it")
    region_sweeps: int = chosen(40, "of coordinates, for the extreme of an ellipsoid over a box")
    ellipsoid_states: int = chosen(8, "at most: a cell has two to their number corners")


THRESHOLDS = Thresholds()
