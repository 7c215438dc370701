"""f(x, u; θ) with θ known only to lie in a range: as a model at one θ̂ with a wider gap, and what each step says of θ."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Any, final

import numpy as np

from gapcert import Array, GapFunction, Interval, Model, Parameter, SynthesisProblem, UsageError, registry
from gapcert.plugin import Bools, circle, magnitude
from gapcert_mpc.thresholds import THRESHOLDS

TURN = Interval(np.nextafter(2 * np.pi, 0.0), np.nextafter(2 * np.pi, 7.0))


@final
@dataclass(frozen=True)
class Family:
    """f(x, u; θ), with the gap r(z) ∈ [l, u](z) of f(·; θ*), where θ* is the plant's own θ, and the range Θ₀ of θ (nθ,).

    `model` has the parameters as its last inputs, so that its range and its slopes over boxes (x, u, θ) are known.
    """

    model: Model
    parameters: tuple[Parameter, ...]
    range: Interval
    problem: SynthesisProblem
    seen: dict[bytes, tuple[Interval, Interval]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, problem: SynthesisProblem, asked: Mapping[str, Any]) -> Family:
        """asked: per parameter what `ranged` reads. UsageError where the model has no such parameter, or is not equations."""
        parameters = named(problem.model, asked)
        ends = [ranged(p, asked[p.name]) for p in parameters]
        theta = Interval(np.array([low for low, _ in ends]), np.array([high for _, high in ends]))
        return cls(with_inputs(problem.model, parameters), parameters, theta, problem)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.parameters)

    @cached_property
    def corners(self) -> Array:
        """The middle of Z, and corners of it, (k, nz): where slopes are looked at to choose θ̂, of which nothing depends."""
        domain = self.problem.domain
        ends = np.array(list(product((0.0, 1.0), repeat=min(len(domain.low), 6))))
        part = np.full((len(ends) + 1, len(domain.low)), 0.5)
        part[1:, : ends.shape[1]] = ends
        return np.asarray(domain.low + (domain.high - domain.low) * part)

    def centre(self, theta: Interval) -> Array:
        """θ̂ ∈ Θ (nθ,) from where f reaches as far to one end of Θ as to the other, at the corner where it reaches farthest."""
        out, nx = theta.mid.copy(), self.model.nx
        z, width = self.corners, self.problem.domain.high[:nx] - self.problem.domain.low[:nx]

        def f(z: Array, j: int, value: float) -> Array:
            at = np.tile(out, (len(z), 1))
            at[:, j] = value
            return np.asarray(self.model.step(z[:, :nx], np.hstack([z[:, nx:], at])).x)

        for j in range(len(out)):
            low, high = float(theta.lo[j]), float(theta.hi[j])
            at_low, at_high = f(z, j, low), f(z, j, high)
            k, i = np.unravel_index(np.argmax(np.abs(at_high - at_low) / width), at_low.shape)
            wanted, rises = (at_low[k, i] + at_high[k, i]) / 2, at_high[k, i] > at_low[k, i]
            for _ in range(40):
                middle = (low + high) / 2
                above = f(z[k : k + 1], j, middle)[0, i] > wanted
                low, high = (low, middle) if above == rises else (middle, high)
            out[j] = min(max((low + high) / 2, theta.lo[j]), theta.hi[j])
        return out

    def moved(self, boxes: Interval, centre: Array, theta: Interval) -> Interval:
        """Contains f(z; θ) − f(z; θ̂) for z in each box (n, nz) and θ ∈ Θ, (n, nx).

        One coordinate of θ after the other leaves θ̂, and its way is cut into pieces, on each of which ∂f/∂θ_j is bounded: the
        difference is a sum of whole pieces and a part of the next, which lies between the sums without it and with all of it.
        """
        n, total = len(boxes), Interval.exact(np.zeros((len(boxes), self.model.nx)))
        for j in range(len(centre)):
            ways = [np.linspace(centre[j], end, THRESHOLDS.slope_pieces + 1) for end in (theta.lo[j], theta.hi[j])]
            first, last = (np.concatenate([way[k : THRESHOLDS.slope_pieces + k] for way in ways]) for k in (0, 1))
            low, high = np.tile(centre, (2 * THRESHOLDS.slope_pieces, 1)), np.tile(centre, (2 * THRESHOLDS.slope_pieces, 1))
            low[:, :j], high[:, :j] = theta.lo[:j], theta.hi[:j]
            low[:, j], high[:, j] = np.minimum(first, last), np.maximum(first, last)
            again = boxes[np.tile(np.arange(n), 2 * THRESHOLDS.slope_pieces)]
            slopes = self.slopes(again, Interval(np.repeat(low, n, axis=0), np.repeat(high, n, axis=0)))[:, :, j]
            moves = (
                slopes
                * (Interval.exact(last) - Interval.exact(first))[np.repeat(np.arange(2 * THRESHOLDS.slope_pieces), n)][:, None]
            )
            reached = so_far = Interval.exact(np.zeros(total.shape))
            for k in range(2 * THRESHOLDS.slope_pieces):
                so_far = moves[n * k : n * (k + 1)] + (so_far if k % THRESHOLDS.slope_pieces else 0.0)
                reached = Interval.hull(reached, so_far)
            total = total + reached
        return total

    def left(self, boxes: Interval) -> tuple[Interval, Interval]:
        """What is left of the gap beside its predictor over each box; it is kept of the many cells that all boxes Θ share."""
        gap = self.problem.gap
        assert gap is not None, "who asks has a gap"
        if len(boxes) < THRESHOLDS.many_boxes:
            return gap.remainder_ends_over(boxes)
        key = hashlib.sha256(boxes.lo.tobytes() + boxes.hi.tobytes()).digest()
        if key not in self.seen:
            if len(self.seen) >= THRESHOLDS.kept_sets:
                self.seen.pop(next(iter(self.seen)))
            self.seen[key] = gap.remainder_ends_over(boxes)
        return self.seen[key]

    def values(self, z: Interval, theta: Interval) -> Interval:
        """Contains f(z; θ), row by row, (n, nx)."""
        return self.model.enclosure(beside(z, theta))

    def slopes(self, z: Interval, theta: Interval) -> Interval:
        """Contains ∂f/∂θ, row by row, (n, nx, nθ)."""
        return self.model.jacobian_enclosure(beside(z, theta))[:, :, z.shape[1] :]

    def at(self, theta: Array) -> Model:
        """f(·; θ) as a model of x and u."""
        spec = self.problem.model.to_spec()
        given = {
            p.name: v if p.unit == "1" else f"{v!r} {p.unit}" for p, v in zip(self.parameters, theta.tolist(), strict=True)
        }
        return built(spec | {"parameters": spec["parameters"] | given})

    def within(self, theta: Interval) -> SynthesisProblem:
        """The same problem for a plant with θ* ∈ Θ: x⁺ ∈ f(z; θ̂) + [l, u](z) + {f(z; θ) − f(z; θ̂) : θ ∈ Θ}."""
        gap, centre = self.problem.gap, self.centre(theta)
        wider = None if gap is None else ParametricGap(gap, self, centre, theta)
        return replace(self.problem, model=self.at(centre), gap=wider)


@final
class ParametricGap(GapFunction):
    """[l, u](z) + {f(z; θ) − f(z; θ̂) : θ ∈ Θ} around f(·; θ̂): it contains f̂ − f(·; θ̂) where θ* ∈ Θ."""

    def __init__(self, gap: GapFunction, family: Family, centre: Array, theta: Interval) -> None:
        self.gap, self.of, self.centre, self.theta, self.family = gap, family, centre, theta, gap.family
        self.predictor = getattr(gap, "predictor", None)

    def _moved(self, boxes: Interval) -> Interval:
        return self.of.moved(boxes, self.centre, self.theta)

    def interval(self, z: Array) -> tuple[Array, Array]:
        low, high = self.gap.interval(z)
        moved = self._moved(Interval.exact(z))
        return (Interval.exact(low) + moved).lo, (Interval.exact(high) + moved).hi

    def interval_over(self, boxes: Interval) -> Interval:
        known = self.gap.interval_over(boxes) if self.predictor is not None else Interval.hull(*self.of.left(boxes))
        return known + self._moved(boxes)

    def remainder_ends_over(self, boxes: Interval) -> tuple[Interval, Interval]:
        moved, (low, high) = self._moved(boxes), self.of.left(boxes)
        return low + moved, high + moved

    def lipschitz(self, boxes: Interval) -> Array:
        return np.full((len(boxes), self.of.problem.model.nx, boxes.shape[1]), np.inf)

    def arrays(self) -> dict[str, Array]:
        return {**self.gap.arrays(), "centre": self.centre, "theta": np.stack([self.theta.lo, self.theta.hi])}

    @property
    def form(self) -> Mapping[str, Any]:
        return {"form": "parametric", "of": dict(self.gap.form), "parameters": list(self.of.names)}


@final
@dataclass(frozen=True)
class Membership:
    """Θ ∩ {θ : x⁺ − f(x, u; θ) ∈ [l, u](x, u)} in boxes, rounded outwards.

    Interval Newton steps in each of the boxes that Θ is cut into: f(z; θ) ∈ f(z; c) + J (θ − c) with J ⊇ ∂f/∂θ over the box, so
    that row i gives θ_j ∈ c_j + (T_i − f_i(z; c) − Σ_{k≠j} J_ik (θ_k − c_k)) / J_ij, where T = x⁺ − [l, u](z). No θ that solves
    it is ever lost: what is dropped lies outside all rows' sets.
    """

    family: Family

    def updated(self, x: Array, u: Array, after: Array, theta: Interval) -> tuple[Interval, Bools]:
        """(Θ⁺ (n, nθ), refuted (n,)) after steps from x under u to `after`, row by row; refuted: no θ ∈ Θ makes the step, and Θ
        stays. Where (x, u) lies outside Z nothing is claimed, and Θ stays as well.
        """
        z, low, high = self._gap(x, u)
        known = self.family.problem.domain.zone.contains(z.mid)
        values = self.family.values(z, theta)
        # T, where f(z; θ*) lies.
        goal = self._turned(after, values.mid) - Interval(low, high)
        rows = np.flatnonzero(known & ~goal.contains(values).all(axis=1))
        lo, hi, refuted = theta.lo.copy(), theta.hi.copy(), np.zeros(len(x), dtype=bool)
        if len(rows):
            found, refuted[rows] = self._cut(z[rows], goal[rows], theta[rows])
            lo[rows], hi[rows] = found.lo, found.hi
        return Interval(lo, hi), refuted

    def _gap(self, x: Array, u: Array) -> tuple[Interval, Array, Array]:
        """z, on the turn on which the gap is known, and l and u there."""
        domain, gap = self.family.problem.domain, self.family.problem.gap
        assert gap is not None, "without a gap nothing is to be learned"
        z, nx = np.hstack([x, u]), x.shape[1]
        moved = self._turned(x, (domain.low[:nx] + domain.high[:nx]) / 2)
        boxes = Interval(np.hstack([moved.lo, u]), np.hstack([moved.hi, u]))
        low, high = (np.array(end) for end in gap.interval(z))
        turned = (boxes.lo < boxes.hi).any(axis=1)
        if turned.any():
            over = gap.interval_over(boxes[turned])
            low[turned], high[turned] = over.lo, over.hi
        return boxes, low, high

    def _turned(self, x: Array, near: Array) -> Interval:
        """States (n, nx), angles by the turn that is nearest to `near`."""
        angles = np.array([s.kind == "angle" for s in self.family.problem.model.states])
        turns = np.where(angles, circle.turns(x, near), 0.0)
        moved = Interval.exact(x) - TURN * turns
        return Interval(np.where(turns != 0, moved.lo, x), np.where(turns != 0, moved.hi, x))

    def _cut(self, z: Interval, goal: Interval, theta: Interval) -> tuple[Interval, Bools]:
        """Hulls of what is left of the parts; a second time in those that are much smaller."""
        lo, hi, refuted = theta.lo.copy(), theta.hi.copy(), np.zeros(len(z), dtype=bool)
        rows = np.arange(len(z))
        for _ in range(2):
            old = Interval(lo[rows], hi[rows])
            new, empty = self._narrowed(z[rows], goal[rows], old)
            refuted[rows] |= empty
            lo[rows], hi[rows] = np.where(empty[:, None], old.lo, new.lo), np.where(empty[:, None], old.hi, new.hi)
            rows = rows[~empty & (hi[rows] - lo[rows] < 0.7 * (old.hi - old.lo)).any(axis=1)]
            if not len(rows):
                break
        # What was refuted in the second round began as it was given.
        lo[refuted], hi[refuted] = theta.lo[refuted], theta.hi[refuted]
        return Interval(lo, hi), refuted

    def _narrowed(self, z: Interval, goal: Interval, theta: Interval) -> tuple[Interval, Bools]:
        n, q = theta.shape
        parts = list(tiled(theta, max(1, int(THRESHOLDS.membership_boxes ** (1 / q) + 1e-9))))
        # Parts one after the other, in each of them all rows.
        again = np.tile(np.arange(n), len(parts))
        boxes = Interval(np.concatenate([a for a, _ in parts]), np.concatenate([b for _, b in parts]))
        lo, hi, left = self._newton(z[again], goal[again], boxes)
        shape = (len(parts), n, q)
        keep = left.reshape(len(parts), n, 1)
        least = np.where(keep, lo.reshape(shape), np.inf).min(axis=0)
        most = np.where(keep, hi.reshape(shape), -np.inf).max(axis=0)
        empty = np.asarray(~keep.any(axis=0))[:, 0]
        return Interval(np.where(empty[:, None], theta.lo, least), np.where(empty[:, None], theta.hi, most)), empty

    def _newton(self, z: Interval, goal: Interval, theta: Interval) -> tuple[Array, Array, Bools]:
        """One sweep over rows and parameters: (low, high, left), where left (n,) says that the box may hold a solution."""
        c = theta.mid
        rest, slopes = goal - self.family.values(z, Interval.exact(c)), self.family.slopes(z, theta)
        lo, hi, left = theta.lo.copy(), theta.hi.copy(), np.ones(len(c), dtype=bool)
        for i in range(rest.shape[1]):
            row = slopes[:, i]
            for j in range(c.shape[1]):
                others = [k for k in range(c.shape[1]) if k != j]
                apart = (row[:, others] * (Interval(lo[:, others], hi[:, others]) - c[:, others])).sum(-1)
                able = rest[:, i] - apart
                # A slope that may be 0 divides into the whole line; the row may be impossible all the same.
                reach = row[:, j] * (Interval(lo[:, j], hi[:, j]) - c[:, j])
                left &= (reach.lo <= able.hi) & (able.lo <= reach.hi)
                found = able / row[:, j] + c[:, j]
                least, most = np.maximum(lo[:, j], found.lo), np.minimum(hi[:, j], found.hi)
                left &= least <= most
                lo[:, j], hi[:, j] = np.where(left, least, lo[:, j]), np.where(left, most, hi[:, j])
        return lo, hi, left


def named(model: Model, names: Sequence[str] | Mapping[str, Any]) -> tuple[Parameter, ...]:
    """The model's parameters of these names; UsageError where there is none, or where the model is not equations."""
    known = {p.name: p for p in model.parameters}
    if unknown := [n for n in names if n not in known]:
        raise UsageError(f"controller.adapt: '{unknown[0]}' is no parameter; expected some of {', '.join(known) or 'none'}")
    kind = model.to_spec().get("kind")
    if kind != "equations":
        raise UsageError(
            f"controller.adapt: a model of kind {kind} says nothing about its range over values of {next(iter(names))}; "
            f"use kind: equations"
        )
    return tuple(known[n] for n in names)


def ranged(p: Parameter, asked: Any) -> tuple[float, float]:
    """[low, high], a tolerance around the stated value (`40 %`, or absolute), or None for the parameter's own tolerance."""
    try:
        if isinstance(asked, list | tuple):
            low, high = (magnitude(v, p.unit) for v in asked)
        else:
            by = p.tolerance if asked is None else _tolerance(p, asked)
            low, high = max(p.value - by, p.low), min(p.value + by, p.high)
    except ValueError as error:
        raise UsageError(f"controller.adapt.{p.name}: {error}") from None
    if not low < high or low < p.low or high > p.high:
        raise UsageError(
            f"controller.adapt.{p.name}: found {low:g} to {high:g} {p.unit}; expected a range of some width within "
            f"{p.low:g} to {p.high:g}"
        )
    return low, high


def _tolerance(p: Parameter, asked: float | str) -> float:
    if isinstance(asked, str) and asked.strip().endswith("%"):
        return abs(p.value) * float(asked.strip()[:-1]) / 100
    return magnitude(asked, p.unit)


def with_inputs(model: Model, parameters: Sequence[Parameter]) -> Model:
    """A model of kind equations whose last inputs are these of its parameters, in their units."""
    spec, names = model.to_spec(), {p.name for p in parameters}
    kept = {n: v for n, v in spec["parameters"].items() if n not in names}
    return built(spec | {"parameters": kept, "inputs": spec.get("inputs", {}) | {p.name: p.unit for p in parameters}})


def built(spec: Mapping[str, Any]) -> Model:
    """The model of a section."""
    known = registry()
    section: Any = known.config("model", spec["kind"])
    made: Model = known.build("model", spec["kind"], section.model_validate(spec))
    return made


def beside(z: Interval, theta: Interval) -> Interval:
    """Boxes (x, u, θ)."""
    return Interval(np.hstack([z.lo, theta.lo]), np.hstack([z.hi, theta.hi]))


def tiled(theta: Interval, count: int) -> Iterator[tuple[Array, Array]]:
    """(low, high), each (n, nθ): Θ (n, nθ) cut into `count` parts along each axis, one after the other."""
    share = np.linspace(0.0, 1.0, count + 1)
    edges = theta.lo[..., None] + (theta.hi - theta.lo)[..., None] * share
    edges = np.minimum(edges, theta.hi[..., None])
    edges[..., -1] = theta.hi
    axes = np.arange(theta.shape[1])
    for pick in product(range(count), repeat=theta.shape[1]):
        yield edges[:, axes, pick], edges[:, axes, np.array(pick) + 1]
