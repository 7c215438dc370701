"""What a controller's promise is worth on the simulator: runs from many starts, without γ beside with γ, under every policy."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np

from gapcert.plugin import (
    POLICIES,
    Array,
    Bools,
    Controller,
    Domain,
    Emit,
    Entry,
    Ints,
    Law,
    NoStart,
    Policy,
    Pulse,
    System,
    UsageError,
    beginning,
    npz_bytes,
    processes,
    silent,
    step_seed,
    unmatched,
    write_atomic,
)

from .loop_audit import Oracle, audited
from .prediction import summary as learned_summary

if TYPE_CHECKING:
    from .section import StartsFrom

SHARES = 4  # shares per worker; chosen, not measured


@final
@dataclass(frozen=True, eq=False)
class Trace:
    """Closed-loop runs: x (n, steps + 1, nx) and u (n, steps, nu), NaN after a run has ended.

    Per run (n,): `stranded`, it ended outside the controller's domain; `left_goal`, it ended outside `stay` or in an
    obstacle; `reached`, it ended in the target. A violation is either of the first two. `counted`: how many of its states a
    goal that never ends has asked for. `visited` hidden states were stepped from, `strange` of them outside what the
    certificate drew (both 0 where it drew none). broken (n, steps): steps that did not end where the controller had promised.
    fallbacks: per run, steps that went on with a plan of before; None where the controller has no such thing. learned: per
    parameter [low, high] as each run knew it, (n, steps + 1, 2), NaN after its end; None where nothing is learned. hidden:
    (n, nh), what they began with, where that was drawn.
    """

    x: Array
    u: Array
    stranded: Bools
    left_goal: Bools
    reached: Bools
    counted: Ints
    broken: Bools
    visited: int = 0
    strange: int = 0
    fallbacks: Ints | None = None
    learned: Mapping[str, Array] | None = None
    hidden: Array | None = None

    @property
    def violation(self) -> Bools:
        return np.asarray(self.stranded | self.left_goal)


def closed_loop(
    system: System,
    controller: Controller,
    starts: Array,
    steps: int,
    policy: Policy = "first",
    seed: int = 0,
    law: Law | None = None,
    domain: Domain | None = None,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Trace:
    """Run `system` under `controller` from `starts` (n, nx), at most `steps` periods each; hidden state is handed on.

    A state outside the controller's domain ends its run and is reported; it is never moved back. Random choices, and those of
    a stochastic system, are pure functions of `seed`. Hidden states begin at their default, or as `law` draws them. UsageError
    where an input breaks a relation of the `domain`: no controller may give one.

    With `workers` above 1 the runs are shared out among as many processes, which are sent the system and the controller; no
    bit of the answer depends on it. Where runs draw by their number, at random or from a `law`, one process does all. It
    tells `progress` the steps done and the runs broken so far.
    """
    if said := unmatched("states", controller.goal.stay.axes, system.states):
        raise UsageError(f"closed_loop: the system does not fit the controller: {said}")
    drawn = policy == "random" or law is not None or "seed" in system.capabilities
    if workers <= 1 or len(starts) <= 1 or drawn:
        return _runs(system, controller, starts, steps, policy, seed, law, domain, progress)
    # A run that ends early leaves its worker idle: smaller shares are evened out.
    shares = np.array_split(starts, min(len(starts), SHARES * workers))
    with processes(workers) as pool:
        parts = [pool.submit(_runs, system, controller, x, steps, policy, seed, None, domain) for x in shares]
        return _joined([part.result() for part in parts])


def _joined(traces: Sequence[Trace]) -> Trace:
    def joined(parts: list[Any]) -> Any:
        if parts[0] is None:
            return None
        if isinstance(parts[0], Mapping):
            return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        return np.concatenate(parts) if isinstance(parts[0], np.ndarray) else sum(parts)

    return Trace(**{f.name: joined([getattr(t, f.name) for t in traces]) for f in fields(Trace)})


def _runs(
    system: System,
    controller: Controller,
    starts: Array,
    steps: int,
    policy: Policy,
    seed: int,
    law: Law | None,
    domain: Domain | None,
    progress: Callable[[int, int], None] | None = None,
) -> Trace:
    n = len(starts)
    x = np.full((n, steps + 1, system.nx), np.nan)
    u = np.full((n, steps, system.nu), np.nan)
    x[:, 0] = starts
    ended = {name: np.zeros(n, dtype=bool) for name in ("stranded", "left_goal", "reached")}
    alive, visited, strange, counted = np.arange(n), 0, 0, np.zeros(n, dtype=np.int64)
    memory = controller.start(x[:, 0])
    broken = np.zeros((n, steps), dtype=bool)
    used = None if controller.fallbacks(memory) is None else np.zeros(n, dtype=np.int64)
    known = None if (told := controller.learned(memory)) is None else {p: np.full((n, steps + 1, 2), np.nan) for p in told}
    h0 = hidden = None if law is None else beginning(law, starts, seed)
    for k in range(steps + 1):
        if k:
            memory[alive] = controller.advance(x[alive, k], memory[alive])
        if known is not None:
            for p, ends in (controller.learned(memory[alive]) or {}).items():
                known[p][alive, k] = ends
        over = _judge(controller, x[alive, k], memory[alive])
        counted[alive] += controller.counted(x[alive, k], memory[alive])
        for name, flag in ended.items():
            flag[alive] = over[name]
        going = ~np.logical_or.reduce(list(over.values()))
        alive, hidden = alive[going], None if hidden is None else hidden[going]
        if progress is not None:
            progress(k, int((ended["stranded"] | ended["left_goal"]).sum()))
        if k == steps or not len(alive):
            break
        u[alive, k] = _responses(controller, x[:, k], memory, alive, policy, seed, k)
        if used is not None and (spent := controller.fallbacks(memory[alive])) is not None:
            used[alive] = spent
        if domain is not None:
            _refuse_broken(domain, x[alive, k], u[alive, k])
        if law is not None and hidden is not None:
            visited, strange = visited + len(hidden), strange + int(law.outside(hidden).sum())
        noise = step_seed(seed, k) if "seed" in system.capabilities else None
        result = system.step(x[alive, k], u[alive, k], hidden=hidden, seed=noise)
        x[alive, k + 1], hidden = result.x, result.hidden
        broken[alive, k] = ~controller.kept(x[alive, k], u[alive, k], result.x, memory[alive])
    found: dict[str, Any] = {**ended, "counted": counted, "visited": visited, "strange": strange, "fallbacks": used}
    return Trace(x, u, **found, broken=broken, learned=known, hidden=h0)


def _responses(
    controller: Controller,
    x: Array,
    memory: Ints,
    alive: Ints,
    policy: Policy,
    seed: int,
    k: int,
) -> Array:
    """The inputs of the runs that are alive (rows of x and memory)."""
    if policy != "random":
        return controller.respond(x[alive], memory[alive], policy, seed, k)
    # A run's row stays the same whoever else has ended, so that what is random is a function of the run alone.
    rows = np.full(len(x), alive[0])
    rows[alive] = alive
    return controller.respond(x[rows], memory[rows], policy, seed, k)[alive]


def _refuse_broken(domain: Domain, x: Array, u: Array) -> None:
    z = np.hstack([x, u])
    if (broken := ~domain.zone.related(z)).any():
        worst = z[int(np.argmax(broken))]
        raise UsageError(
            f"closed loop: at (x, u) = {worst.tolist()} the controller breaks the relation {domain.zone.broken(worst)}; the "
            f"synthesizer that made it is broken"
        )


def _judge(controller: Controller, x: Array, memory: Ints) -> dict[str, Bools]:
    reached = controller.over(x, memory)
    stranded = ~controller.keeps(x, memory) & ~reached
    return {"reached": reached, "stranded": stranded, "left_goal": ~controller.goal.holds(x)}


def draw_starts(controllers: Sequence[Controller], n: int, seed: int | np.random.Generator) -> Array:
    """n states, uniform on the intersection of the controllers' domains but for the target; NoStart where there are too few."""
    rng = np.random.default_rng(seed)
    found: list[Array] = []
    missing = n
    for _ in range(200):
        # Where an answer is dear, not many more are asked for than are needed.
        x = controllers[0].draw(max(4 * n, 5 * controllers[0].resolution), rng)
        for controller in controllers:
            x = x[controller.contains(x)]
            x = x[~controller.over(x, controller.start(x))]
        found.append(x[:missing])
        missing -= len(found[-1])
        if not missing:
            return np.concatenate(found)
    reasons = [str(c.evidence["reason"]) for c in controllers if "reason" in c.evidence]
    why = f" ({reasons[0]})" if reasons else ""
    finer = "smaller cells, " if any("winning_cells" in c.evidence for c in controllers) else ""
    raise NoStart(
        f"closed loop: {n - missing} of {n} starts found where all controllers win{why}, the target left out; enlarge "
        f"their domains ({finer}a longer period, a wider goal)"
    )


def taken_first(
    with_gamma: Controller, without_gamma: Controller, n: int, seed: int | np.random.Generator
) -> tuple[Array, int]:
    """n starts drawn where the controller without γ wins, those first that the one with γ takes, and how many these are."""
    x = draw_starts((without_gamma,), n, seed)
    takes = with_gamma.contains(x)
    if not takes.any():
        raise NoStart(
            f"closed loop: the controller with γ starts from none of {n} states drawn where the one without γ wins; enlarge "
            f"its domain, or leave out `starts_from`"
        )
    return np.concatenate([x[takes], x[~takes]]), int(takes.sum())


@final
@dataclass(frozen=True)
class Count:
    """One row of the table of policies; `controller` is `with_gamma` or `without_gamma`.

    Only goals that end have `reached`, runs that did; reach-and-stay has `settled`, runs that at the last step were where
    they may stay in the target for ever; a goal to be met again and again has `visits`, the fewest of any run that did not
    break.

    refused: of the starts that were drawn where the controller without γ wins, those from which the one with γ does not start;
    no run is made from them. fallbacks: steps that went on with a plan of before.

    broken_promises: steps that did not end where the controller had promised. `refuted` says which part of the promise they
    refute, of steps_held steps outside_gap lie outside [l, u]: see `Oracle.judge`.
    """

    policy: Policy
    controller: str
    starts: int
    steps: int
    violations: int
    stranded: int
    left_goal: int
    broken_promises: int
    refused: int | None = None
    fallbacks: int | None = None
    reached: int | None = None
    settled: int | None = None
    visits: int | None = None
    steps_held: int | None = None
    outside_gap: int | None = None
    refuted: Mapping[str, int] | None = None

    def to_data(self) -> dict[str, Any]:
        """JSON-able; what does not apply is absent."""
        return {k: v for k, v in asdict(self).items() if v is not None}


@final
@dataclass(frozen=True)
class ClosedLoop:
    """Both controllers from the same starts under every policy; the traces are those of the headline policy.

    `hidden_outside`: the share of the hidden states visited with γ, under all policies, that the certificate certainly did not
    cover; None where it drew none. claim: what the runs with γ earn as an audit.
    skipped: policies that were asked for, and that a controller, or neither, does not know.
    """

    policy: Policy
    rows: tuple[Count, ...]
    with_gamma: Trace
    without_gamma: Trace
    hidden_outside: float | None = None
    claim: Mapping[str, Any] = field(default_factory=dict)
    skipped: tuple[str, ...] = ()

    def count(self, controller: str, policy: Policy | None = None) -> Count:
        """The row of a controller under a policy (default: the headline policy)."""
        wanted = (controller, policy or self.policy)
        for row in self.rows:
            if (row.controller, row.policy) == wanted:
                return row
        raise UsageError(f"closed loop: no row for {wanted[0]} under '{wanted[1]}'")

    def save(self, folder: Path) -> None:
        """Write `closed_loop.npz`: x, u and broken of the headline runs of both controllers, for a replay with those saved."""
        both = {"with_gamma": self.with_gamma, "without_gamma": self.without_gamma}
        arrays = {f"{name}_{part}": getattr(trace, part) for name, trace in both.items() for part in ("x", "u", "broken")}
        write_atomic(folder / "closed_loop.npz", npz_bytes(arrays, compress=True))

    def summary(self) -> dict[str, Any]:
        """JSON-able: the two headline rows, and all of them."""

        def headline(controller: str) -> dict[str, Any]:
            return {k: v for k, v in self.count(controller).to_data().items() if k != "controller"}

        both = {name: headline(name) for name in ("with_gamma", "without_gamma")}
        outside = {} if self.hidden_outside is None else {"hidden_outside": self.hidden_outside}
        more: dict[str, Any] = {"claim": dict(self.claim)} if self.claim else {}
        more |= {"skipped": list(self.skipped)} if self.skipped else {}
        if (known := self.with_gamma.learned) is not None:
            more["learned"] = learned_summary(self.with_gamma.x, known)
        return {**both, **outside, **more, "policies": [row.to_data() for row in self.rows]}


@dataclass
class LoopProgress:
    """The progress of all policies' runs, and how many of these have failed."""

    pulse: Pulse
    steps: int
    policies: int
    failed: dict[str, int] = field(default_factory=lambda: {"with_gamma": 0, "without_gamma": 0})
    done: tuple[str, ...] = ()

    def during(self, name: str, policy: str, k: int, now: int) -> None:
        """Controller `name` is at step k under a policy, and `now` of its runs have failed."""
        text = f"{name.replace('_gamma', ' γ')}, policy {policy}"
        failed, begun = self.failed | {name: self.failed[name] + now}, (*self.done, name)
        self.pulse(len(self.done) * self.steps + k, _so_far(failed, begun), text=text)

    def after(self, name: str, failed: int) -> None:
        self.failed[name] += failed
        self.done += (name,)
        text = f"{len(self.done)} of {self.policies} policies done"
        self.pulse(len(self.done) * self.steps, _so_far(self.failed, self.done), text=text)


def _so_far(failed: Mapping[str, int], begun: Sequence[str]) -> dict[str, Any]:
    """The runs that failed, and over how many policies; `begun`: the controller of each policy that counts in these sums."""
    counts = {"runs failed with γ": failed["with_gamma"], "without": failed["without_gamma"]}
    own, other = (begun.count(name) for name in ("with_gamma", "without_gamma"))
    if max(own, other) < 2:
        return counts
    return counts | {"over": f"{own} policies" if own == other or not other else f"{own} and {other} policies"}


def _count(
    controller: Controller, policy: Policy, name: str, trace: Trace, oracle: Oracle | None, refused: int | None
) -> Count:
    automaton = controller.goal.automaton
    kind, whole, last = controller.goal.kind, trace.counted[~trace.violation], trace.x[~trace.violation, -1]
    ends = kind == "reach_avoid" if automaton is None else bool(automaton.done.any())
    again = kind == "recurrence" if automaton is None else not automaton.ends
    judged = {} if oracle is None else oracle.judge(trace.x, trace.u, trace.broken)
    return Count(
        policy,
        name,
        len(trace.u),
        trace.u.shape[1],
        violations=int(trace.violation.sum()),
        stranded=int(trace.stranded.sum()),
        left_goal=int(trace.left_goal.sum()),
        broken_promises=int(trace.broken.sum()),
        refused=refused,
        fallbacks=None if trace.fallbacks is None else int(trace.fallbacks.sum()),
        reached=int(trace.reached.sum()) if ends else None,
        settled=int(controller.counted(last, np.zeros(len(last), dtype=np.int64)).sum()) if kind == "reach_and_stay" else None,
        visits=int(whole.min(initial=trace.x.shape[1])) if again and len(whole) else None,
        **judged,
    )


def _not_known(asked: Sequence[Policy], both: Collection[str], pairs: Collection[tuple[str, Policy]]) -> tuple[str, ...]:
    """The policies asked for that a controller does not know; with its name where the other one does."""
    unknown = {p: [name.replace("_", " ") for name in both if (name, p) not in pairs] for p in asked}
    return tuple(p if len(names) == len(both) else f"{p} {names[0]}" for p, names in unknown.items() if names)


def compare_loops(
    system: System,
    with_gamma: Controller,
    without_gamma: Controller,
    *,
    starts: int = 100,
    steps: int = 600,
    policies: Sequence[Policy] | None = None,
    policy: Policy = "first",
    starts_from: StartsFrom = "both",
    seed: int = 0,
    law: Law | None = None,
    domain: Domain | None = None,
    oracle: Oracle | None = None,
    beta: float = 1e-6,
    entry: Entry | None = None,
    emit: Emit = silent,
) -> ClosedLoop:
    """Both controllers on the simulator from the same starts, drawn where both win, under each of the policies that they know.

    policies: those that are asked for, by default all. `skipped` has what is asked for and not known.
    starts_from `without_gamma`: drawn where the controller without γ wins; those that the one with γ refuses are counted, and
    left out of its runs, which then begin, as else, uniformly where both win.
    The simulator runs with its true hidden state; `law` says which of them the certificate is about. `oracle` says what the
    controller with γ was promised. The runs with γ are an audit at confidence 1 − beta: of its β that of the `entry` by which a
    book counts it, which draws the starts as well, so that no controller can know them; without one, all of it.
    """
    drawn = seed if entry is None else entry.draws(seed, "starts")
    if starts_from == "both":
        x0, taken = draw_starts((with_gamma, without_gamma), starts, drawn), starts
    else:
        x0, taken = taken_first(with_gamma, without_gamma, starts, drawn)
    asked, both = tuple(policies or ()), {"with_gamma": with_gamma, "without_gamma": without_gamma}
    policies = tuple(dict.fromkeys((policy, *(asked or POLICIES))))
    pairs = [(name, p) for name, c in both.items() for p in policies if p in c.policies or p == policy]
    rows: list[Count] = []
    headline: dict[str, Trace] = {}
    failed, visited, strange = np.zeros(taken, dtype=bool), 0, 0
    told = LoopProgress(Pulse(emit, "closed_loop", len(pairs) * steps, "steps"), steps, len(pairs))
    for name, p in pairs:
        own = name == "with_gamma"
        progress = partial(told.during, name, p)
        trace = closed_loop(system, both[name], x0[:taken] if own else x0, steps, p, seed, law, domain, progress=progress)
        told.after(name, int(trace.violation.sum()))
        refused = starts - taken if own and starts_from != "both" else None
        rows.append(_count(both[name], p, name, trace, oracle if own else None, refused))
        if own:
            failed, visited, strange = failed | trace.violation, visited + trace.visited, strange + trace.strange
        if p == policy:
            headline[name] = trace
    outside = None if law is None else strange / max(visited, 1)
    claim = audited(failed, beta, steps, tuple(p for name, p in pairs if name == "with_gamma"), entry)
    skipped = _not_known(asked, both, pairs)
    return ClosedLoop(policy, tuple(rows), headline["with_gamma"], headline["without_gamma"], outside, claim, skipped)
