"""Straight-line programs: one list of operations for floats, intervals, derivatives and JAX alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, final

from gapcert import UsageError
from gapcert_equations.grammar import FUNCTIONS

Table = dict[str, Callable[..., Any]]
Instruction = tuple[str, tuple[int, ...], tuple[Any, ...]]


@final
@dataclass(frozen=True)
class Tape:
    """Expressions as instructions (operation, slots, literals) that append to a list of values.

    The list begins with the parameters; `fixed` depends on them alone; then come the variables, and `body`. An output None is
    structurally zero. Every number type runs the same operations in the same order, so what floats compute lies in what
    intervals compute.
    """

    parameters: int
    fixed: tuple[Instruction, ...]
    variables: int
    body: tuple[Instruction, ...]
    outputs: tuple[int | None, ...]

    def prepare(self, table: Table, parameters: Sequence[Any]) -> list[Any]:
        """The values that do not depend on variables."""
        return _run(table, list(parameters), self.fixed)

    def run(self, table: Table, prepared: Sequence[Any], variables: Sequence[Any]) -> list[Any]:
        """One value per output."""
        values = _run(table, [*prepared, *variables], self.body)
        return [None if o is None else values[o] for o in self.outputs]


def _run(table: Table, values: list[Any], code: tuple[Instruction, ...]) -> list[Any]:
    for name, slots, literals in code:
        values.append(table[name](*(values[s] for s in slots), *literals))
    return values


def record(expressions: Sequence[Any], parameters: Sequence[Any], variables: Sequence[Any]) -> Tape:
    """The tape of SymPy expressions; equal subexpressions are computed once."""
    first = _Recorder({s: ("fixed", i) for i, s in enumerate(parameters)} | {s: ("body", i) for i, s in enumerate(variables)})
    outputs = [None if e.is_zero and e.is_number else first.put(e) for e in expressions]
    p, f, v = len(parameters), len(first.code["fixed"]), len(variables)

    def slot(key: tuple[str, int]) -> int:
        part, index = key
        return index if part == "fixed" else index + p + f

    code = {
        part: tuple((name, tuple(slot(k) for k in keys), literals) for name, keys, literals in items)
        for part, items in first.code.items()
    }
    return Tape(p, code["fixed"], v, code["body"], tuple(None if o is None else slot(o) for o in outputs))


Key = tuple[str, int]


@final
class _Recorder:
    """Value numbering over two lists of instructions; keys are (part, index among that part's values)."""

    def __init__(self, leaves: dict[Any, Key]) -> None:
        self.leaves = leaves
        self.size = {part: sum(k[0] == part for k in leaves.values()) for part in ("fixed", "body")}
        self.code: dict[str, list[tuple[str, tuple[Key, ...], tuple[Any, ...]]]] = {"fixed": [], "body": []}
        self.known: dict[Any, Key] = {}

    def emit(self, name: str, *keys: Key, literals: tuple[Any, ...] = ()) -> Key:
        identity = (name, keys, tuple((type(v), v) for v in literals))
        if identity not in self.known:
            part = "body" if any(k[0] == "body" for k in keys) else "fixed"
            self.code[part].append((name, keys, literals))
            self.known[identity] = (part, self.size[part])
            self.size[part] += 1
        return self.known[identity]

    def put(self, e: Any) -> Key:
        if e in self.leaves:
            return self.leaves[e]
        if e.is_Rational:
            return self.emit("number", literals=(int(e.p), int(e.q)))
        if e.is_Number:
            return self.emit("number", literals=(float(e), 1))
        if e.is_Add:
            return self._sum(e)
        if e.is_Mul:
            return self._product(e)
        if e.is_Pow:
            return self._power(e.base, e.exp)
        arguments = [self.put(a) for a in e.args]
        name = type(e).__name__.lower()
        if name not in FUNCTIONS:
            raise UsageError(
                f"equations: simplification of an expression needs {e}, which is not supported; write it otherwise"
            )
        if name not in ("min", "max"):
            return self.emit(name, *arguments)
        out = arguments[0]
        for a in arguments[1:]:
            out = self.emit(name, out, a)
        return out

    def _sum(self, e: Any) -> Key:
        out: Key | None = None
        for term in self._ordered(e.args):
            coefficient, rest = term.as_coeff_Mul()
            negative = coefficient.is_negative and out is not None
            key = self.put(-coefficient * rest if negative else term)
            out = key if out is None else self.emit("sub" if negative else "add", out, key)
        assert out is not None
        return out

    def _product(self, e: Any) -> Key:
        """c · Π numerators / Π denominators, where c collects what depends on parameters alone."""
        coefficient, rest = e.as_coeff_Mul()
        if coefficient.is_negative:
            return self.emit("neg", self.put(-coefficient * rest))
        keys: dict[tuple[str, bool], list[Key]] = {(p, d): [] for p in ("fixed", "body") for d in (False, True)}
        for factor in self._ordered(e.args):
            under = factor.is_Pow and factor.exp.is_number and factor.exp.is_negative
            key = self.put(1 / factor if under else factor)
            keys[key[0], under].append(key)
        whole: Key | None = None
        for part in ("fixed", "body"):
            top = self._times([whole] if whole else [], keys[part, False])
            bottom = self._times([], keys[part, True])
            whole = top if bottom is None else self.emit("div", top or self.emit("number", literals=(1, 1)), bottom)
        assert whole is not None
        return whole

    def _times(self, start: list[Key], keys: list[Key]) -> Key | None:
        factors = [*start, *keys]
        if not factors:
            return None
        out = factors[0]
        for k in factors[1:]:
            out = self.emit("mul", out, k)
        return out

    def _power(self, base: Any, exponent: Any) -> Key:
        if exponent.is_number:
            value = float(exponent)
            if value < 0:
                return self.emit("div", self.emit("number", literals=(1, 1)), self._power(base, -exponent))
            if value.is_integer():
                return self.emit("pow", self.put(base), literals=(int(value),)) if value != 1 else self.put(base)
            if value == 0.5:
                return self.emit("sqrt", self.put(base))
        return self.emit("power", self.put(base), self.put(exponent))

    def _ordered(self, items: Sequence[Any]) -> list[Any]:
        """Parameters first, then in an order that does not depend on the process."""
        from sympy import default_sort_key

        def varies(e: Any) -> bool:
            return any(self.leaves[s][0] == "body" for s in e.free_symbols)

        return sorted(items, key=lambda e: (varies(e), default_sort_key(e)))
