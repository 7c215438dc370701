"""Designs of `gapcert_mpc` from plain matrices: a mecanum-like one whose gap grows with its speed, and random ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gapcert_mpc.planning.design import Design
from gapcert_mpc.program.linearise import Frame, Stages
from gapcert_mpc.program.program import NotShrinking, Program, Rows, Weights
from gapcert_mpc.program.tube import riccati, tightest
from gapcert_mpc.program.tuning import tuned

Array = np.ndarray


def designed(A: Array, B: Array, c: Array, G: Array, N: int, wanted: Array, rows: Rows | None = None) -> Design:
    """x⁺ = Ax + Bu + w, |w| ≤ c + G|z|, in the box [−1, 1] and `rows`; stages that are alike, and weights 1."""
    n, m = B.shape
    nothing, one = np.zeros(n + m), np.ones(n + m)
    parts = (A, B, np.zeros(n), c, G, nothing, -one, one)
    stages = Stages(*(np.broadcast_to(part, (N + 1, *np.shape(part))).copy() for part in parts))
    rows = Rows(np.zeros((0, n + m)), np.zeros(0), np.zeros(0)) if rows is None else rows
    section, shares = tightest(A, B, c, G, np.eye(n + m))
    if not (shares < 1).all():
        raise ValueError("the tube does not fit")
    X = riccati(A, B, np.ones(n), np.ones(m))
    scale = 1 / X.max()
    weights = Weights(np.eye(n) * scale, np.eye(m) * scale, X * scale, np.eye(n) * 1e-3 * scale)
    aim = Program(stages, section, rows, weights, 1e-5).target(wanted, one)
    if aim is None:
        raise ValueError("no steady state keeps its tube")
    return Design(Frame(nothing, one, n), stages, section, rows, weights, aim, 1e-5)


def with_pieces(design: Design) -> Design:
    """The same, tuned."""
    aim = design.reference[: design.frame.nx]
    return replace(design, tuning=tuned(design.program(), aim, "auto")[1])


def mecanum(variable: bool = True, N: int = 15) -> Design:
    """x⁺ = x + 0.3 u on a square of 3 m at up to 1 m/s; γ = 2 cm + 11.5 cm · |u|, or the most that comes to, 13.5 cm."""
    slope = np.hstack([np.zeros((2, 2)), np.eye(2) * 0.115 / 1.5])
    c, G = (np.full(2, 0.02 / 1.5), slope) if variable else (np.full(2, 0.135 / 1.5), 0 * slope)
    return designed(np.eye(2), np.eye(2) * 0.3 / 1.5, c, G, N, np.array([0.5, 0.5, 0.0, 0.0]))


def drawn(seed: int, variable: bool) -> Design:
    """A random system of up to 4 states and 2 inputs that holds a tube, with a relation between its states and inputs."""
    while True:
        try:
            return _drawn(np.random.default_rng(seed), variable)
        except (ValueError, NotShrinking):
            seed += 1000


def _drawn(rng: np.random.Generator, variable: bool) -> Design:
    n, m = int(rng.integers(1, 5)), int(rng.integers(1, 3))
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.7, 1.05) / np.abs(np.linalg.eigvals(A)).max()
    B = rng.normal(size=(n, m))
    c, G = rng.uniform(1e-3, 0.02, n), rng.uniform(0, 0.02, (n, n + m)) * variable
    C = rng.uniform(-1, 1, (1, n + m))
    rows = Rows(C, np.array([-np.inf]), np.array([0.9 * np.abs(C).sum()]))
    return designed(A, B, c, G, int(rng.integers(2, 12)), rng.uniform(-0.5, 0.5, n + m), rows)
