"""Controllers on cells, their files, and programs made of them: a kit of synthesizers."""

from __future__ import annotations

import sys

from gapcert.plugin import LazyPackage, homes

_HOME = homes(
    {
        "gapcert_cells.automaton_controller": "AutomatonController",
        "gapcert_cells.files": "loaded loading saved_data write_saved",
        "gapcert_cells.grid_controller": "GridController",
        "gapcert_cells.hoa": "read_hoa",
        "gapcert_cells.load": "load_controller",
        "gapcert_cells.ltl": "automaton_of",
        "gapcert_cells.outside": "inside_alone refusal",
        "gapcert_cells.successors": "GROWTH SEEN Along Splits Successors SuccessorsByLevel",
        "gapcert_cells.wider_inputs": "FAR ranges sufficient",
    }
)

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
