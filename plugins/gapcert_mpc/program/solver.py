"""Quadratic programs, and who solves them behind one small face: set up once, data updated in place."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Literal, NamedTuple, final

import numpy as np
import scipy.sparse as sp

from gapcert.plugin import Array, MissingDependency, UsageError

Name = Literal["osqp", "piqp", "clarabel"]
Status = Literal["solved", "infeasible", "unfinished"]


@final
class Answer(NamedTuple):
    """z and multipliers y of the rows; status `solved`, `infeasible` or `unfinished`; iterations."""

    z: Array
    y: Array
    status: Status
    iterations: int


@final
class Qp(NamedTuple):
    """min ½zᵀPz + qᵀz subject to low ≤ Az ≤ high; P upper triangular (n, n) and A (rows, n)."""

    P: sp.csc_matrix
    q: Array
    A: sp.csc_matrix
    low: Array
    high: Array


class QpSolver(ABC):
    """For a program, and for others with the same P and the same pattern of A.

    Rows with low = high when it is set up stay equations, and those without a bound have none. A program that has a row with
    low > high, as where a tube is wider than its room, or a number that is none, has no answer, and no library is asked.
    """

    name: Name
    solved: Any
    bad: tuple[Any, ...]

    def __init__(self, qp: Qp, tolerance: float, **settings: Any) -> None:
        self.shape, self.hopeless, self.behind = qp.A.shape, _hopeless(qp), _hopeless(qp)
        self._set_up(_mended(qp) if self.hopeless else qp, tolerance, **settings)

    @abstractmethod
    def _set_up(self, qp: Qp, tolerance: float) -> None: ...

    @final
    def update(self, qp: Qp, varied: bool = False) -> None:
        """Other vectors, and other values of A where it is `varied`."""
        self.hopeless, self.behind = _hopeless(qp), self.behind or varied
        if not self.hopeless:
            self._update(qp, self.behind)
            self.behind = False

    @abstractmethod
    def _update(self, qp: Qp, varied: bool) -> None: ...

    @final
    def solve(self, z: Array | None = None, y: Array | None = None) -> Answer:
        """From the guess (z, y) where the method can use one: a pure function of the data and the guess."""
        if self.hopeless:
            return Answer(np.full(self.shape[1], np.nan), np.zeros(self.shape[0]), "infeasible", 0)
        return self._solve(z, y)

    @abstractmethod
    def _solve(self, z: Array | None, y: Array | None) -> Answer: ...

    def _answer(self, z: Any, y: Array, found: Any, iterations: Any) -> Answer:
        """Of what the library calls `solved` and, where there is no answer, `bad`."""
        status: Status = "solved" if found == self.solved else "infeasible" if found in self.bad else "unfinished"
        return Answer(np.array(z), y, status, int(iterations))


def _hopeless(qp: Qp) -> bool:
    return not ((qp.low <= qp.high).all() and np.isfinite(qp.q).all() and np.isfinite(qp.A.data).all())


def _mended(qp: Qp) -> Qp:
    """One of that pattern which every library takes."""
    A = sp.csc_matrix((np.nan_to_num(qp.A.data, posinf=0.0, neginf=0.0), qp.A.indices, qp.A.indptr), shape=qp.A.shape)
    low, high = (np.where(np.isnan(e), 0.0, e) for e in (np.fmin(qp.low, qp.high), np.fmax(qp.low, qp.high)))
    return Qp(qp.P, np.nan_to_num(qp.q, posinf=0.0, neginf=0.0), A, low, high)


@final
class Osqp(QpSolver):
    """Operator splitting [Stellato et al., 2020]: the fastest from a good guess."""

    name, solved, bad = "osqp", 1, (3, 4)
    MOST = 60  # beyond it an interior point method is sooner there

    def _set_up(self, qp: Qp, tolerance: float, rho: float = 0.1, alpha: float = 1.6) -> None:
        self.osqp = _library("osqp").OSQP()
        # An adaptive ρ would make an answer depend on what was solved before.
        self.osqp.setup(
            *qp, verbose=False, eps_abs=tolerance / 2, eps_rel=0.0, max_iter=self.MOST, adaptive_rho=0, rho=rho,
            alpha=alpha, check_termination=5, polishing=False, warm_starting=True, scaling=10,
        )  # fmt: skip
        # What is updated is scaled by other roundings than what is set up.
        self._update(qp, False)

    def _update(self, qp: Qp, varied: bool) -> None:
        if varied:
            self.osqp.update(Ax=qp.A.data)
        self.osqp.update(q=qp.q, l=qp.low, u=qp.high)

    def _solve(self, z: Array | None, y: Array | None) -> Answer:
        if z is not None:
            self.osqp.warm_start(x=z, y=y)
        found = self.osqp.solve(raise_error=False)
        return self._answer(found.x, found.y, found.info.status_val, found.info.iter)


@final
class Piqp(QpSolver):
    """Proximal interior point [Schwan et al., 2023]: steady times, and infeasibility found quickly."""

    name = "piqp"
    MOST = 60  # it takes 10, or is on the edge of what is feasible

    def _set_up(self, qp: Qp, tolerance: float) -> None:
        piqp = _library("piqp")
        P, q, A, low, high = qp
        self.equal = low == high
        self.rest = ~self.equal & (np.isfinite(low) | np.isfinite(high))
        self.piqp = piqp.SparseSolver()
        self.piqp.settings.eps_abs = tolerance / 10
        self.piqp.settings.eps_rel = 0.0
        self.piqp.settings.verbose = False
        # Scaling is undone and done again at each update, so that an answer would depend on how many there were.
        self.piqp.settings.preconditioner_iter = 0
        self.piqp.settings.max_iter = self.MOST
        e, rest = self.equal, self.rest
        # Which numbers of A are those of either part, in their order.
        number = sp.csc_matrix((np.arange(len(A.data)), A.indices, A.indptr), shape=A.shape)
        self.parts = [(name, A[rows], number[rows].data) for name, rows in (("A", e), ("G", rest))]
        self.piqp.setup(P, q, self.parts[0][1], low[e], self.parts[1][1], low[rest], high[rest])
        self.solved = piqp.PIQP_SOLVED
        self.bad = (piqp.PIQP_PRIMAL_INFEASIBLE, piqp.PIQP_DUAL_INFEASIBLE)

    def _update(self, qp: Qp, varied: bool) -> None:
        e, rest = self.equal, self.rest
        parts: dict[str, Any] = {}
        for name, part, where in self.parts if varied else ():
            part.data[:] = qp.A.data[where]
            parts[name] = part
        self.piqp.update(c=qp.q, b=qp.low[e], h_l=qp.low[rest], h_u=qp.high[rest], **parts)

    def _solve(self, z: Array | None, y: Array | None) -> Answer:
        found = self.piqp.solve()
        r = self.piqp.result
        dual = np.zeros(len(self.equal))
        dual[self.equal] = r.y
        dual[self.rest] = r.z_u - r.z_l
        return self._answer(r.x, dual, found, r.info.iter)


@final
class Clarabel(QpSolver):
    """Interior point in homogeneous embedding [Goulart and Chen, 2024]: the most careful of the three."""

    name = "clarabel"

    def _set_up(self, qp: Qp, tolerance: float) -> None:
        clarabel = _library("clarabel")
        self.equal = qp.low == qp.high
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.presolve_enable = False
        settings.equilibrate_enable = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance / 100
        rest = ~self.equal
        cones = [clarabel.ZeroConeT(int(self.equal.sum())), clarabel.NonnegativeConeT(2 * int(rest.sum()))]
        self.clarabel = clarabel.DefaultSolver(qp.P, qp.q, self._rows(qp.A), self._right(qp), cones, settings)
        self.solved = clarabel.SolverStatus.Solved
        self.bad = (clarabel.SolverStatus.PrimalInfeasible, clarabel.SolverStatus.DualInfeasible)

    def _rows(self, A: sp.csc_matrix) -> sp.csc_matrix:
        rest = A[~self.equal]
        return sp.csc_matrix(sp.vstack([A[self.equal], rest, -rest], format="csc"))

    def _right(self, qp: Qp) -> Array:
        e = self.equal
        return np.asarray(np.clip(np.concatenate([qp.low[e], qp.high[~e], -qp.low[~e]]), -1e6, 1e6))

    def _update(self, qp: Qp, varied: bool) -> None:
        rows = {"A": self._rows(qp.A).data} if varied else {}
        self.clarabel.update(q=qp.q, b=self._right(qp), **rows)

    def _solve(self, z: Array | None, y: Array | None) -> Answer:
        found = self.clarabel.solve()
        e, dual = int(self.equal.sum()), np.zeros(len(self.equal))
        got = np.array(found.z)
        k = len(dual) - e
        dual[self.equal] = got[:e]
        dual[~self.equal] = got[e : e + k] - got[e + k :]
        return self._answer(found.x, dual, found.status, found.iterations)


def _library(name: str) -> Any:
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError:
        raise MissingDependency(f"controller: {name} is not installed; pip install 'gapcert[mpc]'") from None


SOLVERS: dict[str, type[QpSolver]] = {"osqp": Osqp, "piqp": Piqp, "clarabel": Clarabel}


def solver(name: Name, qp: Qp, tolerance: float, **settings: Any) -> QpSolver:
    """One of SOLVERS by its name; the settings are its own."""
    if name not in SOLVERS:
        raise UsageError(f"controller.solver: '{name}' is unknown; use one of {', '.join(SOLVERS)}")
    return SOLVERS[name](qp, tolerance, **settings)
