"""Cross-sections of a tube and how they grow: support functions and non-negative multipliers, no vertices, no projections."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
import scipy.linalg

from gapcert.plugin import Array, UsageError
from gapcert_mpc.thresholds import THRESHOLDS

from .linearise import Stages


@final
@dataclass(frozen=True)
class Section:
    """{e : |H e| ≤ s}, kept by u = ū + K e. H (p, n) has full column rank, P (n, p) satisfies P H = I.

    For any row vector t, |t e| ≤ |t P| s. With `closed` (n, n) = A₀ + B₀K, `moved` (p, p) satisfies moved H = H closed, so
    that |H closed e| ≤ |moved| s; for another pair (A, B), moved + H(A + BK − closed)P does the same.
    """

    H: Array
    P: Array
    K: Array
    closed: Array
    moved: Array

    @classmethod
    def of(cls, A: Array, B: Array, K: Array) -> Section:
        """Of the modes of A + BK: an interval per real one, a regular polygon per pair that turns, as fine as it must be."""
        closed = A + B @ K
        V, pairs = _modes(closed)
        T = np.asarray(np.linalg.inv(V), dtype=np.float64)
        best: Section | None = None
        for faces in THRESHOLDS.tube_polygons:
            H, P, moved = _polygons(closed, V, T, pairs, faces)
            found = cls(H, P, K, closed, moved)
            if best is None or found.radius < best.radius - 1e-9:
                best = found
            # More faces turn with less loss, and cost rows: enough where most of the contraction is left.
            if 1 - best.radius >= 0.7 * (1 - _radius(closed)):
                break
        assert best is not None
        return best

    def moved_by(self, A: Array, B: Array) -> Array:
        """|Λ| (…, p, p) with Λ H = H (A + BK), for stacks of pairs."""
        return np.asarray(np.abs(self.moved + self.H @ (A + B @ self.K - self.closed) @ self.P))

    def steady(self, c: Array, G: Array, away: float) -> Array:
        """σ (p,) with σ = |Λ|σ + |H|(c + G(away + E σ)); infinite where it grows without end."""
        size = np.abs(self.H)
        M = np.abs(self.moved) + size @ G @ self.support
        if _radius(M) >= 1 - 1e-6:
            return np.full(len(M), np.inf)
        return np.asarray(np.linalg.solve(np.eye(len(M)) - M, size @ (c + G.sum(axis=1) * away)))

    @property
    def radius(self) -> float:
        """Spectral radius of |moved|: below 1 the sections shrink."""
        return _radius(np.abs(self.moved))

    @property
    def support(self) -> Array:
        """E (n + m, p): the tube's half-width along each state and input is E s."""
        return np.asarray(np.abs(self.feedback))

    def turning(self, closed: Array) -> Array:
        """D (…, m, p): |K(e⁺ − e)| ≤ D s + |K||w| where e⁺ = closed e + w, for stacks of these."""
        return np.asarray(np.abs(self.K @ (closed - np.eye(len(self.P))) @ self.P))

    @property
    def feedback(self) -> Array:
        """[P; K P] (n + m, p)."""
        return np.vstack([self.P, self.K @ self.P])


def _radius(M: Array) -> float:
    return float(np.abs(np.linalg.eigvals(M)).max())


def _modes(closed: Array) -> tuple[Array, list[tuple[int, ...]]]:
    """V (n, n) with V⁻¹ closed V block diagonal, and the columns of each block: one, or two of a mode that turns."""
    values, vectors = np.linalg.eig(closed)
    columns: list[Array] = []
    pairs: list[tuple[int, ...]] = []
    for value, vector in zip(values, vectors.T, strict=True):
        k = len(columns)
        if value.imag > 1e-9 * abs(value):
            columns += [vector.real, vector.imag]
            pairs.append((k, k + 1))
        elif value.imag >= -1e-9 * abs(value):
            columns.append(vector.real)
            pairs.append((k,))
    V = np.array(columns).T
    # Nearly parallel modes make thin sections; a Schur basis is never thin.
    if np.linalg.cond(V) > 1e4:
        return np.asarray(scipy.linalg.schur(closed)[1]), [(k,) for k in range(len(closed))]
    return V, pairs


def _polygons(closed: Array, V: Array, T: Array, pairs: list[tuple[int, ...]], faces: int) -> tuple[Array, Array, Array]:
    """(H, P, Λ) with P H = I and Λ H = H closed, the smallest Σ|·| per row, block by block of T = V⁻¹."""
    angles = np.pi * np.arange(faces) / faces
    turned = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    parts = [(turned if len(pair) == 2 else np.ones((1, 1))) for pair in pairs]
    blocks = []
    for pair, part in zip(pairs, parts, strict=True):
        rows = part @ T[list(pair)]
        blocks.append(part / np.linalg.norm(rows, axis=1, keepdims=True))
    H = np.vstack([block @ T[list(pair)] for pair, block in zip(pairs, blocks, strict=True)])
    wanted = np.vstack([np.eye(len(V)), H @ closed])
    modal = wanted @ V
    found = np.hstack([_least(modal[:, list(pair)], block) for pair, block in zip(pairs, blocks, strict=True)])
    # Products leave a defect; it is mended so that the equations hold to rounding.
    found = found + (wanted - found @ H) @ np.linalg.pinv(H)
    return H, found[: len(V)], found[len(V) :]


def _least(rows: Array, faces: Array) -> Array:
    """Λ (r, f) with Λ faces = rows and the smallest Σ|Λ| per row; rows (r, d), faces (f, d), d = 1 or 2.

    A linear program with d equations has a solution with d entries that are not 0: all choices are tried.
    """
    d = faces.shape[1]
    if len(faces) == d:
        return np.asarray(np.linalg.solve(faces.T, rows.T).T)
    first, second = np.triu_indices(len(faces), 1)
    both = np.linalg.inv(np.stack([faces[first], faces[second]], axis=1))
    tried = np.einsum("rd,kde->rke", rows, both)
    chosen = np.abs(tried).sum(axis=2).argmin(axis=1)
    out, at = np.zeros((len(rows), len(faces))), np.arange(len(rows))
    out[at, first[chosen]], out[at, second[chosen]] = tried[at, chosen].T
    return out


def unreached(A: Array, B: Array) -> tuple[float, Array] | None:
    """|λ| ≥ 1 and the left eigenvector of a mode that no input reaches [Hautus: rank (λI − A, B) < n], or None."""
    values, vectors = np.linalg.eig(A.T)
    for value, vector in zip(values, vectors.T, strict=True):
        if abs(value) >= 1 - 1e-9 and np.linalg.matrix_rank(np.hstack([value * np.eye(len(A)) - A, B]), 1e-9) < len(A):
            return float(abs(value)), np.abs(vector)
    return None


def riccati(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """X of the linear-quadratic regulator with diagonal weights Q (n,), R (m,); UsageError where nothing stabilises."""
    try:
        return np.asarray(scipy.linalg.solve_discrete_are(A, B, np.diag(Q), np.diag(R)))
    except (np.linalg.LinAlgError, ValueError):
        values = np.linalg.eigvals(A)
        raise UsageError(
            f"controller: no gain stabilises the linearised model (its largest eigenvalue is {np.abs(values).max():.4g} and "
            "the inputs do not reach it); add an input, or leave the states that none moves out of the goal"
        ) from None


def regulator(A: Array, B: Array, R: Array, Q: Array) -> Array:
    """Its gain K, u = K x."""
    X = riccati(A, B, Q, R)
    return np.asarray(-np.linalg.solve(np.diag(R) + B.T @ X @ B, B.T @ X @ A))


def settled(closed: Array, rows: Array, c: Array, G: Array, whole: Array, away: float) -> Array:
    """(r,): the exact steady half-widths Σ_k |row closedᵏ| w along rows (r, n) with w = c + G(away + e), e those along `whole`.

    Infinite where the sum does not end, or the uncertainty that grows with the tube outgrows it.
    """
    if _radius(closed) >= 1 - 1e-6:
        return np.full(len(rows), np.inf)
    # Σ_k |T closedᵏ| by doubling the number of terms: the powers become matrices of 2, 4, 8, … of them.
    terms, power = np.vstack([rows, whole])[None], closed
    while np.abs(terms[-1]).max() > 1e-4 * np.abs(terms).max() and len(terms) < 1 << 14:
        terms, power = np.concatenate([terms, terms @ power]), power @ power
    total = np.abs(terms).sum(axis=0)
    own, wide = total[: len(rows)], total[len(rows) :]
    grows = wide @ G
    if _radius(grows) >= 1 - 1e-6:
        return np.full(len(rows), np.inf)
    e = np.linalg.solve(np.eye(len(grows)) - grows, wide @ (c + G.sum(axis=1) * away))
    return np.asarray(own @ (c + G @ (away + e)))


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


def tightest(
    A: Array, B: Array, c: Array, G: Array, rows: Array, away: float = 0.5, rates: Array | None = None
) -> tuple[Section, Array]:
    """The section whose steady tube leaves most of the rows (r, n + m), each scaled to a half-width of 1, and its shares (r,).

    Most is the product of what is left of each. Linear-quadratic regulators are tried, their weights moved one by one by powers
    of ten, of three and of 1.5: first by what a tube needs at least, then, from there and afresh, by what these sections need,
    for modes that are nearly parallel make a section thin and its tube wide. The uncertainty is that at |z| = `away`. Shares
    are infinite where no gain of these shrinks the tube. rates (m,): r more shares (m,) are those of how far the feedback may
    change inputs in a step.
    """
    n, m = B.shape

    def gain(logs: Array) -> Array:
        return regulator(A, B, np.exp(logs[n:]), np.exp(logs[:n]))

    def least(logs: Array) -> Array:
        K = gain(logs)
        feedback, closed = np.vstack([np.eye(n), K]), A + B @ K
        if rates is None:
            return settled(closed, rows @ feedback, c, G, feedback, away)
        found = settled(closed, np.vstack([rows @ feedback, K @ (closed - np.eye(n)) / rates[:, None]]), c, G, feedback, away)
        # Of (A + BK − 1)e + w the latter is counted as if e were 0: a first guess is all that is wanted.
        return np.asarray(found + np.append(np.zeros(len(rows)), np.abs(K) @ (c + G.sum(axis=1) * away) / rates))

    def own(logs: Array) -> Array:
        return taken(Section.of(A, B, gain(logs)), c, G, rows, away, rates)

    start = np.zeros(n + m)
    first = found = searched(least, start)
    if (first[2] < 1).all():
        starts = [start] if (start == first[1]).all() else [start, first[1]]
        found = min((searched(own, logs) for logs in starts), key=lambda found: found[0])
    return Section.of(A, B, gain(found[1])), found[2]


def passing(stages: Stages, F: Array, rows: Array) -> Section:
    """The section whose tube leaves most of the rows (r, n + m), each scaled to 1, at the horizon; it need not shrink.

    Linear-quadratic regulators are tried as `tightest` does, by what a tube needs at least and then by what their sections
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


def taken(section: Section, c: Array, G: Array, rows: Array, away: float = 0.5, rates: Array | None = None) -> Array:
    """(r,): what a section's steady tube takes of rows that are scaled to a half-width of 1; infinite where it grows.

    With rates (m,) also what its feedback takes of them, (m,) more: (|K(closed − 1)P|σ + |K|w) / rates.
    """
    size = section.steady(c, G, away)
    if not np.isfinite(size).all():
        return np.full(len(rows) + (0 if rates is None else len(rates)), np.inf)
    held = np.asarray(np.abs(rows @ section.feedback) @ size)
    if rates is None:
        return held
    turned = section.turning(section.closed) @ size + np.abs(section.K) @ (c + G @ (away + section.support @ size))
    return np.concatenate([held, turned / rates])


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


def searched(shares: Callable[[Array], Array], logs: Array) -> tuple[float, Array, Array]:
    """(cost, logs, shares) of a local minimum, one weight at a time but for the last, which is the scale."""

    def judged(logs: Array) -> tuple[float, Array, Array]:
        found = shares(logs)
        if not np.isfinite(found).all():
            return np.inf, logs, found
        # A row that nothing is left of outweighs all others.
        return float(-np.log1p(-found).sum() if (found < 1).all() else 1e3 * found.max()), logs, found

    best = judged(logs)
    for step in (10.0, 3.0, 1.5):
        # Where next to nothing is used, next to nothing is to be gained.
        moved = best[0] > 1e-2
        while moved:
            moved = False
            for j in range(len(logs) - 1):
                for sign in (1, -1):
                    tried = best[1].copy()
                    tried[j] += sign * np.log(step)
                    if abs(tried[j]) < 20 and (found := judged(tried))[0] < best[0] - max(1e-4, 0.02 * abs(best[0])):
                        best, moved = found, True
    return best
