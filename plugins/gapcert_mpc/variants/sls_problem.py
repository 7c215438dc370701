"""What `sls` solves and answers: a linear time-varying system with disturbances from boxes, plans of it, and refusals."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal, final

import numpy as np

from gapcert.plugin import Array, UsageError

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
        made = object.__new__(LtvProblem)
        for field in fields(self):
            object.__setattr__(made, field.name, getattr(self, field.name))
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
