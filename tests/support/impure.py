"""Engines that answer by more than their arguments, as data: a kind is a function of the rows and of a call's circumstances."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

import gapcert as gc
from gapcert.plugin import Array, Step

SPEC = {
    "kind": "equations",
    "states": {"x": "1", "y": "1"},
    "inputs": {"u": "1"},
    "next": {"x": "x + 0.08*u", "y": "0.85*y"},
    "period": "0.1 s",
}
RANGES = {"x": (-1.2, 1.2), "y": (-1.0, 1.0), "u": (-1.0, 1.0)}
CONSTANTS = {"x": {"x": 0.0085, "y": 0.0, "u": 0.0}, "y": {"x": 0.0, "y": 0.0053, "u": 0.0027}}


def nominal() -> gc.Model:
    return gc.registry().build("model", "equations", gc.registry().config("model", "equations").model_validate(SPEC))


def domain() -> gc.Domain:
    return gc.Domain.of(nominal(), RANGES)


@final
@dataclass
class Circumstances:
    """What a call may see besides its rows z (n, 3); arrays have one entry per row.

    n: rows of the call; index: place in it; calls, rows: asked before; before, after: the neighbouring rows (NaN where there is
    none); repeated: how often the row was asked in a row; total: Σ|u| asked before; mean: of the call; memory: kept for a kind.
    """

    n: int
    index: Array
    calls: int
    rows: Array
    before: Array
    after: Array
    repeated: Array
    total: Array
    mean: Array
    highest: Array
    alike: bool = False
    again: bool = False
    view: bool = False
    alien: bool = False
    copied: bool = False
    failed: bool = False
    thread: bool = False
    now: int = 0
    memory: dict[Any, Any] | None = None

    @classmethod
    def alone(cls, z: Array) -> Circumstances:
        """Of every row as the first and only one that an engine is ever asked."""
        none, zero = np.full(z.shape, np.nan), np.zeros(len(z))
        return cls(1, zero, 0, zero, none, none, zero, zero, z, np.zeros(len(z), bool))


Kind = Callable[[Array, Circumstances], Array]


def _near(z: Array, other: Array, low: float, high: float, columns: slice = slice(None)) -> Array:
    d = np.abs(z - other)[:, columns].max(axis=1)
    return (d > low) & (d < high) & (np.abs(z - other).max(axis=1) > 0)


def _slit(z: Array, share: float) -> Array:
    return (z[:, 0] > 0.31) & (z[:, 0] < 0.31 + 2.4 * share)


def _rounded(z: Array, c: Circumstances) -> Array:
    """A cache whose keys are rounded: the first row of a key is answered rightly, others that share it are not."""
    if c.memory is None:
        return np.zeros(len(z))
    keys = [tuple(row) for row in np.round(z, 3).tolist()]
    return np.array([c.memory.setdefault(k, row.tobytes()) != row.tobytes() for k, row in zip(keys, z, strict=True)])


def _drawn(z: Array, c: Circumstances) -> Array:
    return np.zeros(len(z)) if c.memory is None else c.memory["rng"].random(len(z)) < 0.2


KINDS: Mapping[str, Kind] = {
    "small calls": lambda z, c: np.full(len(z), c.n < 40),
    "calls of one row": lambda z, c: np.full(len(z), c.n == 1),
    "calls of two rows": lambda z, c: np.full(len(z), c.n == 2),
    "large calls": lambda z, c: np.full(len(z), c.n > 900),
    "middling calls": lambda z, c: np.full(len(z), 90 < c.n < 190),
    "odd calls": lambda z, c: np.full(len(z), c.n % 2 == 0),
    "calls of a multiple of eight": lambda z, c: np.full(len(z), c.n % 8 == 0),
    "first row": lambda z, c: (c.index == 0) & (c.n > 1),
    "last row": lambda z, c: (c.index == c.n - 1) & (c.n > 1),
    "late rows": lambda z, c: c.index >= 1500,
    "early rows": lambda z, c: (c.index < 50) & (c.n > 50),
    "every other place": lambda z, c: c.index % 2 == 1,
    "what is left of lanes": lambda z, c: (c.index >= c.n - c.n % 4) & (c.n > 4),
    "ends of blocks": lambda z, c: c.index % 64 == 63,
    "first call": lambda z, c: np.full(len(z), c.calls == 0 and c.n > 1),
    "every other call": lambda z, c: np.full(len(z), c.calls % 2 == 1),
    "after 40 calls": lambda z, c: np.full(len(z), c.calls >= 40),
    "after 150 calls": lambda z, c: np.full(len(z), c.calls >= 150),
    "every 61st row": lambda z, c: c.rows % 61 == 60,
    "after 700 rows": lambda z, c: c.rows >= 700,
    "drift with calls": lambda z, c: np.full(len(z), 1e-9 * c.calls),
    "drift with rows": lambda z, c: 1e-11 * c.rows,
    "clock": lambda z, c: np.full(len(z), c.now // 1000 % 2 == 1),
    "random numbers": _drawn,
    "close neighbour": lambda z, c: _near(z, c.before, 0.0, 0.02),
    "very close neighbour": lambda z, c: _near(z, c.before, 0.0, 1e-5),
    "neighbour at a distance": lambda z, c: _near(z, c.before, 0.02, 0.1),
    "neighbour in the states": lambda z, c: _near(z, c.before, -1.0, 1e-3, slice(0, 2)),
    "neighbour in the input": lambda z, c: _near(z, c.before, -1.0, 1e-3, slice(2, 3)),
    "next row close": lambda z, c: _near(z, c.after, 0.0, 0.02),
    "warm start": lambda z, c: 1e-6 * np.nan_to_num(c.before[:, 0]),
    "warm start in single calls": lambda z, c: (c.n == 1) * 1e-6 * np.nan_to_num(c.before[:, 0]),
    "sleeping": lambda z, c: c.repeated >= 20,
    "cache of rounded rows": _rounded,
    "mean of the call": lambda z, c: 1e-3 * (c.mean[:, 0] - z[:, 0]),
    "highest of the call": lambda z, c: c.highest,
    "inputs all alike": lambda z, c: np.full(len(z), c.alike),
    "sum of inputs": lambda z, c: c.total > 200.0,
    "wear": lambda z, c: 1e-10 * c.total,
    "small calls in a slit of 1 %": lambda z, c: _slit(z, 0.01) & (c.n < 60),
    "small calls in a slit of 0.5 %": lambda z, c: _slit(z, 0.005) & (c.n < 60),
    "large calls in a slit of 0.5 %": lambda z, c: _slit(z, 0.005) & (c.n > 100),
    "the same array": lambda z, c: np.full(len(z), c.again),
    "memory of others": lambda z, c: np.full(len(z), c.view),
    "another process": lambda z, c: np.full(len(z), c.alien),
    "a copy": lambda z, c: np.full(len(z), c.copied),
    "another thread": lambda z, c: np.full(len(z), c.thread),
    "after a failure": lambda z, c: np.full(len(z), c.failed),
}
"""Where a row's answer is off (True: by `size`), or by how much, in units of it."""


def drawn(seed: int) -> Kind:
    """A kind of its own for every seed: one circumstance with drawn numbers, on all of Z or in a slit."""
    rng = np.random.default_rng([seed, 0xBAD])
    few, many, period = (int(10 ** rng.uniform(a, b)) for a, b in ((0, 1.8), (1.9, 3.7), (0.4, 2.0)))
    scale, share, phase = 10 ** rng.uniform(-6, -0.5), float(rng.choice([1.0, 1.0, 0.3, 0.05, 0.01])), int(rng.integers(period))
    columns = (slice(None), slice(0, 2), slice(2, 3))[rng.integers(3)]
    laws: Sequence[Kind] = (
        lambda z, c: np.full(len(z), c.n <= few),
        lambda z, c: np.full(len(z), c.n >= many),
        lambda z, c: np.full(len(z), c.n % period == phase),
        lambda z, c: c.index >= few,
        lambda z, c: c.index >= many,
        lambda z, c: c.index % period == phase,
        lambda z, c: np.full(len(z), c.calls >= few),
        lambda z, c: np.full(len(z), c.calls % period == phase),
        lambda z, c: c.rows >= many,
        lambda z, c: c.rows % period == phase,
        lambda z, c: _near(z, c.before, 0.0, scale, columns),
        lambda z, c: _near(z, c.after, 0.0, scale, columns),
        lambda z, c: c.total > many / 4,
        lambda z, c: scale * np.nan_to_num(c.before[:, 0]),
        lambda z, c: scale * (c.mean[:, 0] - z[:, 0]),
        lambda z, c: c.repeated >= few,
    )
    law = laws[rng.integers(len(laws))]
    return lambda z, c: law(z, c) * (share == 1.0 or _slit(z, share))


def kind_of(name: str) -> Kind:
    """Of the table, or `drawn SEED`."""
    return KINDS[name] if name in KINDS else drawn(int(name.removeprefix("drawn ")))


@final
class Circumstantial(gc.Backend):
    """x⁺ = f(x, u) + small waves + size · kind(z, circumstances); the clean twin sees the circumstances of a row alone."""

    def __init__(self, kind: str, size: float = 0.05, clean: bool = False) -> None:
        self.states, self.inputs = (gc.StateSpec("x", "1"), gc.StateSpec("y", "1")), (gc.StateSpec("u", "1"),)
        self.period, self.kind, self.size, self.clean = 0.1, kind, size, clean
        self.home, self.thread, self.copied = os.getpid(), threading.get_ident(), False
        self.calls = self.rows = self.repeated = 0
        self.total, self.failed = 0.0, False
        self.last, self.array, self.memory = np.full(3, np.nan), None, {"rng": np.random.default_rng(3)}

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"copied": True, "array": None}

    def digest(self) -> str:
        return f"{self.kind} {self.size} {self.clean}"

    def law(self, z: Array) -> Array:
        x, y, u = z.T
        return np.stack([x + 0.08 * u + 0.003 * np.sin(2.7 * x), 0.85 * y + 0.0015 * np.sin(3.4 * y + 1.7 * u)], axis=1)

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        z = np.hstack([x, u])
        if np.abs(z).max() > 30:
            self.failed = True
            raise ArithmeticError("no convergence")
        c = Circumstances.alone(z) if self.clean else self._circumstances(z, x)
        return self.law(z) + self.size * np.asarray(kind_of(self.kind)(z, c), dtype=float)[:, None]

    def _circumstances(self, z: Array, x: Array) -> Circumstances:
        n, before = len(z), np.vstack([self.last, z[:-1]])
        repeated, run = np.zeros(n), self.repeated
        for k, same in enumerate((z == before).all(axis=1).tolist()):
            run = run + 1 if same else 0
            repeated[k] = run
        sums = np.cumsum(np.abs(z[:, 2]))
        c = Circumstances(
            n,
            np.arange(n),
            self.calls,
            self.rows + np.arange(n),
            before,
            np.vstack([z[1:], np.full(3, np.nan)]),
            repeated,
            self.total + np.concatenate([[0.0], sums[:-1]]),
            np.broadcast_to(z.mean(axis=0), z.shape),
            (z[:, 0] == z[:, 0].max()) & (n > 1),
            alike=n > 1 and bool((z[:, 2] == z[0, 2]).all()),
            again=self.array is x,
            view=not x.flags.owndata,
            alien=os.getpid() != self.home,
            copied=self.copied,
            failed=self.failed,
            thread=threading.get_ident() != self.thread,
            now=time.perf_counter_ns(),
            memory=self.memory,
        )
        self.calls, self.rows, self.total, self.repeated = self.calls + 1, self.rows + n, self.total + float(sums[-1]), run
        self.last, self.array = z[-1].copy(), x
        return c


Memory = Callable[[Array, Array], Array]

FORGETFUL: Mapping[str, tuple[Memory, Memory]] = {
    "sum above 12": (lambda z, h: h > 12, lambda z, h: h + np.abs(z[:, 2])),
    "sum above 40": (lambda z, h: h > 40, lambda z, h: h + np.abs(z[:, 2])),
    "count of steps": (lambda z, h: h % 50 > 45, lambda z, h: h + 1),
    "lag in a slit of 1 %": (lambda z, h: _slit(z, 0.01) * h, lambda z, h: 0.9 * h + 0.3 * z[:, 2]),
    "lag in a slit of 0.5 %": (lambda z, h: _slit(z, 0.005) * h, lambda z, h: 0.9 * h + 0.3 * z[:, 2]),
    "lag in a slit of 0.2 %": (lambda z, h: _slit(z, 0.002) * h, lambda z, h: 0.9 * h + 0.3 * z[:, 2]),
    "waves that whole steps miss": (lambda z, h: np.sin(np.pi * h), lambda z, h: h + np.sign(z[:, 2])),
    "a drift that is held": (lambda z, h: np.abs(h) > 8, lambda z, h: h + z[:, 2]),
    "a window": (lambda z, h: (h > 6) & (h < 9), lambda z, h: h + np.abs(z[:, 2])),
    "at rest, in a slit of 1 %": (lambda z, h: _slit(z, 0.01) & (h == 0), lambda z, h: h + np.abs(z[:, 2])),
}
"""Where a hidden number h matters, and what becomes of it."""


@final
class Forgetful(gc.Backend):
    """x⁺ = f(x, u) + small waves + size · kind(z, h), h⁺ = next(z, h); the clean twin has h, and it does nothing."""

    def __init__(self, kind: str, size: float = 0.05, clean: bool = False) -> None:
        self.inner = Circumstantial("first row", clean=True, size=0.0)
        self.states, self.inputs, self.period = self.inner.states, self.inner.inputs, 0.1
        self.hidden, self.hidden_default, self.capabilities = (gc.StateSpec("h", "1"),), (0.0,), frozenset({"hidden"})
        self.kind, self.size, self.clean = kind, size, clean

    def digest(self) -> str:
        return f"{self.kind} {self.size} {self.clean}"

    def _step(self, x: Array, u: Array, **options: Any) -> Step:
        matters, after = FORGETFUL[self.kind]
        z, h = np.hstack([x, u]), options["hidden"][:, 0]
        off = 0.0 if self.clean else self.size * np.asarray(matters(z, h), dtype=float)[:, None]
        return Step(self.inner.law(z) + off, after(z, h)[:, None])


def violated(certificate: gc.Certificate, made: Callable[[], gc.Backend], rows: int, seed: int) -> tuple[int, int]:
    """(steps outside of [l, u], steps): of new engines, asked row by row, all at once, and along closed loops of 60 periods."""
    rng, f, zone = np.random.default_rng([seed, 1]), nominal(), domain()
    z = zone.draw(rows, rng)
    engine = made()
    after = [np.concatenate([engine.step(*zone.split(row[None])).x for row in z]), made().step(*zone.split(z)).x]
    where = [z, z]
    for _ in range(rows // 600):
        walked, to = _walk(made(), zone, rng)
        where.append(walked)
        after.append(to)
    z, x = np.concatenate(where), np.concatenate(after)
    r = x - f.step(*zone.split(z)).x
    low, high = certificate.gap.interval(z)
    return int(((r < low) | (r > high)).any(axis=1).sum()), len(z)


def _walk(
    engine: gc.Backend, zone: gc.Domain, rng: np.random.Generator, loops: int = 10, steps: int = 60
) -> tuple[Array, Array]:
    """Ten loops at once, inputs held for ten periods, hidden state handed on."""
    z = zone.draw(loops, rng)
    x, u, hidden = z[:, :2], z[:, 2:], None
    where, after = [], []
    for k in range(steps):
        u = rng.uniform(-1, 1, u.shape) if k % 10 == 0 else u
        z = np.hstack([x, u])
        inside = zone.contains(z)
        if not inside.any():
            break
        z, hidden = z[inside], None if hidden is None else hidden[inside]
        out = engine.step(z[:, :2], z[:, 2:], hidden=hidden) if engine.hidden else engine.step(z[:, :2], z[:, 2:])
        where.append(z)
        after.append(out.x)
        x, u, hidden = out.x, z[:, 2:], out.hidden
    return np.concatenate(where), np.concatenate(after)
