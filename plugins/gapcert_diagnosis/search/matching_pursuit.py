"""Columns of a table of gains that are taken one after another, and what each that is left promises beside those."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array
from gapcert_diagnosis.thresholds import THRESHOLDS

from .candidates import Candidate, Library

Rows = npt.NDArray[np.intp]


@final
@dataclass(frozen=True)
class Columns:
    """Candidates that push; of every column whose it is, which of its starts, its rows (N, K), what starts see, its bounds."""

    known: Sequence[Candidate]
    owner: Rows
    inner: Rows
    rows: Array
    seen: Array
    limits: Array

    def of(self, c: Candidate) -> npt.NDArray[np.bool_]:
        """Which columns (K,) are those of a candidate."""
        return np.asarray(np.array([k.key == c.key for k in self.known], dtype=bool)[self.owner])


@final
class MatchingPursuit:
    """Orthogonal matching pursuit.

    With curvature c, slope s and i the column that is taken, c − cᵢᵢ⁻¹ cᵢcᵢᵀ and s − cᵢᵢ⁻¹ sᵢcᵢ are left.
    """

    def __init__(
        self, library: Library, columns: Columns, slopes: Array, inverse: Array, along: Array, residual: Array
    ) -> None:
        """slopes (N, p), with the inverse of their normal equations, and the residual (N, 1) of a table."""
        self.library, self.columns, rows, seen = library, columns, columns.rows, columns.seen
        self.cross = rows.T @ slopes
        self.pulled = self.cross @ inverse
        self.slope = self.pulled @ along - (rows.T @ residual)[:, 0]
        own = np.einsum("ij,ij->j", rows, rows) - np.einsum("ij,ij->j", seen, seen)
        self.curve = own - np.einsum("ij,ij->i", self.pulled, self.cross)
        self.least = np.maximum((1 - THRESHOLDS.alike_columns**2) * self.curve, 1e-9)
        self.open = np.ones(len(self.curve), dtype=bool)
        self.picks: list[int] = []
        self._gone: list[Array] = []

    def gains(self) -> Array:
        """What each column (K,) promises beside those that are taken: nothing, if it is alike or at odds with one of them."""
        usable, limits = self.open & (self.curve > self.least), self.columns.limits
        a = np.divide(self.slope, self.curve, out=np.zeros_like(self.slope), where=usable)
        a = np.clip(a, limits[:, 0], limits[:, 1])
        return np.where(usable, 2 * a * self.slope - a**2 * self.curve, 0.0)

    def best(self) -> int | None:
        """The column that promises most; of laws that contain one another the simplest that promises nearly as much."""
        gains, known, owner = self.gains(), self.columns.known, self.columns.owner
        if gains.max(initial=0.0) <= 0:
            return None
        i = int(np.argmax(gains))
        inside = [o for o, c in enumerate(known) if self.library.within(c, known[int(owner[i])])]
        kin = np.flatnonzero(np.isin(owner, inside) & (gains > THRESHOLDS.even_promise * gains[i])).tolist()
        return min([i, *kin], key=lambda k: (self.library.simplicity((known[int(owner[k])],))[0], -gains[k]))

    def take(self, i: int) -> None:
        e = self.columns
        own = e.rows.T @ e.rows[:, i] - e.seen.T @ e.seen[:, i] - self.pulled @ self.cross[i]
        column = (own - sum((g * g[i] for g in self._gone), np.zeros_like(own))) / math.sqrt(self.curve[i])
        self.slope, self.curve = self.slope - column * (self.slope[i] / column[i]), self.curve - column**2
        self.picks, self._gone = [*self.picks, i], [*self._gone, column]
        c = e.known[int(e.owner[i])]
        # Not twice the same law at one site.
        at_odds = np.array([self.library.related(k, c) for k in e.known])
        self.open = self.open & ~at_odds[e.owner]
