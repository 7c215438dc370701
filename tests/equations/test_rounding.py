"""What the arithmetic of a step may miss: no evaluator exceeds the bound, whatever the text cancels."""

from __future__ import annotations

import numpy as np
import pytest
from rounded_models import DIGITS, Draw, equations_model, missed

import gapcert as gc
from gapcert import Interval
from gapcert_equations.config import EquationsConfig
from gapcert_equations.programs import rounding

CANCELLING = "0.3*p + 0.2*sin(7*p) + (max(3*p/7 + 4e9, -2) - max(4e9 - p/7, -1e20))"
STIFF = {
    "kind": "equations",
    "states": {"p": "m", "v": "m/s"},
    "inputs": {"u": "1"},
    "parameters": {"T": "1 s", "d": "1 m"},
    "derivative": {"p": "v", "v": "-40*v/T - d*sin(p/d)/T**2 + 40*u*d/T**2"},
    "integrator": "semi_implicit",
    "substeps": 40,
    "period": "1 s",
}


def made(**given):
    return equations_model(EquationsConfig(kind="equations", **given))


def mapped(text, **more):
    """p⁺ by a text in p alone."""
    return made(states={"p": "1"}, inputs={}, period=0.1, next={"p": text}, **more)


def box(low, high):
    return Interval(np.atleast_2d(low).astype(float), np.atleast_2d(high).astype(float))


def answers(model, z, jax=False):
    """x⁺ of every evaluator that is there."""
    x, u = np.ascontiguousarray(z[:, : model.nx]), np.ascontiguousarray(z[:, model.nx :])
    with np.errstate(all="ignore"):
        found = [np.concatenate([_step(model, x[k : k + 1], u[k : k + 1]) for k in range(len(x))])]
        found.append(model.fast_rollout(x, u[:, None, :]).x[:, 1])
        if jax and not model.hidden:
            found.append(np.asarray(model.jax()(x, u)))
    return found


def _step(model, x, u):
    try:
        return model.step(x, u).x
    except gc.UsageError:
        return np.full(x.shape, np.nan)


def violations(seeds, **how):
    """(errors above the bounds, over the box or at the point; how many were looked at; the largest share of a bound)."""
    over, seen, largest = 0, 0, 0.0
    for seed in seeds:
        draw = Draw(seed)
        model, low, high = draw.model()
        if model is None or model.rounding_over(box(low, high)) is None:
            continue
        z = draw.points(low, high)
        for after in answers(model, z, **how):
            far = missed(model, z, after)
            for bound in (model.rounding_over(box(low, high)), model.rounding_over(Interval.exact(z))):
                known = np.isfinite(far) & np.isfinite(bound)
                share = np.where(known, far, 0.0) / np.maximum(np.where(known, bound, 1.0), 1e-320)
                over, seen, largest = over + int((share > 1).sum()), seen + int(known.sum()), max(largest, float(share.max()))
    return over, seen, largest


def test_no_step_misses_more_than_its_bound():
    over, seen, largest = violations(range(12))
    assert over == 0
    assert seen > 500
    assert largest > 0.3  # and the bound is not idle


@pytest.mark.exam
def test_no_step_of_hundreds_of_models_misses_more_than_its_bound():
    over, seen, _ = violations(range(1000, 1250))
    assert over == 0
    assert seen > 10_000


@pytest.mark.exam
def test_nor_does_a_step_by_jax():
    pytest.importorskip("jax")
    over, seen, _ = violations(range(2000, 2024), jax=True)
    assert over == 0
    assert seen > 1000


def test_four_ulp_of_the_state_are_no_bound():
    model, z = mapped(CANCELLING), np.linspace(-1, 1, 400)[:, None]
    far = missed(model, z, model.step(z, np.empty((400, 0))).x)
    assert far.max() > 1e6 * model.resolution(np.ones(1))[0]
    assert far.max() <= model.rounding_over(box([-1], [1]))[0, 0] < 20 * far.max()


def test_a_fault_in_the_analysis_is_seen(monkeypatch):
    """Without the rounding of each operation, or with what operands hand on halved, drawn steps exceed the bound."""
    monkeypatch.setattr(rounding, "_U", 0.0)
    monkeypatch.setattr(rounding, "_LIBRARY", 0.0)
    assert violations(range(6))[0] > 0


def test_large_arguments_of_steep_waves_count():
    model, z = mapped("-84.5*sin(300*p)"), -1000 + np.linspace(0, 1e-3, 300)[:, None]
    far = missed(model, z, model.step(z, np.empty((300, 0))).x)
    bound = model.rounding_over(box([-1000], [-999.999]))[0, 0]
    assert 100 * model.resolution(np.array([84.5]))[0] < far.max() <= bound < 10 * far.max()


def test_the_term_that_cancels_is_named():
    assert mapped(CANCELLING).rounding_terms(box([-1], [1])) == ("(4000000000 + 3/7*p)",)


@pytest.mark.parametrize("scheme", ["euler", "semi_implicit", "rk4"])
def test_errors_shrink_where_the_motion_contracts(scheme):
    """v forgets what it was: forty sub-steps err by no more than a few."""
    model = equations_model(EquationsConfig(**STIFF | {"integrator": scheme}))
    bound = model.rounding_over(box([-1, -1, -1], [1, 1, 1]))[0]
    assert (bound < 64 * np.spacing(2.0)).all()
    rng = np.random.default_rng(3)
    z = rng.uniform(-1, 1, (60, 3))
    for after in answers(model, z):
        assert (missed(model, z, after) <= bound).all()


def test_jumps_have_no_bound_but_where_their_argument_is_exact():
    zone = box([-1], [1])
    assert mapped("p + 0.1*sign(p)").rounding_over(zone)[0, 0] < 1e-15
    assert mapped("p + 0.1*sign(p - 0.3)").rounding_over(zone)[0, 0] == np.inf
    assert mapped("p + 0.1*sign(p - 1.3)").rounding_over(zone)[0, 0] < 1e-15
    assert mapped("p + 0.1*round(5*p)").rounding_over(zone)[0, 0] == np.inf


def test_steep_ends_have_one():
    """√, fractional powers and arc functions at the end of where they are defined, of arguments that are rounded."""
    for text in ("sqrt(abs(p - p**2/3))", "abs(0.1*p)**0.4", "asin(p/(1 + 0.0*p)*0.999)", "acos(tanh(30*p))"):
        bound = mapped(text).rounding_over(box([-1], [1]))[0, 0]
        assert bound < 1e-6, text


def test_friction_of_coupled_coordinates_has_none():
    double = {
        "coordinates": {"a": "rad", "b": "rad"},
        "inputs": {"u": "N*m"},
        "parameters": {"J": "0.4 kg*m^2", "k": "0.1 kg*m^2", "F": "0.2 N*m"},
        "mass_matrix": [["J", "k*cos(a - b)"], ["k*cos(a - b)", "J"]],
        "forces": {"a": "u"},
        "dry_friction": {"a": "F"},
        "period": "10 ms",
    }
    model = made(**double)
    assert model.rounding_over(box([-1] * 5, [1] * 5)) is None
    smooth = made(**{k: v for k, v in double.items() if k != "dry_friction"})
    assert (smooth.rounding_over(box([-1] * 5, [1] * 5)) < 1e-14).all()


def test_late_inputs_and_memories_count():
    late = made(
        states={"p": "m"},
        inputs={"u": "m/s"},
        parameters={"lag": "33 ms", "T": "1 s"},
        derivative={"p": "u + z/T"},
        input_delay={"u": "lag"},
        memory={"z": {"next": "0.7*z + 0.3*p", "start": 0.3, "unit": "m"}},
        period="20 ms",
        substeps=3,
    )
    z = np.random.default_rng(5).uniform(-1, 1, (40, 2))
    bound = late.rounding_over(box([-1, -1], [1, 1]))[0]
    assert (missed(late, z, late.step(z[:, :1], z[:, 1:]).x) <= bound).all()
    assert bound[0] < 4 * np.spacing(1.0)


@pytest.mark.parametrize("name", ["sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "atan", "asin", "acos"])
def test_library_functions_err_by_at_most_four_ulp(name):
    """In every evaluator, at arguments that are hard for them."""
    rng = np.random.default_rng(7)
    near = np.arange(1, 60) * np.pi / 2
    v = np.concatenate([near, np.nextafter(near, 0), rng.normal(size=60), 10.0 ** rng.uniform(-9, 2, 60), [0.625, 0.6250001]])
    if name in ("asin", "acos"):
        v = np.concatenate([np.sin(v), 1 - 10.0 ** rng.uniform(-16, -1, 40)])
    v = np.abs(v) if name in ("log", "sqrt") else np.concatenate([v, -v])
    if name in ("sin", "cos", "tan"):
        v = np.concatenate([v, 10.0 ** rng.uniform(3, 9, 60)])
    model = mapped(f"{name}(p)")
    for after in answers(model, v[:, None]):
        far = missed(model, v[:, None], after)[:, 0]
        size = np.array([float(abs(DIGITS[name](float(p)))) for p in v])
        assert (far <= 8 * 2.0**-53 * size + 1e-307).all()
