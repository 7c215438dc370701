"""Numbers that decide or bound what is tried, accepted or refused in this room, each with its reason."""

from dataclasses import dataclass
from typing import final

from gapcert.plugin import chosen, threshold


@final
@dataclass(frozen=True)
class Thresholds:
    """Read as `THRESHOLDS.name`."""

    # cells
    memory: float = chosen(8e9, "bytes that a game may need: what a workstation has to spare")
    cell_bytes: int = chosen(
        8, "per cell, without its inputs: what the table of values holds, others that a solver keeps beside it left out"
    )
    gap_boxes: int = chosen(60_000, "over which a gap is bounded: more are tighter, and take longer")
    window_entries: int = threshold(1 << 27, "by the formula: 8 bytes of each are 1 GiB, an eighth of `memory`")
    shared_change: float = chosen(1e-3, "of a cell: what is not worth a longer table")
    held_pieces: int = chosen(16, "per state without cells, over which the gap is bounded one by one")
    gap_pairs: int = chosen(64, "of points per coordinate, that tell along which ones blocks should be narrow")
    faint_weight: float = chosen(1e-3, "of the largest: what no pair shows to change may change all the same")
    growths: int = chosen(40, "of a box that is to hold the states without cells")
    growth_ahead: float = chosen(0.1, "of a step's growth: a box that grows ever more slowly is reached")
    held_tolerance: float = chosen(1e-2, "of the gap's supremum over such a box")
    held_boxes: int = chosen(20_000, "that its supremum is looked for in")
    single_pairs: int = chosen(4096, "that cost less to bound one by one than to put into groups")
    class_cells: int = chosen(4, "per class, from which on classes pay")
    axis_leak: float = chosen(1e-9, "of a cell: what an axis may shift another by and not count; it is added to the bound")
    structure_pairs: int = chosen(256, "of points per axis, that show what a model without derivatives depends on")
    # games
    change_pairs: int = chosen(10_000_000, "of a cell and an input, up to which a change is tried: each is a game")
    change_halvings: int = threshold(8, "by the formula, a factor of γ is then known to 1/256")
    drift_cells: int = chosen(4096, "over which it is asked whether a state can be held: a bound, whatever the cells are")
    needed_halvings: int = threshold(16, "by the formula, what is needed at the least is then known to the three digits shown")
    factors: tuple[int, int] = chosen((2, 4), "more cells per axis, that are tried")
    # solvers
    affine_inputs: int = chosen(64, "above, tables are shared by inputs and pay")
    first_blocks: int = chosen(8, "along the longest axis, or some more: they are cut where a game needs it")
    run_threads: int = chosen(4, "at most: each takes four bytes per cell")
    threaded_pairs: int = chosen(1 << 26, "of a cell and an input: with fewer, threads take longer to begin than they save")


THRESHOLDS = Thresholds()
