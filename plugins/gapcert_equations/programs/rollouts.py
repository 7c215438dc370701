"""Rollouts of an EquationsModel by the compiled interpreter, free or put back onto a path."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from gapcert import Array, UsageError
from gapcert.plugin import Step

from .machine import run
from .trace import Codes

if TYPE_CHECKING:
    from gapcert_equations.model import EquationsModel


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
    late, past, lines, values = _prepared(model, x0, u, parameters, hidden)
    columns = lines[2].shape[1]
    start = np.concatenate([x0, past[:, columns:]], axis=1)
    stops = np.arange(0, u.shape[1] + 1, every)
    x, last = run(model.program, start, u, values, lines, model.substeps, stops, model.nx, path)
    if not model.hidden:
        return Step(x)
    return Step(x, np.concatenate([_remembered(late, u, past, u.shape[1]), last[:, model.nx :]], axis=1))


def memories(
    model: EquationsModel,
    path: Array,
    u: Array,
    stops: Sequence[int],
    parameters: Mapping[str, Array | float],
    hidden: Array,
) -> Array:
    """See Model.fast_memories."""
    n, w = len(hidden), len(u)
    known = np.isfinite(path)
    first = np.tile(np.where(known[:, 0], path[:, 0], 0.0), (n // w, 1))
    late, past, lines, values = _prepared(model, first, u, parameters, hidden)
    start, nx = np.concatenate([first, past[:, lines[2].shape[1] :]], axis=1), model.nx
    at: Codes = np.asarray(stops, dtype=np.int64)
    back: Codes = np.asarray(known.any(axis=(0, 2)), dtype=np.int64)
    path = np.where(known, path, np.inf)
    x, _ = run(model.program, start, u, values, lines, model.substeps, at, start.shape[1], path, back)
    explicit = x[:, :, nx:]
    for k in range(len(at)):
        # What blows up is what it was before.
        before = past[:, lines[2].shape[1] :] if k == 0 else explicit[:, k - 1]
        explicit[:, k] = np.where(np.isfinite(explicit[:, k]), explicit[:, k], before)
    lagged = [_remembered(late, u, past, int(k)) for k in at]
    return np.concatenate([np.stack(lagged, axis=1), explicit], axis=2)


Late = list[tuple[int, int, Array]]


def _prepared(
    model: EquationsModel, x0: Array, u: Array, parameters: Mapping[str, Array | float], hidden: Array | None
) -> tuple[Late, Array, tuple[Codes, Array, Array], list[Any]]:
    """Late inputs, hidden states (n, nh), what the interpreter needs to know of late inputs, and parameters; or UsageError."""
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
    where = np.array([(i, f) for (i, _, _), f in zip(late, first, strict=False)], dtype=np.int64).reshape(-1, 2)
    delays = np.array([np.broadcast_to(d, (n,)) for _, _, d in late]).reshape(len(late), n)
    return late, past, (where, np.ascontiguousarray(delays.T), np.ascontiguousarray(past[:, : int(first[-1])])), values


def _value(given: Array | float, n: int) -> Any:
    """One number, or an array (n,)."""
    value = np.asarray(given, dtype=np.float64)
    if value.shape not in ((), (n,)):
        raise UsageError(f"model.fast_rollout: a parameter of shape {value.shape}; expected a number, or one per row ({n},)")
    return value


def _remembered(late: Late, u: Array, past: Array, k: int) -> Array:
    """The last inputs (n, ·) before period k, newest first, of each that comes late."""
    out, column = [np.empty((len(past), 0))], 0
    for i, memory, _ in late:
        new = np.tile(u[:, max(0, k - memory) : k, i][:, ::-1], (len(past) // len(u), 1))
        out.append(np.concatenate([new, past[:, column : column + memory - new.shape[1]]], axis=1))
        column += memory
    return np.concatenate(out, axis=1)
