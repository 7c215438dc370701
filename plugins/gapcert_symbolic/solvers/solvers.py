"""Which solver answers a problem: the first of SOLVERS that it suits."""

from __future__ import annotations

import os
from collections.abc import Callable

import numpy as np

from gapcert.plugin import Bools
from gapcert_symbolic.cells import repeats
from gapcert_symbolic.kernels import inverse, reach
from gapcert_symbolic.kernels.kernels import Bits, Values, whole
from gapcert_symbolic.thresholds import THRESHOLDS

from . import affine, dense, erosion, lazy, runs
from .problem import Problem, Solution

Solver = Callable[[Problem], Solution | None]
"""None where a problem does not suit it."""


def usable(asked: int | None, pairs: int) -> int:
    """How many threads are used for so many pairs of a cell and an input: as asked, else one per core from `threaded_pairs`
    on."""
    return asked or (len(os.sched_getaffinity(0)) if pairs >= THRESHOLDS.threaded_pairs else 1)


def solve(problem: Problem) -> Solution:
    """What the first of SOLVERS finds that the problem suits."""
    return next(found for solver in SOLVERS if (found := solver(problem)) is not None)


def _repeated(problem: Problem) -> Solution | None:
    """Steps to a target where windows repeat: by what is watched at a cell, whatever the cell is."""
    if problem.target is None:
        return None
    windows = problem.windows()
    if (given := repeats.inverse(windows, whole(windows.grid.size * windows.inputs))) is None:
        return None
    values, bits = _begun(problem, problem.target)
    inverse.reach(given, values, bits, windows.permitted, problem.threads)
    return _reached(values, bits)


def _watched(problem: Problem) -> Solution | None:
    """Steps to a target: each pair of a cell and an input is watched at one."""
    if problem.target is None:
        return None
    values, bits = _begun(problem, problem.target)
    reach.reach(problem.windows().game, values, bits)
    return _reached(values, bits)


def _begun(problem: Problem, target: Bools) -> tuple[Values, Bits]:
    fresh = target & problem.safe
    return np.where(fresh, 0, np.where(problem.safe, -1, -2)).astype(np.int32), problem.windows().offered(fresh)


def _reached(values: Values, bits: Bits) -> Solution:
    return Solution(np.maximum(values, -1), bits, int(values.max(initial=0)))


SOLVERS: tuple[Solver, ...] = (dense.solve, affine.solve, lazy.solve, erosion.solve, runs.solve, _repeated, _watched)
"""On JAX where that is asked for; in closed form; by blocks of cells; else on tables of windows, the special ones first."""
