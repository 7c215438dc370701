"""Plans as certificates: where a run may be in the steps to come, and what is done there."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar, final

import numpy as np

from gapcert.plugin import Array, Ints
from gapcert_mpc.program.linearise import Stages
from gapcert_mpc.program.program import Program

T = TypeVar("T")


@final
@dataclass(frozen=True, eq=False)
class Plan:
    """x̄ (N+1, n), ū (N, m), half-widths s (N+1, p) of its tube along H, and the terminal set (x_s, u_s, σ), in the frame.

    (z, y) is the answer of the solver, from which the next one starts; `piece` is what is tried before it. From step N on the
    plan stays in its terminal set; or it has none, and ends at step `arrival`. `lines`: its stages, where they are its own.
    """

    z: Array
    y: Array
    x: Array
    u: Array
    s: Array
    xs: Array
    us: Array
    sigma: Array
    piece: int = 0
    arrival: int | None = None
    lines: Stages | None = None

    def stage(self, age: int) -> tuple[Array, Array, Array]:
        """(x̄, ū, s) after `age` steps."""
        return (self.x[age], self.u[age], self.s[age]) if age < len(self.u) else (self.xs, self.us, self.sigma)

    def input(self, x: Array, age: int, K: Array) -> Array:
        """ū + K(x − x̄) after `age` steps."""
        centre, u, _ = self.stage(age)
        return np.asarray(u + K @ (x - centre))


def plan(program: Program, z: Array, y: Array, piece: int = 0) -> Plan:
    """What an answer of the solver says."""
    N, n, m, p, at = program.N, program.n, program.m, program.p, program.at
    x = z[: (N + 1) * n].reshape(N + 1, n)
    u = z[at["u"][0] : at["u"][0] + N * m].reshape(N, m)
    s = program.constant
    if program.variable:
        s = np.concatenate([program.s0, z[at["s"][0] : at["s"][0] + N * p]]).reshape(N + 1, p)
    if not program.steady:
        return Plan(z, y, x, u, s, x[N], np.zeros(m), s[N], arrival=N)
    xs, us = z[at["xs"][0] :][:n], z[at["us"][0] :][:m]
    base, more, per = program.terminal
    sigma = base + more @ np.maximum(z[at["size"][0] :][:p], 0.0)
    if program.variable:
        sigma = sigma + per @ z[at["a"][-1] :][: len(program.on)]
    return Plan(z, y, x, u, s, xs, us, sigma, piece)


@final
@dataclass(frozen=True)
class Pool:
    """Known plans: x (k, N+1, n), s (k, N+1, p), and the step at which each arrives, (k,)."""

    x: Array
    s: Array
    arrival: Array

    @classmethod
    def of(cls, plans: list[Plan], program: Program) -> Pool:
        x = np.array([q.x for q in plans]).reshape(-1, program.N + 1, program.n)
        s = np.array([q.s for q in plans]).reshape(-1, program.N + 1, program.p)
        return cls(x, s, np.array([q.arrival for q in plans], dtype=np.int64))

    def near(self, x: Array, most: int) -> list[tuple[int, int]]:
        """(plan, stage) pairs whose stage is nearest to x, one per plan, nearest first, and not yet at its target."""
        if not len(self.x):
            return []
        away = np.abs(self.x - x).max(axis=2)
        away[np.arange(self.x.shape[1]) >= self.arrival[:, None]] = np.inf
        stage, nearest = away.argmin(axis=1), away.min(axis=1)
        return [(int(i), int(stage[i])) for i in np.argsort(nearest, kind="stable")[:most] if np.isfinite(nearest[i])]


@final
class Held(NamedTuple):
    """What a run remembers: its plan, the steps since that was made, and how many of all its steps went on with a plan.

    Where rates are limited also its input u (m,) at this step and that of the step `before`, in the frame. step: how many there
    were before this one; aim (n+m,): the reference that it was given, in the frame, in place of that of the design.
    """

    plan: Plan
    age: int = 0
    shifted: int = 0
    u: Array | None = None
    before: Array | None = None
    step: int = 0
    aim: Array | None = None


@final
class Memory(Generic[T]):
    """What runs remember, by number; the oldest are forgotten beyond `most`."""

    def __init__(self, most: int = 1 << 16) -> None:
        self.most, self.kept, self.last = most, OrderedDict[int, T](), 0
        self.begun = OrderedDict[bytes, int]()

    def begin(self, x: Array, made: Callable[[Array], T | None]) -> int:
        """The number of what begins at x, 0 where nothing does; what began there before is not made again."""
        key = x.tobytes()
        number = self.begun.get(key, -1)
        if number < 0 or (number and number not in self.kept):
            held = made(x)
            number = self.begun[key] = 0 if held is None else self.add(held)
            if len(self.begun) > self.most:
                self.begun.popitem(last=False)
        return number

    def add(self, held: T) -> int:
        self.last += 1
        self.kept[self.last] = held
        if len(self.kept) > self.most:
            self.kept.popitem(last=False)
        return self.last

    def __getitem__(self, number: int) -> T | None:
        return self.kept.get(number)

    def of(self, numbers: Ints) -> list[T | None]:
        """What runs remember, in their order."""
        return [self.kept.get(number) for number in numbers.tolist()]
