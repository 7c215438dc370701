"""The contracts of gap families and of Lipschitz estimators, as named checks on fields whose constants are known."""

from __future__ import annotations

import io
import json
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import ClassVar, cast, get_args

import numpy as np

from gapcert.plugin import (
    AffinePredictor,
    Array,
    FitRoute,
    GapFamily,
    GapFunction,
    GapProblem,
    Interval,
    LipschitzBound,
    LipschitzEstimator,
    LipschitzProblem,
    Provenance,
    expect,
)

from .excess import excess
from .fields import Field, Kink, Waves, gap_problem, lattice, lipschitz_problem

FORMS = ("envelope", "constant", "basis", "dominating", "network", "multilinear")


class GapFamilyContract(ABC):
    """Subclass in a test module as `Test…` and supply `family`: pytest then runs every `test_…` below on it.

    `field` and `problem` say what it is fitted to (defaults: smooth waves in two states and one input with their exact
    constants, and every route that the family declares).
    """

    points = 2_000
    cells = 100
    _fitted: ClassVar[list[tuple[GapProblem, GapFunction]]]

    @abstractmethod
    def family(self) -> GapFamily:
        """A new family, built as a user would build it."""

    def field(self) -> Field:
        """Two states and one input, named x0, x1 and u0."""
        return Waves.smooth()

    def problem(self, route: FitRoute) -> GapProblem:
        """What the family is fitted to on a route."""
        counts = (16, 16, 16) if route == "theorem1" else (6, 6, 6)
        affine = route == "dominate" and self.family().predictor == "affine"
        return gap_problem(self.field(), counts, route=route, affine=affine)

    def test_declares_itself(self) -> None:
        f = self.family()
        expect(isinstance(f.name, str) and bool(f.name), f"name is {f.name!r}; expected the component's name")
        expect(
            bool(f.routes) and set(f.routes) <= set(get_args(FitRoute)),
            f"routes are {f.routes}; expected some of {get_args(FitRoute)}",
        )
        for problem, gap in self._fits():
            expect(gap.family == f.name, f"on route {problem.route} it made a gap function of family {gap.family!r}")

    def test_shapes_and_order(self) -> None:
        for problem, gap in self._fits():
            z = self._fresh(problem)
            low, high = gap.interval(z)
            shape = (len(z), problem.domain.nx)
            expect(low.shape == high.shape == shape, f"interval has shapes {low.shape} and {high.shape}; expected {shape}")
            expect(low.dtype == high.dtype == np.float64, f"interval is {low.dtype} and {high.dtype}; expected float64")
            expect(bool(np.isfinite(low).all() and np.isfinite(high).all()), "interval is not finite")
            expect(bool((low <= high).all()), "l lies above u")

    def test_gamma_is_the_larger_side(self) -> None:
        for problem, gap in self._fits():
            z = self._fresh(problem)
            low, high = gap.interval(z)
            gamma = gap.gamma(z)
            expect(bool((gamma >= 0).all()), "γ is negative")
            expect(np.array_equal(gamma, np.maximum(np.abs(low), np.abs(high))), "γ is not max(|l|, |u|)")

    def test_holds_on_its_samples(self) -> None:
        for problem, gap in self._fits():
            s = problem.samples
            low, high = gap.interval(s.z)
            expect(bool((np.abs(s.r) <= gap.gamma(s.z)).all()), f"route {problem.route}: γ lies below |r| on a sample")
            expect(bool(((low <= s.r) & (s.r <= high)).all()), f"route {problem.route}: a sample lies outside [l, u]")

    def test_never_below_the_truth(self) -> None:
        for problem, gap in self._fits():
            z = np.concatenate([self._fresh(problem, 20_000), lattice(problem.domain, (3, 3, 3))])
            r, (low, high) = self.field()(z), gap.interval(z)
            outside = ((r < low) | (r > high)).any(axis=1)
            expect(
                not outside.any(), f"route {problem.route}: r leaves [l, u] at {int(outside.sum())} of {len(z)} fresh points"
            )

    def test_interval_over_holds_in_boxes(self) -> None:
        for problem, gap in self._fits():
            boxes = self._boxes(problem)
            over = gap.interval_over(boxes)
            for z in _inside(boxes):
                low, high = gap.interval(z)
                inside = (over.lo <= low) & (high <= over.hi)
                expect(bool(inside.all()), "interval_over does not contain [l, u] at a point of its box")
            self._tight(problem, gap)
            self._remainder(problem, gap)

    def test_lipschitz_holds_in_boxes(self) -> None:
        for problem, gap in self._fits():
            boxes = self._boxes(problem)
            slope = gap.lipschitz(boxes)
            shape = (len(boxes), problem.domain.nx, boxes.shape[1])
            expect(slope.shape == shape, f"lipschitz has shape {slope.shape}; expected {shape}")
            corners = list(_inside(boxes))
            for a, b in pairwise(corners):
                change = np.abs(gap.gamma(a) - gap.gamma(b))
                allowed = (slope * np.abs(a - b)[:, None, :]).sum(axis=2) + 1e-13 * (gap.gamma(a) + gap.gamma(b))
                expect(bool((change <= allowed).all()), "γ changes by more than lipschitz allows within a box")

    def test_majorant_holds_in_boxes(self) -> None:
        for problem, gap in self._fits():
            boxes = self._boxes(problem)[::20]
            c, a = gap.majorant_over(boxes, 24 * len(boxes))
            shapes = (len(boxes), problem.domain.nx), (len(boxes), problem.domain.nx, boxes.shape[1])
            expect((c.shape, a.shape) == shapes, f"majorant_over has shapes {c.shape} and {a.shape}; expected {shapes}")
            expect(bool((c >= 0).all() and (a >= 0).all()), "the affine majorant has a negative coefficient")
            for z in _inside(boxes):
                most = c + (a * np.abs(z)[:, None, :]).sum(axis=2)
                expect(bool((gap.gamma(z) <= most).all()), "γ lies above its affine majorant in a box")
            z = np.linspace(boxes.lo, boxes.hi, 101)
            mean = c + (a * np.abs(z).mean(axis=0)[:, None, :]).sum(axis=2)
            expect(
                bool((mean <= gap.gamma_over(boxes) * 1.01).all()), "the affine majorant lies above a constant one on average"
            )

    def test_batch_equals_singles(self) -> None:
        for problem, gap in self._fits():
            z = self._fresh(problem)
            low, high = gap.interval(z)
            order = np.random.default_rng(2).permutation(len(z))
            expect(_same(gap.interval(z[order]), (low[order], high[order])), "rows in another order gave other bits")
            for k in range(0, len(z), max(1, len(z) // 16)):
                expect(
                    _same(gap.interval(z[k : k + 1]), (low[k : k + 1], high[k : k + 1])), f"row {k} asked alone gave other bits"
                )

    def test_fit_is_deterministic(self) -> None:
        for problem, gap in self._fits():
            again = self.family().fit(self.problem(cast(FitRoute, problem.route))).arrays()
            first = gap.arrays()
            expect(first.keys() == again.keys(), "a second fit stores other arrays")
            expect(all(np.array_equal(first[k], again[k]) for k in first), "a second fit gave other numbers")

    def test_fit_changes_nothing(self) -> None:
        for route in self.family().routes:
            problem = self.problem(route)
            s = problem.samples
            before = s.z.copy(), s.r.copy(), problem.lipschitz.value.copy()
            self.family().fit(problem).interval(s.z)
            expect(_same((s.z, s.r, problem.lipschitz.value), before), "fit or interval changed an array of its problem")

    def test_form_and_arrays_are_data(self) -> None:
        for _, gap in self._fits():
            form, arrays = dict(gap.form), gap.arrays()
            expect(json.loads(json.dumps(form)) == form, "form does not survive JSON: use lists, numbers, strings and mappings")
            expect(form.get("form") in FORMS, f"form is {form.get('form')!r}; verification knows {FORMS}")
            with io.BytesIO() as file:
                np.savez(file, allow_pickle=False, **arrays)
                file.seek(0)
                stored = dict(np.load(file, allow_pickle=False))
            expect(all(np.array_equal(stored[k], v) for k, v in arrays.items()), "arrays do not survive saving")

    def _fits(self) -> Iterator[tuple[GapProblem, GapFunction]]:
        """Once for all checks of a class: whether a second fit gives the same has a check of its own."""
        cls = type(self)
        if "_fitted" not in vars(cls):
            cls._fitted = [(p, self.family().fit(p)) for p in map(self.problem, self.family().routes)]
        yield from cls._fitted

    def _remainder(self, problem: GapProblem, gap: GapFunction) -> None:
        """Without p, which is known, the band lies within its own bounds, and the range of p does not widen them."""
        if gap.predictor is None or gap.predictor.kind == "none":
            return
        boxes = self._boxes(problem)
        over = gap.remainder_over(boxes)
        for z in _inside(boxes):
            low, high = (end - gap.predictor(z) for end in gap.interval(z))
            inside = (over.lo <= low) & (high <= over.hi)
            expect(bool(inside.all()), "remainder_over does not contain [l − p, u − p] at a point of its box")
        self._tight(problem, gap, remainder=True)

    def _tight(self, problem: GapProblem, gap: GapFunction, remainder: bool = False) -> None:
        """On cells an eighth as wide the bound is closer by far more than an eighth: a constant times a radius is not."""
        domain, rng = problem.domain, np.random.default_rng(5)
        low, found = domain.low + 0.9 * domain.width * rng.random((self.cells, len(domain.low))), []
        for part in (0.05, 0.05 / 8):
            beyond = excess(gap, Interval(low, low + part * domain.width), remainder=remainder)
            scale = gap.gamma(low).max()
            name = "remainder_over" if remainder else "interval_over"
            expect(bool((beyond >= -1e-9 * scale).all()), f"{name} does not contain the band at a point of its box")
            found.append(float(beyond.mean() / scale))
        expect(
            found[1] <= max(found[0] / 12, 3e-5),
            f"{name} lies {found[0]:.2g} of γ beyond what is reached in small boxes, and {found[1]:.2g} in boxes an eighth as "
            f"wide; expected a twelfth or less: use slopes over the box, not a constant times its radius, nor the range of p",
        )

    def _fresh(self, problem: GapProblem, n: int | None = None) -> Array:
        return problem.domain.draw(n or self.points, np.random.default_rng(3))

    def _boxes(self, problem: GapProblem) -> Interval:
        """Random boxes inside the domain, from wide to narrow, and points."""
        rng, domain = np.random.default_rng(4), problem.domain
        a = domain.draw(60, rng)
        size = domain.width * rng.random(a.shape) * np.repeat([0.5, 0.05, 0.001, 0.0], 15)[:, None]
        return Interval(a, np.minimum(a + size, domain.high))


class LipschitzContract(ABC):
    """Subclass in a test module as `Test…` and supply `estimator`: pytest then runs every `test_…` below on it.

    `field` is a white box with known constants (default: two states and one input, named x0, x1, u0, with kinks).
    """

    @abstractmethod
    def estimator(self) -> LipschitzEstimator:
        """A new estimator, built as a user would build it."""

    def field(self) -> Field:
        return Kink(np.array([[0.5, 0.25, 0.125], [0.0, 1.0, 0.5]]), np.array([0.1, -0.3, 0.2]))

    def problem(self, seed: int = 0) -> LipschitzProblem:
        return lipschitz_problem(self.field(), seed=seed)

    def test_shape_and_numbers(self) -> None:
        bound, problem = self._bound(), self.problem()
        shape = (problem.domain.nx, len(problem.domain.low))
        expect(
            bound.value.shape == bound.lower.shape == shape,
            f"shapes {bound.value.shape}, {bound.lower.shape}; expected {shape}",
        )
        for name, v in (("value", bound.value), ("lower", bound.lower)):
            expect(bool(np.isfinite(v).all() and (v >= 0).all()), f"{name} is negative or not finite: {v.tolist()}")

    def test_provenance_is_stated(self) -> None:
        bound, stated = self._bound(), self.estimator().provenance
        expect(
            bound.provenance in get_args(Provenance),
            f"provenance is {bound.provenance!r}; expected one of {get_args(Provenance)}",
        )
        expect(bound.provenance == stated, f"the bound's provenance is {bound.provenance}, its estimator's {stated}")
        expect(bool(bound.method), "method is empty; say how the constants were found")

    def test_value_is_not_below_lower(self) -> None:
        bound = self._bound()
        expect(bool((bound.value >= bound.lower).all()), "value lies below a slope that was proved")

    def test_lower_is_proved(self) -> None:
        lower, truth = self._bound().lower, self.field().constants
        expect(bool((lower <= truth).all()), f"lower = {lower.tolist()} exceeds the true constants {truth.tolist()}")

    def test_bounds_hold(self) -> None:
        """What is no estimate holds for every pair of points, and is at least the exact constant."""
        bound, problem = self._bound(), self.problem()
        if bound.provenance == "estimated":
            return
        rng = np.random.default_rng(8)
        a, b = problem.domain.draw(5_000, rng), problem.domain.draw(5_000, rng)
        r = self.field()
        change, allowed = np.abs(r(a) - r(b)), np.abs(a - b) @ bound.value.T + 4 * problem.resolution
        expect(bool((change <= allowed).all()), "two points differ by more than the constants allow")
        expect(bool((bound.value >= self.field().constants * (1 - 1e-12)).all()), "a constant lies below the true one")

    def test_predictor_is_subtracted(self) -> None:
        """Subtracting a slope that r does not have must change the constants (of what is not simply declared)."""
        slope = np.array([[0.7, -0.2, 0.3], [0.1, 0.4, -0.6]])
        plain = self.problem()
        shifted = replace(plain, predictor=AffinePredictor(np.zeros(2), slope))
        first, second = self._bound(), self.estimator().bound(shifted)
        if first.provenance == "declared":
            return
        expect(not np.allclose(first.value, second.value), "the predictor changes nothing: bound r − p, not r")

    def test_queries_are_counted(self) -> None:
        asked: list[Array] = []
        plain = self.problem()

        def query(name: str, z: Array) -> Array:
            asked.append(z)
            return plain.query(name, z)

        bound = self.estimator().bound(replace(plain, query=query))
        total = sum(len(z) for z in asked)
        expect(bound.samples == total, f"samples is {bound.samples}; {total} transitions were asked for")
        expect(all(plain.domain.contains(z).all() for z in asked), "a query lies outside the domain")

    def test_rounds_have_names(self) -> None:
        names: list[str] = []
        plain = self.problem()

        def query(name: str, z: Array) -> Array:
            names.append(name)
            return plain.query(name, z)

        self.estimator().bound(replace(plain, query=query))
        expect(len(names) == len(set(names)), f"two rounds have one name: {names}; a resumed run could not tell them apart")

    def test_deterministic_by_seed(self) -> None:
        a, b = (self.estimator().bound(self.problem(5)) for _ in range(2))
        expect(np.array_equal(a.value, b.value) and np.array_equal(a.lower, b.lower), "the same seed gave other constants")

    def test_diagnostics_are_data(self) -> None:
        diagnostics = dict(self._bound().diagnostics)
        expect(json.loads(json.dumps(diagnostics)) == diagnostics, "diagnostics do not survive JSON")

    def _bound(self) -> LipschitzBound:
        return self.estimator().bound(self.problem())


def _inside(boxes: Interval) -> Iterator[Array]:
    """Corners and random points, one of each box at a time."""
    rng = np.random.default_rng(6)
    yield boxes.lo
    yield boxes.hi
    yield boxes.mid
    for _ in range(6):
        yield np.clip(boxes.lo + rng.random(boxes.shape) * (boxes.hi - boxes.lo), boxes.lo, boxes.hi)


def _same(a: tuple[Array, ...], b: tuple[Array, ...]) -> bool:
    return all(x.tobytes() == y.tobytes() for x, y in zip(a, b, strict=True))
