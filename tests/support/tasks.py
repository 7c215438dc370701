"""Goals with an automaton for a point that drifts in a square."""

from __future__ import annotations

from typing import Any

from gapcert import Box, Domain, Goal, Model, Region, SynthesisProblem
from gapcert.plugin import Automaton
from gapcert.testing.toys import Drift

AGAIN = """HOA: v1 States: 3 Start: 0 AP: 2 "a" "b" Acceptance: 1 Inf(0) --BODY--
State: 0 [!0] 0 [0 & !1] 1 [0&1] 2 State: 1 [!1] 1 [1] 2 State: 2 {0} [!0] 0 [0 & !1] 1 [0&1] 2 --END--"""
ROCS = "F(a & F(b & F(c & (!b U a))))"


def box(model: Model, low: tuple[float, ...], high: tuple[float, ...]) -> Box:
    return Box(model.states, low, high)


def problem(automaton: Automaton, regions: dict[str, Region], gap: Any = None, avoid: Region | None = None) -> SynthesisProblem:
    model = Drift(2)
    domain = Domain.of(model, {"x0": (0.0, 1.0), "x1": (0.0, 1.0), "u0": (-1.0, 1.0), "u1": (-1.0, 1.0)})
    own = tuple(regions[name] for name in automaton.propositions)
    return SynthesisProblem(model, gap, domain, Goal("automaton", domain.states, None, avoid, automaton, own))


MODEL = Drift(2)
# None of the borders is an edge of a cell.
REGIONS = {
    "a": Region((box(MODEL, (0.04, 0.04), (0.43, 0.43)),)),
    "b": Region((box(MODEL, (0.56, 0.04), (0.97, 0.48)),)),
    "c": Region((box(MODEL, (0.56, 0.36), (0.96, 0.97)), box(MODEL, (0.0, 0.8), (0.3, 1.0)))),
}
SPEC = """
version: 1
name: rounds
model: {kind: equations, states: {x: m, y: m}, inputs: {u: m/s, v: m/s}, next: {x: x + h*u, y: y + h*v}, period: 100 ms}
backend: {kind: equations, states: {x: m, y: m}, inputs: {u: m/s, v: m/s},
  next: {x: x + 0.98*h*u, y: y + h*v - 0.002*h*u}, period: 100 ms}
domain: {x: [0, 1], y: [0, 1], u: [-1, 1], v: [-1, 1]}
sampling: {kind: adaptive, budget: 200}
lipschitz: {residual: {kind: interval}}
gap: {kind: envelope}
certificate: {claim: deterministic, violation: 1e-2, confidence: 0.999}
controller: {kind: symbolic, cells: {x: 25, y: 25}, inputs: {u: 5, v: 5},
  goal: {ltl: F (left & F (right & X F left)), avoid: [{box: {x: [0.45, 0.55]}, where: ["y - x <= 0.02 m"]}],
    regions: {left: {x: [0, 0.3]}, right: {centre: {x: 80 cm, y: 0.3}, radii: {x: 0.2, y: 0.2}}}}}
closed_loop: {steps: 150, starts: 20}
report: {rerun: false}
"""
