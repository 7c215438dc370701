"""Units in the names of columns: `theta [deg]`, `time (ms)`."""

from __future__ import annotations

import re
from collections.abc import Iterable

_LAST = re.compile(r"(.*[^\s\[(])\s*[\[(]\s*([^\[\]()\d\s-][^\[\]()]*?)\s*[\])]\s*")


def stated_units(columns: Iterable[str]) -> dict[str, str]:
    """Column → the unit in brackets that its name ends in; columns without one, an index or another word are left out."""
    found = {name: match[2] for name in columns if (match := _LAST.fullmatch(str(name)))}
    return {name: unit for name, unit in found.items() if _known(unit)}


def without_units(columns: Iterable[str]) -> dict[str, str]:
    """Name without its unit → column; a column that has the name as it is comes before one that states a unit."""
    names = list(columns)
    bare = {match[1].strip(): name for name in stated_units(names) if (match := _LAST.fullmatch(name))}
    return {**bare, **{name: name for name in names}}


def _known(unit: str) -> bool:
    """Is it one, and one whose zero is zero?"""
    from gapcert.contracts.data.units import known_unit

    return known_unit(unit)
