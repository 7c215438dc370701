"""A grid controller with a finite memory: the state of the automaton that reads which regions have been visited."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import ANYWHERE, Array, Automaton, Bools, Box, Controller, Goal, Ints, Outside, Policy, UsageError

from .files import loaded, write_saved
from .grid_controller import GridController
from .outside import inside_alone, refusal


@final
@dataclass(frozen=True, eq=False)
class AutomatonController(Controller):
    """For a goal with an automaton: one GridController per state of it, all over the same cells and inputs.

    must, may (cells,): the regions that a cell lies wholly inside, and those that it may touch, as letters. The values of a
    part are the steps until the automaton accepts: its memory then is an accepting state, where values are 0.
    """

    goal: Goal
    parts: tuple[GridController, ...]
    must: Ints
    may: Ints
    evidence: Mapping[str, Any]
    kind: str = "symbolic"

    @property
    def automaton(self) -> Automaton:
        assert self.goal.automaton is not None, "only a goal with an automaton needs this controller"
        return self.goal.automaton

    @property
    def held(self) -> Box | None:
        """Where only some states have cells, the box that the others must be in."""
        return self.parts[0].held

    @property
    def policies(self) -> tuple[Policy, ...]:
        """All but `adversarial`: how high a cell is depends on the memory that comes with it."""
        return (*ANYWHERE, "least-effort")

    def kept(self, x: Array, u: Array, after: Array, memory: Ints | None = None) -> Bools:
        """(n,): the promise holds with the memory that `after` brings, in a cell that was promised, and before acceptance
        with fewer steps to go; or it has ended well.
        """
        then = self.advance(after, memory := self.start(x) if memory is None else memory)
        cell, left = self.parts[0].cells(x), self._value(after, then)
        value = self._value(x, memory)
        good = (left >= 0) & ((value == 0) | (left < value)) & self.parts[0].promising(cell, u, after)
        return np.asarray((good & (value >= 0)) | self.over(after, then))

    def _value(self, x: Array, memory: Ints) -> Ints:
        """(n,): the value of the part that the memory names, −1 outside."""
        cell = self.parts[0].cells(x)
        values = np.stack([part.values[cell] for part in self.parts])[np.maximum(memory, 0), np.arange(len(cell))]
        return np.where((memory >= 0) & (cell >= 0), values, -1)

    def value(self, x: Array) -> Ints:
        """(n,): the steps until the automaton accepts, at most, of runs that begin at x; −1 outside the domain."""
        return self._value(x, self.start(x))

    def left(self, x: Array, memory: Ints) -> Ints | None:
        return self._value(x, memory)

    def tube(self, x: Array, u: Array, memory: Ints | None = None) -> Array | None:
        """As `GridController.tube`; a memory leads to the same cells whatever it is."""
        return self.parts[0].tube(x, u)

    def start(self, x: Array) -> Ints:
        return self.advance(x, np.full(len(x), self.automaton.start))

    def advance(self, x: Array, memory: Ints) -> Ints:
        """The automaton's state once it has read the regions of x; −1 where nothing more can be accepted."""
        x = np.atleast_2d(np.asarray(x, dtype=np.float64))
        cell, letter = self.parts[0].cells(x), self.goal.letter(x)
        # What was proved of the whole cell counts, should a point on a border be told otherwise by rounding.
        sure = (letter | self.must[cell]) & self.may[cell]
        return self.automaton.advance(memory, np.where(cell >= 0, sure, letter))

    def keeps(self, x: Array, memory: Ints) -> Bools:
        return np.asarray(self._value(x, memory) >= 0)

    def contains(self, x: Array) -> Bools:
        x = np.atleast_2d(np.asarray(x, dtype=np.float64))
        return self.keeps(x, self.start(x))

    def over(self, x: Array, memory: Ints) -> Bools:
        return np.asarray((memory >= 0) & self.automaton.done[memory]) & self.goal.holds(x)

    def counted(self, x: Array, memory: Ints) -> Bools:
        return np.asarray((memory >= 0) & np.array(self.automaton.accepting)[memory]) & self.goal.holds(x)

    def respond(self, x: Array, memory: Ints, policy: Policy, seed: int = 0, k: int = 0) -> Array:
        x = np.atleast_2d(np.asarray(x, dtype=np.float64))
        if (lost := np.flatnonzero(~self.keeps(x, memory))).size:
            told = f"its memory is {int(memory[lost[0]])}"
            raise refusal(self, x, int(lost[0]), told, "`keeps` before `respond`")
        out = np.empty((len(x), self.parts[0].points.shape[1]))
        for q in np.unique(memory):
            rows = memory == q
            # Every part answers for all rows, so that a random choice stays that of the row.
            whole = np.where(rows, np.arange(len(x)), int(np.argmax(rows)))
            out[rows] = self.parts[q].act(x[whole], policy, seed, k)[rows]
        return out

    def act(self, x: Array, policy: Policy, seed: int = 0, k: int = 0, *, outside: Outside = "raise") -> Array:
        """The inputs of runs that begin at x; later ones have a memory, and ask `respond`."""
        if outside == "nan":
            return inside_alone(self, self.parts[0].points.shape[1], x, policy, seed, k)
        x = np.atleast_2d(np.asarray(x, dtype=np.float64))
        return self.respond(x, self.start(x), policy, seed, k)

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """From all cells that win with some memory, those states that win with the one they begin with."""
        best = np.max([part.values for part in self.parts], axis=0)
        x = replace(self.parts[0], values=best).draw(n, rng)
        return x[self.contains(x)]

    def digest(self) -> str:
        """SHA-256 of everything that determines the inputs."""
        out = hashlib.sha256("".join(part.digest() for part in self.parts).encode())
        out.update(np.ascontiguousarray(self.must).tobytes() + np.ascontiguousarray(self.may).tobytes())
        return out.hexdigest()

    def save(self, folder: Path | str) -> None:
        """Write `controller.npz` and `controller.json` into `folder`; `load` needs nothing but this module."""
        stacks = {name: np.stack([getattr(part, name) for part in self.parts]) for name in ("bits", "values")}
        own = {"kind": self.kind, "evidence": dict(self.evidence), "digest": self.digest()}
        write_saved(folder, self.parts[0].told() | own, self.parts[0].arrays() | stacks | {"must": self.must, "may": self.may})

    @classmethod
    def load(cls, folder: Path | str) -> AutomatonController:
        """Inverse of `save`; UsageError where the files are absent, damaged or do not belong together."""

        def made(data: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> AutomatonController:
            whole = GridController.read(data, arrays)
            if whole.goal.automaton is None:
                raise UsageError(f"{folder}: the saved controller has no memory; load it with GridController.load")
            each = zip(arrays["bits"], arrays["values"], strict=True)
            parts = tuple(replace(whole, bits=bits, values=values, evidence={}) for bits, values in each)
            return cls(whole.goal, parts, arrays["must"], arrays["may"], data["evidence"], data["kind"])

        return loaded(folder, made)
