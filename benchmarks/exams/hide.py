"""Puts effects into data from outside: into forces, inputs and outputs of any System; shares nothing with the search."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from gapcert.contracts.data.recording import Recording
from gapcert.contracts.systems.system import System
from gapcert.numerics.arrays import Array
from gapcert.numerics.errors import UsageError

if TYPE_CHECKING:
    from exams.hidden.laws import Hidden as At

INSIDE = ("payload", "gravity-tilt", "parameter")
Hidden = tuple[str, str, Mapping[str, float]]


def hide(
    system: System,
    effects: Sequence[Hidden] = (),
    *,
    x0: Sequence[float],
    u: Array,
    noise: Mapping[str, float],
    seed: int,
    decimate: int = 1,
    colour: float = 0.0,
) -> Recording:
    """A recording of `system` with effects (name, site, {parameter: value}) that its own equations do not have.

    u (T, nu) is held for one sample each, which is `decimate` periods of the system; it is recorded as commanded. The channels
    of `noise` (state → standard deviation) are measured; `colour` is the lag-1 autocorrelation of that noise. Forces are held
    for a period, so that should be short. What changes the system itself (`payload`, `gravity-tilt`, `parameter`) has to be put
    into it. The effect `force-law` (amplitude·sin(periods·q)) stands for whatever a library does not know.
    """
    from exams.hidden.laws import KNOWN, Tables
    from exams.hidden.laws import Hidden as At
    from exams.hidden.log import coloured
    from exams.hidden.outside import Outside

    known = tuple(n for n in KNOWN if n not in INSIDE)
    placed = [_law(At(*e)) for e in effects]
    if unknown := [e.effect for e in placed if e.effect not in known]:
        raise UsageError(f"hide: cannot hide '{unknown[0]}'; it knows {', '.join((*known, 'force-law'))}")
    names = tuple(s.name for s in system.states)
    sites = tuple(system.coordinates)
    near = {q: (*sites[i + 1 :], *sites[i - 1 : i])[0] for i, q in enumerate(sites)} if len(sites) > 1 else {}
    tables = Tables(sites, tuple(s.name for s in system.inputs), names, neighbours=near).hide(placed)
    u = np.asarray(u, dtype=np.float64)
    _, y, _ = Outside(system, tables).run(np.asarray(x0, dtype=np.float64), lambda k, _: u[k], len(u), decimate)
    rng = np.random.default_rng(seed)
    channels = {}
    for n, sigma in noise.items():
        values = y[:, names.index(n)] + sigma * (rng.standard_normal(len(y)) if not colour else coloured(len(y), colour, rng))
        step = tables.quantum.get(n)
        channels[n] = values if step is None else step * np.round(values / step)
    channels |= {s.name: u[:, i] for i, s in enumerate(system.inputs)}
    return Recording.of(np.asarray(np.arange(len(y)) * system.period * decimate), channels)


def _law(e: At) -> At:
    """The law that stands for unknown ones, in terms of what is known."""
    if e.effect != "force-law":
        return e
    numbers = {"amplitude": e.numbers["amplitude"], "period": 2 * math.pi / e.numbers["periods"], "phase": 0.0}
    return replace(e, effect="cogging", numbers=numbers)
