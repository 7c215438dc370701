"""What a model predictive controller stores, proved once more: lines and what they leave out, the tube's sections, its end.

In the frame of the goal's box and the domain's inputs a stage says x⁺ = A x + B u + d + w with |w| ≤ c + G |F(z − ẑ)|. Solvers
answer as a run goes on, and each answer is checked then; what they are asked rests on these numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np

from gapcert.plugin import Array, Box, Interval, Zone
from gapcert_verify import arithmetic as ar
from gapcert_verify.evaluator import Equations

from .gap_bounds import Gap

MOST = 400_000  # boxes that a stage's bound may be cut into
BATCH = 1 << 13
SPARE = 1e-9  # of the frame: far below what a solver may miss a row by, which is counted as disturbance
DEFECT = 1e-8  # of products that are to be the identity, or to be equal


@final
@dataclass(frozen=True)
class Plans:
    """The stored arrays by name; stay: the goal's box. Of zone, in (x, u), the relations count, and the inputs' box."""

    arrays: Mapping[str, Array]
    stay: Box
    zone: Zone
    model: Equations
    gap: Gap

    @cached_property
    def box(self) -> tuple[Array, Array]:
        """[low, high] of states and inputs."""
        nx = len(self.stay.low)
        low, high = (np.asarray(end) for end in (self.zone.low, self.zone.high))
        return np.concatenate([self.stay.low, low[nx:]]), np.concatenate([self.stay.high, high[nx:]])

    def framed(self) -> str:
        """The frame is the goal's box with the domain's inputs, and the relations are rows of it."""
        (low, high), middle, half = self.box, self.arrays["frame.middle"], self.arrays["frame.half"]
        nx = len(self.stay.low)
        if int(self.arrays["frame.nx"]) != nx or middle.shape != low.shape or half.shape != low.shape:
            return f"its frame has {middle.shape} numbers for {len(low)} states and inputs"
        spare = 1e-12 * (high - low)
        if (np.abs(middle - half - low) > spare).any() or (np.abs(middle + half - high) > spare).any():
            return "its frame is not the box of the goal and of the inputs"
        C, top = self.arrays["rows.C"], self.arrays["rows.high"]
        for relation, a, b in zip(self.zone.relations, self.zone.matrix, self.zone.bounds, strict=True):
            own = a * half
            size = np.abs(own).max()
            same = (np.abs(C - own / size) <= 1e-9).all(axis=1) & (top <= (b - a @ middle) / size + 1e-9)
            if not same.any():
                return f"{relation.text} is no row of its programs"
        if (self.arrays["reference"].shape, float(self.arrays["tolerance"]) > 0) != (low.shape, True):
            return "its reference or its tolerance are none"
        return ""

    @property
    def features(self) -> Array:
        """F (f, nz): what the uncertainty depends on."""
        name = next((f"{part}.F" for part in ("scene", "ends") if f"{part}.F" in self.arrays), None)
        return np.eye(len(self.box[0])) if name is None else np.asarray(self.arrays[name])

    @property
    def successive(self) -> bool:
        """Are lines made about each plan as it is made, so that the last stage alone is stored?"""
        return bool(self.arrays["successive"])

    def covered(self) -> str:
        """At every stage w bounds what the line leaves out, and the gap, over X × U."""
        stages = {name: self.arrays[f"stages.{name}"] for name in ("A", "B", "d", "c", "G", "centre", "low", "high")}
        seen = list[list[Array]]()
        for k in range(len(stages["A"]) - 1 if self.successive else 0, len(stages["A"])):
            one = {name: a[k] for name, a in stages.items()}
            if any(all(np.array_equal(a, b) for a, b in zip(one.values(), old, strict=True)) for old in seen):
                continue
            seen.append(list(one.values()))
            if not self.successive and (np.abs(one["low"] + 1).max() > SPARE or np.abs(one["high"] - 1).max() > SPARE):
                return f"stage {k} is bounded on a part of the box alone"
            if text := self._stage(k, one):
                return text
        return ""

    def _stage(self, k: int, s: Mapping[str, Array]) -> str:
        """Boxes are halved where the largest |w| may exceed what is counted, along what it depends on most."""
        line = np.concatenate([s["A"], s["B"]], axis=1)
        if not (np.isfinite(s["c"]) & (s["c"] >= 0)).all() or not (s["G"] >= 0).all():
            return f"stage {k}: its bounds are negative or not finite"
        boxes = [np.concatenate([s["low"][None], s["high"][None]])[:, None]]
        spent = 0
        while boxes:
            low, high = boxes.pop()
            spent += len(low)
            if spent > MOST:
                return f"stage {k}: that its bounds hold was not proved with {MOST:,} boxes"
            inside = ~self._outside(low, high)
            low, high = low[inside], high[inside]
            if not len(low):
                continue
            left, weight = self._left_out(low, high, line, s["d"])
            room = s["c"] + self._distance(low - s["centre"], high - s["centre"]) @ s["G"].T + SPARE
            wrong = ~((left.hi <= room) & (-left.lo <= room)).all(axis=1)
            low, high = low[wrong], high[wrong]
            if not len(low):
                continue
            if (text := self._refuted(k, low, high, line, s)) is not None:
                return text
            j, at = np.argmax((high - low) * (weight[wrong] + 1e-12), axis=1), np.arange(len(low))
            middle = (low / 2 + high / 2)[at, j]
            below, above = high.copy(), low.copy()
            below[at, j] = above[at, j] = middle
            parts = np.concatenate([low, above]), np.concatenate([below, high])
            boxes += [np.stack([p[a : a + BATCH] for p in parts]) for a in range(0, len(parts[0]), BATCH)]
        return ""

    def _refuted(self, k: int, low: Array, high: Array, line: Array, s: Mapping[str, Array]) -> str | None:
        """A point at which more is left out for certain."""
        z = low / 2 + high / 2
        left, _ = self._left_out(z, z, line, s["d"])
        room = s["c"] + np.abs((z - s["centre"]) @ self.features.T) @ s["G"].T
        over = np.maximum(left.lo, -left.hi) > room + 2 * SPARE
        if not over.any():
            return None
        row, i = np.argwhere(over)[0]
        at = (self.arrays["frame.middle"] + self.arrays["frame.half"] * z[row]).tolist()
        return f"stage {k}: at {at} state {i} goes farther from the line than the tube counts"

    def _left_out(self, low: Array, high: Array, line: Array, d: Array) -> tuple[Interval, Array]:
        """(w, weight): what the line and an offset leave out over boxes of the frame, (n, nx), and how much each axis matters.

        By the mean-value theorem about the boxes' middles: F(z) − line(z) at c, and (F′ − line)(z − c).
        """
        middle, half, nx = Interval.exact(self.arrays["frame.middle"]), self.arrays["frame.half"], len(d)
        box = middle + Interval(low, high) * Interval.exact(half)
        c = low / 2 + high / 2
        at = middle + Interval.exact(c) * Interval.exact(half)
        rest, slope, offset = self.gap.apart(box.lo, box.hi)
        reach = Interval.around(0.0, np.maximum(high - c, c - low))
        out, weight = list[Interval](), np.zeros_like(low)
        for k in range(nx):
            f = ar.known(self.model.over(at.lo, at.hi, self.model.terms[k]))
            J = ar.known(self.model.slopes(box.lo, box.hi, self.model.terms[k]))
            p = (at * Interval.exact(slope[k])).sum(-1) + float(offset[k])
            value = (Interval(*f) + p - float(self.arrays["frame.middle"][k])) / float(half[k])
            straight = (Interval.exact(c) * Interval.exact(line[k])).sum(-1) + float(d[k])
            bent = (Interval(*J) + Interval.exact(slope[k])) * Interval.exact(half) / float(half[k]) - Interval.exact(line[k])
            out.append(value - straight + (bent * reach).sum(-1) + rest[:, k] / float(half[k]))
            mag = np.nan_to_num(bent.mag, nan=1e6, posinf=1e6)
            if self.gap.slopes is not None:
                mag = mag + self.gap.slopes[k] * half / half[k]
            weight = np.maximum(weight, mag)
        return Interval.stack(out, axis=1), weight

    def _distance(self, low: Array, high: Array) -> Array:
        """(n, f): the least |F z| over boxes."""
        F = self.features
        ends = (Interval(low, high)[:, None, :] * Interval.exact(F)).sum(-1)
        return np.asarray(abs(ends).lo)

    def _outside(self, low: Array, high: Array) -> Any:
        """(n,): a box meets no point that the relations leave, for certain."""
        middle, half = Interval.exact(self.arrays["frame.middle"]), Interval.exact(self.arrays["frame.half"])
        return self.zone.outside(middle + Interval(low, high) * half)

    def sections(self) -> str:
        """P H = 1, Λ H = H (A + BK) of the first stage, and as much of another one: so |H e| ≤ s stays within |Λ| s."""
        H, P, K, closed, moved = (self.arrays[f"section.{n}"] for n in ("H", "P", "K", "closed", "moved"))
        A, B = self.arrays["stages.A"], self.arrays["stages.B"]
        n = len(A[0])
        if H.ndim != 2 or H.shape[1] != n or P.shape != H.T.shape or K.shape != B[0].T.shape or moved.shape != (len(H),) * 2:
            return f"sections of shape {H.shape} are none of {n} states"
        first = 0 if not self.successive else len(A) - 1
        made = A[first] + B[first] @ K
        for found, wanted, what in (
            (P @ H, np.eye(n), "the half-widths do not follow from its sections"),
            (moved @ H, H @ closed, "its sections are not moved as stated"),
            (closed if not self.successive else made, made, "they are not those of its gain and its line"),
        ):
            if not np.abs(found - wanted).max() <= DEFECT * max(1.0, np.abs(wanted).max()):
                return f"the tube's sections: {what}"
        return ""

    def terminal(self) -> str | None:
        """{|H (x − x_s)| ≤ σ} is kept by u_s + K (x − x_s), and all of it in the rows; None where plans end elsewhere.

        σ = (1 − M)⁻¹ |H| (c + G a + ε) with M = |Λ| + |H| G |F [P; KP]|, a = |F(z_s − ẑ)|.
        """
        if any(name.startswith(("scene.", "ends.")) for name in self.arrays):
            return None
        H, P, K, closed, moved = (self.arrays[f"section.{n}"] for n in ("H", "P", "K", "closed", "moved"))
        A, B, d, c, G, centre = (self.arrays[f"stages.{n}"][-1] for n in ("A", "B", "d", "c", "G", "centre"))
        n, size, feedback, eps = len(A), np.abs(H), np.vstack([P, K @ P]), float(self.arrays["tolerance"])
        course = self.arrays.get("course.references")
        for z in [self.arrays["reference"], *(() if course is None else course)]:
            off = np.abs(A @ z[:n] + B @ z[n:] + d - z[:n]).max()
            if not off <= eps:
                return f"its steady pair moves by {off:.3g} of the frame"
            grown = np.abs(moved + H @ (A + B @ K - closed) @ P) + size @ G @ np.abs(self.features @ feedback)
            spread = size @ (c + G @ np.abs(self.features @ (z - centre)) + eps)
            sigma = np.linalg.solve(np.eye(len(H)) - grown, spread)
            if not (sigma > 0).all() or not (grown @ sigma + spread <= sigma * (1 + SPARE) + SPARE).all():
                return "no size of its sections is kept around its steady pair: the terminal set is not invariant"
            if text := self._room(z, np.abs(np.vstack([np.eye(len(z)), self.arrays["rows.C"]]) @ feedback) @ sigma):
                return text
        return ""

    def _room(self, z: Array, wide: Array) -> str:
        """All of the terminal set is within the frame, the box of its stage, and the rows."""
        low, high = np.maximum(self.arrays["stages.low"][-1], -1.0), np.minimum(self.arrays["stages.high"][-1], 1.0)
        at = np.concatenate([z, self.arrays["rows.C"] @ z])
        low, high = np.append(low, self.arrays["rows.low"]), np.append(high, self.arrays["rows.high"])
        out = (at - wide < low - SPARE) | (at + wide > high + SPARE)
        return f"its terminal set reaches beyond row {int(np.argmax(out))} of what it is to keep" if out.any() else ""

    def ends(self) -> Sequence[Box]:
        """The boxes in which plans end, in the units of the model; none where they end around a steady pair."""
        middle, half = (self.arrays[f"frame.{n}"][: len(self.stay.low)] for n in ("middle", "half"))
        boxes = self.arrays.get("ends.boxes", np.empty((0, 2, len(middle))))
        return [Box(self.stay.axes, *(tuple((middle + half * end).tolist()) for end in box)) for box in boxes]
