"""What is found once, when a controller is made, so that its steps are fast: who solves, with which step sizes, and pieces."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, final

import numpy as np

from gapcert import Array
from gapcert_mpc.thresholds import THRESHOLDS

from .pieces import Pieces, active
from .program import Program
from .solver import Answer, Choice, Name, Osqp, Piqp


@final
@dataclass(frozen=True)
class Tuning:
    """Step size ρ and relaxation α of OSQP, fixed, and the rows that hold plans back most often (k, rows): −1, 0, 1."""

    rho: float = 0.1
    alpha: float = 1.6
    pieces: Array = field(default_factory=lambda: np.zeros((0, 0), dtype=np.int8))


class _Seen(NamedTuple):
    """A state that a plan was drawn from, and that of the step before."""

    x: Array
    answer: Answer
    before: Answer | None


def tuned(
    program: Program, aim: Array, asked: Choice, seed: int = 0, tell: Callable[..., None] = lambda *told: None
) -> tuple[Name, Tuning, int]:
    """The solver, what it is set to, and how many states of sample runs this rests on; the same whenever it is asked again.

    Runs begin at random and at the aim, under disturbances at random corners. The solver `auto` is the one that needs less
    work, in iterations, where no piece holds. tell: hears what is tried, and the best of it.
    """
    tell("sample runs")
    seen = _runs(program, aim, np.random.default_rng(seed))
    counts = Counter(active(program, s.answer.z, s.answer.y).tobytes() for s in seen)
    # A piece is affine in the state alone; where rates are limited, the input before matters, too.
    most = 0 if program.rates is not None else THRESHOLDS.piece_count
    often = [key for key, count in counts.most_common(most) if count >= THRESHOLDS.piece_share * len(seen)]
    kept = np.array([np.frombuffer(key, dtype=np.int8) for key in often]).reshape(len(often), len(program.low))
    made = Pieces(program, kept, aim)
    rest = [s for s in seen if made(s.x) is None]
    rest = rest if len(rest) >= THRESHOLDS.tuning_steps else seen
    dear = np.array([THRESHOLDS.interior_cost * s.answer.iterations for s in rest])
    best, found = (float(dear.sum()) if asked == "auto" else np.inf), (Tuning.rho, Tuning.alpha)
    name: Name = "piqp" if asked == "auto" else asked
    for rho in THRESHOLDS.tried_rhos if asked in ("auto", "osqp") else ():
        for alpha in THRESHOLDS.tried_alphas:
            tell(f"solver settings ρ {rho:g}, α {alpha:g}", {"least work": best, "with": name})
            work = _work(program, rest, dear, rho, alpha, best)
            if work < best:
                best, found, name = work, (rho, alpha), "osqp"
    return name, Tuning(*found, kept), len(seen)


def _runs(program: Program, aim: Array, rng: np.random.Generator) -> list[_Seen]:
    st, n, seen, runs = program.stages, program.n, list[_Seen](), 0
    # Which rows hold a plan back shows where it is exact.
    solver = Piqp(program.P, program.q, program.A, program.low, program.high, 1e-11)
    for number in range(THRESHOLDS.tuning_tries):
        if runs == THRESHOLDS.tuning_runs + THRESHOLDS.tuning_still:
            break
        x = aim if number < THRESHOLDS.tuning_still else rng.uniform(st.low[0, :n], st.high[0, :n])
        before = None
        for _ in range(THRESHOLDS.tuning_steps):
            program.begin(x)
            solver.update(low=program.low, high=program.high)
            answer = solver.solve()
            if answer.status != "solved":
                break
            seen.append(_Seen(x, answer, before))
            runs, before = runs + (before is None), answer
            z = np.concatenate([x, answer.z[program.at["u"][0] :][: program.m]])
            wide = st.c[0] + st.G[0] @ np.abs(z - st.centre[0])
            x = st.A[0] @ x + st.B[0] @ z[n:] + st.d[0] + wide * rng.choice((-1.0, 1.0), n)
    return seen


def _work(program: Program, seen: list[_Seen], dear: Array, rho: float, alpha: float, most: float) -> float:
    """Iterations over the states seen, each from the plan before; where they are too many, the other method's are added."""
    solver = Osqp(program.P, program.q, program.A, program.low, program.high, program.tolerance, rho, alpha)
    z, y, *none = program.shifted()
    total = 0.0
    for s, other in zip(seen, dear.tolist(), strict=True):
        program.begin(s.x)
        solver.update(low=program.low, high=program.high)
        found = solver.solve(*none) if s.before is None else solver.solve(s.before.z[z], s.before.y[y])
        total += found.iterations + (other if found.status != "solved" else 0.0)
        if total >= most:
            break
    return total
