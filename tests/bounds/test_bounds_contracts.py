"""Each check of the contracts of bounds passes on an honest plugin, and fails on the fault that it is there for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import gapcert as gc
from gapcert.contracts.gaps.gap import GapFamily, GapFunction
from gapcert.contracts.gaps.lipschitz import LipschitzBound, LipschitzEstimator
from gapcert.testing import GapFamilyContract, LipschitzContract
from gapcert_bounds.testing.fields import gap_problem


class Cone(GapFunction):
    """γ of one sample: |g| + Σ L |Δ| + 2 e around a centre."""

    family = "cone"

    def __init__(self, z, r, slope, e):
        self.z, self.r, self.slope, self.e = z, r, slope, e

    def interval(self, z):
        reach = (np.abs(z - self.z)[:, None, :] * self.slope).sum(axis=2) + 2 * self.e + 1e-12
        return self.r - reach, self.r + reach

    def interval_over(self, boxes):
        low, high = self.interval(boxes.mid)
        reach = (boxes.rad[:, None, :] * self.slope).sum(axis=2) + 1e-12
        return gc.Interval(low - reach, high + reach)

    def lipschitz(self, boxes):
        return np.broadcast_to(self.slope * (1 + 1e-9), (len(boxes), *self.slope.shape)).copy()

    def arrays(self):
        return {"z": self.z, "r": self.r}

    @property
    def form(self):
        return {"form": "envelope", "predictor": "none"}


class ConeFamily(GapFamily):
    name, routes = "cone", ("dominate",)
    made = Cone

    def fit(self, problem):
        z, r = problem.samples.z, problem.samples.r
        k = len(z) // 2
        return self.made(z[k], r[k], problem.lipschitz.value, problem.resolution)


class Base(GapFamilyContract):
    points = 200
    chosen = ConeFamily

    def family(self):
        return self.chosen()


class TestHonestFamily(Base):
    pass


class Misnamed(ConeFamily):
    name = "cones"


class UnknownRoute(ConeFamily):
    routes = ("by-luck",)


def made(**methods):
    return type("Faulty", (ConeFamily,), {"made": type("FaultyCone", (Cone,), methods)})


def batched(self, z):
    low, high = Cone.interval(self, z)
    return low, high + 1e-9 * len(z)


def swapped(self, z):
    low, high = Cone.interval(self, z)
    return high, low


def single(self, z):
    low, high = Cone.interval(self, z)
    return low.astype(np.float32), high.astype(np.float32)


def too_low(self, z):
    low, high = Cone.interval(self, z)
    return low, self.r + 0.2 * (high - self.r)


def short_of_samples(self, z):
    return -0.1 * np.ones((len(z), 2)), 0.1 * np.ones((len(z), 2))


def grabs_absolute(self, z):
    low, high = Cone.interval(self, z)
    return np.maximum(np.abs(low), np.abs(high)) * 1.01


class Drifts(ConeFamily):
    calls = 0

    def fit(self, problem):
        type(self).calls += 1
        gap = super().fit(problem)
        gap.r = gap.r + 1e-9 * type(self).calls
        return gap


class Vandal(ConeFamily):
    def fit(self, problem):
        gap = super().fit(problem)
        gap.z, gap.r = gap.z.copy(), gap.r.copy()
        problem.samples.r[0] += 1.0
        return gap


def times_radius(self, boxes):
    low, high = self.interval(boxes.mid)
    reach = 3 * (boxes.rad[:, None, :] * self.slope).sum(axis=2) + 1e-12
    return gc.Interval(low - reach, high + reach)


CENTRE_ONLY = {"interval_over": lambda self, boxes: gc.Interval(*self.interval(boxes.mid))}
KNOWN = {"predictor": gc.plugin.AffinePredictor(np.zeros(2), np.array([[0.4, -0.3, 0.2], [0.1, 0.5, -0.2]]))}
CENTRE_OF_REMAINDER = {
    **KNOWN,
    "remainder_over": lambda self, boxes: gc.Interval(*(end - self.predictor(boxes.mid) for end in self.interval(boxes.mid))),
}
NOT_SUBTRACTED = {**KNOWN, "remainder_ends_over": lambda self, boxes: self.ends_over(boxes)}


def constant(factor, slope=0.0):
    """The constant majorant times a factor."""

    def majorant_over(self, boxes, cells=0):
        c = factor * self.gamma_over(boxes)
        return c, np.full((*c.shape, boxes.shape[1]), slope)

    return {"majorant_over": majorant_over}


FLAT_MAJORANT = {"majorant_over": lambda self, boxes, cells: (self.gamma(boxes.mid), np.zeros((*boxes.shape[:1], 2, 3)))}

FAMILY_FAULTS = {
    "test_declares_itself": [Misnamed, UnknownRoute],
    "test_shapes_and_order": [made(interval=swapped), made(interval=single)],
    "test_gamma_is_the_larger_side": [made(gamma=grabs_absolute)],
    "test_holds_on_its_samples": [made(interval=short_of_samples)],
    "test_never_below_the_truth": [made(interval=too_low), made(interval=short_of_samples)],
    # KNOWN: by default the range of a predictor enters, and no family with one may leave it at that.
    "test_interval_over_holds_in_boxes": [
        *(made(**m) for m in (CENTRE_ONLY, CENTRE_OF_REMAINDER, KNOWN, NOT_SUBTRACTED)),
        made(interval_over=times_radius),
    ],
    "test_lipschitz_holds_in_boxes": [made(lipschitz=lambda self, b: Cone.lipschitz(self, b) * 0.99)],
    "test_majorant_holds_in_boxes": [made(**m) for m in (FLAT_MAJORANT, constant(1.1), constant(5.0, -0.01))],
    "test_batch_equals_singles": [made(interval=batched)],
    "test_fit_is_deterministic": [Drifts],
    "test_fit_changes_nothing": [Vandal],
    "test_form_and_arrays_are_data": [
        made(form=property(lambda self: {"form": "envelope", "z": (1, 2)})),
        made(form=property(lambda self: {"form": "secret"})),
        made(arrays=lambda self: {"z": np.array([None])}),
    ],
}


class Slopes(LipschitzEstimator):
    """The exact constants, with slopes between a few random points as what was seen."""

    provenance = "estimated"

    def bound(self, problem):
        rng = np.random.default_rng(problem.seed)
        z = problem.domain.draw(200, rng)
        step = z.copy()
        step[:, 0] = problem.domain.low[0]
        g = problem.remainder("pairs", np.concatenate([z, step]))
        change = np.maximum(np.abs(g[:200] - g[200:]) - 4 * problem.resolution, 0)
        lower = np.zeros((problem.domain.nx, z.shape[1]))
        lower[:, 0] = (change / np.abs(z[:, :1] - step[:, :1])).max(axis=0) * (1 - 1e-9)
        value = np.full_like(lower, 3.0) + lower
        return LipschitzBound(value, lower, self.provenance, "slopes", samples=400)


class EstimatorBase(LipschitzContract):
    chosen = Slopes

    def estimator(self):
        return self.chosen()


class TestHonestEstimator(EstimatorBase):
    pass


class Proved(Slopes):
    """As `Slopes`, but claiming a proof."""

    provenance = "analytic"


class TestHonestProof(EstimatorBase):
    chosen = Proved


def estimator(base=Slopes, **changes):
    class Faulty(base):
        def bound(self, problem):
            bound = base.bound(self, problem)
            return replace(bound, **{k: change(bound) for k, change in changes.items()})

    return Faulty


class Mislabelled(Slopes):
    def bound(self, problem):
        return replace(super().bound(problem), provenance="declared")


class OutsideDomain(Slopes):
    def bound(self, problem):
        problem.query("far", problem.domain.high[None] + 1)
        return replace(super().bound(problem), samples=401)


class SameRound(Slopes):
    def bound(self, problem):
        problem.query("pairs", problem.domain.high[None])
        return replace(super().bound(problem), samples=401)


class IgnoresPredictor(Slopes):
    def bound(self, problem):
        return super().bound(replace(problem, predictor=gc.plugin.AffinePredictor.none(2, 3)))


class Unseeded(Slopes):
    calls = 0

    def bound(self, problem):
        type(self).calls += 1
        return super().bound(replace(problem, seed=type(self).calls))


class Endless(Slopes):
    def bound(self, problem):
        bound = super().bound(problem)
        object.__setattr__(bound, "value", np.full((2, 3), np.inf))
        return bound


ESTIMATOR_FAULTS = {
    "test_shape_and_numbers": [Endless, estimator(value=lambda b: b.value[:, :2])],
    "test_provenance_is_stated": [Mislabelled, estimator(method=lambda b: ""), estimator(provenance=lambda b: "guessed")],
    "test_value_is_not_below_lower": [estimator(value=lambda b: b.lower * 0.9)],
    "test_lower_is_proved": [estimator(lower=lambda b: b.lower + 1.0)],
    "test_bounds_hold": [estimator(Proved, value=lambda b: b.lower * 0.5), estimator(Proved, value=lambda b: b.lower)],
    "test_predictor_is_subtracted": [IgnoresPredictor],
    "test_queries_are_counted": [estimator(samples=lambda b: 7), OutsideDomain],
    "test_rounds_have_names": [SameRound],
    "test_deterministic_by_seed": [Unseeded],
    "test_diagnostics_are_data": [
        estimator(diagnostics=lambda b: {"at": np.zeros(2)}),
        estimator(diagnostics=lambda b: {1: 2}),
    ],
}


def test_every_check_has_a_planted_fault():
    for contract, faults in ((GapFamilyContract, FAMILY_FAULTS), (LipschitzContract, ESTIMATOR_FAULTS)):
        assert {n for n in vars(contract) if n.startswith("test_")} == set(faults)


CASES = [
    (base, check, faulty)
    for base, faults in ((Base, FAMILY_FAULTS), (EstimatorBase, ESTIMATOR_FAULTS))
    for check, classes in faults.items()
    for faulty in classes
]


@pytest.mark.parametrize(("base", "check", "faulty"), CASES, ids=[f"{c}-{k}" for k, (_, c, _) in enumerate(CASES)])
def test_faults_are_caught(base, check, faulty):
    contract = type("Planted", (base,), {"chosen": faulty})()
    with pytest.raises((AssertionError, ValueError, TypeError)):
        getattr(contract, check)()


def test_supremum_of_a_gap_with_nothing_in_it():
    problem = gap_problem(TestHonestFamily().field(), (3, 3, 3))
    gap = ConeFamily().fit(problem)
    upper, lower = gc.plugin.supremum(gap, problem.domain, tolerance=1e-2)
    assert (lower <= upper).all()
    assert (upper <= 1.01 * lower).all()
    assert (gap.gamma(problem.domain.draw(10_000, np.random.default_rng(0))) <= upper).all()
