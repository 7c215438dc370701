"""Closed-loop runs held against what was promised: step by step, all of them as an audit, and in sentences."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal
from typing import Any, final

import numpy as np

from gapcert.plugin import Array, Bools, Box, Claim, Entry, GapFunction, Model, difference, missed, turned

STEPS = 2000
"""Steps of a policy that are held against [l, u] where none broke its promise: evaluating a gap may be dear."""
STARTS = "starts drawn uniformly where both controllers win, the target left out"


@final
@dataclass(frozen=True)
class Oracle:
    """What a step was promised from: x⁺ ∈ f(x, u) + [l, u](x, u), with angles on the turn of `states`."""

    model: Model
    gap: GapFunction
    states: Box | None = None

    def outside(self, x: Array, u: Array, after: Array) -> Bools:
        """(n,): the residual of a step that ended in `after` is outside [l, u], or no number: γ is refuted there."""
        r = difference(self.model.states, after, self.model.step(x, u).x)
        low, high = self.gap.interval(np.hstack([x if self.states is None else turned(self.states, x), u]))
        # Asked so that NaN is outside.
        return np.asarray(~((r >= low) & (r <= high)).all(axis=1))

    def judge(self, x: Array, u: Array, broken: Bools) -> dict[str, Any]:
        """Of runs x (n, steps + 1, nx), u (n, steps, nu) with their `broken` steps: which part of the promise these refute.

        `gap`: the residual is outside [l, u]. `bound`: it is inside, so the model's bound over the cell, or the synthesis, is
        wrong. `steps` of all, evenly chosen, were held against [l, u], and `outside_gap` of these lie outside: a promise may
        be kept although γ is refuted, where the cells left room.
        """
        before, after = x[:, :-1], x[:, 1:]
        made = np.argwhere(~np.isnan(u).any(axis=2))
        made = made[np.linspace(0, len(made) - 1, min(STEPS, len(made))).astype(np.int64)]
        wrong = np.argwhere(broken)
        out: dict[str, Any] = {}
        if len(made):
            i, k = made.T
            outside = self.outside(before[i, k], u[i, k], after[i, k])
            out |= {"steps_held": len(made), "outside_gap": int(outside.sum())}
        if len(wrong):
            i, k = wrong.T
            by_gap = int(self.outside(before[i, k], u[i, k], after[i, k]).sum())
            out["refuted"] = {"gap": by_gap, "bound": len(wrong) - by_gap}
        return out


def audited(failed: Bools, beta: float, steps: int, policies: tuple[str, ...], entry: Entry | None = None) -> dict[str, Any]:
    """What independent runs from drawn starts earn: with confidence 1 − β a run from a further start fails, under at least one
    of the policies, with probability ε at most. failed (starts,): under any policy. Number k of the `entry` spends β / 2^k.
    """
    n, v, spent = len(failed), int(failed.sum()), beta / 2 ** (0 if entry is None else entry.k)
    claim = Claim("statistical", largest(v, n, spent), beta, f"{STARTS} × policies {', '.join(policies)}, {steps} steps")
    warned = {} if entry is None or not entry.warnings else {"warnings": entry.warnings}
    return {**claim.summary(), "runs": n, "violations": v, **({} if entry is None else entry.summary()), **warned}


def largest(v: int, n: int, beta: float) -> float:
    """The probability that v of n draws show at confidence 1 − β not to be exceeded: the smallest ε of four digits, rounded up,
    with P(Bin(n, ε) ≤ v) ≤ β (Clopper and Pearson 1934)."""
    goal = Decimal(beta)
    return (1 + bisect_left(range(1, 10_000), True, key=lambda k: missed(v, n, k / 10_000) <= goal)) / 10_000


def loop_failures(summary: Mapping[str, Any], claim: str = "") -> list[str]:
    """The policies under which runs with γ fail, or steps refute a claim about all of Z that the controller rests on."""
    rows = [p for p in summary["policies"] if p["controller"] == "with_gamma"]
    bad = [p for p in rows if p["violations"]]
    out = [f"closed loop with γ: {p['violations']} of {p['starts']} runs fail under policy '{p['policy']}'" for p in bad]
    return out + [broken_sentence(p) for p in rows if p.get("broken_promises") and claim in ("deterministic", "assumed")]


def broken_sentence(row: Mapping[str, Any]) -> str:
    """What the broken promises of a row refute."""
    text = f"closed loop with γ: {row['broken_promises']} steps under policy '{row['policy']}' break the controller's promise"
    parts = {"gap": "γ, the residual being outside [l, u]", "bound": "the bound of the model's successors"}
    found = [f"{n} refute {parts[cause]}" for cause, n in row.get("refuted", {}).items() if n]
    return f"{text}: {' and '.join(found)}" if found else text
