"""Numbers that decide or bound what is tried, accepted or refused in this room, each with its reason."""

from dataclasses import dataclass
from typing import final

from gapcert.thresholds import chosen


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    stage_pause: float = chosen(1.0, "s between two reports of one stage: a person follows no more")
    short_pause: float = chosen(0.1, "s between two of different stages")
    silence: float = chosen(10.0, "s after which a run that has nothing to tell gives a sign of life")
    rate_window: float = chosen(30.0, "s that a rate is the mean of: shorter ones jump, longer ones miss that a stage slows")
    rate_reports: int = chosen(3, "that a rate rests on, however old: some stages report once a minute")
    rate_known: float = chosen(2.0, "s before which a rate is chance")
    lost_run: float = chosen(600.0, "s without a sign, after which a run on a machine that cannot be seen counts as dead")


THRESHOLDS = Thresholds()
