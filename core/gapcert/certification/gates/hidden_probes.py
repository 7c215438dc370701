"""Hidden states to probe with: moved from the declared default, drawn from declared ranges, or visited in rollouts."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.system import StateSpec, System, difference, rotated
from gapcert.numerics.arrays import Array, Bools

Range = tuple[float, float]


def columns(specs: tuple[StateSpec, ...]) -> list[slice]:
    """Which columns of a hidden array each hidden state occupies."""
    ends = np.cumsum([0, *(s.size for s in specs)]).tolist()
    return [slice(a, b) for a, b in itertools.pairwise(ends)]


def default(system: System, n: int) -> Array:
    """(n, nh): the declared default, n times."""
    return np.tile(np.asarray(system.hidden_default, dtype=np.float64), (n, 1))


def moved(
    system: System,
    n: int,
    rng: np.random.Generator,
    ranges: Mapping[str, Range] | None = None,
    only: Collection[str] | None = None,
) -> Array:
    """(n, nh): each hidden state (or those in `only`) at one of the two ends of its range, or ± its probe size."""
    h = default(system, n)
    for spec, part in zip(system.hidden, columns(system.hidden), strict=True):
        sign = rng.integers(0, 2, n) * 2.0 - 1.0
        axis = rng.standard_normal((n, 3))
        if only is not None and spec.name not in only:
            continue
        if spec.kind == "quaternion":
            h[:, part] = rotated(h[:, part], THRESHOLDS.hidden_move * axis / np.linalg.norm(axis, axis=1, keepdims=True))
        elif ranges is not None and spec.name in ranges:
            low, high = ranges[spec.name]
            h[:, part] = np.where(sign > 0, high, low)[:, None]
        else:
            h[:, part] += (sign * (1.0 if spec.unit == "1" else THRESHOLDS.hidden_move))[:, None]
    return h


@final
@dataclass(frozen=True)
class Pool:
    """States visited in rollouts, x (N, nx) in the domain, with the hidden state h (N, nh) that they were visited with."""

    x: Array
    h: Array

    def __len__(self) -> int:
        return len(self.x)


def visited(
    system: System, domain: Domain, runs: int, steps: int, seed: int, tell: Callable[[int], None] = lambda steps: None
) -> Pool:
    """`runs` rollouts from random states, hidden handed on from the declared default, a fresh random input in each step.

    Inputs are drawn such that (x, u) lies in the domain, relations included; a run that leaves it starts anew. The first
    quarter of the steps is left out: there the hidden state still remembers a start that nothing led to. tell: called with
    the steps that are done.
    """
    rng = np.random.default_rng([seed, 0x41DD])
    x, u = (np.ascontiguousarray(part) for part in domain.split(domain.draw(runs, rng)))
    hidden, age = default(system, runs), np.zeros(runs, dtype=int)
    xs, hs = [], []
    for k in range(steps):
        tell(k)
        out = system.step(x, u, hidden=hidden)
        assert out.hidden is not None, "a system with hidden state hands it on"
        x, hidden, age = out.x, out.hidden, age + 1
        u, inside = inputs(domain, x, rng)
        kept = inside & (age > steps // 4)
        xs.append(x[kept])
        hs.append(hidden[kept])
        if (lost := ~inside).any():
            fresh = domain.draw(int(lost.sum()), rng)
            x, u, hidden, age = x.copy(), u.copy(), hidden.copy(), age.copy()
            x[lost], u[lost] = domain.split(fresh)
            hidden[lost], age[lost] = default(system, len(fresh)), 0
    return Pool(np.concatenate(xs), np.concatenate(hs))


def inputs(domain: Domain, x: Array, rng: np.random.Generator) -> tuple[Array, Bools]:
    """u (n, nu) with (x, u) in the domain, and where there is one: the first that fits of 64 uniform ones per row."""
    low, width = domain.low[domain.nx :], domain.width[domain.nx :]
    tried = low + width * rng.random((len(x), THRESHOLDS.hidden_candidates, len(low)))
    z = np.concatenate([np.broadcast_to(x[:, None], (*tried.shape[:2], x.shape[1])), tried], axis=2)
    fits = domain.contains(z.reshape(-1, z.shape[2])).reshape(z.shape[:2])
    return tried[np.arange(len(x)), fits.argmax(axis=1)], np.asarray(fits.any(axis=1))


def change(system: System, a: Array, b: Array) -> Array:
    """|a − b| of states, one column per state: of a quaternion the angle between the two."""
    d = difference(system.states, a, b)
    parts, column = [], 0
    for s in system.states:
        width = 3 if s.kind == "quaternion" else 1
        parts.append(np.linalg.norm(d[:, column : column + width], axis=1))
        column += width
    return np.stack(parts, axis=1)
