"""Attacks on certificates of texts that cancel: points a few floats from the samples, where only e can cover the arithmetic."""

from __future__ import annotations

import numpy as np
import pytest
from rounded_models import equations_model

import gapcert as gc
from gapcert.certification.coordinates import Coordinates, RelativeModel
from gapcert.contracts.systems.arithmetic import Arithmetic
from gapcert_bounds.constants.interval import IntervalJacobian
from gapcert_equations.config import EquationsConfig
from gapcert_verify.verify import verify_run

# f̂ of each differs from f = 0.4 p + 0.2 u by what is added here; ranges of p.
TEXTS = {
    "offset": ("0.02*sin(5*p)*cos(3*u) + (max(0.7*p + 3e9, -2) - max(3e9 - 0.3*p, 1)) - p", (-1, 1)),
    "wave": ("-61.5*sin(410*p)", (-2001, -2000.995)),
    "quotient": ("((p + 1e5)**3 - 1e15 - 3e10*p - 3e5*p**2 - p**3)*1e-9 + 0.01*u**2", (-2, 2)),
    "scale": ("(exp(18 + tanh(p)) - exp(18)*exp(tanh(p)))*1e-3 + 0.1*atan(p)", (-1, 1)),
}


def model(text="0"):
    law = f"0.4*p + 0.2*u + {text}"
    return equations_model(EquationsConfig(kind="equations", states={"p": "1"}, inputs={"u": "1"}, next={"p": law}, period=0.1))


def certified(folder, name, **options):
    text, ends = TEXTS[name]
    f = model()
    domain = gc.Domain.of(f, {"p": ends, "u": (-1, 1)})
    options = {"sampling": gc.AdaptiveSampling(60), "lipschitz": IntervalJacobian(), "predictor": "none"} | options
    request = gc.plugin.Request("deterministic")
    return gc.certify(f, model(text), domain, folder=folder / "run", request=request, **options)


def near(certificate, n, seed=0):
    """n points of Z at most 400 floats from a sample on every axis, nobody's."""
    rng, domain = np.random.default_rng(seed), certificate.domain
    z = certificate.samples.z[rng.integers(len(certificate.samples.z), size=n)]
    z = z + rng.integers(-400, 401, z.shape) * np.spacing(np.abs(z))
    return np.clip(z, domain.low, domain.high)


def outside(certificate, z, text):
    low, high = certificate.gap.interval(z)
    r = gc.plugin.Residual(model(text), model())(z)
    return int(((r < low) | (r > high)).any(axis=1).sum())


@pytest.mark.parametrize("name", TEXTS)
def test_points_next_to_samples_stay_in_the_band(tmp_path, name):
    c = certified(tmp_path, name)
    assert c.claim.kind == "deterministic"
    assert outside(c, near(c, 20_000), TEXTS[name][0]) == 0
    assert outside(c, c.domain.draw(20_000, np.random.default_rng(4)), TEXTS[name][0]) == 0
    said = next(a for a in c.assumptions if "within e" in a)
    assert "of both it is proved by a running error analysis" in said
    assert "Most of e(p) is the rounding of" in said


@pytest.mark.parametrize("name", ["offset", "wave"])
def test_with_four_ulp_of_the_state_they_do_not(tmp_path, monkeypatch, name):
    """And then e is told as an assumption."""
    monkeypatch.setattr("gapcert_equations.model.EquationsModel.rounding_over", lambda self, z: None)
    monkeypatch.setattr("gapcert.certification.gates.entry.jitter", lambda *given: None)
    c = certified(tmp_path, name)
    assert outside(c, near(c, 20_000), TEXTS[name][0]) > 100
    assert sum("of both it is assumed as it is stated, not proved" in a for a in c.assumptions) == 1


@pytest.mark.contract
@pytest.mark.parametrize("family", ["envelope", "constant", "multilinear"])
def test_other_families_and_the_verifier_agree(tmp_path, family):
    made = gc.registry().build("gap_family", family)
    more = {"sampling": gc.LatticeSampling(budget=80), "lipschitz": IntervalJacobian(curvature=True)} if made.lattice else {}
    c = certified(tmp_path, "offset", family=made, **({"predictor": None} | more if made.lattice else {}))
    assert outside(c, near(c, 20_000), TEXTS["offset"][0]) == 0
    c.save(tmp_path / "run")
    assert [check for check in verify_run(tmp_path / "run")["checks"] if not check["passed"]] == []


@pytest.mark.exam
def test_drawn_offsets_and_waves(tmp_path):
    """f̂ of other sizes: nobody leaves the band."""
    for seed in range(12):
        rng = np.random.default_rng(seed)
        big, slope, steep = 10.0 ** rng.uniform(3, 11), rng.uniform(0.1, 0.9), 10.0 ** rng.uniform(0, 2.5)
        at = rng.choice([0.0, 30.0, -3000.0])
        text = f"(max({slope}*p + {big}, -1) - max({big} - {slope}*p, -1)) - 2*{slope}*p + sin({steep}*p)/{steep} + 1e-3*u**3"
        TEXTS["drawn"] = (text, (at - 0.5, at + 0.5))
        c = certified(tmp_path / str(seed), "drawn")
        assert outside(c, near(c, 200_000, seed), text) == 0, text
    del TEXTS["drawn"]


def test_the_bound_is_that_of_the_worst_part_of_z():
    """1/(p + c) is steep at one end alone: boxes are cut there, and the bound is near the largest error."""
    steep = model("1e-6/(p + 1.001)")
    domain = gc.Domain.of(steep, {"p": (-1, 1), "u": (-1, 1)})
    e, ends = Arithmetic.of(steep, domain), np.array([[-1.0, -1.0], [1.0, 1.0]])
    there = steep.rounding_over(gc.Interval.exact(ends))
    assert e.proved
    assert there.max() <= e.e[0] < 4 * there.max()


def test_a_bound_over_many_boxes_is_the_largest_of_them():
    """Over all of Z nothing bounds 1/(p² − p + 0.3), whose terms are wide there; and exp cancels at one end alone."""
    waist = model("max(exp(15*p) + p, -2) - max(exp(15*p) - 1, -3) + 1e-3/(p*p - p + 0.3)")
    domain = gc.Domain.of(waist, {"p": (-1, 1), "u": (-1, 1)})
    e, at = Arithmetic.of(waist, domain), np.column_stack([np.linspace(-1, 1, 401), np.full(401, 0.5)])
    there = waist.rounding_over(gc.Interval.exact(at))[:, 0]
    assert np.isinf(waist.rounding_over(domain.interval)).all()
    assert e.proved
    assert 1e3 * there.min() < there.max() <= e.e[0] < 4 * there.max()


def test_what_has_no_bound_is_assumed():
    jumps = model("0.1*sign(p - 0.3)")
    e = Arithmetic.of(jumps, gc.Domain.of(jumps, {"p": (-1, 1), "u": (-1, 1)}))
    assert not e.proved
    assert np.isfinite(e.e).all()


def test_relations_and_relative_inputs_keep_it():
    """w = u − 2 p: a step by the coordinates misses no more than its bound, and Z cut by a relation no more than Z whole."""
    whole = model(TEXTS["offset"][0])
    relative = RelativeModel(whole, Coordinates.of(whole, {"w": "u - 2*p"}))
    z = np.random.default_rng(2).uniform(-1, 1, (500, 2))
    inside = whole.enclosure(gc.Interval.exact(np.column_stack([z[:, 0], z[:, 1] + 2 * z[:, 0]])))
    after = relative.step(z[:, :1], z[:, 1:]).x
    bound = relative.rounding_over(gc.Interval(np.full((1, 2), -1.0), np.ones((1, 2))))
    assert bound[0, 0] > whole.rounding_over(gc.Interval(np.full((1, 2), -1.0), np.ones((1, 2))))[0, 0] * 0.99
    assert (after >= inside.lo - bound).all()
    assert (after <= inside.hi + bound).all()
    cut = gc.Domain.of(whole, {"p": (-1, 1), "u": (-1, 1)}, ["p + u <= 0.5"])
    free = gc.Domain.of(whole, {"p": (-1, 1), "u": (-1, 1)})
    assert Arithmetic.of(whole, cut).e[0] <= Arithmetic.of(whole, free).e[0]
