"""Numbers that decide or bound what is tried, accepted or refused in this room, each with its reason."""

from dataclasses import dataclass
from typing import final

from gapcert.plugin import chosen, threshold


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    # the package itself
    inscribed_seeds: int = chosen(48, "cells that inscribed ellipsoids are grown from: the best one is kept")
    rest_weight: float = chosen(1e-3, "of the plan's own cost, for ending away from the reference")
    # planning
    after_arrival: float = chosen(4.0, "half-ranges by which a state or input may leave its own after arrival")
    tube_rounds: int = chosen(5, "of a plan with the tube of the plan before")
    effort_weight: float = chosen(1e-3, "of one input over its half-range for one step, in steps to arrival")
    tried_plans: int = chosen(6, "known ones, whose corridors a start tries")
    tree_nodes: int = chosen(500, "of a search: a start from which nothing is found in so many counts as one without a plan")
    move_floors: tuple[float, ...] = chosen((0.06, 0.02, 0.15), "half-ranges by which a plan may leave its tube, in turns")
    tube_growth: float = chosen(1.2, "of the tube, that it may grow to")
    line_narrowest: float = chosen(0.4, "of the boxes that a plan would get: lines are kept while theirs are not narrower")
    line_widest: float = chosen(1.6, "the same, nor wider")
    linearisation_rounds: int = chosen(4, "about the plan before")
    constant_slope: float = chosen(1e-9, "half-ranges: what changes by less changes by rounding")
    terminal_sizes: tuple[float, ...] = chosen((1.0, 0.7, 0.5, 0.35, 0.25, 0.15, 0.1), "half-widths of the terminal box")
    # program
    outside_margin: float = chosen(1e-9, "half-ranges, far above rounding: obstacles are closed, touching one is inside")
    majorant_near: float = chosen(0.1, "half-ranges: plans are mostly so near to where majorants are centred")
    slope_cells: int = chosen(4096, "in which slopes are bounded: more cost time, fewer are loose")
    slope_parts: int = chosen(4, "of the way to a point, along which slopes are averaged")
    proximal_weight: float = chosen(1e-7, "of terms that make a singular system solvable; `proximal_rounds` take them out")
    proximal_rounds: int = chosen(4, "of refinement: each leaves `proximal_weight` of the error, or so")
    multiplier_error: float = chosen(1e-9, "below 0 that a multiplier may come out, with costs near 1")
    loose_bound: float = chosen(1e3, "half-ranges: a bound that asks nothing, and a finite one leaves the row of its kind")
    tube_polygons: tuple[int, ...] = chosen((2, 3, 4, 6, 8, 12), "faces per plane of a tube's cross-section, that are tried")
    tuning_runs: int = chosen(6, "that end, from which a solver's settings are chosen")
    tuning_steps: int = chosen(40, "of each of them")
    tuning_tries: int = chosen(60, "starts, for so many runs that end")
    tuning_still: int = chosen(4, "runs at the reference, where a loop spends its time")
    piece_count: int = chosen(12, "explicit pieces that are looked up before a program is solved")
    piece_share: float = chosen(0.01, "of the steps, that each piece must be worth")
    tried_rhos: tuple[float, ...] = chosen((0.1, 0.03, 0.3, 1.0), "step sizes of OSQP")
    tried_alphas: tuple[float, float] = threshold((1.0, 1.6), "relaxations: as OSQP, none and its default")
    interior_cost: int = threshold(5, "measured: an interior-point step factors what one of operator splitting solves with")
    # variants
    small_tube: float = chosen(0.05, "of each range: a tube that takes less is not worth the variables that follow γ")
    box_shares: int = chosen(8, "per width of a level, to which its box is rounded outwards")
    computed_disturbance: float = chosen(1e-9, "half-ranges that they may seem larger by: they are computed from states")
    terminal_inside: float = chosen(1e-7, "by which terminal rows are stricter: stages are solved a little inside")
    plan_bytes: int = chosen(1 << 29, "of plans that are remembered")
    membership_boxes: int = chosen(32, "into which Θ is cut")
    many_boxes: int = chosen(200, "at once, from which on a set of them is kept")
    kept_sets: int = chosen(4, "of boxes")
    slope_pieces: int = chosen(4, "on either side of θ̂, along which slopes are bounded one by one")
    starts: int = chosen(64, "that a domain's fraction is looked at from: each may be a search")
    sls_tolerance: float = chosen(1e-9, "of the cost, at which a program counts as solved")
    sls_inside: float = chosen(1e-8, "rows are solved for limits this part further inside, so that they then hold exactly")
    sls_hopeless: float = chosen(1e8, "times the cost without rows: a plan that costs more counts as none")
    sls_rounds: int = chosen(40, "of tightening and planning in turn")
    cell_edge: float = chosen(1e-9, "half-ranges: a cell does not contain its upper edges, and coordinates are rounded")


THRESHOLDS = Thresholds()
