"""What a log could show: of every effect the smallest size that would be named, and which effects look alike in it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import final

import numpy as np

from gapcert.plugin import Array, Bools
from gapcert_diagnosis.results import Seen
from gapcert_diagnosis.thresholds import THRESHOLDS

from .candidates import Candidate
from .criterion import noise
from .fitted_sets import FittedSets
from .gains import Column, GainTable

Key = tuple[str, str]


@final
class Visible:
    """What the windows of a search would show, by the linearised motion, were noise alone left of them."""

    def __init__(self, search: FittedSets) -> None:
        fit = search.nothing
        if not noise(fit, THRESHOLDS.sure_errors):
            white = np.random.default_rng(0).standard_normal(fit.residual.shape)
            fit = replace(fit, residual=white * fit.windows.weight)
        self.library, self.screen, self.fit = search.library, search.screen, fit
        self.table: GainTable
        (self.table,) = self.screen.tables([(fit, 1)])
        # Windows that are not screened say as much again.
        self.more = len(search.windows) / len(self.screen.windows)
        self.counts = np.sum(self.screen.windows.weight**2, axis=(0, 1))
        self._rows: dict[Key, int] = {}

    def needed(self, column: Column) -> tuple[Array, Array]:
        """Curvatures (g,) from which a cause pays for itself, and from which it is plain whatever its share of the effort."""
        ny, count = len(self.counts), column.rows.shape[1]
        energy = np.sum(column.rows.reshape(-1, ny, count) ** 2, axis=0)
        part = energy / np.maximum(energy.sum(axis=0), 1e-300)
        score = self.library.charge() / np.maximum(self.fit.whiteness @ part * self.more, 1e-300)
        per_channel = np.maximum((part / np.maximum(self.counts, 1)[:, None]).max(axis=0), 1e-300)
        fall = THRESHOLDS.least_fall / (1 - THRESHOLDS.least_fall)
        return np.maximum(score, fall / per_channel), (THRESHOLDS.plain_residual**2 - 1) / per_channel

    @cached_property
    def seen(self) -> tuple[Seen, ...]:
        """The smallest size of every candidate that would be named, within the bounds of a search."""
        out = []
        for c in self.library.candidates:
            (low, high), found = self.library.bounds(c), self.least(c)
            if not c.effect.variant_of and found is not None and (found >= low).all() and (found <= high).all():
                k = self.library.amplitude(c) or 0
                value, off = float(found[k]), self.library.off(c)[k]
                # A size of either sign is told as a positive one.
                value = 2 * off - value if low[k] <= 2 * off - value <= high[k] and value < off else value
                told = off if 0 < abs(off) <= max(abs(low[k]), abs(high[k])) else None
                unit = self.library.units(c)[k]
                share = self.share(c, found)
                beside = share if share < THRESHOLDS.no_effort else None
                out.append(Seen(*c.key, c.effect.parameters[k].name, value, unit, beside, told))
        return tuple(out)

    def least(self, c: Candidate) -> Array | None:
        """The smallest values of a candidate that would be named: they pay, and are not negligible or plain all the same.

        What looks like it may be tried in its place, and must not be negligible either.
        """
        if (found := self._paying.get(c.key)) is None or self.library.freed(c) is not None:
            return found
        mates = next((g for g in self.alike if c.key in g), (c.key,))
        needed, plain = (float(a[self._rows[c.key]]) for a in self.needed(self.table.columns[c.key]))
        short = max(self._short(k) for k in self.library.candidates if k.key in mates)
        return self._of_curve(c, min(max(1.0, short), math.sqrt(max(plain / needed, 1.0))))

    def share(self, c: Candidate, values: Array) -> float:
        """Of the effort at its site, of the spread of its output, or of the stated value, where it does most."""
        if (freed := self.library.freed(c)) is not None:
            return abs(float(values[0]) - freed.value) / (abs(freed.value) or freed.tolerance or 1.0)
        return self.screen.share(c, dict(zip(self.library.names(c), values.tolist(), strict=True)))

    def _short(self, c: Candidate) -> float:
        """How many times larger than what pays a candidate must be, not to be negligible."""
        if self.library.freed(c) is not None:
            return 1.0
        least = THRESHOLDS.least_output if c.effect.site == "output" else THRESHOLDS.least_effort
        return least / max(self.share(c, self._paying[c.key]), 1e-300)

    @cached_property
    def _paying(self) -> dict[Key, Array]:
        """The smallest values of candidates that pay for themselves."""
        found: dict[Key, Array | None] = {}
        for c in self.library.candidates:
            if self.library.loosened(c) is not None:
                found[c.key] = self.table.least_freed(c, self.library.charge())
            else:
                found[c.key] = self._of_curve(c, 1.0, finer=self.library.amplitude(c) is None)
        return {k: v for k, v in found.items() if v is not None}

    def _of_curve(self, c: Candidate, times: float, finer: bool = False) -> Array | None:
        """The smallest values that do `times` as much as what pays; finer: smaller ones than those of the grid are tried."""
        column, k, off = self.table.columns[c.key], self.library.amplitude(c), np.array(self.library.off(c))
        wanted, moves = times**2 * self.needed(column)[0], self._moves(column)
        if k is not None:
            rows = np.flatnonzero(moves)
            scale = np.sqrt(wanted[rows] / column.curve[rows])
        else:
            rows = np.flatnonzero(moves & (column.curve >= wanted))
            scale = np.ones(len(rows))
        if not len(rows):
            return None
        best = int(np.argmin(np.abs(column.values[rows, k or 0] - off[k or 0]) * scale))
        self._rows[c.key] = i = int(rows[best])
        least: Array = column.values[i].copy()
        if k is not None:
            least[k] = off[k] + (least[k] - off[k]) * scale[best]
        elif finer:
            ladder = THRESHOLDS.smaller_sizes ** np.arange(1, THRESHOLDS.smaller_rungs + 1)[:, None]
            tried, (low, high) = least * np.where(off > least, 1 / ladder, ladder), self.library.bounds(c)
            tried = tried[((tried >= low) & (tried <= high)).all(axis=1)]
            if len(tried):
                self.table.enter([self.screen.pushed(c, tried)])
            return self._of_curve(c, times)
        return least

    def _moves(self, column: Column) -> Bools:
        """Which columns are more than what starts and free numbers can make of them, and rounding."""
        return np.asarray(column.curve > THRESHOLDS.told_by_products * np.sum(column.rows**2, axis=0))

    @cached_property
    def alike(self) -> tuple[tuple[Key, ...], ...]:
        """Classes of candidates of which each looks like each other one, at some of its values; the simplest first.

        A law that contains another one looks like that, and is in no class.
        """
        known = [c for c in self.library.candidates if c.key in self._paying]
        known = [c for c in known if not any(self.library.within(e, c) for e in known)]
        known.sort(key=lambda c: self.library.simplicity((c,)))
        same = self._cosines(known) > THRESHOLDS.alike_columns
        classes: list[list[int]] = []
        for i in range(len(known)):
            own = [g for g in classes if all(same[i, k] for k in g)]
            if own:
                max(own, key=len).append(i)
            else:
                classes.append([i])
        return tuple(tuple(known[i].key for i in g) for g in classes if len(g) > 1)

    def _cosines(self, known: Sequence[Candidate]) -> Array:
        """(n, n): how nearly one of two candidates, at some of its values, copies the other at its smallest size."""
        t, names, out = self.table, self.fit.hypothesis.names, np.zeros((len(known), len(known)))
        laws = [i for i, c in enumerate(known) if c.key in self._rows]
        columns = [t.columns[known[i].key] for i in laws]
        freed = [(i, names.index(n)) for i, c in enumerate(known) if (n := self.library.loosened(c)) in names and n]
        if laws:
            rows, seen = (np.concatenate([getattr(k, n) for k in columns], axis=1) for n in ("rows", "seen"))
            first = np.cumsum([0, *(k.rows.shape[1] for k in columns[:-1])])
            own = first + [self._rows[known[i].key] for i in laws]
            cross, usable = rows.T @ t.slopes, np.concatenate([self._moves(k) for k in columns])
            bare = np.einsum("ij,ij->j", rows, rows) - np.einsum("ij,ij->j", seen, seen)
            dot = rows[:, own].T @ rows - seen[:, own].T @ seen - cross[own] @ t.inverse @ cross.T
            size = np.where(usable, bare - np.einsum("gi,ij,gj->g", cross, t.inverse, cross), np.inf)
            out[np.ix_(laws, laws)] = np.maximum.reduceat(_cosine(dot, size[own][:, None], size), first, axis=1)
        for i, k in freed:
            without = t.without([k])
            left = float(t.normal[k, k] - t.normal[k] @ without @ t.normal[k])
            if laws:
                rest = np.where(usable, bare - np.einsum("gi,ij,gj->g", cross, without, cross), np.inf)
                out[i, laws] = np.maximum.reduceat(_cosine(cross[:, k] - cross @ without @ t.normal[k], left, rest), first)
            for j, m in freed:
                both = t.without([k, m])
                dot, a, b = (t.normal[p, q] - t.normal[p] @ both @ t.normal[q] for p, q in ((k, m), (k, k), (m, m)))
                out[i, j] = float(_cosine(np.asarray(dot), a, np.asarray(b)))
        return np.maximum(out, out.T)


def _cosine(dot: Array, one: Array | float, other: Array) -> Array:
    return np.asarray(np.abs(dot) / np.sqrt(np.maximum(one * other, 1e-300)))


def smallest(search: FittedSets) -> tuple[Seen, ...]:
    """What each effect would have had to be, to be named in these data."""
    return Visible(search).seen
