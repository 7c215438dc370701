"""Whether two Systems speak of the same numbers: names, units, kinds and period."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from gapcert.contracts.systems.system import StateSpec, System

SAME = 1e-12  # relative difference up to which two periods are one


def unpaired(one: System, other: System) -> str:
    """Why steps of `other` cannot be laid beside those of `one`, or nothing: `its states are …, the model's …; …`."""
    for what in ("states", "inputs"):
        if said := unmatched(what, getattr(one, what), getattr(other, what)):
            return said
    if abs(one.period - other.period) > SAME * one.period:
        return f"its period is {other.period:g} s, the model's {one.period:g} s; set them equal"
    return ""


def unmatched(what: str, want: Sequence[StateSpec], have: Sequence[StateSpec]) -> str:
    """Why axes `have` do not carry the numbers of the model's axes `want`, or nothing."""
    if [s.name for s in want] != [s.name for s in have]:
        return f"its {what} are {_names(have)}, the model's {_names(want)}; they must agree"
    from gapcert.contracts.data.units import same_unit

    for w, h in zip(want, have, strict=True):
        if w.unit != h.unit and not same_unit(w.unit, h.unit):
            said = f"its {what[:-1]} '{h.name}' is in '{h.unit}', the model's in '{w.unit}'"
            return f"{said}; numbers are compared as they are; declare one unit on both sides, and answer in it"
        if (w.kind, h.kind) in _APART:
            said = f"its {what[:-1]} '{h.name}' is of kind {h.kind}, the model's of kind {w.kind}"
            return f"{said}; the difference of their values would have no meaning; declare one kind on both sides"
    return ""


_APART = {(a, b) for a, b in pairwise(("real", "quaternion", "angle", "quaternion", "real"))}
"""Kinds of a pair that cannot be subtracted. An angle and a number can: in the geometry of the model's."""


def _names(specs: Sequence[StateSpec]) -> str:
    return ", ".join(s.name for s in specs)
