"""Is a terminal set robustly invariant? Checked with outward-rounded intervals, without the linearisation that made it."""

from __future__ import annotations

import numpy as np

from gapcert import Array, Interval

from .program.linearise import Frame, Nominal
from .program.tube import Section


def margin(nominal: Nominal, frame: Frame, section: Section, x: Array, u: Array, size: Array) -> float:
    """min_i 1 − b_i / σ_i; positive proves {|H(ξ − x)| ≤ σ} robustly invariant under u + K(ξ − x), all in the frame.

    With z_s = (x, u), ξ = x + e, the mean value theorem gives F(ξ, ·) − F(z_s) = M e, M in the hull of F′ [I; K] over the set,
    and |H(F − x + g)| ≤ |ΛHe| + |(HM − ΛH) e| + |H(F(z_s) − x)| + |H| γ̄ ≤ b for any Λ: γ̄ bounds what is left over the set.
    """
    H, P, K, n = section.H, section.P, section.K, len(x)
    # |e| ≤ |P||He| + |I − PH||e|: the second is rounding, and solved for.
    defect = (Interval.exact(np.eye(n)) - _product(P, H)).mag.sum(axis=1).max()
    if not defect < 0.5:
        return -np.inf
    wide = _times(P, size)
    spare = np.full(n, wide.max() * (2 * defect + 1e-12))
    e = wide + spare
    # K e = KP He + K (I − PH) e, and |KP||He| may be far below |K||P||He|.
    away = np.concatenate([e, _times(_product(K, P).mag, size) + _times(K, spare)]) * (1 + 1e-12)
    z = np.concatenate([x, u])
    middle, half = Interval.exact(frame.middle), Interval.exact(frame.half)
    box = (middle + half * Interval.around(z, away))[None]
    at = (middle + half * Interval.exact(z))[None]
    x_half, x_middle = Interval.exact(frame.x[1]), Interval.exact(frame.x[0])
    J = nominal.slopes(box)[0] * half / x_half.reshape(n, 1)
    M = J[:, :n] + (J[:, n:, None] * Interval.exact(K)[None]).sum(1)
    lost = (Interval.exact(H)[:, :, None] * M[None]).sum(1)
    moved = section.moved + H @ (M.mid - section.closed) @ P
    rest = (lost - _product(moved, H)).mag
    # Together: what is left may lie on one side, and x be steady with the middle of it.
    off = ((nominal.enclosed(at)[0] + nominal.left(box)[0] - x_middle) / x_half - Interval.exact(x)).mag
    bound = _times(moved, size) + _times(rest, e) + _times(H, off)
    return float((1 - bound / size).min())


def _product(A: Array, B: Array) -> Interval:
    """Contains A B."""
    return (Interval.exact(A)[:, :, None] * Interval.exact(B)[None]).sum(1)


def _times(A: Array, b: Array) -> Array:
    """≥ |A| b."""
    return np.asarray((Interval.exact(np.abs(A)) * Interval.exact(b)).sum(1).hi)
