"""Effects around any System, from outside: faults on the way of inputs and outputs, and forces at its coordinates."""

from __future__ import annotations

from collections.abc import Callable
from typing import final

import numpy as np

from exams.hidden import slots as s
from exams.hidden.laws import Tables
from exams.hidden.motion import NEAR, bound, bristles, commanded, dry, law, path
from gapcert.contracts.systems.system import System
from gapcert.numerics.arrays import Array, Ints


@final
class Outside:
    """A System with the effects of `tables` about it. Forces are held for one period of the System, so that should be short.

    An input is the applied force at the coordinate of the same number.
    """

    def __init__(self, system: System, tables: Tables) -> None:
        self.system, self.tables = system, tables
        n = len(tables.sites)
        self.n, self.h = n, system.period
        self.rows = _rows(system, tables.sites)
        self.W, self.memory = np.zeros((s.WORKSPACE, n)), np.zeros((len(tables.lines), 4))
        self.arrived = np.zeros(len(tables.lines), dtype=np.int64)
        idle = Tables(tables.sites, tables.lines, tables.sensors).coordinates
        idle[:, [s.TILT, s.PAYLOAD]] = tables.coordinates[:, [s.TILT, s.PAYLOAD]]
        self.active = not np.array_equal(idle, tables.coordinates)

    def run(
        self,
        start: Array,
        command: Callable[[int, Array], Array],
        count: int,
        every: int,
        more: Callable[[Array], Array] | None = None,
    ) -> tuple[Array, Array, Array]:
        """(states, sensed outputs, commands) of `count` samples of `every` periods; more (x): further forces."""
        x, hidden, fine = np.asarray(start, dtype=np.float64), None, [np.asarray(start, dtype=np.float64)]
        ticks = np.arange(count) * every
        states, shown, u = [], [], np.zeros((count, len(self.tables.lines)))
        for k in range(count):
            states.append(x)
            shown.append(self._sensed(fine))
            u[k] = command(k, shown[-1])
            for i in range(every if k + 1 < count else 0):
                acting, forces = self._act(x, u, k, k * every + i, ticks, hidden, more)
                step = self.system.step(x[None], acting[None], hidden=hidden, forces=forces)
                self._remember(x, step.x[0])
                x, hidden = step.x[0], step.hidden
                fine.append(x)
        return np.array(states), np.array(shown), u

    def _sensed(self, fine: list[Array]) -> Array:
        """Late, scaled, shifted; before the first step the state is taken to have been where it begins."""
        y = np.empty(len(self.tables.sensors))
        for j, row in enumerate(self.tables.outputs):
            back = row[s.LATE] / self.h
            whole = int(back)
            late, earlier = fine[max(len(fine) - 1 - whole, 0)][j], fine[max(len(fine) - 2 - whole, 0)][j]
            y[j] = row[s.SCALE] * (late + (back - whole) * (earlier - late)) + row[s.BIAS]
        return y

    def _act(
        self,
        x: Array,
        u: Array,
        k: int,
        now: int,
        ticks: Ints,
        hidden: Array | None,
        more: Callable[[Array], Array] | None,
    ) -> tuple[Array, Array | None]:
        """(inputs that arrive, forces (1, substeps, n) or None)."""
        A, acting = self.tables.inputs, np.empty(len(self.arrived))
        for i in range(len(acting)):
            since = now - A[i, s.DELAY] / self.h
            while self.arrived[i] < k and ticks[self.arrived[i] + 1] <= since + NEAR:
                self.arrived[i] += 1
            acting[i] = path(A, i, self.memory, commanded(u, ticks, self.arrived[i], i, since, 0), self.h)
        if not self.active and more is None:
            return acting, None
        force = np.zeros(self.n) if more is None else more(x)
        load = np.zeros(self.n)
        load[: min(self.n, len(acting))] = acting[: self.n]
        self._laws(x, now * self.h, load, force)
        for j in range(self.n):
            if dry(self.tables.coordinates, j):
                force[j] += self._friction(j, x, acting, force, load[j], hidden)
        return acting, self._held(force)

    def _laws(self, x: Array, t: float, load: Array, force: Array) -> None:
        """Adds everything that is not dry; `load` becomes what play and slip leave of the applied forces."""
        C, W = self.tables.coordinates, self.W
        q, v = x[self.rows[: self.n]], x[self.rows[self.n :]]
        for j in range(self.n):
            passed = load[j]
            if C[j, s.PLAY] > 0:
                W[s.PLAYED, j] = passed = min(max(W[s.PLAYED, j], passed - C[j, s.PLAY]), passed + C[j, s.PLAY])
            if C[j, s.SLIP] > 0:
                passed = C[j, s.SLIP] * np.tanh(passed / C[j, s.SLIP])
            force[j] += law(C, j, q[j], v[j], W[s.BRISTLE, j], W[s.LUGRE_BRISTLE, j], t) + passed - load[j]
            force[j] -= C[j, s.COUPLING] * v[int(C[j, s.PARTNER])]
            load[j] = passed

    def _friction(self, j: int, x: Array, acting: Array, force: Array, load: float, hidden: Array | None) -> float:
        """The velocity is affine in a force over one step: the one that stops the joint, within its bounds."""
        C, row, pushed = self.tables.coordinates, self.rows[self.n + j], force.copy()
        pushed[j] += 1.0
        free, moved = (
            self.system.step(x[None], acting[None], hidden=hidden, forces=self._held(f)).x[0, row] for f in (force, pushed)
        )
        v = float(x[row])
        return float(np.clip(-free / (moved - free), -bound(C, j, v, load, True), bound(C, j, v, load, False)))

    def _held(self, force: Array) -> Array:
        return np.broadcast_to(force, (1, self.system.substeps, self.n))

    def _remember(self, before: Array, after: Array) -> None:
        self.W[s.SPEED], self.W[s.NEXT_SPEED] = (a[self.rows[self.n :]] for a in (before, after))
        for j in range(self.n):
            bristles(self.tables.coordinates, self.W, j, self.h)


def _rows(system: System, sites: tuple[str, ...]) -> Array:
    """Columns of the positions, then of the velocities: states q and q_dot, the state of a rate, or else in that order."""
    names = [x.name for x in system.states]
    places, speeds = [], []
    for j, q in enumerate(sites):
        if q in names:
            places.append(names.index(q))
            speeds.append(names.index(f"{q}_dot") if f"{q}_dot" in names else names.index(q))
        else:
            places.append(j)
            speeds.append(j + len(sites))
    return np.array([*places, *speeds], dtype=np.int64)
