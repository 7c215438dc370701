"""How much a cause does, beside the effort at its site: what is there but too small is listed, not named."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from gapcert.plugin import Array, difference

from .candidates import Candidate, Causes, sliding, velocity
from .screening import Screen

LEAST = 0.01  # share of the effort: integrators leave as much
LEAST_SHOWN = 0.001  # share of the spread of an output


def negligible(screen: Screen, causes: Causes, values: Mapping[str, float]) -> tuple[tuple[str, str, float], ...]:
    """(effect, site, share of the effort) of causes that are too small to be named."""
    shares = [(c, share(screen, c, values)) for c in causes]
    return tuple((*c.key, s) for c, s in shares if s < (LEAST_SHOWN if c.effect.site == "output" else LEAST))


def share(screen: Screen, c: Candidate, values: Mapping[str, float]) -> float:
    """Root mean square of what a cause does in the window where it does most, over that of the effort at its site.

    Of a parameter: infinite where it is outside of its tolerance, else zero; without one, by how much of its scale it moved.
    """
    library = screen.library
    if (doubt := library.doubted(c)) is not None:
        return abs(values[library.names(c)[0]] - library.off(c)[0]) / doubt
    if (freed := library.loosened(c)) is not None:
        stated = next(p for p in library.model.parameters if p.name == freed)
        return math.inf if abs(values[freed] - stated.value) > stated.tolerance else 0.0
    push = screen.pushed(c, np.array([[values[n] for n in library.names(c)]]))
    if push.state is None:
        channel = [s.name for s in screen.windows.measured.channels].index(c.site)
        shown = push.output if push.output is not None else np.zeros(1)
        return _most(shown[:, :, channel]) / float(screen.windows.measured.spread[channel])
    return _most(_force(screen, c, push.state[..., 0])) / _effort(screen, c)


def _force(screen: Screen, c: Candidate, moved: Array) -> Array:
    """Of one-step differences (W, S, nx): the force at the site that makes them; at an input, the state that feels it most."""
    if c.effect.site == "coordinate":
        response = screen.once(("sliding", c.site), lambda: sliding(screen.library.model, c.site, *_states(screen)))
        v = velocity(screen.library.model, c.site, response)
        return np.asarray(moved[..., v] / response[:, v].reshape(moved.shape[:2]))
    return np.asarray(moved[..., _felt(screen, c)[0]])


def _effort(screen: Screen, c: Candidate) -> float:
    return screen.library.scales(c)["force"] if c.effect.site == "coordinate" else _felt(screen, c)[1]


def _felt(screen: Screen, c: Candidate) -> tuple[int, float]:
    """(column, root mean square) of what the input at the site does to the state in one step, where it does most."""
    found: tuple[int, float] = screen.once(("felt", c.site), lambda: _pulled(screen, c))
    return found


def _pulled(screen: Screen, c: Candidate) -> tuple[int, float]:
    model = screen.library.model
    x, u = _states(screen)
    without = np.where([s.name == c.site for s in model.inputs], 0.0, u)
    pushed = difference(model.states, model.step(x, u).x, model.step(x, without).x)
    sizes = np.sqrt(np.mean(pushed**2, axis=0))
    most = int(np.argmax(sizes / (np.std(x, axis=0) + 1e-300)))
    return most, float(sizes[most]) or 1e-300


def _states(screen: Screen) -> tuple[Array, Array]:
    path = screen.path
    x, u = path.x[:, path.lead :], path.u[:, path.lead :]
    x = x.reshape(-1, x.shape[-1])
    return x, u.reshape(len(x), u.shape[-1])


def _most(a: Array) -> float:
    """The largest root mean square of a window."""
    return float(np.sqrt(np.mean(a.reshape(len(a), -1) ** 2, axis=1).max()))
