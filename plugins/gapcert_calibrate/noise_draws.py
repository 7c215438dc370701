"""A stochastic System as a function of (x, u): one independent draw of its noise at every point."""

from __future__ import annotations

from typing import Any, final

import numpy as np

from gapcert.plugin import Array, Backend, Step, System, UsageError, json_digest, keys


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
