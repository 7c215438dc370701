"""Plans along lines of their own: F is made straight about the last plan, in boxes that the new plan's tube must keep to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np

from gapcert.plugin import Array, Bools
from gapcert_mpc.program.linearise import Frame, Nominal, Stages
from gapcert_mpc.program.tube import Section, tightest
from gapcert_mpc.thresholds import THRESHOLDS

from .design import Design
from .engine import Engine
from .plans import Held, Plan


@final
@dataclass(frozen=True)
class Ending:
    """Stages for a program whose lines vary: all of them the whole goal's but the terminal one, which is about a steady pair;
    and the section that fits best there, with its shares of the terminal box.
    """

    stages: Stages
    section: Section
    shares: Array

    @classmethod
    def about(cls, nominal: Nominal, frame: Frame, wanted: Array, matter: Array, rows: Array, horizon: int) -> Ending:
        """wanted (n + m,) with weights `matter`; rows (r, n + m) besides the states and inputs, scaled to half-widths of 1.

        Of the terminal boxes that are tried, the one that leaves most of itself beside its tube: max Π r_j (1 − share_j).
        """
        one = np.ones((1, len(wanted)))
        whole = nominal.along(frame, 0 * one, -one, one)
        on = (whole.G[0] > THRESHOLDS.constant_slope).any(axis=0)
        z = steady(nominal, frame, wanted, matter)
        best: tuple[tuple[bool, float], Ending] | None = None
        for size in THRESHOLDS.terminal_sizes:
            radius = np.where(on, size, 2.0)
            last = nominal.along(frame, z, np.maximum(z - radius, -1.0), np.minimum(z + radius, 1.0)).only(on)
            room = np.maximum(np.minimum(last.high - z, z - last.low)[0], 1e-3)
            scaled = np.vstack([np.diag(1 / room), rows])
            section, shares = tightest(*last.first, scaled, away=0.0)
            fits = bool((shares < 1).all())
            left = float(np.log(room * (1 - shares[: len(room)])).sum()) if fits else -float(shares.max())
            if best is None or (fits, left) > best[0]:
                best = (fits, left), cls(whole.only(on).repeated(horizon).then(last), section, shares)
            elif best[0][0]:
                break
        assert best is not None
        return best[1]


def steady(nominal: Nominal, frame: Frame, wanted: Array, matter: Array) -> Array:
    """(1, n + m): a point of the goal, nearly steady, that is nearest to the one that is wanted; Gauss-Newton steps."""
    z, whole = np.clip(wanted, -1.0, 1.0)[None], np.ones((1, len(wanted)))
    weight = np.diag(np.maximum(matter, 1e-6))
    for _ in range(10):
        line = nominal.tangents(frame, z, -whole, whole, np.zeros(frame.nx))
        E = np.hstack([np.eye(frame.nx) - line.A[0], -line.B[0]])
        both = np.block([[weight, E.T], [E, np.zeros((len(E), len(E)))]])
        found = np.linalg.lstsq(both, np.concatenate([weight @ wanted, line.d[0]]), rcond=None)[0]
        z = np.clip(found[None, : len(wanted)], -1.0, 1.0)
    return np.asarray(z)


@final
@dataclass(frozen=True)
class Lines:
    """Stages about a motion (x̄ (N, n), ū (N, m)) from x, in boxes about it, with the terminal stage that never changes.

    on (n + m,): the coordinates along which slopes change; the boxes are whole along all others.
    """

    frame: Frame
    nominal: Nominal
    section: Section
    terminal: Stages
    on: Bools

    @classmethod
    def of(cls, nominal: Nominal, design: Design) -> Lines:
        stages = design.stages
        last = stages.taken(np.array([stages.horizon]))
        return cls(design.frame, nominal, design.section, last, np.asarray(stages.G.any(axis=(0, 1))))

    def stages(self, x: Array, z: Array, radius: Array) -> Stages:
        """With a bound of all that the lines leave out."""
        z, low, high = self._boxes(x, z, radius)
        return self.nominal.along(self.frame, z, low, high).only(self.on).then(self.terminal)

    def again(self, x: Array, z: Array, radius: Array, old: Stages, by: int) -> Stages | None:
        """Lines of a plan of `by` steps before, where their boxes still hold these, but for the room to move, and are not much
        wider: a line is valid in its box, whatever it was made for.
        """
        N, n = len(z), self.frame.nx
        take = np.append(np.minimum(np.arange(N) + by, N - 1), N)
        low, high = old.low[take[:-1]], old.high[take[:-1]]
        need = np.where(self.on, THRESHOLDS.line_narrowest * radius, 0.0)
        need[0, :n] = 0.0
        z = np.clip(z, -1.0, 1.0)
        z[0, :n] = x
        inside = (np.maximum(z - need, -1.0) >= low).all() and (np.minimum(z + need, 1.0) <= high).all()
        wide = ((high - low) > THRESHOLDS.line_widest * 2 * radius)[1:, self.on].any()
        return old.taken(take) if inside and not wide else None

    def tangents(self, x: Array, z: Array, radius: Array) -> Stages:
        """With slopes at the points, and nothing left out but what the terminal stage has: for the search, no certificate."""
        return self.nominal.tangents(self.frame, *self._boxes(x, z, radius), self.terminal.c[0]).then(self.terminal)

    def _boxes(self, x: Array, z: Array, radius: Array) -> tuple[Array, Array, Array]:
        n = self.frame.nx
        z = np.clip(z, -1.0, 1.0)
        z[0, :n] = x
        radius = np.where(self.on, radius, 2.0)
        # A plan begins at x itself.
        radius[0, :n] = 0.0
        return z, np.maximum(z - radius, -1.0), np.minimum(z + radius, 1.0)

    def radius(self, s: Array, floor: float) -> Array:
        """(N, n + m): what a tube s (≥ N, p) and a plan that moves by `floor` need."""
        N = len(s)
        return np.asarray(floor + THRESHOLDS.tube_growth * s[:N] @ self.section.support.T)


def tube(stages: Stages, section: Section, tolerance: float, x: Array, u: Array) -> Array:
    """s (N+1, p): the least tube along a plan x̄ (≥ N, n), ū (N, m)."""
    N, size = len(u), np.abs(section.H)
    grown = section.moved_by(stages.A, stages.B) + size @ stages.G @ section.support
    away = np.abs(np.hstack([x[:N], u]) - stages.centre[:N])
    w = stages.c[:N] + tolerance + (stages.G[:N] @ away[..., None])[..., 0]
    s = np.zeros((N + 1, len(size)))
    s[0] = size.sum(axis=1) * tolerance
    for k in range(N):
        s[k + 1] = grown[k] @ s[k] + size @ w[k]
    return s


def rest(plan: Plan, section: Section, age: int) -> tuple[Array, Array]:
    """(x̄ (N, n), ū (N, m)) of the N steps after `age` ones: what is left of it, then towards its steady pair."""
    N, n = len(plan.u), plan.x.shape[1]
    x, u = np.empty((N, n)), np.empty((N, plan.u.shape[1]))
    left = max(N - age, 0)
    x[:left], u[:left] = plan.x[age:N], plan.u[age:]
    away = plan.x[N] - plan.xs
    for _ in range(age - N):
        away = section.closed @ away
    for k in range(left, N):
        x[k], u[k] = plan.xs + away, plan.us + section.K @ away
        away = section.closed @ away
    return x, u


@final
class Successive:
    """Finds plans about plans: sound ones at every iterate, for what a line leaves out is bounded wherever the tube may be."""

    def __init__(self, engine: Engine, design: Design, nominal: Nominal) -> None:
        self.engine, self.lines = engine, Lines.of(nominal, design)
        self.target = design.reference[: design.frame.nx], design.reference[design.frame.nx :]

    def solve(self, x: Array, held: Held | None) -> Plan | None:
        """A plan from x (frame), about what is left of the one that is held, and its age."""
        if held is None:
            return self._begun(x)
        plan, age = held[:2]
        section = self.lines.section
        z = np.hstack(rest(plan, section, age + 1))
        n = len(x)
        away = x - z[0, :n]
        for row in z:
            row += np.concatenate([away, section.K @ away])
            away = section.closed @ away
        floor = THRESHOLDS.move_floors[age % len(THRESHOLDS.move_floors)]
        if age == 0 and plan.lines is not None:
            old = self.lines.again(x, z, self.lines.radius(plan.s[:-1], floor), plan.lines, 1)
            made = None if old is None else self._along(x, old)
            if made is not None:
                return made
        return self._certified(x, z, plan.s, floor)

    def _certified(self, x: Array, z: Array, s: Array, floor: float) -> Plan | None:
        return self._along(x, self.lines.stages(x, z, self.lines.radius(s[:-1], floor)))

    def _along(self, x: Array, stages: Stages) -> Plan | None:
        found = self._found(x, stages)
        if found is None:
            return None
        s = tube(stages, self.lines.section, self.engine.program.tolerance, found.x, found.u)
        return replace(found, s=s, lines=stages)

    def _found(self, x: Array, stages: Stages) -> Plan | None:
        self.engine.program.update(stages)
        return self.engine.found(x, *self.engine.later[2:], varied=True)

    def _begun(self, x: Array) -> Plan | None:
        """About a motion that is found without a bound of what lines leave out, with several boxes."""
        n = len(x)
        z = self._searched(x, self._straight(x))
        if z is None:
            return None
        for floor in THRESHOLDS.move_floors:
            s = np.zeros((len(z) + 1, self.engine.program.p))
            # The tube needs the boxes, and they need the tube.
            for _ in range(2):
                stages = self.lines.stages(x, z, self.lines.radius(s[:-1], floor))
                s = tube(stages, self.lines.section, self.engine.program.tolerance, z[:, :n], z[:, n:])
            made = self._certified(x, z, s, floor)
            if made is not None:
                return made
        return None

    def _searched(self, x: Array, z: Array) -> Array | None:
        """z (N, n + m) of a plan from there: quadratic programs with the slopes at the last one's answer."""
        for _ in range(THRESHOLDS.linearisation_rounds):
            found = self._found(x, self.lines.tangents(x, z, np.ones_like(z)))
            if found is None:
                return None
            then = np.hstack([found.x[:-1], found.u])
            moved, z = float(np.abs(then - z)[:, self.lines.on].max(initial=0.0)), then
            if moved < THRESHOLDS.move_floors[0]:
                break
        return z

    def _straight(self, x: Array) -> Array:
        """From x straight to the target."""
        N = self.engine.program.N
        share = (np.arange(N) / N)[:, None]
        return np.hstack([(1 - share) * x + share * self.target[0], np.tile(self.target[1], (N, 1))])
