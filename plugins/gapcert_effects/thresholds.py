"""Numbers that decide or bound what is tried, accepted or refused in this room, each with its reason."""

from dataclasses import dataclass
from typing import final

from gapcert.plugin import chosen, threshold


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    min_turns: float = threshold(1.3, "periods over the range: measured on the Silverbox, fewer name a cubic spring")
    max_turns: float = chosen(20.0, "periods over the range of motion that are all tried; of more, those that data suggest")
    finest_turns: int = chosen(1000, "periods over the range of motion, at most")
    agreeing_parts: int = chosen(64, "of the data, whose forces must agree on a period")
    agreeing: float = threshold(10.0, "times what chance makes of them: by the formula, at one period in 22,000")
    outstanding: int = chosen(2, "periods that data suggest, at most: one may be a harmonic of the other")
    little_used: float = chosen(0.02, "of an input's peak: a side of its range, or a range, that is no longer has no knots")
    knots: int = chosen(7, "of a curve drawn through the data: three on either side of zero")
    rolling_points: int = chosen(16, "states drawn, at which a step of a base on wheels must turn with its heading")
    rolling_aside: float = chosen(
        0.1, "of the angle turned in a step: from the chord of the arc, where the speed changes meanwhile"
    )
    push_starts: int = chosen(80, "tried: the width of a push grows with the length of the recording")
    gear_step: float = chosen(1.25e-3, "s of a sub-step at most, in which knocks between two inertias are resolved")
    latest_input: float = chosen(0.1, "of the duration of the data, that an input comes late at most")
    latest_periods: float = chosen(1000.0, "of delay, at most: each is a hidden state")
    slowest_lag: float = chosen(1.0, "of the duration of the data, of a time constant at most")
    slowest_sensor: float = chosen(0.3, "of the duration of the data, of a sensor's time constant: slower ones show no motion")
    latest_output: float = chosen(0.05, "of the duration of the data, that an output comes late at most")
    shown_periods: float = chosen(100.0, "of delay, at most: before a window, outputs are extrapolated")
    next_time: float = chosen(1.8, "times a time that is tried, at most, for the next one")
    lattice_cells: int = chosen(64, "of the range, each with the same say: a joint that rests for long is no lattice")
    lattice_levels: int = chosen(6, "at least: of fewer, steps are chance")
    lattice_coarsest: float = chosen(4.0, "steps over the range, at least")
    lattice_repeats: int = chosen(8, "times that each of a few exact levels comes again")
    lattice_finest: float = chosen(2.0, "noise floors of a step: finer ones drown in the noise")
    lattice_widest: float = chosen(100.0, "noise floors of a step")
    lattice_bins: int = chosen(1 << 16, "of a histogram, at most")


THRESHOLDS = Thresholds()
