"""A multi-stage controller of do-mpc for the rod of `gapcert_cells.testing`: a scenario per corner of the disturbance."""

from __future__ import annotations

import itertools
import logging
import time
from typing import Any

import numpy as np

Array = np.ndarray
IPOPT = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes"}


class MultiStage:
    """x⁺ = f(x, u) + w with w at any corner of [low, high] in the first `robust` steps of each scenario, and there for ever."""

    def __init__(self, case: Any, horizon: int, robust: int = 1) -> None:
        import casadi
        import do_mpc

        logging.disable(logging.WARNING)
        self.middle, self.half, self.period = case.frame.middle, case.frame.half, case.period
        model = do_mpc.model.Model("discrete")
        x = model.set_variable("_x", "x", (2, 1))
        u = model.set_variable("_u", "u", (1, 1))
        w = model.set_variable("_p", "w", (2, 1))
        pull = 3 * u - 1.5 * 9.81 * casadi.sin(x[0])
        model.set_rhs("x", casadi.vertcat(x[0] + self.period * x[1] + w[0], x[1] + self.period * pull + w[1]))
        model.setup()
        made = self.mpc = do_mpc.controller.MPC(model)
        made.set_param(n_horizon=horizon, n_robust=robust, t_step=self.period, store_full_solution=False, nlpsol_opts=IPOPT)
        away = [(v - m) / h for v, m, h in zip((x[0], x[1], u[0]), self.middle, self.half, strict=True)]
        aim, Q, R, X = case.reference, case.weights.Q, case.weights.R, case.weights.P
        far = casadi.vertcat(away[0] - aim[0], away[1] - aim[1])
        made.set_objective(
            mterm=far.T @ casadi.DM(X) @ far, lterm=far.T @ casadi.DM(Q) @ far + R[0, 0] * (away[2] - aim[2]) ** 2
        )
        made.set_rterm(u=0.0)
        low, high = self.middle - self.half, self.middle + self.half
        for part, name, rows in (("_x", "x", slice(0, 2)), ("_u", "u", slice(2, 3))):
            made.bounds["lower", part, name], made.bounds["upper", part, name] = low[rows], high[rows]
        made.terminal_bounds["lower", "x"], made.terminal_bounds["upper", "x"] = low[:2], high[:2]
        made.set_uncertainty_values(w=np.array(list(itertools.product(*zip(case.low, case.high, strict=True)))))
        made.setup()

    def begin(self, x: Array) -> None:
        self.mpc.reset_history()
        self.mpc.x0 = x
        self.mpc.set_initial_guess()

    def step(self, x: Array) -> tuple[Array | None, float]:
        """The input, None where none is found, and the seconds of CPU."""
        start = time.thread_time()
        u = np.asarray(self.mpc.make_step(x.reshape(-1, 1))).ravel()
        spent = time.thread_time() - start
        return (u if self.mpc.solver_stats["success"] else None), spent
