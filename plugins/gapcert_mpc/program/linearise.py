"""The nominal map F = f + p about a point, and what bounds everything that its straight line leaves out."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import final

import numpy as np

import gapcert
from gapcert.plugin import Arithmetic, Array, Bools, Box, Domain, GapFunction, Interval, Model, circle, majorant_of
from gapcert_mpc.thresholds import THRESHOLDS


@final
@dataclass(frozen=True)
class Frame:
    """Coordinates ζ = (z − middle) / half of states and inputs, in which a box is [−1, 1]. nx of them are states."""

    middle: Array
    half: Array
    nx: int

    @classmethod
    def of(cls, low: Array, high: Array, nx: int) -> Frame:
        return cls((low + high) / 2, (high - low) / 2, nx)

    def into(self, z: Array) -> Array:
        return np.asarray((z - self.middle) / self.half)

    def out(self, zeta: Array) -> Array:
        return np.asarray(self.middle + self.half * zeta)

    @property
    def ends(self) -> tuple[Array, Array]:
        """(low, high) of the box, and of what rounding makes of it."""
        return self.middle - self.half * (1 + 1e-9), self.middle + self.half * (1 + 1e-9)

    @property
    def x(self) -> tuple[Array, Array]:
        """(middle, half) of the states alone."""
        return self.middle[: self.nx], self.half[: self.nx]

    @property
    def u(self) -> tuple[Array, Array]:
        """(middle, half) of the inputs alone."""
        return self.middle[self.nx :], self.half[self.nx :]


@final
@dataclass(frozen=True)
class Stages:
    """x⁺ = A x + B u + d + w with |w_i| ≤ c_i + Σ_j G_ij |z_j − centre_j| for z in [low, high], per stage, in a Frame.

    A (N+1, n, n), B (N+1, n, m), d and c (N+1, n), G (N+1, n, n+m), centre, low and high (N+1, n+m); the last is
    the terminal one.
    """

    A: Array
    B: Array
    d: Array
    c: Array
    G: Array
    centre: Array
    low: Array
    high: Array

    @property
    def horizon(self) -> int:
        return len(self.A) - 1

    @property
    def first(self) -> tuple[Array, Array, Array, Array]:
        """(A, B, c, G) of the first of them, which a tube is made for."""
        return self.A[0], self.B[0], self.c[0], self.G[0]

    def repeated(self, count: int) -> Stages:
        """The first of them `count` times."""
        return self.taken(np.zeros(count, dtype=np.int64))

    def taken(self, which: Array) -> Stages:
        """Those of these numbers."""
        return Stages(*(getattr(self, f.name)[which] for f in fields(self)))

    def then(self, last: Stages) -> Stages:
        """These, and those after them."""
        return Stages(*(np.concatenate([getattr(self, f.name), getattr(last, f.name)]) for f in fields(self)))

    def only(self, on: Bools) -> Stages:
        """The same bound with G at the coordinates `on` alone: what grows with the others is counted at its largest."""
        reach = np.maximum(self.high - self.centre, self.centre - self.low) * ~on
        return replace(self, c=self.c + (self.G @ reach[..., None])[..., 0], G=self.G * on)


@final
class Nominal:
    """F = f + p with its slopes, and γ̄ of what is left; where no gap function is, F = f and γ̄ = 0. States are unwrapped."""

    def __init__(self, model: Model, gap: GapFunction | None) -> None:
        self.model, self.gap = model, gap
        self.predictor = None if gap is None else gap.predictor
        self.nx = model.nx
        self._missed: dict[bytes, Array] = {}

    def missed(self, low: Array, high: Array) -> Array:
        """(nx,): by how much a computed step of f may differ from f in a box."""
        key = low.tobytes() + high.tobytes()
        if key not in self._missed:
            parts = (self.model.states, slice(None, self.nx)), (self.model.inputs, slice(self.nx, None))
            x, u = (Box(axes, tuple(low[part].tolist()), tuple(high[part].tolist())) for axes, part in parts)
            self._missed[key] = Arithmetic.of(self.model, Domain(x, u)).e
        return self._missed[key]

    def digest(self) -> str:
        """SHA-256 of f, and of what determines γ."""
        out = hashlib.sha256(self.model.digest().encode())
        for name, array in self.gap.arrays().items() if self.gap is not None else ():
            out.update(f"{name}{array.dtype.str}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        return out.hexdigest()

    def __call__(self, z: Array) -> Array:
        """F(z) up to rounding, (n, nz) → (n, nx)."""
        return self.enclosed(Interval.exact(z)).mid

    def enclosed(self, boxes: Interval) -> Interval:
        f = self.model.enclosure(boxes)
        return f if self.predictor is None else f + self.predictor.over(boxes)

    def slopes(self, boxes: Interval) -> Interval:
        """Contains ∂F/∂z over each box, (n, nx, nz)."""
        J = self.model.jacobian_enclosure(boxes)
        return J if self.predictor is None else J + self.predictor.jacobian_over(boxes)

    def left(self, boxes: Interval) -> Interval:
        """Contains r − p over each box, (n, nx)."""
        if self.gap is None:
            return Interval.exact(np.zeros((len(boxes), self.nx)))
        return self.gap.remainder_over(boxes)

    def straight(self, low: Array, high: Array, horizon: int, frame: Frame, constant: bool = False, cut: bool = True) -> Stages:
        """One straight line for a whole box, the same at all stages: its slope is the middle of ∂F/∂z over the box.

        What it leaves out is bounded by a constant, or by a function that is affine in |z − ẑ| as well: the least on average;
        cut: over cells that are cut where that pays, else over those of `tiles`.
        """
        centre, slope, left_out = self.line(low, high)

        def wrong(cells: Interval) -> Interval:
            return left_out(cells) + self.left(cells)

        cells = tiles(low, high)
        over = wrong(cells)
        # Nothing to shift where nothing bounds it.
        ends = over.hi.max(axis=0), over.lo.min(axis=0)
        shift = np.where(np.isfinite(ends).all(axis=0), np.add(*np.where(np.isfinite(ends), ends, 0.0)) / 2, 0.0)
        c, G = (over - shift).mag.max(axis=0), np.zeros((self.nx, len(low)))
        if not (constant or cut) and np.isfinite(c).all():
            # Imported by name it would be the module of this name to the import contracts.
            c, G = gapcert.plugin.majorant((over - shift).mag, cells.lo, cells.hi, centre)
        elif not constant and np.isfinite(c).all():
            c, G = majorant_of(lambda cells: (wrong(cells) - shift).mag, low, high, centre, THRESHOLDS.slope_cells // 4)
        units = slope, self(centre[None])[0] + shift, c, G
        one = in_frame(frame, *(a[None] for a in units), *(frame.into(a)[None] for a in (centre, low, high)))
        return one.repeated(horizon + 1)

    def featured(self, zone: Domain, horizon: int, frame: Frame, constant: bool) -> tuple[Stages, Array]:
        """(stages, F (f, n+m)): one straight line for a whole zone and all stages; |w_i| ≤ c_i + Σ_j G_ij |F_j(z − ẑ)|.

        F has the axes of z for what the line leaves out; and for the gap the coordinates that it is bounded in, where these are
        relative ones, d = u − v say. With d bounded by itself, fast motion at d = 0 is as certain as rest.
        """
        low, high = zone.low, zone.high
        centre, slope, left_out = self.line(low, high)
        relative = getattr(self.gap, "relative", None)

        def wrong(cells: Interval) -> Interval:
            return left_out(cells) if relative is not None else left_out(cells) + self.left(cells)

        parts = [(*_bounded(wrong, zone, centre, constant), np.eye(len(low)))]
        if relative is not None:
            C = np.eye(len(low))
            C[self.nx :] = np.hstack([np.asarray(relative.slope), np.diag(relative.scale)])
            left = self.gap.inner.remainder_over  # type: ignore[union-attr]
            parts.append((*_bounded(left, relative.domain(zone), C @ centre, constant), C))
        shift, c = (np.sum([p[i] for p in parts], axis=0) for i in (0, 1))
        G, F = np.hstack([p[2] for p in parts]), np.vstack([p[3] for p in parts]) * frame.half
        used = G.any(axis=0)
        size = np.abs(F[used]).max(axis=1)
        units = slope, self(centre[None])[0] + shift, c, np.zeros_like(slope)
        one = in_frame(frame, *(a[None] for a in units), *(frame.into(a)[None] for a in (centre, low, high)))
        one = replace(one, G=(G[:, used] * size / frame.x[1][:, None])[None])
        return one.repeated(horizon + 1), F[used] / size[:, None]

    def line(self, low: Array, high: Array) -> tuple[Array, Array, Callable[[Interval], Interval]]:
        """(ẑ (nz,), J (nx, nz), e): the middles of a box and of ∂F/∂z over it; e(cells) contains F(z) − F(ẑ) − J(z − ẑ),
        F(z) as it is computed, too.

        Mean value form about each cell's own centre c: that is what it is at c, plus (F′(cell) − J)(z − c).
        """
        box = Interval(low[None], high[None])
        centre, slope = box.mid, self.slopes(box).mid[0]
        line, start = Interval.exact(slope), self.enclosed(Interval.exact(centre))
        computed = start + Interval.around(0.0, self.missed(low, high))

        def left_out(cells: Interval) -> Interval:
            middle = Interval.exact(cells.mid)
            at = self.enclosed(middle) - computed - (line * (middle - centre)[:, None, :]).sum(-1)
            return at + ((self.slopes(cells) - line) * (cells - middle)[:, None, :]).sum(-1)

        return centre[0], slope, left_out

    def along(self, frame: Frame, z: Array, low: Array, high: Array) -> Stages:
        """A straight line about each point z (k, nz) of a motion, for its box [low, high] (k, nz), which contains it; all of
        these in the frame.

        F(z) − F(ẑ) = ∫₀¹ F′(ẑ + t(z − ẑ)) dt (z − ẑ). For t in the m-th of M parts of [0, 1] the point lies in the box shrunk
        to m/M about ẑ, so that the integral lies in the mean J̄ of F′ over these M boxes: the slope is the middle of J̄, G is
        its radius.
        """
        # Rounding of the frame is far below 1e-12 of a range.
        at, spare = frame.out(z), 1e-12 * frame.half
        below, above = at - (frame.out(low) - spare), frame.out(high) + spare - at
        share = (np.arange(THRESHOLDS.slope_parts) + 1)[:, None, None] / THRESHOLDS.slope_parts
        boxes = Interval((at - share * below).reshape(-1, z.shape[1]), (at + share * above).reshape(-1, z.shape[1]))
        slopes = self.slopes(boxes).reshape(THRESHOLDS.slope_parts, len(z), self.nx, -1)
        mean = sum((slopes[m] for m in range(1, THRESHOLDS.slope_parts)), slopes[0]) / THRESHOLDS.slope_parts
        left = self.left(Interval(at - below, at + above))
        value, error = self._at(at, frame)
        return in_frame(frame, mean.mid, value + left.mid, left.rad + error, mean.rad, z, low, high)

    def tangents(self, frame: Frame, z: Array, low: Array, high: Array, c: Array) -> Stages:
        """The straight lines of F at points z (k, nz), with c (nx,), all in the frame: what they leave out is not bounded."""
        at, n = frame.out(z), self.nx
        J = self.model.jacobian(at[:, :n], at[:, n:])
        if self.predictor is not None:
            J = J + self.predictor.jacobian_over(Interval.exact(at)).mid
        c = np.tile(c * frame.x[1], (len(z), 1))
        return in_frame(frame, J, self._at(at, frame)[0], c, np.zeros_like(J), z, low, high)

    def _at(self, z: Array, frame: Frame) -> tuple[Array, Array]:
        """F(z) at points of the frame, but for whole turns of angles, and by how much it may be wrong: (k, nx) each."""
        x, u = z[:, : self.nx], z[:, self.nx :]
        after = self.model.step(x, u).x
        after = circle.near(after, x, [axis.kind == "angle" for axis in self.model.states])
        error = np.broadcast_to(self.missed(*frame.ends), after.shape) * 2
        if self.predictor is None:
            return after, error
        known = self.predictor.over(Interval.exact(z))
        return after + known.mid, error + known.rad


def _bounded(error: Callable[[Interval], Interval], zone: Domain, centre: Array, constant: bool) -> tuple[Array, Array, Array]:
    """(shift, c, G): |error − shift|_i ≤ c_i + Σ_j G_ij |z_j − centre_j| in the zone."""
    cells = tiles(zone.low, zone.high)
    ends = error(cells[~zone.outside(cells)])
    top, bottom = ends.hi.max(axis=0), ends.lo.min(axis=0)
    shift = np.where(np.isfinite(top + bottom), (top + bottom) / 2, 0.0)

    def bound(cells: Interval) -> Array:
        return np.where(zone.outside(cells)[:, None], 0.0, (error(cells) - shift).mag)

    if constant or not np.isfinite(top - bottom).all():
        return shift, (ends - shift).mag.max(axis=0), np.zeros((ends.shape[1], len(centre)))
    mean = THRESHOLDS.majorant_near * (zone.high - zone.low) / 4
    return shift, *majorant_of(bound, zone.low, zone.high, centre, mean=mean)


def in_frame(frame: Frame, slope: Array, value: Array, c: Array, G: Array, zeta: Array, low: Array, high: Array) -> Stages:
    """Stacks (k, …) in the units of the model, but for ζ and its box."""
    n = frame.nx
    middle, half = frame.x
    J = slope * frame.half / half[:, None]
    d = (value - middle) / half - (J @ zeta[..., None])[..., 0]
    return Stages(J[..., :n], J[..., n:], d, c / half, G * frame.half / half[:, None], zeta, low, high)


def tiles(low: Array, high: Array, budget: int = THRESHOLDS.slope_cells) -> Interval:
    """At most `budget` boxes that tile [low, high], as many along each axis."""
    count = max(1, int(budget ** (1 / len(low)) + 1e-9))
    edges = [np.linspace(a, b, count + 1) for a, b in zip(low, high, strict=True)]
    first = np.stack([g.ravel() for g in np.meshgrid(*(e[:-1] for e in edges), indexing="ij")], axis=1)
    last = np.stack([g.ravel() for g in np.meshgrid(*(e[1:] for e in edges), indexing="ij")], axis=1)
    return Interval(first, last)
