"""Batches as columns, one per number of a row, which is what programs compute with."""

from __future__ import annotations

from typing import Any

import numpy as np

from gapcert import Array, Interval

Columns = list[Any]


def split(rows: Array) -> Columns:
    """(n, columns) as contiguous columns."""
    return list(np.ascontiguousarray(rows.T))


def stacked(columns: Columns, n: int) -> Array:
    """Columns, some of them constant, as (n, columns)."""
    out = np.empty((n, len(columns)))
    for j, c in enumerate(columns):
        out[:, j] = c
    return out


def boxes(columns: Columns, n: int) -> Interval:
    """Columns of Intervals."""
    return Interval(stacked([c.lo for c in columns], n), stacked([c.hi for c in columns], n))
