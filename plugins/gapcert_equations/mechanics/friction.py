"""Linear solves with M, and set-valued friction |f| <= F solved at velocity level; for columns of any number type."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gapcert import Interval
from gapcert_equations.programs.arithmetic import Dual
from gapcert_equations.programs.tape import Columns, Table

SWEEPS = 50

Matrix = list[list[Any]] | None


def solve(mass: Matrix, rhs: Columns) -> Columns:
    """M⁻¹ rhs by elimination without pivoting (M is positive definite); entries None are zero, no matrix is the identity."""
    if mass is None:
        return rhs
    m, r, n = [list(row) for row in mass], list(rhs), len(rhs)
    for k in range(n):
        for i in range(k + 1, n):
            if m[i][k] is None:
                continue
            factor = m[i][k] / m[k][k]
            for j in range(k + 1, n):
                if m[k][j] is not None:
                    m[i][j] = -(factor * m[k][j]) if m[i][j] is None else m[i][j] - factor * m[k][j]
            r[i] = r[i] - factor * r[k]
    for i in reversed(range(n)):
        for j in range(i + 1, n):
            if m[i][j] is not None:
                r[i] = r[i] - m[i][j] * r[j]
        r[i] = r[i] / m[i][i]
    return r


def coupled(mass: Matrix) -> bool:
    """Has M entries off its diagonal?"""
    return mass is not None and any(e is not None for i, row in enumerate(mass) for j, e in enumerate(row) if i != j)


def velocities(table: Table, mass: Matrix, rhs: Columns, bounds: Columns, v: Columns, h: Any) -> Columns:
    """v + h M⁻¹ (rhs + f) with f in [−F, F] bringing it closest to zero; bounds None: no friction there.

    Where coordinates do not couple this is the soft threshold of the free velocity by h F / M, so that rest is exact.
    """
    free = _moved(v, h, solve(mass, rhs))
    if all(b is None for b in bounds):
        return free
    limits = _limits(table, bounds)
    if mass is None or not coupled(mass):
        weights = [1.0 if mass is None else mass[i][i] for i in range(len(v))]
        stop = table["soft"]
        return [a if b is None else stop(a, h * b / w) for a, b, w in zip(free, limits, weights, strict=True)]
    f = _held(table, mass, rhs, limits, v, h)
    new = _moved(v, h, solve(mass, with_friction(rhs, f)))
    return [a if b is None else _rest(table, a, p, b) for a, p, b in zip(new, f, limits, strict=True)]


def mean(table: Table, mass: Matrix, rhs: Columns, bounds: Columns, v: Columns, h: Any) -> Columns:
    """The friction forces averaged over a sub-step in which every coordinate may slip, stop, rest and turn round."""
    if all(b is None for b in bounds):
        return bounds
    limits = _limits(table, bounds)
    if coupled(mass):
        return _held(table, mass, rhs, limits, v, h, turning=True)
    out: Columns = list(limits)
    for i, (b, w) in enumerate(zip(limits, _stopping(mass, rhs, v, h), strict=True)):
        if b is not None:
            m = 1.0 if mass is None else mass[i][i]
            end = table["stop"](v[i], h * rhs[i] / m, h * b / m)
            out[i] = _clip(table, w + end * m / h, b)
    return out


def _held(table: Table, mass: Matrix, rhs: Columns, limits: Columns, v: Columns, h: Any, turning: bool = False) -> Columns:
    """The friction forces themselves where coordinates couple, by projected Gauss–Seidel over M⁻¹.

    The first guess stops every coordinate at once; where no bound cuts it, it is the answer. That is right where a motion ends
    at rest; with `turning`, one that reverses is braked until it stops and driven against −F thereafter, and only what rests
    already, and may, is held by exactly what acts on it.
    """
    if _is_interval(v):
        return [None if b is None else Interval.hull(-b, b) for b in limits]
    wanted = _stopping(mass, rhs, v, h)
    start = [None if b is None else _clip(table, w, b) for w, b in zip(wanted, limits, strict=True)]
    rows = [i for i, b in enumerate(limits) if b is not None]
    f = _project(table, _inverse(table, mass, rows, len(v)), _moved(v, h, solve(mass, rhs)), v, limits, h, start, turning)
    if any(b is None for b in limits):
        return f
    excess = zero = table["number"](0, 1)
    for a, w, b in zip(v, wanted, limits, strict=True):
        over = table["abs"](w) - b
        excess = table["max"](excess, table["max"](over, table["abs"](a)) if turning else over)
    return [table["pick"](excess, zero, a, b) for a, b in zip(start, f, strict=True)]


def _stopping(mass: Matrix, rhs: Columns, v: Columns, h: Any) -> Columns:
    """−(M v / h + rhs): the forces that would stop every coordinate within a sub-step."""
    return [-(p / h + r) for p, r in zip(_times(mass, v), rhs, strict=True)]


def soft(
    table: Table, mass: Matrix, rhs: Columns, bounds: Columns, v: Columns, softness: Sequence[tuple[float, float] | None]
) -> Columns:
    """Friction forces that give way, f = −(a₀ + b v + M⁻¹ f) / R within [−F, F], by (R, b) per row; None: not of this kind."""
    found = [s if b is not None else None for s, b in zip(softness, bounds, strict=True)]
    limits = [b if s else None for s, b in zip(found, _limits(table, bounds), strict=True)]
    if coupled(mass) and _is_interval(v):
        return [None if b is None else Interval.hull(-b, b) for b in limits]
    pull = [a if s is None else a + s[1] * p for a, p, s in zip(solve(mass, rhs), v, found, strict=True)]
    yielding, one = {i: s[0] for i, s in enumerate(found) if s is not None}, table["number"](1, 1)
    inverse = _inverse(table, mass, list(yielding), len(v))
    for i, compliance in yielding.items():
        inverse[i][i] = inverse[i][i] + compliance
    start = [
        None if b is None else _clip(table, -a / inverse[i][i], b) for i, (a, b) in enumerate(zip(pull, limits, strict=True))
    ]
    if len(yielding) == 1 or not coupled(mass):
        return start
    return _project(table, inverse, pull, v, limits, one, start)


def with_friction(rhs: Columns, friction: Columns) -> Columns:
    """Right-hand sides plus friction; None is a coordinate without."""
    return [r if f is None else r + f for r, f in zip(rhs, friction, strict=True)]


def _inverse(table: Table, mass: Matrix, rows: Sequence[int], n: int) -> dict[int, Columns]:
    """Columns of M⁻¹."""
    zero, one = table["number"](0, 1), table["number"](1, 1)
    return {j: solve(mass, [one if i == j else zero for i in range(n)]) for j in rows}


def _project(
    table: Table,
    inverse: dict[int, Columns],
    free: Columns,
    v: Columns,
    limits: Columns,
    h: Any,
    start: Columns,
    turning: bool = False,
) -> Columns:
    """f within its limits that brings free + h · inverse f closest to zero.

    By a fixed number of sweeps: the answer for one row of a batch must not depend on the others. A number type whose rows are
    on their own anyway has a `sweep` that ends when nothing moves.
    """
    f, rows = list(start), list(inverse)
    if "sweep" in table:
        parts = [[a[i] for i in rows] for a in (free, v, limits, start)]
        found = table["sweep"](*parts, [[inverse[j][i] for i in rows] for j in rows], h, turning)
        return [None if b is None else found[rows.index(i)] for i, b in enumerate(limits)]
    for _ in range(SWEEPS):
        for i in rows:
            speed, reach = free[i], h * inverse[i][i]
            for j in rows:
                speed = speed + h * (inverse[j][i] * f[j])
            if turning:
                speed = speed - table["stop"](v[i], speed - reach * f[i] - v[i], reach * limits[i])
            f[i] = _clip(table, f[i] - speed / reach, limits[i])
    return f


def _limits(table: Table, bounds: Columns) -> Columns:
    return [None if b is None else table["max"](b, table["number"](0, 1)) for b in bounds]


def _clip(table: Table, value: Any, limit: Any) -> Any:
    return table["max"](table["min"](value, limit), -limit)


def _rest(table: Table, velocity: Any, force: Any, limit: Any) -> Any:
    """Zero where the friction is inside its bound: it stops what is left by rounding and by the last sweep."""
    zero = table["number"](0, 1)
    if isinstance(velocity, Interval):
        return Interval.hull(velocity, zero)
    return table["pick"](limit, table["abs"](force), velocity, zero)


def _moved(v: Columns, h: Any, acceleration: Columns) -> Columns:
    return [a + h * b for a, b in zip(v, acceleration, strict=True)]


def _times(mass: Matrix, v: Columns) -> Columns:
    if mass is None:
        return v
    out = []
    for row in mass:
        terms = [m * x for m, x in zip(row, v, strict=True) if m is not None]
        out.append(sum(terms[1:], terms[0]))
    return out


def _is_interval(v: Columns) -> bool:
    return any(isinstance(a.value if isinstance(a, Dual) else a, Interval) for a in v)
