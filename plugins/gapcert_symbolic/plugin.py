"""Declares what this package offers; imports nothing but gapcert."""

import gapcert


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    return [
        gapcert.Component(
            "synthesizer",
            "symbolic",
            "sound finite abstraction on a uniform grid: invariance and reach-avoid, all valid inputs per cell",
            "gapcert_symbolic.synthesizer:Symbolic",
            "gapcert_symbolic.config:SymbolicConfig",
            requires=("numba",),
            extra="fast",
        ),
        gapcert.Component("automaton", "ltl", "a goal as a formula of linear temporal logic", "gapcert_cells.ltl:automaton_of"),
        gapcert.Component("automaton", "hoa", "a goal as an automaton in the HOA format", "gapcert_cells.hoa:read_hoa"),
    ]
