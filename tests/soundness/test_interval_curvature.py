"""Attacks on curvature that intervals prove: no fresh point exceeds it, kinks have none, and the band on it holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import gapcert as gc
from gapcert.certification.refutation import curvature_contradiction
from gapcert_bounds import MultilinearPredictor
from gapcert_bounds.constants.interval import IntervalJacobian, merged
from gapcert_bounds.families.multilinear import Multilinear
from gapcert_bounds.testing.fields import Kink, Waves, lattice, lipschitz_problem
from gapcert_equations.config import EquationsConfig
from gapcert_equations.programs import jets
from gapcert_verify.verify import verify_run

NOMINAL = {
    "kind": "equations",
    "states": {"q": "m", "v": "m/s"},
    "inputs": {"u": "1"},
    "parameters": {"k": "1 1/s^2", "T": "1 s", "d": "1 m", "w": "0.1 m/s", "f": "0.3 m/s^2"},
    "derivative": {"q": "v", "v": "-k*d*sin(q/d) + u*d/T**2"},
    "integrator": "euler",
    "period": "0.1 s",
}
# Friction that saturates within a tenth of the axis of v, and a drive that sags.
OTHER = "-1.3*k*d*sin(q/d) - f*tanh(v/w) + u*(1 - 0.2*u**2)*d/T**2"
KINKED = "-1.3*k*d*sin(q/d) - f*abs(v - 0.3*w)/w*0.1 + u*d/T**2"
ZONES = {"q": (-1.5, 1.5), "v": (-1.0, 1.0), "u": (-1.0, 1.0)}


def model(law=None):
    from gapcert_equations.model import EquationsModel

    laws = NOMINAL["derivative"] | ({} if law is None else {"v": law})
    return EquationsModel(EquationsConfig.model_validate(NOMINAL | {"derivative": laws}))


def question(law=OTHER, predictor=None):
    """(remainder, problem) of the two models."""
    nominal, fhat = model(), model(law)
    domain = gc.Domain.of(nominal, ZONES)
    residual, p = gc.plugin.Residual(fhat, nominal), predictor or gc.plugin.AffinePredictor.none(2, 3)
    e = residual.resolution(domain)
    return residual, gc.plugin.LipschitzProblem(domain, p, e, lambda _, z: residual(z), nominal, fhat)


def curved(problem, **options):
    return IntervalJacobian(curvature=True, **options).bound(problem)


def excess(bound, problem, residual, n=20_000):
    """The largest |second difference| over H, at points inside one slab each, that nobody has sampled."""
    rng, worst, step = np.random.default_rng(11), 0.0, 1e-3
    for j in range(len(problem.domain.low)):
        z = problem.domain.draw(n, rng)
        z[:, j] = np.clip(z[:, j], problem.domain.low[j] + step, problem.domain.high[j] - step)
        apart = step * np.eye(z.shape[1])[j]
        g = [residual(p) - problem.predictor(p) for p in (z - apart, z, z + apart)]
        seen = np.maximum(np.abs(g[0] - 2 * g[1] + g[2]) - 1e-14, 0) / step**2
        nodes = np.array([z[:, j] - step, z[:, j] + step])
        allowed = np.concatenate([bound.bend(j, pair) for pair in nodes.T], axis=1).T
        worst = max(worst, float((seen / np.maximum(allowed, 1e-12)).max()))
    return worst


@pytest.mark.exam
@pytest.mark.parametrize("predictor", [None, "affine", "model"])
def test_no_second_difference_exceeds_the_bound(predictor):
    p = None
    if predictor == "affine":
        p = gc.plugin.AffinePredictor(np.array([0.1, 0.2]), np.array([[0.1, 0.0, 0.3], [1.0, -2.0, 0.5]]))
    elif predictor == "model":
        p = gc.plugin.ModelPredictor(model("-1.2*k*d*sin(q/d) + u*d/T**2"), model())
    residual, problem = question(predictor=p)
    for slabs in (1, 8):
        bound = curved(problem, slabs=slabs)
        assert np.isfinite(bound.curvature).all()
        assert bound.provenance == "interval"
        assert 0.9 < excess(bound, problem, residual) <= 1
        assert (bound.slabs is not None) == (slabs > 1)
    # Slabs are proved apart, and the largest of them is what holds everywhere.
    cuts, parts = bound.slabs[1]
    assert len(cuts) <= 9
    assert (parts.max(axis=1) == bound.curvature[:, 1]).all()
    assert parts[1].min() < 0.1 * parts[1].max()


@pytest.mark.exam
def test_a_wrong_rule_is_found_on_fresh_points(monkeypatch):
    bend = jets._BENDS["tanh"]
    monkeypatch.setitem(jets._BENDS, "tanh", lambda *given: bend(*given) * 0.9)
    residual, problem = question()
    assert excess(curved(problem), problem, residual) > 1


def test_bounds_approach_the_exact_ones():
    field = Waves.smooth()
    rough, fine = (curved(lipschitz_problem(field), boxes=n).curvature for n in (1, 4096))
    assert (rough >= fine).all()
    assert (fine >= field.curvature * (1 - 1e-12)).all()
    assert np.allclose(fine, field.curvature, rtol=0.02)


def test_a_kink_has_no_curvature_and_costs_nothing_elsewhere():
    residual, problem = question(KINKED)
    bound = curved(problem, slabs=6)
    assert np.isinf(bound.curvature).tolist() == [[False] * 3, [False, True, False]]
    cuts, parts = bound.slabs[1]
    around = (cuts[:-1] <= 0.03) & (cuts[1:] >= 0.03)
    assert (np.isinf(parts[1]) == around).all()
    assert (parts[1][~around] < 1e-9).all()
    gap, z = fitted(problem, residual, bound, 2000), problem.domain.draw(50_000, np.random.default_rng(2))
    low, high = gap.interval(z)
    assert ((low <= residual(z)) & (residual(z) <= high)).all()


def test_a_model_without_second_derivatives_has_no_curvature():
    kink = Kink(np.array([[0.5, 0.25], [0.3, 1.0]]), np.array([0.1, -0.3]))
    assert np.isinf(curved(lipschitz_problem(kink), boxes=64).curvature).all()


@pytest.mark.exam
def test_a_multilinear_predictor_bends_at_its_nodes_only():
    rng = np.random.default_rng(4)
    axes = (np.array([-1.5, 0.1, 1.5]), np.array([0.0]), np.array([-1.0, 1.0]))
    residual, problem = question(predictor=MultilinearPredictor(axes, rng.normal(size=(3, 1, 2, 2))))
    bound = curved(problem, slabs=16)
    cuts, parts = bound.slabs[0]
    whole = (cuts[:-1] <= 0.1) & (cuts[1:] >= 0.1)
    assert np.isinf(parts[1][whole]).all()
    assert np.isfinite(bound.curvature[:, 1]).all()
    assert excess(bound, problem, residual) <= 1


def test_held_axes_are_left_out():
    _, problem = question()
    bound = curved(replace(problem, held=(2,)))
    assert np.isinf(bound.curvature[:, 2]).all()
    assert bound.slabs[2] is None
    assert np.isfinite(bound.curvature[:, :2]).all()


def test_cells_have_no_curvature():
    with pytest.raises(gc.UsageError, match="use cells: 1"):
        IntervalJacobian(cells=8, curvature=True)


def test_parts_are_put_together_without_loss():
    rng = np.random.default_rng(0)
    for _ in range(50):
        n = int(rng.integers(1, 20))
        cuts, found = np.sort(rng.normal(size=n + 1)), rng.exponential(size=(2, n))
        found[0, rng.random(n) < 0.1] = np.inf
        few, parts = merged(cuts, found, np.ones(2), 4)
        assert len(few) <= 5
        assert (few[0], few[-1]) == (cuts[0], cuts[-1])
        middle = (cuts[1:] + cuts[:-1]) / 2
        assert (parts[:, np.searchsorted(few, middle) - 1] >= found).all()
    even, flat = merged(np.linspace(0, 1, 17), np.ones((1, 16)), np.ones(1), 8)
    assert even.tolist() == [0, 1]
    assert flat.tolist() == [[1]]


def fitted(problem, residual, bound, budget):
    plan = gc.LatticeSampling(budget=budget)
    first = lattice(problem.domain, (3, 3, 3))
    nodes = plan.further(problem.domain, first, residual(first), bound.value, bound)
    samples = gc.plugin.Samples(nodes, residual(nodes), lattice=tuple(np.unique(c) for c in nodes.T))
    made = gc.plugin.GapProblem(samples, problem.domain, bound, problem.predictor, problem.resolution, "dominate")
    assert curvature_contradiction(made) is None
    return Multilinear("none").fit(made)


def test_the_band_holds_and_half_the_curvature_is_not_enough():
    residual, problem = question()
    bound, z = curved(problem), problem.domain.draw(50_000, np.random.default_rng(3))
    r, outside = residual(z), []
    for factor in (1.0, 0.5):
        slabs = tuple(s if s is None else (s[0], factor * s[1]) for s in bound.slabs)
        gap = Multilinear("none").fit(
            gc.plugin.GapProblem(
                *sampled(problem, residual),
                replace(bound, curvature=factor * bound.curvature, slabs=slabs),
                problem.predictor,
                problem.resolution,
                "dominate",
            )
        )
        low, high = gap.interval(z)
        outside.append(int(((r < low) | (r > high)).any(axis=1).sum()))
    assert outside[0] == 0
    assert outside[1] > 100


def sampled(problem, residual):
    z = lattice(problem.domain, (9, 15, 9))
    return gc.plugin.Samples(z, residual(z), lattice=tuple(np.unique(c) for c in z.T)), problem.domain


@pytest.mark.exam
@pytest.mark.parametrize("law", [OTHER, KINKED], ids=["smooth", "kinked"])
def test_a_deterministic_claim_without_declared_curvature_verifies(law, tmp_path):
    nominal, fhat = model(), model(law)
    domain, sizes = gc.Domain.of(nominal, ZONES), {}
    z = domain.draw(50_000, np.random.default_rng(8))
    r = gc.plugin.Residual(fhat, nominal)(z)
    for family, sampling in (("multilinear", gc.LatticeSampling(budget=1200)), ("envelope", gc.AdaptiveSampling(1200))):
        made = gc.certify(
            nominal,
            fhat,
            domain,
            sampling=sampling,
            lipschitz=IntervalJacobian(curvature=family == "multilinear"),
            family=gc.registry().get("gap_family", family).load()(),
            request=gc.Request("deterministic", 1e-2, 1e-3),
            folder=tmp_path / family,
        )
        made.save(tmp_path / family)
        assert made.claim.kind == "deterministic"
        low, high = made.gap.interval(z)
        assert ((low <= r) & (r <= high)).all()
        sizes[family] = float((high - low)[:, 1].mean())
        found = verify_run(tmp_path / family)
        assert found["verdict"] == "holds", [c for c in found["checks"] if not c["passed"]]
        rests = [a for a in made.assumptions if "second derivative of g = r − p along each axis" in a]
        assert len(rests) == (family == "multilinear")
        assert all(("where none is known (v)" in a) == (law == KINKED) for a in rests)
    assert sizes["multilinear"] < 0.5 * sizes["envelope"]
