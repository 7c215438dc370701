"""What the uncertainty depends on: majorants in the coordinates of the gap, and gains that leave these alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import scipy.linalg

from gapcert.plugin import Array, Domain, Interval, majorant_of
from gapcert_mpc.thresholds import THRESHOLDS

from .linearise import Frame, Nominal, Stages, in_frame, tiles
from .tube import Section, searched


def featured(nominal: Nominal, zone: Domain, horizon: int, frame: Frame, constant: bool) -> tuple[Stages, Array]:
    """(stages, F (f, n+m)): one straight line for a whole zone and |w_i| ≤ c_i + Σ_j G_ij |F_j(z − ẑ)|, the same at all stages.

    F has the axes of z for what the line leaves out; and for the gap the coordinates that it is bounded in, where these are
    relative ones, d = u − v say. With d bounded by itself, fast motion at d = 0 is as certain as rest.
    """
    low, high = zone.low, zone.high
    centre, slope, left_out = nominal.line(low, high)
    relative = getattr(nominal.gap, "relative", None)

    def wrong(cells: Interval) -> Interval:
        return left_out(cells) if relative is not None else left_out(cells) + nominal.left(cells)

    parts = [(*_bounded(wrong, zone, centre, constant), np.eye(len(low)))]
    if relative is not None:
        C = np.eye(len(low))
        C[nominal.nx :] = np.hstack([np.asarray(relative.slope), np.diag(relative.scale)])
        left = nominal.gap.inner.remainder_over  # type: ignore[union-attr]
        parts.append((*_bounded(left, relative.domain(zone), C @ centre, constant), C))
    shift, c = (np.sum([p[i] for p in parts], axis=0) for i in (0, 1))
    G, F = np.hstack([p[2] for p in parts]), np.vstack([p[3] for p in parts]) * frame.half
    used = G.any(axis=0)
    size = np.abs(F[used]).max(axis=1)
    units = slope, nominal(centre[None])[0] + shift, c, np.zeros_like(slope)
    one = in_frame(frame, *(a[None] for a in units), *(frame.into(a)[None] for a in (centre, low, high)))
    one = replace(one, G=(G[:, used] * size / frame.x[1][:, None])[None])
    return one.repeated(horizon + 1), F[used] / size[:, None]


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


def grown(closed: Array, rows: Array, c: Array, G: Array, whole: Array, steps: int) -> Array:
    """(r,): the exact half-widths along rows (r, n) after so many steps; w_k = c + G(`majorant_near` + e_k), e_k those along
    `whole`."""
    terms = [np.vstack([rows, whole])]
    for _ in range(steps - 1):
        terms.append(terms[-1] @ closed)
    size, w, e = np.abs(np.array(terms)), np.empty((steps, len(c))), np.zeros(len(whole))
    for k in range(steps):
        w[k] = c + G @ (THRESHOLDS.majorant_near + e)
        total = np.einsum("krn,kn->r", size[: k + 1], w[k::-1])
        e = total[len(rows) :]
    return np.asarray(total[: len(rows)])


def passing(stages: Stages, F: Array, rows: Array) -> Section:
    """The section whose tube leaves most of the rows (r, n + m), each scaled to 1, at the horizon; it need not shrink.

    Linear-quadratic regulators are tried as `tube.tightest` does, by what a tube needs at least and then by what their sections
    need, with a weight on each of F (f, n + m) as well: a feedback that leaves what the uncertainty depends on alone may be
    worth more than one that contracts.
    """
    (A, B, c, G), steps = stages.first, stages.horizon
    n, m = B.shape

    def gain(logs: Array) -> Array:
        # The scale is free: the first weight is that of the first of F, the last that of the last input.
        cost = np.diag(np.exp(logs[len(F) :])) + F.T @ (np.exp(logs[: len(F), None] - 8.0) * F)
        S, R = cost[:n, n:], cost[n:, n:]
        X = scipy.linalg.solve_discrete_are(A, B, cost[:n, :n], R, s=S)
        return np.asarray(-np.linalg.solve(R + B.T @ X @ B, B.T @ X @ A + S.T))

    def least(logs: Array) -> Array:
        feedback = np.vstack([np.eye(n), gain(logs)])
        return grown(A + B @ feedback[n:], rows @ feedback, c, G, F @ feedback, steps)

    def own(logs: Array) -> Array:
        return kept(Section.of(A, B, gain(logs)), c, G, F, rows, steps)

    def flat(logs: Array) -> Array:
        return kept(Section.of(A, B, gain(logs)), c + G.sum(axis=1) * THRESHOLDS.majorant_near, 0 * G, F, rows, steps)

    def shares(of: Callable[[Array], Array]) -> Callable[[Array], Array]:
        def tried(logs: Array) -> Array:
            try:
                return of(logs)
            except (np.linalg.LinAlgError, ValueError):
                return np.full(len(rows), np.inf)

        return tried

    start = np.zeros(len(F) + n + m)
    starts = [start, *(searched(shares(of), start)[1] for of in (least, flat))]
    found = min((searched(shares(own), logs) for logs in starts), key=lambda found: found[0])
    return Section.of(A, B, gain(found[1]))


def kept(section: Section, c: Array, G: Array, F: Array, rows: Array, steps: int) -> Array:
    """(r,): what the tube of a section takes of the rows (r, n + m), each scaled to 1, after so many steps; it is that of a
    plan whose features are at `majorant_near`.
    """
    size = np.abs(section.H)
    moved = np.abs(section.moved) + size @ G @ np.abs(F @ section.feedback)
    s, w = np.zeros(len(size)), size @ (c + G.sum(axis=1) * THRESHOLDS.majorant_near)
    for _ in range(steps):
        s = moved @ s + w
    return np.asarray(np.abs(rows @ section.feedback) @ s)
