"""Which states an input leaves exactly where they are: zeros followed through the operations of a step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert import Array

from .arithmetic import ARRAY
from .tape import Table

# f(0) = 0 exactly, in real numbers and in every library of functions.
_ODD = ("sin", "tan", "tanh", "asin", "atan", "sqrt", "abs", "sign", "round", "pow", "neg")


@final
class Seen:
    """A number of which it is known at most that it is zero: then 0 · x and 0 / p are, p a parameter, and x + 0 is x itself."""

    __array_ufunc__ = None
    __slots__ = ("zero",)

    def __init__(self, zero: bool = False) -> None:
        self.zero = zero

    def __neg__(self) -> Seen:
        return self if self.zero else Seen()

    def __add__(self, other: Any) -> Seen:
        if _zero(other):
            return self
        return other if self.zero and isinstance(other, Seen) else Seen()

    __radd__ = __add__

    def __sub__(self, other: Any) -> Seen:
        return self if _zero(other) else Seen()

    def __rsub__(self, other: Any) -> Seen:
        return -self if _zero(other) else Seen()

    def __mul__(self, other: Any) -> Seen:
        return Seen(self.zero or _zero(other))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Seen:
        return Seen(self.zero and not isinstance(other, Seen) and other != 0)

    def __rtruediv__(self, other: Any) -> Seen:
        return Seen()


def _zero(value: Any) -> bool:
    return value.zero if isinstance(value, Seen) else bool(value == 0)


def _follows(name: str, plain: Any) -> Any:
    def apply(*values: Any) -> Any:
        if not any(isinstance(v, Seen) for v in values):
            return plain(*values)
        return Seen(name in _ODD and _zero(values[0]))

    return apply


_ARITHMETIC = ("add", "sub", "mul", "div", "neg", "number")
SEEN: Table = {name: plain if name in _ARITHMETIC else _follows(name, plain) for name, plain in ARRAY.items()}


def unmoved(step: Callable[..., Any], fixed: Any, u: Array, nx: int, known: bool) -> npt.NDArray[np.bool_]:
    """(n, nx): states that a step (table, fixed, columns) gives back unchanged, under inputs u (n, nu), if that is known."""
    if not known:
        return np.zeros((len(u), nx), dtype=bool)
    patterns, which = np.unique(u == 0, axis=0, return_inverse=True)
    found = np.empty((len(patterns), nx), dtype=bool)
    for row, zeros in zip(found, patterns, strict=True):
        x = [Seen() for _ in range(nx)]
        after = step(SEEN, fixed, [*x, *(Seen(bool(zero)) for zero in zeros)])
        row[:] = [a is b for a, b in zip(after, x, strict=True)]
    return found[which.reshape(-1)]
