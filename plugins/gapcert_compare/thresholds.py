"""Numbers that decide or bound what is tried, accepted or refused in this room, each with its reason."""

from dataclasses import dataclass
from typing import final

from gapcert.plugin import chosen


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    played_trajectories: int = chosen(4, "of the reference's motion, that a difference is diagnosed from")
    played_steps: int = chosen(600, "of each, at least")
    played_seconds: float = chosen(3.0, "of each, at least")
    played_window: int = chosen(5, "part of a trajectory that is fitted at once, as one in so many")
    played_horizon: int = chosen(10, "part over which the gain is measured, as one in so many")
    native_digits: int = chosen(9, "of a native parameter that is set anew, before all of them")
    same_native: float = chosen(1e-6, "relative, how near an option has to bring it")
    closing_share: float = chosen(0.99, "of a difference: a change that takes it away has named its cause")
    listed_changes: int = chosen(8, "at most")
    beam: int = chosen(3, "changes that a search goes on from")
    joint_changes: int = chosen(3, "made together, at most")
    nothing_left: float = chosen(1e-6, "share of a difference that fitted numbers may leave where they explain all of it")


THRESHOLDS = Thresholds()
