"""Attacks on constants that intervals prove per cell: what holds, what a local feature costs, and what may not be shared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rough_fields import Bump

import gapcert as gc
from gapcert.certification.refutation import contradiction
from gapcert.contracts.gaps.predictor import Samples
from gapcert.numerics.constraint_zone import Relation
from gapcert_bounds.constants.interval import IntervalJacobian
from gapcert_bounds.families.envelope import Envelope, EnvelopeGap
from gapcert_bounds.testing.fields import Kink, Nothing, Waves, lattice, lipschitz_problem
from gapcert_verify.verify import verify_run

BUMP = Bump(Waves.smooth(), 0.5, 0.1, np.array([0.21, -0.4, 0.6]))
FIELDS = {"bump": BUMP, "waves": Waves.smooth(), "kink": Kink(np.array([[0.5, 2.0, 0.1], [3.0, 0.0, 0.2]]), np.full(3, 0.3))}
BUDGET = 1500


def fitted(field, cells, budget=BUDGET):
    """As `certify` does it: a first round, constants, and further samples where the band is loosest."""
    residual, first = gc.plugin.Residual(field, Nothing(field)), lattice(field.domain, (3, 3, 3))
    bound = IntervalJacobian(8192, cells).bound(lipschitz_problem(field))
    if bound.cells is None:
        further = gc.AdaptiveSampling(budget).further(field.domain, first, residual(first), bound.value)
    else:
        further = bound.cells.points(field.domain, residual(first), budget - len(first) - len(bound.cells.anchors))
    z = np.concatenate([first, further])
    none = gc.plugin.AffinePredictor.none(field.nx, z.shape[1])
    e = residual.resolution(field.domain)
    return gc.plugin.GapProblem(Samples(z, residual(z)), field.domain, bound, none, e, "dominate")


def fresh(field, n=100_000):
    z = field.domain.draw(n, np.random.default_rng(1))
    return z, field(z)


def outside(gap, z, r):
    low, high = gap.interval(z)
    return int(((r < low) | (r > high)).any(axis=1).sum())


@pytest.mark.exam
@pytest.mark.parametrize("name", FIELDS)
def test_the_band_holds_on_fresh_points(name):
    field = FIELDS[name]
    problem, (z, r) = fitted(field, 64), fresh(field)
    # Both sides of a kink are as steep, so that there is nothing to gain.
    cells = problem.lipschitz.cells
    assert cells is None if name == "kink" else 1 < len(cells) <= 64
    assert contradiction(problem) is None
    assert outside(Envelope().fit(problem), z, r) == 0


@pytest.mark.parametrize("name", ["bump", "waves"])
def test_constants_hold_for_pairs_within_a_cell(name):
    field, rng = FIELDS[name], np.random.default_rng(4)
    bound = IntervalJacobian(4096, 32).bound(lipschitz_problem(field))
    assert (bound.value == bound.cells.worst).all()
    for box, constants in zip(bound.cells.boxes, bound.cells.constants, strict=True):
        a, b = (box.lo + rng.random((2000, 3)) * (box.hi - box.lo) for _ in range(2))
        b[1000:] = np.clip(a[1000:] + 1e-4 * (rng.random((1000, 3)) - 0.5), box.lo, box.hi)
        change = np.abs(field(a) - field(b))
        assert (change <= np.abs(a - b) @ constants.T + 1e-12).all()


def test_a_narrow_bump_costs_less_than_everywhere():
    z, r = fresh(BUMP, 20_000)
    problems = [fitted(BUMP, n) for n in (1, 64)]
    assert len(problems[1].samples) <= len(problems[0].samples)
    one, many = (Envelope().fit(p).gamma(z).mean(axis=0) / np.abs(r).mean(axis=0) for p in problems)
    assert (many - 1 < 0.6 * (one - 1)).all()


def test_samples_of_other_cells_may_not_serve():
    """The minimum over all samples with the constants of a point's own cell is violated: rule of the closed cell."""
    problem, (z, r) = fitted(BUMP, 64), fresh(BUMP)
    cells = problem.lipschitz.cells
    at, wrong = cells.locate(z), 0
    for c in np.unique(at):
        shared = EnvelopeGap(
            problem.samples.z, problem.remainder, cells.constants[c], problem.remainder_resolution, problem.predictor
        )
        wrong += outside(shared, z[at == c], r[at == c])
    assert wrong > 100


def test_the_constants_are_necessary():
    problem, (z, r) = fitted(BUMP, 64), fresh(BUMP)
    cells = replace(problem.lipschitz.cells, constants=0.5 * problem.lipschitz.cells.constants)
    assert outside(Envelope().fit(replace(problem, lipschitz=replace(problem.lipschitz, cells=cells))), z, r) > 100


def test_cells_of_a_domain_with_relations_have_points_of_it():
    domain = replace(BUMP.domain, relations=(Relation("x0 + x1 <= 0.3", (1.0, 1.0, 0.0), 0.3),))
    made = IntervalJacobian(2048, 32).bound(replace(lipschitz_problem(BUMP), domain=domain)).cells
    assert len(made) > 1
    assert domain.contains(made.anchors).all()
    assert not len(made.bare(domain, made.anchors))


@pytest.mark.exam
def test_cells_are_cut_along_few_axes_only():
    field = Waves(np.full((1, 13), 0.1), np.ones((1, 13)), np.zeros((1, 13)))
    with pytest.raises(gc.UsageError, match="along at most 12 axes, found 13; use cells: 1"):
        IntervalJacobian(1, 2).bound(lipschitz_problem(field))


def test_held_axes_are_not_cut():
    made = IntervalJacobian(2048, 32).bound(replace(lipschitz_problem(BUMP), held=(2,))).cells
    assert len(made) > 1
    assert 2 not in made.axis


def test_a_deterministic_certificate_verifies(tmp_path):
    made = gc.certify(
        Nothing(BUMP),
        BUMP,
        BUMP.domain,
        sampling=gc.AdaptiveSampling(300),
        lipschitz=IntervalJacobian(4096, 16),
        family=Envelope("none"),
        request=gc.Request("deterministic", 1e-2, 1e-3),
        folder=tmp_path,
    )
    made.save(tmp_path)
    assert made.claim.kind == "deterministic"
    assert any("they were proved in each of them" in a for a in made.assumptions)
    found = verify_run(tmp_path)
    assert found["verdict"] == "holds", [c for c in found["checks"] if not c["passed"]]
