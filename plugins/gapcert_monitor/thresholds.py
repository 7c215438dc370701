"""Numbers that decide or bound what is tried, accepted or refused in this room, each with its reason."""

from dataclasses import dataclass
from typing import final

from gapcert.plugin import chosen, threshold


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    listed: int = chosen(1_000, "largest, told one by one")
    neighbours: int = chosen(30, "at least: a correlation of fewer is chance")
    noise_correlation: float = chosen(-0.25, "of neighbours: white noise in a measured state turns differences to −0.5")
    drift_stretches: int = chosen(20, "whose sums tell the error of a slope")
    drift_level: float = chosen(0.999, "at which a trend is told")
    drift_share: float = chosen(0.05, "of γ: a slower trend is not told")
    confidence: float = threshold(0.95, "as usual; the caller may ask for another")


THRESHOLDS = Thresholds()
