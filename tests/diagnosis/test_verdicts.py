"""What an answer is held to: rollouts over data that no fit has seen."""

import numpy as np
import pytest
from scipy.signal import lfilter

import gapcert as gc
from gapcert.plugin import Recording, Trajectory
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.fitting.fit import fit
from gapcert_diagnosis.fitting.rollout_error import Stretches
from gapcert_diagnosis.residual.adequacy import by_noise
from gapcert_diagnosis.search.candidates import Library


def equations(section):
    config = gc.registry().config("model", "equations").model_validate({"kind": "equations", **section})
    return gc.registry().build("model", "equations", config, gc.Context(None))


def log(t, **channels):
    return Recording((Trajectory(t, channels, "log"),), {}, "zero")


def stepped(f, x, t, u=None, parts=20):
    """States (n, k) of ẋ = f(x, u) at times t, by the classical method of Runge and Kutta in parts of a step."""
    out, d = [], (t[1] - t[0]) / parts
    for i in range(len(t)):
        out.append(x)
        a = 0.0 if u is None else u[i]
        for _ in range(parts):
            k1 = f(x, a)
            k2 = f(x + d / 2 * k1, a)
            k3 = f(x + d / 2 * k2, a)
            x = x + d / 6 * (k1 + 2 * k2 + 2 * k3 + f(x + d * k3, a))
    return np.array(out)


SPRING = {
    "period": "0.02 s",
    "coordinates": {"x": "m"},
    "parameters": {"m": "2 kg", "k": "30 N/m"},
    "mass_matrix": [["m"]],
    "bias": {"x": "k*x"},
}


@pytest.fixture(scope="module")
def ringing():
    """A spring that swings freely, with 0.4 % of noise: damped by so much (N·s/m)."""

    def of(damping, seed=5):
        t = 0.02 * np.arange(2000)
        x = stepped(lambda x, _: np.array([x[1], -15 * x[0] - damping / 2 * x[1]]), np.array([0.5, 0.0]), t, parts=5)[:, 0]
        return log(t, x=x + 0.004 * np.std(x) * np.random.default_rng(seed).normal(size=len(t)))

    return of


def found_in(recording, section, **more):
    more = {"hold_out": {"last": "33 %"}, "horizons": [2.0, 8.0]} | more
    effects = ["viscous-friction", "coulomb-friction", "quadratic-drag", "linear-spring", "constant-force", "cogging"]
    return gc.diagnose(equations(section), recording, more.pop("effects", effects), **more)


def test_what_long_rollouts_ask_for_is_named_however_little_force_it_is(ringing):
    """2 √(m k)/Q with Q = 300: a windowful of it is less than an integrator may leave."""
    found = found_in(ringing(0.052), SPRING)
    (cause,) = found.causes
    assert (found.verdict, cause.effect) == ("causes", "viscous-friction")
    assert cause.parameters["coefficient"].value == pytest.approx(0.052, rel=0.1)
    assert found.gain["8"]["x"].after < 0.5 * found.gain["8"]["x"].before


def test_nothing_is_named_where_nothing_damps(ringing):
    found = found_in(ringing(0.0), SPRING)
    assert (found.verdict, found.causes, found.negligible) == ("nothing", (), ())


WHEEL = {
    "period": "0.01 s",
    "states": {"v": "m/s"},
    "inputs": {"u": "V"},
    "parameters": {"K": {"value": "0.5 m/s/V", "tolerance": "5 %"}, "tau": {"value": "0.1 s", "tolerance": "5 %"}},
    "derivative": {"v": "(K*u - v)/tau"},
}


def test_held_out_data_decide_between_what_the_fitted_ones_cannot_tell_apart():
    """A dead zone is dry friction until the drive is off: then one coasts, and the other stops."""
    rng, t = np.random.default_rng(2), 0.01 * np.arange(1200)
    u = np.repeat([2.0, 1.0, 3.0, 1.5, 2.5, 1.2, 2.2, 2.8, 1.4, 0.0, 2.0, 0.0], 100)
    v = stepped(lambda x, a: (0.5 * np.sign(a) * max(abs(a) - 0.3, 0.0) - x) / 0.1, np.array([0.0]), t, u, 10)[:, 0]
    recording = log(t, v=v + 0.004 * rng.normal(size=len(t)), u=u)
    found = found_in(
        recording, WHEEL, effects=["coulomb-friction", "input-dead-zone"], hold_out={"last": "30 %"}, horizons=[1.0]
    )
    assert (found.verdict, [c.effect for c in found.causes]) == ("causes", ["input-dead-zone"])
    assert found.ambiguous_with == ()
    assert any("the held-out data" in a and "had a say" in a for a in found.assumptions)
    rival = found.causes[0].runner_up
    assert rival.effect == "coulomb-friction"
    assert rival.leaves["v"] > 2 * found.gain["1"]["v"].after


def test_a_stand_in_that_leaves_much_of_the_motion_is_a_part_and_no_cause():
    """Play in a valve, where the library has a law of force alone."""
    rng, t, at = np.random.default_rng(4), 0.01 * np.arange(3000), 0.0
    u = np.repeat(rng.uniform(-2, 2, 60), 50) + 0.5 * np.sin(2 * t)
    w = np.empty(len(t))
    for i, a in enumerate(u):
        at = min(max(at, a - 0.8), a + 0.8)
        w[i] = at + 0.15 * at**3
    v = stepped(lambda x, a: (0.5 * a - x) / 0.1, np.array([0.0]), t, w, 5)[:, 0]
    recording = log(t, v=v + 0.002 * rng.normal(size=len(t)), u=u)
    found = found_in(recording, WHEEL, effects=["backlash", "input-gain", "input-saturation"], horizons=[0.5, 3.0])
    told = found.summary()
    assert found.verdict == "unexplained"
    assert all(c["partial"] for c in told["causes"])
    assert "does not show to be a cause" in found.sentence() or not told["causes"]


def test_numbers_that_cannot_be_are_no_cause():
    rng, t = np.random.default_rng(6), 0.02 * np.arange(1500)
    x = stepped(lambda x, _: np.array([x[1], -15 * x[0] + 0.05 * x[1]]), np.array([0.1, 0.0]), t, parts=5)[:, 0]
    found = found_in(log(t, x=x + 0.001 * rng.normal(size=len(t))), SPRING, effects=["viscous-friction"], horizons=[2.0])
    assert found.verdict == "unexplained"
    (cause,) = found.causes
    assert cause.flags[0].startswith("implausible")
    assert "no effect in the library explains with plausible numbers" in found.sentence()


@pytest.mark.parametrize("colour", [0.0, 0.8])
def test_what_noise_makes_of_long_rollouts_is_known(colour):
    """Of nothing else: the errors of eight logs are what noise alone would make of them."""
    model, shares = equations(SPRING), []
    t = 0.02 * np.arange(2000)
    x = stepped(lambda x, _: np.array([x[1], -15 * x[0]]), np.array([0.5, 0.0]), t, parts=5)[:, 0]
    for seed in range(8):
        noise = lfilter([np.sqrt(1 - colour**2)], [1, -colour], np.random.default_rng(seed).normal(size=2300))[300:]
        measured = Dataset.of(model, log(t, x=x + 0.01 * noise))
        windows, judge = measured.windows(60), Stretches.of(measured, 8.0)
        last = fit(Library(model, measured, []).hypothesis(()), windows)
        shares.append(float(judge.floors(last)[0] / by_noise(judge, last, seed)[0]))
    assert 0.7 < np.mean(shares) < 1.4
    assert max(shares) < 2.0
