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
    drift_points: int = chosen(80, "at least, for a trend")
    drift_waves: int = chosen(10, "lowest frequencies, that tell what is slow")
    drift_freedom: float = chosen(10.0, "independent samples beyond what is fitted, at least")
    drift_degree: int = threshold(
        5, "of what r may be as a function of each axis: with 2, ripples of it met at few set-points are taken for a trend"
    )
    drift_doubt: float = chosen(2.0, "standard deviations by which neighbours may be closer than they seem")
    drift_apart: float = threshold(
        0.5, "of the variance of time, at least, is no function of z: with less, loops of few set-points are accused too often"
    )
    drift_level: float = chosen(0.999, "at which a trend is told")
    drift_share: float = chosen(0.05, "of γ: a slower trend is not told")
    confidence: float = threshold(0.95, "as usual; the caller may ask for another")


THRESHOLDS = Thresholds()
