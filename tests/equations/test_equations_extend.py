"""Effects become text: the extended model is a spec, prints, and does what was written by hand."""

import numpy as np
import pytest

import gapcert as gc
from gapcert_equations.config import EquationsConfig

MECHANICAL = {
    "kind": "equations",
    "coordinates": {"q": "m"},
    "inputs": {"F": "N"},
    "parameters": {"mass": {"value": "2 kg", "tolerance": "10 %"}},
    "mass_matrix": [["mass"]],
    "forces": {"q": "F"},
    "integrator": "semi_implicit",
    "period": "10 ms",
}
PLAIN = {
    "kind": "equations",
    "states": {"theta": "rad", "omega": "rad/s"},
    "inputs": {"torque": "N*m"},
    "parameters": {"J": "2 kg*m^2"},
    "derivative": {"theta": "omega", "omega": "torque/J"},
    "integrator": "euler",
    "period": "10 ms",
}


def build(spec: dict, **changes) -> gc.Model:
    from gapcert_equations.model import EquationsModel

    return EquationsModel(EquationsConfig.model_validate(spec | changes))


def effect(site: str, *parameters: gc.Parameter, **texts) -> gc.plugin.Extension:
    return gc.plugin.Extension("effect", site, parameters, **texts)


def same(model: gc.Model, spec: dict, **changes) -> None:
    from gapcert_equations.model import EquationsModel

    other = build(spec, **changes)
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(4, model.nx)), rng.normal(size=(4, 6, model.nu))
    np.testing.assert_allclose(model.rollout(x, u).x, other.rollout(x, u).x, rtol=1e-14, atol=1e-16)
    again = EquationsModel(EquationsConfig.model_validate(model.to_spec()))
    assert again == model
    assert again.parameters == model.parameters


def test_force_effects():
    c = gc.Parameter("c", 0.3, "N*s/m", 0.1, 0.0, 5.0)
    k = gc.Parameter("k", 2.0, "N/m")
    model = build(MECHANICAL).extend([effect("q", c, force="-c*{v}"), effect("q", k, force="-k*{q} + 0*{v}*k*0")])
    assert "F - c*q_dot" in model.equations()
    assert [p.name for p in model.parameters] == ["mass", "c", "k"]
    assert model.parameters[1] == c
    expected = MECHANICAL["parameters"] | {"c": "0.3 N*s/m", "k": "2 N/m"}
    same(
        build(MECHANICAL).extend([effect("q", c, force="-c*{v}")]), MECHANICAL, parameters=expected, forces={"q": "F - c*q_dot"}
    )


def test_force_effects_at_a_state_equation():
    c, k = gc.Parameter("c", 0.3, "1/s"), gc.Parameter("k", 2.0, "1/s^2")
    model = build(PLAIN)
    assert model.sites("coordinate") == ("omega",)
    assert model.sites("input") == ("torque",)
    assert model.sites("output") == ("theta", "omega")
    extended = model.extend([effect("omega", c, force="-c*{v}"), effect("omega", k, force="-k*sin({q})")])
    texts = {"theta": "omega", "omega": "torque/J - c*omega - k*sin(theta)"}
    same(extended, PLAIN, parameters=PLAIN["parameters"] | {"c": "0.3 1/s", "k": "2 1/s^2"}, derivative=texts)


def test_dry_friction_input_output_and_delay():
    fc, gain = gc.Parameter("fc", 1.0, "N"), gc.Parameter("gain", 0.9)
    d, bias = gc.Parameter("d", 0.015, "s", low=0.0, high=0.05), gc.Parameter("bias", 0.2, "m")
    model = build(MECHANICAL).extend(
        [
            effect("q", fc, dry_friction="fc"),
            effect("F", gain, input="gain*{u}"),
            effect("F", d, delay="d"),
            effect("q", bias, output="{y} + bias"),
        ]
    )
    assert len(model.hidden) == 5
    names = {"fc": "1 N", "gain": 0.9, "d": {"value": "15 ms", "low": "0 s", "high": "50 ms"}, "bias": "0.2 m"}
    same(
        model,
        MECHANICAL,
        parameters=MECHANICAL["parameters"] | names,
        forces={"q": "gain*F"},
        dry_friction={"q": "fc"},
        input_delay={"F": "15 ms"},
    )
    assert [y.name for y in model.outputs] == ["q", "q_dot"]
    assert model.output(np.array([[1.0, 3.0]]), np.zeros((1, 1))).tolist() == [[1.2, 3.0]]


def sibling(base: gc.Model, spec: dict, **changes) -> gc.Model:
    from gapcert_equations.model import EquationsModel

    return EquationsModel.from_config(EquationsConfig.model_validate(spec | changes), gc.Context(model=base))


def test_what_another_model_has_recorded_gives_the_same_model():
    base = build(MECHANICAL)
    for changes in (
        {"parameters": {"mass": "3 kg"}},
        {"substeps": 3, "integrator": "rk4"},
        {"forces": {"q": "2*F"}},
        {"parameters": {"mass": "3000 g"}, "dry_friction": {"q": "0.1*F"}},
        {"parameters": {"mass": "2 kg", "late": {"value": "5 ms", "high": "12 ms"}}, "input_delay": {"F": "late"}},
        {"parameters": {"mass": "2 kg", "late": {"value": "5 ms", "high": "32 ms"}}, "input_delay": {"F": "late"}},
    ):
        model = sibling(base, MECHANICAL, **changes)
        assert model.definition.recorder is base.definition.recorder
        same(model, MECHANICAL, **changes)
        assert model.hidden == build(MECHANICAL, **changes).hidden


def test_texts_are_checked_anew_where_a_name_means_something_else():
    base = build(MECHANICAL, parameters={"mass": "2 kg", "k": "1 N/m"}, forces={"q": "F - k*q"})
    for changes in (
        {"parameters": {"mass": "2 kg", "k": "1 N"}},
        {"inputs": {"F": "N*m"}},
        {"coordinates": {"q": "rad"}},
        {"parameters": {"mass": "2 kg"}},
        {"mass_matrix": [["mass*q**2"]]},
    ):
        with pytest.raises(gc.UsageError, match=r"model\.forces\.q|model\.forces"):
            sibling(base, base.to_spec(), **changes)


def test_an_input_is_replaced_wherever_it_acts():
    gain = gc.Parameter("gain", 0.5)
    model = build(MECHANICAL, bias={"q": "abs(F)"}).extend([effect("F", gain, input="gain*{u}")])
    x, u = np.zeros((1, 2)), np.array([[4.0]])
    assert np.array_equal(model.step(x, u).x, build(MECHANICAL, bias={"q": "abs(F)"}).step(x, u / 2).x)


@pytest.mark.parametrize(
    ("extension", "words"),
    [
        (effect("p", force="-{v}"), "no such site; there are q"),
        (effect("q", gc.Parameter("mass", 1.0), force="-mass*{v}"), "'mass' is already a name"),
        (effect("q", force="-{w}"), "no {w}"),
        (effect("q", gc.Parameter("c", 1.0, "N"), force="-c*{v}"), r"found .*; expected N"),
        (effect("G", input="2*{u}"), "no such site"),
        (effect("z", output="2*{y}"), "no such site"),
    ],
)
def test_effects_that_do_not_fit(extension, words):
    with pytest.raises(gc.UsageError, match=words):
        build(MECHANICAL).extend([extension])
    with pytest.raises(gc.UsageError, match="unknown kind"):
        build(MECHANICAL).sites("engine")


def test_outputs_show_what_reaches_the_plant_and_logs_what_was_commanded():
    top, tau, late = gc.Parameter("top", 1.0, "N*m"), gc.Parameter("tau", 0.1, "s"), gc.Parameter("late", 0.015, "s", high=0.05)
    spec = PLAIN | {"outputs": {"alpha": "torque/J", "asked": "-2*torque"}}
    x, u = np.zeros((1, 2)), np.array([[4.0]])
    cut = build(spec).extend([effect("torque", top, input="min({u}, top)")])
    assert cut.to_spec()["outputs"] == {"alpha": "(min(torque, top))/J", "asked": "-2*torque"}
    assert cut.output(x, u).tolist() == [[0.5, -8.0]]
    z = gc.plugin.Memory("slow", "N*m", "slow + {h}/tau*({u} - slow)")
    lag = build(spec).extend([effect("torque", tau, input="slow + {h}/tau*({u} - slow)/2", memory=(z,))])
    same(lag, lag.to_spec())
    # At the instant of a sample nothing of the coming sub-step has arrived.
    np.testing.assert_allclose(lag.output(x, u, None, np.array([[3.0]])), [[1.5, -8.0]], rtol=1e-6)
    assert build(spec).extend([effect("torque", late, delay="late")]).input_delays().tolist() == [0.0]
    del spec["outputs"]["asked"]
    assert build(spec).extend([effect("torque", late, delay="late")]).input_delays().tolist() == [0.015]
