"""Rollouts of an EquationsModel by the compiled interpreter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from gapcert import Step, UsageError
from gapcert_equations.machine import run

if TYPE_CHECKING:
    from gapcert_equations.model import EquationsModel

Array = npt.NDArray[np.float64]


def rollout(
    model: EquationsModel,
    x0: Array,
    u: Array,
    parameters: Mapping[str, Array | float],
    hidden: Array | None,
    every: int = 1,
    path: Array | None = None,
) -> Step:
    """See Model.fast_rollout; with `path` (n, T, nx), Model.along in all but the first state."""
    n, w, nu = len(x0), len(u), u.shape[-1]
    if x0.shape != (n, model.nx) or nu != model.nu or w == 0 or n % w:
        expected = f"(n, {model.nx}) and (w, T, {model.nu}), w dividing n"
        raise UsageError(f"model.fast_rollout: x0 has shape {x0.shape} and u {u.shape}; expected {expected}")
    if unknown := sorted(set(parameters) - {p.name for p in model.parameters}):
        raise UsageError(f"model.fast_rollout: no parameter {unknown[0]!r}; it has {sorted(p.name for p in model.parameters)}")
    values = [_value(parameters.get(p.name, p.value), n) for p in model.parameters]
    past = np.tile(model.hidden_default, (n, 1)) if hidden is None else np.asarray(hidden, dtype=np.float64)
    if past.shape != (n, len(model.hidden)):
        raise UsageError(f"model.fast_rollout: hidden has shape {past.shape}; expected ({n}, {len(model.hidden)})")
    late = model.late(values)
    first = np.concatenate([[0], np.cumsum([memory for _, memory, _ in late])]).astype(np.int64)
    columns = int(first[-1])
    where = np.array([(i, f) for (i, _, _), f in zip(late, first, strict=False)], dtype=np.int64).reshape(-1, 2)
    delays = np.array([np.broadcast_to(d, (n,)) for _, _, d in late]).reshape(len(late), n)
    start = np.concatenate([x0, past[:, columns:]], axis=1)
    lines = (where, np.ascontiguousarray(delays.T), np.ascontiguousarray(past[:, :columns]))
    x, last = run(model.program, start, u, values, lines, model.substeps, every, model.nx, path)
    if not model.hidden:
        return Step(x)
    remembered = [_remembered(u, i, memory, past[:, f : f + memory]) for (i, memory, _), f in zip(late, first, strict=False)]
    return Step(x, np.concatenate([*remembered, last[:, model.nx :]], axis=1))


def _value(given: Array | float, n: int) -> Any:
    """One number, or an array (n,)."""
    value = np.asarray(given, dtype=np.float64)
    if value.shape not in ((), (n,)):
        raise UsageError(f"model.fast_rollout: a parameter of shape {value.shape}; expected a number, or one per row ({n},)")
    return value


def _remembered(u: Array, i: int, memory: int, past: Array) -> Array:
    """The last inputs (n, memory), newest first."""
    new = u[:, ::-1, i][:, :memory]
    new = np.tile(new, (len(past) // len(u), 1))
    return np.concatenate([new, past[:, : memory - new.shape[1]]], axis=1)
