"""From rates to one step: Euler, semi-implicit Euler, RK4; once over columns of any number type."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, final

from gapcert_equations.programs.tape import Columns, Table, Tape

from .friction import Matrix, mean, soft, solve, velocities, with_friction

Prepared = tuple[Columns, Columns]
Terms = tuple[Matrix, Columns, Columns, Columns]


@final
@dataclass(frozen=True)
class Dynamics:
    """M a = rhs + f at the `rows` (velocities) of the state; each of `positions` (row, source) integrates another row.

    The tape yields mass entries row by row (`mechanical` only), then per row one right-hand side, one friction bound (None: no
    friction), and, where there is any, the damping D that is solved with the sub-step, (M + h D) Δv = h (rhs + f). softness:
    (compliance, rate) of friction that gives way; late: friction does not feel h D. For a map, `integrator` is None and the
    tape yields x⁺. Friction is found at the beginning of a sub-step; in RK4 it is the mean over it, the same in all stages,
    unless it gives way. `memory` yields the hidden states z at its end; the stages see those of its beginning. Columns of both
    tapes are x, u, z.
    """

    tape: Tape
    memory: Tape
    rows: tuple[int, ...] = ()
    positions: tuple[tuple[int, int], ...] = ()
    mechanical: bool = False
    integrator: Literal["euler", "semi_implicit", "rk4"] | None = None
    substeps: int = 1
    period: float = 1.0
    softness: tuple[tuple[float, float] | None, ...] = ()
    late: bool = False

    @property
    def stepping(self) -> tuple[Any, ...]:
        """What one sub-step is beside its tapes; how friction gives way counts where there is friction."""
        n = len(self.rows)
        bounds = self.tape.outputs[n * n + n if self.mechanical else n :][:n]
        soft = [None if b is None else s for s, b in zip(self.softness, bounds, strict=True)]
        return self.integrator, self.period / self.substeps, *soft, self.late

    @property
    def frictionless(self) -> bool:
        """Rates, or a map, and nothing else."""
        n = len(self.rows)
        return not self.mechanical and all(b is None for b in self.tape.outputs[n : 2 * n])

    @property
    def coupled_friction(self) -> bool:
        """Friction at coordinates that M couples: a projection without a derivative in closed form."""
        n = len(self.rows)
        mass, bounds = self.tape.outputs[: n * n], self.tape.outputs[n * n + n : n * n + 2 * n]
        off = any(m is not None for i, m in enumerate(mass) if i % (n + 1))
        return self.mechanical and off and any(b is not None for b in bounds)

    @property
    def once(self) -> Dynamics:
        """One sub-step as a whole period."""
        return replace(self, substeps=1, period=self.period / self.substeps)

    def substep(self, table: Table) -> Any:
        """The length of a sub-step in s."""
        return table["number"](self.period, 1) / float(self.substeps)

    def prepare(self, table: Table, parameters: Columns) -> Prepared:
        """What both tapes compute from the parameters alone; the sub-step is the last of theirs."""
        known = [*parameters, self.substep(table)]
        return self.tape.prepare(table, known), self.memory.prepare(table, known)

    def step(
        self,
        table: Table,
        prepared: Prepared,
        x: Columns,
        u: Columns,
        z: Columns,
        force: Sequence[Columns] | None = None,
    ) -> tuple[Columns, Columns]:
        """(x⁺, z⁺) by columns; force[k][i] is added to the right-hand side of row i in sub-step k."""
        h = self.substep(table)
        for k in range(self.substeps):
            seen = [*u, *z]
            # z⁺ first: it is a law of the state at the beginning.
            z = _filled(table, self.memory.run(table, prepared[1], [*x, *seen])) if z else z
            if self.integrator is None:
                return _filled(table, self.tape.run(table, prepared[0], [*x, *seen])), z
            x = self._substep(table, prepared[0], x, seen, None if force is None else force[k], h)
        return x, z

    def _substep(self, table: Table, prepared: Columns, x: Columns, u: Columns, force: Columns | None, h: Any) -> Columns:
        mass, rhs, bounds, damping = self._terms(table, prepared, x, u, force)
        v = [x[i] for i in self.rows]
        if self.integrator != "rk4":
            rhs, bounds = self._yielding(table, mass, rhs, bounds, v)
            whole = self._damped(mass, damping, h)
            if self.late and whole is not mass and any(b is not None for b in bounds):
                # What friction finds is the velocity that all else gives: M a' = rhs − h D a, with (M + h D) a = rhs.
                free = solve(whole, rhs)
                rhs = [r if d is None else r - h * d * a for r, d, a in zip(rhs, damping, free, strict=True)]
                whole = mass
            new = velocities(table, whole, rhs, bounds, v, h)
            return self._move(x, dict(zip(self.rows, new, strict=True)), h)
        hard = [None if s else b for b, s in zip(bounds, self.softness or [None] * len(v), strict=True)]
        friction = mean(table, mass, rhs, hard, v, h)

        def rates(at: Columns, terms: Terms) -> Columns:
            right = self._yielding(table, *terms[:3], [at[i] for i in self.rows])[0]
            acceleration = solve(terms[0], with_friction(right, friction))
            out = dict(zip(self.rows, acceleration, strict=True)) | {i: at[source] for i, source in self.positions}
            return [out[i] for i in range(len(at))]

        def stage(k: Columns, share: float) -> Columns:
            at = [a + (h * share) * b for a, b in zip(x, k, strict=True)]
            return rates(at, self._terms(table, prepared, at, u, force))

        k1 = rates(x, (mass, rhs, bounds, damping))
        k2 = stage(k1, 0.5)
        k3 = stage(k2, 0.5)
        k4 = stage(k3, 1.0)
        sixth = h / 6.0
        return [a + sixth * (p + 2.0 * (q + r) + s) for a, p, q, r, s in zip(x, k1, k2, k3, k4, strict=True)]

    def _terms(self, table: Table, prepared: Columns, x: Columns, u: Columns, force: Columns | None) -> Terms:
        values, n = self.tape.run(table, prepared, [*x, *u]), len(self.rows)
        mass = [values[i * n : (i + 1) * n] for i in range(n)] if self.mechanical else None
        values = values[n * n :] if self.mechanical else values
        rhs = _filled(table, values[:n])
        return mass, rhs if force is None else with_friction(rhs, force), values[n : 2 * n], values[2 * n :]

    def _yielding(self, table: Table, mass: Matrix, rhs: Columns, bounds: Columns, v: Columns) -> tuple[Columns, Columns]:
        """(rhs with friction that gives way, bounds of friction that does not)."""
        if not any(s and b is not None for s, b in zip(self.softness, bounds, strict=False)):
            return rhs, bounds
        rest = [None if s else b for s, b in zip(self.softness, bounds, strict=True)]
        return with_friction(rhs, soft(table, mass, rhs, bounds, v, self.softness)), rest

    def _damped(self, mass: Matrix, damping: Columns, h: Any) -> Matrix:
        if mass is None or all(d is None for d in damping):
            return mass
        return [
            [e if i != j or d is None else e + h * d for j, e in enumerate(row)]
            for i, (row, d) in enumerate(zip(mass, damping, strict=True))
        ]

    def _move(self, x: Columns, new: dict[int, Any], h: Any) -> Columns:
        """Positions move with the old velocities (euler), or with the new ones, in the order in which they are known."""
        speeds = dict(enumerate(x)) if self.integrator == "euler" else new
        done, waiting = dict(new), dict(self.positions)
        while waiting:
            for i in [i for i, source in waiting.items() if source in speeds]:
                done[i] = x[i] + h * speeds[waiting.pop(i)]
                speeds = speeds if self.integrator == "euler" else done
        return [done[i] for i in range(len(x))]


def _filled(table: Table, values: Columns) -> Columns:
    return [table["number"](0, 1) if v is None else v for v in values]
