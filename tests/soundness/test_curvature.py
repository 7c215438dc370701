"""Estimated curvature: near the truth where a field is smooth, and never a number where it has a kink."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rough_fields import Coarse

import gapcert as gc
from gapcert.certification.refutation import kinks
from gapcert_bounds.constants.gradient_elite import GradientElite
from gapcert_bounds.constants.wood_zhang import WoodZhang
from gapcert_bounds.testing.fields import Field, Kink, Nothing, Waves, lipschitz_problem

ESTIMATORS = {
    "gradient-elite": lambda **o: GradientElite(**{"budget": 12_000, "curvature": True, **o}),
    "wood-zhang": lambda **o: WoodZhang(**{"pairs": 600, "curvature": True, **o}),
}
estimators = pytest.mark.parametrize("name", ESTIMATORS)


@estimators
def test_smooth_fields_get_what_they_have(name):
    field = Waves.smooth()
    bound = ESTIMATORS[name](safety=1.0).bound(lipschitz_problem(field))
    assert {s["kind"] for s in bound.diagnostics["curvature"]} == {"smooth"}
    assert (bound.curvature <= field.curvature * 1.02).all()
    assert (bound.curvature >= 0.97 * field.curvature).all()
    twice = ESTIMATORS[name](safety=2.0).bound(lipschitz_problem(field))
    assert np.allclose(twice.curvature, 2 * bound.curvature)
    assert kinks(bound) is None


@estimators
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_kink_has_no_curvature(name, seed):
    """In one state along every axis where it has one; the other state keeps its numbers."""
    field = Half(Kink(np.array([[0.5, 0.25, 0.125], [0.0, 0.0, 0.0]]), np.array([0.1, -0.3, 0.2])))
    bound = ESTIMATORS[name]().bound(lipschitz_problem(field, seed=seed))
    kinds = {(s["state"], s["axis"]): s["kind"] for s in bound.diagnostics["curvature"]}
    assert all(kinds["x0", axis] == "kink" for axis in ("x0", "x1", "u0"))
    assert all(kinds["x1", axis] == "smooth" for axis in ("x0", "x1", "u0"))
    assert np.isinf(bound.curvature[0]).all()
    assert np.isfinite(bound.curvature[1]).all()
    assert "x0 along x1 (kink)" in kinks(bound)


@estimators
def test_noise_has_no_curvature(name):
    """Answers in steps of 1e-4 that are said to be exact to 1e-13."""
    field = Waves.smooth()
    problem = lipschitz_problem(field, backend=Coarse(field, 1e-4))
    lied = replace(problem, resolution=np.full(2, 1e-13))
    bound = ESTIMATORS[name](distance=0.05).bound(lied)
    assert np.isinf(bound.curvature).all()
    assert {s["kind"] for s in bound.diagnostics["curvature"]} <= {"kink", "noise", "unresolved"}


@estimators
def test_what_does_not_bend_is_bounded_by_its_resolution(name):
    field = Waves(np.array([[0.3, 0.0, 0.2]]), np.array([[2.0, 1.0, 3.0]]), np.zeros((1, 3)))
    bound = ESTIMATORS[name]().bound(lipschitz_problem(field))
    assert bound.curvature[0, 1] < 1e-8
    assert [s["inert"] for s in bound.diagnostics["curvature"]] == [False, True, False]


@estimators
def test_every_transition_is_counted_and_lies_in_the_domain(name):
    asked = []
    plain = lipschitz_problem(Waves.smooth())

    def query(round_, z):
        asked.append((round_, z))
        return plain.query(round_, z)

    bound = ESTIMATORS[name]().bound(replace(plain, query=query))
    assert bound.samples == sum(len(z) for _, z in asked)
    assert all(plain.domain.contains(z).all() for _, z in asked)
    assert len({round_ for round_, _ in asked}) == len(asked)
    if name == "gradient-elite":
        assert bound.samples < 12_000 + 6_000


def test_estimates_certify_and_a_kink_is_warned_of(tmp_path):
    field = Half(Kink(np.array([[0.5, 0.25, 0.125], [0.0, 0.0, 0.0]]), np.array([0.1, -0.3, 0.2])))
    said = []
    made = gc.certify(
        Nothing(field),
        field,
        field.domain,
        sampling=gc.LatticeSampling(budget=600),
        lipschitz=GradientElite(budget=12_000, curvature=True),
        family=gc.registry().build("gap_family", "multilinear"),
        request=gc.Request("statistical", 1e-2, 1e-3, attack=20_000),
        folder=tmp_path / "run",
        emit=said.append,
    )
    made.save(tmp_path / "run")
    assert made.holds
    assert any("Second differences" in e.data["message"] for e in said if e.name == "warning")
    assert any("Second differences" in w for w in made.summary()["warnings"])
    assert any("(x0) it rests on the Lipschitz constants" in s for s in made.assumptions)
    assert made.states["x1"].tightness < 1.1 < made.states["x0"].tightness


class Half(Field):
    """A kinky state x0 beside a smooth x1."""

    def __init__(self, kink):
        super().__init__(2, 1)
        self.kink, self.waves = kink, Waves.smooth()
        self.constants = np.vstack([kink.constants[:1], self.waves.constants[1:]])

    def _step(self, x, u, **options):
        return np.hstack([self.kink.step(x, u).x[:, :1], self.waves.step(x, u).x[:, 1:]])

    def enclosure(self, z):
        return gc.Interval.concatenate([self.kink.enclosure(z)[:, :1], self.waves.enclosure(z)[:, 1:]], axis=1)

    def jacobian_enclosure(self, z):
        parts = [self.kink.jacobian_enclosure(z)[:, :1], self.waves.jacobian_enclosure(z)[:, 1:]]
        return gc.Interval.concatenate(parts, axis=1)
