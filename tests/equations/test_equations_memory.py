"""Hidden states that effects add: lags, bristles, play, clocks; late outputs; forces at other coordinates; rounding."""

import pickle

import numpy as np
import pytest

import gapcert as gc
from gapcert.testing import SystemContract
from gapcert_equations.config import EquationsConfig

CART = {
    "kind": "equations",
    "coordinates": {"q": "m"},
    "inputs": {"F": "N"},
    "parameters": {"mass": "2 kg"},
    "mass_matrix": [["mass"]],
    "forces": {"q": "F"},
    "integrator": "semi_implicit",
    "substeps": 3,
    "period": "30 ms",
}
LAG = gc.plugin.Memory("slow", "N", "slow + (1 - exp(-{h}/tau))*({u} - slow)")
TAU = gc.Parameter("tau", 0.05, "s", low=0.0)
STEPS = 20


def build(**changes) -> gc.Model:
    from gapcert_equations.model import EquationsModel

    return EquationsModel(EquationsConfig.model_validate(CART | changes))


def effect(site: str, *parameters: gc.Parameter, **texts) -> gc.plugin.Extension:
    return gc.plugin.Extension("effect", site, parameters, **texts)


def commands(n: int = 1) -> np.ndarray:
    return np.random.default_rng(1).normal(size=(n, STEPS, 1))


def by_hand(u: np.ndarray, force, z: float) -> tuple[np.ndarray, float]:
    """q, v after every period of 2 kg in three semi-implicit sub-steps of 10 ms; force(v, u, z) → (force, z⁺)."""
    q = v = 0.0
    out = [(q, v)]
    for command in u[0, :, 0]:
        for _ in range(3):
            f, z = force(v, command, z)
            v += 0.01 * f / 2.0
            q += 0.01 * v
        out.append((q, v))
    return np.array(out), z


def test_a_memory_advances_once_per_substep_and_is_seen_as_it_was():
    model = build().extend([effect("F", TAU, input="slow", memory=(LAG,))])
    assert [(h.name, h.unit) for h in model.hidden] == [("slow", "N")]
    share, u = 1 - np.exp(-0.01 / 0.05), commands()
    path, last = by_hand(u, lambda v, command, z: (z, z + share * (command - z)), 0.0)
    out = model.rollout(np.zeros((1, 2)), u)
    np.testing.assert_allclose(out.x[0], path, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(out.hidden, [[last]], rtol=1e-12)
    assert "slow⁺ = slow + (1 - exp(-h/tau))*(F - slow)" in model.equations()
    assert r"slow^{+} &= " in model.latex()


def test_stages_of_rk4_see_the_memory_of_the_beginning():
    a = gc.Parameter("a", 0.5, "m/s^3")
    model = build(integrator="rk4").extend([effect("q", a, force="mass*a*{t}")])
    out = model.rollout(np.zeros((1, 2)), np.zeros((1, STEPS, 1)))
    # The force is a·t held over each sub-step: v gains h·a·(k h) in sub-step k.
    k = np.arange(3 * STEPS)
    speed = np.concatenate([[0.0], np.cumsum(0.01 * 0.5 * 0.01 * k)])[::3]
    np.testing.assert_allclose(out.x[0, :, 1], speed, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(out.hidden, [[0.03 * STEPS]], rtol=1e-12)


def test_two_effects_share_one_clock_and_it_is_handed_on():
    a, b = gc.Parameter("a", 0.3, "N/s"), gc.Parameter("b", 0.2, "N/s")
    model = build().extend([effect("q", a, force="a*{t}"), effect("q", b, force="b*{t}")])
    assert [h.name for h in model.hidden] == ["time"]
    x, u = np.zeros((1, 2)), commands()
    whole, half = model.rollout(x, u), model.rollout(x, u[:, :7])
    rest = model.rollout(half.x[:, -1], u[:, 7:], hidden=half.hidden)
    assert np.array_equal(rest.x[:, -1], whole.x[:, -1])
    later = model.rollout(x, u, hidden=np.array([[3.0]]))
    assert later.x[0, -1, 1] - whole.x[0, -1, 1] == pytest.approx(0.5 * 3.0 / 2.0 * STEPS * 0.03)


def test_play_in_the_drive_is_a_law_of_what_acts_already():
    gap = gc.Parameter("gap", 0.3, "N")
    play = gc.plugin.Memory("tooth", "N", "max(min(tooth, {f} + gap), {f} - gap)", start=0.1)
    gain = effect("F", gc.Parameter("gain", 1.5), input="gain*{u}")
    model = build().extend([effect("q", gap, force="tooth - {f}", memory=(play,)), gain])
    u = commands()

    def law(v: float, command: float, z: float) -> tuple[float, float]:
        # The gain came later, so it acts nearer to the command: the play sees the amplified force.
        return z, max(min(z, 1.5 * command + 0.3), 1.5 * command - 0.3)

    path, last = by_hand(u, law, 0.1)
    out = model.rollout(np.zeros((1, 2)), u)
    np.testing.assert_allclose(out.x[0], path, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(out.hidden, [[last]], rtol=1e-12)
    assert model.hidden_default == (0.1,)


def test_the_memory_of_a_replaced_input_sees_the_command():
    second = gc.plugin.Memory("rate", "N", "rate + min(max({u} - rate, -2*w), 2*w)")
    w = gc.Parameter("w", 0.05, "N")
    model = build().extend([effect("F", TAU, input="slow", memory=(LAG,)), effect("F", w, input="rate", memory=(second,))])
    texts = {z: m["next"] for z, m in model.to_spec()["memory"].items()}
    assert texts["slow"] == "slow + (1 - exp(-h/tau))*(rate - slow)"
    assert texts["rate"].startswith("rate + min(max(F - rate")


def test_a_derivative_remembers_too():
    from gapcert_equations.model import EquationsModel

    spec = {
        "kind": "equations",
        "states": {"y": "m"},
        "inputs": {"u": "m/s"},
        "derivative": {"y": "u"},
        "integrator": "euler",
        "period": "10 ms",
    }
    base = EquationsModel(EquationsConfig.model_validate(spec))
    z = gc.plugin.Memory("old", "m/s", "{f}")
    model = base.extend([effect("y", force="old - {f}", memory=(z,))])
    u = commands()
    out = model.rollout(np.zeros((1, 1)), u).x[0, :, 0]
    np.testing.assert_allclose(np.diff(out)[1:], 0.01 * u[0, :-1, 0], rtol=1e-9, atol=1e-15)


def test_a_map_remembers_per_period():
    from gapcert_equations.model import EquationsModel

    spec = {
        "kind": "equations",
        "states": {"n": "1"},
        "next": {"n": "n + count"},
        "memory": {"count": {"next": "count + h/w", "start": 2}},
        "parameters": {"w": "1 s"},
        "period": "1 s",
    }
    model = EquationsModel(EquationsConfig.model_validate(spec))
    out = model.rollout(np.zeros((1, 1)), np.zeros((1, 3, 0)))
    assert out.x[0, :, 0].tolist() == [0.0, 2.0, 5.0, 9.0]
    assert out.hidden.tolist() == [[5.0]]


def test_the_sub_step_has_another_name_where_the_model_has_an_h():
    model = build(parameters={"mass": "2 kg", "h": "0.1 m"}).extend([effect("F", TAU, input="slow", memory=(LAG,))])
    assert "exp(-h_/tau)" in model.to_spec()["memory"]["slow"]["next"]
    plain = build().extend([effect("F", TAU, input="slow", memory=(LAG,))])
    u = commands()
    assert np.array_equal(model.rollout(np.zeros((1, 2)), u).x, plain.rollout(np.zeros((1, 2)), u).x)


def test_late_inputs_come_before_memories():
    late = gc.Parameter("late", 0.04, "s", low=0.0, high=0.06)
    model = build().extend([effect("F", TAU, input="slow", memory=(LAG,)), effect("F", late, delay="late")])
    assert [h.name for h in model.hidden] == ["F_delay_1", "F_delay_2", "slow"]
    u, share = commands(), 1 - np.exp(-0.01 / 0.05)
    old = np.concatenate([np.zeros(2), u[0, :, 0]])
    acting = (2 / 3) * old[1:-1] + (1 / 3) * old[:-2]
    path, _ = by_hand(acting[None, :, None], lambda v, command, z: (z, z + share * (command - z)), 0.0)
    np.testing.assert_allclose(model.rollout(np.zeros((1, 2)), u).x[0], path, rtol=1e-12, atol=1e-14)


def test_outputs_may_be_late():
    late = gc.Parameter("late", 0.02, "s", low=0.0, high=0.1)
    model = build(outputs={"pos": "q", "speed": "q_dot"}).extend([effect("pos", late, output_delay="late")])
    assert model.output_delays().tolist() == [0.02, 0.0]
    rows = model.output_delays({"late": np.array([0.0, 0.05])})
    assert rows.tolist() == [[0.0, 0.0], [0.05, 0.0]]
    twice = model.extend([effect("pos", gc.Parameter("more", 0.01, "s"), output_delay="more")])
    assert twice.output_delays()[0] == pytest.approx(0.03)
    assert build(output_delay={"q": "12 ms"}).output_delays().tolist() == [0.012, 0.0]
    assert build().output_delays({"mass": np.ones(3)}).shape == (3, 2)
    x, u = np.ones((1, 2)), np.ones((1, 1))
    assert np.array_equal(model.output(x, u), build().output(x, u))
    with pytest.raises(gc.UsageError, match="fixed delay 12 ms"):
        build(output_delay={"q": "12 ms"}).extend([effect("q", late, output_delay="late")])


def test_a_force_between_two_coordinates():
    from gapcert_equations.model import EquationsModel

    spec = CART | {
        "coordinates": {"a": "m", "b": "m"},
        "mass_matrix": [["mass", "0"], ["0", "mass"]],
        "forces": {"a": "F"},
    }
    k = gc.Parameter("k", 7.0, "N/m")
    spring = effect("a", k, force="-k*({q} - b)", forces={"b": "k*({q} - b)"})
    model = EquationsModel(EquationsConfig.model_validate(spec)).extend([spring])
    assert model.to_spec()["forces"] == {"a": "F - k*(a - b)", "b": "k*(a - b)"}
    x = model.rollout(np.array([[0.3, -0.1, 0.2, 0.0]]), np.zeros((1, 50, 1))).x[0]
    np.testing.assert_allclose(x[:, 2] + x[:, 3], 0.2, rtol=1e-12)
    assert np.ptp(x[:, 2]) > 0.1


def test_a_lifted_tolerance_changes_nothing():
    model = build()
    assert model.extend([gc.plugin.Extension("parameter", "mass", (), frees="mass")]) == model
    with pytest.raises(gc.UsageError, match="did you mean 'mass'"):
        model.extend([gc.plugin.Extension("parameter", "mas", (), frees="mas")])


@pytest.mark.parametrize(
    ("extension", "words"),
    [
        (effect("F", TAU, input="slow", memory=(gc.plugin.Memory("mass", "N", "{u}"),)), "memory 'mass' is already"),
        (effect("F", TAU, input="slow", memory=(gc.plugin.Memory("slow", "m", "{u}"),)), "expected m, the unit of slow"),
        (effect("F", TAU, input="slow", memory=(gc.plugin.Memory("slow", "N", "{v}"),)), "no {v}"),
        (effect("F", gc.Parameter("h", 1.0, "s"), input="{u}"), "'h' is already"),
        (effect("q", force="{f}", forces={"p": "{f}"}), "no such site"),
        (effect("q", gc.Parameter("z", 1.0), output="{y} + slow"), "unknown name 'slow'"),
    ],
)
def test_memories_that_do_not_fit(extension, words):
    with pytest.raises(gc.UsageError, match=words):
        build().extend([extension])


def test_a_clock_needs_its_name():
    with pytest.raises(gc.UsageError, match="a 'time' of its own"):
        build(parameters={"mass": "2 kg", "time": "1 s"}).extend([effect("q", force="mass*{t}")])


def test_an_extended_model_is_a_section_like_any_other():
    from gapcert_equations.model import EquationsModel

    effects = [
        effect("F", TAU, input="slow", memory=(LAG,)),
        effect("q", gc.Parameter("a", 0.5, "N/s"), force="a*{t}"),
        effect("q", gc.Parameter("late", 0.02, "s"), output_delay="late"),
    ]
    model = build().extend(effects)
    again = EquationsModel(EquationsConfig.model_validate(model.to_spec()))
    assert again == model
    u = commands(3)
    expected = model.rollout(np.zeros((3, 2)), u)
    for other in (again, pickle.loads(pickle.dumps(model)), build().extend(effects[:1]).extend(effects[1:])):
        out = other.rollout(np.zeros((3, 2)), u)
        assert np.array_equal(out.x, expected.x)
        assert np.array_equal(out.hidden, expected.hidden)


def test_a_symbol_may_change_its_kind_between_extensions():
    from gapcert_equations.model import EquationsModel

    model, u = build(), commands()
    first = model.extend([effect("q", gc.Parameter("z", 1.0, "N"), force="z")])
    second = model.extend([effect("q", force="z", memory=(gc.plugin.Memory("z", "N", "z + {f}", start=1.0),))])
    assert not np.array_equal(first.rollout(np.zeros((1, 2)), u).x, second.rollout(np.zeros((1, 2)), u).x)
    fresh = EquationsModel(EquationsConfig.model_validate(second.to_spec()))
    assert np.array_equal(fresh.rollout(np.zeros((1, 2)), u).x, second.rollout(np.zeros((1, 2)), u).x)


def test_bounds_hold_from_the_default():
    model = build().extend([effect("F", TAU, input="slow + F", memory=(gc.plugin.Memory("slow", "N", "{u}", start=0.4),))])
    rng = np.random.default_rng(3)
    x, u = rng.normal(size=(50, 2)), rng.normal(size=(50, 1))
    z = gc.Interval.hull(np.hstack([x, u]) - 0.1, np.hstack([x, u]) + 0.1)
    box, new = model.enclosure(z), model.step(x, u).x
    assert ((box.lo <= new) & (new <= box.hi)).all()
    change = model.step(x, u + 0.5).x - model.step(x, u - 0.5).x
    np.testing.assert_allclose(model.jacobian(x, u)[:, :, 2], change, rtol=1e-9)


def test_no_certificate_without_a_word_on_hidden_state():
    model = build().extend([effect("F", TAU, input="slow", memory=(LAG,))])
    spec = {"version": 1, "name": "hidden", "model": model.to_spec(), "backend": CART}
    spec |= {"domain": {"q": [-1, 1], "q_dot": [-1, 1], "F": [-1, 1]}, "sampling": {"kind": "adaptive", "budget": 50}}
    with pytest.raises(gc.UsageError, match="the model has hidden state"):
        gc.run(gc.load_spec(spec))


def test_rounding():
    model = build(forces={"q": "w*round(F/w)"}, parameters={"mass": "2 kg", "w": "0.5 N"}, substeps=1)
    u = np.array([[0.24], [0.26], [0.8], [-0.7]])
    speed = model.step(np.zeros((4, 2)), u).x[:, 1]
    np.testing.assert_allclose(speed, 0.015 * np.array([0.0, 0.5, 1.0, -0.5]), rtol=1e-14)
    assert np.array_equal(model.jacobian(np.zeros((4, 2)), u)[:, :, 2], np.zeros((4, 2)))
    z = gc.Interval.hull(np.array([[0, 0, 0.1], [0, 0, 0.1]]), np.array([[0, 0, 0.2], [0, 0, 0.3]]))
    slopes = model.jacobian_enclosure(z)
    assert (slopes.hi[0, 1, 2], slopes.hi[1, 1, 2]) == (pytest.approx(0, abs=1e-300), np.inf)
    box = model.enclosure(z)
    assert box.hi[:, 1] == pytest.approx([0.0, 0.0075])


class TestRemembering(SystemContract):
    def system(self) -> gc.System:
        bristle = gc.plugin.Memory("bend", "m", "bend*exp(-{h}*abs({v})/w) + {h}*{v}")
        w, k = gc.Parameter("w", 0.01, "m"), gc.Parameter("k", 30.0, "N/m")
        return build(integrator="rk4").extend(
            [
                effect("q", w, k, force="-k*bend", memory=(bristle,)),
                effect("F", TAU, input="slow", memory=(LAG,)),
                effect("F", gc.Parameter("late", 0.04, "s", low=0.0, high=0.06), delay="late"),
            ]
        )
