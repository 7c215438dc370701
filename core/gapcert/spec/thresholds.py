"""Numbers that decide or bound what is tried, accepted or refused in this room, each with its reason."""

from dataclasses import dataclass
from typing import final

from gapcert.thresholds import chosen


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    # editors
    editor_bytes: int = chosen(1 << 20, "of a file that an editor is asked to take for a spec: larger ones are data")
    editor_depth: int = chosen(4, "of folders in which specs are looked for")
    # text
    extending_files: int = chosen(32, "that extend each other, at most")
    matrix_specs: int = chosen(10_000, "specs of one matrix, at most")
    folder_files: int = chosen(20_000, "of a folder that are looked at")
    spec_bytes: int = chosen(1_000_000, "of a file: a spec names its data, it does not hold them")
    spec_values: int = chosen(20_000, "with what aliases repeat: they may double per line")
    spec_depth: int = chosen(64, "of nesting: what reads it recurses")


THRESHOLDS = Thresholds()
