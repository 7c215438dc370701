"""The estimator gradient-elite, and the sweep over distances that it shares with wood-zhang."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rough_fields import Bump, Coarse

import gapcert as gc
from gapcert.certification.refutation import growth_warning
from gapcert.certification.samples.executors import threads
from gapcert.testing import LipschitzContract
from gapcert_bounds.config import GradientEliteConfig
from gapcert_bounds.constants.gradient_elite import GradientElite
from gapcert_bounds.constants.wood_zhang import WoodZhang
from gapcert_bounds.testing.fields import Kink, Nothing, Waves, lipschitz_problem

SWEPT = pytest.mark.parametrize("estimator", [WoodZhang(pairs=1000), GradientElite(budget=4000)], ids=["wood-zhang", "elite"])


class TestGradientElite(LipschitzContract):
    def estimator(self):
        return GradientElite()


class TestGradientEliteOfWaves(LipschitzContract):
    def estimator(self):
        return GradientElite(budget=3000)

    def field(self):
        return Waves.smooth()


def asked(g, nz, seed=0, nx=1):
    """The problem of a plain function g of z (n, nz) on [−1, 1]^nz; its first nx axes are states."""
    flat = Kink(np.zeros((nx, nz)), np.zeros(nz))
    return replace(lipschitz_problem(flat, seed=seed), query=lambda _, z: g(z).reshape(len(z), nx))


def kinds(bound):
    return {(s["state"], s["axis"]): s["kind"] for s in bound.diagnostics["sweep"]}


@pytest.mark.parametrize("field", [Waves.smooth(), Kink(np.array([[0.5, 0.25, 0.1], [0.4, 1.0, 0.3]]), np.full(3, 0.2))])
def test_it_recovers_constants_and_claims_no_more_than_estimates(field):
    problem = lipschitz_problem(field, seed=2)
    bare, bound = GradientElite(safety=1).bound(problem), GradientElite().bound(problem)
    assert np.allclose(bare.value, field.constants, rtol=1e-3)
    assert (bare.value <= field.constants * (1 + 1e-9)).all(), "a slope that does not occur"
    assert np.allclose(bound.value, 1.2 * bare.value)
    assert (bound.lower <= field.constants).all()
    assert (bound.provenance, bound.safety) == ("estimated", 1.2)
    assert bound.steep.shape == (2, 3, 2, 3)
    assert gc.registry().get("lipschitz", "gradient-elite").claim == "statistical"


@pytest.mark.exam
@pytest.mark.parametrize(
    ("g", "truth"),
    [
        (lambda z: (z**2).sum(axis=1) / 2, np.ones(4)),
        (lambda z: np.sin(z * [1.0, 2.0, 3.0, 4.0]).sum(axis=1), np.array([1.0, 2.0, 3.0, 4.0])),
        (lambda z: np.prod(1 + z, axis=1), np.full(4, 8.0)),
    ],
    ids=["squares", "sines", "product"],
)
def test_it_comes_closer_than_wood_zhang_at_the_same_transitions(g, truth):
    errors = []
    for estimator in (GradientElite(safety=1, budget=4000), WoodZhang(safety=1, pairs=500)):
        values = np.array([estimator.bound(asked(g, 4, seed)).value[0] for seed in range(10)])
        errors.append(np.abs(values / truth - 1).mean())
    assert errors[0] < errors[1] / 2


def test_a_narrow_bump_is_missed():
    """What no pair of the first round came near is not searched: the estimate stays below the truth, safety or not."""
    field = Bump(Waves.smooth(), 0.03, 0.03, np.array([0.31, -0.4, 0.6]))
    values = np.array([GradientElite(budget=3000).bound(lipschitz_problem(field, seed=s)).value for s in range(10)])
    assert (values < field.constants).any(axis=(1, 2)).mean() >= 0.5


def test_pairs_stay_within_relations_and_held_axes_are_left_alone():
    field, seen = Waves.smooth(), []
    domain = gc.Domain(field.domain.states, field.domain.inputs, (gc.plugin.Relation("x0 + x1 <= 0.3", (1.0, 1.0, 0.0), 0.3),))
    plain = replace(lipschitz_problem(field), domain=domain, held=(2,))

    def query(name, z):
        seen.append((name, z))
        return plain.query(name, z)

    bound = GradientElite(budget=3000).bound(replace(plain, query=query))
    assert all(domain.contains(z).all() for _, z in seen)
    assert sum(len(z) for _, z in seen) == bound.samples
    assert not any("u0" in name for name, _ in seen)
    assert (bound.value[:, 2] == 0).all()
    assert (bound.value[:, :2] > 0.05).all()


def test_hidden_states_that_a_pair_has_in_common_are_no_slope():
    """r = ½ x0 + h with h drawn for each pair: single answers differ by h, pairs do not."""
    plain = asked(lambda z: z[:, 0] / 2, 2)
    rng = np.random.default_rng(4)
    problem = replace(
        plain,
        query=lambda _, z: (z[:, 0] / 2 + rng.random(len(z)))[:, None],
        paired=lambda _, both: (both[:, 2] - both[:, 0])[:, None] / 2,
        resolution=np.array([1.0]),
        rounding=plain.resolution,
    )
    for estimator in (GradientElite(budget=2000), WoodZhang(pairs=500)):
        bound = estimator.bound(problem)
        assert bound.value[0, 0] == pytest.approx(0.6, rel=1e-9)
        assert kinds(bound) == {("x0", "x0"): "smooth", ("x0", "u0"): "unresolved"}


def test_an_inert_axis_gets_what_the_resolution_may_hide():
    problem = lipschitz_problem(Kink(np.array([[0.5, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.zeros(3)))
    bound = GradientElite().bound(problem)
    assert bound.diagnostics["u0"]["inert"] == [True, True]
    assert (bound.lower[:, 2] == 0).all()
    assert (bound.value[:, 2] <= 4 * problem.resolution / (0.5e-2 * 2) * (1 + 1e-9)).all()
    assert (bound.value[:, 2] >= 2 * problem.resolution / (0.5e-2 * 2)).all()


def test_what_cannot_be_done_is_refused():
    with pytest.raises(gc.UsageError, match="100 transitions is 16 pairs for each of 3 axes; give at least 216"):
        GradientElite(budget=100).bound(lipschitz_problem(Waves.smooth()))
    with pytest.raises(gc.UsageError, match=r"gradient-elite: pairs along .* are too close for 'x\d'.*set distance: 0\.\d+$"):
        GradientElite(distance=1e-4).bound(lipschitz_problem(Waves.smooth(), backend=Coarse(Waves.smooth(), 1e-5)))
    with pytest.raises(ValueError, match="budget"):
        GradientEliteConfig(kind="gradient-elite", budget=10)


@SWEPT
@pytest.mark.parametrize("seed", range(3))
def test_the_sweep_tells_smooth_from_jump_and_noise(estimator, seed):
    rng = np.random.default_rng(seed)
    smooth = estimator.bound(asked(lambda z: z[:, 0] / 2 + np.sin(3 * z[:, 1]), 2, seed))
    assert set(kinds(smooth).values()) == {"smooth"}
    jump = estimator.bound(asked(lambda z: z[:, 0] / 2 + 0.1 * z[:, 1] + 0.02 * (z[:, 0] > 0.123), 2, seed))
    assert kinds(jump) == {("x0", "x0"): "jump", ("x0", "u0"): "smooth"}
    noise = estimator.bound(asked(lambda z: z[:, 0] / 2 + 1e-4 * rng.standard_normal(len(z)), 2, seed))
    assert set(kinds(noise).values()) == {"noise"}
    for found in smooth.diagnostics["sweep"] + jump.diagnostics["sweep"] + noise.diagnostics["sweep"]:
        assert np.allclose(np.divide(found["distances"][:-1], found["distances"][1:]), 4, rtol=1e-6)
        assert len(found["distances"]) == len(found["slopes"])


def test_the_sweep_of_a_jump_grows_by_four_at_each_step():
    found = WoodZhang().bound(asked(lambda z: 0.02 * (z[:, 0] > 0.123), 2)).diagnostics["sweep"][0]
    assert np.allclose(np.divide(found["slopes"][1:], found["slopes"][:-1]), 4)
    assert np.allclose(np.multiply(found["slopes"], found["distances"]), 0.02)


@pytest.mark.parametrize("estimator", [WoodZhang(distance=0.05), GradientElite(distance=0.05)], ids=["wood-zhang", "elite"])
def test_the_sweep_does_not_judge_what_the_resolution_hides(estimator):
    # Steps of 3e-4 would be jumps for a sweep that did not know of them.
    bound = estimator.bound(lipschitz_problem(Waves.smooth(), backend=Coarse(Waves.smooth(), 3e-4)))
    assert set(kinds(bound).values()) <= {"smooth", "unresolved"}
    assert kinds(bound)["x1", "x0"] == "unresolved"


def certified(folder, field, backend, **more):
    return gc.certify(Nothing(field), backend, field.domain, folder=folder, executor=threads, **more)


class Noisy(gc.Backend):
    """A field whose answers carry waves that are too short for pairs, and too long to be taken for jitter."""

    def __init__(self, field, size):
        self.states, self.inputs, self.period = field.states, field.inputs, field.period
        self.field, self.size = field, size

    def _step(self, x, u, **options):
        phase = 1e5 * np.hstack([x, u]).sum(axis=1)
        return self.field.step(x, u).x + self.size * np.sin(phase)[:, None]

    def resolution(self, magnitude):
        return self.field.resolution(magnitude)


def test_a_warning_says_what_the_sweep_found_where_growth_is_silent(tmp_path):
    field, said = Kink(np.array([[0.5, 0.25]]), np.array([2.0, 2.0])), []
    noisy = Noisy(field, 1e-4)
    certificate = certified(tmp_path, field, noisy, lipschitz=GradientElite(budget=2000), emit=said.append)
    diagnostics = dict(certificate.lipschitz.diagnostics)
    assert {s["kind"] for s in diagnostics["sweep"]} == {"noise"}
    # What follows single pairs may take noise for a jump, and is not believed where the sweep knows better.
    followed = {"state": 0, "axis": 0, "where": [0.1, 0.2], "size": 1e-4, "distances": [1e-2, 1e-4], "slopes": [0.01, 1.0]}
    both = replace(certificate.lipschitz, diagnostics=diagnostics | {"growth": followed})
    assert "seems to be noisy beyond its resolution" in growth_warning(both, field.domain.axes)
    alone = replace(both, diagnostics={"growth": followed})
    assert "seems to jump there" in growth_warning(alone, field.domain.axes)
    diagnostics.pop("growth", None)
    silent = replace(certificate.lipschitz, diagnostics=diagnostics)
    assert "seems to be noisy beyond its resolution" in growth_warning(silent, field.domain.axes)
    assert [e.data["message"] for e in said if e.name == "warning" and e.stage == "lipschitz"]
    jump = {"state": "x0", "axis": "u0", "distances": [1e-2, 1e-3], "slopes": [1.0, 10.0], "kind": "jump"}
    silent = replace(silent, diagnostics={"sweep": [*diagnostics["sweep"], jump]})
    assert "x0 along u0 grew from 1 to 10 as the distance shrank from 0.01 to 0.001: f̂ − f seems to jump" in growth_warning(
        silent, field.domain.axes
    )
    assert growth_warning(replace(silent, diagnostics={"sweep": []}), field.domain.axes) is None


def test_a_spec_with_gradient_elite_runs(tmp_path):
    model = {
        "kind": "equations",
        "states": {"x": "1"},
        "inputs": {"u": "1"},
        "parameters": {"c": "0.2"},
        "next": {"x": "x + c*sin(x) + u"},
        "period": "0.1 s",
    }
    spec = {
        "version": 1,
        "name": "small",
        "model": model,
        "backend": model | {"parameters": {"c": "0.3"}},
        "domain": {"x": [-1, 1], "u": [-1, 1]},
        "lipschitz": {"residual": {"kind": "gradient-elite", "budget": 2000}},
        "certificate": {"claim": "empirical"},
    }
    run = gc.run(spec, out=tmp_path)
    assert run.exit_code == 0
    stated = run.summary["certificate"]["lipschitz"]
    assert stated["provenance"] == "estimated"
    assert stated["method"] == "gradient-elite (500 pairs in 8 rounds per axis)"
    assert stated["safety"] == 1.2
