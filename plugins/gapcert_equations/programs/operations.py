"""Operations of a program on rows of registers, compiled in groups, and only those that a program holds.

The interpreter (`machine`) calls them through their addresses: what it called by name would be compiled into it.

sin, cos, exp and tanh of rows have no branches, so that they run in vector registers; they are within 2 ulp of the C library's.
Polynomials and splitting of π/2 and ln 2 are those of FreeBSD's msun (k_sin.c, k_cos.c, e_rem_pio2.c, e_exp.c), the fraction
for small tanh is that of Cephes.
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

from .trace import ARITHMETIC, CHOICES, CODES, WIDTH, Codes

_MIN, _MAX, _ABS, _SIGN, _ROUND, _SOFT, _STOP, _PICK = (CODES[n] for n in CHOICES)
_SIN, _COS, _TAN, _EXP, _LOG, _SQRT = (CODES[n] for n in ("sin", "cos", "tan", "exp", "log", "sqrt"))
_TANH, _ATAN, _ASIN, _ACOS, _POWER = (CODES[n] for n in ("tanh", "atan", "asin", "acos", "power"))
_SINCOS, _SWEEP, _TURN = CODES["sincos"], CODES["sweep"], CODES["turn"]
_SETTLED = 1e-12
_FAR = 1e5  # beyond, n times the first 33 bits of π/2 is no longer exact enough
_STEEP = 708.0  # beyond, 2ⁿ leaves the normal numbers
_SHIFT = 6755399441055744.0  # 1.5·2⁵²: adding it leaves an integer in the low bits
_EXTRA = len(CODES)
_ONE, _TWO, _THREE, _FOUR = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
_ADD, _SUB, _MUL, _DIV, _NEG, _COPY, _MULADD, _MULSUB, _SUBMUL = (CODES[n] for n in ARITHMETIC)
_GIVEN = types.int64[::1], types.int64[::1], types.float64[:, ::1], types.int64

# The first two are called by compiled functions alone: from Python they would crash. Inner ones make no arrays, and need not
# count references; contracted ones may fuse a product with a sum.
compiled = compiler(nogil=True, error_model="numpy", no_cpython_wrapper=True)
inner = compiler(nogil=True, error_model="numpy", _nrt=False, no_cpython_wrapper=True)
contracted = compiler(nogil=True, error_model="numpy", fastmath={"contract"}, _nrt=False)


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


@contracted
def _turn(x: float) -> tuple[float, float, float]:
    """(quadrant, sin r, cos r) of x = quadrant·π/2 + r."""
    n = np.floor(x * 0.6366197723675814 + 0.5)
    r = ((x - n * 1.5707963267341256) - n * 6.077100506303966e-11) - n * 2.0222662487959506e-21
    z = r * r
    p = -2.50507602534068634195e-08 + z * 1.58969099521155010221e-10
    p = -1.98412698298579493134e-04 + z * (2.75573137070700676789e-06 + z * p)
    s = r + z * r * (-1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * p))
    q = 2.08757232129817482790e-09 + z * -1.13596475577881948265e-11
    q = 2.48015872894767294178e-05 + z * (-2.75573143513906633035e-07 + z * q)
    q = z * (4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * q))
    w = 1.0 - 0.5 * z
    c = w + (((1.0 - w) - 0.5 * z) + z * q)
    return n - 4.0 * np.floor(n * 0.25), s, c


@contracted
def _far(x: Array, m: int) -> bool:
    count = 0
    for i in range(m):
        count += abs(x[i]) > _FAR
    return count > 0


@contracted
def sines_and_cosines(x: Array, sine: Array, cosine: Array, m: int) -> None:
    """Both, of the first m numbers of a row."""
    if _far(x, m):
        for i in range(m):
            sine[i], cosine[i] = math.sin(x[i]), math.cos(x[i])
        return
    for i in range(m):
        quadrant, s, c = _turn(x[i])
        odd = quadrant == 1.0 or quadrant == 3.0
        p, q = (c, s) if odd else (s, c)
        sine[i] = -p if quadrant >= 2.0 else p
        cosine[i] = -q if quadrant == 1.0 or quadrant == 2.0 else q


@contracted
def sines(x: Array, out: Array, m: int, ahead: int) -> None:
    """sin of the first m numbers of a row; a quarter of a turn ahead it is cos."""
    if _far(x, m):
        for i in range(m):
            out[i] = math.cos(x[i]) if ahead else math.sin(x[i])
        return
    for i in range(m):
        quadrant, s, c = _turn(x[i])
        quadrant += ahead
        p = c if quadrant == 1.0 or quadrant == 3.0 else s
        out[i] = -p if quadrant == 2.0 or quadrant == 3.0 else p


@contracted
def exponentials(x: Array, out: Array, m: int) -> None:
    """exp of the first m numbers of a row."""
    count = 0
    for i in range(m):
        count += abs(x[i]) > _STEEP
    if count > 0:
        for i in range(m):
            out[i] = math.exp(x[i])
        return
    for i in range(m):
        out[i] = np.floor(x[i] * 1.4426950408889634 + 0.5) + _SHIFT
    bits = out.view(np.int64)
    for i in range(m):
        bits[i] = (bits[i] + 1023) << 52
    for i in range(m):
        n = np.floor(x[i] * 1.4426950408889634 + 0.5)
        hi, lo = x[i] - n * 6.93147180369123816490e-01, n * 1.90821492927058770002e-10
        r = hi - lo
        t = r * r
        p = 6.61375632143793436117e-05 + t * (-1.65339022054652515390e-06 + t * 4.13813679705723846039e-08)
        c = r - t * (1.66666666666666019037e-01 + t * (-2.77777777770155933842e-03 + t * p))
        out[i] *= 1.0 - ((lo - (r * c) / (2.0 - c)) - hi)


@contracted
def hyperbolic_tangents(x: Array, double: Array, out: Array, m: int) -> None:
    """tanh of the first m numbers of a row; `double` has room for as many."""
    for i in range(m):
        double[i] = 2.0 * min(abs(x[i]), 20.0)
    exponentials(double, out, m)
    for i in range(m):
        y = x[i]
        z = y * y
        p = -1.61468768441708447952e3 + z * (-9.92877231001918586564e1 + z * -9.64399179425052238628e-1)
        q = 4.84406305325125486048e3 + z * (2.23548839060100448583e3 + z * (1.12811678491632931402e2 + z))
        near, far = y + y * z * p / q, 1.0 - 2.0 / (out[i] + 1.0)
        far = -far if y < 0 else far
        out[i] = far if abs(y) > 0.625 else near


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
