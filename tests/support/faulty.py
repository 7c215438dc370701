"""Toy systems with the faults of real engines, planted: what the gates before a certificate must catch."""

from __future__ import annotations

import os
from typing import Any, final

import numpy as np

from gapcert.contracts.systems.system import Backend, Model, StateSpec, Step
from gapcert.numerics.arrays import Array


@final
class WarmStart(Backend):
    """f̂ = f + leak · (the last query's x): a solver that starts from its previous solution."""

    def __init__(self, model: Model, leak: float = 1e-9) -> None:
        self.states, self.inputs, self.period = model.states, model.inputs, model.period
        self.model, self.leak, self.last = model, leak, np.zeros(model.nx)

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        before = np.vstack([self.last, x[:-1]])
        self.last = x[-1].copy()
        return np.asarray(self.model.step(x, u).x + self.leak * before)


@final
class Sleeping(Backend):
    """f̂ = f until `patience` queries in a row moved less than `speed`: a body that an engine has put to sleep stays put."""

    def __init__(self, model: Model, patience: int = 20, speed: float = 0.1) -> None:
        self.states, self.inputs, self.period = model.states, model.inputs, model.period
        self.model, self.patience, self.speed, self.idle = model, patience, speed, 0

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        out = self.model.step(x, u).x
        for k in range(len(x)):
            self.idle = self.idle + 1 if np.abs(out[k] - x[k]).max() < self.speed * self.period else 0
            if self.idle > self.patience:
                out[k] = x[k]
        return out


@final
class PerProcess(Backend):
    """f̂ = f + size in every process but the one that made it: a cache, a locale or a hash seed that does not travel."""

    def __init__(self, model: Model, size: float = 1e-7) -> None:
        self.states, self.inputs, self.period = model.states, model.inputs, model.period
        self.model, self.size, self.home = model, size, os.getpid()

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        return np.asarray(self.model.step(x, u).x + self.size * (os.getpid() != self.home))


@final
class Coasting(Backend):
    """p⁺ = p + τ ((1 − a) v + a u), v⁺ = v + a (u − v): a body that follows its command with lag; v is hidden, and so is a
    `wear` that does nothing.

    Against p⁺ = p + τ u the residual is τ (1 − a)(v − u), at most 2 τ (1 − a) for |u|, |v| ≤ 1: known for every hidden state.
    """

    def __init__(self, period: float = 0.1, agility: float = 0.5) -> None:
        self.states, self.inputs = (StateSpec("p", "m"),), (StateSpec("u", "m/s"),)
        self.period, self.agility = period, agility
        self.hidden, self.hidden_default = (StateSpec("v", "m/s"), StateSpec("wear", "m")), (0.0, 0.0)
        self.capabilities = frozenset({"hidden"})

    def _step(self, x: Array, u: Array, **options: Any) -> Step:
        v, a = options["hidden"][:, :1], self.agility
        p = x + self.period * ((1 - a) * v + a * u)
        return Step(p, np.hstack([v + a * (u - v), options["hidden"][:, 1:]]))
