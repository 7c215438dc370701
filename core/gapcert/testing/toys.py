"""Small Systems whose residual is known exactly: for tests of everything that is built on a residual."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, final

import numpy as np

from gapcert.contracts.systems.system import Backend, Model, StateSpec, Step
from gapcert.numerics.arrays import Array
from gapcert.numerics.errors import UsageError
from gapcert.numerics.intervals import Interval

Field = Callable[[Array], Array]
PLAIN: Mapping[str, Any] = {
    "kind": "equations",
    "states": {"q": "m/s"},
    "inputs": {"u": "m/s^2"},
    "parameters": {"k": "0.5 Hz"},
    "derivative": {"q": "u - k*q"},
    "integrator": "rk4",
    "period": "10 ms",
}
"""A first-order lag as the `model:` of a spec."""


@final
class Drift(Model):
    """x⁺ = x + τ u, with as many inputs as states."""

    def __init__(self, n: int = 2, period: float = 0.1) -> None:
        self.states = tuple(StateSpec(f"x{i}", "m") for i in range(n))
        self.inputs = tuple(StateSpec(f"u{i}", "m/s") for i in range(n))
        self.outputs = self.states
        self.period = period

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        return np.asarray(x + self.period * u)

    def jacobian(self, x: Array, u: Array) -> Array:
        row = np.hstack([np.eye(self.nx), self.period * np.eye(self.nx)])
        return np.broadcast_to(row, (len(x), *row.shape)).copy()

    def enclosure(self, z: Interval) -> Interval:
        return z[:, : self.nx] + z[:, self.nx :] * self.period

    def jacobian_enclosure(self, z: Interval) -> Interval:
        return Interval.exact(self.jacobian(z.lo[:, : self.nx], z.lo[:, self.nx :]))

    def equations(self) -> str:
        return "\n".join(
            f"{s.name}⁺ = {s.name} + {self.period:g} {u.name}" for s, u in zip(self.states, self.inputs, strict=True)
        )

    def to_spec(self) -> dict[str, Any]:
        nexts = {s.name: f"{s.name} + tau*{u.name}" for s, u in zip(self.states, self.inputs, strict=True)}
        return {
            "kind": "equations",
            "states": {s.name: s.unit for s in self.states},
            "inputs": {u.name: u.unit for u in self.inputs},
            "parameters": {"tau": f"{self.period!r} s"},  # a bare number has no seconds, and metres are no m/s
            "next": nexts,
            "period": f"{self.period!r} s",
        }


@final
class Perturbed(Backend):
    """f̂ = f + field(z): the residual is the field, up to rounding. `field` must be picklable and act row by row."""

    def __init__(self, model: Model, field: Field) -> None:
        self.states, self.inputs, self.period = model.states, model.inputs, model.period
        self.model, self.field = model, field

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        return self.model.step(x, u).x + self.field(np.hstack([x, u]))


def ripple(z: Array) -> Array:
    """A smooth field in as many states as z has halves: 0.01 sin(3 x_i) + 0.02 u_i² + 0.005."""
    n = z.shape[1] // 2
    return np.asarray(0.01 * np.sin(3 * z[:, :n]) + 0.02 * z[:, n:] ** 2 + 0.005)


def ripple_lipschitz(n: int, input_bound: float) -> Array:
    """Its exact per-axis constants (n, 2n) for |u| ≤ input_bound: 0.03 in x_i (attained at 0), 0.04 input_bound in u_i."""
    return np.hstack([0.03 * np.eye(n), 0.04 * input_bound * np.eye(n)])


def _unknown(*asked: Any) -> Any:
    raise UsageError("opaque: nothing is known of the model but its steps")


_UNKNOWN: Any = _unknown


@final
class Opaque(Model):
    """A model that answers steps, and tells nothing else; asked for more, it raises a UsageError."""

    def __init__(self, model: Model) -> None:
        self.model, self.states, self.inputs, self.period = model, model.states, model.inputs, model.period

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        return self.model.step(x, u).x

    def fast_rollout(self, x0: Array, u: Array, **options: Any) -> Step:
        return self.model.fast_rollout(x0, u, **options)

    jacobian = enclosure = jacobian_enclosure = extend = equations = to_spec = sites = _UNKNOWN
