"""The cart-pole and the quadrotor against MuJoCo: the band holds where a loop goes, and over boxes its remainder is thin."""

from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

import gapcert as gc
from gapcert.contracts.gaps.predictor import AffinePredictor
from gapcert_bounds.families.multilinear import MultilinearGap
from gapcert_report import illustrator

pytestmark = [pytest.mark.contract, pytest.mark.needs("mujoco")]

SPECS = Path(__file__).parents[2] / "specs"
MUTED = ("report.html=false", "report.rerun=false")
LESS = ("sampling.budget=400", "lipschitz.residual.budget=6000", "certificate.violation=1e-2", "certificate.attack=1000")
ALONE = ("controller=null", "closed_loop=null", "expect={verdict: holds, certificate.audit.violations: 0}")
FEWER = ("closed_loop.starts=8", "closed_loop.steps=40")
STEADY = {"cartpole": [0.0], "quadrotor": [3.924, 3.924]}
PUSHED = {"cartpole": {"x_dot": 0.01, "theta_dot": 0.01}, "quadrotor": {"vz": 0.05, "rate": 0.05}}
"""States that the inputs move directly, and which share of that the remainder may be."""


def rollouts(name, runs=60, steps=60):
    """z and r along runs of a linear feedback, with noise on the inputs, while they are in the domain."""
    spec, rng, steady = gc.load_spec(SPECS / f"{name}.yaml"), np.random.default_rng(0), np.array(STEADY[name])
    model = spec.build("model")
    system, nx = spec.build("backend", model=model), model.nx
    domain = gc.Domain.of(model, dict(spec.config.domain))
    low, high = np.array(domain.low), np.array(domain.high)
    q, w = np.diag(1 / high[:nx] ** 2), np.diag(1 / (high - low)[nx:] ** 2)
    slopes = model.jacobian(np.zeros((1, nx)), steady[None])[0]
    a, b = slopes[:, :nx], slopes[:, nx:]
    p = solve_discrete_are(a, b, q, w)
    gain = np.linalg.solve(w + b.T @ p @ b, b.T @ p @ a)
    x, zs, rs = rng.uniform(-0.4, 0.4, (runs, nx)) * high[:nx], [], []
    for _ in range(steps):
        u = np.clip(steady - x @ gain.T + rng.uniform(-0.3, 0.3, (runs, model.nu)), low[nx:], high[nx:])
        z, after = np.concatenate([x, u], axis=1), system.step(x, u).x
        inside = ((z >= low) & (z <= high)).all(axis=1)
        zs.append(z[inside])
        rs.append((after - model.step(x, u).x)[inside])
        x = after
    return domain, np.concatenate(zs), np.concatenate(rs)


def outside(gap, z, r):
    low, high = gap.interval(z)
    return int(((r < low) | (r > high)).any(axis=1).sum())


def without_predictor(gap, curvature, constants):
    none = AffinePredictor.none(len(gap.resolution), len(gap.inner.axes))
    return MultilinearGap(gap.inner.axes, gap.inner.values, curvature, constants, gap.resolution, none)


def holds(name, gap):
    """On points that no fit and no audit saw; with a tenth of what curvature and constants allow for, it does not."""
    domain, z, r = rollouts(name)
    assert len(z) > 1500
    assert outside(gap, z, r) == 0
    thinner = without_predictor(gap, [h / 10 for h in gap.curvature], gap.lipschitz_values / 10)
    assert outside(thinner, z, r - gap.predictor(z)) > 100
    return domain


def thin(name, gap, domain):
    """The remainder's supremum over boxes of a tenth of the domain's width, beside what the inputs can do in a period."""
    model = gc.load_spec(SPECS / f"{name}.yaml").build("model")
    low, high, rng = np.array(domain.low), np.array(domain.high), np.random.default_rng(1)
    centre = rng.uniform(low + 0.05 * (high - low), high - 0.05 * (high - low), (300, len(low)))
    boxes = gc.Interval(centre - 0.05 * (high - low), centre + 0.05 * (high - low))
    mean = without_predictor(gap, gap.curvature, gap.lipschitz_values).interval_over(boxes).mag.mean(axis=0)
    moved = np.abs(model.jacobian(np.zeros((1, model.nx)), np.array([STEADY[name]]))[0][:, model.nx :])
    authority = moved @ (high - low)[model.nx :] / 2
    for state, share in PUSHED[name].items():
        k = [s.name for s in model.states].index(state)
        assert mean[k] <= share * authority[k], state


@pytest.mark.run
def test_a_cheaper_certificate_of_the_cart_pole(tmp_path):
    run = gc.run(gc.load_spec(SPECS / "cartpole.yaml", (*MUTED, *LESS, *ALONE)), out=tmp_path)
    assert run.exit_code == 0
    holds("cartpole", run.certificate.gap)


@pytest.mark.exam
@pytest.mark.parametrize("name", STEADY)
def test_the_spec_meets_what_it_expects(name, tmp_path, monkeypatch):
    # A third of the run would be one picture, which other tests draw.
    monkeypatch.setattr(illustrator, "winning_figure", lambda *_, **__: None)
    run = gc.run(gc.load_spec(SPECS / f"{name}.yaml", (*MUTED, *FEWER)), out=tmp_path)
    assert run.exit_code == 0
    assert len(run.summary["expectations"]) == 14
    thin(name, run.certificate.gap, holds(name, run.certificate.gap))
