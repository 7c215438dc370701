"""System level synthesis: nominal inputs and causal feedback from disturbances, optimised jointly and robustly feasible.

Method: Anderson, Doyle, Low and Matni, "System level synthesis", Annual Reviews in Control 47 (2019); for robust predictive
control with time-varying systems Leeman et al., "Fast system level synthesis", arXiv 2401.13762. Here disturbances are from
boxes, so that tightenings are 1-norms, and the program is solved by an interior-point method over multipliers of rows.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, final

import numpy as np

from gapcert.plugin import Array, Bools, Ints, UsageError
from gapcert_mpc.thresholds import THRESHOLDS

from . import sls_kernels as kernels

# N stages, n states, m inputs, c rows of a stage and e rows of the end.
_SHAPES = {
    "A": "Nnn",
    "B": "Nnm",
    "x0": "n",
    "Q": "Nnn",
    "R": "Nmm",
    "Q_end": "nn",
    "d": "Nn",
    "r": "Nn",
    "x_ref": "Mn",
    "u_ref": "Nm",
    "Cx": "Ncn",
    "Cu": "Ncm",
    "Cp": "Ncm",
    "h": "Nc",
    "low": "Nc",
    "C_end": "en",
    "h_end": "e",
    "low_end": "e",
    "u_before": "m",
}
_LIMITS = {"h", "low", "h_end", "low_end"}
_WEIGHTS = {"Q", "R", "Q_end"}
_DYNAMICS = {"A", "B", "Q", "R", "Q_end", "Cx", "Cu", "Cp", "C_end"}


@final
@dataclass(frozen=True, eq=False)
class LtvProblem:
    """x_{k+1} = A_k x_k + B_k u_k + d_k + w_k with |w_k| ≤ r_k, k = 0 … N − 1, from x₀; rows, and a quadratic cost.

    Rows: low_k ≤ Cx_k x_k + Cu_k u_k + Cp_k u_{k−1} ≤ h_k at k < N (u_{−1} = `u_before`; Cp bounds rates) and
    low_end ≤ C_end x_N ≤ h_end, for all disturbances; infinite limits are none.

    Cost: ½ Σ_k |x_k − x_ref,k|²_Q + |u_k − u_ref,k|²_R + ½ |x_N − x_ref,N|²_{Q_end} of the nominal trajectory (w = 0), plus
    `response_weight` times the same quadratic, without references, of each response to one disturbance alone at its bound,
    Φ_{·,j} e_i r_{j,i}. With 1/3, the default, this is the expectation of the cost over independent disturbances that are
    uniform on their boxes.

    Shapes: A (N, n, n), B (N, n, m), d and r (N, n), x_ref (N + 1, n), u_ref (N, m), Cx (N, c, n), Cu and Cp (N, c, m), h and
    low (N, c), C_end (e, n), h_end and low_end (e), Q (N, n, n), R (N, m, m), Q_end (n, n). All but B may lack leading axes,
    which are repeated then. Q and Q_end are positive semidefinite, R is positive definite. Raises UsageError for other shapes
    and values.
    """

    A: Array
    B: Array
    x0: Array
    Q: Array
    R: Array
    Q_end: Array
    d: Any = 0.0
    r: Any = 0.0
    x_ref: Any = 0.0
    u_ref: Any = 0.0
    Cx: Any = None
    Cu: Any = None
    Cp: Any = None
    h: Any = np.inf
    low: Any = -np.inf
    C_end: Any = None
    h_end: Any = np.inf
    low_end: Any = -np.inf
    u_before: Any = 0.0
    response_weight: float = 1 / 3

    def __post_init__(self) -> None:
        B = np.asarray(self.B, float)
        if B.ndim != 3:
            raise UsageError(f"LtvProblem: B has shape {B.shape}; it needs (stages, states, inputs)")
        stage_rows = [np.shape(C)[-2] for C in (self.Cx, self.Cu, self.Cp) if np.ndim(C) >= 2]
        N, n, m = B.shape
        sizes = {"N": N, "M": N + 1, "n": n, "m": m, "c": max(stage_rows, default=0)}
        sizes["e"] = np.shape(self.C_end)[-2] if np.ndim(self.C_end) >= 2 else 0
        for name in _SHAPES:
            self._set(name, getattr(self, name), sizes)
        if not 0 < self.response_weight < np.inf:
            raise UsageError(f"LtvProblem: response_weight is {self.response_weight}; it needs to be positive")

    def _set(self, name: str, value: Any, sizes: dict[str, int]) -> None:
        shape = tuple(sizes[c] for c in _SHAPES[name])
        try:
            given = np.asarray(0.0 if value is None else value, float)
            array = np.ascontiguousarray(np.broadcast_to(given, shape))
        except (TypeError, ValueError):
            raise UsageError(f"LtvProblem: {name} has shape {np.shape(value)}; it needs {shape}") from None
        if np.isnan(array).any() or (name not in _LIMITS and np.isinf(array).any()):
            raise UsageError(f"LtvProblem: {name} has values that are not finite")
        if name == "r" and (array < 0).any():
            raise UsageError("LtvProblem: r has negative values; radii of boxes are 0 or more")
        if name in _WEIGHTS and array.size:
            # eigvalsh reads one triangle alone.
            flawed = np.abs(array - array.swapaxes(-1, -2)).max() > 1e-9 * np.abs(array).max()
            least, needed = np.linalg.eigvalsh(array).min(), -1e-9 * np.abs(array).max()
            if flawed or (least <= 0 if name == "R" else least < needed):
                kind = "positive definite" if name == "R" else "positive semidefinite"
                raise UsageError(f"LtvProblem: {name} is not symmetric and {kind}; choose weights that are")
        object.__setattr__(self, name, array)

    def replaced(self, changes: dict[str, Any]) -> LtvProblem:
        """This problem with other data of the same shapes; only these are checked again."""
        unknown = changes.keys() - _SHAPES.keys()
        if unknown:
            raise UsageError(f"LtvProblem has no array {sorted(unknown)[0]!r}; arrays are {', '.join(_SHAPES)}")
        (N, n, m), (c, e) = self.B.shape, (self.Cx.shape[1], len(self.C_end))
        sizes = {"N": N, "M": N + 1, "n": n, "m": m, "c": c, "e": e}
        made = copy(self)
        for name, value in changes.items():
            made._set(name, value, sizes)
        return made

    def disturbance(self, k: int, x: Array, u: Array, after: Array) -> Array:
        """w_k = x_{k+1} − A_k x_k − B_k u_k − d_k, from what was measured."""
        found: Array = after - self.A[k] @ x - self.B[k] @ u - self.d[k]
        return found


@final
@dataclass(frozen=True, eq=False)
class SlsPlan:
    """Inputs and responses to disturbances that keep all rows, whatever the disturbances in their boxes.

    u_k = ū_k + Σ_{j<k} Φu_{k,j} w_j, and so x_k = x̄_k + Σ_{j<k} Φx_{k,j} w_j. `x` (N + 1, n) and `u` (N, m) are x̄ and ū;
    `state_response` (N + 1, N, n, n) and `input_response` (N, N, m, n) have Φ_{k,j} at [k, j], and zeros for j ≥ k.
    `tightening` (N, c) and `tightening_end` (e) are Σ_j Σ_i |row Φ_{k,j} e_i| r_{j,i}; with them, rows hold with `slack` ≥ 0
    at least, rounding counted outwards. `cost` is that of the nominal trajectory, `objective` what was minimised;
    `iterations` are of the interior-point method.
    """

    x: Array
    u: Array
    state_response: Array
    input_response: Array
    tightening: Array
    tightening_end: Array
    cost: float
    objective: float
    slack: float
    iterations: int

    def input(self, k: int, past: Array) -> Array:
        """u_k, after the disturbances `past` (k, n) = w_0 … w_{k−1}."""
        past = np.asarray(past, float).reshape(-1, self.x.shape[1])
        if not 0 <= k < len(self.u) or len(past) != k:
            raise UsageError(f"SlsPlan.input: stage {k} of {len(self.u)} with {len(past)} disturbances; it needs {k} of them")
        u: Array = self.u[k] + np.einsum("jmi,ji->m", self.input_response[k, :k], past)
        return u


@final
@dataclass(frozen=True)
class SlsRefusal:
    """No plan.

    `infeasible`: multipliers show, up to rounding, that every plan costs more than `bound`, beyond all measure. `unsolved`: no
    plan was found that could be verified.
    """

    kind: Literal["infeasible", "unsolved"]
    reason: str
    bound: float


class Condensed(NamedTuple):
    """Under u = K x + W v with the gains of the Riccati recursion, W Wᵀ = (R + BᵀPB)⁻¹, the cost is ½|v|² + linear + constant.

    `P` (N + 1, n, n) are its matrices; `states` (N + 1, n, z) and `inputs` (N, m, z) respond to z = v₀ … v_{N−1}, x₀,
    w₀ … w_{N−1}, and so do all rows (rows, z), those of stages first.
    """

    P: Array
    states: Array
    inputs: Array
    rows: Array

    @classmethod
    def of(cls, p: LtvProblem) -> Condensed:
        """Raises numpy.linalg.LinAlgError where R + BᵀPB is numerically singular."""
        A, B, (N, n, m) = p.A, p.B, p.B.shape
        K, W, P = np.zeros((N, m, n)), np.zeros((N, m, m)), np.zeros((N + 1, n, n))
        P[N] = p.Q_end
        for k in range(N - 1, -1, -1):
            PB = P[k + 1] @ B[k]
            root = np.linalg.inv(np.linalg.cholesky(p.R[k] + B[k].T @ PB))
            G = root @ (PB.T @ A[k])
            W[k], K[k] = root.T, -root.T @ G
            V = p.Q[k] + A[k].T @ P[k + 1] @ A[k] - G.T @ G
            P[k] = 0.5 * (V + V.T)
        X, U = np.zeros((N + 1, n, N * (m + n) + n)), np.zeros((N, m, N * (m + n) + n))
        closed, driven = A + B @ K, B @ W
        X[0, :, N * m : N * m + n] = np.eye(n)
        for k in range(N):
            np.matmul(closed[k], X[k], out=X[k + 1])
            X[k + 1, :, k * m : (k + 1) * m] = driven[k]
            X[k + 1, :, N * m + (k + 1) * n : N * m + (k + 2) * n] = np.eye(n)
        np.matmul(K, X[:N], out=U)
        for k in range(N):
            U[k, :, k * m : (k + 1) * m] = W[k]
        before = np.concatenate([np.zeros_like(U[:1]), U[:-1]])
        staged = p.Cx @ X[:N] + p.Cu @ U + p.Cp @ before
        return cls(P, X, U, np.concatenate([staged.reshape(-1, X.shape[2]), p.C_end @ X[N]]))

    def tracking(self, p: LtvProblem) -> tuple[Array, Array]:
        """(x, u) of least cost without rows."""
        N, _, m = p.B.shape
        z = np.concatenate([np.zeros(N * m), p.x0, p.d.ravel()])
        dx, du = self.states @ z - p.x_ref, self.inputs @ z - p.u_ref
        weighted = np.einsum("kij,kj->ki", p.Q, dx[:N]), np.einsum("kij,kj->ki", p.R, du), p.Q_end @ dx[N]
        z[: N * m] = -np.einsum("kiz,ki->z", self.states[:N, :, : N * m], weighted[0])
        z[: N * m] -= np.einsum("kiz,ki->z", self.inputs[:, :, : N * m], weighted[1])
        z[: N * m] -= self.states[N, :, : N * m].T @ weighted[2]
        return self.states @ z, self.inputs @ z


class _Rows(NamedTuple):
    """All rows along the trajectory without rows: their values, what columns add, limits, and the cost there."""

    alpha: Array
    beta: Array
    limits: Array
    cost: float
    stages: Ints
    u: Array


@final
class SlsSolver:
    """Solves one `LtvProblem` after another of the same shapes.

    Inputs are u = K x + κ + W v with the gains of the Riccati recursion, which makes the cost ½|v̄|² + ½ρ Σ |v_c|² + constant
    (v̄ nominal, v_c for the scalar disturbance c) and all rows of nominal and of responses parts of one matrix. The interior-
    point method sees only the rows that are needed: it begins with those of the last plan, and rows that its solution breaks
    join.
    """

    def __init__(self, problem: LtvProblem) -> None:
        self.problem = problem
        self._stale = True
        self.working: Bools = np.zeros((2, problem.Cx.shape[0] * problem.Cx.shape[1] + len(problem.C_end)), np.bool_)

    def update(self, **changes: Any) -> None:
        """Other data of the same shapes: x0, A, B, d, r, references, limits, …"""
        self.problem = self.problem.replaced(changes)
        self._stale |= not _DYNAMICS.isdisjoint(changes)

    def forget(self) -> None:
        """Begins the next solution without the rows of the last plan: it depends then on the problem alone."""
        self.working = np.zeros_like(self.working)

    def solve(self) -> SlsPlan | SlsRefusal:
        """The optimal plan, verified; or why there is none."""
        rows, p = self._prepared(), self.problem
        (N, _, m), radii = p.B.shape, p.r.ravel()
        columns = np.flatnonzero(radii)
        v, V, count = np.zeros(N * m), np.zeros((len(columns), N * m)), 0
        status, working, bound, multipliers = kernels.SOLVED, self.working, rows.cost, np.zeros(self.working.shape)
        for _ in range(THRESHOLDS.sls_rounds):
            if working.any():
                status, v, V, multipliers, steps, extra = self._restricted(rows, working)
                count, bound = count + steps, max(bound, rows.cost + extra)
                if status == kernels.INFEASIBLE:
                    break
            a, tau = rows.alpha + self._ahead @ v, np.abs(rows.beta + self._ahead @ V.T).sum(axis=1)
            slack = rows.limits - np.array([tau + a, tau - a])
            broken = ~working & (slack < 0.0)
            if not broken.any():
                break
            working = working | broken
        if status != kernels.SOLVED:
            self.forget()
            if status == kernels.INFEASIBLE:
                return SlsRefusal("infeasible", f"rows cannot all hold: every plan costs more than {bound:.3g}", float(bound))
            why = f"the interior-point method did not converge; plans cost at least {bound:.3g}"
            return SlsRefusal("unsolved", why, float(bound))
        self.working = working & (multipliers > 1e-6 * multipliers.max(initial=0.0))
        return self._plan(rows, v, V / radii[columns][:, None], columns, count)

    def _prepared(self) -> _Rows:
        """All that changes with x₀, disturbances, references and limits; what does not is made where it is stale."""
        p = self.problem
        N, n, m = p.B.shape
        if self._stale:
            try:
                self._condensed = Condensed.of(p)
            except np.linalg.LinAlgError:
                raise UsageError("SlsSolver: R + BᵀPB is numerically singular; choose a larger R or smaller Q") from None
            self._ahead = np.ascontiguousarray(self._condensed.rows[:, : N * m])
            # So many leading entries of v enter a row.
            now = p.Cu.any(axis=2) + np.arange(N)[:, None]
            self._reach = m * np.concatenate([now.ravel(), np.full(len(p.C_end), N)])
            self._stale = False
        x, u = self._condensed.tracking(p)
        before = np.concatenate([p.u_before[None], u[:-1]])
        staged = p.Cx @ x[:N, :, None] + p.Cu @ u[:, :, None] + p.Cp @ before[:, :, None]
        radii = p.r.ravel()
        columns, limits = np.flatnonzero(radii), limits_of(p)
        limits -= THRESHOLDS.sls_inside * (1.0 + np.where(np.isinf(limits), 0.0, np.abs(limits)))
        # A response without rows costs r² Pᵢᵢ.
        least = 0.5 * p.response_weight * float(radii**2 @ np.diagonal(self._condensed.P[1:], axis1=1, axis2=2).ravel())
        return _Rows(
            alpha=np.concatenate([staged.ravel(), p.C_end @ x[N]]),
            beta=self._condensed.rows[:, N * m + n + columns] * radii[columns],
            limits=limits,
            cost=self._cost(x, u) + least,
            stages=columns // n,
            u=u,
        )

    def _cost(self, x: Array, u: Array) -> float:
        p = self.problem
        dx, du, N = x - p.x_ref, u - p.u_ref, len(u)
        stages = np.einsum("ki,kij,kj->", dx[:N], p.Q, dx[:N]) + np.einsum("ki,kij,kj->", du, p.R, du)
        return 0.5 * float(stages + dx[N] @ p.Q_end @ dx[N])

    def _restricted(self, rows: _Rows, working: Bools) -> tuple[int, Array, Array, Array, int, float]:
        """With the rows `working` (2, rows) alone: status, v̄, v_c, multipliers, iterations and a bound of the cost added."""
        (N, _, m), rho = self.problem.B.shape, self.problem.response_weight
        chosen = np.flatnonzero(working.any(axis=0))
        chosen = chosen[np.argsort(self._reach[chosen], kind="stable")]
        side, row = (np.ascontiguousarray(v) for v in np.nonzero(working[:, chosen]))  # one layout, compiled once
        own = self._ahead[chosen]
        blocks = own.reshape(-1, N, m).transpose(1, 0, 2)
        grams = np.zeros((N + 1, len(chosen), len(chosen)))
        grams[:N] = np.cumsum((blocks @ blocks.transpose(0, 2, 1))[::-1], axis=0)[::-1]
        beta = np.ascontiguousarray(rows.beta[chosen].T)
        first = np.searchsorted(self._reach[chosen], (rows.stages + 1) * m, side="right")
        fixed = np.where(np.arange(len(chosen)) < first[:, None], np.abs(beta), 0.0).sum(axis=0)
        moving = first < len(chosen)
        sign = np.where(side == 0, 1.0, -1.0)
        alpha, beta, first, stages = rows.alpha[chosen], beta[moving], first[moving], rows.stages[moving]
        limit = rows.limits[side, chosen[row]] - fixed[row]
        gram = grams[1:] / rho
        status, lam, y, steps, bound = kernels.solved(
            kernels.started(alpha, beta, grams[0], gram, first, row, sign, limit),
            alpha,
            grams[0],
            (beta, gram, first, stages),
            (row, sign, limit),
            (rows.cost, THRESHOLDS.sls_tolerance, THRESHOLDS.sls_hopeless * max(rows.cost, 1e-300)),
        )
        eta = np.bincount(row, weights=sign * lam, minlength=len(chosen))
        V = np.zeros((len(moving), N * m))
        V[moving] = -(y @ own) / rho
        V[np.arange(N * m) < ((rows.stages + 1) * m)[:, None]] = 0.0
        multipliers = np.zeros(working.shape)
        multipliers[side, chosen[row]] = lam
        return status, -(eta @ own), V, multipliers, steps, bound

    def _plan(self, rows: _Rows, v: Array, V: Array, columns: Ints, count: int) -> SlsPlan | SlsRefusal:
        """Its trajectories follow from its inputs, and it is one only where all rows hold on them."""
        p = self.problem
        N, n, m = p.B.shape
        ahead, c = self._condensed.inputs[:, :, : N * m], p.Cx.shape[1]
        inputs = np.empty((N, m, 1 + N * n))
        inputs[:, :, 0] = rows.u + ahead @ v
        inputs[:, :, 1:] = self._condensed.inputs[:, :, N * m + n :]
        inputs[:, :, 1 + columns] += ahead @ V.T
        Z, tau, slack = verified(p, inputs)
        if not slack >= 0.0:
            return SlsRefusal("unsolved", f"the plan found breaks a row by {-slack:.3g}, rounding counted outwards", -np.inf)
        x, u, radii = Z[:, :, 0].copy(), inputs[:, :, 0].copy(), p.r.ravel()
        response, answer = Z[:, :, 1:] * radii, inputs[:, :, 1:] * radii
        spread = (response[:N] * (p.Q @ response[:N])).sum() + (answer * (p.R @ answer)).sum()
        spread += (response[N] * (p.Q_end @ response[N])).sum()
        cost = self._cost(x, u)
        return SlsPlan(
            x=x,
            u=u,
            state_response=Z[:, :, 1:].reshape(N + 1, n, N, n).transpose(0, 2, 1, 3),
            input_response=inputs[:, :, 1:].reshape(N, m, N, n).transpose(0, 2, 1, 3),
            tightening=tau[: N * c].reshape(N, c),
            tightening_end=tau[N * c :],
            cost=cost,
            objective=cost + 0.5 * p.response_weight * float(spread),
            slack=slack,
            iterations=count,
        )


def limits_of(p: LtvProblem) -> Array:
    """(2, rows): sign a + τ ≤ limit for the signs + and −."""
    return np.array([np.concatenate([p.h.ravel(), p.h_end]), np.concatenate([-p.low.ravel(), -p.low_end])])


def verified(p: LtvProblem, inputs: Array) -> tuple[Array, Array, float]:
    """States under `inputs` (N, m, 1 + N n) by the recursion itself, tightenings of all rows, and the least slack of a row.

    Columns are the nominal one, then responses to each w_j: Z_{k+1} = A_k Z_k + B_k inputs_k + what enters at k. A bound of all
    rounding errors is taken off the slack: with δ = (n + m + 4) ε, |error_{k+1}| ≤ |A_k| (|error_k| + δ |Z_k|) + δ (|B_k|
    |inputs_k| + |d_k|), and likewise for rows and their sums.
    """
    N, n, m = p.B.shape
    eps = float(np.finfo(float).eps)
    Z, error = np.zeros((N + 1, n, 1 + N * n)), np.zeros((N + 1, n, 1 + N * n))
    Z[0, :, 0] = p.x0
    driven = p.B @ inputs
    driven[:, :, 0] += p.d
    size = np.abs(p.B) @ np.abs(inputs)
    size[:, :, 0] += np.abs(p.d)
    for k in range(N):
        np.matmul(p.A[k], Z[k], out=Z[k + 1])
        Z[k + 1] += driven[k]
        Z[k + 1, :, 1 + k * n : 1 + (k + 1) * n] += np.eye(n)
        A = np.abs(p.A[k])
        error[k + 1] = A @ (error[k] + (n + m + 4) * eps * np.abs(Z[k])) + (n + m + 4) * eps * size[k]
    before = np.concatenate([np.zeros_like(inputs[:1]), inputs[:-1]])
    before[0, :, 0] = p.u_before
    rows = (p.Cx @ Z[:N] + p.Cu @ inputs + p.Cp @ before).reshape(-1, 1 + N * n)
    rows = np.concatenate([rows, p.C_end @ Z[N]])
    weights, rounding = np.concatenate([[1.0], p.r.ravel()]), (N * n + n + 2 * m + 8) * eps
    doubt = error + rounding * np.abs(Z)
    lost = np.abs(p.Cx) @ (doubt[:N] @ weights)[:, :, None]
    lost += rounding * (np.abs(p.Cu) @ np.abs(inputs) + np.abs(p.Cp) @ np.abs(before)) @ weights[:, None]
    outward = np.concatenate([lost.ravel(), np.abs(p.C_end) @ (doubt[N] @ weights)])
    a, tau = rows[:, 0], np.abs(rows[:, 1:]) @ weights[1:]
    outward += rounding * (np.abs(a) + tau)
    limits = limits_of(p)
    slack = limits - np.array([a, -a]) - tau - outward
    return Z, tau, float(slack[np.isfinite(limits)].min(initial=np.inf))
