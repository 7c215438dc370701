"""Numbers that decide or bound what is tried, accepted or refused in this room, each with its reason."""

from dataclasses import dataclass
from typing import final

from gapcert.thresholds import chosen, threshold


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    # the package itself
    judged_points: int = chosen(25_000, "between two reports of progress")
    same_period: float = chosen(1e-12, "relative: periods that were stated as one differ by rounding alone")
    yardstick_samples: int = chosen(20_000, "from which on no envelope is made beside theorem 1, whose cost grows with them")
    suspects: int = chosen(200, "samples above γ that are held against all others: one contradiction is enough")
    constant_looks: float = chosen(4e8, "at samples, by the branch and bound behind a constant")
    trail_parts: int = chosen(4, "of a pair in each step: a jump's slope then grows by 4, a settled one by 1")
    trail_clear: float = chosen(16.0, "resolutions: smaller changes tell nothing")
    supremum_batch: int = chosen(2048, "boxes of a round: fewer go to the largest bound first, more cost less each")
    supremum_probes: int = chosen(64, "boxes of a round whose centres and corners are asked, for a lower end")
    hunt_boxes: int = chosen(20_000, "of a search for what contradicts a declaration: seconds, where equations are long")
    hunt_batch: int = chosen(64, "boxes of its rounds: few go deep, as a narrow spike asks")
    hunt_width: float = chosen(1e-12, "of an axis: what is narrower drowns in rounding")
    hunt_steps: int = chosen(40, "halvings of an axis, by which a suspected point is left")
    # gates
    hidden_vertices: int = chosen(64, "of declared ranges, at most: beyond six numbers they are drawn")
    hidden_move: float = chosen(0.1, "of a hidden number without a range, in rad, m, rad/s, …; 1 where it has no unit")
    hidden_candidates: int = chosen(64, "drawn per state, for one that keeps the relations")
    harmless: int = threshold(4, "resolutions: by the formula, both answers of a spread may err by e of f̂ and of f")
    hidden_queries: int = chosen(384, "of a probe, shared by all hidden numbers")
    hidden_together: int = chosen(48, "states at which all hidden numbers are moved at once")
    hidden_runs: int = chosen(24, "rollouts, from which visited hidden states are taken")
    hidden_steps: int = chosen(12, "of each of them")
    harmless_runs: int = chosen(16, "long rollouts, which lend an audit hidden states that seemed harmless")
    harmless_steps: int = chosen(256, "of each of them: what adds up over a closed loop shows by then")
    hidden_attack: int = chosen(256, "points of an attack from other hidden states, and as many visited ones")
    spread_points: int = chosen(64, "at which the spread over hidden states is measured")
    spread_draws: int = chosen(16, "hidden states at each of these")
    repeat_rows: int = chosen(64, "points at which it is looked whether a system repeats with a turn")
    repeat_error: float = chosen(64.0, "times what a step rounds by, that it may change with a turn: sums round more than once")
    purity_rows: int = chosen(21, "that are asked again in other company; with the centre and three ladders they are 64")
    purity_rungs: int = chosen(14, "of a ladder of close rows: from its length down to 6e-7 of it")
    jitter_rows: int = chosen(32, "points, each asked at fifteen places some ulp apart: no more than other probes ask")
    small_call: int = chosen(64, "rows of the largest of an audit's small calls")
    small_calls_rows: int = chosen(1_500, "of an audit, at most, that are asked in small calls, which cost an engine more")
    again_rows: int = chosen(64, "of the samples and of the audit, each, that are asked again alone: more cost time")
    held_periods: int = chosen(512, "at most, that one row is asked in a row: a counter in a system shows by then")
    response_error: float = chosen(0.1, "relative, between what an input moves in f̂ and in f: a warning, no refusal")
    response_rows: int = chosen(16, "states at which an input is moved from end to end")
    # fingerprint
    question_points: int = threshold(64, "as the design has it: what f and f̂ answer at so many points of Z makes a question")
    question_box: int = chosen(512, "points of the box around Z, of which Z has the same in every spelling")
    question_diagonal: int = chosen(8, "of the points at one share of every axis")
    question_orders: int = chosen(720, "of axes with equal ranges, those of six: after so many a question is the same")
    question_range: float = threshold(1e-9, "of the width, as the design has it: closer ranges are one")
    question_draws: int = chosen(16, "of noise at each point")
    question_noise: float = threshold(0.5, "deviations: by the formula, means of 16 draws at 64 points differ by less")
    question_spread: float = threshold(0.05, "by the formula: spreads of 1024 draws differ by less than four times this share")
    question_shared: float = chosen(0.05, "of its hashes: recordings that have so many in common are one")
    # samples
    spread_grid: int = chosen(300, "points of a grid where nobody asks for another")
    refinement_rounds: int = chosen(8, "at most 9, since names of rounds are sorted as texts")
    refinement_points: int = chosen(4_000, "at which the band is looked at, which costs no simulation")


THRESHOLDS = Thresholds()
