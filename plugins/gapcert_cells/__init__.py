"""Controllers on cells, their files, and programs made of them: a kit of synthesizers."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage

_HOME = {
    "Along": "gapcert_cells.successors",
    "AutomatonController": "gapcert_cells.automaton_controller",
    "GridController": "gapcert_cells.grid_controller",
    "Splits": "gapcert_cells.cell_tree",
    "Successors": "gapcert_cells.successors",
    "SuccessorsByLevel": "gapcert_cells.cell_tree",
    "automaton_of": "gapcert_cells.ltl",
    "load_controller": "gapcert_cells.load",
    "loading": "gapcert_cells.files",
    "read_hoa": "gapcert_cells.hoa",
    "write_saved": "gapcert_cells.files",
}

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
