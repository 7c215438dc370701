"""From rates to one step: Euler, semi-implicit Euler, RK4; once over columns of any number type."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, final

from gapcert_equations.friction import Columns, Matrix, mean, solve, velocities, with_friction
from gapcert_equations.tape import Table, Tape

Prepared = tuple[Columns, Columns]


@final
@dataclass(frozen=True)
class Dynamics:
    """M a = rhs + f at the `rows` (velocities) of the state; each of `positions` (row, source) integrates another row.

    The tape yields mass entries row by row (`mechanical` only), then per row one right-hand side and one friction bound
    (None: no friction), then, if `late`, the inertia that friction does not feel: M lacks it, and what moves without friction
    obeys (M + diag) a = rhs. For a map, `integrator` is None and the tape yields x⁺. Friction is found at the beginning of a
    sub-step; in RK4 it is the mean over it, the same in all stages. `memory` yields the hidden states z at its end;
    the stages see those of its beginning. Columns of both tapes are x, u, z.
    """

    tape: Tape
    memory: Tape
    rows: tuple[int, ...] = ()
    positions: tuple[tuple[int, int], ...] = ()
    mechanical: bool = False
    integrator: Literal["euler", "semi_implicit", "rk4"] | None = None
    substeps: int = 1
    period: float = 1.0
    late: bool = False

    @property
    def coupled_friction(self) -> bool:
        """Friction at coordinates that M couples: a projection without a derivative in closed form."""
        n = len(self.rows)
        mass, bounds = self.tape.outputs[: n * n], self.tape.outputs[n * n + n : n * n + 2 * n]
        off = any(m is not None for i, m in enumerate(mass) if i % (n + 1))
        return self.mechanical and off and any(b is not None for b in bounds)

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
        mass, rhs, bounds = self._terms(table, prepared, x, u, force)
        v = [x[i] for i in self.rows]
        if self.integrator != "rk4":
            new = velocities(table, mass, rhs, bounds, v, h)
            return self._move(x, dict(zip(self.rows, new, strict=True)), h)
        friction = mean(table, mass, rhs, bounds, v, h)

        def rates(at: Columns, terms: tuple[Matrix, Columns, Columns]) -> Columns:
            acceleration = solve(terms[0], with_friction(terms[1], friction))
            out = dict(zip(self.rows, acceleration, strict=True)) | {i: at[source] for i, source in self.positions}
            return [out[i] for i in range(len(at))]

        def stage(k: Columns, share: float) -> Columns:
            at = [a + (h * share) * b for a, b in zip(x, k, strict=True)]
            return rates(at, self._terms(table, prepared, at, u, force))

        k1 = rates(x, (mass, rhs, bounds))
        k2 = stage(k1, 0.5)
        k3 = stage(k2, 0.5)
        k4 = stage(k3, 1.0)
        sixth = h / 6.0
        return [a + sixth * (p + 2.0 * (q + r) + s) for a, p, q, r, s in zip(x, k1, k2, k3, k4, strict=True)]

    def _terms(
        self, table: Table, prepared: Columns, x: Columns, u: Columns, force: Columns | None
    ) -> tuple[Matrix, Columns, Columns]:
        values, n = self.tape.run(table, prepared, [*x, *u]), len(self.rows)
        mass = [values[i * n : (i + 1) * n] for i in range(n)] if self.mechanical else None
        values = values[n * n :] if self.mechanical else values
        rhs = _filled(table, values[:n])
        rhs = rhs if force is None else [r + f for r, f in zip(rhs, force, strict=True)]
        if self.late and mass is not None:
            rhs = _early(mass, rhs, values[2 * n :])
        return mass, rhs, values[n : 2 * n]

    def _move(self, x: Columns, new: dict[int, Any], h: Any) -> Columns:
        """Positions move with the old velocities (euler), or with the new ones, in the order in which they are known."""
        speeds = dict(enumerate(x)) if self.integrator == "euler" else new
        done, waiting = dict(new), dict(self.positions)
        while waiting:
            for i in [i for i, source in waiting.items() if source in speeds]:
                done[i] = x[i] + h * speeds[waiting.pop(i)]
                speeds = speeds if self.integrator == "euler" else done
        return [done[i] for i in range(len(x))]


def _early(mass: list[Columns], rhs: Columns, late: Columns) -> Columns:
    """M (M + diag(late))⁻¹ rhs = rhs − late a, with (M + diag(late)) a = rhs."""
    whole = [list(row) for row in mass]
    for i, e in enumerate(late):
        if e is not None:
            whole[i][i] = e if whole[i][i] is None else whole[i][i] + e
    return [r if e is None else r - e * a for r, e, a in zip(rhs, late, solve(whole, rhs), strict=True)]


def _filled(table: Table, values: Columns) -> Columns:
    return [table["number"](0, 1) if v is None else v for v in values]
