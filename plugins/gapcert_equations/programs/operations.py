"""Operations of a program on rows of registers, compiled in groups, and only those that a program holds.

The interpreter (`machine`) calls them through their addresses: what it called by name would be compiled into it.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba.core import types
from numba.extending import intrinsic

from gapcert import Array
from gapcert.plugin import compiler
from gapcert_equations.mechanics.friction import SWEEPS

from .rows import exponentials, hyperbolic_tangents, sines, sines_and_cosines
from .trace import ARITHMETIC, CHOICES, CODES, WIDTH, Codes

_MIN, _MAX, _ABS, _SIGN, _ROUND, _SOFT, _STOP, _PICK = (CODES[n] for n in CHOICES)
_SIN, _COS, _TAN, _EXP, _LOG, _SQRT = (CODES[n] for n in ("sin", "cos", "tan", "exp", "log", "sqrt"))
_TANH, _ATAN, _ASIN, _ACOS, _POWER = (CODES[n] for n in ("tanh", "atan", "asin", "acos", "power"))
_SINCOS, _SWEEP, _TURN = CODES["sincos"], CODES["sweep"], CODES["turn"]
_SETTLED = 1e-12
_EXTRA = len(CODES)
_ONE, _TWO, _THREE, _FOUR = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
_ADD, _SUB, _MUL, _DIV, _NEG, _COPY, _MULADD, _MULSUB, _SUBMUL = (CODES[n] for n in ARITHMETIC)
_GIVEN = types.int64[::1], types.int64[::1], types.float64[:, ::1], types.int64

# Called by compiled functions alone: from Python they would crash. Inner ones make no arrays, and need not count references.
compiled = compiler(nogil=True, error_model="numpy", no_cpython_wrapper=True)
inner = compiler(nogil=True, error_model="numpy", _nrt=False, no_cpython_wrapper=True)


@intrinsic
def _perform(context: Any, address: Any, code: Any, table: Any, r: Any, m: Any) -> Any:
    """Carry out one instruction by the operation at an address."""

    def generate(target: Any, builder: Any, signature: Any, given: Any) -> Any:
        convention = target.call_conv
        kind = convention.get_function_type(types.none, _GIVEN)
        function = builder.inttoptr(given[0], kind.as_pointer())
        status, _ = convention.call_function(builder, function, types.none, _GIVEN, given[1:])
        with builder.if_then(status.is_error, likely=False):
            convention.return_status_propagate(builder, status)
        return target.get_dummy_value()

    return types.none(types.int64, *_GIVEN), generate


perform: Any = _perform


@inner
def _stopped(v: float, d: float, k: float) -> float:
    """As `stop` of the table of arrays."""
    sign = 1.0 if v > 0 else (-1.0 if v < 0 else 0.0)
    a, p = d - k * sign, d if d > -k else -k
    turned = (d - (p if p < k else k)) * (1.0 + v / (1.0 if a == 0 else a))
    return v + a if (v + a) * sign > 0 else turned


@inner
def _choice(code: Codes, table: Codes, r: Array, m: int) -> None:
    """Kinks and jumps, without branches."""
    op, d, a, b, c, e = code[0], code[1], code[2], code[3], code[4], code[5]
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


@inner
def _circular(code: Codes, table: Codes, r: Array, m: int) -> None:
    op, d, a = code[0], code[1], code[2]
    if op == _SINCOS:
        sines_and_cosines(r[code[3]], r[d], r[a], m)
    else:
        sines(r[a], r[d], m, 1 if op == _COS else 0)


@inner
def _exponential(code: Codes, table: Codes, r: Array, m: int) -> None:
    if code[0] == _EXP:
        exponentials(r[code[2]], r[code[1]], m)
    else:
        hyperbolic_tangents(r[code[2]], r[len(r) - 1], r[code[1]], m)


@inner
def _root(code: Codes, table: Codes, r: Array, m: int) -> None:
    d, a = code[1], code[2]
    for i in range(m):
        r[d, i] = math.sqrt(r[a, i])


@inner
def _function(code: Codes, table: Codes, r: Array, m: int) -> None:
    """What the C library computes, one number at a time."""
    op, d, a, b = code[0], code[1], code[2], code[3]
    for i in range(m):
        x = r[a, i]
        if op == _POWER:
            r[d, i] = x ** r[b, i]
        elif op == _LOG:
            r[d, i] = math.log(x)
        elif op == _TAN:
            r[d, i] = math.tan(x)
        elif op == _ATAN:
            r[d, i] = math.atan(x)
        elif op == _ASIN:
            r[d, i] = math.asin(x)
        else:
            r[d, i] = math.acos(x)


@compiled
def _sweep(code: Codes, table: Codes, r: Array, rows: int) -> None:
    """Projected Gauss–Seidel as in `friction`; a row that has settled is left alone, so that no row depends on others.

    The instruction says where in the program's `extra`: registers of free and present velocities, limits, first guesses,
    inverse masses, the sub-step, and results.
    """
    where, m, turning = table[_EXTRA + code[2] :], code[3], code[0] == _TURN
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


@inner
def execute(code: Codes, table: Codes, r: Array, m: int) -> None:
    """All instructions of a part of a program, one after another."""
    # What every program is mostly made of stands here, not in a function, and its indices are unsigned: a call and the test for
    # negative indices would cost as much as the arithmetic on 16 lanes.
    lanes = np.uint64(m)
    for k in range(0, len(code), WIDTH):
        at = np.uint64(k)
        op, d, a = code[at], np.uint64(code[at + _ONE]), np.uint64(code[at + _TWO])
        b, c = np.uint64(code[at + _THREE]), np.uint64(code[at + _FOUR])
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
            perform(table[op], code[k : k + WIDTH], table, r, m)


_GROUPS: dict[Callable[..., None], tuple[int, ...]] = {
    _choice: (_MIN, _MAX, _ABS, _SIGN, _ROUND, _SOFT, _STOP, _PICK),
    _circular: (_SIN, _COS, _SINCOS),
    _exponential: (_EXP, _TANH),
    _root: (_SQRT,),
    _function: (_TAN, _LOG, _ATAN, _ASIN, _ACOS, _POWER),
    _sweep: (_SWEEP, _TURN),
}
_KERNEL = {op: kernel for kernel, several in _GROUPS.items() for op in several}


@functools.cache
def addresses(held: frozenset[int]) -> Codes:
    """Where each of these operations is; 0 for those that the interpreter carries out itself, and for all others."""
    return np.array([address(_KERNEL[op]) if op in held and op in _KERNEL else 0 for op in CODES.values()], dtype=np.int64)


@functools.cache
def address(kernel: Any) -> int:
    """Where a compiled operation is; compiles it."""
    kernel.compile(_GIVEN)
    result = kernel.overloads[_GIVEN]
    return int(result.library.get_pointer_to_function(result.fndesc.llvm_func_name))
