"""The terms of a mechanical model, M(q) v̇ + bias = forces, with its payloads and with gravity turned."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, final

import sympy
from sympy.simplify.fu import TR8

from gapcert import UsageError
from gapcert_equations.config import EquationsConfig
from gapcert_equations.text import declarations, units
from gapcert_equations.text.sympy_text import symbol
from gapcert_equations.text.units import ACCELERATION, METRE
from gapcert_equations.thresholds import THRESHOLDS

STANDARD_GRAVITY = 9.80665

Read = Callable[[str, str], Any]


@final
@dataclass(frozen=True)
class Terms:
    """SymPy expressions: mass[i][j], bias[i], forces[i] in the order of the coordinates."""

    mass: list[list[Any]]
    bias: list[Any]
    forces: list[Any]


def terms(config: EquationsConfig, read: Read) -> Terms:
    """`read` turns (path, text) into an expression."""
    names = list(config.coordinates)
    mass = [[read(f"mass_matrix.{i}.{j}", e) for j, e in enumerate(row)] for i, row in enumerate(config.mass_matrix or [])]
    bias, forces = ([read(f"{k}.{q}", getattr(config, k).get(q, "0")) for q in names] for k in ("bias", "forces"))
    out = Terms(mass, bias, forces)
    for q, text in config.payload.items():
        out = _carrying(config, read, out, q, read(f"payload.{q}", text))
    for q, text in config.tilt.items():
        out = _tilted(config, out, names.index(q), read(f"tilt.{q}", text))
    return out


def _carrying(config: EquationsConfig, read: Read, t: Terms, q: str, m: Any) -> Terms:
    """M + m JᵀJ, bias + m Jᵀ (J̇ v − g), with J the Jacobian of the place of the mass and g the vector of gravity."""
    place = tuple(read(f"points.{q}.{i}", text) for i, text in enumerate(config.points[q]))
    down = gravity(config, read, len(place))
    names = list(config.coordinates)
    jacobian, inertia, turning = _geometry(place, tuple(map(symbol, names)), tuple(symbol(f"{n}_dot") for n in names))
    if any(e.has(sympy.Derivative, sympy.Subs, sympy.DiracDelta) for e in (*turning, *(e for row in jacobian for e in row))):
        raise UsageError(f"model.points.{q}: ({', '.join(config.points[q])}) has no derivative; write it without kinks")
    mass = [[e + m * inertia[i][j] for j, e in enumerate(row)] for i, row in enumerate(t.mass)]
    weight = [sum(row[i] * g for row, g in zip(jacobian, down, strict=True)) for i in range(len(names))]
    return Terms(mass, [b + m * (turning[i] - weight[i]) for i, b in enumerate(t.bias)], t.forces)


def gravity(config: EquationsConfig, read: Read, size: int) -> list[Any]:
    """As declared, else straight down along the last axis."""
    if config.gravity is None:
        return [sympy.Integer(0)] * (size - 1) + [-_strength(config)]
    numbers = [declarations.quantity_in(text, ACCELERATION) for text in config.gravity]
    texts = zip(numbers, config.gravity, strict=True)
    return [read(f"gravity.{i}", text if n is None else repr(n)) for i, (n, text) in enumerate(texts)]


def _strength(config: EquationsConfig) -> Any:
    """The parameter `g` where there is one and it is an acceleration, else standard gravity."""
    g = config.parameters.get("g")
    known = g is not None and declarations.parameter_dimension(g) == ACCELERATION
    return symbol("g") if known else sympy.Float(STANDARD_GRAVITY)


@functools.lru_cache(maxsize=256)
def _geometry(place: Sequence[Any], q: Sequence[Any], v: Sequence[Any]) -> tuple[Any, Any, Any]:
    """J, JᵀJ and Jᵀ J̇ v of a point."""
    jacobian = [[sympy.diff(p, a) for a in q] for p in place]
    centripetal = [_along([sympy.diff(_along(row, v), b) for b in q], v) for row in jacobian]
    inertia = [[_tidy(sum(row[i] * row[j] for row in jacobian)) for j in range(len(q))] for i in range(len(q))]
    turning = [_tidy(sum(row[i] * c for row, c in zip(jacobian, centripetal, strict=True))) for i in range(len(q))]
    return jacobian, inertia, turning


def _along(row: Sequence[Any], v: Sequence[Any]) -> Any:
    return sum((e * w for e, w in zip(row, v, strict=True)), sympy.Integer(0))


def _tidy(e: Any) -> Any:
    """Products of sines as sines of sums, so that sin² + cos² = 1, where that is quick and makes it shorter."""
    if sympy.count_ops(e) > THRESHOLDS.expanded_operations:
        return e
    shorter = sympy.expand(TR8(sympy.expand(e)))
    return shorter if sympy.count_ops(shorter) <= sympy.count_ops(e) else e


def _tilted(config: EquationsConfig, t: Terms, k: int, angle: Any) -> Terms:
    """Gravity turned by `angle` along coordinate k.

    Of an angle q, the bias at rest is taken at q − angle. Along a length x, everything is pulled as a mass would be on a
    slope: forces + M[:, x] g sin(angle).
    """
    names = list(config.coordinates)
    if units.unit(declarations.axes(config.coordinates)[names[k]].unit)[0] == METRE:
        pull = _strength(config) * sympy.sin(angle)
        return Terms(t.mass, t.bias, [f + row[k] * pull for f, row in zip(t.forces, t.mass, strict=True)])
    rest = {symbol(f"{n}_dot"): sympy.Integer(0) for n in names}
    turned = {symbol(names[k]): symbol(names[k]) - angle}
    bias = []
    for b in t.bias:
        at_rest = b.xreplace(rest)
        bias.append(b - at_rest + at_rest.xreplace(turned))
    return Terms(t.mass, bias, t.forces)
