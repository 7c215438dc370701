"""Second derivatives over boxes: against those of SymPy, against differences of slopes, and with flaws planted."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

import gapcert as gc
from gapcert.certification.gates.augment import AugmentedModel, Resting
from gapcert.numerics import intervals
from gapcert_equations.config import EquationsConfig
from gapcert_equations.programs import jets

SMOOTH = {
    "sin": "sin(2*x*x + y*y)",
    "cos": "cos(x*x - y*y*y)",
    "tan": "tan(x/2 + y/3)",
    "exp": "exp(y - x**2)",
    "log": "log(2 + x*y)",
    "sqrt": "sqrt(2 + x + y)",
    "tanh": "tanh(3*x*y)",
    "atan": "atan(2*x - y)",
    "asin": "asin(x*y/2)",
    "acos": "acos(x/2 + y/4)",
    "pow": "(x - y)**5 + x**2*y",
    "inverse": "(2 + x)**(-2)",
    "power": "(2 + x)**1.3",
    "exponent": "(2 + y)**(x + 1)",
    "both": "(2 + x)**(x + y)",
    "quotient": "(y + x**2)/(2 + x*y)",
    "reciprocal": "1/(3 + sin(x)) - y/(2 + x)",
    "abs": "abs(x + 5)*x**2",
    "min": "min(x**3, x + 5) + max(x*x*y, y - 8)",
}


def of(text):
    from gapcert_equations.model import EquationsModel

    spec = {"kind": "equations", "states": {"x": "1"}, "inputs": {"y": "1"}, "next": {"x": text}, "period": "1 s"}
    return EquationsModel(EquationsConfig.model_validate(spec))


def second(text, axis, z):
    """∂² of a text at z (n, 2) by SymPy."""
    import sympy

    from gapcert_equations.text.sympy_text import expression

    plain = text.replace("max(x*x*y, y - 8)", "x*x*y").replace("min(x**3, x + 5)", "x**3").replace("abs(x + 5)", "(x + 5)")
    names = sympy.symbols("x y", real=True)
    return (
        sympy.lambdify(
            names, sympy.diff(expression(plain).replace(sympy.Function("tanh", real=True), sympy.tanh), names[axis], 2), "numpy"
        )(*z.T)
        + 0 * z[:, 0]
    )


def check(text):
    """At points the enclosure is the derivative itself, and over boxes it contains that of every point."""
    model, rng = of(text), np.random.default_rng(5)
    z = rng.uniform(-0.9, 0.9, (200, 2))
    for axis in (0, 1):
        true = second(text, axis, z)
        at = model.curvature_enclosure(gc.Interval.exact(z), axis)
        np.testing.assert_allclose(at.mid[:, 0], true, rtol=1e-11, atol=1e-12)
        assert (at.width[:, 0] <= 1e-11 * (1 + np.abs(true))).all()
        size = rng.uniform(0, 0.3, z.shape)
        over = model.curvature_enclosure(gc.Interval(z - rng.random(z.shape) * size, z + size), axis)
        slack = 1e-12 * (1 + np.abs(true))
        assert ((over.lo[:, 0] <= true + slack) & (true - slack <= over.hi[:, 0])).all()


@pytest.mark.parametrize("text", SMOOTH.values(), ids=SMOOTH)
def test_every_rule_against_sympy(text):
    check(text)


@pytest.mark.parametrize("name", sorted(jets._BENDS))
@pytest.mark.parametrize("order", [0, 1])
def test_a_wrong_rule_is_noticed(name, order, monkeypatch):
    rules = (jets._SLOPES, jets._BENDS)[order]
    right = rules[name]
    monkeypatch.setitem(rules, name, lambda *given: right(*given) * 0.999)
    with pytest.raises(AssertionError):
        check(SMOOTH[name])


@pytest.mark.parametrize(("rule", "text"), [("__mul__", "sin(x)*exp(x + y)*exp(y)"), ("__truediv__", SMOOTH["quotient"])])
def test_a_product_rule_without_its_middle_term_is_noticed(rule, text, monkeypatch):
    right = getattr(jets.Jet, rule)

    def flawed(self, other):
        if not isinstance(other, jets.Jet):
            return right(self, other)
        flat = right(jets.Jet(self.value, None, self.bend), jets.Jet(other.value, None, other.bend))
        return jets.Jet(flat.value, right(self, other).slope, flat.bend)

    check(text)
    monkeypatch.setattr(jets.Jet, rule, flawed)
    with pytest.raises(AssertionError):
        check(text)


KINKS = {
    "abs": ("abs(x - y)", (1.0, 0.0)),
    "min": ("min(x, y)", (1.0, 0.0)),
    "max": ("max(x*x, y)", (1.0, 0.0)),
    "round": ("round(x)", (0.1, 0.2)),
    "sqrt": ("sqrt(x)", (1.0, 1.5)),
    "sign": ("sign(x)*x*x", (0.5, 0.6)),
}


@pytest.mark.parametrize(("text", "beside"), KINKS.values(), ids=KINKS)
def test_there_is_no_curvature_across_a_kink(text, beside):
    model = of(text)
    across = {"round": (0.4, 0.6)}.get(text[:5], (0.0, 1.0))
    boxes = [
        gc.Interval([[low, y]], [[high, y + 0.1]]) for low, high, y in ((*across, 0.0), (beside[0], beside[0] + 0.1, -0.5))
    ]
    found = [model.curvature_enclosure(b, 0).mag[0, 0] for b in boxes]
    assert np.isinf(found[0])
    assert found[1] < 5


def test_one_of_two_boxes_that_meet_at_a_kink_has_no_curvature():
    """Else a slope could jump where both say that none does."""
    for text in ("abs(x)", "min(x, 0)", "max(x, 2*x)", "round(x + 1/2)"):
        both = of(text).curvature_enclosure(gc.Interval([[-1.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], [1.0, 0.0]]), 0)
        assert np.isinf(both.mag).any(), text


def test_what_is_constant_along_an_axis_has_no_kink_there():
    across = gc.Interval([[-1.0, -1.0]], [[1.0, 1.0]])
    assert of("abs(y) + sin(x)").curvature_enclosure(across, 0).mag[0, 0] <= 1 + 1e-12
    assert np.isinf(of("abs(y) + sin(x)").curvature_enclosure(across, 1).mag[0, 0])


def missed(values):
    """How often an enclosure of ∂²(x³ y / 7 + 0.1 x²) at a point does not contain the exact number."""
    model, out = of("x**3*y/7 + 0.1*x**2"), 0
    found = model.curvature_enclosure(gc.Interval.exact(values), 0)
    for (x, y), low, high in zip(values, found.lo[:, 0], found.hi[:, 0], strict=True):
        exact = 6 * Fraction(x) * Fraction(y) / 7 + Fraction(0.1) * 2
        out += not Fraction(low) <= exact <= Fraction(high)
    return out


def test_outward_rounding_is_needed(monkeypatch):
    values = np.random.default_rng(0).uniform(-1, 1, (300, 2))
    assert missed(values) == 0
    for name in ("_down", "_up"):
        monkeypatch.setattr(intervals, name, np.asarray)
    assert missed(values) > 50


def test_a_model_that_is_wrapped_keeps_its_curvature():
    inner = of("sin(2*x) + x*y**3")
    z = np.random.default_rng(1).uniform(-1, 1, (20, 2))
    box = gc.Interval.around(z, 0.1)
    x, y = (inner.curvature_enclosure(box, j) for j in (0, 1))
    assert (x.lo != y.lo).all()
    wide = AugmentedModel(inner, (gc.StateSpec("h"),))
    spread = gc.Interval(np.insert(box.lo, 1, -1, axis=1), np.insert(box.hi, 1, 1, axis=1))
    for axis, expected in ((0, x), (1, gc.Interval.exact(0 * x.lo)), (2, y)):
        found = wide.curvature_enclosure(spread, axis)
        assert (found[:, :1].lo == expected.lo).all()
        assert (found[:, :1].hi == expected.hi).all()
        assert (found.mag[:, 1] == 0).all()
    assert (Resting(inner).curvature_enclosure(box, 1).hi == y.hi).all()
