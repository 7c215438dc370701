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
    angles = [j for j, axis in enumerate(domain.states.axes) if axis.kind == "angle"]
    if not angles:
        return ()
    z = domain.draw(THRESHOLDS.purity_rows, np.random.default_rng([seed, 0xC19C]))
    x, u = (np.ascontiguousarray(part) for part in domain.split(z))
    apart = np.abs(backend.step(x, u).x - model.step(x, u).x).max(axis=0)
    said = []
    for j in angles:
        if domain.states.wraps[j] or apart[j] > TURN / 2:
            why = "the domain spans a turn" if domain.states.wraps[j] else "f and f̂ are whole turns apart"
            proofs = [_proof(*pair, j, why, x, u) for pair in (("model", model), ("backend", backend))]
            said.append(
                f"{domain.axes[j].name} closes on itself ({why}); that f repeats with it was {proofs[0]}, that f̂ does was "
                f"{proofs[1]}."
            )
    return tuple(said)


def _proof(role: str, system: System, j: int, closes: str, x: Array, u: Array) -> str:
    """How it is known that a system repeats along state j; UsageError where it does not, or where its text is no proof."""
    name, known = system.states[j].name, system.repeats(system.states[j].name)
    seen = _witness(system, j, x, u)
    if known or seen:
        raise UsageError(
            f"certify: {name} closes on itself, since {closes}, but the {role} does not repeat with it: "
            f"{'; '.join(filter(None, (known, seen)))}; expected the same step a turn further, but for whole turns of angles; "
            f"write it so (in sin and cos), narrow the domain to a part of the turn, or declare {name} as a real number"
        )
    return f"probed at {len(x)} states, not proved" if known is None else "proved from its text"


def _witness(system: System, j: int, x: Array, u: Array) -> str:
    """Where a step changes with a turn more or less, by more than e and than what x + 2π rounds by; empty: nowhere."""
    here, move = system.step(x, u).x, np.eye(x.shape[1])[j]
    shaken = system.step(x + 4 * np.spacing(np.abs(x) + TURN) * move, u).x
    rounding = np.abs(difference(system.states, shaken, here)).max(axis=0)
    for k in (1, -1):
        there = system.step(x + k * TURN * move, u).x
        e = system.resolution(np.maximum(np.abs(here), np.abs(there)).max(axis=0))
        excess = np.abs(difference(system.states, there, here)) - THRESHOLDS.repeat_error * (e + rounding)
        if not (excess <= 0).all():
            i, c = np.unravel_index(
                int(np.argmax(np.where(excess <= 0, -np.inf, np.nan_to_num(excess, nan=np.inf)))), excess.shape
            )
            return f"from (x, u) = {[*x[i].tolist(), *u[i].tolist()]} its state {c} becomes {here[i, c]:.6g}, {k:+d} turn on {there[i, c]:.6g}"
    return ""
