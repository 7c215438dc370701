"""The states that have no cells: a box V0 that they never leave, and the inputs that keep relations there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np

from gapcert import Array, Box, Domain, GapFunction, Goal, Interval, Model, UsageError
from gapcert.plugin import Bools, Ints, supremum
from gapcert_symbolic.thresholds import THRESHOLDS

from .grid import Grid, combined

CHUNK = 20_000


@final
@dataclass(frozen=True)
class Left:
    """A problem whose cells are about the states `on` alone (by number): model, gap, domain, goal, and the inputs in use."""

    model: Model
    gap: GapFunction | None
    domain: Domain
    goal: Goal
    on: tuple[int, ...]
    inputs: Box

    @property
    def states(self) -> tuple[int, ...]:
        """The states that have no cells."""
        return tuple(j for j in range(self.domain.nx) if j not in self.on)

    def box(self, v: Interval) -> Interval:
        """stay × V × inputs, (1, nz), for v (1, states without cells)."""
        stay = self.goal.stay.interval
        low, high = stay.lo.copy(), stay.hi.copy()
        low[:, self.states], high[:, self.states] = v.lo, v.hi
        return Interval.concatenate([Interval(low, high), self.inputs.interval], axis=1)

    def image(self, v: Interval) -> Interval:
        """Contains f_v over the box: its range ∩ the mean-value form f(c) + J (z − c)."""
        z = self.box(v)
        centre = Interval.exact(z.mid)
        moved = (self.model.jacobian_enclosure(z) * (z - centre)[:, None, :]).sum(-1)
        return self.model.enclosure(z).intersect(self.model.enclosure(centre) + moved)[:, list(self.states)]

    def gamma(self, v: Interval) -> Array:
        """sup γ_v over the part of the box that lies in Z, (states without cells,)."""
        if self.gap is None:
            return np.zeros(len(self.states))
        z, domain = self.box(v), self.domain
        low, high = np.maximum(z.lo[0], domain.low), np.minimum(z.hi[0], domain.high)
        x = Box(domain.states.axes, tuple(low[: domain.nx].tolist()), tuple(high[: domain.nx].tolist()))
        part = Domain(x, self.inputs, domain.relations)
        return supremum(self.gap, part, THRESHOLDS.held_tolerance, THRESHOLDS.held_boxes, self.states)[0]

    def broken(self, v: Interval) -> str:
        """What fails for some v in V and some input: a relation that does not involve the cells' states, or the range of v."""
        z, stay = self.box(v), self.goal.stay
        for relation in self.domain.relations:
            a = np.asarray(relation.coefficients)
            if not a[list(self.on)].any() and float((z[0] * a).sum(-1).hi) > relation.bound:
                return f"{relation.text} does not hold for all of them"
        for k, j in enumerate(self.states):
            if v.lo[0, k] < stay.low[j] or v.hi[0, k] > stay.high[j]:
                return f"{stay.names[j]} leaves [{stay.low[j]:g}, {stay.high[j]:g}]"
        return ""

    def scaled(self, share: float) -> Left:
        """With inputs in a share of their ranges, about the same middle."""
        low, high = np.asarray(self.inputs.low), np.asarray(self.inputs.high)
        middle, reach = (low + high) / 2, share * (high - low) / 2
        inputs = Box(self.inputs.axes, tuple((middle - reach).tolist()), tuple((middle + reach).tolist()))
        return replace(self, inputs=inputs)


def invariant(left: Left) -> Box:
    """V0: f_v(stay, V0, U) + [−γ_v, γ_v] ⊆ V0, so that from v in V0 no input leads out of it while the cells' states stay.

    Grown from what the inputs reach in one step. Without a gap it is the largest box that the relations leave, where that is
    invariant too. UsageError with the largest admissible inputs where a relation fails for some v in V0 and some input.
    """
    stay = left.goal.stay.interval[:, list(left.states)]
    v = _apart(left.image(Interval.exact(stay.mid)))
    for k in range(THRESHOLDS.growths):
        if what := left.broken(v):
            raise UsageError(_inadmissible(left, v, what))
        after = _widened(left.image(v), left.gamma(v))
        if v.contains(after).all():
            return _box(left, _widest(left, v) if left.gap is None else v)
        grown = Interval.hull(v, after)
        more = (THRESHOLDS.growth_ahead if k > 2 else 0.0) * np.maximum(grown.hi - v.hi, v.lo - grown.lo) + 1e-9 * grown.mag
        v = _widened(grown, more[0])
    names = ", ".join(left.goal.stay.names[j] for j in left.states)
    raise UsageError(
        f"controller.on: no box holds {names} after {THRESHOLDS.growths} steps of growing; grid them too, or narrow input_range"
    )


def _widened(v: Interval, by: Array) -> Interval:
    return v + Interval(-by[None], by[None])


def _apart(v: Interval) -> Interval:
    """With ends that differ, as a Box needs them."""
    return _widened(v, 1e-12 * np.maximum(v.mag[0], 1.0))


def _box(left: Left, v: Interval) -> Box:
    axes = tuple(left.goal.stay.axes[j] for j in left.states)
    return Box(axes, tuple(v.lo[0].tolist()), tuple(v.hi[0].tolist()))


def _widest(left: Left, v: Interval) -> Interval:
    """V grown side by side as far as the relations and `stay` allow; V itself where that is not invariant."""
    stay = left.goal.stay.interval[:, list(left.states)]
    low, high = v.lo.copy(), v.hi.copy()
    for k, j in enumerate(left.states):
        ends = [stay.lo[0, k], stay.hi[0, k]]
        for relation in left.domain.relations:
            a = np.array(relation.coefficients)
            if not a[j] or a[list(left.on)].any():
                continue
            own, a[j] = a[j], 0.0
            end = (relation.bound - float((left.box(Interval(low, high))[0] * a).sum(-1).hi)) / own * (1 - 1e-12)
            ends[int(own > 0)] = min(ends[1], end) if own > 0 else max(ends[0], end)
        low[0, k], high[0, k] = min(low[0, k], ends[0]), max(high[0, k], ends[1])
    wide = Interval(low, high)
    return wide if not left.broken(wide) and wide.contains(left.image(wide)).all() else v


def _inadmissible(left: Left, v: Interval, what: str) -> str:
    gamma, share = left.gamma(v), [0.0, 1.0]
    for _ in range(30):
        middle = sum(share) / 2
        share[0 if _admissible(left.scaled(middle), gamma) else 1] = middle
    stay = left.goal.stay
    held = ", ".join(f"{stay.names[j]} up to ±{m:.3g} {stay.axes[j].unit}" for j, m in zip(left.states, v.mag[0], strict=True))
    head = f"controller.input_range: with these inputs the states left out move ({held}), and {what}"
    if not share[0]:
        gaps = ", ".join(f"{stay.names[j]}: {g:.3g}" for j, g in zip(left.states, gamma, strict=True))
        return f"{head}; no inputs around these middles are admissible (gap {gaps}); certify a smaller gap"
    most = left.scaled(share[0]).inputs
    ranges = ", ".join(f"{n}: [{_in(a, 1)}, {_in(b, -1)}]" for n, a, b in zip(most.names, most.low, most.high, strict=True))
    return f"{head}; the largest admissible range of this shape is {{{ranges}}}"


def _admissible(left: Left, gamma: Array) -> bool:
    """Is there an invariant box within the relations, were the gap as large as `gamma` everywhere?"""
    v = left.image(Interval.exact(left.goal.stay.interval[:, list(left.states)].mid))
    for _ in range(THRESHOLDS.growths):
        after = _widened(left.image(v), gamma)
        if left.broken(after):
            return False
        if v.contains(after).all():
            return True
        v = _widened(Interval.hull(v, after), 1e-9 * after.mag[0])
    return False


def _in(value: float, sign: int) -> str:
    """To four digits, rounded towards the middle."""
    return f"{(np.ceil if sign > 0 else np.floor)(round(value * 1e4, 6)) / 1e4:g}"


def offered(domain: Domain, grid: Grid, axes: tuple[Array, ...], cell: Ints | None = None) -> Bools | None:
    """(cells, inputs): the input keeps every relation for all states of the cell; None where there are no relations.

    Of all cells, or of some. max over the cell of a·z, rounded outwards, is at most b.
    """
    if not domain.relations:
        return None
    points, nx = combined(axes), domain.nx
    size = grid.size if cell is None else len(cell)
    out = np.ones((size, len(points)), dtype=bool)
    for relation in domain.relations:
        a = np.asarray(relation.coefficients)
        by_input = (Interval.exact(points) * a[nx:]).sum(-1)
        for start in range(0, size, CHUNK):
            ends = grid.cells(start, start + CHUNK) if cell is None else grid.boxes(cell[start : start + CHUNK])
            by_state = (Interval(*ends) * a[:nx]).sum(-1)
            total = by_state.reshape(-1, 1) + by_input.reshape(1, -1)
            out[start : start + CHUNK] &= total.hi <= relation.bound
    return out
