"""Numbers that decide or bound what is tried, accepted or refused in this room, each with its reason."""

from dataclasses import dataclass
from typing import final

from gapcert.plugin import chosen, threshold


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    always_read: int = chosen(1 << 28, "bytes of an array that are read however well they are packed")
    packed_times: int = threshold(1100, "times smaller than its values: as deflate, at most 1032, with room")
    named_columns: int = chosen(64, "of one array, that get a name each")
    listed_elements: int = chosen(64, "of an array")
    preamble_lines: int = chosen(1000, "in which a logger may say something")


THRESHOLDS = Thresholds()
