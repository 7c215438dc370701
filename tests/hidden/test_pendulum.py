"""Effects hidden in PyBullet's pendulum are found by name and number, and nothing is found where nothing is hidden."""

from pathlib import Path

import pytest
from exams.hide import hide

import gapcert as gc
from gapcert.testing import multisine

SPECS = Path(__file__).parents[2] / "specs"
NOMINAL = {
    "kind": "equations",
    "coordinates": {"theta": {"unit": "rad", "kind": "angle"}},
    "inputs": {"torque": "N*m"},
    "parameters": {"m": {"value": "1 kg", "tolerance": "2 %"}, "l": "1 m", "g": "9.81 m/s^2"},
    "mass_matrix": [["m*l**2/3"]],
    "bias": {"theta": "m*g*l/2*sin(theta)"},
    "forces": {"theta": "torque"},
    "integrator": "rk4",
    "period": "10 ms",
}
CASES = {
    "coulomb-friction": ("theta", "level", 0.08, 5),
    "viscous-friction": ("theta", "coefficient", 0.05, 5),
    "input-delay": ("torque", "delay", 0.015, 20),
    "input-gain": ("torque", "gain", 0.8, 5),
    "constant-force": ("theta", "force", 0.1, 5),
}
# In this model a mass and a gain are one number, and the one that comes first in the order of the contract is named.
EQUAL = {"input-gain": ("parameter", "m")}
MAIN = ("coulomb-friction", "viscous-friction", "input-delay")


def build(kind, section):
    config = gc.registry().config(kind, section["kind"]).model_validate(section)
    return gc.registry().build(kind, section["kind"], config, gc.Context(SPECS))


def recorded(effects, decimate, seed):
    """12 s at 100 Hz of PyBullet without its own damping, 1 mrad of noise on the angle, `decimate` engine steps per sample."""
    pytest.importorskip("pybullet")
    pendulum = build(
        "backend",
        {
            "kind": "pybullet",
            "robot": "models/pendulum.urdf",
            "states": {"theta": "hinge.position", "theta_dot": "hinge.velocity"},
            "inputs": {"torque": "hinge"},
            "period": f"{0.01 / decimate} s",
            "linear_damping": 0,
            "angular_damping": 0,
        },
    )
    torque = multisine(12.0, 0.01, 2.0, (0.2, 2.5), seed=4)
    return hide(pendulum, effects, x0=[0.3, 0.0], u=torque, noise={"theta": 1e-3}, seed=seed, decimate=decimate)


def diagnosed(recording, effects="all"):
    return gc.diagnose(build("model", NOMINAL), recording, effects, hold_out={"last": 0.25}, horizons=[0.5])


@pytest.mark.run
@pytest.mark.parametrize("name", [*MAIN, *(pytest.param(n, marks=pytest.mark.exam) for n in CASES if n not in MAIN)])
def test_a_hidden_effect_is_found_by_name_and_number(name):
    site, parameter, value, decimate = CASES[name]
    found = diagnosed(recorded([(name, site, {parameter: value})], decimate, seed=5))
    (cause,) = found.causes
    if name in EQUAL:
        assert (cause.effect, cause.site) == EQUAL[name]
        assert ((name, site),) in found.ambiguous_with
    else:
        assert (cause.effect, cause.site) == (name, site)
        assert cause.parameters[parameter].value == pytest.approx(value, rel=0.05)
    assert found.verdict == "causes"
    assert cause.explained > 0.6
    if not found.ambiguous_with:
        assert cause.explained > cause.runner_up.explained + 0.1
    gain = found.gain["0.5"]["theta"]
    assert gain.low <= gain.after <= gain.high < 0.5 * gain.before
    assert found.residual["theta"].after == pytest.approx(1e-3, rel=0.1)


@pytest.mark.run
def test_nothing_hidden_is_nothing_found():
    found = diagnosed(recorded([], 5, seed=1))
    assert found.verdict == "nothing"
    assert found.causes == ()
    assert found.unexplained is None
    assert found.residual["theta"].before == found.residual["theta"].after == pytest.approx(1e-3, rel=0.1)


@pytest.mark.run
def test_a_law_that_the_library_lacks_is_unexplained_and_no_push():
    hidden = recorded([("cubic-spring", "theta", {"stiffness": 2.0})], 5, seed=1)
    found = diagnosed(hidden, ["viscous-friction", "coulomb-friction", "quadratic-drag", "constant-force", "input-delay"])
    assert (found.verdict, found.unexplained.events) == ("unexplained", ())


@pytest.mark.exam
def test_three_effects_at_once():
    hidden = [
        ("coulomb-friction", "theta", {"level": 0.08}),
        ("viscous-friction", "theta", {"coefficient": 0.05}),
        ("input-delay", "torque", {"delay": 0.015}),
    ]
    found = diagnosed(recorded(hidden, 20, seed=5))
    assert {c.effect: c.site for c in found.causes} == {n: s for n, s, _ in hidden}
    assert found.verdict in ("causes", "ambiguous")
    for cause in found.causes:
        (value,) = next(p for n, _, p in hidden if n == cause.effect).values()
        assert next(iter(cause.parameters.values())).value == pytest.approx(value, rel=0.05)
