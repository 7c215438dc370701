"""Angles that close on themselves: f and f̂ have to repeat with every turn of them, by proof or as probed."""

from __future__ import annotations

import numpy as np

from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.system import Model, System, difference
from gapcert.numerics.arrays import Array
from gapcert.numerics.circle import TURN
from gapcert.numerics.errors import UsageError


def repeating(model: Model, backend: System, domain: Domain, seed: int) -> tuple[str, ...]:
    """One sentence per angle that closes on itself: Z spans a full turn of it, or f and f̂ count its turns differently.

    UsageError where f or f̂ does not repeat with it.
    """
    x, u = domain.split(domain.draw(THRESHOLDS.repeat_rows, np.random.default_rng([seed, 0xC19C])))
    said, apart = [], np.abs(backend.step(x, u).x - model.step(x, u).x).max(axis=0)
    for j, axis in enumerate(domain.states.axes):
        if axis.kind == "angle" and (domain.states.wraps[j] or apart[j] > TURN / 2):
            why = "the domain spans a turn" if domain.states.wraps[j] else "f and f̂ are whole turns apart"
            what, of = f"{axis.name} closes on itself ({why})", ((model, "model"), (backend, "backend"))
            f, fhat = (_proof(what, *each, j, x, u) for each in of)
            said.append(f"{what}; that f repeats with it was {f}, that f̂ does was {fhat}.")
    return tuple(said)


def _proof(what: str, system: System, role: str, j: int, x: Array, u: Array) -> str:
    """How it is known that a system repeats along state j; UsageError where it does not, or where its text is no proof."""
    known, seen = system.repeats(system.states[j].name), _witness(system, j, x, u)
    if known or seen:
        raise UsageError(
            f"certify: {what}, but the {role} does not repeat with it: {'; '.join(filter(None, (known, seen)))}; expected the "
            f"same step a turn further, but for whole turns of angles; write it so (in sin and cos), or narrow the domain"
        )
    return f"probed at {len(x)} states, not proved" if known is None else "proved by its equations"


def _witness(system: System, j: int, x: Array, u: Array) -> str:
    """Where a step changes with a turn more or less, by more than e and than what x + 2π rounds by; empty: nowhere."""
    here, move = system.step(x, u).x, np.eye(x.shape[1])[j]
    shaken = system.step(x + 4 * np.spacing(np.abs(x) + TURN) * move, u).x
    rounding = np.abs(difference(system.states, shaken, here)).max(axis=0)
    for k in (1, -1):
        there = system.step(x + k * TURN * move, u).x
        e = system.resolution(np.maximum(np.abs(here), np.abs(there)).max(axis=0))
        # Asked so that NaN is a change.
        changed = ~(np.abs(difference(system.states, there, here)) <= THRESHOLDS.repeat_error * (e + rounding))
        for i, c in np.argwhere(changed)[:1]:
            at, name = [*x[i].tolist(), *u[i].tolist()], system.states[c].name
            return f"from (x, u) = {at} it steps to {name} = {here[i, c]:.9g}, {k:+d} turn on to {there[i, c]:.9g}"
    return ""
