"""The laws themselves: exact over a sub-step, special cases of each other where they say so, findable from their grids."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

import gapcert as gc
from gapcert_diagnosis.testing import BASE, CARRIER, CART, PAIR, PLAIN, ROD, equations

FREE = {  # q' = u shows what reaches the model, and nothing else
    "kind": "equations",
    "states": {"q": "m"},
    "inputs": {"u": "m/s"},
    "derivative": {"q": "u"},
    "integrator": "rk4",
    "period": "10 ms",
}
BLOCK = {
    "kind": "equations",
    "coordinates": {"q": "m"},
    "inputs": {"u": "N"},
    "parameters": {"mass": "2 kg"},
    "mass_matrix": [["mass"]],
    "forces": {"q": "u"},
    "integrator": "rk4",
    "period": "10 ms",
}


def with_effect(section, name, site, **numbers):
    """A model with one effect at the given numbers."""
    model, effect = equations(section), gc.registry().build("effect", name)
    extension = effect.extension(site, model)
    values = {p.name: numbers[e.name] for p, e in zip(extension.parameters, effect.parameters, strict=True)}
    known = {k: p for k, p in vars(extension).items() if k != "parameters"}
    parameters = tuple(gc.Parameter(p.name, values[p.name], p.unit, 0.0, p.low, p.high) for p in extension.parameters)
    return model.extend([gc.plugin.Extension(parameters=parameters, **known)])


def driven(section, name, site, u, x0=None, **numbers):
    """Its path (T + 1, nx) under u (T,)."""
    model = with_effect(section, name, site, **numbers)
    start = np.zeros((1, model.nx)) if x0 is None else np.array([x0])
    return model.fast_rollout(start, np.asarray(u, dtype=float)[None, :, None]).x[0]


LEVELS = np.repeat(np.random.default_rng(0).uniform(-1, 1, 40), 7)


@pytest.mark.parametrize("rate", [0.3, 4.0, 31.0, 70.0])
def test_a_limited_rate_has_its_exact_mean_in_every_step(rate):
    fine, r, total = 500, 0.0, [0.0]
    h = 0.01 / fine
    for u in LEVELS[:60]:
        delta = np.clip((u - r), -rate * h * np.arange(1, fine + 1), rate * h * np.arange(1, fine + 1))
        total.append(total[-1] + h * np.sum(r + delta - 0.5 * np.diff(delta, prepend=0.0)))
        r = r + delta[-1]
    np.testing.assert_allclose(driven(FREE, "input-rate-limit", "u", LEVELS[:60], rate=rate)[:, 0], total, atol=1e-8)


@pytest.mark.parametrize("time", [1e-4, 0.01, 0.3])
def test_a_lag_has_its_exact_mean_in_every_step(time):
    r, total, decay = 0.0, [0.0], math.exp(-0.01 / time)
    for u in LEVELS:
        total.append(total[-1] + 0.01 * u + time * (r - u) * (1 - decay))
        r = u + (r - u) * decay
    np.testing.assert_allclose(driven(FREE, "input-lag", "u", LEVELS, time_constant=time)[:, 0], total, atol=1e-12)


def test_a_lag_of_no_time_is_none():
    plain = equations(FREE).rollout(np.zeros((1, 1)), LEVELS[None, :, None]).x[0]
    assert np.array_equal(driven(FREE, "input-lag", "u", LEVELS, time_constant=0.0), plain)


@pytest.mark.parametrize("time", [0.0, 1e-4, 0.01, 0.3])
def test_a_slow_sensor_follows_straight_lines_exactly(time):
    model, left = with_effect(FREE, "sensor-lag", "q", time_constant=time), math.exp(-0.01 / time) if time else 0.0
    x, z, hidden = np.array([[0.3]]), 0.3, np.zeros((1, 2))
    for u in LEVELS:
        moved = model.fast_rollout(x, np.array([[[u]]]), hidden=hidden)
        # Towards a line of slope u, which it is behind by T·u in the end.
        z = moved.x[0, -1, 0] - u * time + (z - x[0, 0] + u * time) * left
        x, hidden = moved.x[:, -1], moved.hidden
        assert model.output(x, np.zeros((1, 1)), None, hidden)[0, 0] == pytest.approx(z, abs=1e-12)


def servo(u, rate, time, fine=2000):
    """q under q̇ = r, ṙ = clip((u − r)/time, ±rate), by fine steps of the trapezoid."""
    r, total, h = 0.0, [0.0], 0.01 / fine
    for level in u:
        path = [r]
        for _ in range(fine):
            # A lag over one fine step, no faster than the limit.
            path.append(path[-1] + float(np.clip((level - path[-1]) * -math.expm1(-h / time), -rate * h, rate * h)))
        r = path[-1]
        total.append(total[-1] + h * float(np.sum(path) - 0.5 * (path[0] + path[-1])))
    return total


@pytest.mark.exam
@pytest.mark.parametrize(("rate", "time"), [(0.3, 0.02), (4.0, 0.004), (4.0, 0.05), (31.0, 0.02), (31.0, 0.0005), (70.0, 0.1)])
def test_a_lag_of_limited_rate_has_its_exact_mean_in_every_step(rate, time):
    found = driven(FREE, "input-rate-limited-lag", "u", LEVELS[:40], rate=rate, time_constant=time)[:, 0]
    np.testing.assert_allclose(found, servo(LEVELS[:40], rate, time), atol=3e-7)


@pytest.mark.parametrize("rate", [0.3, 4.0, 31.0, 70.0])
def test_without_a_time_constant_it_is_the_rate_limit(rate):
    found = driven(FREE, "input-rate-limited-lag", "u", LEVELS, rate=rate, time_constant=0.0)
    np.testing.assert_allclose(found[:, 0], driven(FREE, "input-rate-limit", "u", LEVELS, rate=rate)[:, 0], atol=1e-12)


@pytest.mark.parametrize("time", [1e-4, 0.01, 0.3])
def test_without_a_limit_of_its_rate_it_is_the_lag(time):
    found = driven(FREE, "input-rate-limited-lag", "u", LEVELS, rate=1e15, time_constant=time)
    np.testing.assert_allclose(found[:, 0], driven(FREE, "input-lag", "u", LEVELS, time_constant=time)[:, 0], atol=1e-12)


def test_a_sagging_supply_drains_by_what_it_gave():
    p, total, decay = 0.0, [0.0], math.exp(-0.01 / 0.5)
    for u in LEVELS:
        mean = abs(u) + (p - abs(u)) * (1 - decay) * 0.5 / 0.01
        total.append(total[-1] + 0.01 * u * (1 - 0.4 * mean))
        p = abs(u) + (p - abs(u)) * decay
    np.testing.assert_allclose(driven(FREE, "supply-sag", "u", LEVELS, sag=0.4, time_constant=0.5)[:, 0], total, atol=1e-12)


def test_a_supply_may_sag_for_as_long_as_the_log():
    effect = gc.registry().build("effect", "supply-sag")
    scales = {"input": 0.4, "duration": 37.0, "period": 0.004}
    times = [t for _, t in effect.grid(scales)]
    assert effect.parameters[1].bounds(scales) == (0.01, 37.0)
    assert 0.5 * 37 < max(times) < 37
    assert min(times) == 5 * 0.004
    assert max(t for _, t in effect.grid(scales | {"duration": 1.5})) < 1.5


def back_and_forth(n=6000, turns=84):
    """Places of a motion, and teeth there: as many over the range."""
    t = np.linspace(0, 1, n)
    place = np.cumsum(np.cos(11 * t) + 0.8 * np.cos(37 * t + 1) + 0.3 * np.cos(71 * t + 2))
    return place, np.sin(2 * np.pi * turns * place / np.ptp(place) + 0.7)


def test_data_suggest_a_period_finer_than_those_that_are_tried():
    effect, (place, teeth) = gc.registry().build("effect", "cogging"), back_and_forth()
    noise = np.random.default_rng(3).standard_normal(len(place))
    found = effect.suggested(place, 0.4 * teeth + noise + 0.5 * np.sign(np.gradient(place)))
    turns = {round(np.ptp(place) / period, 6) for _, period, _ in found}
    assert min(abs(n - 84) for n in turns) <= 0.125
    assert {phase for _, _, phase in found} == {0.0, 0.5 * np.pi}


def test_of_noise_and_of_what_is_sampled_too_coarsely_none_is_suggested():
    effect, (place, teeth) = gc.registry().build("effect", "cogging"), back_and_forth()
    noise = np.random.default_rng(4).standard_normal(len(place))
    assert effect.suggested(place, noise) == []
    assert effect.suggested(place, np.sign(np.gradient(place))) == []
    assert effect.suggested(place[::30], teeth[::30]) == []
    assert effect.suggested(place, np.where(place == place[7], np.inf, teeth)) == []
    assert effect.suggested(place[:0], teeth[:0]) == []


def test_dead_zone_saturation_gain_and_offset():
    def gives(name, **numbers):
        return np.diff(driven(FREE, name, "u", LEVELS, **numbers)[:, 0]) / 0.01

    np.testing.assert_allclose(gives("input-dead-zone", width=0.3), LEVELS - np.clip(LEVELS, -0.3, 0.3), atol=1e-12)
    np.testing.assert_allclose(gives("input-saturation", level=0.3), np.clip(LEVELS, -0.3, 0.3), atol=1e-12)
    np.testing.assert_allclose(gives("input-gain", gain=-1.2), -1.2 * LEVELS, atol=1e-12)
    np.testing.assert_allclose(gives("input-offset", offset=0.2), LEVELS + 0.2, atol=1e-12)


def form(name, of="u", section=FREE, **numbers):
    """What reaches the model of LEVELS under another form of an effect."""
    effect = next(f for n in INPUTS for f in gc.registry().build("effect", n).variants if f.name == name)()
    model = equations(section)
    extension = effect.extension(of, model)
    own = zip(extension.parameters, effect.parameters, strict=False)
    parameters = tuple(replace(p, value=numbers[e.name]) for p, e in own) + extension.parameters[len(effect.parameters) :]
    extended = model.extend([replace(extension, parameters=parameters)])
    return np.diff(extended.fast_rollout(np.zeros((1, 1)), LEVELS[None, :, None]).x[0, :, 0]) / 0.01


INPUTS = ("input-dead-zone", "input-saturation", "input-lag", "input-nonlinearity")


def test_soft_limits_bend_before_they_hold():
    np.testing.assert_allclose(form("input-saturation-soft", level=0.4), 0.4 * np.tanh(LEVELS / 0.4), atol=1e-12)
    rounded = LEVELS / np.sqrt(1 + (LEVELS / 0.4) ** 2)
    np.testing.assert_allclose(form("input-saturation-rounded", level=0.4, sharpness=2.0), rounded, atol=1e-12)
    hard = form("input-saturation-rounded", level=0.4, sharpness=500.0)
    np.testing.assert_allclose(hard, np.clip(LEVELS, -0.4, 0.4), atol=1e-3)


def test_a_dead_zone_may_lie_on_one_side_of_zero():
    for minus, plus in ((0.1, 0.5), (-0.1, 0.5), (0.6, 0.0)):
        found = form("input-dead-zone-uneven", minus=minus, plus=plus)
        np.testing.assert_allclose(found, LEVELS - np.clip(LEVELS, -minus, plus), atol=1e-12)
        bent = np.maximum(LEVELS - plus, 0) + 0.7 * np.minimum(LEVELS + minus, 0)
        np.testing.assert_allclose(form("input-dead-zone-bent", minus=minus, plus=plus, ratio=0.7), bent, atol=1e-12)


def test_a_curve_is_straight_between_its_knots_and_constant_beyond():
    numbers = dict(zip((f"at_{k}" for k in range(1, 8)), (0.3, -0.1, 0.2, 0.0, 0.1, -0.4, 0.5), strict=True))
    found = form("input-curve", **numbers)
    np.testing.assert_allclose(found, LEVELS + np.interp(LEVELS, np.linspace(-1, 1, 7), list(numbers.values())), atol=1e-12)
    curve = gc.registry().build("effect", "input-nonlinearity").variants[0]()
    for low, high, knots in ((-2.0, 4.0, [-0.5, -1 / 3, -1 / 6, 0, 1 / 3, 2 / 3, 1]), (1.0, 4.0, np.linspace(0.25, 1, 7))):
        made = curve.scaled({"input_low": low, "input_high": high, "input_peak": max(-low, high)})
        np.testing.assert_allclose(made.knots, knots, atol=1e-4)
        assert made.reach == 4.0
    bent = np.diff(driven(FREE, "input-nonlinearity", "u", LEVELS, square=0.3, cube=-0.2)[:, 0]) / 0.01
    np.testing.assert_allclose(bent, LEVELS + 0.3 * LEVELS**2 - 0.2 * LEVELS**3, atol=1e-12)


def test_hysteresis_of_the_only_force_is_play_of_that_force():
    one, two = (driven(BLOCK, name, site, LEVELS, width=0.25) for name, site in (("input-hysteresis", "u"), ("backlash", "q")))
    np.testing.assert_allclose(one, two, atol=1e-12)


def test_a_second_lag_follows_the_first():
    found, one, two, z, fine = form("input-lag-second-order", time_constant=0.3, second=0.08), 0.3, 0.08, np.zeros(2), 400
    for k, level in enumerate(LEVELS[:80]):
        passed = []
        for _ in range(fine):
            z[0] += (level - z[0]) * 0.01 / fine / one
            z[1] += (z[0] - z[1]) * 0.01 / fine / two
            passed.append(z[1])
        assert found[k] == pytest.approx(np.mean(passed), abs=1e-3)
    alone = np.diff(driven(FREE, "input-lag", "u", LEVELS, time_constant=0.3)[:, 0]) / 0.01
    np.testing.assert_allclose(form("input-lag-second-order", time_constant=0.3, second=0.0), alone, atol=1e-12)


def test_play_keeps_its_distance_and_holds_in_between():
    v = driven(BLOCK, "backlash", "q", LEVELS, width=0.25)[:, 1]
    passed, wanted = 0.0, []
    for u in LEVELS:
        passed = min(max(passed, u - 0.25), u + 0.25)
        wanted.append(passed)
    np.testing.assert_allclose(np.diff(v) * 2 / 0.01, wanted, atol=1e-9)


def test_slip_takes_small_forces_whole_and_no_more_than_the_traction():
    v = driven(BLOCK, "wheel-slip", "q", [1e-3, 50.0], traction=1.0)[:, 1]
    np.testing.assert_allclose(np.diff(v) * 2 / 0.01, [1e-3, 1.0], rtol=1e-6)


@pytest.mark.parametrize(("time", "duration"), [(0.1, 0.2), (0.1037, 0.0012), (0.0999, 0.1003)])
def test_a_push_has_its_impulse_wherever_it_falls_in_a_step(time, duration):
    x = driven(BLOCK, "external-push", "q", np.zeros(50), force=3.0, time=time, duration=duration)
    assert x[-1, 1] == pytest.approx(3.0 * duration / 2, rel=1e-12)
    assert x[int(time / 0.01), 1] == 0


@pytest.mark.parametrize("section", [BLOCK, {**BLOCK, "integrator": "semi_implicit"}], ids=["rk4", "semi_implicit"])
def test_a_bristle_at_rest_is_a_spring_that_neither_gains_nor_loses(section):
    """Stiffness 0.4/0.05 on 2 kg: 2 rad/s for 40 periods, far inside the bend at which it would slide."""
    x = driven(section, "dahl-friction", "q", np.zeros(12_600), x0=[0.0, 2e-5], level=0.4, displacement=0.05)
    energy = 0.5 * 2 * x[:, 1] ** 2 + 0.5 * 8 * x[:, 0] ** 2
    late = energy[-700:].max()
    assert late == pytest.approx(energy[:700].max(), rel=0.03)
    turns = np.flatnonzero(np.diff(np.sign(x[:, 1])) < 0)
    assert 0.01 * np.diff(turns).mean() == pytest.approx(2 * np.pi / 2, rel=5e-3)


def test_a_bristle_bends_over_its_displacement():
    """Dragged at constant speed, f/F = 1 − exp(−way/displacement)."""
    extended = with_effect(BLOCK, "dahl-friction", "q", level=0.4, displacement=0.05)
    x, hidden, forces = np.array([[0.0, 1.0]]), np.zeros((1, 1)), []
    for _ in range(20):
        step = extended.step(x, np.zeros((1, 1)), hidden=hidden)
        forces.append((1.0 - step.x[0, 1]) * 2 / 0.01)
        hidden = step.hidden
    np.testing.assert_allclose(forces, 0.4 * (1 - np.exp(-0.01 * np.arange(1, 21) / 0.05)), rtol=5e-3)


SWING = {"x0": [0.5, 0.0], "u": 2 * np.sin(0.03 * np.arange(500))}
CASES = [
    ("stribeck-friction", {"level": 0.2, "ratio": 0.0, "velocity": 0.3}, "coulomb-friction", {"level": 0.2}),
    ("asymmetric-coulomb-friction", {"plus": 0.2, "minus": 0.2}, "coulomb-friction", {"level": 0.2}),
    ("asymmetric-viscous-friction", {"plus": 0.2, "minus": 0.2}, "viscous-friction", {"coefficient": 0.2}),
    (
        "lugre-friction",
        {"level": 0.2, "ratio": 0.0, "velocity": 0.3, "displacement": 0.02},
        "dahl-friction",
        {"level": 0.2, "displacement": 0.02},
    ),
]


@pytest.mark.parametrize(("rich", "numbers", "simple", "fewer"), CASES, ids=[c[0] for c in CASES])
def test_a_law_contains_its_special_case(rich, numbers, simple, fewer):
    one, two = driven(ROD, rich, "q", **SWING, **numbers), driven(ROD, simple, "q", **SWING, **fewer)
    np.testing.assert_allclose(one, two, atol=1e-11)
    mapping = gc.registry().build("effect", rich).contains[simple]
    assert {mine: fewer[theirs] for mine, theirs in mapping.items()}.items() <= numbers.items()


@pytest.mark.parametrize(("rich", "simple"), [("dahl-friction", "coulomb-friction"), ("lugre-friction", "stribeck-friction")])
def test_stiff_bristles_come_to_the_dry_law(rich, simple):
    """The way of a reversal grows with the square of its time: the gap falls with the root of the displacement."""
    fine, slide = {**ROD, "substeps": 20}, {"x0": [0.5, 2.0], "u": 2 * np.sin(0.03 * np.arange(120))}
    numbers = {"level": 0.2, "ratio": 0.5, "velocity": 0.3}
    fewer = {k: v for k, v in numbers.items() if k == "level" or simple == "stribeck-friction"}
    dry = driven(fine, simple, "q", **slide, **fewer)
    rest = {} if rich == "dahl-friction" else {k: numbers[k] for k in ("ratio", "velocity")}
    gaps = [
        np.abs(driven(fine, rich, "q", **slide, level=0.2, displacement=d, **rest) - dry).max() for d in (0.04, 0.004, 0.0004)
    ]
    assert gaps[0] > 2.2 * gaps[1] > 2.2**2 * gaps[2]


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_asymmetric_laws_have_their_sides(way):
    slide = {"x0": [0.0, way], "u": np.zeros(1)}
    dry = driven(BLOCK, "asymmetric-coulomb-friction", "q", **slide, plus=0.3, minus=0.1)
    wet = driven(BLOCK, "asymmetric-viscous-friction", "q", **slide, plus=0.3, minus=0.1)
    expected = -(0.3 if way > 0 else -0.1) / 2 * 0.01
    assert dry[1, 1] - way == pytest.approx(expected, rel=1e-9)
    assert wet[1, 1] - way == pytest.approx(expected, rel=1e-3)


def test_an_asymmetric_dry_joint_rests_between_its_levels():
    for push, moves in ((0.29, False), (0.31, True), (-0.09, False), (-0.11, True)):
        x = driven(BLOCK, "asymmetric-coulomb-friction", "q", np.full(20, push), plus=0.3, minus=0.1)
        assert bool(np.any(x)) == moves


def test_friction_of_the_load_is_that_of_the_applied_force():
    x = driven(BLOCK, "load-dependent-friction", "q", [2.0, -2.0, 0.0], x0=[0.0, 5.0], coefficient=0.25)
    np.testing.assert_allclose(np.diff(x[:, 1]) * 2 / 0.01, [1.5, -2.5, 0.0], atol=1e-9)


def test_a_payload_is_a_mass_at_the_tip():
    heavy = with_effect(CARRIER, "payload", "q", mass=0.4)
    hand = equations({**CARRIER, "mass_matrix": [["m*l**2*(1/3 + 0.4)"]], "bias": {"q": "m*(1/2 + 0.4)*g*l*sin(q)"}})
    x, u = np.array([[0.7, -0.4]]), np.ones((1, 80, 1))
    np.testing.assert_allclose(heavy.rollout(x, u).x, hand.rollout(x, u).x, atol=1e-12)


def test_a_coupling_feels_the_neighbour():
    """M·Δv/h of one explicit step is the force: −0.2·0.7 at joint q, none at joint p."""
    section = {**PAIR, "integrator": "euler"}
    x, u = np.array([[0.0, 0.0, 0.3, 0.7]]), np.zeros((1, 2))
    new, old = (
        m.step(x, u).x[0, 2:] for m in (with_effect(section, "joint-coupling", "q", coefficient=0.2), equations(section))
    )
    np.testing.assert_allclose(np.array([[0.5, 0.05], [0.05, 0.2]]) @ (new - old) / 0.01, [-0.14, 0.0], atol=1e-12)


TWINS = [
    (BLOCK, ("constant-force", "q", {"force": 0.3}), ("input-offset", "u", {"offset": 0.3}), None),
    (BLOCK, ("constant-force", "q", {"force": 2 * 9.80665 * math.sin(0.1)}), ("gravity-tilt", "q", {"angle": 0.1}), None),
    (ROD, ("gravity-tilt", "q", {"angle": 0.1}), ("sensor-bias", "q", {"bias": 0.1}), -0.1),
]


def test_a_soft_limit_of_one_force_is_slip():
    model, slip = equations(CART), with_effect(CART, "wheel-slip", "q", traction=0.7)
    soft = gc.registry().build("effect", "input-saturation").variants[0]().extension("u", model)
    limited = model.extend([replace(soft, parameters=(replace(soft.parameters[0], value=0.7),))])
    x, u = np.array([[0.1, 0.2]]), 2 * np.sin(0.07 * np.arange(200))[None, :, None]
    np.testing.assert_allclose(slip.rollout(x, u).x, limited.rollout(x, u).x, atol=1e-12)


@pytest.mark.parametrize(("section", "one", "two", "shift"), TWINS, ids=[f"{a[0]}-{b[0]}" for _, a, b, _ in TWINS])
def test_what_is_called_equivalent_is(section, one, two, shift):
    u, shown = np.sin(0.05 * np.arange(200)), []
    for (name, site, numbers), moved in ((one, 0.0), (two, shift or 0.0)):
        model = with_effect(section, name, site, **numbers)
        x = model.rollout(np.array([[0.4 + moved, 0.1]]), u[None, :, None]).x[0]
        shown.append(model.output(x[:-1], u[:, None])[:, 0])
    np.testing.assert_allclose(*shown, atol=1e-9)
    assert two[0] in gc.registry().build("effect", one[0]).equivalent


@pytest.mark.parametrize("turns", [1.31, 2.4, 7.77, 19.0])
def test_the_grid_of_cogging_has_a_neighbour_of_every_needle(turns):
    """Over a way that is spent evenly, some start explains more than half of a wave of any period and phase."""
    cogging = gc.registry().build("effect", "cogging")
    q = np.linspace(-1, 1.5, 4000)
    grid = np.array(cogging.grid({"force": 1.0, "position_range": 2.5}))
    waves = np.sin(2 * np.pi * q / grid[:, 1:2] + grid[:, 2:])
    for phase in np.linspace(-3, 3, 7):
        wave = np.sin(2 * np.pi * q * turns / 2.5 + phase)
        share = (waves @ wave) ** 2 / ((waves**2).sum(axis=1) * (wave @ wave))
        assert share.max() > 0.4


def test_the_grid_of_pushes_covers_the_recording():
    push = gc.registry().build("effect", "external-push")
    for duration in (3.0, 12.0, 100.0):
        grid = np.array(push.grid({"force": 1.0, "start": 5.0, "duration": duration}))
        assert len(grid) <= 80
        assert grid[0, 1] == 5.0
        np.testing.assert_allclose(grid[:-1, 1] + grid[:-1, 2], grid[1:, 1])
        assert grid[-1, 1] + 2 * grid[-1, 2] > 5.0 + duration


APPLIES = [
    ("joint-coupling", PAIR, {"q", "p"}),
    ("joint-coupling", ROD, set()),
    ("payload", CARRIER, {"q"}),
    ("payload", ROD, set()),
    ("gravity-tilt", CART, {"q"}),
    ("gravity-tilt", PLAIN, set()),
    ("gravity-tilt", {**PAIR, "bias": {"p": "k/2*sin(p)"}}, {"p"}),
    ("wheel-slip", CART, {"q"}),
    ("wheel-slip", ROD, set()),
    ("side-slip", BASE, {"x"}),
    ("side-slip", {**BASE, "derivative": {**BASE["derivative"], "y": "v*sin(theta) + v/2"}}, set()),
    ("side-slip", {**BASE, "derivative": {**BASE["derivative"], "y": "-v*sin(theta)"}}, set()),
    ("side-slip", PLAIN, set()),
    ("backlash", {**PAIR, "forces": {"q": "u"}, "inputs": {"u": "N*m"}}, {"q"}),
    ("backlash", PLAIN, set()),
    ("load-dependent-friction", {**PAIR, "forces": {"q": "u"}, "inputs": {"u": "N*m"}}, {"q"}),
    ("gear-play", ROD, {"q"}),
    ("gear-play", {**PAIR, "mass_matrix": [["J", "0"], ["0", "I"]], "forces": {"q": "u"}, "inputs": {"u": "N*m"}}, {"q"}),
    ("gear-play", PAIR, set()),
    ("gear-play", PLAIN, set()),
    ("gear-play", {**PLAIN, "states": {"x": "m", "q": "m/s"}, "derivative": {"x": "q", "q": "u - k*q"}}, set()),
    ("linear-spring", PLAIN, set()),
    ("cogging", {**PLAIN, "states": {"x": "m", "q": "m/s"}, "derivative": {"x": "q", "q": "u - k*q"}}, {"q"}),
    ("parameter", CARRIER, {"m"}),
]


@pytest.mark.parametrize(("name", "section", "where"), APPLIES)
def test_where_an_effect_can_act(name, section, where):
    model, effect = equations(section), gc.registry().build("effect", name)
    assert {s for s in model.sites(effect.site) if effect.applies(s, model)} == where


def test_an_implausible_sign_can_be_fitted_and_is_outside_what_is_plausible():
    for name in ("viscous-friction", "quadratic-drag", "linear-spring"):
        (p,) = gc.registry().build("effect", name).parameters
        assert p.low < 0 <= p.plausible[0]


def test_a_canonical_wave_has_a_positive_amplitude_and_a_phase_within_half_a_turn():
    cogging = gc.registry().build("effect", "cogging")
    for amplitude, phase in itertools.product((-0.3, 0.3), (-9.0, 0.4, 3.0, 8.0)):
        plain = cogging.canonical({"amplitude": amplitude, "period": 0.5, "phase": phase})
        assert plain["amplitude"] == 0.3
        assert abs(plain["phase"]) <= math.pi
        assert plain["amplitude"] * math.sin(plain["phase"]) == pytest.approx(amplitude * math.sin(phase))


GEAR = {
    "kind": "equations",
    "coordinates": {"q": "rad"},
    "inputs": {"u": "N*m"},
    "parameters": {"inertia": "0.05 kg*m^2", "rubs": "0.05 N*m/(rad/s)", "weighs": "0.1 N*m"},
    "mass_matrix": [["inertia"]],
    "bias": {"q": "weighs*sin(q)"},
    "forces": {"q": "u - rubs*q_dot"},
    "integrator": "rk4",
    "period": "5 ms",
}
TURNS = np.sin(2 * np.pi * 0.9 * np.arange(400) * 0.005) + 0.6 * np.sin(2 * np.pi * 2.3 * np.arange(400) * 0.005)


def two_inertias(u, link, width, damping, fine=50):
    """Angles of motor and link (T + 1, 2) in fine steps; link: its share of the inertia; knocks throw nothing back."""
    h, own, path = 0.005 / fine, 0.05 * np.array([1 - link, link]), [(0.0, 0.0)]
    q, v = np.zeros(2), np.zeros(2)
    for level in u:
        for _ in range(fine):
            v = v + h / own * (level - (0.05 - damping) * v[0], -damping * v[1] - 0.1 * np.sin(q[1]))
            gap = q[0] - q[1] + h * (v[0] - v[1])
            knock = (gap - min(max(gap, -width / 2), width / 2)) / h * own.prod() / 0.05
            v = v + knock / own * (-1, 1)
            q = q + h * v
        path.append(tuple(q))
    return np.array(path)


def played(seen, share, width, decay):
    """Its path (T + 1, 2) as the library has it, seen from the motor (0) or the link (1)."""
    motor, model = gc.registry().build("effect", "gear-play"), equations(GEAR)
    extension = (motor, motor.variants[0]())[seen].extension("q", model)
    known = zip(extension.parameters, (width, share * width, decay), strict=True)
    extended = model.extend([replace(extension, parameters=tuple(replace(p, value=v) for p, v in known))])
    return extended.fast_rollout(np.zeros((1, 2)), TURNS[None, :, None]).x[0]


@pytest.mark.parametrize("link", [0.3, 0.7])
@pytest.mark.parametrize("seen", [0, 1], ids=["motor", "link"])
def test_play_in_the_angle_is_two_inertias_with_a_gap(seen, link):
    path = two_inertias(TURNS, link, 0.06, 0.02)[:, seen]
    plain = equations(GEAR).fast_rollout(np.zeros((1, 2)), TURNS[None, :, None]).x[0, :, 0]
    off = played(seen, (link, 1 - link)[seen], 0.06, 0.02 / (0.05 * link))[:, 0] - path
    assert np.sqrt(np.mean(off**2)) < 0.05 * np.sqrt(np.mean((plain - path) ** 2))


@pytest.mark.parametrize("seen", [0, 1], ids=["motor", "link"])
def test_without_a_gap_nothing_moves_apart(seen):
    fine = equations({**GEAR, "substeps": 4}).fast_rollout(np.zeros((1, 2)), TURNS[None, :, None]).x[0]
    np.testing.assert_allclose(played(seen, 0.4, 0.0, 0.5), fine, atol=1e-9)


def test_long_laws_go_into_a_saturated_root():
    """A text that SymPy would expand for minutes, to learn whether a tanh of it is real."""
    numbers = {"k": "3 m/(s*V)", "r": "0.2", "us": "0.4 V", "tau": "0.1 s"}
    slope = {"y": "v", "v": "(k*u*sqrt(1 - r*tanh(u/us)) - v)/tau"}
    section = {"states": {"y": "m", "v": "m/s"}, "inputs": {"u": "V"}, "period": "5 ms", "integrator": "rk4"}
    model = equations({"kind": "equations", **section, "parameters": numbers, "derivative": slope})
    laws = [gc.registry().build("effect", name) for name in ("supply-sag", "input-rate-limited-lag")]
    assert len(model.extend([law.extension("u", model) for law in laws]).hidden) == 2
