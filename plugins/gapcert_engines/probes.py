"""Random states from which a robot's step meets no end of a joint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gapcert.plugin import Array, Model, StateSpec, UsageError
from gapcert_engines.thresholds import THRESHOLDS


def probes(
    model: Model, within: Mapping[str, tuple[float, float]], n: int, parameters: Mapping[str, Array] | None
) -> tuple[Array, Array, Array]:
    """x (n, nx), positions before velocities, and u (n, nu): normal, and in the middle of a range where there is one; and x⁺.

    UsageError where steps leave the ranges from however slow a motion.
    """
    rng = np.random.default_rng(0)
    (low, high), ends = _ends(model.states, within), _ends(model.inputs, within)
    x, u = _inside(rng.normal(size=(n, model.nx)), low, high), _inside(rng.normal(size=(n, model.nu)), *ends)
    for _ in range(THRESHOLDS.probe_tries):
        after = model.step(x, u, parameters=parameters).x
        gone = (after <= low) | (after >= high)
        if not gone.any():
            return x, u, after
        x[gone.any(axis=1), model.nx // 2 :] *= THRESHOLDS.probe_calmer
        u[gone.any(axis=1)] *= THRESHOLDS.probe_calmer
    name = model.states[int(np.argmax(gone.sum(axis=0)))].name
    raise UsageError(
        f"model.of: one step takes {name} out of {within[name][0]:.6g} to {within[name][1]:.6g}, from wherever it starts at "
        f"rest; expected a joint with room to move; fix it in the file, or take its limits out"
    )


def _ends(specs: Sequence[StateSpec], within: Mapping[str, tuple[float, float]]) -> tuple[Array, Array]:
    pairs = np.array([within.get(s.name, (-np.inf, np.inf)) for s in specs]).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def _inside(z: Array, low: Array, high: Array) -> Array:
    """Standard normal numbers, squeezed into the middle four fifths of at most `probe_range` of a range, as near zero as it
    goes."""
    width = np.minimum(high - low, THRESHOLDS.probe_range)
    bounded = np.isfinite(low) | np.isfinite(high)
    return np.where(bounded, np.clip(0.0, low + width / 2, high - width / 2) + 0.4 * width * np.tanh(z), z)
