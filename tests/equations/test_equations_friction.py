"""Dry friction solved inside the step, and inputs that come late."""

import numpy as np
import pytest

import gapcert as gc
from gapcert_equations.config import EquationsConfig
from gapcert_equations.programs.arithmetic import ARRAY, INTERVAL

BLOCK = {
    "kind": "equations",
    "coordinates": {"q": "m"},
    "inputs": {"F": "N"},
    "parameters": {"mass": "2 kg", "fc": "3 N"},
    "mass_matrix": [["mass"]],
    "forces": {"q": "F"},
    "dry_friction": {"q": "fc"},
    "integrator": "semi_implicit",
    "period": "1 ms",
}
ARM = {
    "kind": "equations",
    "coordinates": {"a": "rad", "b": "rad"},
    "inputs": {"u": "N*m"},
    "parameters": {"w": "2 N*m", "f": "0.5 N*m"},
    "mass_matrix": [["0.4*w*s2", "0.1*w*s2*cos(a - b)"], ["0.1*w*s2*cos(a - b)", "0.2*w*s2"]],
    "bias": {"a": "w*sin(a)/10"},
    "forces": {"a": "u"},
    "dry_friction": {"a": "f", "b": "f/5"},
    "integrator": "semi_implicit",
    "period": "2 ms",
}
ARM["parameters"]["s2"] = "0.5 s^2"
DELAYED = {
    "kind": "equations",
    "states": {"x": "1"},
    "inputs": {"u": "1/s"},
    "derivative": {"x": "u"},
    "input_delay": {"u": "20 ms"},
    "integrator": "euler",
    "period": "10 ms",
}


def build(spec: dict, **changes) -> gc.Model:
    from gapcert_equations.model import EquationsModel

    return EquationsModel(EquationsConfig.model_validate(spec | changes))


@pytest.mark.parametrize("integrator", ["euler", "semi_implicit", "rk4"])
def test_a_block_pushed_below_its_friction_rests_exactly(integrator):
    model = build(BLOCK, integrator=integrator)
    out = model.rollout(np.array([[0.1, 0.0]]), np.full((1, 200, 1), 2.9)).x
    assert (out == out[:, :1]).all()
    pushed = model.rollout(np.array([[0.1, 0.0]]), np.full((1, 200, 1), 3.1)).x
    assert pushed[0, -1, 1] == pytest.approx(0.2 * 0.1 / 2, rel=1e-9)


@pytest.mark.parametrize("integrator", ["euler", "semi_implicit", "rk4"])
def test_slide_to_stop_matches_the_analytic_distance_and_energy(integrator):
    model = build(BLOCK, integrator=integrator)
    out = model.rollout(np.array([[0.0, 0.5]]), np.zeros((1, 400, 1))).x[0]
    # a = fc / m = 1.5 m/s²: stops after 1/3 s and v² / 2a = 1/12 m; all kinetic energy goes into fc · distance.
    assert out[-1, 1] == 0.0
    assert (out[340:, 0] == out[340, 0]).all()
    assert out[-1, 0] == pytest.approx(1 / 12, rel=4e-3)
    assert 3 * out[-1, 0] == pytest.approx(2 * 0.5**2 / 2, rel=4e-3)
    assert (np.diff(np.abs(out[:, 1])) <= 0).all()


def test_friction_at_a_state_equation_is_in_its_units():
    spec = {
        "kind": "equations",
        "states": {"q": "m", "v": "m/s"},
        "parameters": {"d": "1.5 m/s^2"},
        "derivative": {"q": "v", "v": "0"},
        "dry_friction": {"v": "d"},
        "integrator": "euler",
        "period": "1 ms",
    }
    x = np.array([[0.0, 0.5], [0.0, -0.001]])
    out = build(spec).step(x, np.empty((2, 0))).x
    np.testing.assert_allclose(out, [[0.0005, 0.4985], [-1e-6, 0.0]], rtol=1e-14)


@pytest.mark.parametrize("integrator", ["euler", "semi_implicit", "rk4"])
def test_coupled_coordinates_stick_together(integrator):
    model = build(ARM, integrator=integrator)
    out = model.rollout(np.array([[0.2, 0.5, 0.0, 0.0]]), np.full((1, 100, 1), 0.3)).x
    assert (out == out[:, :1]).all()


def test_coupled_friction_obeys_its_law():
    """f = −F sign(v⁺) where it slips and |f| <= F where it rests, with f recovered from the momentum balance."""
    model, h = build(ARM), 0.002
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-1, 1, (300, 4)) * [1, 1, 0.01, 0.01], rng.uniform(-1, 1, (300, 1))
    new = model.step(x, u).x
    m = 0.1 * np.cos(x[:, 0] - x[:, 1])
    mass = np.stack([np.stack([0.4 + 0 * m, m], 1), np.stack([m, 0.2 + 0 * m], 1)], 1)
    rhs = np.stack([u[:, 0] - 0.2 * np.sin(x[:, 0]), 0 * m], 1)
    f = np.einsum("nij,nj->ni", mass, new[:, 2:] - x[:, 2:]) / h - rhs
    bound = np.array([0.5, 0.1])
    slips = new[:, 2:] != 0
    assert 0.1 < slips.mean() < 0.9
    assert (np.abs(f) <= bound * (1 + 1e-6)).all()
    np.testing.assert_allclose(np.where(slips, f + bound * np.sign(new[:, 2:]), 0), 0, atol=1e-6)


def test_coupled_friction_is_enclosed_but_its_slope_is_refused():
    model = build(ARM)
    rng = np.random.default_rng(1)
    c = rng.uniform(-1, 1, (200, 5)) * [1, 1, 0.01, 0.01, 1]
    box = gc.Interval.around(c, 1e-3)
    points = c + rng.uniform(-1e-3, 1e-3, c.shape)
    assert model.enclosure(box).contains(model.step(points[:, :4], points[:, 4:]).x).all()
    with pytest.raises(gc.UsageError, match="diagonal mass_matrix"):
        model.jacobian_enclosure(box)
    assert np.isinf(model.curvature_enclosure(box, 1).mag).all()


def test_curvature_is_known_where_friction_certainly_slips():
    low, high = [[0.0, 0.5, -1.0], [0.0, -0.5, -1.0], [0.0, -1e-2, 0.0]], [[1.0, 1.0, 1.0], [1.0, -0.2, 1.0], [1.0, 1e-2, 0.1]]
    found = build(BLOCK).curvature_enclosure(gc.Interval(low, high), 1).mag
    assert (found[:2] < 1e-12).all()
    assert np.isinf(found[2, 1])


def test_slopes_through_stick_and_slip():
    model = build(BLOCK)
    x, u = np.array([[0.0, 1e-4], [0.0, 1.0]]), np.array([[1.0], [1.0]])
    jacobian = model.jacobian(x, u)
    assert jacobian[0, 1].tolist() == [0, 0, 0]
    np.testing.assert_allclose(jacobian[1, 1], [0, 1, 0.0005])
    both = model.jacobian_enclosure(gc.Interval([[0.0, 0.0, 1.0]], [[0.0, 1.0, 1.0]]))
    assert both.contains(jacobian).all()


@pytest.mark.parametrize(
    ("delay", "late"), [("20 ms", [0, 0, 1, 2, 3]), ("25 ms", [0, 0, 0.5, 1.5, 2.5]), ("10 ms", [0, 1, 2, 3, 4])]
)
def test_delays_are_exact(delay, late):
    model = build(DELAYED, input_delay={"u": delay})
    u = np.arange(1.0, 6.0).reshape(1, 5, 1)
    out = model.rollout(np.zeros((1, 1)), u).x[0, :, 0]
    np.testing.assert_allclose(np.diff(out), 0.01 * np.array(late), rtol=1e-12, atol=1e-18)


def test_delays_are_hidden_state_that_steps_hand_on():
    model = build(DELAYED, input_delay={"u": "25 ms"})
    assert [h.name for h in model.hidden] == ["u_delay_1", "u_delay_2", "u_delay_3"]
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(3, 1)), rng.normal(size=(3, 7, 1))
    whole = model.rollout(x, u)
    hidden = None
    for k in range(7):
        step = model.step(whole.x[:, k], u[:, k], hidden=hidden)
        assert np.array_equal(step.x, whole.x[:, k + 1])
        hidden = step.hidden
    assert np.array_equal(hidden, whole.hidden)
    assert np.array_equal(hidden[:, 0], u[:, -1, 0])
    assert model.jacobian(x, u[:, 0]).tolist() == [[[1.0, 0.0]]] * 3


def test_a_delay_can_be_a_parameter_within_its_bound():
    model = build(
        DELAYED,
        parameters={"d": {"value": "0 s", "low": "0 s", "high": "30 ms"}},
        input_delay={"u": "d"},
    )
    u = np.arange(1.0, 6.0).reshape(1, 5, 1)
    for d, delay in ((0.025, "25 ms"), (0.02, "20 ms"), (0.0, "0 ms")):
        fixed = build(DELAYED, input_delay={"u": delay}).rollout(np.zeros((1, 1)), u).x
        assert np.array_equal(model.rollout(np.zeros((1, 1)), u, parameters={"d": d}).x, fixed)
    with pytest.raises(gc.UsageError, match=r"0\.04 s is longer than 3 periods"):
        model.step(np.zeros((1, 1)), u[:, 0], parameters={"d": 0.04})


def turning(v: float, a: float, k: float, t: float) -> float:
    """The velocity after t of v̇ = a − k sign v, by its pieces."""
    braked = a - k * np.sign(v)
    stops = -v / braked if braked * v < 0 else np.inf
    if v == 0:
        stops = 0.0
    if stops >= t:
        return v + braked * t
    return 0.0 if abs(a) <= k else (a - k * np.sign(a)) * (t - stops)


@pytest.mark.parametrize("push", [-9.0, -4.0, -2.9, 0.0, 2.9, 3.1, 9.0])
def test_a_motion_that_stops_or_turns_within_a_step_leaves_it_with_the_right_velocity(push):
    v = np.linspace(-0.004, 0.004, 41)
    new = build(BLOCK, integrator="rk4").step(np.stack([0 * v, v], 1), np.full((41, 1), push)).x[:, 1]
    expected = [turning(a, push / 2, 1.5, 1e-3) for a in v.tolist()]
    np.testing.assert_allclose(new, expected, atol=1e-15)
    assert (new == 0).any() == (abs(push) < 3)
    if abs(push) > 4:
        # Bringing it to rest as far as the bound allows, as the other integrators do, is wrong by up to the bound's share.
        other = build(BLOCK).step(np.stack([0 * v, v], 1), np.full((41, 1), push)).x[:, 1]
        assert np.abs(other - expected).max() > 1e-4


def test_coupled_motions_that_turn_converge_with_the_square_of_the_step():
    u = 1.2 * np.sin(np.linspace(0, 40, 300))[None, :, None]
    x0 = np.random.default_rng(0).uniform(-0.5, 0.5, (4, 4))

    def motion(substeps):
        bias = {"a": "w*sin(a)", "b": "w*sin(b)/3"}
        return build(ARM, integrator="rk4", substeps=substeps, period="8 ms", bias=bias).fast_rollout(x0, u).x

    true = motion(64)
    errors = [np.sqrt(np.mean((motion(s) - true) ** 2)) for s in (1, 4)]
    assert (np.abs(np.diff(np.sign(true[..., 2:]), axis=1)) > 0).sum() > 50
    assert errors[0] < 3e-5
    assert errors[0] / errors[1] > 10  # first order would be 4


def test_stop_and_its_slopes_are_enclosed():
    rng = np.random.default_rng(0)
    c, r = rng.uniform(-1, 1, (3, 4000)), rng.uniform(0, 0.3, (3, 4000))
    c[2] = np.abs(c[2]) + r[2]
    boxes = [gc.Interval(m - w, m + w) for m, w in zip(c, r, strict=True)]
    point = list(c + r * rng.uniform(-1, 1, c.shape))
    value = ARRAY["stop"](*point)
    assert INTERVAL["stop"](*boxes).contains(value).all()
    for box, slope, by_hand in zip(
        INTERVAL["stop_slopes"](*boxes),
        ARRAY["stop_slopes"](*point),
        [ARRAY["stop"](*(p + (i == j) * 1e-7 for i, p in enumerate(point))) for j in range(3)],
        strict=True,
    ):
        assert (box.lo <= slope + 1e-12).all()
        assert (slope <= box.hi + 1e-12).all()
        close = np.abs((by_hand - value) / 1e-7 - slope) < 1e-4
        assert close.mean() > 0.99  # all but those at a kink
    # It turns and rests in this sample.
    assert 0.05 < (value == 0).mean() < 0.5


@pytest.mark.parametrize("integrator", ["semi_implicit", "rk4"])
def test_derivatives_through_friction(integrator):
    model = build(
        BLOCK, integrator=integrator, forces={"q": "F + 0*mass*q/t2"}, parameters=BLOCK["parameters"] | {"t2": "1 s^2"}
    )
    rng = np.random.default_rng(1)
    x, u = rng.uniform(-0.004, 0.004, (300, 2)), rng.uniform(-9, 9, (300, 1))
    z = np.concatenate([x, u], 1)
    jacobian = model.jacobian(x, u)
    for j in range(3):
        up = z + 1e-8 * (np.arange(3) == j)
        slope = (model.step(up[:, :2], up[:, 2:]).x - model.step(x, u).x) / 1e-8
        assert (np.abs(slope - jacobian[:, :, j]) < 1e-6).all(axis=1).mean() > 0.98
    box = gc.Interval(z - 1e-4, z + 1e-4)
    assert model.jacobian_enclosure(box).contains(jacobian).all()
    inside = z + rng.uniform(-1e-4, 1e-4, z.shape)
    assert model.enclosure(box).contains(model.step(inside[:, :2], inside[:, 2:]).x).all()
