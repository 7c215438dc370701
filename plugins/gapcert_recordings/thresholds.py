"""Numbers that decide or bound what is tried, accepted or refused in this room, each with its reason."""

from dataclasses import dataclass
from typing import final

from gapcert.plugin import chosen, decides


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    input_tries: int = chosen(256, "inputs drawn at a time, for one that keeps the relations")
    hold_seconds: tuple[float, float] = chosen((0.2, 1.0), "s, for which an input of a played experiment is held")
    bridged_samples: int = chosen(5, "lost ones, over which an input may be continued")
    stray_samples: int = chosen(3, "in a row that may arrive out of order; more are a clock that was set back")
    clock_resets: int = chosen(20, "at most: what is set back more often is no clock")
    no_measurement: float = chosen(1e30, "in whatever unit: formats fill holes with 9.97e36 or the largest float")
    fill_distance: float = chosen(10.0, "times the range of all else: one value that is met again so far away stands for none")
    input_jump: float = chosen(4.0, "times its usual change: an input that moved so far unseen cannot be continued")
    unseen_jitter: float = chosen(0.05, "of the noise floor: what uneven times change by less may be taken for even")
    arrival_gain: float = chosen(-0.05, "log of the noise floor, even times over logged: below, these are times of arrival")
    widest_smooth: float = decides(0.1, "s on either side of a sample that a smooth curve may look at")
    outlier_scatter: float = chosen(8.0, "times the local scatter, of a value against both sides together")
    one_sided_scatter: float = chosen(3.0, "the same from before and from after, each alone")
    outlier_rounds: int = chosen(20, "of taking out the strangest value of each stretch")
    least_outlier: float = chosen(0.005, "of a channel's spread: kinks of a clean signal are no outliers")
    scatter_samples: int = chosen(50, "that share a scatter: fewer know it badly, more mix rest and motion")
    smooth_bias: float = chosen(0.05, "of the noise, that a smooth curve may have")
    least_scatter: int = chosen(16, "samples that a scatter needs")
    period_error: float = chosen(1e-3, "of the period, between two rows: with more, they are no transition")
    copy_bits: float = chosen(30.0, "by which a stretch may not agree by chance: 1e-9, of some thousand that are looked at")
    copy_coarse: float = chosen(6.0, "bits: where a row tells less, others of the same two logs show what chance does")
    copy_rows: int = chosen(8, "at least, in a stretch that is the same")
    copy_votes: int = chosen(3, "rows that lie alike, before all are compared")
    copy_places: int = chosen(40, "of one log in another, those where most rows lie alike, that are compared")
    copy_lag: int = chosen(2, "rows: four of them, so far apart, are looked up together")
    copy_neighbours: int = chosen(8, "nearest of them")
    copy_queries: int = chosen(100_000, "of them are asked for, or a part of the rows")
    copy_steps: tuple[int, ...] = chosen((2, 3, 4), "rows, of which a copy may have kept one, whatever its clock says")
    copy_ratio: int = chosen(50, "of periods, at most, at which one is taken for a thinned copy of another")
    copy_channels: int = chosen(6, "that are looked up: what tells no two apart costs time")
    copy_apart: int = chosen(16, "rows of one log, nearer to each other than that, are neighbours")
    copies_told: int = chosen(3, "by name: a recording may hold many, and a program reads all of them")
    form_values: int = chosen(400, "of a channel tell with how many digits it is written")
    hole_step: float = chosen(1.5, "of the period: longer steps of time are holes")
    flaw_samples: int = chosen(30, "at least, in a column of which anything is told")
    clipped_samples: int = chosen(3, "in a row at the end of a range: a turning point has fewer")
    clipped_speed: float = chosen(0.3, "of the usual step, with which a value that is cut off comes to the end of its range")
    stuck_samples: int = chosen(8, "in a row that are the same, of a sensor whose noise shows in every other one")
    even_runs: float = chosen(0.9, "of the values, that are held as long as most are")
    hole_ends: int = chosen(5, "samples on either side of a hole that tell how fast it turns there")


THRESHOLDS = Thresholds()
