"""Declarations against knowledge: drawn texts with spikes and ramps that no sample meets, declared away; and true ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import gapcert as gc
from gapcert.certification import contradiction
from gapcert.certification.thresholds import THRESHOLDS
from gapcert.contracts.gaps.gap import GapProblem
from gapcert.contracts.gaps.lipschitz import LipschitzBound, LipschitzProblem, Residual, Symmetry
from gapcert.contracts.gaps.predictor import AffinePredictor, Samples
from gapcert.numerics.order_statistics import NO_CONSTANTS
from gapcert.testing.toys import Opaque
from gapcert_bounds.constants.declared_constants import Declared
from gapcert_bounds.families.constant import Declared as DeclaredGamma

Array = np.ndarray
HIDDEN = (
    "{size}*max(0, 1 - {steep}*abs({axis} - {at}))",
    "{size}*exp(-({steep}*({axis} - {at}))**2)",
    "{size}*(1 + tanh({steep}*({axis} - {at})))/2",
)


def asked(law: str, n: int) -> LipschitzProblem:
    """f: x_i⁺ = x_i + 0.1 u, on [−2, 3]ⁿ × [−1, 1]; of f̂, x0⁺ has the law beside it."""
    states = [f"x{i}" for i in range(n)]
    plain = {"kind": "equations", "states": dict.fromkeys(states, "1"), "inputs": {"u": "1"}, "period": "0.1 s"}
    nexts = {s: f"{s} + 0.1*u" for s in states}
    systems = [
        gc.load_spec({"version": 1, "name": "n", "model": plain | {"next": nexts | {"x0": nexts["x0"] + more}}}).build("model")
        for more in ("", f" + {law}")
    ]
    f, fhat = systems
    domain = gc.Domain.of(f, {**dict.fromkeys(states, (-2.0, 3.0)), "u": (-1.0, 1.0)})
    residual = Residual(fhat, f)
    none = AffinePredictor.none(n, n + 1)
    return LipschitzProblem(domain, none, residual.resolution(domain), lambda _, z: residual(z), f, fhat, seed=5)


def held(problem: LipschitzProblem, bound: LipschitzBound, gap: Any = None) -> None:
    """A bound, or a γ that is assumed, against the equations."""
    n = problem.domain.nx
    samples = Samples(np.zeros((0, n + 1)), np.zeros((0, n)))
    whole = GapProblem(samples, problem.domain, bound, problem.predictor, problem.resolution, "dominate")
    contradiction.declared(whole, gap, Residual(problem.backend, problem.model), gap is not None)


def declared(problem: LipschitzProblem, slope: Mapping[int, float], bend: Mapping[int, float] | None = None) -> None:
    """Held against the equations: constants of x0 by axis, others 0, and, if given, curvature."""
    names = [a.name for a in problem.domain.axes]
    state = names[: problem.domain.nx]

    def table(of: Mapping[int, float]) -> dict[str, dict[str, float]]:
        return {s: {a: of.get(j, 0.0) if s == "x0" else 0.0 for j, a in enumerate(names)} for s in state}

    held(problem, Declared(table(slope), None if bend is None else table(bend)).bound(problem))


def stated(problem: LipschitzProblem, first: float, others: float) -> None:
    """Held against the equations: γ of x0, and of the other states."""
    names, n = [s.name for s in problem.model.states], problem.domain.nx
    gap = DeclaredGamma({name: first if name == "x0" else others for name in names}).stated(names)
    held(problem, LipschitzBound(np.zeros((n, n + 1)), np.zeros((n, n + 1)), "estimated", NO_CONSTANTS), gap)


def drawn(seed: int) -> tuple[str, int, int, float, float]:
    """(law, states, axis, size, steep): a smooth part of slope and curvature below 0.04 in x0, and one narrow thing."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 4))
    axis, size, steep = int(rng.integers(n)), float(rng.uniform(0.1, 2)), float(10 ** rng.uniform(3.7, 5))
    at = float(rng.uniform(-1.9, 2.9))
    law = HIDDEN[seed % len(HIDDEN)].format(size=size, steep=steep, axis=f"x{axis}", at=at)
    return f"0.02*sin(x0) + {law}", n, axis, size, steep


@pytest.mark.parametrize("seed", range(9))
def test_what_no_sample_meets_is_found_in_the_text_and_both_numbers_are_told(seed: int) -> None:
    law, n, axis, size, _ = drawn(seed)
    problem = asked(law, n)
    z = problem.domain.draw(300, np.random.default_rng(seed))
    if seed % len(HIDDEN) != 2:  # a step is met from either side
        assert np.abs(problem.query("", z)[:, 0]).max() < 0.02 + 0.5 * size
    with pytest.raises(gc.UsageError, match=rf"^lipschitz: constants: the change .* along x{axis}, and the declaration allows"):
        declared(problem, {0: 0.021, axis: 0.05})
    with pytest.raises(gc.UsageError, match=r"^symmetries.translation: .* and the declaration allows"):
        contradiction.symmetric(problem, Symmetry((f"x{axis}",), (axis,), 0, (0.0,) * n))
    with pytest.raises(gc.UsageError, match=r"^gap: γ: \|f̂ − f\| of x0 is .*, and the declaration allows 0.05;"):
        stated(problem, 0.05, 0.0)


@pytest.mark.parametrize("seed", range(9))
def test_true_declarations_are_accepted(seed: int) -> None:
    """The exact suprema of a spike of straight sides, or a little more than those of smooth ones."""
    law, n, axis, size, steep = drawn(seed)
    problem = asked(law, n)
    top = size * steep * (1.0 if seed % 3 == 0 else 0.8578 if seed % 3 == 1 else 0.5)
    declared(problem, {axis: top + 0.02 * (axis == 0)} | ({} if axis == 0 else {0: 0.02}))
    free = [j for j in range(1, n) if j != axis]
    for j in free:
        assert contradiction.symmetric(problem, Symmetry((f"x{j}",), (j,), 0, (0.0,) * n)).proved
    stated(problem, 1.001 * size + 0.02, 1e-9)


@pytest.mark.parametrize(
    "law",
    [
        "0.4*max(0, 1 - 9000*(abs(x0 - 1.234) + abs(x1 + 0.777)))",
        "0.2*exp(-3e6*((x0 - 0.31)**2 + (x1 - 2.2)**2 + (x2 + 1.1)**2))",
        "0.3*tanh(4000*(u*x0 - 0.37))",
        "0.09*sqrt(abs(x0 - 0.555))",
    ],
)
def test_what_is_narrow_along_several_axes_at_once_is_found(law: str) -> None:
    problem = asked(law, 3)
    for lie in (
        lambda: declared(problem, dict.fromkeys(range(4), 0.06)),
        lambda: contradiction.symmetric(problem, Symmetry(("x0",), (0,), 0, (0.0,) * 3)),
        lambda: stated(problem, 0.1, 1e-9),
    ):
        with pytest.raises(gc.UsageError, match="and the declaration allows"):
            lie()


@pytest.mark.parametrize(
    ("law", "bend", "true"),
    [
        ("0.01*x0**2 + 0.0003*sin(60*(x0 - 1))*exp(-(40*(x0 - 1))**2)", 0.05, False),
        ("0.01*abs(x0 - 0.7130)", 0.5, False),
        ("0.01*x0**2 + 0.001*sin(5*x0)", 0.0451, True),
        ("0.01*x0**2", 0.0199, False),
    ],
)
def test_curvature_is_held_against_the_text(law: str, bend: float, true: bool) -> None:
    problem = asked(law, 1)
    slope = {0: 0.2}
    if true:
        declared(problem, slope, {0: bend})
    else:
        with pytest.raises(gc.UsageError, match=r"^lipschitz: curvature: the second difference .* along x0, and the decl"):
            declared(problem, slope, {0: bend})


def test_a_bend_is_judged_by_its_slab() -> None:
    """A lie in the quiet part is found, whatever the loud part allows."""
    problem = asked("0.01*max(0, x0 - 1)**2", 1)
    for quiet, loud, true in ((0.0, 0.0201, True), (0.1, 0.01, False)):
        parts = {"x0": {"x0": [[-2.0, 1.0, quiet], [1.0, 3.0, loud]], "u": 0.0}}
        bound = Declared({"x0": {"x0": 0.05, "u": 0.0}}, parts).bound(problem)
        if true:
            held(problem, bound)
        else:
            with pytest.raises(gc.UsageError, match="lipschitz: curvature"):
                held(problem, bound)


def test_a_ripple_below_the_resolution_is_no_contradiction() -> None:
    problem = asked("0.1*max(0, 1 - 20000*abs(x0 - 0.3))", 1)
    with pytest.raises(gc.UsageError, match="and the declaration allows"):
        declared(problem, {0: 0.01})
    declared(replace(problem, resolution=np.array([0.06])), {0: 0.01})


def test_without_the_search_the_lie_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    law, n, axis, _, _ = drawn(0)
    problem = asked(law, n)
    monkeypatch.setattr(contradiction, "THRESHOLDS", replace(THRESHOLDS, hunt_boxes=-1))
    declared(problem, {0: 0.021, axis: 0.05})
    assert not contradiction.symmetric(problem, Symmetry((f"x{axis}",), (axis,), 0, (0.0,) * n)).proved


def test_what_encloses_nothing_stays_an_assumption() -> None:
    problem = asked("0.01*sin(x0)", 2)
    for other in (Opaque(problem.backend), gc.testing.toys.Perturbed(problem.model, lambda z: 0 * z[:, :2])):
        kept = contradiction.symmetric(replace(problem, backend=other), Symmetry(("x1",), (1,), 3, (0.0, 0.0)))
        assert not kept.proved
        assert "nothing proves it" in kept.sentence()
        assert kept.exception.endswith("along x1, which rest on the declared symmetry")


def spec(law: str, **more: Any) -> dict[str, Any]:
    plain = {"kind": "equations", "states": {"p": "1", "q": "1"}, "inputs": {"u": "1"}, "period": "0.1 s"}
    return {
        "version": 1,
        "name": "declared",
        "model": plain | {"next": {"p": "p + 0.1*u", "q": "q"}},
        "backend": plain | {"next": {"p": f"p + 0.1*u + 0.02*sin(q) + {law}", "q": "q"}},
        "domain": {"p": [-1, 1], "q": [-1, 1], "u": [-1, 1]},
        "sampling": {"kind": "adaptive", "budget": 40},
        "certificate": {"claim": "deterministic", "violation": 0.05, "confidence": 0.9},
        "report": {"rerun": False, "html": False},
        **more,
    }


@pytest.mark.run
def test_a_run_refuses_what_is_false_and_names_what_is_open(tmp_path: Any) -> None:
    more = {"symmetries": {"translation": ["p"]}, "lipschitz": {"residual": {"kind": "interval"}}}
    with pytest.raises(gc.UsageError, match=r"symmetries.translation: the change of f̂ − f of p is .* allows"):
        gc.run(spec("0.4*exp(-(9000*(p + 0.4))**2)", **more), out=tmp_path)
    said = gc.run(spec("0*p", **more), out=tmp_path).summary["certificate"]["assumptions"]
    assert any("interval arithmetic proves it from the equations" in s for s in said)
    # What cancels in numbers alone is true, and no interval shows it: then no sentence calls it proved.
    said = gc.run(spec("0.3*(p - p**3) - 0.3*p*(1 - p**2)", **more), out=tmp_path).summary["certificate"]["assumptions"]
    assert any("nothing proves it" in s for s in said)
    assert any("both systems, but for those along p, which rest on the declared symmetry." in s for s in said)


@pytest.mark.parametrize("seed", range(4))
def test_points_of_the_audit_are_held_against_declared_constants_and_symmetries(seed: int) -> None:
    """Of an engine: a bump that no sample of the bound meets, and some of the audit do; it stays below any γ."""
    problem, rng = asked("0*x0", 2), np.random.default_rng(seed)
    at, width = rng.uniform(-1.5, 2.5, 2), 10 ** rng.uniform(-1, -0.7)

    def bump(z: Array) -> Array:
        return np.stack([0.4 * np.maximum(0, 1 - np.abs(z[:, :2] - at).max(axis=1) / width), 0 * z[:, 0]], axis=1)

    z, fresh = (problem.domain.draw(n, rng) for n in (60, 8000))
    z = z[bump(z)[:, 0] == 0]
    assert bump(fresh).any()
    flat, true = np.full((2, 3), 0.05), np.array([[0.4 / width] * 3, [0.0] * 3])
    symmetry = Symmetry(("x0", "x1"), (0, 1), 0, (0.0, 0.0))
    for value, provenance, held_, found in (
        (flat, "declared", None, True),
        (true, "declared", None, False),
        (flat, "interval", None, False),
        (np.zeros((2, 3)), "interval", symmetry, True),
    ):
        bound = LipschitzBound(value, 0 * value, provenance, "")
        whole = GapProblem(Samples(z, bump(z)), problem.domain, bound, problem.predictor, problem.resolution, "dominate")
        told = contradiction.by_audit(replace(whole, symmetry=held_), fresh, bump(fresh))
        assert (told is not None) == found
        assert told is None or (told["state"] == 0 and told["change"] > told["allowed"])
        assert contradiction.by_audit(replace(whole, symmetry=held_), z, bump(z)) is None
