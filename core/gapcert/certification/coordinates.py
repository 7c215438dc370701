"""Inputs measured relative to the states: w = D u + C x in place of u, where a residual changes with the difference alone.

A bound per axis cannot see that a gap depends on u − v only: it charges for u and for v. In the coordinates (v, u − v) one of
the two charges vanishes. The map is linear and invertible, so uniform points stay uniform and every theorem holds as it stands.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from gapcert.contracts.data.inequality import substitution
from gapcert.contracts.gaps.gap import GapFunction
from gapcert.contracts.gaps.predictor import Predictor
from gapcert.contracts.systems.domain import Box, Domain, Relation
from gapcert.contracts.systems.scene import Scene
from gapcert.contracts.systems.system import Extension, Model, StateSpec, Step, System
from gapcert.numerics.arrays import Array
from gapcert.numerics.digest import json_digest
from gapcert.numerics.errors import UsageError
from gapcert.numerics.intervals import Interval

_SPARE = 1e-12  # of what is added up: more than it rounds by


@final
@dataclass(frozen=True)
class Coordinates:
    """w = scale · u + slope x, one row per input. axes: names and units of w; slope (nu, nx); scale (nu,), no zero."""

    axes: tuple[StateSpec, ...]
    texts: tuple[str, ...]
    slope: tuple[tuple[float, ...], ...]
    scale: tuple[float, ...]

    @classmethod
    def of(cls, system: System, given: Mapping[str, str]) -> Coordinates:
        """From texts such as `{dx: ux - vx}`: one for each input, each a sum of that input and of states."""
        states, inputs = ({a.name: a.unit for a in axes} for axes in (system.states, system.inputs))
        found, faults = substitution(given, states, inputs)
        for name, error in faults[:1]:
            example = f"such as d: {system.inputs[0].name} - {system.states[0].name}"
            raise UsageError(f"coordinates{name and f'.{name}'}: {error}; {example}")
        # In the order of the inputs, whatever order they were written in.
        rows = [found[a.name] for a in system.inputs]
        matrix = np.array([row for _, _, row in rows])
        return cls(
            tuple(StateSpec(name, unit) for name, unit, _ in rows),
            tuple(given[name] for name, _, _ in rows),
            tuple(tuple(r) for r in matrix[:, : system.nx].tolist()),
            tuple(np.diagonal(matrix[:, system.nx :]).tolist()),
        )

    def inputs(self, x: Array, w: Array) -> Array:
        """u (n, nu) of states (n, nx) and coordinates (n, nu)."""
        return np.asarray((w - _times(x, np.asarray(self.slope))) / np.asarray(self.scale))

    def inputs_over(self, z: Interval) -> Interval:
        """Boxes of (x, w) → boxes that contain (x, u), (n, nz)."""
        nx = len(self.slope[0])
        columns = [z[:, j : j + 1] for j in range(nx)]
        for i, row in enumerate(self.slope):
            u = z[:, nx + i : nx + i + 1]
            for j, c in enumerate(row):
                u = u - z[:, j : j + 1] * c if c else u
            columns.append(u * (1.0 / self.scale[i]) if abs(self.scale[i]) == 1 else _divided(u, self.scale[i]))
        return Interval.concatenate(columns, axis=1)

    def missed(self, z: Interval) -> Array:
        """(n, nz): what `inputs` rounds by at points of boxes of (x, w): of nx products and sums, and a division."""
        nx, scale = len(self.slope[0]), np.abs(self.scale)
        size = (z.mag[:, nx:] + z.mag[:, :nx] @ np.abs(self.slope).T) / scale
        return np.hstack([np.zeros((len(z), nx)), (nx + 3) * float(np.finfo(float).eps) * size])

    def over(self, z: Interval) -> Interval:
        """Boxes of (x, u) → boxes that contain (x, w), (n, nz)."""
        nx = len(self.slope[0])
        columns = [z[:, j : j + 1] for j in range(nx)]
        for i, row in enumerate(self.slope):
            w = z[:, nx + i : nx + i + 1] * self.scale[i]
            for j, c in enumerate(row):
                w = w + z[:, j : j + 1] * c if c else w
            columns.append(w)
        return Interval.concatenate(columns, axis=1)

    def arrays(self) -> dict[str, Array]:
        """The numbers of the map, for what is stored."""
        return {"slope_of_w": np.asarray(self.slope), "scale_of_w": np.asarray(self.scale)}

    def chain(self, jacobian: Interval) -> Interval:
        """∂/∂(x, u) (n, nx, nz) → ∂/∂(x, w) = (J_x − J_u D⁻¹ C, J_u D⁻¹)."""
        nx, across = len(self.slope[0]), list[Interval]()
        along = [jacobian[:, :, j] for j in range(nx)]
        for i, row in enumerate(self.slope):
            across.append(_divided(jacobian[:, :, nx + i], self.scale[i]))
            along = [c - across[i] * a if a else c for c, a in zip(along, row, strict=True)]
        return Interval.stack([*along, *across], axis=-1)

    def domain(self, domain: Domain) -> Domain:
        """The same set of points in (x, w): its box is the smallest that holds them, the ranges of u become relations."""
        relations = [self._moved(r) for r in (*domain.relations, *_ranges(domain))]
        low, high = np.array([self._range(domain, relations, i) for i in range(len(self.axes))]).T
        box = Box(self.axes, tuple(low.tolist()), tuple(high.tolist()))
        mag = np.array([*domain.states.low, *low]), np.array([*domain.states.high, *high])
        # What the box implies is no relation of its own.
        left = [r for r in relations if np.maximum(*(np.array(r.coefficients) * m for m in mag)).sum() > r.bound]
        return Domain(domain.states, box, tuple(left))

    def _moved(self, relation: Relation) -> Relation:
        a, nx = np.array(relation.coefficients), len(self.slope[0])
        across = a[nx:] / np.asarray(self.scale)
        moved = np.concatenate([a[:nx] - across @ np.asarray(self.slope), across])
        return Relation(relation.text, tuple((moved + 0.0).tolist()), relation.bound)

    def _range(self, domain: Domain, relations: Sequence[Relation], i: int) -> tuple[float, float]:
        """The least and the largest w_i on Z, rounded outwards."""
        from scipy.optimize import linprog

        row = np.zeros(len(domain.axes))
        row[: domain.nx], row[domain.nx + i] = self.slope[i], self.scale[i]
        bounds = list(zip(domain.low, domain.high, strict=True))
        a = np.array([r.coefficients for r in domain.relations]).reshape(-1, len(row))
        b = np.array([r.bound for r in domain.relations])
        ends = []
        for sign in (1.0, -1.0):
            found = linprog(sign * row, A_ub=a if len(a) else None, b_ub=b if len(b) else None, bounds=bounds)
            best = float(np.asarray(found.fun))
            pad = 1e-9 * float(np.abs(row) @ np.maximum(np.abs(domain.low), np.abs(domain.high)))
            own = np.zeros(len(row))
            own[domain.nx + i] = -sign
            # A relation that bounds this coordinate alone gives its end exactly.
            exact = [r.bound for r in relations if np.array_equal(r.coefficients, own) and -r.bound >= best - 2 * pad]
            ends.append(sign * (-exact[0] if exact else best - pad))
        return ends[0], ends[1]


def _times(x: Array, matrix: Array) -> Array:
    """x (n, nx) by matrixᵀ, summed axis by axis, so that a row's bits do not depend on its batch."""
    out = np.zeros((len(x), len(matrix)))
    for j in np.flatnonzero(matrix.any(axis=0)):
        out += x[:, j : j + 1] * matrix[:, j]
    return out


def _divided(x: Interval, by: float) -> Interval:
    return x * (1.0 / by) if abs(by) == 1 else x * Interval(np.nextafter(1.0 / by, -np.inf), np.nextafter(1.0 / by, np.inf))


def _ranges(domain: Domain) -> list[Relation]:
    """The box of u as relations."""
    out = []
    for i, (axis, low, high) in enumerate(zip(domain.inputs.axes, domain.inputs.low, domain.inputs.high, strict=True)):
        for sign, bound in ((1.0, high), (-1.0, -low)):
            a = np.zeros(len(domain.axes))
            a[domain.nx + i] = sign
            out.append(Relation(f"{axis.name} in [{low:g}, {high:g}]", tuple(a.tolist()), bound))
    return out


class _Relative:
    """What steps under u = (w − C x) / D."""

    inner: System

    def __init__(self, inner: System, coordinates: Coordinates) -> None:
        self.inner, self.relative = inner, coordinates
        self.states, self.inputs = inner.states, coordinates.axes
        self.period, self.substeps, self.capabilities = inner.period, inner.substeps, inner.capabilities
        self.hidden, self.hidden_default = inner.hidden, inner.hidden_default
        self.parameters, self.coordinates = inner.parameters, inner.coordinates

    def _step(self, x: Array, u: Array, **options: Any) -> Step:
        return self.inner.step(x, self.relative.inputs(x, u), **options)

    def resolution(self, magnitude: Array) -> Array:
        """Twice that of the System itself: u is rounded once more."""
        return np.asarray(2 * self.inner.resolution(magnitude))

    def repeats(self, angle: str) -> str | None:
        moves = any(row[[s.name for s in self.states].index(angle)] for row in self.relative.slope)
        return "the coordinates measure inputs relative to it" if moves else self.inner.repeats(angle)

    def digest(self) -> str:
        # The System says itself what determines its answers: caches and tiles do not.
        names = [a.name for a in self.inputs]
        return json_digest(type(self).__qualname__, self.inner.digest(), self.relative.slope, self.relative.scale, names)


@final
class RelativeSystem(_Relative, System):
    """A System whose input is w."""

    def scene(self, x: Array, hidden: Array | None = None) -> Scene | None:
        return self.inner.scene(x, hidden)


@final
class RelativeModel(_Relative, Model):
    """A Model whose input is w."""

    inner: Model

    def __init__(self, model: Model, coordinates: Coordinates) -> None:
        super().__init__(model, coordinates)
        self.outputs = model.outputs

    def jacobian(self, x: Array, u: Array) -> Array:
        j = Interval.exact(self.inner.jacobian(x, self.relative.inputs(x, u)))
        return np.asarray(self.relative.chain(j).mid)

    def enclosure(self, z: Interval) -> Interval:
        return self.inner.enclosure(self.relative.inputs_over(z))

    def jacobian_enclosure(self, z: Interval) -> Interval:
        return self.relative.chain(self.inner.jacobian_enclosure(self.relative.inputs_over(z)))

    def rounding_over(self, z: Interval) -> Array | None:
        """That of the Model over the inputs as they are computed, and what their rounding changes."""
        exact, missed = self.relative.inputs_over(z), self.relative.missed(z)
        near = Interval.around(exact.mid, exact.rad + missed)
        if (own := self.inner.rounding_over(near)) is None:
            return None
        return np.asarray(own + (self.inner.jacobian_enclosure(near).mag @ missed[..., None])[..., 0])

    def output(self, x: Array, u: Array, parameters: Any = None, hidden: Array | None = None) -> Array:
        return self.inner.output(x, self.relative.inputs(x, u), parameters, hidden)

    def extend(self, extensions: Sequence[Extension]) -> Model:
        return RelativeModel(self.inner.extend(extensions), self.relative)

    def equations(self) -> str:
        told = (f"{a.name} = {text}" for a, text in zip(self.relative.axes, self.relative.texts, strict=True))
        return "\n".join([self.inner.equations(), *told])

    def to_spec(self) -> dict[str, Any]:
        return self.inner.to_spec()

    def sites(self, kind: str) -> tuple[str, ...]:
        return self.inner.sites(kind)


def in_words(model: Model, domain: Domain) -> str:
    """The box of a domain, range by range, with what its coordinates stand for."""
    relative = model.relative if isinstance(model, RelativeModel) else None
    texts = {a.name: f" = {text}" for a, text in zip(relative.axes, relative.texts, strict=True)} if relative else {}
    axes = zip(domain.axes, domain.low, domain.high, strict=True)
    return ", ".join(f"{a.name}{texts.get(a.name, '')} in [{x:g}, {y:g}] {a.unit}".removesuffix(" 1") for a, x, y in axes)


@final
class RelativePredictor(Predictor):
    """p of (x, w), asked at points and boxes of (x, u)."""

    def __init__(self, predictor: Predictor, coordinates: Coordinates) -> None:
        self.inner, self.relative, self.kind = predictor, coordinates, predictor.kind

    def __call__(self, z: Array) -> Array:
        return self.inner(self.relative.over(Interval.exact(z)).mid)

    def over(self, boxes: Interval) -> Interval:
        return self.inner.over(self.relative.over(boxes))

    def jacobian_over(self, boxes: Interval) -> Interval:
        """(J_x + J_w C, J_w D)."""
        inner, nx = self.inner.jacobian_over(self.relative.over(boxes)), len(self.relative.slope[0])
        along, across = [inner[:, :, j] for j in range(nx)], [inner[:, :, nx + i] for i in range(len(self.relative.axes))]
        for c, row in zip(across, self.relative.slope, strict=True):
            along = [b + c * a if a else b for b, a in zip(along, row, strict=True)]
        return Interval.stack([*along, *(c * d for c, d in zip(across, self.relative.scale, strict=True))], axis=2)

    def resolution(self, domain: Domain) -> Array:
        boxes = self.relative.over(domain.interval)
        x, u = np.split(domain.interval.mag[0], [-len(self.relative.axes)])
        # w is the middle of an interval to which each of its products and sums, nx + 1 at most, adds two roundings.
        size = np.abs(self.relative.slope) @ x + np.abs(self.relative.scale) * u
        missed = 4 * (len(x) + 1) * float(np.finfo(float).eps) * size
        slope = self.inner.jacobian_over(boxes).mag[0, :, len(x) :]
        return np.asarray(self.inner.error_over(boxes) + slope @ missed)

    def arrays(self) -> dict[str, Array]:
        return {**self.relative.arrays(), **self.inner.arrays()}


@final
class RelativeGap(GapFunction):
    """A gap function of (x, w), asked at points and boxes of (x, u)."""

    def __init__(self, gap: GapFunction, coordinates: Coordinates) -> None:
        self.inner, self.relative, self.family = gap, coordinates, gap.family
        self.predictor = None if gap.predictor is None else RelativePredictor(gap.predictor, coordinates)

    def interval(self, z: Array) -> tuple[Array, Array]:
        # The box of the rounded coordinates contains the exact ones.
        found = self.inner.interval_over(self.relative.over(Interval.exact(z)))
        return found.lo, found.hi

    def interval_over(self, boxes: Interval) -> Interval:
        return self.inner.interval_over(self.relative.over(boxes))

    def remainder_ends_over(self, boxes: Interval) -> tuple[Interval, Interval]:
        if self.predictor is None:
            return self.ends_over(boxes)
        low, high = self.inner.remainder_ends_over(self.relative.over(boxes))
        # `interval` bounds the band over the box of the rounded coordinates, which rounds in these sizes.
        size = self.predictor.over(boxes).mag + np.maximum(low.mag, high.mag)
        pad = _SPARE * size + 2 * self.predictor.error_over(boxes)
        return Interval(low.lo - pad, low.hi + pad), Interval(high.lo - pad, high.hi + pad)

    def gamma_of(self, boxes: Interval, i: int) -> Array:
        return self.inner.gamma_of(self.relative.over(boxes), i)

    def lipschitz(self, boxes: Interval) -> Array:
        inner = self.inner.lipschitz(self.relative.over(boxes))
        nx, slope, scale = boxes.lo.shape[1] - len(self.relative.axes), self.relative.slope, self.relative.scale
        x, w = inner[:, :, :nx], inner[:, :, nx:]
        # |Δw| ≤ |D| |Δu| + |C| |Δx|.
        return np.concatenate([x + w @ np.abs(slope), w * np.abs(scale)], axis=2) * (1 + 1e-12)

    def arrays(self) -> dict[str, Array]:
        return {**self.relative.arrays(), **self.inner.arrays()}

    @property
    def form(self) -> Mapping[str, Any]:
        return {"form": "relative", "inner": dict(self.inner.form)}
