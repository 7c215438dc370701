"""Numbers that decide or bound what is tried, accepted or refused in this room, each with its reason."""

from dataclasses import dataclass
from typing import final

from gapcert.plugin import chosen, threshold


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    archive_entries: int = chosen(20_000, "at most: an FMU has some hundred")
    description_bytes: int = chosen(64 << 20, "at most: what is parsed at once")
    events: int = chosen(1000, "at most: more is chattering")
    event_halvings: int = threshold(50, "by the formula, an event is then known to 2⁻⁵⁰ of a period")
    kept_messages: int = chosen(20, "of an FMU, at most")
    memory_periods: int = chosen(4, "through which an FMU is asked whether it remembers more than its states")
    memory_change: float = chosen(1e-9, "relative: a smaller difference is rounding")


THRESHOLDS = Thresholds()
