"""Backends side by side: asked the same questions, through the same shards as any certificate's samples."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast, final

import numpy as np

from gapcert.plugin import (
    Array,
    Build,
    Domain,
    Emit,
    Event,
    MissingDependency,
    Model,
    Points,
    Residual,
    Step,
    Store,
    System,
    UsageError,
    json_digest,
    unpaired,
)

from .section import CompareConfig


@final
@dataclass(frozen=True)
class Width:
    """How many numbers an answer has."""

    nx: int


@final
@dataclass(frozen=True)
class Successors:
    """x⁺ at points z = (x, u); called with z (n, nx + nu), returns (n, nx)."""

    system: System

    @property
    def model(self) -> Width:
        return Width(self.system.nx)

    def __call__(self, z: Array) -> Array:
        return self.system.step(z[:, : self.system.nx], z[:, self.system.nx :]).x


@final
@dataclass(frozen=True)
class Rollouts:
    """Runs of T steps; called with (x0, u_0, …, u_(T−1)) as (n, nx + T·nu), returns (n, (T + 1)·nx)."""

    system: System
    steps: int

    @property
    def model(self) -> Width:
        return Width(self.system.nx * (self.steps + 1))

    def __call__(self, z: Array) -> Array:
        inputs = z[:, self.system.nx :].reshape(len(z), self.steps, self.system.nu)
        return self.system.rollout(z[:, : self.system.nx], inputs).x.reshape(len(z), -1)


@final
class Given(System):
    """A backend with some of its native parameters at other values."""

    def __init__(self, system: System, values: Mapping[str, float]) -> None:
        self.system, self.values = system, dict(sorted(values.items()))
        self.states, self.inputs, self.period, self.substeps = system.states, system.inputs, system.period, system.substeps
        self.hidden, self.hidden_default = system.hidden, system.hidden_default
        self.capabilities = system.capabilities - {"parameters", "forces"}

    def _step(self, x: Array, u: Array, **options: Any) -> Step:
        return self.system.step(x, u, parameters=self.values, **options)

    def resolution(self, magnitude: Array) -> Array:
        return self.system.resolution(magnitude)

    def digest(self) -> str:
        return json_digest(self.system.digest(), self.values)


@final
@dataclass(frozen=True)
class Peer:
    """One backend of a comparison; `apart` says why it cannot be compared pointwise with the others."""

    name: str
    config: Any
    system: System
    apart: str = ""


def peers(build: Build, asked: CompareConfig, model: Model) -> tuple[dict[str, Peer], dict[str, str]]:
    """The backends that can be built here, and for the others the sentence that says why not."""
    found: dict[str, Peer] = {}
    lost = dict(asked.unavailable)
    for name, config in asked.backends.items():
        if name in lost:
            continue
        try:
            system = rebuilt(build, config, model)
        except MissingDependency as error:
            if name in asked.require:
                raise
            lost[name] = str(error)
        except UsageError as error:
            raise build.spec.error(f"compare.backends.{name}", str(error)) from error
        else:
            found[name] = Peer(name, config, system, misfit(model, system))
    return found, lost


def rebuilt(build: Build, config: Any, model: Model) -> System:
    """The backend that a config describes."""
    system: System = build.with_sections(backend=config).make("backend", model)
    return system


def misfit(model: Model, system: System) -> str:
    """Why a backend's steps cannot be laid beside the others', or nothing."""
    if said := unpaired(model, system):
        return said
    return "it is stochastic: equal questions have different answers" if "seed" in system.capabilities else ""


@final
@dataclass
class Laboratory:
    """Asks Systems common questions: uniform points z, runs under common random inputs, and slices; every answer is stored.

    Systems with hidden state start from its declared default.
    """

    folder: Path
    domain: Domain
    asked: CompareConfig
    seed: int
    executor: Callable[[], Executor]
    chunk: int
    emit: Emit
    digests: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        pairs, rng = self.asked.pairs, np.random.default_rng([self.seed, 0xC0FFEE])
        self.z = self.domain.draw(pairs.points, rng)
        starts = self.domain.split(self.domain.draw(pairs.rollouts, rng))[0]
        nu = len(self.domain.inputs.axes)
        low, high = np.asarray(self.domain.inputs.low), np.asarray(self.domain.inputs.high)
        inputs = low + (high - low) * rng.random((pairs.rollouts, pairs.steps, nu))
        self.runs = np.concatenate([starts, inputs.reshape(pairs.rollouts, pairs.steps * nu)], axis=1)

    def successors(self, system: System, z: Array | None = None) -> Array:
        """x⁺ (n, nx) at z, by default at the common points."""
        if z is None:
            return self._ask(system, Successors(system), "points", self.z)
        name = hashlib.sha256(np.ascontiguousarray(z).tobytes()).hexdigest()[:12]
        return self._ask(system, Successors(system), f"slice-{name}", z)

    def rollouts(self, system: System) -> Array:
        """(rollouts, steps + 1, nx) under the common inputs."""
        steps = self.asked.pairs.steps
        flat = self._ask(system, Rollouts(system, steps), "runs", self.runs)
        return flat.reshape(len(self.runs), steps + 1, system.nx)

    def _ask(self, system: System, question: Any, name: str, z: Array) -> Array:
        key = system.digest()
        # A store needs no more of a residual than a question has: it is called with points, and has a model with nx.
        store = Store(
            self.folder / key[:16], cast(Residual, question), key, self.executor, chunk=self.chunk, emit=self._unbarred
        )
        answer = store.collect(name, Points(z))
        self.digests[f"{key[:16]}/{name}"] = store.digests[name]
        return answer

    def _unbarred(self, event: Event) -> None:
        """Hundreds of short rounds are one stage to who watches: only their warnings are passed on."""
        if event.name == "warning":
            self.emit(event)
