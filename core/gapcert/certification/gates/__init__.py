"""What is probed before any certificate: that f̂ is a function of (x, u), and what its hidden state does to it."""

from gapcert.certification.gates.augment import widen
from gapcert.certification.gates.entry import contain, enter, paired
from gapcert.certification.gates.hidden_distribution import Law, beginning
from gapcert.certification.gates.hidden_state import Gate, HiddenPlan, attacked
from gapcert.certification.gates.memory import forgets, unmeasured

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
    "unmeasured",
    "widen",
]
