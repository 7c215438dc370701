"""Payloads and gravity that is turned: worked into M, bias and forces, against models written by hand."""

import numpy as np
import pytest

import gapcert as gc
from gapcert_equations.config import EquationsConfig

ARM = {
    "kind": "equations",
    "coordinates": {"a": {"unit": "rad", "kind": "angle"}, "b": {"unit": "rad", "kind": "angle"}},
    "inputs": {"u": "N*m", "w": "N*m"},
    "parameters": {"m": "1.2 kg", "p": "0.7 kg", "l": "0.5 m", "g": "9.81 m/s^2"},
    "mass_matrix": [
        ["(m + 2*p + 2*p*cos(b))*l**2", "p*l**2*(1 + cos(b))"],
        ["p*l**2*(1 + cos(b))", "p*l**2"],
    ],
    "bias": {
        "a": "-p*l**2*sin(b)*(2*a_dot*b_dot + b_dot**2) + (m + p)*g*l*sin(a) + p*g*l*sin(a + b)",
        "b": "p*l**2*sin(b)*a_dot**2 + p*g*l*sin(a + b)",
    },
    "forces": {"a": "u", "b": "w"},
    "points": {"b": ["l*sin(a) + l*sin(a + b)", "-l*cos(a) - l*cos(a + b)"]},
    "integrator": "rk4",
    "substeps": 2,
    "period": "10 ms",
}
CART_POLE = {
    "kind": "equations",
    "coordinates": {"x": "m", "t": "rad"},
    "inputs": {"F": "N"},
    "parameters": {"M": "1 kg", "m": "0.3 kg", "l": "0.4 m", "g": "9.81 m/s^2"},
    "mass_matrix": [["M + m", "m*l*cos(t)"], ["m*l*cos(t)", "m*l**2"]],
    "bias": {"x": "-m*l*sin(t)*t_dot**2", "t": "m*g*l*sin(t)"},
    "forces": {"x": "F"},
    "integrator": "rk4",
    "substeps": 2,
    "period": "10 ms",
}
PAYLOAD = gc.Parameter("load", 0.4, "kg", low=0.0)
ANGLE = gc.Parameter("phi", 0.2, "rad")


def build(spec: dict, **changes) -> gc.Model:
    from gapcert_equations.model import EquationsModel

    return EquationsModel(EquationsConfig.model_validate(spec | changes))


def effect(site: str, *parameters: gc.Parameter, **texts) -> gc.plugin.Extension:
    return gc.plugin.Extension("effect", site, parameters, **texts)


def motion(model: gc.Model, shift: np.ndarray | float = 0.0, **options) -> np.ndarray:
    rng = np.random.default_rng(5)
    x0, u = rng.normal(size=(4, model.nx)), rng.normal(size=(4, 60, model.nu))
    return model.rollout(x0 + shift, u, **options).x


def test_a_payload_at_the_tip_is_a_heavier_tip():
    loaded = build(ARM).extend([effect("b", PAYLOAD, payload="load")])
    by_hand = build(ARM, parameters=ARM["parameters"] | {"p": "1.1 kg"})
    np.testing.assert_allclose(motion(loaded), motion(by_hand), rtol=1e-10, atol=1e-11)
    assert np.abs(motion(loaded) - motion(build(ARM))).max() > 0.1
    free = motion(loaded, parameters={"load": 0.0})
    np.testing.assert_allclose(free, motion(build(ARM)), rtol=1e-12, atol=1e-12)


def test_two_payloads_add_up_and_print():
    more = gc.Parameter("more", 0.1, "kg")
    model = build(ARM).extend([effect("b", PAYLOAD, payload="load"), effect("b", more, payload="more")])
    assert model.to_spec()["payload"] == {"b": "load + more"}
    by_hand = build(ARM, parameters=ARM["parameters"] | {"p": "1.2 kg"})
    np.testing.assert_allclose(motion(model), motion(by_hand), rtol=1e-10, atol=1e-11)
    assert "(l**2*p + l**2*(load + more))*b_ddot" in model.equations()
    assert "payload" not in model.equations()
    assert r"\left(l^{2} p + l^{2} \left(load + more\right)\right) \ddot{b}" in model.latex()


def test_gravity_turned_along_an_angle_is_the_arm_turned_back():
    tilted = build(ARM).extend([effect("a", ANGLE, tilt="phi"), effect("b", PAYLOAD, payload="load")])
    shift = np.array([0.2, 0.0, 0.0, 0.0])
    loaded = build(ARM).extend([effect("b", PAYLOAD, payload="load")])
    np.testing.assert_allclose(motion(tilted, shift) - shift, motion(loaded), rtol=1e-9, atol=1e-10)
    level = motion(tilted, parameters={"phi": 0.0})
    np.testing.assert_allclose(level, motion(loaded), rtol=1e-12, atol=1e-12)


def test_gravity_turned_along_a_length_pulls_everything():
    tilted = build(CART_POLE).extend([effect("x", ANGLE, tilt="phi")])
    # In the frame that falls down the slope, the cart-pole moves as on level ground.
    t = 0.01 * np.arange(61)[None]
    pull = 9.81 * np.sin(0.2)
    expected = motion(build(CART_POLE))
    expected[..., 0] += pull * t**2 / 2
    expected[..., 2] += pull * t
    np.testing.assert_allclose(motion(tilted), expected, rtol=1e-9, atol=1e-10)


def test_a_slope_pulls_with_standard_gravity_where_the_model_has_none():
    cart = {
        "kind": "equations",
        "coordinates": {"x": "m"},
        "parameters": {"M": "2 kg"},
        "mass_matrix": [["M"]],
        "integrator": "semi_implicit",
        "period": "1 s",
    }
    tilted = build(cart).extend([effect("x", ANGLE, tilt="phi")])
    out = tilted.step(np.zeros((1, 2)), np.zeros((1, 0))).x
    np.testing.assert_allclose(out, [[9.80665 * np.sin(0.2)] * 2], rtol=1e-14)
    assert "(M)*x_ddot = 9.80665*M*sin(phi)" in tilted.equations()


@pytest.mark.parametrize(("gravity", "pull"), [(None, -9.80665), (["0", "0", "-1.62 m/s^2"], -1.62), (["0", "g", "0"], 0.0)])
def test_the_weight_of_a_payload_in_three_dimensions(gravity, pull):
    crane = {
        "kind": "equations",
        "coordinates": {"x": "m", "z": "m"},
        "inputs": {"F": "N"},
        "parameters": {"M": "2 kg", "g": "3 N"},
        "mass_matrix": [["M", "0"], ["0", "M"]],
        "forces": {"x": "F"},
        "points": {"z": ["x", "0", "z"]},
        "integrator": "euler",
        "period": "1 s",
    }
    if gravity is not None:
        crane |= {"gravity": gravity, "parameters": {"M": "2 kg", "g": "3 m/s^2"}}
    model = build(crane).extend([effect("z", PAYLOAD, payload="load")])
    out = model.step(np.zeros((1, 4)), np.ones((1, 1))).x
    np.testing.assert_allclose(out, [[0, 0, 1 / 2.4, 0.4 * pull / 2.4]], rtol=1e-14, atol=1e-16)


def test_a_long_model_says_in_words_what_it_carries():
    n = 5
    names = [f"q{i}" for i in range(n)]
    sums = [" + ".join(names[: i + 1]) for i in range(n)]
    chain = {
        "kind": "equations",
        "coordinates": dict.fromkeys(names, "rad"),
        "parameters": {"J": "1 kg*m^2", "l": "0.3 m"},
        "mass_matrix": [["J" if i == j else "0" for j in range(n)] for i in range(n)],
        "points": {"q4": [" + ".join(f"l*{f}({s})" for s in sums) for f in ("sin", "cos")]},
        "integrator": "rk4",
        "period": "5 ms",
    }
    model = build(chain).extend([effect("q4", PAYLOAD, payload="load"), effect("q0", ANGLE, tilt="phi")])
    assert "load is carried at (l*sin(q0) + " in model.equations()
    assert "gravity is turned by phi along q0" in model.latex()
    assert build(model.to_spec()) == model
    # Mechanical energy of the carried mass and the rotors is kept.
    x0 = np.concatenate([np.linspace(-0.5, 0.5, n), np.linspace(0.4, -0.2, n)])[None]
    x = model.rollout(x0, np.zeros((1, 100, 0)), parameters={"phi": 0.0}).x[0]
    angle, speed = np.cumsum(x[:, :n], axis=1), np.cumsum(x[:, n:], axis=1)
    vx, vy = ((0.3 * f(angle) * s * speed).sum(axis=1) for f, s in ((np.cos, 1), (np.sin, -1)))
    height = 0.3 * np.cos(angle).sum(axis=1)
    energy = 0.5 * (x[:, n:] ** 2).sum(axis=1) + 0.4 * (0.5 * (vx**2 + vy**2) + 9.80665 * height)
    assert np.ptp(0.5 * (x[:, n:] ** 2).sum(axis=1)) > 0.1
    np.testing.assert_allclose(energy, energy[0], rtol=1e-8)


@pytest.mark.parametrize(
    ("changes", "path", "words"),
    [
        ({"payload": {"a": "m"}}, ("payload", "a"), "there is no point of a"),
        ({"payload": {"b": "l"}}, ("payload", "b"), "expected kg"),
        ({"payload": {"b": "m*cos(a)"}}, ("payload", "b"), "unknown name 'a'"),
        ({"tilt": {"a": "l"}}, ("tilt", "a"), "expected 1"),
        ({"tilt": {"c": "0.1"}}, ("tilt", "c"), "there are a, b"),
        ({"points": {"b": ["l", "l*a_dot"]}}, ("points", "b", 1), "unknown name 'a_dot'"),
        ({"points": {"b": ["sin(a)", "l"]}}, ("points", "b", 0), "expected m, a place"),
        ({"points": {"b": ["l"]}}, ("points",), "1 components; expected 2 or 3"),
        ({"gravity": ["0", "0", "-g"]}, ("points",), "2 and 3 components"),
        ({"gravity": ["0", "-9.81"]}, ("gravity", 1), "expected m/s"),
    ],
)
def test_problems_of_gravity(changes, path, words):
    found = EquationsConfig.model_validate(ARM | changes).check()
    assert [p[0] for p in found] == [path]
    assert words in found[0][1]


def test_gravity_acts_where_it_can():
    with pytest.raises(gc.UsageError, match="there is no point of a"):
        build(ARM).extend([effect("a", PAYLOAD, payload="load")])
    plain = build({"kind": "equations", "states": {"v": "m/s"}, "derivative": {"v": "0"}, "period": "1 s"})
    with pytest.raises(gc.UsageError, match="act through a mass_matrix"):
        plain.extend([effect("v", ANGLE, tilt="phi")])
    with pytest.raises(ValueError, match="belong to mass_matrix"):
        build(plain.to_spec(), gravity=["0", "0"])
    kinked = build(ARM, points={"b": ["l*min(a, b)", "0"]})
    with pytest.raises(gc.UsageError, match="has no derivative"):
        kinked.extend([effect("b", PAYLOAD, payload="load")])


def test_one_more_effect_on_a_long_model_does_not_cost_the_model_again():
    drag = effect("a", gc.Parameter("c", 0.1, "N*m*s"), force="-c*{v}")
    model = build(ARM)
    recorder, extended = model.definition.recorder, model.extend([drag])
    assert extended.definition.recorder is recorder
    before = len(recorder.known)
    assert model.extend([drag]) == extended
    assert len(recorder.known) == before
    fresh = build(extended.to_spec())
    assert fresh.definition.recorder is not recorder
    assert np.array_equal(motion(fresh), motion(extended))
    assert len(fresh.definition.dynamics.tape.body) == len(extended.definition.dynamics.tape.body)
