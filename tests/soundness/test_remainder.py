"""What a gap has beside its predictor, over boxes, and affine majorants: sound on points nobody sampled, and thin."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from fractions import Fraction
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gapcert as gc
import gapcert_networks
from gapcert.certification.coordinates import Coordinates, RelativeGap, RelativePredictor
from gapcert.contracts.gaps.predictor import Predictor
from gapcert_bounds import MultilinearPredictor
from gapcert_bounds.families.envelope import EnvelopeGap, PiecewiseEnvelope
from gapcert_bounds.families.multilinear import MultilinearGap
from gapcert_bounds.testing.fields import Nothing, Waves, gap_problem, lattice
from gapcert_calibrate.route import CalibratedGap
from gapcert_cells.testing import Band
from gapcert_functions.dominating import dominate
from gapcert_mpc.saved_models import NotKept, again, kept, pair

Array = np.ndarray

FIELD = Waves.smooth()
STEEP = gc.plugin.AffinePredictor(np.array([0.3, -2.0]), np.array([[3.0, -2.0, 1.5], [0.5, 4.0, -2.5]]))
WOVEN = MultilinearPredictor((np.array([-1.0, 0.1, 1.0]),) * 3, np.random.default_rng(0).normal(size=(3, 3, 3, 2)))
RELATIVE = Coordinates(FIELD.inputs, ("u0 - 0.7 x1 + 0.2 x0",), ((0.2, -0.7),), (1.3,))

PREDICTORS: dict[str, Predictor] = {
    "affine": STEEP,
    "multilinear": WOVEN,
    "model": gc.plugin.ModelPredictor(Waves(4 * FIELD.amplitude, 0.5 * FIELD.rate, FIELD.phase), Nothing(FIELD)),
}


def around(p: Predictor, counts: tuple[int, ...] = (5, 5, 5)) -> gc.plugin.GapProblem:
    """r = p + waves; the constants are those of the waves."""
    problem = gap_problem(FIELD, counts)
    samples = replace(problem.samples, r=problem.samples.r + p(problem.samples.z))
    return replace(problem, samples=samples, predictor=p)


def envelope(p: Predictor) -> EnvelopeGap:
    problem = around(p)
    return EnvelopeGap(problem.samples.z, problem.remainder, problem.lipschitz.value, problem.remainder_resolution, p)


def piecewise(p: Predictor) -> PiecewiseEnvelope:
    """Two cells, of which one jumps."""
    problem = around(p)
    constants, jumps = np.stack([problem.lipschitz.value] * 2), np.array([[0.0, 0.0], [0.05, 0.02]])
    cut = (np.array([0]), np.array([0.21]), np.array([[-1, -2]]))
    cells = gc.plugin.Cells(problem.domain.low, problem.domain.high, *cut, constants, jumps, problem.samples.z)
    return PiecewiseEnvelope(problem.samples.z, problem.remainder, cells, problem.remainder_resolution, p)


def multilinear(p: Predictor) -> MultilinearGap:
    problem = around(p)
    axes = problem.samples.lattice
    bends = [problem.lipschitz.bend(j, a) for j, a in enumerate(axes)]
    g = problem.remainder.reshape(5, 5, 5, 2)
    return MultilinearGap(axes, g, bends, problem.lipschitz.value, problem.remainder_resolution, p)


def dominating(p: Predictor) -> gc.GapFunction:
    rng = np.random.default_rng(1)
    q = gapcert_networks.Network(
        (rng.normal(size=(8, 3)), rng.normal(size=(2, 8)) / 8), (rng.normal(size=8), np.full(2, 0.3)), "tanh"
    )
    below = gapcert_networks.Network((q.weights[0], -q.weights[1]), (q.biases[0], -q.biases[1]), "tanh")
    return dominate(around(p), "drawn", below, q, (2, 2, 2), 0.05, 500)


GAPS = {
    "envelope": envelope,
    "piecewise": piecewise,
    "multilinear": multilinear,
    "dominating": dominating,
    "calibrated": lambda p: CalibratedGap(envelope(p), np.array([0.02, -0.01]), np.full(2, 1e-9)),
    "calibrated-dominating": lambda p: CalibratedGap(dominating(p), np.array([-0.02, 0.01]), np.full(2, 1e-9)),
    "relative": lambda p: RelativeGap(envelope(p), RELATIVE),
    "relative-calibrated": lambda p: RelativeGap(CalibratedGap(piecewise(p), np.array([0.02, -0.01]), np.zeros(2)), RELATIVE),
}


@cache
def made(name: str, predictor: str) -> gc.GapFunction:
    return GAPS[name](PREDICTORS[predictor])


def boxes(seed: int = 0) -> gc.Interval:
    """From the whole domain to points."""
    rng = np.random.default_rng(seed)
    low = rng.uniform(-1, 1, (40, 3))
    size = np.repeat([2.0, 0.3, 0.01, 0.0], 10)[:, None] * rng.random((40, 3))
    whole = gc.Interval(-np.ones((1, 3)), np.ones((1, 3)))
    return gc.Interval.concatenate([whole, gc.Interval(low, np.minimum(low + size, 1.0))])


@pytest.mark.exam
@pytest.mark.parametrize("predictor", PREDICTORS)
@pytest.mark.parametrize("name", GAPS)
def test_it_holds_at_points_of_boxes(name: str, predictor: str) -> None:
    gap, some = made(name, predictor), boxes()
    assert gap.predictor is not None
    over, rng = gap.remainder_over(some), np.random.default_rng(1)
    ends = gap.remainder_ends_over(some)
    for k in range(30):
        share = float(k) if k < 2 else rng.integers(0, 2, some.shape) if k < 8 else rng.random(some.shape)
        z = np.clip(some.lo + share * (some.hi - some.lo), some.lo, some.hi)
        low, high = (end - gap.predictor(z) for end in gap.interval(z))
        assert ((over.lo <= low) & (high <= over.hi)).all()
        assert (ends[0].contains(low) & ends[1].contains(high)).all()


@pytest.mark.exam
@pytest.mark.parametrize("name", GAPS)
def test_affine_majorants_hold_at_points_of_boxes(name: str) -> None:
    """Where cells meet at jumps, too."""
    gap, some, rng = made(name, "affine"), boxes(2)[::8], np.random.default_rng(4)
    c, a = gap.majorant_over(some, 40 * len(some))
    for k in range(60):
        share = float(k) if k < 2 else rng.random(some.shape)
        z = np.clip(some.lo + share * (some.hi - some.lo), some.lo, some.hi)
        assert (gap.gamma(z) <= c + (a * np.abs(z)[:, None, :]).sum(axis=2)).all()
    assert (a.max(axis=(1, 2)) > 0)[:2].all(), "constant over wide boxes"


@pytest.mark.parametrize("predictor", PREDICTORS)
@pytest.mark.parametrize("name", GAPS)
def test_what_the_predictor_does_over_a_box_does_not_enter(name: str, predictor: str) -> None:
    """It is as wide as the band of the same samples without a predictor, up to rounding."""
    gap, some = made(name, predictor), boxes()
    found = gap.remainder_over(some)
    if name in ("envelope", "piecewise", "multilinear", "calibrated", "relative"):
        same = GAPS[name](gc.plugin.AffinePredictor.none(2, 3)).interval_over(some)
        assert found.width == pytest.approx(same.width, abs=1e-6)
    whole = gap.interval_over(some[:1])
    assert (found.width[:1] < 0.6 * whole.width).all()


def test_thin_beside_a_pendulum_and_in_eight_dimensions() -> None:
    """A steep affine part and a small rest, with constants of the rest: what is left is a fiftieth of the whole over Z."""
    for nz, nx, n in ((3, 2, 125), (8, 4, 256)):
        rng = np.random.default_rng(nz)
        rest = Waves(0.002 * rng.normal(size=(nx, nz)), rng.uniform(0.5, 2, (nx, nz)), rng.uniform(-3, 3, (nx, nz)))
        p = gc.plugin.AffinePredictor(rng.normal(size=nx), rng.normal(size=(nx, nz)))
        z = lattice(rest.domain, (5, 5, 5)) if nz == 3 else rest.domain.draw(n, rng)
        gap = EnvelopeGap(z, rest(z), rest.constants, np.full(nx, 1e-15), p)
        whole = rest.domain.interval
        remainder, over = gap.remainder_over(whole), gap.interval_over(whole)
        assert (remainder.width < over.width / 50).all()
        fresh = rest.domain.draw(20_000, rng)
        assert remainder.contains(rest(fresh)).all()
        # By the range of p it would be twice as wide as the whole.
        low, high = gc.GapFunction.remainder_ends_over(gap, whole)
        assert (high.hi - low.lo > 1.9 * over.width).all()


def large(seed: int) -> tuple[EnvelopeGap, Array]:
    """An affine predictor whose terms cancel: its rounding is far above what it is itself."""
    rng = np.random.default_rng(seed)
    slope = rng.normal(size=(1, 3)) * 10.0 ** rng.integers(0, 9)
    z = rng.uniform(-1, 1, (50, 3))
    p = gc.plugin.AffinePredictor(-slope @ z[0], slope)
    gap = EnvelopeGap(z[:1], np.zeros((1, 1)), np.zeros((1, 3)), np.zeros(1), p)
    return gap, np.concatenate([z[:1], z[:1] + 1e-9 * z])


def outside(gap: EnvelopeGap, z: Array) -> int:
    """How many points' l − p or u − p, p in exact arithmetic, lie outside the remainder over the box that is the point."""
    found, (low, high), bad = gap.remainder_over(gc.Interval.exact(z)), gap.interval(z), 0
    p = gap.predictor
    for k, point in enumerate(z):
        exact = Fraction(p.offset[0]) + sum(Fraction(a) * Fraction(b) for a, b in zip(p.slope[0], point, strict=True))
        bad += Fraction(low[k, 0]) - exact < Fraction(found.lo[k, 0]) or Fraction(high[k, 0]) - exact > Fraction(found.hi[k, 0])
    return bad


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_exact_predictor_may_be_meant(seed: int) -> None:
    assert outside(*large(seed)) == 0


def test_without_the_rounding_of_the_predictor_it_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Predictor, "error_over", lambda self, boxes: np.zeros(1))
    assert sum(outside(*large(seed)) for seed in range(10)) > 10


@pytest.mark.parametrize("predictor", PREDICTORS)
def test_a_predictor_in_relative_coordinates_is_the_same_function(predictor: str) -> None:
    inner = PREDICTORS[predictor]
    p, rng, h = RelativePredictor(inner, RELATIVE), np.random.default_rng(3), 1e-6
    z = rng.uniform(-0.5, 0.5, (200, 3))
    w = np.concatenate([z[:, :2], 1.3 * z[:, 2:] + z[:, :2] @ np.array([[0.2], [-0.7]])], axis=1)
    assert p(z) == pytest.approx(inner(w), abs=1e-12)
    some = gc.Interval(z - 0.02, z + 0.02)
    slopes, over = p.jacobian_over(some), p.over(some)
    at = some.lo + rng.random(z.shape) * (some.hi - some.lo)
    assert over.contains(p(at)).all()
    for j in range(3):
        step = np.where(np.arange(3) == j, h, 0.0)
        slope = (p(np.minimum(at + step, some.hi)) - p(np.maximum(at - step, some.lo))) / (2 * h)
        assert ((slopes.lo[:, :, j] - 1e-6 <= slope) & (slope <= slopes.hi[:, :, j] + 1e-6)).all()
    assert (p.resolution(FIELD.domain) >= 0).all()
    assert (p.resolution(FIELD.domain) < 1e-13).all()


def test_without_a_predictor_it_is_the_whole() -> None:
    band = Band((-0.2, -0.1), (0.3, 0.1))
    some = boxes()
    for gap in (band, CalibratedGap(band, np.full(2, 0.1), np.zeros(2)), RelativeGap(band, RELATIVE)):
        assert gap.predictor is None
        whole, found = gap.interval_over(some), gap.remainder_over(some)
        assert np.array_equal(whole.lo, found.lo)
        assert np.array_equal(whole.hi, found.hi)


@pytest.mark.exam
@pytest.mark.parametrize("predictor", ["affine", "multilinear"])
@pytest.mark.parametrize("name", GAPS)
def test_kept_as_data_it_gives_the_same_bits(name: str, predictor: str) -> None:
    gap, some, arrays = made(name, predictor), boxes(3), dict[str, Array]()
    gap.interval(some.lo)
    written = json.dumps(kept(gap, "gap", arrays))
    file = io.BytesIO()
    np.savez(file, **arrays)
    file.seek(0)
    with np.load(file, allow_pickle=False) as stored:
        found = again(json.loads(written), stored)
    assert found is not gap
    assert all(np.array_equal(a, b) for a, b in zip(gap.interval(some.lo), found.interval(some.lo), strict=True))
    for over in (gc.GapFunction.remainder_over, type(gap).interval_over):
        first, then = over(gap, some), over(found, some)
        assert np.array_equal(first.lo, then.lo)
        assert np.array_equal(first.hi, then.hi)


@pytest.mark.parametrize("value", [{"gap": len}, made("envelope", "model"), np.array([None])])
def test_what_is_no_data_is_not_kept(value: object) -> None:
    with pytest.raises(NotKept):
        kept(value, "value", {})
    arrays = dict[str, Array]()
    assert pair(arrays, some=np.zeros(2), value=value) is None
    assert arrays == {}


@pytest.mark.parametrize("name", ["subprocess:Popen", "os:system", "gapcert.nothing:At", "gapcert:verify_run"])
def test_data_name_no_foreign_class(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        again({"object": name, "has": {}}, {})
