"""One step of a model as a flat program over registers: what depends on parameters alone apart, equal values computed once."""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert_equations.mechanics.dynamics import Dynamics

from .arithmetic import ARRAY, power
from .tape import Table

# muladd a·b + c, mulsub a·b − c, submul c − a·b; sincos, sweep and turn write several registers.
ARITHMETIC = ("add", "sub", "mul", "div", "neg", "copy", "muladd", "mulsub", "submul")
CHOICES = ("min", "max", "abs", "sign", "round", "soft", "stop", "pick")
FUNCTIONS = ("sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "atan", "asin", "acos", "power", "sincos")
CODES = {name: i for i, name in enumerate((*ARITHMETIC, *CHOICES, *FUNCTIONS, "sweep", "turn"))}
PROLOGUE, PERIOD, SUBSTEP = range(3)
WIDTH = 6  # of an instruction
_NONE = (0, 0, 0, 0)

Codes = npt.NDArray[np.int64]


@final
@dataclass(frozen=True)
class Program:
    """Instructions (operation, target, up to four operands) of three parts: per rollout, per period and per sub-step.

    Registers: `constants` with their values, `parameters`, `inputs`, `states`; `new[i]` is copied to `states[i]` after every
    sub-step. `extra` holds the operand lists of operations with many. recall: the same for what is remembered alone; states
    that it does not rest on, not even through others, stay where they are.
    """

    code: tuple[Codes, Codes, Codes]
    extra: Codes
    size: int
    constants: Codes
    values: npt.NDArray[np.float64]
    parameters: Codes
    inputs: Codes
    states: Codes
    new: Codes
    recall: Program | None = None

    @cached_property
    def held(self) -> frozenset[int]:
        """The operations that occur."""
        return frozenset(int(op) for part in self.code for op in part[:, 0])


def _operators(name: str) -> tuple[Callable[[Symbol, Any], Symbol], Callable[[Symbol, Any], Symbol]]:
    """What Python asks of the left and of the right operand: both are recorded as the same operation."""
    return lambda self, other: self.graph.put(name, self, other), lambda self, other: self.graph.put(name, other, self)


@final
class Symbol:
    """A value of the program that is being recorded."""

    __array_ufunc__ = None
    __slots__ = ("graph", "index")

    def __init__(self, graph: Graph, index: int) -> None:
        self.graph, self.index = graph, index

    __add__, __radd__ = _operators("add")
    __sub__, __rsub__ = _operators("sub")
    __mul__, __rmul__ = _operators("mul")
    __truediv__, __rtruediv__ = _operators("div")

    def __neg__(self) -> Symbol:
        return self.graph.put("neg", self)

    def __abs__(self) -> Symbol:
        return self.graph.put("abs", self)


@final
class Graph:
    """Value numbering: nodes (operation, operands), each with the part of the program in which it can be computed first."""

    def __init__(self) -> None:
        self.nodes: list[tuple[str, tuple[int, ...]]] = []
        self.part: list[int] = []
        self.symbols: list[Symbol] = []
        self.known: dict[Any, Symbol] = {}
        self.constant: dict[int, float] = {}

    def leaf(self, name: str, part: int) -> Symbol:
        return self._append(("leaf", name), "leaf", (), part)

    def number(self, value: Any) -> Symbol:
        value = float(value)
        symbol = self._append(("number", value.hex()), "number", (), PROLOGUE)
        self.constant[symbol.index] = value
        return symbol

    def put(self, name: str, *operands: Any) -> Symbol:
        indices = tuple([o.index if isinstance(o, Symbol) else self.number(o).index for o in operands])
        simple = name == "div" or not self.constant.keys().isdisjoint(indices)
        if simple and (same := self._simpler(name, indices)) is not None:
            return same
        if (name == "mul" or name == "add") and indices[1] < indices[0]:
            indices = indices[::-1]
        known = self.known.get((name, indices))
        return self._append((name, indices), name, indices, max([self.part[i] for i in indices])) if known is None else known

    def several(self, name: str, operands: Sequence[Any], count: int) -> list[Symbol]:
        """An operation that yields `count` values."""
        indices = tuple([o.index if isinstance(o, Symbol) else self.number(o).index for o in operands])
        part = max([self.part[i] for i in indices])
        whole = self._append((name, indices), name, indices, part).index
        return [self._append(("take", whole, k), "take", (whole,), part) for k in range(count)]

    def close(self) -> None:
        """Lets go of the symbols, which know the graph: these cycles would wait for the garbage collector."""
        self.known.clear()
        self.symbols.clear()

    def reachable(self, indices: Sequence[int]) -> set[int]:
        """All that these are computed from."""
        live, open_ = set(), list(indices)
        while open_:
            i = open_.pop()
            if i not in live:
                live.add(i)
                open_ += self.nodes[i][1]
        return live

    def _simpler(self, name: str, indices: tuple[int, ...]) -> Symbol | None:
        """The same value with fewer or cheaper operations; divisions by what does not vary become products."""
        given = [self.constant.get(i) for i in indices]
        if None not in given:
            return self.number(ARRAY[name](*map(np.float64, given)))
        left, right, a, b = given[0], given[-1], self.symbols[indices[0]], self.symbols[indices[-1]]
        if name == "mul" and 1.0 in (left, right):
            return b if left == 1.0 else a
        if name == "add" and 0.0 in (left, right):
            return b if left == 0.0 else a
        if (name, right) in (("sub", 0.0), ("div", 1.0)):
            return a
        if name == "div" and left != 1.0 and self.part[b.index] < self.part[a.index]:
            return a * (1.0 / b)
        return None

    def _append(self, key: Any, name: str, operands: tuple[int, ...], part: int) -> Symbol:
        known = self.known.get(key)
        if known is None:
            self.known[key] = known = Symbol(self, len(self.nodes))
            self.symbols.append(known)
            self.nodes.append((name, operands))
            self.part.append(part)
        return known


def table(graph: Graph) -> Table:
    """Operations that are recorded instead of carried out."""

    def sweep(
        free: list[Any], v: list[Any], limits: list[Any], start: list[Any], inverse: list[list[Any]], h: Any, turning: bool
    ) -> list[Symbol]:
        flat = [*free, *v, *limits, *start, *(e for row in inverse for e in row), h]
        return graph.several("turn" if turning else "sweep", flat, len(free))

    recorded: Table = {name: partial(graph.put, name) for name in CODES}
    return recorded | {"number": lambda p, q: graph.number(np.float64(p) / q), "pow": power, "sweep": sweep}


@final
class Assembler:
    """Nodes → instructions: dead ones left out, products fused into sums, registers used again."""

    def __init__(self, graph: Graph, results: Sequence[Symbol]) -> None:
        self.graph, self.results = graph, [r.index for r in results]
        self.live = graph.reachable(self.results)
        self.uses = self._counted()
        self.fused = self._products()
        self.pairs = self._pairs()
        order = sorted(self.live - self.fused)
        self.order = [i for part in (PROLOGUE, PERIOD, SUBSTEP) for i in order if graph.part[i] == part]
        self.instruction = {i: self._drawn(i) for i in self.order}
        self.code: tuple[list[list[int]], ...] = ([], [], [])
        self.extra: list[int] = []
        self.register: dict[int, int] = {}
        self.free: list[int] = []
        self.size = 0

    def program(self, parameters: Sequence[Symbol], inputs: Sequence[Symbol], states: Sequence[Symbol]) -> Program:
        constants = sorted(i for i in self.live if i in self.graph.constant)
        leaves = [*constants, *(s.index for group in (parameters, inputs, states) for s in group)]
        for i in leaves:
            self.register[i] = self._new()
        self._emit_all(set(leaves))
        new = self._new_states([s.index for s in states])

        def registers(indices: Sequence[int]) -> Codes:
            return np.array([self.register[i] for i in indices], dtype=np.int64)

        prologue, period, substep = (np.array(c, dtype=np.int64).reshape(-1, WIDTH) for c in self.code)
        return Program(
            (prologue, period, substep),
            np.array(self.extra, dtype=np.int64),
            self.size,
            registers(constants),
            np.array([self.graph.constant[i] for i in constants], dtype=np.float64),
            registers([s.index for s in parameters]),
            registers([s.index for s in inputs]),
            registers([s.index for s in states]),
            np.array(new, dtype=np.int64),
        )

    def _counted(self) -> dict[int, int]:
        uses = dict.fromkeys(self.live, 0)
        for i in self.live:
            for j in self.graph.nodes[i][1]:
                uses[j] += 1
        for i in self.results:
            uses[i] += 1
        return uses

    def _products(self) -> set[int]:
        """Products that one sum alone uses, in the same part."""
        fused = set()
        for i in sorted(self.live):
            name, operands = self.graph.nodes[i]
            if name in ("add", "sub") and operands[0] != operands[1]:
                for j in operands:
                    if self.graph.nodes[j][0] == "mul" and self.uses[j] == 1 and self.graph.part[j] == self.graph.part[i]:
                        fused.add(j)
                        break
        return fused

    def _pairs(self) -> dict[int, int]:
        """sin x → cos x and back, where both are needed."""
        known = self.graph.known
        sines = [i for i in self.live if self.graph.nodes[i][0] == "sin"]
        both = [(i, known.get(("cos", self.graph.nodes[i][1]))) for i in sines]
        pairs = {i: cosine.index for i, cosine in both if cosine is not None and cosine.index in self.live}
        return pairs | {j: i for i, j in pairs.items()}

    def _drawn(self, i: int) -> tuple[str, tuple[int, ...]]:
        """The instruction of a node, with a product drawn into it."""
        name, operands = self.graph.nodes[i]
        if name not in ("add", "sub"):
            return name, operands
        for k, j in enumerate(operands):
            if j in self.fused:
                fused = "muladd" if name == "add" else ("mulsub", "submul")[k]
                return fused, (*self.graph.nodes[j][1], operands[1 - k])
        return name, operands

    def _last_uses(self) -> dict[int, float]:
        """The place after which a register is free; what a later part needs stays for good."""
        last: dict[int, float] = dict.fromkeys(self.results, np.inf)
        part = self.graph.part
        for place, i in enumerate(self.order):
            for j in self.instruction[i][1]:
                if part[i] > part[j]:
                    last[j] = np.inf
                elif last.get(j, 0) <= place:
                    last[j] = place
        for i in self.order:
            if self.graph.nodes[i][0] == "take":  # written together with the first of its siblings
                last[i] = max(last.get(i, 0), last[self.graph.nodes[i][1][0]])
        return last

    def _emit_all(self, leaves: set[int]) -> None:
        last = self._last_uses()
        ends: dict[float, list[int]] = {}
        for i, end in last.items():
            if end != np.inf and i not in leaves and self.graph.nodes[i][0] not in ("sweep", "turn"):
                ends.setdefault(end, []).append(i)
        for place, i in enumerate(self.order):
            if i not in self.register:
                self._emit(i)
            if place in ends:
                self.free += [self.register[j] for j in ends[place]]

    def _emit(self, i: int) -> None:
        name, operands = self.instruction[i]
        code = self.code[self.graph.part[i]]
        if name in ("sweep", "turn"):
            targets = [self.graph.known[("take", i, k)].index for k in range(_rows(len(operands)))]
            for t in targets:
                self.register[t] = self._new()
            where = len(self.extra)
            self.extra += [self.register[j] for j in (*operands, *targets)]
            code.append([CODES[name], self.register[targets[0]], where, len(targets), 0, 0])
            return
        register = self.register
        sources = [register[j] for j in operands]
        register[i] = self._new()
        if i in self.pairs:
            other = self.pairs[i]
            self.register[other] = self._new()
            sine, cosine = (i, other) if name == "sin" else (other, i)
            code.append([CODES["sincos"], self.register[sine], self.register[cosine], sources[0], 0, 0])
            return
        code.append([CODES[name], register[i], *sources, *_NONE[len(sources) :]])

    def _new_states(self, states: list[int]) -> list[int]:
        """Registers of the results; one that is another state is saved first, since states are written one after another."""
        new = []
        for own, i in zip(states, self.results, strict=True):
            if i in states and i != own:
                register = self._new()
                self.code[SUBSTEP].append([CODES["copy"], register, self.register[i], 0, 0, 0])
            else:
                register = self.register[i]
            new.append(register)
        return new

    def _new(self) -> int:
        if self.free:
            return self.free.pop()
        self.size += 1
        return self.size - 1


def _rows(operands: int) -> int:
    """m of m free and m present velocities, m limits, m first guesses, m² inverse masses and the sub-step."""
    return math.isqrt(operands + 3) - 2


def trace(dynamics: Dynamics, parameters: int, states: int, inputs: int, memories: int) -> Program:
    """One sub-step; the states of the program are the model's and its memories."""
    # Ten thousands of small objects live as long as the trace: enough for the collector to go through all that is loaded.
    collecting = gc.isenabled()
    gc.disable()
    try:
        return _traced(Graph(), dynamics, parameters, states, inputs, memories)
    finally:
        if collecting:
            gc.enable()


def _traced(graph: Graph, dynamics: Dynamics, parameters: int, states: int, inputs: int, memories: int) -> Program:
    operations = table(graph)
    p = [graph.leaf(f"p{i}", PROLOGUE) for i in range(parameters)]
    u = [graph.leaf(f"u{i}", PERIOD) for i in range(inputs)]
    x = [graph.leaf(f"x{i}", SUBSTEP) for i in range(states)]
    z = [graph.leaf(f"z{i}", SUBSTEP) for i in range(memories)]
    once = dynamics.once
    with np.errstate(all="ignore"):
        new, kept = once.step(operations, once.prepare(operations, p), x, u, z)
    results = [r if isinstance(r, Symbol) else graph.number(r) for r in (*new, *kept)]
    program = Assembler(graph, results).program(p, u, [*x, *z])
    if z:
        alone = _recalling(graph, results, [*x, *z], states)
        program = replace(program, recall=Assembler(graph, alone).program(p, u, [*x, *z]))
    graph.close()
    return program


def _recalling(graph: Graph, results: list[Symbol], leaves: list[Symbol], states: int) -> list[Symbol]:
    """Results, with states that those behind the first `states` do not rest on unmoved."""
    seen, known = set(range(states, len(leaves))), -1
    while len(seen) > known:
        known, live = len(seen), graph.reachable([results[i].index for i in seen])
        seen |= {i for i, leaf in enumerate(leaves) if leaf.index in live}
    return [r if i in seen else leaf for i, (r, leaf) in enumerate(zip(results, leaves, strict=True))]
