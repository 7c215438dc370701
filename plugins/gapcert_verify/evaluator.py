"""Equation text bounded once more: f over boxes and its slopes, from the `model:` section alone, by code of `verify` alone.

A section becomes a list of operations, one step of the integrator written out, in which equal ones occur once. It is run on
intervals (`arithmetic`), forwards, with slopes where these are asked for. Of the code that makes models nothing is used; the
functions that a text may call have the same names.
"""

from __future__ import annotations

import ast
import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from gapcert.plugin import Array

from . import arithmetic as ar
from .arithmetic import Range

Slopes = dict[int, Range]
_ONE, _ZERO = ar.point(1.0), ar.point(0.0)
_WHOLE = Range(np.float64(-np.inf), np.float64(np.inf))
_UP = Range(np.float64(0.0), np.float64(np.inf))
CHUNK = 1 << 14  # boxes at once: what a cache holds


class NotText(Exception):
    """What of a model is no equation text, or none that is bounded here, in words."""


def _jump(x: Range, across: Range) -> Range:
    """The slope of steps: 0, or anything of `across` where one may lie in x."""
    crossed = np.asarray(ar.rounded(x).lo != ar.rounded(x).hi) if across is _UP else np.asarray((x.lo <= 0) & (x.hi >= 0))
    return Range(np.where(crossed, across.lo, 0.0), np.where(crossed, across.hi, 0.0))


def _of_tan(x: Range, y: Range) -> Range:
    return ar.add(_ONE, ar.whole_power(y, 2))


def _of_root(x: Range, y: Range) -> Range:
    return ar.divide(ar.point(0.5), y)


def _of_arc(x: Range, y: Range) -> Range:
    return ar.divide(_ONE, ar.root(ar.subtract(_ONE, ar.whole_power(x, 2))))


FUNCTIONS: dict[str, tuple[Callable[[Range], Range], Callable[[Range, Range], Range]]] = {
    "sin": (ar.sin, lambda x, y: ar.cos(x)),
    "cos": (ar.cos, lambda x, y: ar.negative(ar.sin(x))),
    "tan": (ar.tan, _of_tan),
    "exp": (ar.exp, lambda x, y: y),
    "log": (ar.log, lambda x, y: ar.divide(_ONE, x)),
    "sqrt": (ar.root, _of_root),
    "abs": (ar.absolute, lambda x, y: ar.sign(x)),
    "tanh": (ar.tanh, lambda x, y: ar.greatest(ar.subtract(_ONE, ar.whole_power(y, 2)), _ZERO)),
    "atan": (ar.arctan, lambda x, y: ar.divide(_ONE, ar.add(_ONE, ar.whole_power(x, 2)))),
    "asin": (ar.arcsin, _of_arc),
    "acos": (ar.arccos, lambda x, y: ar.negative(_of_arc(x, y))),
    "sign": (ar.sign, lambda x, y: _jump(x, _WHOLE)),
    "round": (ar.rounded, lambda x, y: _jump(x, _UP)),
}
"""Name → range, and range of the slope from those of argument and value; beside them a text may call min and max."""
_BINARY = {
    "+": ar.add,
    "-": ar.subtract,
    "*": ar.multiply,
    "/": ar.divide,
    "min": ar.least,
    "max": ar.greatest,
    "soft": ar.soft,
}


@final
@dataclass(frozen=True)
class Term:
    """A value on a tape, by its number."""

    tape: Tape
    at: int

    def __add__(self, other: Term) -> Term:
        return self if other.is_number(0) else other if self.is_number(0) else self.tape.put("+", self, other)

    def __sub__(self, other: Term) -> Term:
        return self if other.is_number(0) else self.tape.put("-", self, other)

    def __neg__(self) -> Term:
        return self.tape.number(0) - self

    def __mul__(self, other: Term) -> Term:
        if self.is_number(0) or other.is_number(0):
            return self.tape.number(0)
        return self if other.is_number(1) else other if self.is_number(1) else self.tape.put("*", self, other)

    def __truediv__(self, other: Term) -> Term:
        return self if other.is_number(1) else self.tape.put("/", self, other)

    def is_number(self, value: float) -> bool:
        """Is it this constant, exactly?"""
        op, _, data = self.tape.code[self.at]
        return op == "number" and data == (value, value)

    @property
    def on(self) -> frozenset[int]:
        """The columns that it depends on."""
        return self.tape.uses[self.at]


@final
@dataclass
class Tape:
    """Operations in order; equal ones are one. uses: the columns that each depends on."""

    code: list[tuple[str, tuple[int, ...], Any]] = field(default_factory=list)
    uses: list[frozenset[int]] = field(default_factory=list)
    known: dict[tuple[str, tuple[int, ...], Any], int] = field(default_factory=dict)
    plans: dict[tuple[int, ...], list[tuple[int, list[int]]]] = field(default_factory=dict)

    def put(self, op: str, *args: Term, data: Any = None) -> Term:
        key = op, tuple(a.at for a in args), data
        if key not in self.known:
            self.known[key] = len(self.code)
            self.code.append(key)
            own = frozenset({data}) if op == "column" else frozenset()
            self.uses.append(own.union(*(a.on for a in args)))
        return Term(self, self.known[key])

    def number(self, lo: float, hi: float | None = None) -> Term:
        """A constant, or an interval that holds it."""
        return self.put("number", data=(float(lo), float(lo if hi is None else hi)))

    def column(self, j: int) -> Term:
        return self.put("column", data=j)

    def run(self, columns: Sequence[Range | None], asked: Sequence[Term], slopes: frozenset[int] = frozenset()) -> Any:
        """Ranges of what is asked, and their slopes along some columns; those that are left out are 0."""
        values: dict[int, Range] = {}
        bent: dict[int, Slopes] = {}
        with np.errstate(all="ignore"):
            for at, over in self._plan(tuple(t.at for t in asked)):
                op, args, data = self.code[at]
                if op == "column":
                    found = columns[data]
                    assert found is not None, "what is asked needs this column"
                    values[at], bent[at] = found, {data: _ONE} if data in slopes else {}
                else:
                    x, own = [values[a] for a in args], [bent[a] for a in args]
                    values[at] = _value(op, x, data)
                    bent[at] = _bent(op, x, values[at], own, data) if any(own) else {}
                for old in over:
                    del values[old], bent[old]
        return [values[t.at] for t in asked], [bent[t.at] for t in asked]

    def _plan(self, asked: tuple[int, ...]) -> list[tuple[int, list[int]]]:
        """What has to be done, in order, and what nobody needs after each."""
        if asked not in self.plans:
            wanted, last = list(asked), dict[int, int]()
            while wanted:
                if (at := wanted.pop()) not in last:
                    last[at] = at
                    wanted += self.code[at][1]
            for at in sorted(last):
                last |= dict.fromkeys(self.code[at][1], at)
            over = dict[int, list[int]]()
            for at in sorted(set(last) - set(asked)):
                over.setdefault(last[at], []).append(at)
            self.plans[asked] = [(at, over.get(at, [])) for at in sorted(last)]
        return self.plans[asked]


def _value(op: str, x: Sequence[Range], data: Any) -> Range:
    if op == "number":
        return Range(np.float64(data[0]), np.float64(data[1])) if data[0] != data[1] else ar.point(data[0])
    if op == "power":
        return ar.whole_power(x[0], data)
    if op == "raise":
        return ar.exp(ar.multiply(x[1], ar.log(x[0])))
    return _BINARY[op](*x) if op in _BINARY else FUNCTIONS[op][0](*x)


def _bent(op: str, x: Sequence[Range], y: Range, own: Sequence[Slopes], data: Any) -> Slopes:
    """The chain rule."""
    if op in FUNCTIONS:
        return _scaled(own[0], FUNCTIONS[op][1](x[0], y))
    if op == "power":
        return _scaled(own[0], ar.multiply(ar.whole_power(x[0], data - 1), ar.point(data)))
    if op in ("+", "-"):
        return _summed(own[0], own[1] if op == "+" else {j: ar.negative(s) for j, s in own[1].items()})
    if op == "*":
        return _summed(_scaled(own[0], x[1]), _scaled(own[1], x[0]))
    if op == "/":
        return {j: ar.divide(s, x[1]) for j, s in _summed(own[0], _scaled(own[1], ar.negative(y))).items()}
    if op == "raise":
        inner = _summed(_scaled(own[1], ar.log(x[0])), {j: ar.divide(s, x[0]) for j, s in _scaled(own[0], x[1]).items()})
        return _scaled(inner, y)
    if op == "soft":
        # It moves with v or rests, and against v's sign with k.
        moved = Range(np.float64(0), np.float64(1)), Range(np.float64(-1), np.float64(1))
        return _summed(*(_scaled(s, m) for s, m in zip(own, moved, strict=True)))
    below, above = np.asarray(x[0].hi < x[1].lo), np.asarray(x[0].lo > x[1].hi)
    return _either(below, above, *own) if op == "min" else _either(above, below, *own)


def _scaled(slopes: Slopes, by: Range) -> Slopes:
    return {j: by if s is _ONE else ar.multiply(s, by) for j, s in slopes.items()}


def _summed(a: Slopes, b: Slopes) -> Slopes:
    return {j: ar.add(a[j], b[j]) if j in a and j in b else a.get(j) or b[j] for j in {**a, **b}}


def _either(first: Array, second: Array, a: Slopes, b: Slopes) -> Slopes:
    """The slope of the one that is taken for certain, or both."""
    out = {}
    for j in {**a, **b}:
        p, q = a.get(j, _ZERO), b.get(j, _ZERO)
        both = ar.hull(p, q)
        ends = (np.where(first, i, np.where(second, k, m)) for i, k, m in zip(p, q, both, strict=True))
        out[j] = Range(*ends)
    return out


_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\d\s.+-].*?|1\s*/.*?|(?<=\s)1)?\s*")
# Pint computes powers of numbers while it reads: only a name or a bracket may have an exponent, a short one.
_POWER = re.compile(r"(?<=[^\W\d_]|[)%°])\s*(?:\*\*|\^)\s*\(?-?\d{1,2}(?:[./]\d)?\)?(?!\s*(?:\*\*|[\^\w.]))")
_PLAIN = re.compile(r"(?:1(?=\s*/))?(?:[^\W\d_]|[%°/() .-]|\*(?!\*)){0,60}")


def quantity(value: Any) -> tuple[float, float]:
    """Floats around a stated value in SI units, such as `9.81 m/s^2`; ValueError where it is none."""
    if not isinstance(value, str):
        return float(value), float(value)
    match = _QUANTITY.fullmatch(value)
    if match is None or not math.isfinite(float(match[1])):
        raise ValueError(f"'{value[:60]}' is no finite quantity")
    number, factor = float(match[1]), _factor((match[2] or "").strip())
    if factor == 1.0:
        return number, number
    ends = float(ar.down(ar.down(number * factor))), float(ar.up(ar.up(number * factor)))
    # A factor such as one over a thousand may be applied as a division.
    return min(ends), max(ends)


def _factor(unit: str) -> float:
    """To the coherent SI unit."""
    if unit in ("", "1"):
        return 1.0
    if len(unit) > 80 or _PLAIN.fullmatch(_POWER.sub("", unit)) is None:
        raise ValueError(f"unit '{unit[:60]}' is not known")
    import pint

    registry: Any = pint.application_registry
    try:
        factor = float(registry.Quantity(1.0, registry.parse_units(unit)).to_base_units().magnitude)
    except Exception:  # pint raises whatever its tokenizer and its definitions raise
        raise ValueError(f"unit '{unit[:60]}' is not known") from None
    return 1.0 if math.isclose(factor, 1.0, rel_tol=1e-12) else factor


@final
class Reader:
    """Text → terms, over the names of a section."""

    def __init__(self, tape: Tape, names: Mapping[str, Term]) -> None:
        self.tape, self.names = tape, names

    def __call__(self, text: Any) -> Term:
        if not isinstance(text, str):
            return self.tape.number(float(text))
        if len(text) > 20_000:
            raise ValueError("an expression is too long")
        return self._read(ast.parse(re.sub(r"\s", " ", text).strip(), mode="eval").body)

    def _read(self, node: ast.expr) -> Term:
        if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
            value = float(node.value)
            exact = isinstance(node.value, float) or abs(node.value) <= 2**53
            return self.tape.number(value) if exact else self.tape.number(float(ar.down(value)), float(ar.up(value)))
        if isinstance(node, ast.Name):
            # What is computed takes the float next to π.
            return self.tape.number(math.pi, math.nextafter(math.pi, 4)) if node.id == "pi" else self.names[node.id]
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.UAdd | ast.USub):
            inner = self._read(node.operand)
            return -inner if isinstance(node.op, ast.USub) else inner
        if isinstance(node, ast.BinOp):
            if isinstance(node.op, ast.Pow):
                return self._power(node)
            return _OPERATORS[type(node.op)](self._read(node.left), self._read(node.right))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
            return self._called(node.func.id, [self._read(a) for a in node.args])
        raise ValueError(f"'{ast.unparse(node)[:60]}' is no expression")

    def _called(self, name: str, args: list[Term]) -> Term:
        if name in ("min", "max") and len(args) > 1:
            out = args[0]
            for other in args[1:]:
                out = self.tape.put(name, out, other)
            return out
        if name not in FUNCTIONS or len(args) != 1:
            raise ValueError(f"{name} of {len(args)} arguments is no function")
        return self.tape.put(name, *args)

    def _power(self, node: ast.BinOp) -> Term:
        base, value = self._read(node.left), _folded(node.right)
        if value is None or not (value == 0.5 or (value.is_integer() and abs(value) <= 1000)):
            return self.tape.put("raise", base, self._read(node.right))
        if value == 0.5:
            return self.tape.put("sqrt", base)
        whole = self.tape.put("power", base, data=int(abs(value))) if value else self.tape.number(1)
        return self.tape.number(1) / whole if value < 0 else whole


def _folded(node: ast.expr) -> float | None:
    """The value of an exponent that is numbers alone."""
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
        return float(node.value)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.UAdd | ast.USub):
        inner = _folded(node.operand)
        return inner if inner is None or isinstance(node.op, ast.UAdd) else -inner
    if isinstance(node, ast.BinOp) and type(node.op) in _FLOATS:
        a, b = _folded(node.left), _folded(node.right)
        return None if a is None or b is None else _FLOATS[type(node.op)](a, b)
    return None


_FLOATS: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: lambda a, b: a / b if b else math.nan,
}
_OPERATORS: dict[type[ast.operator], Callable[[Term, Term], Term]] = {
    ast.Add: Term.__add__,
    ast.Sub: Term.__sub__,
    ast.Mult: Term.__mul__,
    ast.Div: Term.__truediv__,
}


@final
@dataclass(frozen=True)
class Equations:
    """One period of a `model:` section: state k becomes terms[k], of the columns (x, u)."""

    states: tuple[str, ...]
    inputs: tuple[str, ...]
    angles: tuple[bool, ...]
    tape: Tape
    terms: tuple[Term, ...]

    @classmethod
    def of(cls, section: Mapping[str, Any], added: Sequence[str] = ()) -> Equations:
        """added: states that the section does not have, which stay as they are. NotText says why not; ValueError and its like
        come of what is no section.
        """
        if section.get("kind") != "equations":
            raise NotText(f"a model of kind {section.get('kind')}")
        if odd := [k for k in _BEYOND if section.get(k)]:
            raise NotText(f"a model with {' and '.join(odd)}")
        own, inputs = _named(section), tuple(section.get("inputs", {}))
        states, tape = (*own, *added), Tape()
        columns = {name: tape.column(j) for j, name in enumerate((*states, *inputs))}
        stated = {n: p["value"] if isinstance(p, Mapping) else p for n, p in section.get("parameters", {}).items()}
        names = columns | {n: tape.number(*quantity(v)) for n, v in stated.items()}
        made = _Step(section, tape, names, tuple(own)).after()
        angles = tuple(own.get(n) == "angle" for n in states)
        return cls(states, inputs, angles, tape, (*made, *(columns[n] for n in added)))

    @property
    def nx(self) -> int:
        return len(self.states)

    def moves(self, k: int) -> Term | None:
        """g where f_k = x_k + g, and g does not depend on x_k."""
        return _beside(self.terms[k], self.tape.column(k))

    def over(self, low: Array, high: Array, term: Term) -> Range:
        """A term over boxes (n, nz): its range, cut to what its slopes prove.

        Along columns in which it is monotone it is asked at the box's corner, along others in its middle, by the mean-value
        theorem: f(z) ∈ f(c) + Σ_j J_j (z_j − c_j). Where it may be undefined nothing is known.
        """
        parts = [self._over(low[a : a + CHUNK], high[a : a + CHUNK], term) for a in range(0, max(len(low), 1), CHUNK)]
        return Range(*(np.concatenate(ends) for ends in zip(*parts, strict=True)))

    def slopes(self, low: Array, high: Array, term: Term) -> Range:
        """∂/∂z of a term over boxes (n, nz), each end (n, nz)."""
        out, every = np.zeros((2, *low.shape)), frozenset(range(low.shape[1]))
        for a in range(0, len(low), CHUNK):
            rows = slice(a, a + CHUNK)
            _, (found,) = self.tape.run(_columns(low[rows], high[rows]), [term], every)
            for j, s in found.items():
                own = ar.known(s)
                out[0, rows, j], out[1, rows, j] = own.lo, own.hi
        return Range(out[0], out[1])

    def _over(self, low: Array, high: Array, term: Term) -> Range:
        n = len(low)
        wide = frozenset(j for j in term.on if (low[:, j] < high[:, j]).any())
        (natural,), (slopes,) = self.tape.run(_columns(low, high), [term], wide)
        natural = _filled(natural, n)
        if not wide:
            return ar.known(natural)
        first, last, spread = (low / 2 + high / 2, low / 2 + high / 2, np.zeros(n))
        for j, s in slopes.items():
            s = ar.known(_filled(s, n))
            a, b, middle = low[:, j], high[:, j], first[:, j].copy()
            rises, falls = s.lo >= 0, s.hi <= 0
            first[:, j] = np.where(rises, a, np.where(falls, b, middle))
            last[:, j] = np.where(rises, b, np.where(falls, a, middle))
            reach = ar.up(np.maximum(b - middle, middle - a))
            with np.errstate(invalid="ignore", over="ignore"):
                spread = np.where(rises | falls, spread, ar.up(spread + ar.up(s.mag * reach)))
        ends = [self.tape.run(_columns(p, p), [term])[0][0] for p in (first, last)]
        with np.errstate(invalid="ignore"):
            cut = ar.common(natural, _filled(Range(ar.down(ends[0].lo - spread), ar.up(ends[1].hi + spread)), n))
        undefined = np.isnan(natural.lo) | np.isnan(natural.hi)
        return ar.known(Range(np.where(undefined, np.nan, cut.lo), np.where(undefined, np.nan, cut.hi)))


def _columns(low: Array, high: Array) -> list[Range | None]:
    if low is high:
        return [Range(c, c) for c in np.ascontiguousarray(low.T)]
    return [Range(a, b) for a, b in zip(np.ascontiguousarray(low.T), np.ascontiguousarray(high.T), strict=True)]


def _filled(x: Range, n: int) -> Range:
    return Range(np.broadcast_to(x.lo, (n,)), np.broadcast_to(x.hi, (n,)))


def _beside(term: Term, own: Term) -> Term | None:
    """What is added to `own`, of which nothing else depends on it."""
    if term == own:
        return term.tape.number(0)
    op, args, _ = term.tape.code[term.at]
    if op not in ("+", "-"):
        return None
    a, b = (Term(term.tape, i) for i in args)
    alone = next(iter(own.on))
    if alone in a.on and alone not in b.on and (rest := _beside(a, own)) is not None:
        return rest + b if op == "+" else rest - b
    if op == "+" and alone in b.on and alone not in a.on and (rest := _beside(b, own)) is not None:
        return rest + a
    return None


_BEYOND = ("bodies", "payload", "tilt", "soft_friction", "memory", "input_delay", "friction_after_damping")
"""Sections of a model whose step is not written out here."""


def _named(section: Mapping[str, Any]) -> dict[str, str]:
    """States → kind: those declared, or coordinates and their velocities."""
    declared = section.get("coordinates") or section.get("states") or {}
    kinds = {n: a.get("kind", "real") if isinstance(a, Mapping) else "real" for n, a in declared.items()}
    return kinds if not section.get("coordinates") else kinds | {f"{n}_dot": "real" for n in kinds}


@final
@dataclass(frozen=True)
class _Step:
    """The integrator, written out over terms. Rows are the states with a law of their own; positions integrate another."""

    section: Mapping[str, Any]
    tape: Tape
    names: dict[str, Term]
    states: tuple[str, ...]

    def after(self) -> list[Term]:
        s = self.section
        if s.get("next") is not None:
            return [self._read(self._columns(), s["next"][n]) for n in self.states]
        scheme, count = s.get("integrator") or "rk4", int(s.get("substeps", 1))
        if not 1 <= count <= 10_000 or scheme not in ("euler", "semi_implicit", "rk4"):
            raise ValueError(f"{count} sub-steps of {scheme} are none")
        if scheme == "rk4" and (s.get("dry_friction") or s.get("implicit")):
            raise NotText("dry friction or implicit damping under rk4")
        h = self.tape.number(*_time(s["period"])) / self.tape.number(count)
        x = self._columns()
        for _ in range(count):
            x = self._rk4(x, h) if scheme == "rk4" else self._euler(x, h, semi=scheme == "semi_implicit")
            if len(self.tape.code) > 100_000:
                raise NotText(f"a model with {count} sub-steps of such equations")
        return x

    def _columns(self) -> list[Term]:
        return [self.names[n] for n in self.states]

    def _read(self, x: Sequence[Term], text: Any) -> Term:
        return Reader(self.tape, {**self.names, **dict(zip(self.states, x, strict=True)), **self._substep()})(text)

    def _substep(self) -> dict[str, Term]:
        """`h`, where no name of the model is taken for it."""
        if self.section.get("next") is not None or "h" in self.names:
            return {}
        return {"h": self.tape.number(*_time(self.section["period"])) / self.tape.number(int(self.section.get("substeps", 1)))}

    @property
    def _mechanical(self) -> bool:
        return self.section.get("derivative") is None

    @property
    def _positions(self) -> dict[int, int]:
        """Row → the one that it integrates."""
        if self._mechanical:
            n = len(self.states) // 2
            return {i: n + i for i in range(n)}
        texts = {n: str(t).strip() for n, t in self.section["derivative"].items()}
        source = {n: t for n, t in texts.items() if t in texts}

        def grounded(name: str) -> bool:
            seen = set[str]()
            while name in source and name not in seen:
                seen.add(name)
                name = source[name]
            return name not in source

        return {self.states.index(n): self.states.index(t) for n, t in source.items() if grounded(n)}

    @property
    def _rows(self) -> list[int]:
        return [i for i in range(len(self.states)) if i not in self._positions]

    def _rates(self, x: Sequence[Term]) -> tuple[list[list[Term]] | None, list[Term]]:
        """(M, right-hand sides) of the rows; M None is the identity."""
        s = self.section
        if not self._mechanical:
            return None, [self._read(x, s["derivative"][self.states[i]]) for i in self._rows]
        names, matrix = list(s["coordinates"]), s["mass_matrix"]
        force, bias = ([self._read(x, (s.get(k) or {}).get(q, "0")) for q in names] for k in ("forces", "bias"))
        mass = [[self._read(x, e) for e in row] for row in matrix]
        return mass, [f - b for f, b in zip(force, bias, strict=True)]

    def _euler(self, x: list[Term], h: Term, semi: bool) -> list[Term]:
        mass, right = self._rates(x)
        names, rows = [self.states[i] for i in self._rows], self._rows
        sites = list(self.section["coordinates"]) if self._mechanical else names
        implicit = self.section.get("implicit") or {}
        if mass is not None and implicit:
            for i, q in enumerate(sites):
                mass[i][i] = mass[i][i] + h * self._read(x, implicit.get(q, "0"))
        rates = _solved(mass, right)
        new = {i: x[i] + h * r for i, r in zip(rows, rates, strict=True)}
        for k, q in enumerate(sites):
            if (bound := (self.section.get("dry_friction") or {}).get(q)) is not None:
                if mass is not None and any(
                    not e.is_number(0) for i, row in enumerate(mass) for e in (*row[:i], *row[i + 1 :])
                ):
                    raise NotText("dry friction at coordinates that the mass matrix couples")
                limit = self.tape.put("max", self._read(x, bound), self.tape.number(0))
                push = h * limit if mass is None else h * limit / mass[k][k]
                new[rows[k]] = self.tape.put("soft", new[rows[k]], push)
        speeds, done, waiting = dict(enumerate(x)) if not semi else new, dict(new), dict(self._positions)
        while waiting:
            for i in [i for i, source in waiting.items() if source in speeds]:
                done[i] = x[i] + h * speeds[waiting.pop(i)]
                speeds = done if semi else speeds
        return [done[i] for i in range(len(x))]

    def _rk4(self, x: list[Term], h: Term) -> list[Term]:
        half, sixth, two = h * self.tape.number(0.5), h / self.tape.number(6), self.tape.number(2)

        def rates(at: list[Term]) -> list[Term]:
            made = dict(zip(self._rows, _solved(*self._rates(at)), strict=True))
            made |= {i: at[source] for i, source in self._positions.items()}
            return [made[i] for i in range(len(at))]

        def moved(k: list[Term], by: Term) -> list[Term]:
            return [a + by * b for a, b in zip(x, k, strict=True)]

        k1 = rates(x)
        k2 = rates(moved(k1, half))
        k3 = rates(moved(k2, half))
        k4 = rates(moved(k3, h))
        return [a + sixth * (p + two * (q + r) + s) for a, p, q, r, s in zip(x, k1, k2, k3, k4, strict=True)]


def _time(value: Any) -> tuple[float, float]:
    """A period in s. Milliseconds may be divided or multiplied: both are inside."""
    low, high = quantity(value)
    if not 0 < low <= high:
        raise ValueError(f"period {value} is no positive time")
    return low, high


def _solved(mass: list[list[Term]] | None, right: list[Term]) -> list[Term]:
    """M⁻¹ r by elimination without pivoting: M is positive definite."""
    if mass is None:
        return right
    m, r, n = [list(row) for row in mass], list(right), len(right)
    for k in range(n):
        for i in range(k + 1, n):
            if m[i][k].is_number(0):
                continue
            factor = m[i][k] / m[k][k]
            m[i] = [*m[i][: k + 1], *(a - factor * b for a, b in zip(m[i][k + 1 :], m[k][k + 1 :], strict=True))]
            r[i] = r[i] - factor * r[k]
    for i in reversed(range(n)):
        for j in range(i + 1, n):
            r[i] = r[i] - m[i][j] * r[j]
        r[i] = r[i] / m[i][i]
    return r
