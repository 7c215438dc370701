"""Numbers that decide or bound what is tried, accepted or refused in this room, each with its reason."""

from dataclasses import dataclass
from typing import final

from gapcert.plugin import chosen, threshold


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    small_remainder: int = chosen(4, "rows: a block costs as much as four single ones, a large one as copies / 12")
    engine_probes: int = chosen(64, "random states at which equations are held against a step of the engine")
    probe_range: float = chosen(5.0, "of a state or input, at most: wilder ones blow up")
    probe_calmer: float = chosen(0.3, "of a probe that blew up")
    probe_tries: int = chosen(8, "of calming one")
    strong_push: float = chosen(1e6, "N or N·m: far above all other forces, far below where float64 loses them")
    tried_substeps: tuple[int, ...] = chosen((1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20), "of an engine")
    tried_steps: tuple[float, ...] = threshold((1 / 240, 0.002, 0.001), "s: as PyBullet, MuJoCo, DART and Gazebo by default")


THRESHOLDS = Thresholds()
