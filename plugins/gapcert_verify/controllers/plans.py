"""What a model predictive controller stores, proved once more: lines and what they leave out, the tube's sections, its end.

In the frame of the goal's box and the domain's inputs a stage says x⁺ = A x + B u + d + w with |w| ≤ c + G |F(z − ẑ)|. Solvers
answer as a run goes on, and each answer is checked then; what they are asked rests on these numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from gapcert.plugin import Array, Box, Zone
from gapcert_verify.evaluator import Equations

from .gap_bounds import Gap
from .lines import SPARE, Line

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
        if (low < np.asarray(self.zone.low) - spare).any() or (high > np.asarray(self.zone.high) + spare).any():
            return "its frame reaches beyond the certificate's domain, where no gap is known"
        C, top = self.arrays["rows.C"], self.arrays["rows.high"]
        for relation, a, b in zip(self.zone.relations, self.zone.matrix, self.zone.bounds, strict=True):
            own = a * half
            size = np.abs(own).max()
            room = (b - a @ middle) / size + 1e-9
            same = (np.abs(C - own / size) <= 1e-9).all(axis=1) & (top <= room)
            if not same.any() and np.abs(own / size).sum() > room:  # the box itself may keep it
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
            if not (np.isfinite(one["c"]) & (one["c"] >= 0)).all() or not (one["G"] >= 0).all():
                return f"stage {k}: its bounds are negative or not finite"
            frame = self.arrays["frame.middle"], self.arrays["frame.half"]
            if text := Line(one, frame, self.features, self.zone, self.model, self.gap).proved(k):
                return text
        return ""

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
