"""Names, grammar and units: every problem of a section at once, each with its key and its column."""

import re
import time

import pytest

import gapcert as gc
from gapcert_equations.config import EquationsConfig
from gapcert_equations.text.grammar import ExpressionError, parse, substitute
from gapcert_equations.text.units import unit

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
    "coordinates": {"a": "rad", "q": "m"},
    "inputs": {"u": "N*m", "F": "N"},
    "parameters": {"J": "1 kg*m^2", "m": "1 kg", "c": "1 N*s/m"},
    "mass_matrix": [["J", "0"], ["0", "m"]],
    "forces": {"a": "u", "q": "F"},
    "integrator": "euler",
    "period": "5 ms",
}


def problems(spec: dict, **changes) -> list:
    return EquationsConfig.model_validate(spec | changes).check()


def test_right_models_have_no_problems():
    assert problems(PENDULUM) == []
    assert problems(MECHANICAL) == []


@pytest.mark.parametrize("written", [1, 1.0, {"unit": 1}])
def test_a_bare_one_is_no_unit(written):
    from gapcert_equations.model import EquationsModel

    spec = {"kind": "equations", "states": {"b": written}, "inputs": {"u": written}, "next": {"b": "b + u"}, "period": "1 s"}
    config = EquationsConfig.model_validate(spec)
    assert config.check() == []
    assert EquationsModel(config).states[0].unit == "1"
    for other in (2, 0, True, {"unit": 2}):
        with pytest.raises(ValueError, match=r"found [20]; expected a unit|valid string"):
            EquationsConfig.model_validate(spec | {"states": {"b": other}})


def test_a_bare_one_passes_for_a_unit_in_a_spec():
    model = {"kind": "equations", "states": {"b": 1}, "inputs": {"u": {"unit": 1.0}}, "next": {"b": "b + u"}, "period": "1 s"}
    spec = {"version": 1, "name": "bare", "model": model, "backend": model, "domain": {"b": ["-1", "1"], "u": [-1, 1]}}
    assert gc.load_spec(spec).config.domain == {"b": (-1.0, 1.0), "u": (-1.0, 1.0)}
    with pytest.raises(gc.SpecError, match=r"model\.states\.b: found 2; expected a unit such as m/s, or 1 for none"):
        gc.load_spec(spec, ["model.states.b=2"])


@pytest.mark.parametrize(
    ("text", "offset", "words"),
    [
        ("__import__('os')", 11, "not allowed"),
        ("().__class__", 0, "attribute"),
        ("omega.real", 0, "attribute"),
        ("9**9**9**9", 6, "exponent"),
        ("2**1e308", 3, "exponent"),
        ("((9**64)**64)**64 * omega", 1, "not finite"),
        ("1e999", 0, "not finite"),
        ("(-1)**0.5", 0, "not finite and real"),
        ("log(-1)", 0, "not finite"),
        ("omega/(2 - 2)", 7, "division by zero"),
        ("lambda: 1", 6, "':' is not allowed"),
        ("lambda", 0, "cannot read"),
        ("[1, 2]", 0, "'\\['"),
        ("1, 2", 0, "a list"),
        ("omega if g else l", 0, "not allowed"),
        ("omega and g", 0, "not allowed"),
        ("a := 3", 2, "':'"),
        ("omega^2", 5, "write \\*\\* for powers"),
        ("omega // 2", 9, "operator"),
        ("3 omega", 2, "cannot read|perhaps"),
        ("omega +", 0, "cannot read"),
        ("(omega", 0, "never closed"),
        ("omega = 3", 6, "right-hand side"),
        ("", 0, "empty"),
        ("sin", 0, "is a function"),
        ("sin(omega, g)", 0, "one argument"),
        ("sin(x=1)", 5, "right-hand side"),
        ("sinn(theta)", 0, "did you mean 'sin'"),
        ("min(omega)", 0, "2 to 8"),
        ("eval(omega)", 0, "unknown function"),
        ("min(*omega)", 0, "cannot read|plain arguments"),
        ("omega + 1 # rest", 10, "'#'"),
        ("theta\x00", 5, "not allowed"),
        ("omega*True", 6, "not allowed"),
        ("0x_", 0, "cannot read"),
        ("1j*omega", 0, "not allowed"),
    ],
)
def test_hostile_and_mistaken_expressions(text, offset, words):
    with pytest.raises(ExpressionError, match=words) as caught:
        parse(text)
    if "cannot read" not in words:
        assert caught.value.offset == offset


@pytest.mark.parametrize(
    "text",
    [
        "(" * 5000 + "x" + ")" * 5000,
        "-" * 3990 + "x",
        "x**" * 900 + "1",
        "+".join("x" * 1900),
        "sin(" * 90 * 10,
    ],
)
def test_deep_and_long_texts_end_quickly_in_one_sentence(text):
    start = time.process_time()
    with pytest.raises(ExpressionError, match=r"^[^\n]+$"):
        parse(text)
    assert time.process_time() - start < 1


@pytest.mark.parametrize(
    "text",
    [
        "(1 + 1/9**40)**64*(1 + 1/9**40)**64*omega",
        "(((omega*T + 1)**64)**64)**64/T",
        "max(max(max(omega, -omega), omega), max(omega, -omega))",
        "sin(1e300*theta)/T",
    ],
)
def test_large_powers_and_nested_extrema_are_built_quickly(text):
    from gapcert_equations.model import EquationsModel

    start = time.process_time()
    spec = PENDULUM | {
        "parameters": PENDULUM["parameters"] | {"T": "1 s"},
        "derivative": PENDULUM["derivative"] | {"theta": text},
    }
    EquationsModel(EquationsConfig.model_validate(spec))
    assert time.process_time() - start < 3


@pytest.mark.parametrize(
    ("changes", "path", "words", "offset"),
    [
        ({"derivative": {"theta": "omga", "omega": "omega*g/l*m"}}, ("derivative", "theta"), "did you mean 'omega'", 0),
        (
            {"derivative": {"theta": "omega", "omega": "torque/(m*l**2) - omega"}},
            ("derivative", "omega"),
            r"expected 1/s\^2",
            18,
        ),
        ({"derivative": {"theta": "omega", "omega": "torque"}}, ("derivative", "omega"), r"found N\*m; expected 1/s\^2", 0),
        ({"derivative": {"theta": "omega + torque", "omega": "0"}}, ("derivative", "theta"), r"found N\*m; expected rad/s", 8),
        ({"derivative": {"theta": "omega", "omega": "g/l*sin(omega)"}}, ("derivative", "omega"), "sin takes a pure number", 8),
        ({"derivative": {"theta": "omega", "omega": "g/l*(m + 1)/m"}}, ("derivative", "omega"), "like the term before it", 9),
        ({"derivative": {"theta": "omega", "omega": "g/l*2**m"}}, ("derivative", "omega"), "exponents are numbers", 7),
        ({"derivative": {"theta": "omega", "omega": "g**theta"}}, ("derivative", "omega"), "constant exponent", 3),
        ({"derivative": {"theta": "omega"}}, ("derivative",), "no equation for state 'omega'", None),
        ({"derivative": PENDULUM["derivative"] | {"thet": "omega"}}, ("derivative", "thet"), "did you mean 'theta'", None),
        ({"states": {"theta": "deg", "omega": "rad/s"}}, ("states", "theta"), "not an SI base or derived unit; use rad", None),
        ({"states": {"theta": {"unit": "mm"}, "omega": "rad/s"}}, ("states", "theta", "unit"), "use m", None),
        ({"states": {"theta": "foo", "omega": "rad/s"}}, ("states", "theta"), "unknown unit 'foo'", None),
        ({"inputs": {"torque": "degC"}}, ("inputs", "torque"), "offset", None),
        ({"inputs": {"torque": "N*m", "m": "1"}}, ("parameters", "m"), "already among the inputs", None),
        ({"inputs": {"lambda": "1", "torque": "N*m"}}, ("inputs", "lambda"), "reserved", None),
        ({"inputs": {"a-b": "1", "torque": "N*m"}}, ("inputs", "a-b"), "cannot be used as a name", None),
        ({"parameters": {"m": "1 kg", "l": "1 m", "g": "9.81 m/s^2", "sin": 1}}, ("parameters", "sin"), "reserved", None),
        (
            {"parameters": {"m": "one kg", "l": "1 m", "g": "9.81 m/s^2"}},
            ("parameters", "m"),
            "expected a number with a unit",
            None,
        ),
        ({"parameters": {"m": ".nan kg", "l": "1 m", "g": 1}}, ("parameters", "m"), "expected a number", None),
        ({"parameters": {"m": float("nan"), "l": "1 m", "g": 1}}, ("parameters", "m"), "finite", None),
        (
            {"parameters": {"m": {"value": "1 kg", "tolerance": "1 m"}, "l": 1, "g": 1}},
            ("parameters", "m", "tolerance"),
            "expected kg",
            None,
        ),
        ({"period": "5 kg"}, ("period",), "positive time", None),
        ({"period": "-5 ms"}, ("period",), "positive time", None),
        ({"period": 0}, ("period",), "positive time", None),
        ({"input_delay": {"torqu": "1 ms"}}, ("input_delay", "torqu"), "did you mean 'torque'", None),
        ({"input_delay": {"torque": "1 m"}}, ("input_delay", "torque"), "cannot read", None),
        ({"input_delay": {"torque": "l"}}, ("input_delay", "torque"), "expected s", 0),
        ({"input_delay": {"torque": "-1 ms"}}, ("input_delay", "torque"), "at least 0", 0),
        ({"dry_friction": {"theta": "1"}}, ("dry_friction", "theta"), "there are omega", None),
        ({"dry_friction": {"omega": "1"}}, ("dry_friction", "omega"), "found 1", 0),
        ({"outputs": {"y": {"expr": "theta", "unit": "m"}}}, ("outputs", "y", "expr"), "expected m", 0),
        ({"outputs": {"y": "thet"}}, ("outputs", "y"), "did you mean 'theta'", 0),
        ({"outputs": {"y": {"expr": "theta", "unit": "deg"}}}, ("outputs", "y", "unit"), "use rad", None),
    ],
)
def test_each_problem_has_its_key_and_column(changes, path, words, offset):
    from gapcert_equations.model import EquationsModel

    found = problems(PENDULUM, **changes)
    at = [p for p in found if p[0] == path]
    assert at, found
    assert re.search(words, at[0][1]), at
    assert offset is None or at[0][2] == offset
    with pytest.raises(gc.UsageError, match=words):
        EquationsModel(EquationsConfig.model_validate(PENDULUM | changes))


@pytest.mark.parametrize(
    ("changes", "path", "words"),
    [
        ({"forces": {"a": "F"}}, ("forces", "a"), r"found N; expected N\*m"),
        ({"bias": {"q": "c*a_dot"}}, ("bias", "q"), "expected N"),
        ({"mass_matrix": [["J", "m"], ["0", "m"]]}, ("mass_matrix", 0, 1), "to fit mass_matrix"),
        ({"mass_matrix": [["J", "0"]]}, ("mass_matrix",), "expected 2 x 2"),
        ({"mass_matrix": [["0", "0"], ["0", "m"]]}, ("mass_matrix", 0, 0), "is 0"),
        ({"forces": {"b": "F"}}, ("forces", "b"), "does not belong here"),
        ({"inputs": {"a_dot": "N", "u": "N*m", "F": "N"}}, ("inputs", "a_dot"), "among the velocities"),
        ({"dry_friction": {"q": "u"}}, ("dry_friction", "q"), "expected N"),
    ],
)
def test_problems_of_mechanical_models(changes, path, words):
    assert any(p == path and re.search(words, text) for p, text, _ in problems(MECHANICAL, **changes))


def test_all_problems_come_at_once():
    bad = {"theta": "omga", "omega": "torque + )"}
    assert [p for p, _, _ in problems(PENDULUM, derivative=bad, outputs={"y": "q"})] == [
        ("derivative", "theta"),
        ("derivative", "omega"),
        ("outputs", "y"),
    ]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"next": {"theta": "theta"}}, "derivative and next; give exactly one"),
        ({"derivative": None}, "found none; give exactly one"),
        ({"coordinates": {"q": "m"}}, "belong to mass_matrix"),
        ({"derivative": None, "mass_matrix": [["1"]]}, "needs coordinates"),
        ({"derivative": None, "next": {"theta": "theta", "omega": "omega"}}, "do not apply"),
        ({"substeps": 0}, "greater than or equal to 1"),
        ({"integrator": "rk5"}, "'euler', 'semi_implicit' or 'rk4'"),
        ({"tau": 1}, "Extra inputs"),
        ({"parameters": {"m": True}}, "expected a number or a quantity"),
    ],
)
def test_the_shape_of_the_section(changes, words):
    with pytest.raises(ValueError, match=words):
        EquationsConfig.model_validate(PENDULUM | changes)


@pytest.mark.parametrize(
    "text", ["m**9**9**9", "99**99*m", "m**(99**99)", "m**999999999", "m" * 100, "__import__('os')", "m;kg"]
)
def test_hostile_units_are_unknown_at_once(text):
    start = time.process_time()
    with pytest.raises(ValueError, match="unknown unit"):
        unit(text)
    assert time.process_time() - start < 1


def test_unicode_names_and_columns():
    spec = PENDULUM | {
        "states": {"θ": "rad", "ω": "rad/s"},
        "derivative": {"θ": "ω", "ω": "-g/l*sin(θ) + torque"},
    }
    assert problems(spec)[0][2] == len("-g/l*sin(θ) + ")
    assert parse("ω +\n θ").right.col_offset == 5


def test_substitution_is_of_names_only():
    assert substitute("u + uu*sin(u)/u2", {"u": "a - b"}) == "(a - b) + uu*sin((a - b))/u2"


@pytest.mark.parametrize(
    ("wrong", "at", "said"),
    [
        ({"g": "9.81 m/s"}, ("parameters", "g"), "found m/s; with m/s^2 the units of derivative.omega would agree"),
        ({"m": "1 N"}, ("parameters", "m"), "found N; with kg the units of derivative.omega would agree"),  # a divisor
        ({"g": 9.81}, ("parameters", "g"), "found no unit; with m/s^2 the units of derivative.omega would agree"),
        ({"g": {"value": "9.81 m/s"}}, ("parameters", "g", "value"), "found m/s; with m/s^2 the units of derivative.omega"),
    ],
)
def test_the_parameter_with_which_all_units_would_agree_is_named_beside_the_equation(wrong, at, said):
    equation, parameter = problems(PENDULUM, parameters=PENDULUM["parameters"] | wrong)
    assert equation[0] == ("derivative", "omega")
    assert parameter[0] == at
    assert parameter[1].startswith(said)


def test_a_parameter_whose_square_is_wrong_is_named():
    c = {"parameters": MECHANICAL["parameters"] | {"c": "1 N", "w": "1 1/m^2"}, "bias": {"q": "m*w**2*q"}}
    assert [p[0] for p in problems(MECHANICAL, **c)] == [("bias", "q"), ("parameters", "w")]
    assert problems(MECHANICAL, **c)[1][1] == "found 1/m^2; with rad/s the units of bias.q would agree"


def test_none_is_named_where_several_parameters_or_none_would_do():
    two = problems(MECHANICAL, parameters=MECHANICAL["parameters"] | {"r": "2 m"}, bias={"q": "c*r*q_dot"})
    assert [p[0] for p in two] == [("bias", "q")]
    none = problems(MECHANICAL, forces={"a": "u + F", "q": "F"})
    assert [p[0] for p in none] == [("forces", "a")]


def test_both_lines_of_a_spec_are_shown(tmp_path):
    path = tmp_path / "spec.yaml"
    path.write_text(
        "version: 1\nname: line\nmodel:\n  kind: equations\n  states: {v: m/s}\n  parameters:\n    k: 2 N\n"
        "  derivative:\n    v: -k*v\n  period: 1 s\nbackend: {kind: pybullet}\n"
    )
    with pytest.raises(gc.SpecError) as refused:
        gc.load_spec(path)
    said = str(refused.value)
    assert f"{path}:7:8: error: model.parameters.k: found N; with 1/s the units of derivative.v would agree" in said
    assert f"{path}:9:8: error: model.derivative.v: found " in said
