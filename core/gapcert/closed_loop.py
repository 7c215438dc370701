"""What a controller's promise is worth on the simulator: runs from many starts, without γ beside with γ, under every policy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, final, get_args

import numpy as np
import numpy.typing as npt

from gapcert.control import Controller, Policy
from gapcert.domain import Domain
from gapcert.errors import NoStart, UsageError
from gapcert.events import Emit, Event, silent
from gapcert.gates.laws import Law, beginning
from gapcert.system import Array, System, step_seed

Bools = npt.NDArray[np.bool_]
POLICIES: tuple[Policy, ...] = get_args(Policy)


@final
@dataclass(frozen=True, eq=False)
class Trace:
    """Closed-loop runs: x (n, steps + 1, nx) and u (n, steps, nu), NaN after a run has ended.

    Per run (n,): `stranded`, it ended outside the controller's domain; `left_goal`, it ended outside `stay` or in an
    obstacle; `reached`, it ended in the target. A violation is either of the first two. `counted`: how many of its states a
    goal that never ends has asked for. `visited` hidden states were stepped from, `strange` of them outside what the
    certificate drew (both 0 where it drew none).
    """

    x: Array
    u: Array
    stranded: Bools
    left_goal: Bools
    reached: Bools
    counted: npt.NDArray[np.int64]
    visited: int = 0
    strange: int = 0

    @property
    def violation(self) -> Bools:
        return np.asarray(self.stranded | self.left_goal)


@final
@dataclass(frozen=True)
class Count:
    """One row of the table of policies; `controller` is `with_gamma` or `without_gamma`.

    Only goals that end have `reached`, runs that did; reach-and-stay has `settled`, runs that came to stay and did to the last
    step; a goal to be met again and again has `visits`, the fewest of any run that did not break.
    """

    policy: Policy
    controller: str
    starts: int
    steps: int
    violations: int
    stranded: int
    left_goal: int
    reached: int | None = None
    settled: int | None = None
    visits: int | None = None

    def to_data(self) -> dict[str, Any]:
        """JSON-able; what does not apply is absent."""
        return {k: v for k, v in asdict(self).items() if v is not None}


@final
@dataclass(frozen=True)
class ClosedLoop:
    """Both controllers from the same starts under every policy; the traces are those of the headline policy.

    `hidden_outside`: the share of the hidden states visited with γ, under all policies, that the certificate certainly did not
    cover; None where it drew none.
    """

    policy: Policy
    rows: tuple[Count, ...]
    with_gamma: Trace
    without_gamma: Trace
    hidden_outside: float | None = None

    def count(self, controller: str, policy: Policy | None = None) -> Count:
        """The row of a controller under a policy (default: the headline policy)."""
        wanted = (controller, policy or self.policy)
        for row in self.rows:
            if (row.controller, row.policy) == wanted:
                return row
        raise UsageError(f"closed loop: no row for {wanted[0]} under '{wanted[1]}'")

    def summary(self) -> dict[str, Any]:
        """JSON-able: the two headline rows, and all of them."""

        def headline(controller: str) -> dict[str, Any]:
            return {k: v for k, v in self.count(controller).to_data().items() if k != "controller"}

        both = {name: headline(name) for name in ("with_gamma", "without_gamma")}
        outside = {} if self.hidden_outside is None else {"hidden_outside": self.hidden_outside}
        return {**both, **outside, "policies": [row.to_data() for row in self.rows]}


def closed_loop(
    system: System,
    controller: Controller,
    starts: Array,
    steps: int,
    policy: Policy = "first",
    seed: int = 0,
    law: Law | None = None,
    domain: Domain | None = None,
) -> Trace:
    """Run `system` under `controller` from `starts` (n, nx), at most `steps` periods each; hidden state is handed on.

    A state outside the controller's domain ends its run and is reported; it is never moved back. Random choices, and those of
    a stochastic system, are pure functions of `seed`. Hidden states begin at their default, or as `law` draws them. UsageError
    where an input breaks a relation of the `domain`: no controller may give one.
    """
    n = len(starts)
    x = np.full((n, steps + 1, system.nx), np.nan)
    u = np.full((n, steps, system.nu), np.nan)
    x[:, 0] = starts
    ended = {name: np.zeros(n, dtype=bool) for name in ("stranded", "left_goal", "reached")}
    alive, visited, strange, counted = np.arange(n), 0, 0, np.zeros(n, dtype=np.int64)
    memory = controller.start(x[:, 0])
    hidden = None if law is None else beginning(law, starts, seed)
    for k in range(steps + 1):
        if k:
            memory[alive] = controller.advance(x[alive, k], memory[alive])
        over = _judge(controller, x[alive, k], memory[alive])
        counted[alive] += controller.counted(x[alive, k], memory[alive])
        for name, flag in ended.items():
            flag[alive] = over[name]
        going = ~np.logical_or.reduce(list(over.values()))
        alive, hidden = alive[going], None if hidden is None else hidden[going]
        if k == steps or not len(alive):
            break
        # A run's row stays the same whoever else has ended, so that a random policy is a function of the run alone.
        rows = np.full(n, alive[0])
        rows[alive] = alive
        u[alive, k] = controller.respond(x[rows, k], memory[rows], policy, seed, k)[alive]
        if domain is not None:
            _refuse_broken(domain, x[alive, k], u[alive, k])
        if law is not None and hidden is not None:
            visited, strange = visited + len(hidden), strange + int(law.outside(hidden).sum())
        noise = step_seed(seed, k) if "seed" in system.capabilities else None
        result = system.step(x[alive, k], u[alive, k], hidden=hidden, seed=noise)
        x[alive, k + 1], hidden = result.x, result.hidden
    return Trace(x, u, **ended, counted=counted, visited=visited, strange=strange)


def _refuse_broken(domain: Domain, x: Array, u: Array) -> None:
    z = np.hstack([x, u])
    if (broken := ~domain.zone.related(z)).any():
        worst = z[int(np.argmax(broken))]
        raise UsageError(
            f"closed loop: at (x, u) = {worst.tolist()} the controller breaks the relation {domain.zone.broken(worst)}; the "
            f"synthesizer that made it is broken"
        )


def _judge(controller: Controller, x: Array, memory: npt.NDArray[np.int64]) -> dict[str, Bools]:
    reached = controller.over(x, memory)
    stranded = ~controller.keeps(x, memory) & ~reached
    return {"reached": reached, "stranded": stranded, "left_goal": ~controller.goal.holds(x)}


def draw_starts(controllers: Sequence[Controller], n: int, seed: int) -> Array:
    """n states, uniform on the intersection of the controllers' domains but for the target; NoStart where there are too few."""
    rng = np.random.default_rng(seed)
    found: list[Array] = []
    missing = n
    for _ in range(200):
        x = controllers[0].draw(max(4 * n, 1000), rng)
        for controller in controllers:
            x = x[controller.contains(x) & ~controller.over(x, controller.start(x))]
        found.append(x[:missing])
        missing -= len(found[-1])
        if not missing:
            return np.concatenate(found)
    reasons = [str(c.evidence["reason"]) for c in controllers if "reason" in c.evidence]
    why = f" ({reasons[0]})" if reasons else ""
    raise NoStart(
        f"closed loop: {n - missing} of {n} starts found where all controllers win{why}, the target left out; enlarge "
        f"their domains (smaller cells, a longer period, a wider goal)"
    )


def _count(controller: Controller, policy: Policy, name: str, trace: Trace) -> Count:
    kind = controller.goal.kind
    automaton = controller.goal.automaton
    ends = kind == "reach_avoid" if automaton is None else bool(automaton.done.any())
    again = kind == "recurrence" if automaton is None else not automaton.ends
    starts, steps = trace.u.shape[:2]
    broke, stranded, left, reached = (
        int(flag.sum()) for flag in (trace.violation, trace.stranded, trace.left_goal, trace.reached)
    )
    whole = trace.counted[~trace.violation]
    return Count(
        policy,
        name,
        starts,
        steps,
        broke,
        stranded,
        left,
        reached if ends else None,
        int((whole > 0).sum()) if kind == "reach_and_stay" else None,
        int(whole.min(initial=trace.x.shape[1])) if again and len(whole) else None,
    )


def compare_loops(
    system: System,
    with_gamma: Controller,
    without_gamma: Controller,
    *,
    starts: int = 100,
    steps: int = 600,
    policies: Sequence[Policy] = POLICIES,
    policy: Policy = "first",
    seed: int = 0,
    law: Law | None = None,
    domain: Domain | None = None,
    emit: Emit = silent,
) -> ClosedLoop:
    """Both controllers on the simulator from the same starts, drawn where both win, under every policy.

    The simulator runs with its true hidden state; `law` says which of them the certificate is about.
    """
    x0 = draw_starts((with_gamma, without_gamma), starts, seed)
    policies = tuple(dict.fromkeys((policy, *policies)))
    rows, headline, done, visited, strange = [], {}, 0, 0, 0
    for name, controller in (("with_gamma", with_gamma), ("without_gamma", without_gamma)):
        for p in policies:
            trace = closed_loop(system, controller, x0, steps, p, seed, law, domain)
            if name == "with_gamma":
                visited, strange = visited + trace.visited, strange + trace.strange
            rows.append(_count(controller, p, name, trace))
            if p == policy:
                headline[name] = trace
            done += 1
            emit(Event("progress", "closed_loop", {"done": done, "total": 2 * len(policies)}))
    outside = None if law is None else strange / max(visited, 1)
    return ClosedLoop(policy, tuple(rows), headline["with_gamma"], headline["without_gamma"], outside)
