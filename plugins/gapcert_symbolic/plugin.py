"""Declares what this package offers; imports nothing but gapcert."""

from pathlib import Path

import gapcert
from gapcert.plugin import RUN, Argument


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
        gapcert.Component(
            "contract", "SynthesizerContract", "what every synthesizer keeps", "gapcert_cells.testing:SynthesizerContract"
        ),
        gapcert.Component("automaton", "ltl", "a goal as a formula of linear temporal logic", "gapcert_cells.ltl:automaton_of"),
        gapcert.Component("automaton", "hoa", "a goal as an automaton in the HOA format", "gapcert_cells.hoa:read_hoa"),
        gapcert.Component(
            "command",
            "export",
            "write a run's controller as a program that needs no Gapcert",
            "gapcert_cells.export.export:command",
            arguments=(
                RUN,
                Argument("--to", "C without libraries, or Python with NumPy", {"choices": ("c", "numpy"), "required": True}),
                Argument("--out", "where the files go", {"type": Path, "required": True, "metavar": "FOLDER"}),
                Argument("--without-gamma", "the controller that trusts the model", {"action": "store_true"}),
            ),
        ),
    ]
