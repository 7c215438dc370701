"""What a controller is, who makes one, and what it says of each step."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, final

import numpy as np

from gapcert.contracts.controllers.goal import Goal
from gapcert.contracts.controllers.policies import ANYWHERE, Policy
from gapcert.contracts.gaps.gap import GapFunction
from gapcert.contracts.plugins.events import Emit, silent
from gapcert.contracts.systems.domain import Domain, Outside
from gapcert.contracts.systems.system import Model
from gapcert.numerics.arrays import Array, Bools, Ints


@final
@dataclass(frozen=True)
class SynthesisProblem:
    """x⁺ ∈ f(x, u) + [l, u](x, u) with (x, u) ∈ Z, and a goal. `gap` None means the nominal model is trusted (γ = 0).

    certificate: the SHA-256 of the `certificate.json` that the gap is of, where there is one.
    """

    model: Model
    gap: GapFunction | None
    domain: Domain
    goal: Goal
    seed: int = 0
    emit: Emit = field(default=silent)
    certificate: str = ""

    @property
    def basis(self) -> dict[str, Any]:
        """What the `evidence` of its controller says of the certificate behind it."""
        return {"certificate": self.certificate} if self.certificate else {}


class Synthesizer(ABC):
    """Makes a Controller (`synthesizer` plugins).

    What a controller rests on and nothing proves is in its `evidence` under `assumptions`; its claim is `empirical` then.
    """

    name: str

    @abstractmethod
    def synthesize(self, problem: SynthesisProblem) -> Controller:
        """A controller whose domain is sound for the problem; an empty one is an answer, with its reason in `evidence`."""

    def check(self, model: Model, domain: Domain, goal: Goal) -> None:  # noqa: B027 (a synthesizer need not have one)
        """UsageError for what `synthesize` would refuse whatever the gap is; asked before the gap is paid for."""


@final
@dataclass(frozen=True, eq=False)
class StepInfo:
    """What a controller says of one step.

    feasible: the promise holds at the state. solve_seconds: how long the answer took. certificate: the SHA-256 of the
    certificate behind the promise. tube (k, nx, 2): boxes [low, high] that hold the state 1, …, k steps later, as far as it is
    foreseen; angles count modulo a turn. source: where the input comes from: `solved`, `shifted` (a plan of before goes on),
    or why there is none: `refused`, `reached`. left: in at most so many steps the goal is met; None where that is not counted.
    memory (1,): what the run remembers, for the next step.
    """

    feasible: bool
    solve_seconds: float
    certificate: str | None = None
    tube: Array | None = None
    source: Literal["solved", "shifted", "refused", "reached"] = "solved"
    left: int | None = None
    memory: Ints | None = None

    @property
    def fallback(self) -> bool:
        """The input is that of a plan of before."""
        return self.source == "shifted"


class Controller(ABC):
    """A state feedback that knows where it is valid. `kind` names the synthesizer that made it.

    `evidence` has `winning_cells` and the like, or without cells `domain_fraction`, the share of `goal.stay` from which it
    starts; `reason`, why nothing is promised; `assumptions`; and what `SynthesisProblem.basis` says.
    """

    kind: str
    goal: Goal
    evidence: Mapping[str, Any]

    @abstractmethod
    def contains(self, x: Array) -> Bools:
        """(n,) booleans: is the state inside the controller's domain?"""

    @abstractmethod
    def act(self, x: Array, policy: Policy, seed: int = 0, k: int = 0, *, outside: Outside = "raise") -> Array:
        """Inputs (n, nu) for states (n, nx) at step k; outside the domain (never another cell's input) UsageError, or NaN."""

    def start(self, x: Array) -> Ints:
        """Memory (n,) of runs that begin at x; 0 where nothing need be remembered."""
        return np.zeros(len(x), dtype=np.int64)

    def advance(self, x: Array, memory: Ints) -> Ints:
        """Memory of runs that have come to x."""
        return memory

    def keeps(self, x: Array, memory: Ints) -> Bools:
        """(n,): the promise still holds for runs at x with this memory."""
        return self.contains(x)

    def respond(self, x: Array, memory: Ints, policy: Policy, seed: int = 0, k: int = 0) -> Array:
        """`act` for runs with a memory."""
        return self.act(x, policy, seed, k)

    def over(self, x: Array, memory: Ints) -> Bools:
        """(n,): the goal is reached, and the promise ends."""
        return self.goal.reached(x)

    def counted(self, x: Array, memory: Ints) -> Bools:
        """(n,): this moment is one of those that the goal asks for again and again."""
        return self.goal.visited(x)

    @abstractmethod
    def save(self, folder: Path) -> None:
        """Write everything that `act` needs; it loads without what made it."""

    @property
    def policies(self) -> tuple[Policy, ...]:
        """Those that `act` knows."""
        return ANYWHERE

    def kept(self, x: Array, u: Array, after: Array, memory: Ints | None = None) -> Bools:
        """(n,): does a step of runs at x with this memory, under u, that ended in `after` keep what was promised?

        By default: the promise still holds there, or has ended well.
        """
        then = self.advance(after, self.start(x) if memory is None else memory)
        return np.asarray(self.keeps(after, then) | self.over(after, then))

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """At most n states, independent and uniform on the domain; by default what is left of n draws from `goal.stay`."""
        low, high = np.asarray(self.goal.stay.low), np.asarray(self.goal.stay.high)
        x = low + (high - low) * rng.random((n, len(low)))
        return np.asarray(x[self.contains(x)])

    @property
    def wins(self) -> bool:
        """Is there a state from which it starts? As `evidence` says."""
        told = self.evidence
        return bool(told.get("winning_cells", told.get("domain_fraction", "reason" not in told)))

    @property
    def resolution(self) -> int:
        """Points per axis at which a picture asks `contains`; fewer where an answer is dear."""
        return 200

    def facts(self) -> dict[str, Any]:
        """Kind and evidence, JSON-able; without cells with `domain_fraction`, if need be from `resolution` squared draws."""
        told = {"kind": self.kind, **self.evidence}
        if "winning_cells" in told or "domain_fraction" in told:
            return told
        box, draws = self.goal.stay, np.random.default_rng(0).random((self.resolution**2, len(self.goal.stay.axes)))
        x = np.asarray(box.low) + (np.asarray(box.high) - np.asarray(box.low)) * draws
        return told | {"domain_fraction": float(self.contains(x).mean())}

    def predicted(self, x: Array, memory: Ints | None = None) -> tuple[Array, Array, Array] | None:
        """Where a run that is at x (nx,) will be: centre, low, high, each (N + 1, nx), from x itself on; None if not foreseen.

        The state k steps later lies in [low_k, high_k] whatever the gap does, as long as the controller keeps to this plan.
        memory (1,): that of a run which has come to x; None: a run begins there.
        """
        return None

    def wanted(self, count: int) -> Array | None:
        """(count, nx): what the first moments of every run are drawn to, where that moves; else None. No promise is of it."""
        return None

    def tube(self, x: Array, u: Array, memory: Ints | None = None) -> Array | None:
        """(k, nx, 2): boxes [low, high] that hold the state 1, …, k steps after u (nu,) at x (nx,); by default `predicted`."""
        if (found := self.predicted(x, memory)) is None:
            return None
        return np.stack(found[1:], axis=2)[1:]

    def left(self, x: Array, memory: Ints) -> Ints | None:
        """(n,): in at most so many steps the goal is met; None where that is not counted."""
        return None

    def fallbacks(self, memory: Ints) -> Ints | None:
        """(n,): of the steps of runs with this memory, with the one that is about to be made, those that go on with a plan of
        before; None where a controller has no such thing.
        """
        return None

    def learned(self, memory: Ints) -> Mapping[str, Array] | None:
        """(n, 2) per parameter of the model that is learned: [low, high] as runs with this memory know it; NaN where no value
        makes all steps that were seen. None where nothing is learned.
        """
        return None

    def step(self, x: Array, memory: Ints | None = None) -> tuple[Array | None, StepInfo]:
        """The input (nu,) at one state x (nx,) under policy `first`, and what is promised of it; no input (None) outside the
        domain, and none where the goal is reached.

        memory: `StepInfo.memory` of the step before; None: a run begins at x.
        """
        begin, rows = time.perf_counter(), np.asarray(x, dtype=np.float64)[None]
        now = self.start(rows) if memory is None else self.advance(rows, memory)
        told: dict[str, Any] = {"certificate": self.evidence.get("certificate"), "memory": now}
        if (over := bool(self.over(rows, now)[0])) or not self.keeps(rows, now)[0]:
            told |= {"source": "reached", "left": 0} if over else {"source": "refused"}
            return None, StepInfo(over, time.perf_counter() - begin, **told)
        u = self.respond(rows, now, "first")[0]
        seconds, left = time.perf_counter() - begin, self.left(rows, now)
        told |= {"tube": self.tube(rows[0], u, now), "left": None if left is None else int(left[0])}
        made = self.fallbacks(now)
        before = self.fallbacks(memory) if made is not None and memory is not None else None
        if made is not None and made[0] > (0 if before is None else before[0]):
            told["source"] = "shifted"
        return u, StepInfo(True, seconds, **told)
