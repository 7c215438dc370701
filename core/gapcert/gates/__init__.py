"""What is probed before any certificate: that f̂ is a function of (x, u), and what its hidden state does to it."""

from gapcert.gates.augment import widen
from gapcert.gates.entry import contain, enter, paired, refuse
from gapcert.gates.hidden import Gate, HiddenPlan, attacked
from gapcert.gates.laws import Law, beginning
from gapcert.gates.memory import forgets, unmeasured

__all__ = [
    "Gate",
    "HiddenPlan",
    "Law",
    "attacked",
    "beginning",
    "contain",
    "enter",
    "forgets",
    "paired",
    "refuse",
    "unmeasured",
    "widen",
]
