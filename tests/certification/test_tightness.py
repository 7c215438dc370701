"""Adaptive sampling that ends where the band is tight enough: how far it goes, and that it goes on from where it was."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rough_fields import Bump

import gapcert as gc
from gapcert.certification.samples.designs import _ends, _Watch
from gapcert_bounds.constants.interval import IntervalJacobian
from gapcert_bounds.families.envelope import Envelope
from gapcert_bounds.testing.fields import Field, Nothing, Waves, gap_problem
from gapcert_verify.verify import verify_run

FIELD = Waves.smooth()
BUMP = Bump(FIELD, 0.5, 0.1, np.array([0.21, -0.4, 0.6]))


def certified(
    folder: Path, tightness: float | None, budget: int = 20_000, field: Field = FIELD, **options: Any
) -> gc.Certificate:
    made = gc.certify(
        Nothing(field),
        field,
        field.domain,
        sampling=gc.AdaptiveSampling(budget, tightness=tightness),
        lipschitz=IntervalJacobian(1024, **options),
        family=Envelope(),
        folder=folder,
    )
    made.save(folder)
    return made


def bound_rounds(made: gc.Certificate) -> dict[str, str]:
    return {k: v for k, v in made.digests.items() if k.startswith("bound-")}


@pytest.mark.exam
@pytest.mark.parametrize("tightness", [1.7, 1.4])
def test_it_ends_where_the_band_is_tight_enough(tmp_path: Path, tightness: float) -> None:
    made = certified(tmp_path, tightness)
    found = [s.tightness or np.inf for s in made.states.values()]
    assert max(found) <= 1.1 * tightness
    assert 27 < len(made.problem.samples) < 10_000
    assert verify_run(tmp_path)["verdict"] == "holds"
    # A half of the samples is less tight than asked for, as far as rounds can tell: each doubles them.
    less = certified(tmp_path / "less", None, len(made.problem.samples) // 2)
    assert max(s.tightness or np.inf for s in less.states.values()) > 0.95 * tightness


@pytest.mark.exam
def test_a_tighter_band_needs_more_samples(tmp_path: Path) -> None:
    sizes = [len(certified(tmp_path / str(t), t).problem.samples) for t in (2.5, 1.7, 1.4)]
    assert sizes[0] < sizes[1] < sizes[2]


def test_the_budget_ends_it_as_well(tmp_path: Path) -> None:
    asked, plain = (certified(tmp_path / str(t), t, 400) for t in (1.0001, None))
    assert np.array_equal(asked.problem.samples.z, plain.problem.samples.z)
    assert len(bound_rounds(asked)) > len(bound_rounds(plain)) == 2


@pytest.mark.exam
def test_it_goes_on_from_the_rounds_that_are_stored(tmp_path: Path) -> None:
    first = bound_rounds(certified(tmp_path, 1.3))
    assert len(first) > 3
    assert bound_rounds(certified(tmp_path, 1.3)) == first
    shutil.rmtree(tmp_path / "samples" / max(first))
    assert bound_rounds(certified(tmp_path, 1.3)) == first


def test_constants_per_cell_are_refined_as_well(tmp_path: Path) -> None:
    made = certified(tmp_path, 1.5, field=BUMP, cells=32)
    assert max(s.tightness or np.inf for s in made.states.values()) <= 1.65
    assert len(made.problem.samples) < 5_000
    assert verify_run(tmp_path)["verdict"] == "holds"


@pytest.mark.parametrize(("first", "least", "count"), [(27, 1, 10), (27, 1, 10**6), (1, 200, 199), (27, 300, 4000), (3, 1, 1)])
def test_rounds_are_few_and_end_at_the_last_point(first: int, least: int, count: int) -> None:
    ends = _ends(first, least, count)
    assert len(ends) <= 9
    assert ends[-1] == count
    assert ends[0] >= min(least, count)


def test_what_is_watched_is_the_band_of_all_samples() -> None:
    """Each round brings its own samples alone, and the band that results is that of all of them."""
    problem = gap_problem(FIELD, (6, 6, 6))
    samples, watch = problem.samples, _Watch(problem)
    for part in np.array_split(np.arange(len(samples)), 3):
        watch.tight(samples, gc.plugin.Samples(samples.z[part], samples.r[part]), 1.1)
    low, high = Envelope("none").fit(problem).interval(watch.z)
    np.testing.assert_allclose(watch.low, low, rtol=0, atol=1e-14)
    np.testing.assert_allclose(watch.high, high, rtol=0, atol=1e-14)
