"""Arrays in JSON, small: evenly spaced ones as three numbers, steps as runs, others as float32 in base64."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

from gapcert.plugin import Array


def packed(values: Array) -> dict[str, Any]:
    """{n, first, step}; {runs} of (whole number or None, how often); or {offset, f32}: seven digits of every value, where all
    are close of its distance from the offset. NaN stands for what is not there.
    """
    values = np.asarray(values, float).ravel()
    known = values[np.isfinite(values)]
    n, wide, top = len(values), float(np.ptp(known)) if len(known) else 0.0, float(np.abs(known).max(initial=0.0))
    if n > 2 and len(known) == n:
        first, step = float(values[0]), float(values[-1] - values[0]) / (n - 1)
        if np.allclose(values, first + step * np.arange(n), rtol=0, atol=1e-9 * max(wide, 1e-3 * top)):
            return {"n": n, "first": first, "step": step}
    starts = np.flatnonzero(np.append(True, ~((values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1])))))
    if 4 * len(starts) < n and (known == np.round(known)).all():
        counts = np.diff(np.append(starts, n)).tolist()
        return {"runs": [[None if np.isnan(v) else int(v), c] for v, c in zip(values[starts], counts, strict=True)]}
    offset = float(known[0]) if top > 100 * wide else 0.0
    return {"offset": offset, "f32": base64.b64encode((values - offset).astype("<f4").tobytes()).decode()}
