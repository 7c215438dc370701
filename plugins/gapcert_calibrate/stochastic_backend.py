"""Backends with noise: `stochastic` puts it around any backend, and NoiseDraws makes of what has noise a function of (x, u)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, final

import numpy as np

from gapcert.plugin import (
    Array,
    Backend,
    Context,
    Scene,
    Step,
    System,
    UsageError,
    difference,
    json_digest,
    keys,
    magnitude,
    normals,
    registry,
    uniforms,
)

from .config import Absolute, StochasticConfig


@final
class Stochastic(Backend):
    """With `seed`: native parameters drawn, then x⁺ + (δ/τ)(x⁺ − x) + noise; without: the system itself.

    δ is uniform in ± `jitter`: the read-out comes early or late, along the straight line through the two samples. `noise` holds
    standard deviations per state (nx,). A row of a batch draws from (seed, row) alone. The noisy state is what the next step
    starts from; hidden state has no noise. Parameters in `factors` are multiplied (their stated value, or the one that is
    given); those in `ranges` take a value in the range, and are no parameters any more.
    """

    def __init__(
        self,
        system: System,
        *,
        noise: Mapping[str, float] | None = None,
        jitter: float = 0.0,
        factors: Mapping[str, tuple[float, float]] | None = None,
        ranges: Mapping[str, tuple[float, float]] | None = None,
    ) -> None:
        self.system, self.jitter = system, jitter
        self.noise, self.factors, self.ranges = dict(noise or {}), dict(factors or {}), dict(ranges or {})
        self._check()
        self.states, self.inputs, self.period, self.substeps = system.states, system.inputs, system.period, system.substeps
        self.hidden, self.hidden_default, self.coordinates = system.hidden, system.hidden_default, system.coordinates
        self.parameters = tuple(p for p in system.parameters if p.name not in self.ranges)
        self.capabilities = system.capabilities | {"seed"}
        if not self.parameters:
            self.capabilities -= {"parameters"}
        self._sd = np.array([self.noise.get(s.name, 0.0) for s in system.states])

    @classmethod
    def from_config(cls, config: StochasticConfig, context: Context) -> Stochastic:
        """Builds what `of` describes first: units are those of its states and parameters."""
        component = next(c for k in ("backend", "model") if (c := registry().components.get((k, config.of.kind))) is not None)
        system: System = registry().build(component.kind, component.name, config.of, context)
        units = {s.name: s.unit for s in system.states}
        known = {p.name: p.unit for p in system.parameters}
        for place, names, there in (("sensor_noise", config.sensor_noise, units), ("parameters", config.parameters, known)):
            if lost := [n for n in names if n not in there]:
                raise UsageError(f"backend.{place}: there is no '{lost[0]}'; there are {', '.join(there) or 'none'}")
        try:
            noise = {n: magnitude(v, units[n]) for n, v in config.sensor_noise.items()}
            written = {n: p for n, p in config.parameters.items() if isinstance(p, Absolute)}
            ranges = {n: (magnitude(p.range[0], known[n]), magnitude(p.range[1], known[n])) for n, p in written.items()}
        except ValueError as error:
            raise UsageError(f"backend: {error}") from None
        factors = {n: p for n, p in config.parameters.items() if not isinstance(p, Absolute)}
        return cls(system, noise=noise, jitter=config.jitter, factors=factors, ranges=ranges)

    def _check(self) -> None:
        stated = {p.name: p for p in self.system.parameters}
        for name in (*self.factors, *self.ranges):
            if name not in stated:
                raise UsageError(f"stochastic: there is no parameter '{name}'; there are {', '.join(stated) or 'none'}")
            p = stated[name]
            low, high = self.ranges.get(name) or sorted(p.value * f for f in self.factors[name])
            if low == high or not p.low <= low <= high <= p.high:
                raise UsageError(
                    f"stochastic: {name} would be drawn from [{low:g}, {high:g}] {p.unit}, and may be in "
                    f"[{p.low:g}, {p.high:g}]; give a range of positive width inside that (factors of 0 have none)"
                )
        bent = [s.name for s in self.system.states if s.kind == "quaternion"]
        if bent and (self.jitter or any(n in bent for n in self.noise)):
            raise UsageError(f"stochastic: '{bent[0]}' is a rotation, which can be neither jittered nor given noise per number")
        if not (self.factors or self.ranges or self.jitter or any(self.noise.values())):
            raise UsageError("stochastic: nothing is drawn; give sensor_noise, jitter or parameters")
        if not 0 <= self.jitter < self.system.period:
            raise UsageError(
                f"stochastic: jitter is {self.jitter:g} s; expected less than the period of {self.system.period:g} s, and not "
                f"less than 0"
            )

    def _step(self, x: Array, u: Array, **options: Any) -> Step:
        seed = options.pop("seed", None)
        if seed is None:
            return self.system.step(x, u, **options)
        # A stream of its own for each row: the row's number is all that tells equal rows of a batch apart.
        key = keys(seed, np.arange(len(x), dtype=np.float64)[:, None])
        drawn = uniforms(key, 1 + len(self.factors) + len(self.ranges))
        inner = seed if "seed" in self.system.capabilities else None
        out = self.system.step(x, u, seed=inner, **self._drawn(options, drawn[:, 1:]))
        after = out.x
        if self.jitter:
            late = self.jitter * (2 * drawn[:, :1] - 1) / self.period
            after = after + late * difference(self.states, after, x)
        if self.noise:
            after = after + self._sd * normals(key, self.nx, drawn.shape[1])
        return Step(after, out.hidden)

    def scene(self, x: Array, hidden: Array | None = None) -> Scene | None:
        # What was drawn on the way is not known, nor what it made of hidden state.
        return None if self.hidden else self.system.scene(x)

    def _drawn(self, options: dict[str, Any], shares: Array) -> dict[str, Any]:
        """The options with this step's parameters."""
        if not self.factors and not self.ranges:
            return options
        given = dict(options.get("parameters", {}))
        stated = {p.name: p.value for p in self.system.parameters}
        for j, (name, (low, high)) in enumerate({**self.factors, **self.ranges}.items()):
            value = low + (high - low) * shares[:, j]
            given[name] = value if name in self.ranges else value * given.get(name, stated[name])
        return {**options, "parameters": given}

    def resolution(self, magnitude: Array) -> Array:
        return self.system.resolution(magnitude)

    def repeats(self, angle: str) -> str | None:
        return None if self.factors or self.ranges else self.system.repeats(angle)

    def digest(self) -> str:
        law = [self.noise, self.jitter, self.factors, self.ranges]
        return json_digest(type(self).__qualname__, self.system.digest(), law)


@final
class NoiseDraws(Backend):
    """f̂(x, u) with its noise drawn, as a pure function of the seed, the bits of (x, u) and the number of the draw."""

    def __init__(self, system: System, seed: int, draw: int = 0) -> None:
        self.states, self.inputs, self.period, self.substeps = system.states, system.inputs, system.period, system.substeps
        self.hidden, self.hidden_default, self.coordinates = system.hidden, system.hidden_default, system.coordinates
        self.parameters, self.capabilities = system.parameters, system.capabilities - {"seed"}
        self.system, self.seed, self.draw = system, seed, draw

    def _step(self, x: Array, u: Array, **options: Any) -> Step:
        # One call per row: how the rows of a batch share the stream of one seed is the system's own affair, and a claim about
        # independent draws cannot rest on it.
        key = keys(self.seed, np.hstack([x, u, np.full((len(x), 1), float(self.draw))]))
        steps = [
            self.system.step(x[k : k + 1], u[k : k + 1], seed=int(key[k] >> np.uint64(1)), **_row(options, k))
            for k in range(len(x))
        ]
        hidden = None if steps[0].hidden is None else np.concatenate([s.hidden for s in steps if s.hidden is not None])
        return Step(np.concatenate([s.x for s in steps]), hidden)

    def resolution(self, magnitude: Array) -> Array:
        return self.system.resolution(magnitude)

    def digest(self) -> str:
        return json_digest(type(self).__qualname__, self.system.digest(), self.seed, self.draw)


def _row(options: dict[str, Any], k: int) -> dict[str, Any]:
    part = {n: v[k : k + 1] for n, v in options.items() if n != "parameters"}
    if "parameters" in options:
        part["parameters"] = {n: v[k : k + 1] for n, v in options["parameters"].items()}
    return part


def drawn(system: System, seed: int) -> System:
    """A stochastic system with its noise drawn, any other as it is."""
    return NoiseDraws(system, seed) if "seed" in system.capabilities else system


def again(system: System, draw: int) -> System:
    """The same system with further draws of its noise; UsageError where it has none that can be drawn again."""
    if not isinstance(system, NoiseDraws):
        raise UsageError(
            "certificate.repeats: only the noise of a stochastic backend can be drawn again, and not together with drawn "
            "hidden state; leave repeats out"
        )
    return NoiseDraws(system.system, system.seed, draw)
