"""Rollouts of an EquationsModel, free or put back onto a path, by one compiled interpreter, which no model compiles anew."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np

from gapcert import Array, Parameter, UsageError
from gapcert.plugin import Step, Values, compiler

from .operations import address, addresses, execute, inner, perform
from .trace import Codes, Program

Late = list[tuple[int, int, Array]]

_BLOCK, _LANES = 256, 16

compiled = compiler(nogil=True, error_model="numpy")


@inner
def _load(r: Array, m: int, row: Codes, registers: Codes, values: Array) -> None:
    """values (rows, columns) of the block's rows into registers."""
    for j in range(len(registers)):
        for i in range(m):
            r[registers[j], i] = values[row[i], j]


@inner
def _drive(
    r: Array, m: int, row: Codes, column: Codes, registers: Codes, u: Array, k: int, late: Codes, delays: Array, past: Array
) -> None:
    """Inputs u (T, nu, w) of period k; the n-th of `late` comes delays[:, n] periods late, from `past` before the first.

    row: of the block in `past`, and in u; late: (input, first column in past) of each. The last of u is held.
    """
    final = len(u) - 1
    for j in range(len(registers)):
        for i in range(m):
            r[registers[j], i] = u[min(k, final), j, column[i]]
    for n in range(len(late)):
        j, first = late[n, 0], late[n, 1]
        for i in range(m):
            whole = int(delays[row[i], n])
            share, value = delays[row[i], n] - whole, 0.0
            for back in range(whole, whole + (1 if share == 0.0 else 2)):
                at = u[min(k - back, final), j, column[i]] if back <= k else past[row[i], first + back - k - 1]
                value += at * (1.0 - share if back == whole else share)
            r[registers[j], i] = value


@inner
def _place(r: Array, m: int, place: Codes, registers: Codes, path: Array, k: int) -> None:
    """States of period k from a given path (T, columns, w)."""
    for j in range(path.shape[1]):
        for i in range(m):
            r[registers[j], i] = path[k, j, place[i]]


@inner
def _put_back(r: Array, m: int, place: Codes, registers: Codes, path: Array, k: int, safe: Array) -> None:
    """The same, where the path is finite; memories that have blown up since the last time are what they were then."""
    for i in range(m):
        known = False
        for j in range(path.shape[1]):
            value = path[k, j, place[i]]
            if np.isfinite(value):
                r[registers[j], i] = value
                known = True
            elif not np.isfinite(r[registers[j], i]):
                r[registers[j], i] = 0.0
        for j in range(len(safe) if known else 0):
            at = registers[path.shape[1] + j]
            if np.isfinite(r[at, i]):
                safe[j, i] = r[at, i]
            else:
                r[at, i] = safe[j, i]


@inner
def _store(r: Array, m: int, first: int, registers: Codes, out: Array) -> None:
    for j in range(out.shape[1]):
        for i in range(min(m, len(out) - first)):
            out[first + i, j] = r[registers[j], i]


@inner
def _moves(r: Array, m: int, row: Codes, registers: Codes, x0: Array, before: Array) -> bool:
    """Is any of the last registers other than `before`, whose neighbour, the second of two rows, is what it began with?"""
    moving, first = False, len(registers) - len(before)
    for j in range(len(before)):
        at = registers[first + j]
        for i in range(m):
            if i % 2 == 0 and r[at, i] != before[j, i] and r[at, i + 1] == x0[row[i + 1], first + j]:
                moving = True
            before[j, i] = r[at, i]
    return moving


@compiled
def _run(
    code: tuple[Codes, Codes, Codes],
    execute: int,
    table: Codes,
    r: Array,
    safe: Array,
    constants: tuple[Codes, Array],
    given: tuple[Codes, Array],
    x0: Array,
    states: tuple[Codes, Codes],
    u: Array,
    inputs: Codes,
    late: Codes,
    delays: Array,
    past: Array,
    counts: tuple[int, int, int],
    rows: Codes,
    slots: Codes,
    path: Array,
    back: Codes,
    before: Array,
    out: Array,
    last: Array,
) -> None:
    block, substeps, steps = counts
    n, row, column, place, (own, new) = len(x0), rows[0], rows[1], rows[2], states
    for first in range(0, n, block):
        for i in range(block):
            row[i] = min(first + i, n - 1)
            column[i] = row[i] % u.shape[2]
            place[i] = row[i] % path.shape[2]
        for j in range(len(constants[0])):
            r[constants[0][j]] = constants[1][j]
        _load(r, block, row, given[0], given[1])
        _load(r, block, row, own, x0)
        perform(execute, code[0], table, r, block)
        if slots[0] >= 0:
            _store(r, block, first, own, out[:, slots[0]])
        before[:] = np.nan
        pause = past.shape[1] + 1  # by then, all late inputs have come
        for k in range(steps):
            if len(before) and k == pause:
                if not _moves(r, block, row, own, x0, before):
                    break
                pause += pause // 4 + 1
            if len(back) and back[min(k, len(back) - 1)]:
                _put_back(r, block, place, own, path, min(k, len(path) - 1), safe)
            elif len(path) and not len(back):
                _place(r, block, place, own, path, k)
            _drive(r, block, row, column, inputs, u, k, late, delays, past)
            perform(execute, code[1], table, r, block)
            for _ in range(substeps):
                perform(execute, code[2], table, r, block)
                for j in range(len(own)):
                    for i in range(block):
                        r[own[j], i] = r[new[j], i]
            if k + 1 < len(slots) and slots[k + 1] >= 0:
                _store(r, block, first, own, out[:, slots[k + 1]])
        _store(r, block, first, own, last[:, 0])


def run(
    program: Program,
    x0: Array,
    u: Array,
    parameters: list[Any],
    late: tuple[Codes, Array, Array],
    substeps: int,
    stops: Codes,
    columns: int,
    path: Array | None = None,
    back: Codes | None = None,
    steps: int | None = None,
    paired: bool = False,
) -> tuple[Array, Array]:
    """States (n, stops, columns) before periods `stops`, and all of them at the end, from x0 (n, states) under u (w, T, nu).

    w divides n. parameters: numbers, or arrays (n,) where they vary. late: (input, first column, columns) of inputs that come
    late, by how many periods (n, ·), and what they were before (n, ·), newest first. path (v, T, nx), v dividing n: where each
    period starts from instead; with `back` (T,), only the periods marked there, and where the path is finite. For more `steps`
    than T the last input and place are held; of paired rows, until what memories only the first of a pair moves stand still.
    """
    n = len(x0)
    varying = [i for i, p in enumerate(parameters) if isinstance(p, np.ndarray)]
    same = [i for i, p in enumerate(parameters) if not isinstance(p, np.ndarray)]
    rows = np.array([parameters[i] for i in varying]).T.copy() if varying else np.empty((n, 0))
    registers = np.concatenate([program.constants, program.parameters[same]])
    values = np.concatenate([program.values, [parameters[i] for i in same]])
    count = -(-n // _BLOCK)
    block = -(-n // (count * _LANES)) * _LANES
    out, last = np.empty((n, len(stops), columns)), np.empty((n, 1, x0.shape[1]))
    slots: Codes = np.full(u.shape[1] + 1, -1)
    slots[stops] = np.arange(len(stops))
    path = np.ascontiguousarray((np.empty((1, 0, columns)) if path is None else path).transpose(1, 2, 0))
    _run(
        (program.code[0].ravel(), program.code[1].ravel(), program.code[2].ravel()),
        address(execute),
        np.concatenate([addresses(program.held), program.extra]),
        np.empty((program.size + 1, block)),
        np.zeros((memories := len(program.states) - path.shape[1], block)),
        (registers, values),
        (program.parameters[varying], rows),
        np.ascontiguousarray(x0),
        (program.states, program.new),
        np.ascontiguousarray(u.transpose(1, 2, 0)),
        program.inputs,
        *late,
        (block, substeps, u.shape[1] if steps is None else steps),
        np.empty((3, block), dtype=np.int64),
        slots,
        path,
        np.empty(0, dtype=np.int64) if back is None else back,
        np.empty((memories if paired else 0, block)),
        out,
        last,
    )
    return out, last[:, 0]


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

    @cached_property
    def _stated(self) -> dict[str, np.float64]:
        return {p.name: np.float64(p.value) for p in self.parameters}

    def rollout(
        self, x0: Array, u: Array, parameters: Values, hidden: Array | None, every: int = 1, path: Array | None = None
    ) -> Step:
        """See Model.fast_rollout; with `path` (n, T, nx), Model.along in all but the first state."""
        late, past, lines, values = self._prepared(x0, u, parameters, hidden)
        columns = lines[2].shape[1]
        start = np.concatenate([x0, past[:, columns:]], axis=1)
        stops = np.arange(0, u.shape[1] + 1, every)
        x, last = run(self.program, start, u, values, lines, self.substeps, stops, self.nx, path)
        if not late:
            return Step(x, last[:, self.nx :] if self.hidden_default else None)
        return Step(x, np.concatenate([_remembered(late, u, past, u.shape[1]), last[:, self.nx :]], axis=1))

    def memories(self, path: Array, u: Array, stops: Sequence[int], parameters: Values, hidden: Array) -> Array:
        """See Model.fast_memories."""
        n, w = len(hidden), len(u)
        known = np.isfinite(path)
        first = _tiled(np.where(known[:, 0], path[:, 0], 0.0), n // w)
        late, past, lines, values = self._prepared(first, u, parameters, hidden)
        before = past[:, lines[2].shape[1] :]
        start = np.concatenate([first, before], axis=1)
        at: Codes = np.asarray(stops, dtype=np.int64)
        back: Codes = np.asarray(known.any(axis=(0, 2)), dtype=np.int64)
        program = self.program.recall or self.program
        x, _ = run(program, start, u, values, lines, self.substeps, at, start.shape[1], path, back)
        explicit = x[:, :, self.nx :]
        if not np.isfinite(explicit).all():
            for k in range(len(at)):
                # What blows up is what it was before.
                explicit[:, k] = before = np.where(np.isfinite(explicit[:, k]), explicit[:, k], before)
        if not late:
            return explicit
        return np.concatenate([np.stack([_remembered(late, u, past, int(k)) for k in at], axis=1), explicit], axis=2)

    def held(self, x: Array, u: Array, steps: int, parameters: Values, hidden: Array) -> Array:
        """See Model.held_memories."""
        known, drive = np.isfinite(x), np.zeros((2 * len(u), 1, self.nu))
        drive[::2, 0] = u  # every row twice: with its input, and without
        first = _tiled(np.repeat(np.where(known, x, 0.0), 2, axis=0), len(hidden) // len(u))
        rows = {n: np.repeat(v, 2) if np.ndim(v) else v for n, v in parameters.items()}
        late, past, lines, values = self._prepared(first, drive, rows, np.repeat(hidden, 2, axis=0))
        start = np.concatenate([first, past[:, (count := lines[2].shape[1]) :]], axis=1)
        path, none, program = np.repeat(x, 2, axis=0)[:, None], np.empty(0, dtype=np.int64), self.program.recall or self.program
        known = known[:, (program.new != program.states)[: self.nx]]
        given = none, 0, path, np.array([known.any()], dtype=np.int64), steps, bool(known.all())
        _, last = run(program, start, drive, values, lines, self.substeps, *given)
        sent = _remembered(late, np.repeat(drive, count, axis=1), past, min(count, steps))
        now = np.concatenate([sent, last[:, self.nx :]], axis=1)
        return np.where(np.isfinite(now[::2]) & (now[1::2] == hidden), now[::2], hidden)

    def _prepared(
        self, x0: Array, u: Array, parameters: Values, hidden: Array | None
    ) -> tuple[Late, Array, tuple[Codes, Array, Array], list[Any]]:
        """Late inputs, hidden states (n, nh), what the interpreter must know of late inputs, and parameters; or UsageError."""
        n, w, nu, nh = len(x0), len(u), u.shape[-1], len(self.hidden_default)
        if x0.shape != (n, self.nx) or nu != self.nu or w == 0 or n % w:
            expected = f"(n, {self.nx}) and (w, T, {self.nu}), w dividing n"
            raise UsageError(f"model.fast_rollout: x0 has shape {x0.shape} and u {u.shape}; expected {expected}")
        if unknown := sorted(parameters.keys() - self._stated.keys()):
            raise UsageError(f"model.fast_rollout: no parameter {unknown[0]!r}; it has {sorted(self._stated)}")
        values = [_value(parameters[name], n) if name in parameters else v for name, v in self._stated.items()]
        past = np.tile(self.hidden_default, (n, 1)) if hidden is None else np.asarray(hidden, dtype=np.float64)
        if past.shape != (n, nh):
            raise UsageError(f"model.fast_rollout: hidden has shape {past.shape}; expected ({n}, {nh})")
        if not (late := self.late(values)):
            return late, past, (np.empty((0, 2), dtype=np.int64), np.empty((n, 0)), np.empty((n, 0))), values
        first = np.concatenate([[0], np.cumsum([memory for _, memory, _ in late])]).astype(np.int64)
        where = np.array([(i, f) for (i, _, _), f in zip(late, first, strict=False)], dtype=np.int64).reshape(-1, 2)
        delays = np.array([np.broadcast_to(d, (n,)) for _, _, d in late]).reshape(len(late), n)
        return late, past, (where, np.ascontiguousarray(delays.T), np.ascontiguousarray(past[:, : int(first[-1])])), values


def _tiled(rows: Array, times: int) -> Array:
    return rows if times == 1 else np.tile(rows, (times, 1))


def _value(given: Array | float, n: int) -> Any:
    """One number, or an array (n,)."""
    if isinstance(given, float):
        return np.float64(given)
    value = np.asarray(given, dtype=np.float64)
    if value.shape not in ((), (n,)):
        raise UsageError(f"model.fast_rollout: a parameter of shape {value.shape}; expected a number, or one per row ({n},)")
    return value if value.ndim else value[()]


def _remembered(late: Late, u: Array, past: Array, k: int) -> Array:
    """The last inputs (n, ·) before period k, newest first, of each that comes late."""
    out, column = [np.empty((len(past), 0))], 0
    for i, memory, _ in late:
        new = np.tile(u[:, max(0, k - memory) : k, i][:, ::-1], (len(past) // len(u), 1))
        out.append(np.concatenate([new, past[:, column : column + memory - new.shape[1]]], axis=1))
        column += memory
    return np.concatenate(out, axis=1)
