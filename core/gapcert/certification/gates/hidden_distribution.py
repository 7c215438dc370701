"""Where hidden states come from: moved from the declared default, visited in rollouts, or drawn by a law.

With a law, f̂ is a function of (x, u) again.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.system import Backend, Model, StateSpec, System, difference, rotated
from gapcert.numerics.arrays import Array, Bools, Ints
from gapcert.numerics.counter_rng import Keys, keys, uniforms
from gapcert.numerics.digest import json_digest
from gapcert.numerics.errors import UsageError

Range = tuple[float, float]


def columns(specs: tuple[StateSpec, ...]) -> list[slice]:
    """Which columns of a hidden array each hidden state occupies."""
    return [slice(a, b) for a, b in itertools.pairwise(np.cumsum([0, *(s.size for s in specs)]).tolist())]


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
    system: System,
    domain: Domain,
    runs: int,
    steps: int,
    seed: int,
    tell: Callable[[int], None] = lambda steps: None,
    long: bool = False,
) -> Pool:
    """`runs` rollouts from random states, hidden handed on from the declared default, a fresh random input in each step.

    Inputs are drawn such that (x, u) lies in the domain, relations included; a run that leaves it starts anew. The first
    quarter of the steps is left out: there the hidden state still remembers a start that nothing led to. tell: called with
    the steps that are done. long: nothing is left out, inputs are held for 1, 2, 4, … 128 steps, and a run that starts anew
    hands its hidden state on, so that what adds up over all steps does.
    """
    rng = np.random.default_rng([seed, 0x41DD])
    x, u = domain.split(domain.draw(runs, rng))
    hidden, age, hold = default(system, runs), np.zeros(runs, dtype=int), 2 ** (np.arange(runs) % 8)
    xs, hs = [], []
    for k in range(steps):
        tell(k)
        out = system.step(x, u, hidden=hidden)
        assert out.hidden is not None, "a system with hidden state hands it on"
        x, hidden, age = out.x, out.hidden, age + 1
        before, (u, inside) = u, inputs(domain, x, rng)
        if long:
            held = (age % hold > 0) & domain.contains(np.hstack([x, before]))
            u = np.where(held[:, None], before, u)
        kept = inside & (long | (age > steps // 4))
        xs.append(x[kept])
        hs.append(hidden[kept])
        if (lost := ~inside).any():
            fresh = domain.draw(int(lost.sum()), rng)
            x, u, hidden, age = x.copy(), u.copy(), hidden.copy(), age.copy()
            x[lost], u[lost] = domain.split(fresh)
            if not long:
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


class Law(ABC):
    """A distribution of the hidden state, which may depend on x; its draws keep columns `index` between `low` and `high`."""

    low: Array
    high: Array
    index: Any = slice(None)

    @abstractmethod
    def draw(self, key: Keys, x: Array) -> Array:
        """(n, nh): one draw per row, by its key alone."""

    def extremes(self, x: Array, count: int) -> list[Array]:
        """About `count` alternatives (n, nh) at the same x, which span the distribution's support; here, draws."""
        return [self.draw(keys(k, x), x) for k in range(count)]

    def outside(self, hidden: Array) -> Bools:
        """(n,): which hidden states certainly lie outside what draws can reach, since they leave its box."""
        h = hidden[:, self.index]
        return np.asarray(((h < self.low) | (h > self.high)).any(axis=1))

    @abstractmethod
    def describe(self) -> str:
        """The distribution in words, after `hidden state`."""

    def follows(self) -> str:
        """What is assumed, besides, of a law that depends on x: constants are those under a common hidden state."""
        return ""

    @abstractmethod
    def digest(self) -> str:
        """SHA-256 of everything that determines the draws."""


@final
class Ranges(Law):
    """Each named hidden state uniform on its range, the others at their default."""

    def __init__(self, system: System, ranges: Mapping[str, Range]) -> None:
        known = {s.name: s for s in system.hidden}
        for name, (low, high) in ranges.items():
            if name not in known:
                raise UsageError(f"hidden: '{name}' is no hidden state; there are {', '.join(known) or 'none'}")
            if known[name].kind == "quaternion":
                raise UsageError(f"hidden: '{name}' is a rotation, which no range can name; use sample: {{visited: {{}}}}")
            if not low <= high:
                raise UsageError(f"hidden: {name} = [{low}, {high}] is inverted; expected low ≤ high")
        self.ranges = {n: (float(low), float(high)) for n, (low, high) in ranges.items()}
        self.base = tuple(float(v) for v in system.hidden_default)
        parts = [(part.start, s.name) for s, part in zip(system.hidden, columns(system.hidden), strict=True)]
        self.index = np.array([at for at, name in parts if name in ranges], dtype=np.intp)
        chosen = [self.ranges[name] for _, name in parts if name in ranges]
        self.low, self.high = (np.array([c[k] for c in chosen], dtype=np.float64) for k in (0, 1))

    def draw(self, key: Keys, x: Array) -> Array:
        h = np.tile(np.asarray(self.base), (len(key), 1))
        h[:, self.index] = self.low + (self.high - self.low) * uniforms(key, len(self.index))
        return h

    def extremes(self, x: Array, count: int) -> list[Array]:
        """Half of them vertices of the box, half inside it."""
        ends = list(itertools.islice(itertools.product((0.0, 1.0), repeat=len(self.index)), THRESHOLDS.hidden_vertices))
        rng = np.random.default_rng(len(self.index))
        if 2 ** len(self.index) > THRESHOLDS.hidden_vertices:
            ends = [tuple(v) for v in rng.integers(0, 2, (THRESHOLDS.hidden_vertices, len(self.index))).astype(float)]
        picked = rng.permutation(len(ends))[: max(2, count // 2)]
        shares = [np.asarray(ends[k]) for k in picked] + list(rng.random((count - len(picked), len(self.index))))
        out = []
        for share in shares:
            h = np.tile(np.asarray(self.base), (len(x), 1))
            h[:, self.index] = self.low + (self.high - self.low) * share
            out.append(h)
        return out

    def describe(self) -> str:
        return "uniform on " + " × ".join(f"{n} ∈ [{low:g}, {high:g}]" for n, (low, high) in self.ranges.items())

    def digest(self) -> str:
        return json_digest("ranges", self.ranges, self.base)


@final
class Visited(Law):
    """The hidden state of one of the `near` visited states that are closest in x, each axis scaled by the domain's width.

    So hidden states stay consistent with x, as wheel speeds with a velocity. Axes in `ignore` do not count for closeness.
    """

    def __init__(self, pool: Pool, width: Array, near: int, names: Collection[str], ignore: Collection[str] = ()) -> None:
        if len(pool) < near:
            raise UsageError(
                f"hidden.sample.visited: rollouts left {len(pool)} states in the domain, and near is {near}; give more runs "
                f"or steps"
            )
        self.pool, self.near = pool, near
        counts = np.array([n not in ignore for n in names])
        self.scale = np.where(counts, 1 / width, 0.0)
        self.low, self.high = pool.h.min(axis=0), pool.h.max(axis=0)

    def nearest(self, x: Array) -> Ints:
        """(n, near): which visited states are closest."""
        from scipy.spatial import cKDTree

        _, index = cKDTree(self.pool.x * self.scale).query(x * self.scale, k=self.near)
        return np.asarray(index, dtype=np.intp).reshape(len(x), self.near)

    def draw(self, key: Keys, x: Array) -> Array:
        pick = np.minimum((uniforms(key, 1)[:, 0] * self.near).astype(np.intp), self.near - 1)
        return np.asarray(self.pool.h[self.nearest(x)[np.arange(len(x)), pick]])

    def extremes(self, x: Array, count: int) -> list[Array]:
        """All of them: there are no other draws at this x."""
        index = self.nearest(x)
        return [self.pool.h[index[:, k]] for k in range(self.near)]

    def describe(self) -> str:
        return f"that of one of the {self.near} nearest of {len(self.pool)} states visited in rollouts"

    def follows(self) -> str:
        return (
            "; constants were taken under a common hidden state, so how the visited ones change with x has to lie within "
            "constants and spread"
        )

    def digest(self) -> str:
        h = hashlib.sha256(json.dumps(["visited", self.near]).encode())
        for array in (self.pool.x, self.pool.h, self.scale):
            h.update(np.ascontiguousarray(array).tobytes())
        return h.hexdigest()


@final
class Around(Law):
    """Hidden state that seemed harmless: at its default, as long rollouts leave it, or moved, a third each."""

    def __init__(self, system: System, domain: Domain, ranges: Mapping[str, Range], seed: int) -> None:
        met = visited(system, domain, THRESHOLDS.harmless_runs, THRESHOLDS.harmless_steps, seed, long=True).h
        rng, base = np.random.default_rng([seed, 0x41E0]), default(system, max(1, len(met)))
        far = base + rng.random(base.shape) * (moved(system, len(base), rng, ranges) - base)
        for spec, part in zip(system.hidden, columns(system.hidden), strict=True):
            if spec.kind == "quaternion":
                far[:, part] /= np.linalg.norm(far[:, part], axis=1, keepdims=True)
        self.pool = np.vstack([base, met if len(met) else base, far])
        self.low, self.high = self.pool.min(axis=0), self.pool.max(axis=0)

    def draw(self, key: Keys, x: Array) -> Array:
        return np.asarray(self.pool[(uniforms(key, 1)[:, 0] * len(self.pool)).astype(np.intp)])

    def describe(self) -> str:
        long = f"as rollouts of up to {THRESHOLDS.harmless_steps} steps leave it"
        return f"in equal parts at its default, {long}, and moved from its default as the probe does"

    def digest(self) -> str:
        return json_digest("around", hashlib.sha256(self.pool.tobytes()).hexdigest())


@final
class HiddenDraws(Backend):
    """f̂(x, u) with its hidden state drawn by a law, as a pure function of the seed and of the bits of (x, u)."""

    def __init__(self, system: System, law: Law, seed: int) -> None:
        self.states, self.inputs, self.period, self.substeps = system.states, system.inputs, system.period, system.substeps
        self.parameters, self.coordinates = system.parameters, system.coordinates
        self.capabilities = system.capabilities - {"hidden"}
        self.system, self.law, self.seed = system, law, seed

    def hidden_at(self, x: Array, u: Array) -> Array:
        """(n, nh): the hidden state that a step from (x, u) starts with."""
        # Because the bits of (x, u) decide, no two points share a draw: the audit, whose points no fit has seen, attacks with
        # hidden states that no fit has seen either.
        return self.law.draw(keys(self.seed, np.hstack([x, u])), x)

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        return self.system.step(x, u, hidden=self.hidden_at(x, u), **options).x

    def resolution(self, magnitude: Array) -> Array:
        return self.system.resolution(magnitude)

    def digest(self) -> str:
        return json_digest(type(self).__qualname__, self.system.digest(), self.law.digest(), self.seed)


@final
@dataclass(frozen=True)
class Paired:
    """r(end) − r(start) of pairs (n, 2 nz) under one common hidden state, that of the start: (n, nx).

    If every r(·, h) has constant L, so has the middle of its band over h; slopes between two draws would measure the band.
    """

    model: Model
    draws: HiddenDraws

    def __call__(self, both: Array) -> Array:
        nz, nx = both.shape[1] // 2, self.model.nx
        hidden = self.draws.hidden_at(both[:, :nx], both[:, nx:nz])
        ends = []
        for x, u in ((both[:, :nx], both[:, nx:nz]), (both[:, nz : nz + nx], both[:, nz + nx :])):
            after = self.draws.system.step(x, u, hidden=hidden).x
            ends.append(difference(self.model.states, after, self.model.step(x, u).x))
        return np.asarray(ends[1] - ends[0])


def beginning(law: Law, x: Array, seed: int) -> Array:
    """(n, nh): hidden states to begin closed loops with, drawn by the law that the certificate is about; row by row."""
    rows = np.arange(len(x), dtype=np.float64)[:, None]
    return law.draw(keys(seed, np.hstack([rows, x])), x)
