"""Residuals that jump: cells are marked where they do and nowhere else, and the band holds because of their jumps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rough_fields import Contact, bounce, slide, stick, stop

import gapcert as gc
from gapcert.certification.refutation import contradiction
from gapcert.certification.samples.designs import AdaptiveSampling
from gapcert.contracts.gaps.lipschitz import Residual
from gapcert.contracts.gaps.predictor import Samples
from gapcert_bounds.constants.piecewise import Piecewise
from gapcert_bounds.constants.wood_zhang import WoodZhang
from gapcert_bounds.families.constant import Constant
from gapcert_bounds.families.envelope import Envelope
from gapcert_bounds.testing.fields import Field, Kink, Nothing, Waves, lipschitz_problem

ABS = Kink(np.array([[0.5, 0.25, 0.125], [0.3, 1.0, 0.5]]), np.array([0.11, -0.3, 0.2]))


def fitted(field: Field, estimator, seed=0):
    """What `certify` makes of a field: samples, an affine predictor, constants, and more samples for them."""
    residual, domain, plan = Residual(field, Nothing(field)), field.domain, AdaptiveSampling(300)
    z = plan.first(domain).z
    p = gc.plugin.AffinePredictor.fit(Samples(z, residual(z)))
    bound = estimator.bound(lipschitz_problem(field, predictor=p, seed=seed))
    if bound.cells is None:
        further = plan.further(domain, z, residual(z), bound.value)
    else:
        further = bound.cells.points(domain, residual(z), 300 - len(z))
    z = np.concatenate([z, further])
    return gc.plugin.GapProblem(Samples(z, residual(z)), domain, bound, p, residual.resolution(domain), "dominate")


@pytest.fixture(scope="module")
def problems():
    cells = {bounce: 128, slide: 128, stop: 256}
    return {law.__name__: fitted(Contact(law), Piecewise(cells=most)) for law, most in cells.items()}


def fresh(field, n=100_000, seed=1):
    z = field.domain.draw(n, np.random.default_rng(seed))
    return z, field(z)


def outside(gap, z, r):
    low, high = gap.interval(z)
    return int(((r < low) | (r > high)).any(axis=1).sum())


@pytest.mark.exam
@pytest.mark.parametrize(("law", "tightness"), [(bounce, 1.2), (slide, 1.05), (stop, 1.7)])
def test_the_band_holds_on_fresh_points_and_is_tight(problems, law, tightness):
    problem, (z, r) = problems[law.__name__], fresh(Contact(law))
    gap = Envelope().fit(problem)
    assert outside(gap, z, r) == 0
    assert contradiction(problem) is None
    assert (gap.gamma(z).mean(axis=0) <= tightness * np.abs(r).mean(axis=0)).all()


def across(law, boxes):
    """(m,): does the law jump within the closed box? Told by its own formula, on corners and random points."""
    guard = {
        "bounce": lambda z: z[:, 0] + 1 + 0.3 * (z[:, 1] + 0.3 * (0.3 * z[:, 2] - 1)),
        "slide": lambda z: z[:, 1],
        "stop": lambda z: np.minimum(z[:, 0] - 0.5, z[:, 1] - 0.6),
    }[law.__name__]
    rng = np.random.default_rng(5)
    values = [guard(boxes.lo + t * (boxes.hi - boxes.lo)) for t in (0, 1, *(rng.integers(0, 2, (80, 3))), *rng.random((80, 3)))]
    return (np.min(values, axis=0) <= 1e-4) & (np.max(values, axis=0) >= -1e-4)


@pytest.mark.exam
@pytest.mark.parametrize("law", [bounce, slide, stop])
def test_cells_are_marked_only_where_something_jumps(problems, law):
    cells = problems[law.__name__].lipschitz.cells
    assert cells.marked.any()
    assert not (cells.marked & ~across(law, cells.boxes)).any()
    assert cells.volume[cells.marked].sum() < 0.07
    assert cells.volume.sum() == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("law", [slide, stop])
def test_no_cell_that_jumps_is_missed(problems, law):
    cells = problems[law.__name__].lipschitz.cells
    assert not (~cells.marked & across(law, gc.Interval(cells.boxes.lo + 1e-3, cells.boxes.hi - 1e-3))).any()


@pytest.mark.exam
@pytest.mark.parametrize("field", [ABS, Waves.smooth(), Contact(stick)], ids=["kink", "smooth", "sticking"])
def test_nothing_is_marked_where_nothing_jumps(field):
    problem = fitted(field, Piecewise())
    assert not problem.lipschitz.cells.marked.any()
    assert len(problem.lipschitz.cells) > 1
    z, r = fresh(field)
    gap = Envelope().fit(problem)
    assert outside(gap, z, r) == 0
    flat = Envelope().fit(fitted(field, WoodZhang()))
    assert (gap.gamma(z[:10_000]).mean(axis=0) <= 1.02 * flat.gamma(z[:10_000]).mean(axis=0)).all()


@pytest.mark.parametrize("law", [bounce, slide])
def test_the_jumps_are_necessary(problems, law):
    problem, (z, r) = problems[law.__name__], fresh(Contact(law))
    cells = problem.lipschitz.cells
    without = replace(problem, lipschitz=replace(problem.lipschitz, cells=replace(cells, jumps=0 * cells.jumps)))
    assert contradiction(without) is not None
    assert outside(Envelope().fit(without), z, r) > 100


def test_samples_of_other_cells_may_not_serve(problems):
    """A cell of slope 10 beside one of slope 0.1: a sample on the gentle side says nothing about the steep one."""
    problem = problems["slide"]
    cells = problem.lipschitz.cells
    cell, sample = cells.locate(np.array([[0.0, 0.5, 0.0]]))[0], np.array([[0.0, -0.5, 0.0]])
    alone = cells.closures(np.concatenate([sample, cells.anchors]))
    assert 0 not in alone[cell]
    z, r = fresh(Contact(slide))
    shared = replace(cells, jumps=0 * cells.jumps, constants=np.broadcast_to(cells.constants[cell], cells.constants.shape))
    one = replace(problem.lipschitz, cells=None, value=shared.worst)
    assert outside(Envelope().fit(replace(problem, lipschitz=one)), z, r) > 1_000


@pytest.mark.parametrize("law", [bounce, slide])
def test_one_constant_is_refuted_or_useless(problems, law):
    z, r = fresh(Contact(law), 10_000)
    ours = Envelope().fit(problems[law.__name__]).gamma(z).mean(axis=0)
    flat = fitted(Contact(law), WoodZhang())
    gap = Envelope().fit(flat)
    assert outside(gap, z, r) > 0 or (gap.gamma(z).mean(axis=0) > 2 * ours).all()


def test_the_supremum_is_proved_over_all_cells(problems):
    problem, (z, r) = problems["bounce"], fresh(Contact(bounce))
    gap = Envelope().fit(problem)
    upper, lower = gc.plugin.supremum(gap, problem.domain)
    assert (gap.gamma(z).max(axis=0) <= upper).all()
    assert (upper <= 1.0011 * lower).all()
    assert (Constant().fit(problem).value == upper).all()
    assert (np.abs(r).max(axis=0) <= upper).all()


def test_boxes_hold_across_cells(problems):
    problem = problems["bounce"]
    gap, rng = Envelope().fit(problem), np.random.default_rng(3)
    low = problem.domain.draw(2_000, rng)
    high = np.minimum(low + rng.random(low.shape) * np.repeat([0.8, 0.05, 0.0], (700, 700, 600))[:, None], 1.0)
    boxes = gc.Interval(low, high)
    over, slope = gap.interval_over(boxes), gap.lipschitz(boxes)
    points = [low + rng.integers(0, 2, low.shape) * (high - low) for _ in range(6)]
    points += [low + rng.random(low.shape) * (high - low) for _ in range(6)]
    for a, b in zip(points[1:], points, strict=False):
        lower, upper = gap.interval(np.clip(a, low, high))
        assert ((over.lo <= lower) & (upper <= over.hi)).all()
        change = np.abs(gap.gamma(np.clip(a, low, high)) - gap.gamma(np.clip(b, low, high)))
        apart = np.abs(np.clip(a, low, high) - np.clip(b, low, high))[:, None, :]
        allowed = np.where(apart > 0, slope * np.maximum(apart, 1e-300), 0.0).sum(axis=2)
        assert (change <= allowed + 1e-12).all()
    assert np.isinf(slope).any()
    assert np.isfinite(slope).any()


def test_batches_do_not_change_bits(problems):
    gap, (z, _) = Envelope().fit(problems["bounce"]), fresh(Contact(bounce), 5_000)
    low, high = gap.interval(z)
    order = np.random.default_rng(0).permutation(len(z))
    again = gap.interval(z[order])
    assert again[0].tobytes() == low[order].tobytes()
    assert again[1].tobytes() == high[order].tobytes()
    one = gap.interval(z[7:8])
    assert one[0].tobytes() == low[7:8].tobytes()
