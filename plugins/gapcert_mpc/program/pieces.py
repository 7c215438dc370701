"""Pieces of the best plan: while the rows that hold it back stay the same, it is affine in the start: one product."""

from __future__ import annotations

from typing import final

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg

from gapcert import Array
from gapcert_mpc.thresholds import THRESHOLDS

from .minimal_tube import Least
from .program import Program
from .solver import Piqp


@final
class Pieces:
    """z and y as affine functions of x̄₀, per set of rows that are equations there while no other row matters.

    Partial enumeration [Pannocchia, Rawlings and Wright, 2007]: an answer is one only if no row is missed by more than half the
    tolerance, and no multiplier has the wrong sign; it is a best one then, as the program is convex. What neither cost nor
    rows determine stays at the middle of the rows when x̄₀ is `aim`, or becomes as small as the trajectory allows.
    """

    def __init__(self, program: Program, kept: Array, aim: Array) -> None:
        """kept (k, rows): −1 at the lower bound, 1 at the upper, 0 where the row does not matter; equations count anyway."""
        self.program, self.least, self.aimed = program, Least(program), program.aimed
        program.begin(aim)
        centre = Piqp(program.P, program.q, program.A, program.low, program.high, program.tolerance).solve()
        made = [self._piece(active, centre.z) for active in (kept if centre.status == "solved" else kept[:0])]
        # What rules a piece out is looked at for all of them at once.
        self.ends = np.cumsum([0] + [len(sure) for _, sure, _ in made])[:-1]
        sure = np.vstack([sure for _, sure, _ in made]) if made else np.zeros((0, program.n + 1))
        self.sure, self.sure_slope = sure[:, 0].copy(), sure[:, 1:].copy()
        self.parts = [(a[:, 0].copy(), a[:, 1:].copy(), b[:, 0].copy(), b[:, 1:].copy()) for a, _, b in made]

    def __len__(self) -> int:
        return len(self.parts)

    def __call__(self, x: Array, first: int = 0) -> tuple[Array, Array, int] | None:
        """(z, y) from x̄₀ = x, and the piece; that which is asked for first where two hold. None where none does."""
        p = self.program
        # With another reference other plans are best.
        if not self.parts or p.aimed != self.aimed:
            return None
        # NaN compares as False, so that it keeps nothing.
        some = np.flatnonzero(np.maximum.reduceat(self.sure + self.sure_slope @ x, self.ends) <= 0.0).tolist()
        for k in sorted(some, key=lambda k: bool(k != first)) if len(some) > 1 else some:
            constant, slope, at, along = self.parts[k]
            found = constant + slope @ x
            z = found[: p.size]
            if p.variable or not (at + along @ x).max(initial=-1.0) <= 0.0:
                z = self.least(z)
                if not p.missed(z, x) <= p.tolerance / 2:
                    continue
            return z, found[p.size :], k
        return None

    def _piece(self, active: Array, centre: Array) -> tuple[Array, Array, Array]:
        """(z, y), what must be negative for it to hold, and what must be so for its tube to be taken as it is: maps of (1, x).

        (z, y) is the limit of the proximal method of multipliers, so that rows may depend on each other.
        """
        p = self.program
        starts = np.arange(p.start[0], p.start[0] + p.n)
        low, high = (np.hstack([b[:, None], np.zeros((len(b), p.n))]) for b in (p.low, p.high))
        for bound in (low, high):
            bound[starts] = np.eye(p.n, p.n + 1, 1)
        equal = p.low == p.high
        on = np.flatnonzero(equal | (active != 0))
        A, wanted = sp.csr_matrix(p.A)[on], np.where((active[on] > 0)[:, None], high[on], low[on])
        P = p.P + sp.triu(p.P, 1).T
        own, rows = sp.identity(p.size), sp.identity(len(on))
        factors = scipy.sparse.linalg.splu(
            sp.bmat([[P + THRESHOLDS.proximal_weight * own, A.T], [A, -THRESHOLDS.proximal_weight * rows]], format="csc")
        )
        z, y = np.hstack([centre[:, None], np.zeros((p.size, p.n))]), np.zeros((len(on), p.n + 1))
        q = np.hstack([p.q[:, None], np.zeros((p.size, p.n))])
        for _ in range(THRESHOLDS.proximal_rounds):
            found = factors.solve(np.vstack([THRESHOLDS.proximal_weight * z - q, wanted - THRESHOLDS.proximal_weight * y]))
            z, y = found[: p.size], found[p.size :]
        dual, unit, value = np.zeros((len(p.low), p.n + 1)), np.eye(1, p.n + 1), p.A @ z
        dual[on] = y
        side = np.flatnonzero(~equal[on])
        signs = -np.sign(active[on[side]])[:, None] * y[side] - THRESHOLDS.multiplier_error * unit
        # Rows of the trajectory alone tell at once; those of its tube may still hold with a smaller one.
        alone = np.diff(sp.csr_matrix(p.A[:, p.at["size"][0] :]).indptr) == 0
        missed = [sign * (value - bound) - p.tolerance / 2 * unit for sign, bound in ((1, high), (-1, low))]
        sure = [signs, *(by[alone & np.isfinite(by[:, 0])] for by in missed)]
        rest = [by[~alone & np.isfinite(by[:, 0])] for by in missed]
        return np.vstack([z, dual]), np.vstack(sure), np.vstack(rest)


def active(program: Program, z: Array, y: Array) -> Array:
    """Which rows hold an exact answer back: those nearer to their bound than their multiplier is to 0; −1, 0 or 1 (rows,)."""
    value = program.A @ z
    near = np.minimum(value - program.low, program.high - value) < np.abs(y)
    return np.where((program.low == program.high) | ~near, 0, np.sign(y)).astype(np.int8)
