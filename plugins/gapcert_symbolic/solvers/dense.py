"""The fixpoints on JAX: every round looks at all cells and inputs at once. On a GPU that pays where cells are many, rounds few.

A window holds no lost cell iff their number in it is 0, and that is a signed sum of 2ⁿ entries of a table of prefix sums
(summed-area table). Sums are modulo 2³², which tells 0 apart in windows of fewer than 2³² cells. On an axis that wraps, the
table goes around twice. Values and inputs are those of the compiled solvers.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gapcert.plugin import Bools
from gapcert_symbolic.cells.abstraction import Windows

from .problem import Play, Problem, Solution


def solve(problem: Problem) -> Solution:
    """Either game."""
    windows, safe, target = problem.windows(), problem.safe, problem.target
    return _invariance(windows, safe) if target is None else _reach_avoid(windows, safe, target)


def _invariance(windows: Windows, safe: Bools) -> Solution:
    game = _Game(windows)
    alive, rounds = game.cells(safe), 0
    while True:
        rounds += 1
        kept, inputs, some = game.kept(alive)
        if not bool(some):
            break
        alive = kept
    return Solution(np.where(game.flat(alive), 0, -1).astype(np.int32), game.bits(inputs), rounds)


def _reach_avoid(windows: Windows, safe: Bools, target: Bools) -> Solution:
    game = _Game(windows)
    won, inputs = game.cells(target & safe), game.offered(target & safe)
    left, values, level = game.cells(safe & ~target), game.cells(np.where(target & safe, 0, -1).astype(np.int32)), 0
    while True:
        won, left, values, inputs, some = game.grown(won, left, values, inputs, level + 1)
        if not bool(some):
            break
        level += 1
    return Solution(game.flat(values), game.bits(inputs), level)


class Positions:
    """As `games.Watched`: in every round the cells of each state of the automaton that can be entered in more cells now."""

    def __init__(self, play: Play) -> None:
        self.play, self.game = play, _Game(play.windows)
        self.values: Any = None
        self.bits: Any = None

    def least(self, assumed: Bools) -> int:
        play, game, automaton = self.play, self.game, self.play.automaton
        states, safe, none = range(len(play.leads)), play.safe, np.zeros_like(play.safe)
        never, wins = (game.cells(np.where(on, 0, -2).astype(np.int32)) for on in (none, safe))
        open_, values, inputs = game.cells(np.where(safe, -1, -2).astype(np.int32)), {}, {}
        for q in states:
            values[q], inputs[q] = open_, game.offered(none)
            if automaton.done[q]:
                values[q], inputs[q] = wins, game.offered(safe)
            elif automaton.accepting[q]:
                again, asked = game.cells(play.entered(q, assumed)), game.cells(safe & assumed[q])
                _, _, values[q], inputs[q], _ = game.grown(again, asked, never, inputs[q], 0)
        active = [q for q in states if not automaton.accepting[q]]
        left, known, level, more = {q: game.cells(safe) for q in active}, dict[int, Any](), 0, True
        while more:
            more, won = False, [game.flat(values[q] >= 0) for q in states]
            for q in active:
                good = play.entered(q, won)
                if q not in known or (good != known[q]).any():
                    known[q] = good
                    _, left[q], values[q], inputs[q], some = game.grown(
                        game.cells(good), left[q], values[q], inputs[q], level + 1
                    )
                    more |= bool(some)
            level += more
        self.values = np.maximum(np.stack([game.flat(values[q]) for q in states]), -1)
        self.bits = np.stack([game.bits(inputs[q]) for q in states])
        return level


class _Game:
    """Windows on the device. Cells are arrays of the shape `counts`; inputs have one more axis before: eight to a byte."""

    def __init__(self, windows: Windows) -> None:
        grid, m = windows.grid, windows.inputs
        self.windows, self.bytes = windows, (m + 7) // 8
        shapes = [tuple(grid.counts[d] if d in axis.on else 1 for d in range(len(grid.counts))) for axis in windows.axes]
        # The last byte is filled up with the last input, and what is told of the filling is left out.
        column = np.stack([np.pad(axis.column, (0, -m % 8), mode="edge") for axis in windows.axes])
        tables = [
            [jnp.asarray(np.ascontiguousarray(end.T).reshape(end.shape[1], *shape)) for end in (axis.first, axis.last)]
            for axis, shape in zip(windows.axes, shapes, strict=True)
        ]
        self.allowed = self._shaped(windows.every)
        kept, grown = _compiled(grid.counts, grid.wraps, tuple(axis.moves for axis in windows.axes))
        columns = jnp.asarray(column.reshape(len(shapes), self.bytes, 8).astype(np.int32))
        given = {"column": columns, "tables": tables, "allowed": self.allowed}
        self.kept, self.grown = functools.partial(kept, **given), functools.partial(grown, **given)

    def _shaped(self, packed: Any) -> Any:
        """(…, bytes) → (bytes, *counts), or (bytes, 1, …) where all cells have the same."""
        counts = self.windows.grid.counts
        return jnp.asarray(packed.T.reshape(self.bytes, *(counts if len(packed) > 1 else [1] * len(counts))))

    def cells(self, marked: Any) -> Any:
        return jnp.asarray(marked.reshape(self.windows.grid.counts))

    def flat(self, cells: Any) -> Any:
        return np.asarray(cells).ravel()

    def bits(self, inputs: Any) -> Any:
        return np.ascontiguousarray(np.asarray(inputs).reshape(self.bytes, -1).T)

    def offered(self, marked: Bools) -> Any:
        """All inputs that are allowed, in marked cells."""
        return jnp.where(self.cells(marked), self.allowed, jnp.uint8(0))


@functools.cache
def _compiled(counts: tuple[int, ...], wraps: tuple[bool, ...], moves: tuple[bool, ...]) -> tuple[Callable[..., Any], ...]:
    """One round of invariance, and one of reach."""
    rounds = _Rounds(counts, wraps, moves)
    return jax.jit(rounds.kept), jax.jit(rounds.grown)


class _Rounds(NamedTuple):
    """What JAX compiles for a shape of the grid."""

    counts: tuple[int, ...]
    wraps: tuple[bool, ...]
    moves: tuple[bool, ...]

    def sums(self, lost: Any) -> Any:
        """Prefix sums, with a zero before the first along each axis."""
        table = lost.astype(jnp.uint32)
        for k in range(len(self.counts)):
            whole = jnp.concatenate([table, table], axis=k) if self.wraps[k] else table
            before = [(int(d == k), 0) for d in range(len(self.counts))]
            table = jnp.pad(jnp.cumsum(whole, axis=k, dtype=jnp.uint32), before)
        return table

    def valid(self, table: Any, columns: Any, tables: Any) -> Any:
        """(*counts): is the window of the input with these columns in the grid, and nothing in it lost?"""
        n, inside, ends = len(self.counts), jnp.ones((1,) * len(self.counts), dtype=bool), []
        for k, count in enumerate(self.counts):
            first, last = (jax.lax.dynamic_index_in_dim(t, columns[k], keepdims=False) for t in tables[k])
            if self.moves[k]:
                own = jax.lax.broadcasted_iota(jnp.int32, tuple(count if d == k else 1 for d in range(n)), k)
                first, last = first + own, last + own
            if self.wraps[k]:
                turn = jnp.where(first < 0, count, 0) - jnp.where(first >= count, count, 0)
                first, last = first + turn, last + turn
            else:
                inside &= (first >= 0) & (last < count)
            most = 2 * count if self.wraps[k] else count
            ends.append((jnp.clip(first, 0, most), jnp.clip(last + 1, 0, most)))
        number = jnp.zeros(self.counts, dtype=jnp.uint32)
        for corner in itertools.product((0, 1), repeat=n):
            at = table[tuple(jnp.broadcast_to(ends[k][c], self.counts) for k, c in enumerate(corner))]
            number = number + at if (n - sum(corner)) % 2 == 0 else number - at
        return inside & (number == 0)

    def leading(self, won: Any, column: Any, tables: Any, allowed: Any) -> Any:
        """(bytes, *counts): the inputs that lead wholly into `won`."""
        table = self.sums(~won)

        def byte(eight: Any) -> Any:
            def bit(j: Any, found: Any) -> Any:
                return found | (self.valid(table, eight[:, j], tables).astype(jnp.uint8) << (7 - j).astype(jnp.uint8))

            return jax.lax.fori_loop(0, 8, bit, jnp.zeros(self.counts, dtype=jnp.uint8))

        return jax.lax.map(byte, jnp.swapaxes(column, 0, 1)) & allowed

    def kept(self, alive: Any, column: Any, tables: Any, allowed: Any) -> Any:
        """(what stays alive, its inputs, has anything died?)"""
        inputs = jnp.where(alive, self.leading(alive, column, tables, allowed), jnp.uint8(0))
        left = (inputs != 0).any(axis=0)
        return left, inputs, (left != alive).any()

    def grown(
        self, won: Any, left: Any, values: Any, inputs: Any, level: Any, column: Any, tables: Any, allowed: Any
    ) -> tuple[Any, ...]:
        """(won, left, values, inputs, has anything been won?)"""
        found = self.leading(won, column, tables, allowed)
        fresh = left & (found != 0).any(axis=0)
        return won | fresh, left & ~fresh, jnp.where(fresh, level, values), jnp.where(fresh, found, inputs), fresh.any()
