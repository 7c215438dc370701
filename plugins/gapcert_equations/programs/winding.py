"""What a turn of an angle does to an expression: the number type that proves that a step repeats with it."""

from __future__ import annotations

from typing import Any, final

from gapcert import StateSpec
from gapcert.plugin import TURN

from .arithmetic import ARRAY
from .tape import Table

_ODD = ("sin", "tan", "tanh", "asin", "atan", "sign", "round")
_EVEN = ("cos", "abs")


@final
class Winding:
    """v(θ + 2π) = v(θ) + 2π `turns`, or −v(θ) where it `flips`; `why` nothing of the kind is known.

    `jump`: both may differ by that many turns more where a rounded angle lies half-way.
    """

    __array_ufunc__ = None
    __slots__ = ("flips", "jump", "turns", "why")

    def __init__(self, turns: float = 0.0, flips: bool = False, jump: float = 0.0, why: str = "") -> None:
        self.turns, self.flips, self.jump, self.why = _whole(turns), flips, _whole(jump), why

    @property
    def still(self) -> bool:
        return not (self.turns or self.flips or self.jump or self.why)

    def __neg__(self) -> Winding:
        return self * -1.0

    def __add__(self, other: Any) -> Winding:
        o = of(other)
        if self.why or o.why:
            return self if self.why else o
        if self.flips != o.flips and not (isinstance(other, float) and other == 0):
            return Winding(why="only a part of a sum changes its sign")
        if self.jump and o.jump and not (self.jump.is_integer() and o.jump.is_integer()):
            return Winding(why="a sum takes rounded values of it as numbers")
        return Winding(self.turns + o.turns, self.flips, self.jump or o.jump)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Winding:
        return self.__add__(-other)

    def __rsub__(self, other: Any) -> Winding:
        return (-self).__add__(other)

    def __mul__(self, other: Any) -> Winding:
        if not isinstance(other, Winding):
            c = float(other)
            return Winding(self.turns * c, self.flips and c != 0, self.jump * c, self.why)
        if self.why or other.why:
            return self if self.why else other
        if self.turns or other.turns or self.jump or other.jump:
            return Winding(why="a product takes it as a number")
        return Winding(flips=self.flips != other.flips)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Winding:
        return self * (1.0 / other) if isinstance(other, Winding) else self._over(float(other))

    def _over(self, c: float) -> Winding:
        return Winding(self.turns / c, self.flips, self.jump / c, self.why)

    def __rtruediv__(self, other: Any) -> Winding:
        return Winding(why=self.why or "a quotient takes it as a number") if self.turns or self.jump or self.why else self


def _whole(turns: float) -> float:
    """A factor that is meant to be a whole number is one, but for the rounding of what it was made of."""
    n = round(turns)
    return float(n) if abs(turns - n) <= 4e-16 * max(1.0, abs(n)) else float(turns)


def of(value: Any) -> Winding:
    """A number that is no Winding stays as it is."""
    return value if isinstance(value, Winding) else Winding()


def _function(name: str, plain: Any) -> Any:
    def apply(*values: Any) -> Any:
        if not any(isinstance(v, Winding) for v in values):
            return plain(*values)
        known = [of(v) for v in values]
        return next((v for v in known if v.why), None) or _applied(name, known)

    return apply


def _applied(name: str, known: list[Winding]) -> Winding:
    first = known[0]
    if all(v.still for v in known):
        return Winding()
    if first.flips and name in (*_ODD, *_EVEN):
        return Winding(flips=name in _ODD)
    if name in ("sin", "cos", "tan") and (2 * first.turns).is_integer() and first.jump.is_integer():
        return Winding(flips=name != "tan" and not first.turns.is_integer())
    if name == "round" and not first.jump and (whole := _whole(first.turns * TURN)).is_integer():
        return Winding(whole / TURN, jump=1 / TURN)
    what = "what changes its sign with it" if first.flips else f"{first.turns:.6g} times it"
    return Winding(why=f"{name} of {what} does not come round")


WINDING: Table = {
    name: plain if name in ("add", "sub", "mul", "div", "neg", "pow", "number") else _function(name, plain)
    for name, plain in ARRAY.items()
}


def unrepeated(spec: StateSpec, value: Any, angle: str) -> str:
    """Why a state after the step is not what it was a turn of `angle` before, but for whole turns where it is an angle."""
    v = of(value)
    if v.still or (spec.kind == "angle" and v.turns.is_integer() and v.jump.is_integer() and not (v.flips or v.why)):
        return ""
    if v.why or v.flips:
        return f"{spec.name} does not come round with {angle}: {v.why or 'it changes its sign'}"
    moved = f"{v.turns:.6g} turns" if spec.kind == "angle" else f"{v.turns * TURN:.6g} {spec.unit}"
    return f"a turn of {angle} moves {spec.name} by {moved}" if v.turns else f"{spec.name} rounds {angle} as a number"
