"""Rollouts of an EquationsModel by the compiled interpreter, free or put back onto a path."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from gapcert import Array, Parameter, UsageError
from gapcert.plugin import Step, Values

from .machine import run
from .trace import Codes, Program

Late = list[tuple[int, int, Array]]


@final
@dataclass(frozen=True)
class Compiled:
    """What of a model the interpreter needs: one sub-step, sizes, numbers, and which inputs are late at values of those."""

    program: Program
    nx: int
    nu: int
    substeps: int
    parameters: tuple[Parameter, ...]
    hidden_default: tuple[float, ...]
    late: Callable[[list[Any]], Late]

    def rollout(
        self, x0: Array, u: Array, parameters: Values, hidden: Array | None, every: int = 1, path: Array | None = None
    ) -> Step:
        """See Model.fast_rollout; with `path` (n, T, nx), Model.along in all but the first state."""
        late, past, lines, values = self._prepared(x0, u, parameters, hidden)
        columns = lines[2].shape[1]
        start = np.concatenate([x0, past[:, columns:]], axis=1)
        stops = np.arange(0, u.shape[1] + 1, every)
        x, last = run(self.program, start, u, values, lines, self.substeps, stops, self.nx, path)
        if not self.hidden_default:
            return Step(x)
        return Step(x, np.concatenate([_remembered(late, u, past, u.shape[1]), last[:, self.nx :]], axis=1))

    def memories(self, path: Array, u: Array, stops: Sequence[int], parameters: Values, hidden: Array) -> Array:
        """See Model.fast_memories."""
        n, w = len(hidden), len(u)
        known = np.isfinite(path)
        first = np.tile(np.where(known[:, 0], path[:, 0], 0.0), (n // w, 1))
        late, past, lines, values = self._prepared(first, u, parameters, hidden)
        start = np.concatenate([first, past[:, lines[2].shape[1] :]], axis=1)
        at: Codes = np.asarray(stops, dtype=np.int64)
        back: Codes = np.asarray(known.any(axis=(0, 2)), dtype=np.int64)
        path = np.where(known, path, np.inf)
        x, _ = run(self.program, start, u, values, lines, self.substeps, at, start.shape[1], path, back)
        explicit = x[:, :, self.nx :]
        for k in range(len(at)):
            # What blows up is what it was before.
            before = past[:, lines[2].shape[1] :] if k == 0 else explicit[:, k - 1]
            explicit[:, k] = np.where(np.isfinite(explicit[:, k]), explicit[:, k], before)
        lagged = [_remembered(late, u, past, int(k)) for k in at]
        return np.concatenate([np.stack(lagged, axis=1), explicit], axis=2)

    def _prepared(
        self, x0: Array, u: Array, parameters: Values, hidden: Array | None
    ) -> tuple[Late, Array, tuple[Codes, Array, Array], list[Any]]:
        """Late inputs, hidden states (n, nh), what the interpreter must know of late inputs, and parameters; or UsageError."""
        n, w, nu, nh = len(x0), len(u), u.shape[-1], len(self.hidden_default)
        if x0.shape != (n, self.nx) or nu != self.nu or w == 0 or n % w:
            expected = f"(n, {self.nx}) and (w, T, {self.nu}), w dividing n"
            raise UsageError(f"model.fast_rollout: x0 has shape {x0.shape} and u {u.shape}; expected {expected}")
        names = [p.name for p in self.parameters]
        if unknown := sorted(set(parameters) - set(names)):
            raise UsageError(f"model.fast_rollout: no parameter {unknown[0]!r}; it has {sorted(names)}")
        values = [_value(parameters.get(p.name, p.value), n) for p in self.parameters]
        past = np.tile(self.hidden_default, (n, 1)) if hidden is None else np.asarray(hidden, dtype=np.float64)
        if past.shape != (n, nh):
            raise UsageError(f"model.fast_rollout: hidden has shape {past.shape}; expected ({n}, {nh})")
        late = self.late(values)
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
