"""What was changed or left out of a recording, in words, from the `log` of a diagnosis."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

SHOWN = 3  # places of a kind


def repairs(log: Mapping[str, Any]) -> Iterator[str]:
    """A clause each for what is not as it was logged; nothing for a clean log."""
    if resets := log.get("resets"):
        yield f"the clock is set back{_places(resets)}, where the recording is cut"
    if gaps := log.get("gaps"):
        yield f"time jumps ahead{_places(gaps)}, where the recording is cut"
    if cuts := log.get("cuts"):
        yield f"an input moved unseen{_places(cuts)}, where the recording is cut"
    if n := log.get("duplicates"):
        yield f"{_count(n, 'row')} whose time is missing or does not go forward {_are(n)} left out"
    if n := log.get("dropped"):
        yield f"{_count(n, 'row')} {_are(n)} missing, and bridged"
    if log.get("stamps") == "ignored":
        yield "times are taken for those of arrival, and replaced by even ones"
    for key, what in (("outliers", "far outside of everything around"), ("missing", "missing")):
        yield from (f"{_count(n, 'value')} of {name} {_are(n)} {what}, and left out" for name, n in log.get(key, {}).items())
    yield from (
        f"{_count(n, 'reading')} of {name} {_are(n)} far outside of everything else, and replaced"
        for name, n in log.get("repaired", {}).items()
    )
    if seconds := log.get("unused"):
        yield f"{seconds:.3g} s are in stretches too short or too empty to be used"


def _places(found: Sequence[Mapping[str, Any]]) -> str:
    said = ", ".join(f"{f['at']:.6g} s" for f in found[:SHOWN])
    return f" {len(found)} times (first at {said})" if len(found) > SHOWN else f" at {said}"


def _count(n: int, noun: str) -> str:
    return f"{n:,} {noun}{'s' * (n > 1)}"


def _are(n: int) -> str:
    return "are" if n > 1 else "is"
