"""How much a cause does, beside the effort at its site: what is there but too small is listed, not named."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from gapcert.plugin import Array, difference
from gapcert_diagnosis.thresholds import THRESHOLDS

from .candidates import Candidate, Causes, sliding, velocity
from .screening import Screen


def negligible(screen: Screen, causes: Causes, values: Mapping[str, float]) -> tuple[tuple[str, str, float], ...]:
    """(effect, site, share of the effort) of causes that are too small to be named."""
    shares = [(c, share(screen, c, values)) for c in causes]
    return tuple(
        (*c.key, s)
        for c, s in shares
        if s < (THRESHOLDS.least_output if c.effect.site == "output" else THRESHOLDS.least_effort)
    )


def share(screen: Screen, c: Candidate, values: Mapping[str, float]) -> float:
    """Root mean square of what a cause does in the window where it does most, over that of the effort at its site.

    Of a parameter: infinite where it is outside of its tolerance, else zero; without one, by how much of its scale it moved.
    """
    library = screen.library
    if (doubt := library.doubted(c)) is not None:
        return abs(values[library.names(c)[0]] - library.off(c)[0]) / doubt
    if (freed := library.freed(c)) is not None:
        return math.inf if abs(values[freed.name] - freed.value) > freed.tolerance else 0.0
    push = screen.push_at(c, values)
    if push.state is None:
        channel = [s.name for s in screen.windows.measured.channels].index(c.site)
        shown = push.output if push.output is not None else np.zeros(1)
        return _most(shown[:, :, channel]) / float(screen.windows.measured.spread[channel])
    moved = push.state[..., 0]
    if c.effect.site == "coordinate":
        return _most(_force(screen, c, moved)) / library.scales(c)["force"]
    column, effort = screen.once(("felt", c.site), lambda: _felt(screen, c))
    return _most(moved[..., column]) / float(effort)


def _force(screen: Screen, c: Candidate, moved: Array) -> Array:
    """The force at a coordinate that makes one-step differences (W, S, nx)."""
    response = screen.once(("sliding", c.site), lambda: sliding(screen.library.model, c.site, *_states(screen)))
    v = velocity(screen.library.model, c.site, response)
    return np.asarray(moved[..., v] / response[:, v].reshape(moved.shape[:2]))


def _felt(screen: Screen, c: Candidate) -> tuple[int, float]:
    """(column, root mean square) of what the input at the site does to the state in one step, where it does most."""
    model = screen.library.model
    x, u = _states(screen)
    without = np.where([s.name == c.site for s in model.inputs], 0.0, u)
    pushed = difference(model.states, model.step(x, u).x, model.step(x, without).x)
    sizes = np.sqrt(np.mean(pushed**2, axis=0))
    most = int(np.argmax(sizes / (np.std(x, axis=0) + 1e-300)))
    return most, float(sizes[most]) or 1e-300


def _states(screen: Screen) -> tuple[Array, Array]:
    x, u = (a[:, screen.path.lead :] for a in (screen.path.x, screen.path.u))
    rows = x.shape[0] * x.shape[1]
    return x.reshape(rows, x.shape[-1]), u.reshape(rows, u.shape[-1])


def _most(a: Array) -> float:
    """The largest root mean square of a window."""
    return float(np.sqrt(np.mean(a.reshape(len(a), -1) ** 2, axis=1).max()))
