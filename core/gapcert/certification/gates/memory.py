"""A model that remembers: what it remembers becomes hidden state of the comparison, over a declared range."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, final

import numpy as np

from gapcert.contracts.systems.scene import Scene
from gapcert.contracts.systems.system import Backend, Extension, Model, Step, System, difference
from gapcert.numerics.arrays import Array
from gapcert.numerics.digest import json_digest
from gapcert.numerics.errors import UsageError
from gapcert.numerics.intervals import Interval


def unmeasured(model: Model, backend: System, declared: Collection[str]) -> tuple[Model, System]:
    """f with its memory z at the default z₀, and f̂ with z among its hidden states; themselves where z is not declared.

    x⁺ = f(x, u, z₀) + f̂(x, u, h) − f(x, u, z), so that the residual of the pair is f̂ − f at the z that is drawn, and what
    bounds it over the range of z bounds the gap whatever the model remembers.
    """
    if not model.hidden or not {s.name for s in model.hidden} <= set(declared):
        return model, backend
    if any(s.size > 1 for s in (*model.states, *model.hidden)):
        raise UsageError("certify: a model that remembers needs states that are numbers or angles, not rotations")
    resting = Resting(model)
    return resting, Remembering(model, resting, backend)


@final
class Resting(Model):
    """f(x, u, z₀): a model whose memory is always at its default."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.states, self.inputs, self.outputs = model.states, model.inputs, model.outputs
        self.period, self.substeps, self.parameters = model.period, model.substeps, model.parameters
        self.coordinates, self.capabilities = model.coordinates, model.capabilities - {"hidden"}

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        return self.model.step(x, u, **options).x

    def jacobian(self, x: Array, u: Array) -> Array:
        return self.model.jacobian(x, u)

    def enclosure(self, z: Interval) -> Interval:
        return self.model.enclosure(z)

    def jacobian_enclosure(self, z: Interval) -> Interval:
        return self.model.jacobian_enclosure(z)

    def curvature_enclosure(self, z: Interval, axis: int) -> Interval:
        return self.model.curvature_enclosure(z, axis)

    def output(self, x: Array, u: Array, parameters: Mapping[str, Array | float] | None = None) -> Array:
        return self.model.output(x, u, parameters)

    def resolution(self, magnitude: Array) -> Array:
        return self.model.resolution(magnitude)

    def digest(self) -> str:
        return json_digest(type(self).__qualname__, self.model.digest())

    def extend(self, extensions: Sequence[Extension]) -> Model:
        return Resting(self.model.extend(extensions))

    def equations(self) -> str:
        return self.model.equations()

    def to_spec(self) -> dict[str, Any]:
        return self.model.to_spec()

    def sites(self, kind: str) -> tuple[str, ...]:
        return self.model.sites(kind)

    def force_unit(self, site: str) -> str | None:
        return self.model.force_unit(site)


@final
class Remembering(Backend):
    """f̂ with the model's memory beside its own hidden state, see `unmeasured`."""

    def __init__(self, model: Model, resting: Resting, backend: System) -> None:
        self.model, self.resting, self.backend = model, resting, backend
        self.states, self.inputs, self.period = backend.states, backend.inputs, backend.period
        self.substeps, self.parameters, self.coordinates = backend.substeps, (), ()
        self.hidden = backend.hidden + model.hidden
        self.hidden_default = (*backend.hidden_default, *model.hidden_default)
        # A seed stays, so that it is refused; forces and parameters have no meaning for a difference.
        self.capabilities = frozenset(c for c in ("hidden", *backend.capabilities) if c in ("hidden", "seed"))

    def scene(self, x: Array, hidden: Array | None = None) -> Scene | None:
        own = sum(s.size for s in self.backend.hidden)
        return self.backend.scene(x, None if hidden is None or not own else hidden[:, :own])

    def _step(self, x: Array, u: Array, **options: Any) -> Step:
        own = sum(s.size for s in self.backend.hidden)
        hidden = options["hidden"]
        there = self.backend.step(x, u, hidden=hidden[:, :own] if own else None)
        here = self.model.step(x, u, hidden=np.ascontiguousarray(hidden[:, own:]))
        after = self.resting.step(x, u).x + difference(self.states, there.x, here.x)
        assert here.hidden is not None, "a model that remembers hands its memory on"
        return Step(after, here.hidden if there.hidden is None else np.hstack([there.hidden, here.hidden]))

    def resolution(self, magnitude: Array) -> Array:
        return self.backend.resolution(magnitude) + 2 * self.model.resolution(magnitude)

    def digest(self) -> str:
        return json_digest(type(self).__qualname__, self.model.digest(), self.backend.digest())


def forgets(model: Model) -> str:
    """Why there is no controller for a model that remembers, in a sentence."""
    names = ", ".join(s.name for s in model.hidden)
    return f"the model remembers {names}, and a controller knows the state alone; use a model without memory"
