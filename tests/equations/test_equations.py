"""One text gives the step, its derivatives, and its range: against hand-written numerics."""

import pickle
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

import gapcert as gc
from gapcert_equations.config import EquationsConfig

PENDULUM = {
    "kind": "equations",
    "states": {"theta": {"unit": "rad", "kind": "angle"}, "omega": "rad/s"},
    "inputs": {"torque": "N*m"},
    "parameters": {"m": "1 kg", "l": "1 m", "g": "9.81 m/s^2"},
    "derivative": {"theta": "omega", "omega": "-3*g/(2*l)*sin(theta) + 3*torque/(m*l**2)"},
    "integrator": "euler",
    "period": "5 ms",
}
MECHANICAL = {
    "kind": "equations",
    "coordinates": {"theta": {"unit": "rad", "kind": "angle"}},
    "inputs": {"torque": "N*m"},
    "parameters": PENDULUM["parameters"],
    "mass_matrix": [["m*l**2/3"]],
    "bias": {"theta": "m*g*l/2*sin(theta)"},
    "forces": {"theta": "torque"},
    "integrator": "semi_implicit",
    "period": "5 ms",
}
DOUBLE = {
    "kind": "equations",
    "coordinates": {"a": "rad", "b": "rad"},
    "inputs": {"u": "N*m"},
    "parameters": {"J": "0.4 kg*m^2", "k": "0.1 kg*m^2", "c": "0.2 N*m*s", "w": "2 N*m"},
    "mass_matrix": [["J", "k*cos(a - b)"], ["k*cos(a - b)", "J/2"]],
    "bias": {"a": "w*sin(a) + k*sin(a - b)*b_dot**2", "b": "c*b_dot - k*sin(a - b)*a_dot**2"},
    "forces": {"a": "u"},
    "integrator": "rk4",
    "substeps": 2,
    "period": "10 ms",
}
ZOO = {
    "kind": "equations",
    "states": {"x": "1", "y": "1", "z": "1"},
    "inputs": {"u": "1"},
    "parameters": {"a": 0.7, "T": "1 s"},
    "derivative": {
        "x": "y/T",
        "y": "(tanh(x)*exp(-x**2) + a*cos(3*z)/(2 + sin(y)) - abs(y)*y + min(u, x, 0.5))/T",
        "z": "(sqrt(1 + z**2)*atan(u) - max(x, -z) + log(2 + x**4) + tan(x/4)*asin(sin(y)/2)"
        " - acos(cos(x)/3)**3/7 + (2 + x)**1.3)/T",
    },
    "integrator": "rk4",
    "period": 0.05,
}
FRICTION = MECHANICAL | {"dry_friction": {"theta": "0.3*m*g*l*abs(cos(theta))/4"}, "integrator": "euler"}


def build(spec: dict, **changes) -> gc.Model:
    from gapcert_equations.model import EquationsModel

    return EquationsModel(EquationsConfig.model_validate(spec | changes))


def batch(model: gc.Model, n: int, seed: int = 0, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return scale * rng.uniform(-1, 1, (n, model.nx)), scale * rng.uniform(-1, 1, (n, model.nu))


def test_the_nominal_pendulum_is_euler():
    x, u = batch(build(PENDULUM), 100)
    theta, omega, tau = *x.T, 0.005
    expected = np.stack([theta + tau * omega, omega + tau * (-3 * 9.81 / 2 * np.sin(theta) + 3 * u[:, 0])], 1)
    np.testing.assert_allclose(build(PENDULUM).step(x, u).x, expected, rtol=1e-15, atol=1e-16)


def test_the_mechanical_pendulum_is_the_same_and_semi_implicit_is_symplectic():
    model = build(MECHANICAL)
    assert [s.name for s in model.states] == ["theta", "theta_dot"]
    x, u = batch(model, 100)
    np.testing.assert_allclose(build(MECHANICAL, integrator="euler").step(x, u).x, build(PENDULUM).step(x, u).x, rtol=2e-15)
    theta, omega = x.T
    new = omega + 0.005 * (-3 * 9.81 / 2 * np.sin(theta) + 3 * u[:, 0])
    np.testing.assert_allclose(model.step(x, u).x, np.stack([theta + 0.005 * new, new], 1), rtol=2e-15)
    np.testing.assert_allclose(build(PENDULUM, integrator="semi_implicit").step(x, u).x, model.step(x, u).x, rtol=2e-15)
    # Symplectic: the map preserves area.
    assert np.allclose(np.linalg.det(model.jacobian(x, u)[:, :, :2]), 1, atol=1e-14)
    assert not np.allclose(np.linalg.det(build(PENDULUM).jacobian(x, u)[:, :, :2]), 1, atol=1e-5)


@pytest.mark.parametrize(("integrator", "order"), [("euler", 1), ("semi_implicit", 1), ("rk4", 4)])
def test_integrators_converge_with_their_order_to_the_true_flow(integrator, order):
    x, u = np.array([[0.7, -0.4, 1.2, 0.6]]), np.array([[0.5]])

    def flow(_t: float, s: np.ndarray) -> list[float]:
        a, b, p, q = s
        mass = np.array([[0.4, 0.1 * np.cos(a - b)], [0.1 * np.cos(a - b), 0.2]])
        bias = np.array([2 * np.sin(a) + 0.1 * np.sin(a - b) * q**2, 0.2 * q - 0.1 * np.sin(a - b) * p**2])
        return [p, q, *np.linalg.solve(mass, np.array([0.5, 0.0]) - bias)]

    true = solve_ivp(flow, (0, 0.4), x[0], rtol=1e-12, atol=1e-13, method="DOP853").y[:, -1]
    errors = [
        np.abs(build(DOUBLE, integrator=integrator, substeps=s, period="400 ms").step(x, u).x[0] - true).max() for s in (20, 40)
    ]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.35)
    assert errors[0] < (1e-5 if order == 4 else 0.2)


@pytest.mark.parametrize("spec", [PENDULUM, MECHANICAL, DOUBLE, ZOO], ids=["pendulum", "mechanical", "double", "zoo"])
def test_jacobian_against_differences_of_the_whole_step(spec):
    model = build(spec)
    x, u = batch(model, 40, seed=3, scale=0.9)
    z = np.concatenate([x, u], 1)
    jacobian = model.jacobian(x, u)
    for j in range(z.shape[1]):
        high, low = z.copy(), z.copy()
        high[:, j] += 1e-6
        low[:, j] -= 1e-6
        rise = model.step(high[:, : model.nx], high[:, model.nx :]).x - model.step(low[:, : model.nx], low[:, model.nx :]).x
        np.testing.assert_allclose(jacobian[:, :, j], rise / 2e-6, atol=2e-8)


def test_jacobian_is_exact_to_rounding():
    """Against a complex step of the same RK4 written by hand: no truncation error at all."""
    x, u = batch(build(PENDULUM), 20)
    tau = 0.005

    def rk4(s: np.ndarray, torque: np.ndarray) -> np.ndarray:
        def f(v: np.ndarray) -> np.ndarray:
            return np.stack([v[:, 1], -3 * 9.81 / 2 * np.sin(v[:, 0]) + 3 * torque], 1)

        k1 = f(s)
        k2 = f(s + tau / 2 * k1)
        k3 = f(s + tau / 2 * k2)
        return s + tau / 6 * (k1 + 2 * k2 + 2 * k3 + f(s + tau * k3))

    jacobian = build(PENDULUM, integrator="rk4").jacobian(x, u)
    for j in range(3):
        z = np.concatenate([x, u], 1).astype(complex)
        z[:, j] += 1e-30j
        np.testing.assert_allclose(jacobian[:, :, j], rk4(z[:, :2], z[:, 2]).imag / 1e-30, rtol=1e-13, atol=1e-15)


@pytest.mark.exam
@pytest.mark.parametrize("spec", [PENDULUM, DOUBLE, ZOO, FRICTION], ids=["pendulum", "double", "zoo", "friction"])
@given(seed=st.integers(0, 10**6), width=st.sampled_from([0.0, 1e-9, 0.02, 0.5]))
@settings(max_examples=15, derandomize=True, deadline=None)
def test_enclosures_contain_every_image_and_slope(spec, seed, width):
    model = build(spec)
    rng = np.random.default_rng(seed)
    x, u = batch(model, 1, seed)
    c = np.concatenate([x, u], 1)
    half = width * rng.uniform(0, 1, c.shape)
    box = gc.Interval(c - half, c + half)
    inside = np.clip(c + half * rng.uniform(-1, 1, (60, c.shape[1])), box.lo, box.hi)
    corners = np.where(rng.random((20, c.shape[1])) < 0.5, box.lo, box.hi)
    points = np.concatenate([inside, corners])
    image = model.enclosure(box)
    assert image.shape == (1, model.nx)
    assert image.contains(model.step(points[:, : model.nx], points[:, model.nx :]).x).all()
    slopes = model.jacobian_enclosure(box)
    assert slopes.contains(model.jacobian(points[:, : model.nx], points[:, model.nx :])).all()


def test_enclosures_shrink_with_the_square_of_the_box():
    """The mean-value form is first-order tight: its excess over the true range is of second order."""
    model = build(DOUBLE)
    c = np.array([[0.3, -0.2, 0.5, 0.4, 0.1]])
    widths = []
    for half in (1e-2, 1e-3):
        linear = half * np.abs(model.jacobian(c[:, :4], c[:, 4:])).sum(-1) * 2
        widths.append((model.enclosure(gc.Interval.around(c, half)).width - linear).max())
    assert widths[1] < widths[0] / 60


@pytest.mark.parametrize("spec", [MECHANICAL, DOUBLE, ZOO, FRICTION], ids=["mass", "double", "zoo", "friction"])
def test_no_difference_of_slopes_exceeds_what_a_box_allows(spec):
    model = build(spec)
    centre = np.concatenate(batch(model, 300, 3), axis=1)
    rng, nx, half, step = np.random.default_rng(3), model.nx, 0.05, 1e-5
    z = centre + rng.uniform(-1, 1, centre.shape) * (half - step)
    known = 0
    for axis in range(z.shape[1]):
        apart = step * np.eye(z.shape[1])[axis]
        high, low = (model.jacobian(p[:, :nx], p[:, nx:])[:, :, axis] for p in (z + apart, z - apart))
        over = model.curvature_enclosure(gc.Interval(centre - half, centre + half), axis)
        seen = (high - low) / (2 * step)
        slack = 1e-7 * (1 + np.abs(seen))
        assert ((over.lo <= seen + slack) & (seen - slack <= over.hi)).all()
        known += int(np.isfinite(over.mag).sum())
    assert known > 0.5 * z.size * nx


def test_sign_has_no_bounded_slope_across_its_jump():
    model = build(ZOO, derivative=ZOO["derivative"] | {"z": "sign(x)/T"}, integrator="euler")
    across, beside = gc.Interval([[-0.1, 0, 0, 0]], [[0.1, 0, 0, 0]]), gc.Interval([[0.1, 0, 0, 0]], [[0.2, 0, 0, 0]])
    assert np.isinf(model.jacobian_enclosure(across).mag[0, 2, 0])
    assert model.jacobian_enclosure(beside).mag[0, 2, 0] < 1e-300


@pytest.mark.parametrize("spec", [PENDULUM, DOUBLE, ZOO, FRICTION], ids=["pendulum", "double", "zoo", "friction"])
def test_the_answer_does_not_depend_on_the_batch(spec):
    model = build(spec)
    x, u = batch(model, 257)
    order = np.random.default_rng(1).permutation(257)
    whole = model.step(x, u).x
    assert np.array_equal(model.step(x[order], u[order]).x, whole[order])
    assert all(np.array_equal(model.step(x[i : i + 1], u[i : i + 1]).x[0], whole[i]) for i in range(0, 257, 16))


@pytest.mark.parametrize("spec", [PENDULUM, DOUBLE, ZOO], ids=["pendulum", "double", "zoo"])
def test_rollout_is_repeated_steps(spec):
    model = build(spec)
    x, _ = batch(model, 3)
    u = np.random.default_rng(5).uniform(-1, 1, (3, 12, model.nu))
    out = model.rollout(x, u).x
    for k in range(12):
        assert np.array_equal(out[:, k + 1], model.step(out[:, k], u[:, k]).x)


def test_forces_act_through_the_mass_matrix_in_each_substep():
    model = build(DOUBLE, integrator="euler")
    x, u = batch(model, 4)
    kick = np.zeros((4, 2, 2))
    kick[:, 1, 0] = 0.7
    assert model.coordinates == ("a", "b")
    moved = model.step(x, u, forces=kick).x - model.step(x, u).x
    half = build(DOUBLE, integrator="euler", substeps=1, period="5 ms").step(x, u).x
    mass = np.array([[[0.4, m], [m, 0.2]] for m in 0.1 * np.cos(half[:, 0] - half[:, 1])])
    np.testing.assert_allclose(moved[:, 2:], 0.005 * np.linalg.solve(mass, np.array([[0.7], [0.0]]))[..., 0], rtol=1e-12)
    plain = build(PENDULUM)
    assert plain.coordinates == ("omega",)
    x, u = batch(plain, 4)
    moved = plain.step(x, u, forces=np.full((4, 1, 1), 2.0)).x - plain.step(x, u).x
    np.testing.assert_allclose(moved, [[0, 0.01]] * 4, atol=1e-15)


def test_parameters_may_vary_over_the_batch():
    model = build(PENDULUM)
    x, u = batch(model, 3)
    out = model.step(x, u, parameters={"m": np.array([1.0, 2.0, 4.0])}).x
    for i, m in enumerate((1.0, 2.0, 4.0)):
        assert np.array_equal(out[i], build(PENDULUM, parameters=PENDULUM["parameters"] | {"m": f"{m} kg"}).step(x, u).x[i])
    assert model.sites("parameter") == ("m", "l", "g")


def test_quantities_are_converted_to_coherent_units():
    other = build(
        PENDULUM,
        parameters={
            "m": {"value": "1000 g", "tolerance": "10 %"},
            "l": {"value": "100 cm", "tolerance": "2 mm", "low": 50},
            "g": "981 cm/s^2",
        },
        period=0.005,
    )
    x, u = batch(other, 50)
    assert np.array_equal(other.step(x, u).x, build(PENDULUM).step(x, u).x)
    m, length, g = other.parameters
    assert (m.value, m.unit, m.tolerance) == (1.0, "kg", 0.1)
    assert (length.unit, length.tolerance, length.low) == ("m", 0.002, 0.5)
    assert (g.value, g.unit) == (9.81, "m/s^2")


def test_the_map_itself_and_outputs():
    spec = {
        "kind": "equations",
        "states": {"x": "m", "v": "m/s"},
        "inputs": {"F": "N"},
        "parameters": {"dt": "0.1 s", "m": "2 kg"},
        "next": {"x": "x + dt*v", "v": "v + dt*F/m"},
        "outputs": {"power": {"expr": "F*v", "unit": "W"}, "x": "x", "double": "2*v"},
        "period": "0.1 s",
    }
    model = build(spec)
    x, u = np.array([[1.0, 2.0]]), np.array([[4.0]])
    np.testing.assert_allclose(model.step(x, u).x, [[1.2, 2.2]], rtol=1e-15)
    assert model.output(x, u).tolist() == [[8.0, 1.0, 4.0]]
    assert [(y.name, y.unit) for y in model.outputs] == [("power", "W"), ("x", "m"), ("double", "m/s")]
    assert model.coordinates == ()
    assert build(PENDULUM).output(x, u) is x


@pytest.mark.parametrize("spec", [PENDULUM, MECHANICAL, DOUBLE, ZOO, FRICTION], ids=["p", "m", "d", "z", "f"])
def test_round_trips(spec):
    from gapcert_equations.model import EquationsModel

    model = build(spec)
    again = EquationsModel(EquationsConfig.model_validate(model.to_spec()))
    copy = pickle.loads(pickle.dumps(model))
    x, u = batch(model, 5)
    for other in (again, copy):
        assert other == model
        assert other.digest() == model.digest()
        assert np.array_equal(other.step(x, u).x, model.step(x, u).x)
    assert build(spec, period="6 ms").digest() != model.digest()


def test_printed_equations():
    assert build(MECHANICAL, dry_friction={"theta": "0.1*torque + 0*m*g*l"}).equations().splitlines() == [
        "(m*l**2/3)*theta_ddot + (m*g*l/2*sin(theta)) = torque + friction(theta)",
        "|friction(theta)| <= 0.1*torque + 0*m*g*l",
        "m = 1 kg",
        "l = 1 m",
        "g = 9.81 m/s^2",
        "[semi_implicit, period 5 ms]",
    ]
    assert "theta' = omega" in build(PENDULUM).equations()
    assert r"\dot{\omega} &= - \frac{3 g \sin{\left(\theta \right)}}{2 l}" in build(PENDULUM).latex()
    assert r"\ddot{\theta}" in build(MECHANICAL).latex()


@pytest.mark.exam
@pytest.mark.parametrize("spec", [PENDULUM, DOUBLE, ZOO], ids=["pendulum", "double", "zoo"])
def test_the_jax_twin_agrees_within_two_ulp(spec):
    jax = pytest.importorskip("jax")
    model = build(spec)
    x, u = batch(model, 300)
    twin = np.asarray(model.jax()(x, u))
    own = model.step(x, u).x
    assert twin.dtype == np.float64
    assert (np.abs(twin - own) <= 2 * np.spacing(np.abs(own).max(axis=0))).all()
    assert not jax.config.jax_enable_x64
    assert jax.numpy.ones(1).dtype == np.float32


@pytest.mark.contract
def test_declaring_and_validating_imports_nothing_heavy():
    code = (
        "import sys, gapcert_equations.plugin, gapcert_equations.config as c;"
        "c.EquationsConfig.model_json_schema();"
        "bad = {'sympy', 'pint', 'jax', 'scipy'} & set(sys.modules); print(bad); sys.exit(bool(bad))"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
