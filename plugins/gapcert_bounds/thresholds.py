"""Numbers that decide or bound what is tried, accepted or refused in this room, each with its reason."""

from dataclasses import dataclass
from typing import final

from gapcert.plugin import chosen, threshold


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    # constants
    bend_rounds: int = chosen(6, "of a search for large second differences, each nearer to the largest")
    bend_fresh: float = chosen(0.25, "share of a later round that is drawn from all of Z")
    bend_faked: float = chosen(0.02, "share of the largest second difference that the resolution may fake")
    bend_clear: float = chosen(16.0, "resolutions: smaller second differences tell nothing")
    bend_steps: int = chosen(4, "of a sweep, by four each: what grows through all of them grows on")
    bend_settled: float = chosen(1.5, "growth of a second difference below which it has settled")
    bend_growth: float = chosen(2.5, "per step by four: a kink grows fourfold, a jump or noise sixteenfold, what is smooth not")
    bend_trails: int = chosen(3, "of the largest, per state and axis, and as many at random")
    least_differences: int = chosen(60, "second differences per axis: with fewer, rounds have no elites")
    elite_rounds: int = chosen(8, "of a search for large slopes, each nearer to the largest")
    elite_first: int = chosen(2, "parts of the pairs that the first round has, of which each later one has one")
    elite_fresh: float = chosen(0.25, "share of a later round that is drawn from all of Z")
    shortest_pair: float = chosen(1 / 16, "of the distance that was asked for: shorter pairs follow noise")
    slope_faked: float = chosen(0.02, "share of the largest slope that the resolution may fake at a shortened pair")
    cut_gain: float = chosen(1e-3, "of the cost of one cell for all: cutting ends where less is left to gain")
    finest_cut: int = chosen(8, "parts of a cell per axis")
    curvature_near: float = chosen(0.01, "a bound that a second derivative comes so close to is not improved")
    curvature_parts: int = chosen(16, "of an axis at least, put together again where slabs are fewer")
    slab_cost: float = chosen(0.005, "of the sum of bounds: what fewer slabs may cost")
    slight_curvature: float = chosen(1e-6, "of the Lipschitz constant over an axis: what is not worth improving")
    cell_axes: int = chosen(12, "at most: two parts along each make 2¹² cells and more")
    pair_share: float = chosen(0.4, "of the budget, that is spent on close pairs")
    trail_share: float = chosen(0.6, "of the budget, that is spent when steep pairs have been followed")
    jump_budget: float = chosen(1.5, "of the budget, at most: a jump that was found is pursued to its end")
    cell_pairs: int = threshold(100, "per axis: by the formula, the largest of 100 misses the top sixth in 1 of 10⁸ cells")
    cell_pad: float = chosen(0.25, "of a box's width, on each side of it, from which its pairs are taken")
    change_clear: float = chosen(16.0, "resolutions: smaller changes tell nothing")
    trail_end: int = chosen(64, "parts of the thinnest cell at which trails end")
    piecewise_axes: int = chosen(8, "at most: a cell has 2⁸ corners")
    compared_points: int = chosen(400, "of a cell, each with each: the cost grows with their square")
    noise_share: float = chosen(0.1, "of the largest slope, that the resolution may fake")
    sweep_steps: int = chosen(6, "by four each: down to 1/4096 of a pair")
    sweep_parts: int = chosen(4, "of a pair in each step: a jump's slope grows by as much, a settled one by 1")
    sweep_clear: float = chosen(64.0, "resolutions: smaller changes tell nothing")
    slope_settled: float = chosen(1.5, "growth of a slope below which it has settled")
    slope_growth: float = threshold(4.0, "in two steps, by the formula: noise grows by 16, smooth slopes by 1")
    jump_alone: float = chosen(8.0, "times the random pairs' changes: what is left at a steep pair is a jump, and not noise")
    farthest_end: float = chosen(1e4, "ranges of the sample: beyond, the likelihood is flat, and the distribution a Gumbel's")
    farthest_slope: float = chosen(2.0, "times the largest: maxima whose fitted end lies beyond show no end at all")
    elites: int = chosen(8, "per state and axis, that a later round looks around")
    elite_reach: float = chosen(0.3, "of the domain's width around an elite in the second round; half as far in each later one")
    # families
    predictor_nodes: int = chosen(1_000, "of a multilinear predictor: more are fitted to fewer samples each")
    predictor_samples: int = chosen(20_000, "that it is fitted to: the audit decides on all")
    exchange_rounds: int = chosen(40, "of adding violated points: what is left is repaired by an exact shift")
    dropped_weight: float = chosen(1e-8, "of the largest: such weights are rounding of the solver")
    shift_cells: int = chosen(4096, "of the default table of shifts, at most: more take longer than the band is worth")
    asked_points: int = chosen(4096, "at which the band is compared")
    exchange_error: float = chosen(1e-7, "of the largest residual: what is left is repaired by an exact shift")
    grouped_points: int = chosen(256, "that are asked together: near ones share the cones that they need")
    direct_points: int = chosen(1024, "up to which groups cost more than they save")
    mean_cones: int = chosen(8, "that join a mean, at most: more tighten it little")
    mean_near: float = chosen(1e-3, "of what a cone moves over the box: a bound that is so near is enough")


THRESHOLDS = Thresholds()
