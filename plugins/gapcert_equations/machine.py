"""Programs run over blocks of rows by one compiled interpreter, which no model compiles anew."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from gapcert import compiler
from gapcert_equations.friction import SWEEPS
from gapcert_equations.rows import cosines, exponentials, hyperbolic_tangents, sines, sines_and_cosines
from gapcert_equations.trace import ARITHMETIC, CHOICES, CODES, Codes, Program

Array = npt.NDArray[np.float64]

_ADD, _SUB, _MUL, _DIV, _NEG, _COPY, _MULADD, _MULSUB, _SUBMUL = (CODES[n] for n in ARITHMETIC)
_MIN, _MAX, _ABS, _SIGN, _ROUND, _SOFT, _STOP, _PICK = (CODES[n] for n in CHOICES)
_SIN, _COS, _TAN, _EXP, _LOG, _SQRT = (CODES[n] for n in ("sin", "cos", "tan", "exp", "log", "sqrt"))
_TANH, _ATAN, _ASIN, _ACOS, _POWER = (CODES[n] for n in ("tanh", "atan", "asin", "acos", "power"))
_SINCOS, _SWEEP, _TURN = CODES["sincos"], CODES["sweep"], CODES["turn"]
_SETTLED = 1e-12
_BLOCK, _LANES = 256, 16

compiled = compiler(nogil=True, error_model="numpy")


@compiled
def _stopped(v: float, d: float, k: float) -> float:
    """As `stop` of the table of arrays."""
    sign = 1.0 if v > 0 else (-1.0 if v < 0 else 0.0)
    a, p = d - k * sign, d if d > -k else -k
    turned = (d - (p if p < k else k)) * (1.0 + v / (1.0 if a == 0 else a))
    return v + a if (v + a) * sign > 0 else turned


@compiled
def _choice(op: int, r: Array, m: int, d: int, a: int, b: int, c: int, e: int) -> None:
    """Kinks and jumps, without branches."""
    if op == _MIN:
        for i in range(m):
            p, q = r[a, i], r[b, i]
            r[d, i] = p if p < q or p != p else q
    elif op == _MAX:
        for i in range(m):
            p, q = r[a, i], r[b, i]
            r[d, i] = p if p > q or p != p else q
    elif op == _ABS:
        for i in range(m):
            r[d, i] = abs(r[a, i])
    elif op == _SIGN:
        for i in range(m):
            p = r[a, i]
            r[d, i] = 1.0 if p > 0 else (-1.0 if p < 0 else p)
    elif op == _PICK:
        for i in range(m):
            p, q = r[c, i], r[e, i]
            r[d, i] = p if r[a, i] <= r[b, i] else q
    elif op == _SOFT:
        for i in range(m):
            v, k = r[a, i], r[b, i]
            p = v if v > -k else -k
            r[d, i] = v - (p if p < k else k)
    elif op == _STOP:
        for i in range(m):
            r[d, i] = _stopped(r[a, i], r[b, i], r[c, i])
    elif op == _ROUND:
        for i in range(m):
            r[d, i] = np.rint(r[a, i])


@compiled
def _function(op: int, r: Array, m: int, d: int, a: int, b: int) -> None:
    if op == _SQRT:
        for i in range(m):
            r[d, i] = math.sqrt(r[a, i])
    elif op == _SIN:
        sines(r[a], r[d], m)
    elif op == _COS:
        cosines(r[a], r[d], m)
    elif op == _SINCOS:
        sines_and_cosines(r[b], r[d], r[a], m)
    elif op == _EXP:
        exponentials(r[a], r[d], m)
    elif op == _TANH:
        hyperbolic_tangents(r[a], r[d], m)
    elif op == _POWER:
        for i in range(m):
            r[d, i] = r[a, i] ** r[b, i]
    elif op == _LOG:
        for i in range(m):
            r[d, i] = math.log(r[a, i])
    elif op == _TAN:
        for i in range(m):
            r[d, i] = math.tan(r[a, i])
    elif op == _ATAN:
        for i in range(m):
            r[d, i] = math.atan(r[a, i])
    elif op == _ASIN:
        for i in range(m):
            r[d, i] = math.asin(r[a, i])
    elif op == _ACOS:
        for i in range(m):
            r[d, i] = math.acos(r[a, i])


@compiled
def _sweep(r: Array, rows: int, where: Codes, m: int, turning: bool) -> None:
    """Projected Gauss–Seidel as in `friction`; a row that has settled is left alone, so that no row depends on others.

    where: registers of free and present velocities, limits, first guesses, inverse masses, the sub-step, and results.
    """
    v, limit, guess, inverse = where[m : 2 * m], where[2 * m : 3 * m], where[3 * m : 4 * m], where[4 * m : 4 * m + m * m]
    h, force = where[4 * m + m * m], where[4 * m + m * m + 1 :]
    speed, moves, open_ = np.empty(rows), np.empty(rows), np.ones(rows)
    for i in range(m):
        for k in range(rows):
            r[force[i], k] = r[guess[i], k]
    for _ in range(SWEEPS):
        moves[:] = 0.0
        for i in range(m):
            own, most, f, start = inverse[i * m + i], limit[i], force[i], where[i]
            for k in range(rows):
                speed[k] = r[start, k]
            for j in range(m):
                other, weight = force[j], inverse[j * m + i]
                for k in range(rows):
                    speed[k] += r[h, k] * (r[weight, k] * r[other, k])
            if turning:
                for k in range(rows):
                    reach = r[h, k] * r[own, k]
                    speed[k] -= _stopped(r[v[i], k], speed[k] - reach * r[f, k] - r[v[i], k], reach * r[most, k])
            for k in range(rows):
                old, bound = r[f, k], r[most, k]
                new = old - speed[k] / (r[h, k] * r[own, k])
                new = bound if new > bound else new
                new = -bound if new < -bound else new
                moves[k] = 1.0 if abs(new - old) > _SETTLED * bound else moves[k]
                r[f, k] = new if open_[k] > 0 else old
        left = 0
        for k in range(rows):
            open_[k] = moves[k] if open_[k] > 0 else 0.0
            left += open_[k] > 0
        if left == 0:
            break


@compiled
def _other(op: int, code: Codes, extra: Codes, r: Array, m: int) -> None:
    d, a, b, c, e = code[1], code[2], code[3], code[4], code[5]
    if op <= _PICK:
        _choice(op, r, m, d, a, b, c, e)
    elif op >= _SWEEP:
        _sweep(r, m, extra[a:], b, op == _TURN)
    else:
        _function(op, r, m, d, a, b)


@compiled
def _execute(code: Codes, extra: Codes, r: Array, m: int) -> None:
    # What every program is mostly made of stands here, not in a function, and its indices are unsigned: a call and the test for
    # negative indices would cost as much as the arithmetic on 16 lanes.
    lanes = np.uint64(m)
    for k in range(len(code)):
        op = code[k, 0]
        d, a, b, c = np.uint64(code[k, 1]), np.uint64(code[k, 2]), np.uint64(code[k, 3]), np.uint64(code[k, 4])
        if op == _MULADD:
            for i in range(lanes):
                r[d, i] = r[a, i] * r[b, i] + r[c, i]
        elif op == _MUL:
            for i in range(lanes):
                r[d, i] = r[a, i] * r[b, i]
        elif op == _ADD:
            for i in range(lanes):
                r[d, i] = r[a, i] + r[b, i]
        elif op == _SUB:
            for i in range(lanes):
                r[d, i] = r[a, i] - r[b, i]
        elif op == _MULSUB:
            for i in range(lanes):
                r[d, i] = r[a, i] * r[b, i] - r[c, i]
        elif op == _SUBMUL:
            for i in range(lanes):
                r[d, i] = r[c, i] - r[a, i] * r[b, i]
        elif op == _DIV:
            for i in range(lanes):
                r[d, i] = r[a, i] / r[b, i]
        elif op == _NEG:
            for i in range(lanes):
                r[d, i] = -r[a, i]
        elif op == _COPY:
            for i in range(lanes):
                r[d, i] = r[a, i]
        else:
            _other(op, code[k], extra, r, m)


@compiled
def _load(r: Array, m: int, row: Codes, registers: Codes, values: Array) -> None:
    """values (rows, columns) of the block's rows into registers."""
    for j in range(len(registers)):
        for i in range(m):
            r[registers[j], i] = values[row[i], j]


@compiled
def _drive(
    r: Array, m: int, row: Codes, column: Codes, registers: Codes, u: Array, k: int, late: Codes, delays: Array, past: Array
) -> None:
    """Inputs u (T, nu, w) of period k; the n-th of `late` comes delays[:, n] periods late, from `past` before the first.

    row: of the block in `past`, and in u; late: (input, first column in past) of each.
    """
    for j in range(len(registers)):
        for i in range(m):
            r[registers[j], i] = u[k, j, column[i]]
    for n in range(len(late)):
        j, first = late[n, 0], late[n, 1]
        for i in range(m):
            whole = int(delays[row[i], n])
            share, value = delays[row[i], n] - whole, 0.0
            for back in range(whole, whole + (1 if share == 0.0 else 2)):
                at = u[k - back, j, column[i]] if back <= k else past[row[i], first + back - k - 1]
                value += at * (1.0 - share if back == whole else share)
            r[registers[j], i] = value


@compiled
def _place(r: Array, m: int, row: Codes, registers: Codes, path: Array, k: int) -> None:
    """States of period k from a given path (T, columns, w)."""
    for j in range(path.shape[1]):
        for i in range(m):
            r[registers[j], i] = path[k, j, row[i] % path.shape[2]]


@compiled
def _put_back(r: Array, m: int, row: Codes, registers: Codes, path: Array, k: int, safe: Array) -> None:
    """The same, where a row of the path is not inf; memories that have blown up since the last time are what they were then."""
    for i in range(m):
        known = False
        for j in range(path.shape[1]):
            value = path[k, j, row[i] % path.shape[2]]
            if value != np.inf:
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


@compiled
def _store(r: Array, m: int, first: int, registers: Codes, out: Array) -> None:
    for j in range(out.shape[1]):
        for i in range(min(m, len(out) - first)):
            out[first + i, j] = r[registers[j], i]


@compiled
def _run(
    code: tuple[Codes, Codes, Codes],
    extra: Codes,
    size: int,
    constants: tuple[Codes, Array],
    given: tuple[Codes, Array],
    x0: Array,
    states: tuple[Codes, Codes],
    u: Array,
    inputs: Codes,
    late: Codes,
    delays: Array,
    past: Array,
    counts: tuple[int, int],
    slots: Codes,
    path: Array,
    back: Codes,
    out: Array,
    last: Array,
) -> None:
    block, substeps = counts
    n, r, safe = len(x0), np.empty((size, block)), np.zeros((len(states[0]) - path.shape[1], block))
    row, column, (own, new) = np.empty(block, np.int64), np.empty(block, np.int64), states
    for first in range(0, n, block):
        for i in range(block):
            row[i] = min(first + i, n - 1)
            column[i] = row[i] % u.shape[2]
        for j in range(len(constants[0])):
            r[constants[0][j]] = constants[1][j]
        _load(r, block, row, given[0], given[1])
        _load(r, block, row, own, x0)
        _execute(code[0], extra, r, block)
        if slots[0] >= 0:
            _store(r, block, first, own, out[:, slots[0]])
        for k in range(len(u)):
            if len(back) and back[k]:
                _put_back(r, block, row, own, path, k, safe)
            elif len(path) and not len(back):
                _place(r, block, row, own, path, k)
            _drive(r, block, row, column, inputs, u, k, late, delays, past)
            _execute(code[1], extra, r, block)
            for _ in range(substeps):
                _execute(code[2], extra, r, block)
                for j in range(len(own)):
                    for i in range(block):
                        r[own[j], i] = r[new[j], i]
            if slots[k + 1] >= 0:
                _store(r, block, first, own, out[:, slots[k + 1]])
        _store(r, block, first, own, last)


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
) -> tuple[Array, Array]:
    """States (n, stops, columns) before periods `stops`, and all of them at the end, from x0 (n, states) under u (w, T, nu).

    w divides n. parameters: numbers, or arrays (n,) where they vary. late: (input, first column, columns) of inputs that come
    late, by how many periods (n, ·), and what they were before (n, ·), newest first. path (v, T, nx), v dividing n: where each
    period starts from instead; with `back` (T,), only the periods marked there, and where the path is not inf.
    """
    n, steps = len(x0), u.shape[1]
    varying = [i for i, p in enumerate(parameters) if np.ndim(p)]
    same = [i for i, p in enumerate(parameters) if not np.ndim(p)]
    rows = np.stack([parameters[i] for i in varying], axis=1) if varying else np.empty((n, 0))
    registers = np.concatenate([program.constants, program.parameters[same]])
    values = np.concatenate([program.values, [float(parameters[i]) for i in same]])
    count = -(-n // _BLOCK)
    block = -(-n // (count * _LANES)) * _LANES
    out, last = np.empty((n, len(stops), columns)), np.empty((n, x0.shape[1]))
    slots: Codes = np.full(steps + 1, -1)
    slots[stops] = np.arange(len(stops))
    _run(
        program.code,
        program.extra,
        program.size,
        (registers, values),
        (program.parameters[varying], rows),
        np.ascontiguousarray(x0),
        (program.states, program.new),
        np.ascontiguousarray(u.transpose(1, 2, 0)),
        program.inputs,
        *late,
        (block, substeps),
        slots,
        np.ascontiguousarray((np.empty((1, 0, columns)) if path is None else path).transpose(1, 2, 0)),
        np.empty(0, dtype=np.int64) if back is None else back,
        out,
        last,
    )
    return out, last
