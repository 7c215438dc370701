"""What controllers answer outside of their domain: an error that names axes and values, or NaN."""

from __future__ import annotations

import numpy as np

from gapcert.plugin import Array, Controller, Policy, UsageError, turned


def inside_alone(controller: Controller, nu: int, x: Array, policy: Policy, seed: int, k: int) -> Array:
    """`act` with NaN in rows outside the domain: there another row is asked in place, so that a random choice stays that of its
    row.
    """
    x = np.atleast_2d(np.asarray(x, dtype=np.float64))
    out, inside = np.full((len(x), nu), np.nan), controller.contains(x)
    if inside.any():
        out[inside] = controller.act(np.where(inside[:, None], x, x[np.argmax(inside)]), policy, seed, k)[inside]
    return out


def refusal(controller: Controller, x: Array, row: int, why: str = "", ask: str = "`contains` before `act`") -> UsageError:
    """For the state x[row] outside the domain: its axes and values, and the one that leaves `goal.stay`, if one does."""
    at, stay = np.atleast_2d(np.asarray(x, dtype=np.float64))[row : row + 1], controller.goal.stay
    state = ", ".join(f"{a.name} = {v!r}" for a, v in zip(stay.axes, at[0].tolist(), strict=True))
    told = "; ".join(filter(None, (why, stay.leaves(turned(stay, at)[0]))))
    return UsageError(f"controller: row {row}: {state} is outside its domain; ask {ask}" + (f" ({told})" if told else ""))
