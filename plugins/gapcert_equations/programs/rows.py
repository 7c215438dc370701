"""sin, cos, exp and tanh of rows without branches, so that they run in vector registers; within 2 ulp of the C library's.

Polynomials and splitting of π/2 and ln 2 are those of FreeBSD's msun (k_sin.c, k_cos.c, e_rem_pio2.c, e_exp.c), the fraction
for small tanh is that of Cephes.
"""

from __future__ import annotations

import math

import numpy as np

from gapcert import Array
from gapcert.plugin import compiler

_FAR = 1e5  # beyond, n times the first 33 bits of π/2 is no longer exact enough
_STEEP = 708.0  # beyond, 2ⁿ leaves the normal numbers
_SHIFT = 6755399441055744.0  # 1.5·2⁵²: adding it leaves an integer in the low bits

compiled = compiler(nogil=True, error_model="numpy", fastmath={"contract"}, _nrt=False)


@compiled
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


@compiled
def _far(x: Array, m: int) -> bool:
    count = 0
    for i in range(m):
        count += abs(x[i]) > _FAR
    return count > 0


@compiled
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


@compiled
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


@compiled
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


@compiled
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
