"""Backend `stochastic`: what it draws, that a row draws from (seed, row) alone, and its place in a spec."""

from __future__ import annotations

import numpy as np
import pytest

import gapcert as gc
from gapcert.contracts.systems.system import step_seed
from gapcert.numerics.counter_rng import keys, normals, uniforms
from gapcert.spec.schema import schema
from gapcert.testing import SystemContract
from gapcert.testing.systems import ToyOscillator
from gapcert.testing.toys import Drift
from gapcert_calibrate.stochastic_backend import Stochastic

MODEL = {
    "kind": "equations",
    "states": {"x": "m", "v": "m/s"},
    "inputs": {"a": "m/s^2"},
    "parameters": {"c": "0.4 1/s"},
    "derivative": {"x": "v", "v": "a - c*v"},
    "integrator": "euler",
    "period": "0.1 s",
}
NOISY = {
    "kind": "stochastic",
    "of": MODEL,
    "sensor_noise": {"x": "1 mm"},
    "jitter": "2 ms",
    "parameters": {"c": [0.9, 1.1]},
}
SPEC = {"version": 1, "name": "noisy", "model": MODEL, "backend": NOISY, "domain": {"x": [-1, 1], "v": [-1, 1], "a": [-2, 2]}}
N = 20_000


def drift(**options):
    return Stochastic(Drift(1), **options)


def draw(system, n=N, seed=3):
    return system.step(np.zeros((n, 1)), np.ones((n, 1)), seed=seed).x[:, 0]


class TestStochastic(SystemContract):
    def system(self):
        return Stochastic(ToyOscillator(), noise={"theta": 1e-3}, jitter=1e-3, factors={"k": (0.9, 1.1)})


class TestStochasticOfStochastic(SystemContract):
    def system(self):
        return Stochastic(ToyOscillator(noise=1e-3), noise={"omega": 1e-3})


class TestDrawnRange(SystemContract):
    def system(self):
        return Stochastic(ToyOscillator(), ranges={"k": (0.5, 3.0)})


def test_noise_is_gaussian_of_the_stated_size():
    x = draw(drift(noise={"x0": 1e-3})) - 0.1
    assert abs(x.mean()) < 5e-3 / np.sqrt(N)
    assert x.std() == pytest.approx(1e-3, rel=5 / np.sqrt(2 * N))
    # Fourth moment of a normal distribution: 3; its own standard deviation is √(96/n).
    assert ((x / x.std()) ** 4).mean() == pytest.approx(3, abs=5 * np.sqrt(96 / N))


def test_jitter_stays_on_the_line_through_the_samples():
    late = (draw(drift(jitter=0.02)) - 0.1) / 0.1
    assert np.abs(late).max() <= 0.2
    assert np.abs(late).max() > 0.199
    assert abs(late.mean()) < 5 * 0.2 / np.sqrt(3 * N)


def test_parameters_are_factors_or_ranges():
    fall = gc.load_spec(SPEC).build("model")
    x, u = np.tile([0.0, 1.0], (N, 1)), np.zeros((N, 1))

    def c(system, **options):
        return (1 - system.step(x, u, seed=1, **options).x[:, 1]) / 0.1

    scaled = c(Stochastic(fall, factors={"c": (0.9, 1.1)}))
    assert (scaled.min(), scaled.max()) == pytest.approx((0.36, 0.44), rel=1e-3)
    given = c(Stochastic(fall, factors={"c": (0.9, 1.1)}), parameters={"c": 2.0})
    np.testing.assert_allclose(given, scaled * 5)
    absolute = Stochastic(fall, ranges={"c": (0.0, 0.1)})
    assert (c(absolute).min(), c(absolute).max()) == pytest.approx((0.0, 0.1), abs=1e-4)
    assert absolute.parameters == ()


def test_without_a_seed_nothing_is_drawn():
    system = drift(noise={"x0": 1e-3}, jitter=0.02)
    x = np.random.default_rng(0).uniform(-1, 1, (20, 1))
    np.testing.assert_array_equal(system.step(x, x).x, Drift(1).step(x, x).x)


def test_a_row_draws_from_seed_and_row_alone():
    system = drift(noise={"x0": 1e-3}, jitter=0.02)
    np.testing.assert_array_equal(draw(system, 50), draw(system, 5000)[:50])
    assert len(np.unique(draw(system))) == N
    assert abs(np.corrcoef(draw(system), draw(system, seed=4))[0, 1]) < 5 / np.sqrt(N)
    x = draw(system) - 0.1
    assert abs(np.corrcoef(x[1:], x[:-1])[0, 1]) < 5 / np.sqrt(N)


def test_a_rollout_draws_anew_in_each_step():
    system = drift(noise={"x0": 1e-3})
    run = system.rollout(np.zeros((3, 1)), np.zeros((3, 40, 1)), seed=7).x[:, :, 0]
    steps = np.diff(run, axis=1)
    assert len(np.unique(steps)) == steps.size
    np.testing.assert_array_equal(run[:, 1], system.step(np.zeros((3, 1)), np.zeros((3, 1)), seed=step_seed(7, 0)).x[:, 0])


def test_streams_are_uniform_and_independent():
    key = keys(0, np.arange(N, dtype=float)[:, None])
    u = uniforms(key, 3)
    assert ((u >= 0) & (u < 1)).all()
    counts = np.histogram(u, 20, (0, 1))[0]
    assert np.abs(counts - 3 * N / 20).max() < 5 * np.sqrt(3 * N / 20)
    assert np.abs(np.corrcoef(u.T) - np.eye(3)).max() < 5 / np.sqrt(N)
    np.testing.assert_array_equal(uniforms(key, 1, 2)[:, 0], u[:, 2])
    assert normals(key, 1).std() == pytest.approx(1, rel=5 / np.sqrt(2 * N))
    np.testing.assert_array_equal(keys(1, np.array([[0.0]])), keys(1, np.array([[-0.0]])))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "nothing is drawn"),
        ({"jitter": 0.2}, "jitter is 0.2 s; expected less than the period of 0.1 s"),
        ({"factors": {"m": (0.9, 1.1)}}, "there is no parameter 'm'; there are none"),
    ],
)
def test_what_cannot_be_drawn_is_refused(options, message):
    with pytest.raises(gc.UsageError, match=message):
        drift(**options)


def test_parameters_stay_in_their_bounds():
    with pytest.raises(gc.UsageError, match=r"k would be drawn from \[-1, 1\]"):
        Stochastic(ToyOscillator(), ranges={"k": (-1.0, 1.0)})


def test_a_spec_wraps_any_backend():
    system = gc.load_spec(SPEC).build("backend")
    assert isinstance(system, Stochastic)
    assert (system.noise, system.jitter, system.factors) == ({"x": 1e-3}, 2e-3, {"c": (0.9, 1.1)})
    absolute = {**NOISY, "parameters": {"c": {"range": ["0.1 1/s", "0.2 1/s"]}}}
    assert gc.load_spec({**SPEC, "backend": absolute}).build("backend").ranges == {"c": (0.1, 0.2)}
    with pytest.raises(gc.SpecError, match=r"backend\.sensor_noise\.y: unknown state 'y'; known: v, x"):
        gc.load_spec({**SPEC, "backend": {**NOISY, "sensor_noise": {"y": 1}}}).build("backend")
    with pytest.raises(gc.SpecError, match="unit 'rad' does not fit; expected m"):
        gc.load_spec({**SPEC, "backend": {**NOISY, "sensor_noise": {"x": "1 rad"}}}).build("backend")


TEXT = """\
version: 1
name: noisy
backend:
  kind: stochastic
  jitter: 1 ms
  of:
    kind: equations
    states: {x: m}
    inputs: {u: m/s}
    derivative: {x: u}
    integrator: rk5
    period: 0.1 s
"""


@pytest.mark.parametrize(
    ("text", "place", "message"),
    [
        (TEXT, "11:17", "backend.of.integrator: found 'rk5'"),
        (TEXT.replace("rk5", "rk4").replace("{x: u}", "{x: w}"), "10:21", "backend.of.derivative.x"),
        (TEXT.replace("kind: equations", "kind: equation"), "7:11", "backend.of.kind: no plugin provides backend 'equation'"),
        (TEXT.replace("rk5", "rk4").replace("1 ms", "-1 ms"), "5:11", "backend.jitter: found '-1 ms'; expected a time of 0"),
        (TEXT.replace("rk5", "rk4").replace("  jitter: 1 ms\n", ""), "4:3", "backend: expected at least one of sensor_noise"),
    ],
)
def test_faults_inside_are_told_at_their_place(tmp_path, text, place, message):
    path = tmp_path / "noisy.yaml"
    path.write_text(text)
    with pytest.raises(gc.SpecError) as told:
        gc.load_spec(path)
    assert f"noisy.yaml:{place}: error: {message}" in str(told.value)


def test_the_schema_knows_the_backend_inside():
    definitions = schema()["$defs"]
    assert definitions["backend.stochastic"]["properties"]["of"]["$ref"] == "#/else/properties/backend"


def test_a_stochastic_backend_has_no_certificate(tmp_path):
    spec = {**SPEC, "certificate": {"claim": "empirical"}}
    with pytest.raises(gc.UsageError, match="the backend is stochastic"):
        gc.run(spec, out=tmp_path)


@pytest.mark.parametrize(
    ("noise", "column", "says"),
    [("q: 0.1", 5, "backend.sensor_noise.q: unknown state 'q'"), ("p: 1 s", 8, "unit 's' does not fit; expected m")],
)
def test_noise_is_checked_where_it_is_written(noise, column, says):
    model = "{kind: equations, states: {p: m}, inputs: {u: m/s}, parameters: {T: 1 s}, next: {p: p + T*u}, period: 1 s}"
    text = f"""\
version: 1
name: noisy
model: {model}
backend:
  kind: stochastic
  of: {model}
  sensor_noise:
    {noise}
domain: {{p: [0, 1], u: [0, 1]}}
"""
    with pytest.raises(gc.SpecError) as caught:
        gc.load_spec(text)
    assert f"<text>:8:{column}: error" in str(caught.value)
    assert says in str(caught.value)
