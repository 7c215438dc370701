"""Purity: equal queries give equal bits, in any order, beside any others, in a fresh copy and in other workers."""

from __future__ import annotations

import functools
import itertools
import math
import pickle
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from gapcert.certification.gates.hidden_distribution import moved
from gapcert.certification.samples.executors import processes
from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.system import Step, System, difference
from gapcert.numerics.arrays import Array, Ints
from gapcert.numerics.errors import UsageError


@final
@dataclass(frozen=True)
class Queries:
    """Rows to ask: x (n, nx), u (n, nu), hidden (n, nh) where there is one."""

    x: Array
    u: Array
    hidden: Array | None = None

    def __getitem__(self, rows: Any) -> Queries:
        return Queries(self.x[rows], self.u[rows], None if self.hidden is None else self.hidden[rows])

    def of(self, system: System) -> Step:
        return system.step(self.x, self.u) if self.hidden is None else system.step(self.x, self.u, hidden=self.hidden)


def queries(system: System, domain: Domain, seed: int) -> Queries:
    """Random rows of Z, its centre, and ladders in it; hidden states are moved too: purity is about all arguments."""
    rng = np.random.default_rng([seed, 0x9075])
    x, u = domain.split(np.vstack([domain.draw(THRESHOLDS.purity_rows, rng), domain.centre]))
    rows = laddered(system, Queries(x, u, moved(system, len(x), rng) if system.hidden else None))
    return rows[domain.zone.related(np.hstack([rows.x, rows.u]))]


def laddered(system: System, rows: Queries) -> Queries:
    """`rows`, then three ladders from one of them to another, in u alone, in x alone and in both.

    Rung k is a third as far from the one as rung k − 1, so that neighbours are close at every scale. Rotations stay.
    """
    share = 3.0 ** -np.arange(THRESHOLDS.purity_rungs)[:, None]
    moves = np.repeat([s.kind != "quaternion" for s in system.states], [s.size for s in system.states])
    which = np.arange(len(rows.x)).tolist()
    for k, (by_x, by_u) in enumerate(((0.0, 1.0), (1.0, 0.0), (1.0, 1.0))):
        a, b = 2 * k % len(rows.x), (2 * k + 1) % len(rows.x)
        x = rows.x[a] + by_x * moves * share * (rows.x[b] - rows.x[a])
        u = rows.u[a] + by_u * share * (rows.u[b] - rows.u[a])
        which += [a] * len(share)
        rows = Queries(np.vstack([rows.x, x]), np.vstack([rows.u, u]), rows.hidden)
    return replace(rows, hidden=None if rows.hidden is None else rows.hidden[which])


def purity(
    role: str,
    system: System,
    domain: Domain,
    executor: Callable[[], Executor],
    seed: int,
    tell: Callable[[str], None] = lambda what: None,
) -> str:
    """What was probed, in words; UsageError where `system` (`role` names it) is no function of its arguments.

    tell: hears each probe before the next one.
    """
    rows, first = answered(system, domain, seed)
    tell("asked once")
    if (lost := ~np.isfinite(first.x).all(axis=1)).any():
        k = int(np.argmax(lost))
        z = np.concatenate([rows.x[k], rows.u[k]])
        raise UsageError(
            f"certify: the {role} steps from (x, u) = {z.tolist()} to {first.x[k].tolist()}; shrink the domain, or mend "
            f"the {role}"
        )
    d = 0.0
    for what, index, answer in itertools.chain(contexts(system, rows, seed), held(system, rows, first)):
        d = max(d, _same(role, system, rows, first, index, answer, what))
        if len(answer.x) >= THRESHOLDS.purity_rows:
            tell(what)
    # Company may change last bits, within e, as where loops are vectorised; the same call has the same bits at any time.
    fresh = pickle.loads(pickle.dumps(system))
    for what, asked in (("asked again in the same call", system), ("asked of a fresh copy", fresh)):
        _same(role, system, rows, first, slice(None), apart(asked, rows, seed), what, exact=True)
        tell(what)
    said = "repeated and permuted queries, close neighbours, other sizes of call"
    there = _elsewhere(system, rows, executor, seed)
    if isinstance(there, str):
        return f"{said} and a fresh copy {agreed(d)} ({there})"
    for k, (index, answer) in enumerate(there):
        how = "in another worker" + " and in another order" * k
        d = max(d, _same(role, system, rows, first, index, answer, how, exact=not k))
    return f"{said}, a fresh copy and another worker {agreed(d)}"


def answered(system: System, domain: Domain, seed: int) -> tuple[Queries, Step]:
    """The rows of `purity`, and what the system answers before anything else is asked of it."""
    rows = queries(system, domain, seed)
    return rows, apart(system, rows, seed)


def unchanged(system: System, first: tuple[Queries, Step], seed: int) -> None:
    """UsageError where a system no longer answers as it did at first, in the same call."""
    _same("backend", system, *first, slice(None), apart(system, first[0], seed), "asked again at the end", exact=True)


def agreed(d: float) -> str:
    """What is said of answers that differ by up to d, which e allows."""
    return f"agreed within e, though not bit for bit (they differ by up to {d:.2g})" if d else "agreed bit for bit"


def allowed(e: Array, d: Array) -> Array:
    """By how much differences d (n, columns) may be of rounding: e of each state, or the largest where rotations are states."""
    return e if len(e) == d.shape[1] else np.full(d.shape[1], e.max())


def _shuffled(rows: Queries, seed: int) -> Ints:
    return np.random.default_rng([seed, 0]).permutation(len(rows.x))


def apart(system: System, rows: Queries, seed: int) -> Step:
    """Answers to all rows, asked in one call in which neighbours stand apart."""
    order = _shuffled(rows, seed)
    out, back = rows[order].of(system), np.argsort(order)
    return Step(out.x[back], None if out.hidden is None else out.hidden[back])


def contexts(system: System, rows: Queries, seed: int) -> Iterator[tuple[str, Any, Step]]:
    """The same rows in other company, as a measurement or a closed loop asks them: (how, which rows, the answers)."""
    order = np.random.default_rng([seed, 1]).permutation(len(rows.x))
    asked = rows[order]
    yield "in another order", order, asked.of(system)
    asked.x[:], asked.u[:] = rows.x, rows.u
    if asked.hidden is not None:
        asked.hidden[:] = rows.hidden
    yield "asked again, beside their neighbours and in the arrays of before,", slice(None), asked.of(system)
    first, size = len(rows.x), 1
    while first > 0:  # one by one along a ladder, then in larger and larger calls
        size += len(rows.x) - first >= THRESHOLDS.purity_rungs
        index = np.arange(first)[-size:][::-1]
        yield f"in calls of {size}" if size > 1 else "asked alone", index, rows[index].of(system)
        first -= size


def held(system: System, rows: Queries, first: Step) -> Iterator[tuple[str, Any, Step]]:
    """One row asked over and over: an engine that puts slow bodies to sleep counts, over half a second to two, while it is."""
    times = min(THRESHOLDS.held_periods, max(4, math.ceil(2.5 / system.period)))
    move = np.abs(difference(system.states, first.x, rows.x)).sum(axis=1)
    slowest = int(np.argmin(np.where(move > 0, move, np.inf)))
    for k in {slowest, len(rows.x) - 1}:
        index = np.full(times, k)
        yield "many times in a row", index, rows[index].of(system)


def _same(
    role: str, system: System, rows: Queries, first: Step, index: Any, answer: Step, what: str, exact: bool = False
) -> float:
    """The largest difference, 0 where all bits agree; UsageError beyond e, or of any bit where answers are to be `exact`: by
    state, where, and beside the mean |x⁺ − x|.
    """
    expected = Step(first.x[index], None if first.hidden is None else first.hidden[index])
    if _bits(expected) == _bits(answer):
        return 0.0
    d = np.abs(difference(system.states, answer.x, expected.x))
    e = system.resolution(np.abs(first.x).max(axis=0))
    if not exact and (d <= allowed(e, d)).all() and _close(expected.hidden, answer.hidden):
        return float(d.max())
    hidden = ""
    if not d.any() and expected.hidden is not None and answer.hidden is not None:
        hidden = f" (in the hidden state, by {np.abs(answer.hidden - expected.hidden).max():.3g})"
    k, _ = np.unravel_index(int(np.argmax(d)), d.shape)
    z = np.concatenate([rows.x[index][k], rows.u[index][k]])
    move = np.abs(difference(system.states, first.x, rows.x)).mean(axis=0)
    # A quaternion has three numbers of a difference.
    columns = [s.name for s in system.states for _ in range(3 if s.kind == "quaternion" else 1)]
    each = ", ".join(
        f"{name} by {worst:.3g}" + (f" ({worst / m:.2g} of its mean move)" if m > 0 else "")
        for name, worst, m in zip(columns, d.max(axis=0), move, strict=True)
        if worst > 0
    )
    raise UsageError(
        f"certify: the {role} is not a function of (x, u): the same {len(d)} queries {what} differ by up to "
        f"{d.max():.3g}{hidden}{': ' + each if each else ''}; worst at (x, u) = {z.tolist()}; make it restore its whole state "
        f"before every query (warm starts, contact caches, sleeping)"
    )


def _close(a: Array | None, b: Array | None) -> bool:
    """Do hidden states agree to the four ulp that float64 is allowed by default?"""
    return a is b if a is None or b is None else bool((np.abs(a - b) <= 4 * np.spacing(np.abs(a).max(axis=0))).all())


def _bits(step: Step) -> tuple[bytes, bytes]:
    return step.x.tobytes(), b"" if step.hidden is None else step.hidden.tobytes()


# Other workers


def answer(payload: bytes, order: Ints) -> Step | str:
    """Runs in a worker: the permuted rows, or why the system cannot be had there."""
    try:
        loaded: tuple[System, Queries] = pickle.loads(payload)
    except (ImportError, AttributeError) as error:
        return f"it cannot be had in another process: {error}"
    system, rows = loaded
    return rows[order].of(system)


def _elsewhere(system: System, rows: Queries, executor: Callable[[], Executor], seed: int) -> list[tuple[Any, Step]] | str:
    """The same call and a permutation, asked of other workers at once; or why that is not possible."""
    payload = pickle.dumps((system, rows))
    if b"__main__" in payload:
        return "in this process only: it belongs to the running script"
    orders = [_shuffled(rows, seed), np.random.default_rng([seed, 2]).permutation(len(rows.x))]
    # Starting a worker costs a second or so of CPU: processes are represented by one that stays, for all certificates.
    stays = getattr(executor, "func", executor) is processes
    pool = _worker() if stays else executor()
    try:
        answers = [future.result() for future in [pool.submit(answer, payload, order) for order in orders]]
    except BrokenExecutor:
        _worker.cache_clear()
        return "another process could not be asked: it ended"
    finally:
        if not stays:
            pool.shutdown(wait=True)
    lost = next((a for a in answers if isinstance(a, str)), None)
    return lost or [(order, a) for order, a in zip(orders, answers, strict=True) if isinstance(a, Step)]


@functools.cache
def _worker() -> Executor:
    return processes(1)
