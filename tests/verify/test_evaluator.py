"""Verify's own bounds of equation text: they hold every step of the model, and are hardly wider than the model's own."""

import numpy as np
import pytest
from rounded_models import equations_model

from gapcert import Interval, UsageError
from gapcert_equations.config import EquationsConfig
from gapcert_equations.text import grammar
from gapcert_verify import arithmetic, evaluator
from gapcert_verify.evaluator import Equations, NotText, quantity

UNARY = ("sin", "cos", "tan", "exp", "abs", "tanh", "atan", "sign", "round")
MODELS = {
    "euler": {
        "states": {"p": {"unit": "rad", "kind": "angle"}, "w": "rad/s"},
        "inputs": {"u": "1/s^2"},
        "integrator": "euler",
        "parameters": {"a": "3.1 1/s^2", "b": "20 deg"},
        "derivative": {"p": "w", "w": "u - a*sin(p + b)"},
        "period": "30 ms",
    },
    "semi": {
        "states": {"p": "m", "w": "m/s"},
        "inputs": {"u": "m/s^2"},
        "integrator": "semi_implicit",
        "substeps": 3,
        "parameters": {"f": "0.4 m/s^2", "k": "9 1/s^2"},
        "derivative": {"p": "w", "w": "u - k*p"},
        "dry_friction": {"w": "f"},
        "period": "0.1 s",
    },
    "rk4": {
        "states": {"x": "m", "y": "m", "h": "rad"},
        "inputs": {"v": "m/s", "s": "rad"},
        "parameters": {"l": "80 cm"},
        "substeps": 4,
        "derivative": {"x": "v*cos(h + atan(tan(s)/2))", "y": "v*sin(h + atan(tan(s)/2))", "h": "v*tan(s)/l"},
        "period": "0.3 s",
    },
    "mechanics": {
        "coordinates": {"x": "m", "q": {"unit": "rad", "kind": "angle"}},
        "inputs": {"F": "N"},
        "integrator": "semi_implicit",
        "parameters": {"M": "1.5 kg", "m": "200 g", "l": "0.4 m", "g": "9.81 m/s^2", "d": "0.3 N*s/m"},
        "substeps": 2,
        "mass_matrix": [["M + m", "m*l*cos(q)"], ["m*l*cos(q)", "4/3*m*l**2"]],
        "forces": {"x": "F"},
        "implicit": {"x": "d"},
        "bias": {"x": "-m*l*sin(q)*q_dot**2", "q": "-m*g*l*sin(q)"},
        "period": "0.05 s",
    },
}


def drawn(rng, depth=3):
    """A random expression of x, y and u, defined and finite for all of them."""
    if depth == 0 or rng.random() < 0.15:
        return str(rng.choice(["x", "y", "u", f"{rng.uniform(-3, 3):.3g}", "pi"]))
    kind = rng.integers(9)
    a, b = drawn(rng, depth - 1), drawn(rng, depth - 1)
    if kind < 3:
        return f"({a} {'+-*'[kind]} {b})"
    return [
        f"({a})/(1.5 + cos({b}))",
        f"{rng.choice(UNARY)}({a})",
        f"({a})**{rng.integers(2, 5)}",
        f"min({a}, {b})",
        f"max({a}, {b}, 0.3)",
        f"sqrt(1 + ({a})**2) + log(2 + ({b})**2) + asin(tanh({a})/2) + acos(sin({b})/2)",
    ][kind - 3]


def reached(model, q, rng, reach, n=1500, size=2.0):
    """How many points leave the bounds of boxes around them, and by which factor these are wider than the model's own."""
    centre, nz = rng.uniform(-size, size, (n, model.nx + model.nu)), model.nx + model.nu
    half = rng.uniform(0, reach, (n, nz)) * (rng.random((n, nz)) < 0.8)
    low, high = centre - half, centre + half
    bounds, own, left = [q.over(low, high, t) for t in q.terms], model.enclosure(Interval(low, high)), 0
    for _ in range(12):
        share = np.where(rng.random((n, nz)) < 0.4, rng.integers(0, 2, (n, nz)), rng.random((n, nz)))
        z = np.clip(low + share * (high - low), low, high)
        after = model.step(z[:, : model.nx], z[:, model.nx :]).x
        for k, b in enumerate(bounds):
            left += int(((after[:, k] < b.lo) | (after[:, k] > b.hi)).sum())
    wide = [(b.hi - b.lo + 1e-12) / (own.hi[:, k] - own.lo[:, k] + 1e-12) for k, b in enumerate(bounds)]
    return left, float(np.nanmedian(np.concatenate(wide)))


def test_it_knows_the_functions_of_the_grammar():
    assert {*evaluator.FUNCTIONS, "min", "max"} == set(grammar.FUNCTIONS)


@pytest.mark.parametrize("name", MODELS)
def test_steps_of_models_stay_inside(name):
    section = {"kind": "equations", **MODELS[name]}
    model, q = equations_model(EquationsConfig.model_validate(section)), Equations.of(section)
    assert q.states == tuple(s.name for s in model.states)
    left, wide = reached(model, q, np.random.default_rng(len(name)), 0.2, size=1.0)
    assert left == 0
    assert wide < 1.05


def written(text):
    section = {
        "kind": "equations",
        "states": {"x": "1", "y": "1"},
        "inputs": {"u": "1"},
        "next": {"x": text, "y": "y"},
        "period": "1 s",
    }
    try:
        return equations_model(EquationsConfig.model_validate(section)), Equations.of(section)
    except UsageError:  # it simplifies to what is no number
        return None


def test_random_expressions_stay_inside():
    rng, seen = np.random.default_rng(11), 0
    while seen < 25:
        if (pair := written(drawn(rng))) is not None:
            with np.errstate(all="ignore"):
                assert reached(*pair, rng, 0.4, n=300)[0] == 0
            seen += 1


@pytest.mark.exam
def test_many_random_expressions_stay_inside():
    rng, seen = np.random.default_rng(12), 0
    while seen < 600:
        if (pair := written(drawn(rng, depth=int(rng.integers(1, 6))))) is not None:
            with np.errstate(all="ignore"):
                assert reached(*pair, rng, float(rng.choice([1e-6, 1e-2, 0.5, 5.0])), n=400)[0] == 0
            seen += 1


FAULTS = {
    "no rounding outwards": ("x + 0.1*y + 0.7", {"up": lambda v: v}, {}),
    "a crest that is missed": (
        "sin(2*x) + 0.1*y",
        {"_meets": lambda a, period, shift: np.zeros(np.shape(a.lo), dtype=bool)},
        {},
    ),
    "the kink of a modulus": ("abs(x) - 0.3*y", {}, {"abs": (arithmetic.absolute, lambda x, y: arithmetic.point(1.0))}),
    "a maximum that takes the smaller": ("max(x, y)", {}, {"max": arithmetic.least}),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_noticed(name, monkeypatch):
    text, functions, entries = FAULTS[name]
    model, q = written(text)
    assert reached(model, q, np.random.default_rng(2), 0.5)[0] == 0
    for function, fault in functions.items():
        monkeypatch.setattr(arithmetic, function, fault)
    for key, fault in entries.items():
        monkeypatch.setitem(evaluator.FUNCTIONS if key in evaluator.FUNCTIONS else evaluator._BINARY, key, fault)
    assert reached(model, q, np.random.default_rng(2), 0.5)[0] > 0


def test_what_is_undefined_bounds_nothing():
    q = written("sqrt(x) + 0*y")[1]
    found = q.over(np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]]), np.array([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0]]), q.terms[0])
    assert found.hi[0] == np.inf
    assert found.hi[1] == pytest.approx(0.2**0.5)


def test_a_state_that_nothing_moves_stays_exactly():
    q = written("x + 0.3*u")[1]
    one = np.array([[0.7, 0.1, 0.0]])
    assert q.moves(0) is not None
    assert arithmetic.zero(q.over(one, one, q.moves(0))).all()


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("9.81 m/s^2", 9.81),
        ("20 deg", np.deg2rad(20)),
        ("5 ms", 5e-3),
        ("3", 3.0),
        (2, 2.0),
        ("80 g", 0.08),
        ("3 1/s^2", 3.0),
        ("2 N*m/(rad*s)", 2.0),
    ],
)
def test_quantities_are_in_si_units(text, value):
    low, high = quantity(text)
    assert low <= value <= high
    assert high - low <= 1e-15 * abs(value)


@pytest.mark.parametrize("text", ["1 rumpelstilz", "m", "1 m**9**9**9", "2 (9**9)*m", "nan", "1 __import__('os')"])
def test_what_is_no_quantity_is_refused(text):
    with pytest.raises(ValueError, match="is n"):
        quantity(text)


@pytest.mark.parametrize(
    "text", ["x.real", "open(x)", "x if y else u", "[x]", "lambda: x", "'x'", "x @ y", "sin(x, y)", "z + 1"]
)
def test_what_is_no_expression_is_refused(text):
    with pytest.raises((ValueError, KeyError)):
        Equations.of(
            {
                "kind": "equations",
                "states": {"x": "1", "y": "1"},
                "inputs": {"u": "1"},
                "next": {"x": text, "y": "y"},
                "period": 1,
            }
        )


def test_what_is_not_written_out_is_named():
    with pytest.raises(NotText, match="kind fmu"):
        Equations.of({"kind": "fmu"})
    with pytest.raises(NotText, match="memory"):
        Equations.of({"kind": "equations", "states": {"x": "1"}, "next": {"x": "x"}, "memory": {"m": {"next": "m"}}})
    with pytest.raises(NotText, match="dry friction"):
        Equations.of({**MODELS["semi"], "kind": "equations", "integrator": "rk4"})
