"""Columns of a log as numbers, or the first value in them that is none."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from gapcert.numerics.arrays import Array
from gapcert.numerics.errors import clipped

Place = Callable[[str, int], str]
"""(name of a table, row counted from 0) → where that row stands, in words."""
LACKING = frozenset({"", "na", "n/a", "#n/a", "nan", "null", "none"})
"""Texts that stand for a value that is missing."""


def as_numbers(values: Any) -> Array | None:
    """A column (n,) as numbers, with NaN for what is missing (None, empty, `NA`, `NaN`); None where it holds anything else."""
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        if first_text(values) is not None:
            return None
        return np.array([np.nan if _lacking(v) else float(v) for v in values])


def first_text(values: Any) -> tuple[int, str] | None:
    """(row counted from 0, the value) of the first that is neither a number nor missing."""
    for row, value in enumerate(values):
        if _lacking(value):
            continue
        try:
            float(value)
        except (TypeError, ValueError):
            return row, clipped(str(value), longest=40)[0]
    return None


def counted(table: str, row: int) -> str:
    """Where a row stands, of a file that has no lines."""
    return f"row {row + 1}"


def _lacking(value: Any) -> bool:
    return value is None or (isinstance(value, str) and value.strip().lower() in LACKING)
