"""Limits of how fast inputs may change, as rows of the program."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from gapcert import Array, Domain, UsageError
from gapcert.plugin import magnitude

if TYPE_CHECKING:
    from .program import Program, Table

LOOSE = 1e3  # half-ranges: a bound that asks nothing, and a finite one leaves the row of its kind


def limits(rates: Mapping[str, float | str], domain: Domain, half: Array | float = 1.0) -> Array | None:
    """(m,): the largest change of each input per step in units of `half`, infinite for those not named; None where none is."""
    out = np.full(len(domain.inputs.names), np.inf)
    for name, value in rates.items():
        if name not in domain.inputs.names:
            raise UsageError(f"controller.rates: '{name}' is no input; expected some of {', '.join(domain.inputs.names)}")
        j = domain.inputs.names.index(name)
        try:
            out[j] = magnitude(value, domain.inputs.axes[j].unit)
        except ValueError as error:
            raise UsageError(f"controller.rates.{name}: {error}") from None
        if not 0 < out[j] < np.inf:
            raise UsageError(f"controller.rates.{name}: found {value}; expected a positive change per period")
    return out / half if rates else None


def limit(program: Program, table: Table, rates: Array) -> Array:
    """Rows that keep |u_k − u_{k−1}| ≤ r on the tubes; the first of those that the input before asks of ū₀.

    With W_k = c + G(a_k + |E| s_k) and ū_N = u_s + K(x̄_N − x_s): |ū_{k+1} − ū_k| + D s_k + |K| W_k ≤ r for k < N, and
    Dσ + |K| W_s ≤ r; each tightened by ε. rates (m,) in half-ranges, infinite where an input may jump.
    """
    on = np.flatnonzero(np.isfinite(rates))
    N, at, st, sec, eps = program.N, program.at, program.stages, program.section, program.tolerance
    K, one = sec.K[on], np.eye(program.m)[on]
    size = np.abs(K)
    # Each equation of the dynamics may be missed by ε, which is as much more of w.
    room = rates[on] - eps - (st.c + eps) @ size.T
    spread = size @ st.G
    D, far = sec.turning(st.A + st.B @ sec.K)[:, on] + spread @ np.abs(program.F @ sec.feedback), spread[:, :, program.on]
    start = table.rows(-rates[on][None], rates[on][None])
    table.put("rate-start", start, at["u"][:1], one)
    base, more, per = program.terminal
    for sign, word in ((1.0, "above"), (-1.0, "below")):
        high = room[:N] - (D[:N] @ program.constant[:N, :, None])[..., 0]
        first = table.rows(np.full_like(high, -np.inf), high)
        table.put(f"rate-{word}", first, at["u"], -sign * one)
        table.put(f"rate-{word}-next", first[: N - 1], at["u"][1:], sign * one)
        table.put(f"rate-{word}-us", first[N - 1 :], at["us"], sign * one)
        table.put(f"rate-{word}-x", first[N - 1 :], at["x"][N:], sign * K)
        table.put(f"rate-{word}-xs", first[N - 1 :], at["xs"], -sign * K)
        if program.variable:
            table.put(f"rate-{word}-a", first, at["a"][:N], far[:N])
            table.put(f"rate-{word}-s", first[1:], at["s"][: N - 1], D[1:N])
    high = (room[N] - D[N] @ base)[None]
    ends = table.rows(np.full_like(high, -np.inf), high)
    table.put("rate-set-size", ends, at["size"], D[N] @ more)
    if program.variable:
        table.put("rate-set-a", ends, at["a"][-1:], D[N] @ per + far[N])
    program.final = np.append(program.final, ends[0] + np.arange(len(on)))
    return np.asarray(start[0] + np.arange(len(on)))


def begins(program: Program, rates: Array, before: Array | None) -> None:
    """|ū₀ − u| + W s₀ ≤ r for the input u (m,) of the step before; nothing is asked where there was none."""
    on = np.flatnonzero(np.isfinite(rates))
    room = np.full(len(on), LOOSE)
    if before is not None:
        room = rates[on] - program.tolerance - program.section.support[program.n :][on] @ program.s0
    middle = 0.0 if before is None else before[on]
    program.low[program.changes], program.high[program.changes] = middle - room, middle + room
