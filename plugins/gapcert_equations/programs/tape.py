"""Straight-line programs: one list of operations for floats, intervals, derivatives and JAX alike."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partialmethod
from typing import Any, final

from gapcert import UsageError
from gapcert_equations.text.grammar import FUNCTIONS

Table = dict[str, Callable[..., Any]]
Columns = list[Any]
"""Batches as columns, one per number of a row, of any number type."""
Instruction = tuple[str, tuple[int, ...], tuple[Any, ...]]


@final
@dataclass(frozen=True)
class Tape:
    """Expressions as instructions (operation, slots, literals) that append to a list of values.

    The list begins with the parameters; `fixed` depends on them alone; then come the variables, and `body`. An output None is
    structurally zero. Every number type runs the same operations in the same order, so what floats compute lies in what
    intervals compute.
    """

    fixed: tuple[Instruction, ...]
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
    append = values.append
    for name, slots, literals in code:
        function = table[name]
        # Nearly all are of the first two kinds; a general call costs as much as the arithmetic on few rows.
        if len(slots) == 2 and not literals:
            i, j = slots
            append(function(values[i], values[j]))
        elif len(slots) == 1 and not literals:
            append(function(values[slots[0]]))
        else:
            append(function(*[values[s] for s in slots], *literals))
    return values


Key = tuple[str, Any]


@final
class Recorder:
    """Value numbering of SymPy expressions: equal subexpressions are computed once, also by the tapes that follow.

    Keys are ("parameter" | "variable", symbol) of a leaf, or ("fixed" | "body", index) of an instruction. It only ever grows,
    so a model shares it with its extensions: one more effect costs what the effect adds.
    """

    def __init__(self) -> None:
        self.kinds: dict[Any, str] = {}
        self.code: dict[str, list[tuple[str, tuple[Key, ...], tuple[Any, ...]]]] = {"fixed": [], "body": []}
        self.known: dict[Any, Key] = {}
        self.seen: dict[Any, Key] = {}
        self.made: dict[Any, Any] = {}
        self.defined: weakref.WeakValueDictionary[str, Any] = weakref.WeakValueDictionary()
        self.programs: weakref.WeakValueDictionary[Any, Any] = weakref.WeakValueDictionary()
        self.lock = threading.Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        return Recorder, ()

    def knowing(self, parameters: Sequence[Any], variables: Sequence[Any]) -> Recorder:
        """This one with further symbols; a new one where a symbol is of another kind here."""
        kinds = dict.fromkeys(parameters, "parameter") | dict.fromkeys(variables, "variable")
        if any(self.kinds.get(s, k) != k for s, k in kinds.items()):
            return Recorder().knowing(parameters, variables)
        self.kinds.update(kinds)
        return self

    def tape(self, expressions: Sequence[Any], parameters: Sequence[Any], variables: Sequence[Any]) -> Tape:
        """The tape of some expressions in these parameters and variables."""
        with self.lock:
            outputs = [self._output(e) for e in expressions]
            fixed, body = self._needed([o for o in outputs if o is not None])
        first = len(parameters) + len(fixed)
        slots: dict[Key, int] = {("parameter", s): i for i, s in enumerate(parameters)}
        slots |= {k: len(parameters) + i for i, k in enumerate(fixed)}
        slots |= {("variable", s): first + i for i, s in enumerate(variables)}
        slots |= {k: first + len(variables) + i for i, k in enumerate(body)}

        def code(keys: list[Key]) -> tuple[Instruction, ...]:
            items = [self.code[part][i] for part, i in keys]
            return tuple([(name, tuple([slots[k] for k in given]), literals) for name, given, literals in items])

        results = tuple(None if o is None else slots[o] for o in outputs)
        return Tape(code(fixed), code(body), results)

    def once(self, given: Any, make: Callable[[], Any]) -> Any:
        """What is recorded of these texts and expressions, recorded the first time."""
        if given not in self.made:
            self.made[given] = make()
        return self.made[given]

    def _output(self, e: Any) -> Key | None:
        if isinstance(e, Value):
            return e.key
        if isinstance(e, float):
            return None if e == 0 else self.emit("number", literals=(e, 1))
        return None if e.is_number and e.is_zero else self.put(e)

    def value(self, e: Any) -> Any:
        """A SymPy expression as a Value, or as the number that it is."""
        return float(e) if e.is_number else Value(self, self.put(e))

    def _needed(self, keys: list[Key]) -> tuple[list[Key], list[Key]]:
        """The instructions of both parts that these values rest on, in the order in which they were recorded."""
        found = set[Key]()
        while keys:
            key = keys.pop()
            if key not in found and (code := self.code.get(key[0])) is not None:
                found.add(key)
                keys += code[key[1]][1]
        return sorted([k for k in found if k[0] == "fixed"]), sorted([k for k in found if k[0] == "body"])

    def emit(self, name: str, *keys: Key, literals: tuple[Any, ...] = ()) -> Key:
        identity = (name, keys, tuple((type(v), v) for v in literals))
        if identity not in self.known:
            part = "body" if any(_varies(k) for k in keys) else "fixed"
            self.code[part].append((name, keys, literals))
            self.known[identity] = (part, len(self.code[part]) - 1)
        return self.known[identity]

    def put(self, e: Any) -> Key:
        """The key of an expression, recorded if it is new."""
        if e not in self.seen:
            self.seen[e] = (self.kinds[e], e) if e.is_Symbol else self._new(e)
        return self.seen[e]

    def _new(self, e: Any) -> Key:
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
        keys: dict[tuple[bool, bool], list[Key]] = {(v, d): [] for v in (False, True) for d in (False, True)}
        for factor in self._ordered(e.args):
            under = factor.is_Pow and factor.exp.is_number and factor.exp.is_negative
            key = self.put(1 / factor if under else factor)
            keys[_varies(key), under].append(key)
        whole: Key | None = None
        for varying in (False, True):
            top = self._times([whole] if whole else [], keys[varying, False])
            bottom = self._times([], keys[varying, True])
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
            return any(self.kinds[s] == "variable" for s in e.free_symbols)

        return sorted(items, key=lambda e: (varies(e), default_sort_key(e)))


@final
class Value:
    """What an instruction gives, to compute with; 0·x, 1·x and x + 0 are no instructions."""

    __slots__ = ("key", "recorder")

    def __init__(self, recorder: Recorder, key: Key) -> None:
        self.recorder, self.key = recorder, key

    def _new(self, name: str, *values: Any) -> Value:
        keys = (v.key if isinstance(v, Value) else self.recorder.emit("number", literals=(float(v), 1)) for v in values)
        return Value(self.recorder, self.recorder.emit(name, *keys))

    def _of(self, name: str, *others: Any) -> Value:
        return self._new(name, self, *others)

    __neg__ = partialmethod(_of, "neg")
    __abs__ = partialmethod(_of, "abs")
    max = partialmethod(_of, "max")
    sqrt = partialmethod(_of, "sqrt")
    sin = partialmethod(_of, "sin")
    cos = partialmethod(_of, "cos")

    def __add__(self, other: Any) -> Any:
        return self if _is(other, 0) else self._new("add", self, other)

    def __radd__(self, other: Any) -> Any:
        return self if _is(other, 0) else self._new("add", other, self)

    def __sub__(self, other: Any) -> Any:
        return self if _is(other, 0) else self._new("sub", self, other)

    def __rsub__(self, other: Any) -> Any:
        return -self if _is(other, 0) else self._new("sub", other, self)

    def __mul__(self, other: Any) -> Any:
        if _is(other, 0):
            return 0.0
        if _is(other, 1):
            return self
        return -self if _is(other, -1) else self._new("mul", self, other)

    def __rmul__(self, other: Any) -> Any:
        if isinstance(other, Value) or not (_is(other, 0) or _is(other, 1) or _is(other, -1)):
            return self._new("mul", other, self)
        return self * other


def _is(value: Any, number: float) -> bool:
    return not isinstance(value, Value) and bool(value == number)


def _varies(key: Key) -> bool:
    return key[0] in ("body", "variable")
