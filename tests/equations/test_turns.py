"""Does a text repeat with every turn of an angle? A proof is never wrong, and common texts have one."""

import numpy as np
import pytest

import gapcert as gc
from gapcert.plugin import difference

STATES = {"p": {"unit": "rad", "kind": "angle"}, "q": {"unit": "rad", "kind": "angle"}, "v": "1"}


def model(**given: str) -> gc.Model:
    section = {"kind": "equations", "states": STATES, "inputs": {"u": "1"}, "period": "0.1 s"}
    section["next"] = {"p": "p", "q": "q", "v": "v"} | given
    return gc.load_spec({"version": 1, "name": "turns", "model": section}).build("model")


def rates(integrator: str = "rk4", **given: str) -> gc.Model:
    section = {"kind": "equations", "inputs": {"u": "1/s^2"}, "period": "50 ms", "integrator": integrator, "substeps": 3}
    section |= {"parameters": {"k": "9 1/s^2"}}
    section |= {"states": {"p": STATES["p"], "w": "rad/s"}, "derivative": {"p": "w", "w": "u"} | given}
    return gc.load_spec({"version": 1, "name": "turns", "model": section}).build("model")


def change(m: gc.Model, turns: int = 1, n: int = 2000) -> float:
    """The largest change of a step with a turn of p."""
    rng = np.random.default_rng(5)
    x, u = rng.uniform(-3, 3, (n, m.nx)), rng.uniform(-1, 1, (n, 1))
    far = x + 2 * np.pi * turns * np.eye(m.nx)[0]
    return float(np.abs(difference(m.states, m.step(far, u).x, m.step(x, u).x)).max())


@pytest.mark.parametrize(
    "text",
    [
        "v + 0.1*sin(3*p)",
        "sin(p/2)**2",
        "cos(p/2)*sin(p/2)",
        "abs(cos(p/2))",
        "tanh(sin(p/2))*sin(3*p/2)",
        "max(0, sin(p - q))/(2 + cos(p))",
        "exp(cos(p))*(2 + sin(p))**1.5",
        "sin(p + v)*v + u",
        "cos(p - 2*pi*round(p/(2*pi)))",
        "(p + 1)*0 + min(sin(p), cos(p))",
    ],
)
def test_what_is_proved(text: str) -> None:
    m = model(v=text)
    assert m.repeats("p") == ""
    assert change(m) < 1e-12
    assert change(m, -7) < 1e-11


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"p": "0.97*p + 0.2*u"}, "a turn of p moves p by 0.97 turns"),
        ({"q": "q + p/2"}, "a turn of p moves q by 0.5 turns"),
        ({"v": "v - 0.1*p"}, "a turn of p moves v by -0.628319 1"),
        ({"v": "sin(p/2)"}, "v does not come round with p: it changes its sign"),
        ({"v": "(1 + sin(p/2))**2"}, "only a part of a sum changes its sign"),
        ({"v": "exp(-((p - 1)/0.01)**2)"}, "a product takes it as a number"),
        ({"v": "1/(9 + p)"}, "a quotient takes it as a number"),
        ({"v": "sin(1.001*p)"}, "sin of 1.001 times it does not come round"),
        ({"v": "p - 2*pi*round(p/(2*pi))"}, "v rounds p as a number"),
        ({"v": "tanh(p)"}, "tanh of 1 times it does not come round"),
    ],
)
def test_what_is_refused_changes(given: dict[str, str], why: str) -> None:
    m = model(**given)
    assert why in (m.repeats("p") or "")
    assert change(m) > 1e-3 or "exp" in str(given) or "round" in str(given), "a spike or a jump that no sample meets is there"


def test_whole_turns_of_angles_are_none() -> None:
    for text in ("p + 0.1*u", "2*p + v", "u - p", "p + q - 2*pi*round((p + 0.1*u)/(2*pi))"):
        m = model(p=text)
        assert m.repeats("p") == ""
        assert change(m) < 1e-12


@pytest.mark.parametrize("integrator", ["euler", "semi_implicit", "rk4"])
def test_through_integrators_and_substeps(integrator: str) -> None:
    swings, springs = (rates(integrator, w=f"{text} + u") for text in ("-k*sin(p)", "-k*p"))
    assert swings.repeats("p") == ""
    assert change(swings) < 1e-12
    assert "a turn of p moves" in springs.repeats("p")


def test_through_a_mass_matrix_friction_and_late_inputs() -> None:
    section = {
        "kind": "equations",
        "coordinates": {"p": STATES["p"], "s": "m"},
        "inputs": {"F": "N"},
        "parameters": {"m": "1 kg", "l": "1 m", "c": "0.1 N", "g": "9.81 m/s^2"},
        "mass_matrix": [["m*l**2", "m*l*cos(p)"], ["m*l*cos(p)", "3*m"]],
        "bias": {"p": "m*g*l*sin(p)", "s": "-m*l*sin(p)*p_dot**2"},
        "forces": {"s": "F"},
        "period": "10 ms",
    }
    m = gc.load_spec({"version": 1, "name": "cart", "model": section}).build("model")
    assert m.repeats("p") == ""
    assert change(m) < 1e-9
    bent = section | {"bias": section["bias"] | {"p": "m*g*l*p"}}
    assert gc.load_spec({"version": 1, "name": "cart", "model": bent}).build("model").repeats("p")


NAMES = ("p", "p", "q", "v", "u", "0.5", "2", "3")
UNARY = ("sin({})", "cos({})", "abs({})", "tanh({})", "-({})", "({})**2", "({})/2", "2*({})", "atan({})", "round({})")
BINARY = ("({}) + ({})", "({}) - ({})", "({})*({})", "min({}, {})", "max({}, {})", "({})/(3 + ({})**2)")


def drawn(rng: np.random.Generator, depth: int) -> str:
    if depth == 0 or rng.random() < 0.15:
        return str(rng.choice(NAMES))
    if rng.random() < 0.55:
        return str(rng.choice(UNARY)).format(drawn(rng, depth - 1))
    return str(rng.choice(BINARY)).format(drawn(rng, depth - 1), drawn(rng, depth - 1))


def test_no_proof_of_a_drawn_text_is_wrong() -> None:
    """Texts of random trees: of those with a proof none changes, and of those without most do."""
    rng, proved, lost = np.random.default_rng(11), 0, 0
    for _ in range(400):
        place = str(rng.choice(["p", "v"]))
        m = model(**{place: drawn(rng, 4)})
        changes = change(m, int(rng.integers(1, 4)), 300)
        if m.repeats("p") == "":
            proved += 1
            assert changes < 1e-9, m.equations()
        else:
            lost += changes < 1e-9
    assert proved > 120
    assert lost < 60
