"""Hidden state that changes its place.

That of f̂ becomes state: f̂ with it measured, and f with h⁺ = h beside its own equations. What a model remembers becomes hidden
state of the comparison, over a declared range.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import partialmethod
from typing import Any, final

import numpy as np

from gapcert.certification.gates.hidden_distribution import columns, default
from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.scene import Scene
from gapcert.contracts.systems.system import Backend, Extension, Model, StateSpec, Step, System, difference
from gapcert.numerics.arrays import Array
from gapcert.numerics.digest import json_digest
from gapcert.numerics.errors import UsageError
from gapcert.numerics.intervals import Interval


def widen(model: Model, backend: System, domain: Domain) -> tuple[Model, System]:
    """Both with the states of the domain that they lack, hidden states of the backend; themselves where they lack none."""
    names = [a.name for a in domain.states.axes]
    return augment_model(model, backend, names), augment(backend, names)


def augment(backend: System, names: Sequence[str]) -> System:
    """The backend with its hidden states among `names` as states, in the backend's order."""
    chosen = [s.name for s in backend.hidden if s.name in names]
    return Augmented(backend, chosen) if chosen else backend


def augment_model(model: Model, backend: System, names: Sequence[str]) -> Model:
    """The model with those of `names` that it lacks and that are states or hidden states of the backend held constant."""
    own = {s.name for s in (*model.states, *model.inputs)}
    added = tuple(s for s in (*backend.states, *backend.hidden) if s.name in names and s.name not in own)
    return AugmentedModel(model, added) if added else model


@final
class Augmented(Backend):
    """f̂ over (x, h): the chosen hidden states are states, the others stay hidden."""

    def __init__(self, system: System, names: Sequence[str]) -> None:
        specs = {s.name: (s, part) for s, part in zip(system.hidden, columns(system.hidden), strict=True)}
        for name in names:
            if specs[name][0].kind == "quaternion":
                raise UsageError(
                    f"hidden: '{name}' is a rotation, which has no range; use hidden: {{sample: {{visited: {{}}}}}}"
                )
        self.system, self.names = system, tuple(names)
        every = np.arange(len(system.hidden_default))
        self.shown = np.concatenate([every[specs[n][1]] for n in names])
        self.rest = np.setdiff1d(every, self.shown)
        self.states = system.states + tuple(specs[n][0] for n in names)
        self.inputs, self.period, self.substeps = system.inputs, system.period, system.substeps
        self.hidden = tuple(s for s in system.hidden if s.name not in names)
        self.hidden_default = tuple(np.asarray(system.hidden_default)[self.rest].tolist())
        self.parameters, self.coordinates = system.parameters, system.coordinates
        self.capabilities = system.capabilities if self.hidden else system.capabilities - {"hidden"}

    def _step(self, x: Array, u: Array, **options: Any) -> Step:
        nx = self.system.nx
        inner = default(self.system, len(x))
        inner[:, self.shown] = x[:, nx:]
        if self.hidden:
            inner[:, self.rest] = options.pop("hidden")
        out = self.system.step(np.ascontiguousarray(x[:, :nx]), u, hidden=inner, **options)
        assert out.hidden is not None, "a system with hidden state hands it on"
        return Step(np.hstack([out.x, out.hidden[:, self.shown]]), out.hidden[:, self.rest] if self.hidden else None)

    def scene(self, x: Array, hidden: Array | None = None) -> Scene | None:
        inner = default(self.system, len(x))
        inner[:, self.shown] = x[:, self.system.nx :]
        if hidden is not None:
            inner[:, self.rest] = hidden
        return self.system.scene(x[:, : self.system.nx], inner)

    def resolution(self, magnitude: Array) -> Array:
        """The hidden states are as coarse, relative to their size, as the coarsest of the others."""
        nx = self.system.nx
        own, plain = self.system.resolution(magnitude[:nx]), super().resolution(magnitude)
        return np.concatenate([own, plain[nx:] * max(1.0, float((own / plain[:nx]).max()))])

    def repeats(self, angle: str) -> str | None:
        return self.system.repeats(angle) if angle not in self.names else None

    def digest(self) -> str:
        return json_digest(type(self).__qualname__, self.system.digest(), self.names)


@final
class AugmentedModel(Model):
    """(x, h)⁺ = (f(x, u), h): what a model that does not know h says of it is that it stays."""

    def __init__(self, model: Model, added: Sequence[StateSpec]) -> None:
        self.model, self.added = model, tuple(added)
        self.states, self.inputs, self.outputs = model.states + self.added, model.inputs, model.outputs
        self.period, self.substeps, self.parameters = model.period, model.substeps, model.parameters
        self.coordinates, self.capabilities = model.coordinates, model.capabilities
        self.hidden, self.hidden_default = model.hidden, model.hidden_default

    def _step(self, x: Array, u: Array, **options: Any) -> Step:
        out = self.model.step(self._own(x), u, **options)
        return Step(np.hstack([out.x, x[:, self.model.nx :]]), out.hidden)

    def _own(self, x: Array) -> Array:
        return np.ascontiguousarray(x[:, : self.model.nx])

    def _inner(self, z: Interval) -> Interval:
        """The boxes of (x, u), without those of h."""
        keep = [*range(self.model.nx), *range(self.nx, self.nx + self.nu)]
        return z[:, keep]

    def _spread(self, inner: Array) -> Array:
        """∂(x, h)⁺/∂(x, h, u) from ∂x⁺/∂(x, u): zeros against h, and the identity in its own rows."""
        nx, nh = self.model.nx, len(self.added)
        out = np.zeros((len(inner), nx + nh, nx + nh + self.nu))
        out[:, :nx, :nx], out[:, :nx, nx + nh :] = inner[..., :nx], inner[..., nx:]
        out[:, np.arange(nx, nx + nh), np.arange(nx, nx + nh)] = 1.0
        return out

    def jacobian(self, x: Array, u: Array) -> Array:
        return self._spread(self.model.jacobian(self._own(x), u))

    def enclosure(self, z: Interval) -> Interval:
        inner, nx = self.model.enclosure(self._inner(z)), self.model.nx
        return Interval.concatenate([inner, z[:, nx : self.nx]], axis=1)

    def jacobian_enclosure(self, z: Interval) -> Interval:
        inner = self.model.jacobian_enclosure(self._inner(z))
        return Interval(self._spread(inner.lo), self._spread(inner.hi))

    def curvature_enclosure(self, z: Interval, axis: int) -> Interval:
        nx = self.model.nx
        if nx <= axis < self.nx:
            return Interval.exact(np.zeros((len(z), self.nx)))
        inner = self.model.curvature_enclosure(self._inner(z), axis if axis < nx else axis - len(self.added))
        return Interval.concatenate([inner, np.zeros((len(z), len(self.added)))], axis=1)

    def output(self, x: Array, u: Array, parameters: Any = None, hidden: Array | None = None) -> Array:
        return self.model.output(self._own(x), u, parameters, hidden)

    def resolution(self, magnitude: Array) -> Array:
        """h⁺ = h is exact."""
        return np.concatenate([self.model.resolution(magnitude[: self.model.nx]), np.zeros(len(self.added))])

    def rounding_over(self, z: Interval) -> Array | None:
        inner = self.model.rounding_over(self._inner(z))
        return None if inner is None else np.hstack([inner, np.zeros((len(z), len(self.added)))])

    def digest(self) -> str:
        return json_digest(type(self).__qualname__, self.model.digest(), [[s.name, s.unit, s.kind] for s in self.added])

    def repeats(self, angle: str) -> str | None:
        return "" if angle in [s.name for s in self.added] else self.model.repeats(angle)

    def extend(self, extensions: Sequence[Extension]) -> Model:
        return AugmentedModel(self.model.extend(extensions), self.added)

    def equations(self) -> str:
        return "\n".join([self.model.equations(), *(f"{s.name}⁺ = {s.name}" for s in self.added)])

    def to_spec(self) -> dict[str, Any]:
        """The model's own section: `hidden: augment` and the domain add the rest."""
        return self.model.to_spec()

    def sites(self, kind: str) -> tuple[str, ...]:
        return self.model.sites(kind)


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

    def _asked(self, name: str, *given: Any) -> Any:
        return getattr(self.model, name)(*given)

    jacobian: Any = partialmethod(_asked, "jacobian")
    enclosure: Any = partialmethod(_asked, "enclosure")
    jacobian_enclosure: Any = partialmethod(_asked, "jacobian_enclosure")
    curvature_enclosure: Any = partialmethod(_asked, "curvature_enclosure")
    output: Any = partialmethod(_asked, "output")
    resolution: Any = partialmethod(_asked, "resolution")
    rounding_over: Any = partialmethod(_asked, "rounding_over")
    rounding_terms: Any = partialmethod(_asked, "rounding_terms")
    equations: Any = partialmethod(_asked, "equations")
    to_spec: Any = partialmethod(_asked, "to_spec")
    sites: Any = partialmethod(_asked, "sites")
    force_unit: Any = partialmethod(_asked, "force_unit")

    def digest(self) -> str:
        return json_digest(type(self).__qualname__, self.model.digest())

    def extend(self, extensions: Sequence[Extension]) -> Model:
        return Resting(self.model.extend(extensions))


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
