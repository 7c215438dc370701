"""Rigid bodies in a tree: against models written by hand, against MuJoCo, in intervals and derivatives, and badly described."""

import numpy as np
import pytest

import gapcert as gc
from gapcert_equations.config import EquationsConfig

ARM = {
    "kind": "equations",
    "coordinates": {"a": {"unit": "rad", "kind": "angle"}, "b": {"unit": "rad", "kind": "angle"}},
    "inputs": {"u": "N*m", "w": "N*m"},
    "parameters": {"m": "1.2 kg", "p": "0.7 kg", "l": "0.5 m", "g": "9.81 m/s^2", "J": "0.02 kg*m^2"},
    "forces": {"a": "u", "b": "w"},
    "integrator": "rk4",
    "substeps": 2,
    "period": "10 ms",
}
WRITTEN = {
    "mass_matrix": [
        ["(m + 2*p + 2*p*cos(b))*l**2 + 0.01 * m * l**2", "p*l**2*(1 + cos(b))"],
        ["p*l**2*(1 + cos(b))", "p*l**2 + J"],
    ],
    "bias": {
        "a": "-p*l**2*sin(b)*(2*a_dot*b_dot + b_dot**2) + (m + p)*g*l*sin(a) + p*g*l*sin(a + b)",
        "b": "p*l**2*sin(b)*a_dot**2 + p*g*l*sin(a + b)",
    },
}
BODIES = {
    "bodies": {
        "upper": {"joint": "a", "axis": [0, 2, 0], "mass": "m", "com": [0, 0, "-l"], "inertia": [0, "0.01*m*l**2", 0]},
        "lower": {
            "on": "upper",
            "joint": "b",
            "at": [0, 0, "-l"],
            "axis": [0, 1, 0],
            "mass": "p",
            "com": [0, 0, "-l"],
            "inertia": [0, 0, 0],
            "armature": "J",
        },
    }
}
CART = {
    "kind": "equations",
    "coordinates": {"t": "rad", "x": "m"},
    "inputs": {"F": "N"},
    "parameters": {"M": "1 kg", "m": {"value": "0.3 kg", "tolerance": "2 %"}, "l": "0.4 m", "g": "9.81 m/s^2"},
    "forces": {"x": "F"},
    "dry_friction": {"x": "0.05*M*g"},
    "integrator": "semi_implicit",
    "period": "10 ms",
}
CART_WRITTEN = {
    "mass_matrix": [["m*l**2", "m*l*cos(t)"], ["m*l*cos(t)", "M + m"]],
    "bias": {"x": "-m*l*sin(t)*t_dot**2", "t": "m*g*l*sin(t)"},
}
CART_BODIES = {
    "bodies": {
        "cart": {"joint": "x", "axis": [1, 0, 0], "mass": "M", "inertia": [0, 0, 0]},
        "pole": {"on": "cart", "joint": "t", "axis": [0, -1, 0], "mass": "m", "com": [0, 0, "-l"], "inertia": [0, 0, 0]},
    }
}


def build(spec, **changes):
    from gapcert_equations.model import EquationsModel

    return EquationsModel(EquationsConfig.model_validate(spec | changes))


def motions(model, count=20, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, model.nx)), rng.normal(size=(count, 40, model.nu))


def test_an_arm_of_bodies_is_the_arm_written_by_hand():
    made, written = build(ARM, **BODIES), build(ARM, **WRITTEN)
    x, u = motions(made)
    np.testing.assert_allclose(made.rollout(x, u).x, written.rollout(x, u).x, rtol=0, atol=1e-10)
    np.testing.assert_allclose(made.fast_rollout(x, u).x, written.rollout(x, u).x, rtol=0, atol=1e-10)
    np.testing.assert_allclose(made.jacobian(x, u[:, 0]), written.jacobian(x, u[:, 0]), rtol=0, atol=1e-10)
    heavier = {"p": np.linspace(0.5, 0.9, len(x))}
    expected = written.rollout(x, u, parameters=heavier).x
    np.testing.assert_allclose(made.rollout(x, u, parameters=heavier).x, expected, rtol=0, atol=1e-10)


def test_bodies_that_fall_otherwise_are_recorded_anew():
    from gapcert_equations.model import EquationsModel

    bodies = ARM | BODIES
    base, weak = EquationsModel(EquationsConfig.model_validate(bodies)), ARM["parameters"] | {"g": "1 N"}
    for changes in ({"gravity": ["0", "0", "-1.6 m/s^2"]}, {"parameters": weak}):
        config = EquationsConfig.model_validate(bodies | changes)
        model, alone = EquationsModel.from_config(config, gc.Context(model=base)), EquationsModel(config)
        x, u = np.array([[0.4, 0.2, 1.0, -0.5]]), np.array([[0.1, 0.3]])
        np.testing.assert_array_equal(model.step(x, u).x, alone.step(x, u).x)
        assert np.abs(model.step(x, u).x - base.step(x, u).x).max() > 1e-6


def test_a_cart_with_a_pole_stands_still_in_any_order_of_bodies():
    made, written = build(CART, **CART_BODIES), build(CART, **CART_WRITTEN)
    x, u = motions(made)
    np.testing.assert_allclose(made.rollout(x, u).x, written.rollout(x, u).x, rtol=0, atol=1e-10)
    still = made.rollout(np.zeros((1, 4)), np.full((1, 10, 1), 0.3)).x
    np.testing.assert_array_equal(still, 0.0)


def test_what_is_welded_moves_with_what_carries_it():
    """A lump beside another is the body of both."""
    lump = {"on": "upper", "at": [0, 0, "-l"], "turned": [0.6, 0, 0.8, 0], "mass": "p", "inertia": [0, "J", 0]}
    alone = {"upper": BODIES["bodies"]["upper"] | {"mass": "m + p", "inertia": [0, "0.01*m*l**2 + J", 0]}}
    coordinates, forces = {"a": "rad"}, {"a": "u + 0*w"}
    welded = build(ARM, coordinates=coordinates, forces=forces, bodies={"upper": BODIES["bodies"]["upper"], "lump": lump})
    one = build(ARM, coordinates=coordinates, forces=forces, bodies=alone)
    x, u = motions(one)
    np.testing.assert_allclose(welded.rollout(x, u).x, one.rollout(x, u).x, rtol=0, atol=1e-10)


def test_boxes_and_their_derivatives_hold_what_points_do():
    made = build(ARM, **BODIES)
    x, u = motions(made)
    z = np.concatenate([x, u[:, 0]], axis=1)
    rng = np.random.default_rng(1)
    box = gc.Interval(z - 0.01, z + 0.01)
    inside = z + rng.uniform(-0.01, 0.01, z.shape)
    after, slopes = made.enclosure(box), made.jacobian_enclosure(box)
    new, jacobian = made.step(inside[:, :4], inside[:, 4:]).x, made.jacobian(inside[:, :4], inside[:, 4:])
    assert ((after.lo <= new) & (new <= after.hi)).all()
    assert ((slopes.lo <= jacobian) & (jacobian <= slopes.hi)).all()
    assert (after.hi - after.lo).max() < 0.1


def test_gravity_turns_at_a_joint_as_in_the_model_written_by_hand():
    angle = gc.Parameter("phi", 0.2, "rad")
    turned = [build(ARM, **m).extend([gc.plugin.Extension("tilt", "a", (angle,), tilt="phi")]) for m in (BODIES, WRITTEN)]
    x, u = motions(turned[0])
    made, written = (m.rollout(x, u).x for m in turned)
    np.testing.assert_allclose(made, written, rtol=0, atol=1e-10)
    assert np.abs(made - build(ARM, **BODIES).rollout(x, u).x).max() > 0.01


ROD = {
    "kind": "equations",
    "coordinates": {"q": {"unit": "rad", "kind": "angle"}},
    "inputs": {"u": "N*m"},
    "parameters": {"a": "0.3 1/s", "b": "0.2 1/m", "c": "0.4 1/s", "d": 0.7, "F": "0.8 N*m", "D": "3 N*m*s/rad"},
    "integrator": "semi_implicit",
    "substeps": 2,
    "period": "10 ms",
}
BODY = {"joint": "q", "axis": [0, 1, 0], "mass": 1.2, "com": [0, 0, -0.5], "inertia": [0.1, 0.1, 0.01]}


def rod(body=None, **changes):
    return build(ROD, bodies={"rod": BODY | (body or {})}, **{"forces": {"q": "u"}} | changes)


def test_drag_slows_a_rod_as_by_hand():
    """Torque −(m r² a + I c) ω − (m r³ b + I d) ω |ω| about the hinge, of a centre of mass at the distance r."""
    made = rod({"drag": {"linear": ["a", "b"], "angular": ["c", "d"]}})
    numbers = {"p": f"{1.2 * 0.5**2 * 0.3 + 0.1 * 0.4!r} N*m*s", "s": f"{1.2 * 0.5**3 * 0.2 + 0.1 * 0.7!r} N*m*s^2"}
    written = rod(forces={"q": "u - p*q_dot - s*q_dot*abs(q_dot)"}, parameters=ROD["parameters"] | numbers)
    x, u = motions(made)
    np.testing.assert_allclose(made.rollout(x, 0.1 * u).x, written.rollout(x, 0.1 * u).x, rtol=0, atol=1e-12)
    np.testing.assert_allclose(made.fast_rollout(x, u).x, made.rollout(x, u).x, rtol=0, atol=1e-12)
    assert np.abs(made.rollout(x, u).x - rod().rollout(x, u).x).max() > 0.01


def test_drag_has_a_slope_at_rest_and_boxes_hold_it():
    drag = {"linear": ["0.3", "0.2"], "angular": ["0.4", "0.7"]}
    bodies = {n: b | {"drag": drag} for n, b in BODIES["bodies"].items()}
    bodies["lower"] = bodies["lower"] | {"axis": [1, 0, 0], "inertia": [0.01, 0.02, 0.03]}
    made = build(ARM, bodies=bodies, integrator="semi_implicit")
    x, u = motions(made)
    x[0, 2:], x[1, 3] = 0.0, 0.0
    step, slopes = 1e-6, made.jacobian(x, u[:, 0])
    for i in range(4):
        moved = np.zeros(4)
        moved[i] = step
        numeric = (made.step(x + moved, u[:, 0]).x - made.step(x - moved, u[:, 0]).x) / (2 * step)
        np.testing.assert_allclose(slopes[:, :, i], numeric, rtol=0, atol=1e-6)
    z = np.concatenate([x, u[:, 0]], axis=1)
    inside = z + np.random.default_rng(1).uniform(-0.01, 0.01, z.shape)
    box = gc.Interval(z - 0.01, z + 0.01)
    after, jacobian = made.enclosure(box), made.jacobian_enclosure(box)
    new, own = made.step(inside[:, :4], inside[:, 4:]).x, made.jacobian(inside[:, :4], inside[:, 4:])
    assert ((after.lo <= new) & (new <= after.hi)).all()
    assert ((jacobian.lo <= own) & (own <= jacobian.hi)).all()
    assert (after.hi - after.lo).max() < 0.1


def test_dry_friction_after_damping_does_not_feel_its_inertia():
    """v⁺ = soft(v + h (forces − D v) / (M + h D), h F / M); as one force among others it would divide by M + h D."""
    both = {"forces": {"q": "u - D*q_dot"}, "implicit": {"q": "D"}, "dry_friction": {"q": "F"}, "substeps": 1}
    after, among = rod(friction_after_damping=True, **both), rod(**both)
    x, u = motions(after)
    x[:, 1] *= 0.1
    h, mass, damping, bound = 0.01, 0.1 + 1.2 * 0.25, 3.0, 0.8
    forces = u[:, 0, 0] - 1.2 * 9.80665 * 0.5 * np.sin(x[:, 0]) - damping * x[:, 1]
    free = x[:, 1] + h * forces / (mass + h * damping)
    expected = np.sign(free) * np.maximum(np.abs(free) - h * bound / mass, 0)
    assert (expected == 0).any()
    np.testing.assert_allclose(after.step(x, u[:, 0]).x[:, 1], expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(after.fast_rollout(x, u).x, after.rollout(x, u).x, rtol=0, atol=1e-12)
    assert np.abs(among.step(x, u[:, 0]).x[:, 1] - expected).max() > 1e-5


def chain(joints: int, rng: np.random.Generator) -> tuple[str, dict]:
    """An MJCF text, and the same bodies as a section."""

    def text(vector):
        return " ".join(repr(float(v)) for v in vector)

    opened, coordinates, bodies = "", {}, {}
    for i in range(joints):
        slides = i == 2
        axis, at, com, turn = rng.normal(size=3), 0.4 * rng.normal(size=3), 0.2 * rng.normal(size=3), rng.normal(size=4)
        mass, inertia, armature = 1 + rng.random(), [0.05, 0.06, 0.07, 0.01, -0.005, 0.003], 0.01 * rng.random()
        opened += (
            f'<body pos="{text(at)}" quat="{text(turn / np.linalg.norm(turn))}"><inertial pos="{text(com)}" mass="{mass!r}" '
        )
        opened += f'fullinertia="{text(inertia)}"/><joint type="{"slide" if slides else "hinge"}" axis="{text(axis)}" '
        opened += f'armature="{armature!r}"/>'
        coordinates[f"q{i}"] = "m" if slides else "rad"
        bodies[f"b{i}"] = {"joint": f"q{i}", "at": at.tolist(), "turned": turn.tolist(), "axis": axis.tolist(), "mass": mass}
        bodies[f"b{i}"] |= {"com": com.tolist(), "inertia": inertia, "armature": armature}
        bodies[f"b{i}"] |= {"on": f"b{i - 1}"} if i else {}
    option = '<option integrator="Euler" timestep="0.001" gravity="0.5 -0.3 -9.81"/>'
    mjcf = f"<mujoco>{option}<worldbody>{opened}{'</body>' * joints}</worldbody></mujoco>"
    section = {
        "kind": "equations",
        "coordinates": coordinates,
        "bodies": bodies,
        "gravity": ["0.5 m/s^2", "-0.3 m/s^2", "-9.81 m/s^2"],
    }
    return mjcf, section | {"inputs": {"u": "N*m"}, "forces": {"q0": "u"}, "integrator": "semi_implicit", "period": "1 ms"}


def test_seven_joints_move_as_in_mujoco():
    mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed")
    rng = np.random.default_rng(3)
    mjcf, section = chain(7, rng)
    model, made = mujoco.MjModel.from_xml_string(mjcf), build(section)
    data = mujoco.MjData(model)
    for _ in range(5):
        data.qpos[:], data.qvel[:], data.qfrc_applied[0] = rng.normal(size=7), rng.normal(size=7), rng.normal()
        x, u = np.concatenate([data.qpos, data.qvel])[None], np.array([[data.qfrc_applied[0]]])
        mujoco.mj_step(model, data)
        np.testing.assert_allclose(made.step(x, u).x[0], [*data.qpos, *data.qvel], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"lower": {"on": "uper"}}, "bodies.lower.on: 'uper' is no body above this one; did you mean 'upper'"),
        ({"lower": {"joint": "a"}}, "bodies.lower.joint: a moves 'upper' already"),
        ({"lower": {"joint": "c"}}, "bodies.lower.joint: 'c' is no coordinate"),
        ({"lower": {"mass": "l"}}, "bodies.lower.mass: found m"),
        ({"upper": {"com": [0, 0, "m"]}}, "bodies.upper.com.2: found kg"),
        ({"upper": {"inertia": [0, "m", 0]}}, "bodies.upper.inertia.1: found kg"),
        ({"lower": {"armature": "m"}}, "bodies.lower.armature: found kg"),
        ({"lower": {"drag": {"linear": [0, "l"]}}}, "bodies.lower.drag.linear.1: found m"),
        ({"lower": {"drag": {"angular": ["m", 0]}}}, "bodies.lower.drag.angular.0: found kg"),
    ],
)
def test_bad_bodies_are_refused_where_they_are(change, told):
    bodies = {name: body | change.get(name, {}) for name, body in BODIES["bodies"].items()}
    with pytest.raises(gc.UsageError) as refused:
        build(ARM, bodies=bodies)
    assert told in str(refused.value)


SOFT = {"compliance": 0.4, "rate": 105.0}


def test_soft_friction_gives_way_where_hard_friction_rests():
    """f = −(a₀ + b v)/(1/M + R) within ±F, found without the damping that is solved with the step."""
    both = {"forces": {"q": "u - D*q_dot"}, "implicit": {"q": "D"}, "dry_friction": {"q": "F"}, "substeps": 1}
    made, hard = rod(soft_friction={"q": SOFT}, **both), rod(**both)
    x, u = motions(made)
    x[:, 1] *= 0.01
    h, mass, damping, bound = 0.01, 0.1 + 1.2 * 0.25, 3.0, 0.8
    forces = u[:, 0, 0] - 1.2 * 9.80665 * 0.5 * np.sin(x[:, 0]) - damping * x[:, 1]
    pull = forces / mass + SOFT["rate"] * x[:, 1]
    friction = np.clip(-pull / (1 / mass + SOFT["compliance"]), -bound, bound)
    assert (np.abs(friction) < bound).any()
    assert (np.abs(friction) == bound).any()
    expected = x[:, 1] + h * (forces + friction) / (mass + h * damping)
    np.testing.assert_allclose(made.step(x, u[:, 0]).x[:, 1], expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(made.fast_rollout(x, u).x, made.rollout(x, u).x, rtol=0, atol=1e-12)
    assert np.abs(hard.step(x, u[:, 0]).x[:, 1] - expected).max() > 1e-3
    z = np.concatenate([x, u[:, 0]], axis=1)
    inside = z + np.random.default_rng(1).uniform(-0.01, 0.01, z.shape)
    after, new = made.enclosure(gc.Interval(z - 0.01, z + 0.01)), made.step(inside[:, :2], inside[:, 2:]).x
    assert ((after.lo <= new) & (new <= after.hi)).all()
    assert "friction(q) gives way: compliance 0.4, rate 105/s" in made.equations()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"implicit": {"q": "F"}}, "implicit.q: found"),
        ({"implicit": {"p": "D"}}, "implicit.p: 'p' does not belong here"),
        ({"soft_friction": {"p": SOFT}}, "soft_friction.p: 'p' does not belong here"),
        ({"implicit": {"q": "D"}, "integrator": "rk4"}, "rk4 takes no damping with the step"),
    ],
)
def test_bad_friction_is_refused_where_it_is(change, told):
    with pytest.raises(gc.UsageError) as refused:
        rod(**change)
    assert told in str(refused.value)
