"""Every mode of MPC ends in a controller, in a reason or in one sentence, whatever the gap leaves of the goal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
from drawn_mpc import MODES, drawn, ended

import gapcert as gc
from gapcert.plugin import Box, Goal, SynthesisProblem
from gapcert_cells.testing import Band
from gapcert_mpc.synthesizer import Mpc


@pytest.mark.parametrize("seed", range(660, 660 + len(MODES)), ids=MODES)
def test_each_mode_ends_in_an_answer(seed: int) -> None:
    assert ended(seed) in ("made", "nothing", "refused")


@pytest.mark.exam
def test_so_do_hundreds_of_drawn_ones() -> None:
    endings = [ended(seed) for seed in range(3 * len(MODES), 15 * len(MODES))]
    assert set(endings) <= {"made", "nothing", "refused"}
    assert 20 < endings.count("nothing") < len(endings) - 20


OTHERS = (("osqp", "reach"), ("clarabel", "reach"), ("piqp", "around"))


@pytest.mark.parametrize(("solver", "mode"), [("piqp", "reach"), *(pytest.param(*p, marks=pytest.mark.exam) for p in OTHERS)])
def test_a_tube_that_is_wider_than_its_room_is_a_reason(solver: str, mode: str) -> None:
    """Its rows then ask for more than they allow, which no library takes."""
    data = drawn(MODES.index(mode))
    data["controller"] |= {"solver": solver, "horizon": 4}
    spec = gc.load_spec(data)
    model = spec.build("model")
    domain = gc.Domain.of(model, dict(spec.config.domain))
    wide = [0.6 * (high - low) for low, high in zip(domain.low[: domain.nx], domain.high[: domain.nx], strict=True)]
    band = Band([-w for w in wide], wide)
    made = spec.build("controller").synthesize(SynthesisProblem(model, band, domain, spec.goal(domain)))
    assert made.evidence["domain_fraction"] == 0
    assert "reaches the target" in made.evidence["reason"]
    blamed = made.evidence["reason"].endswith("; for γ = 0 there would be a controller")
    assert blamed == (mode == "reach"), "in four steps these inputs come around the obstacle for no gap"


def held(pull: float, low: float, high: float, **options: Any) -> Mapping[str, Any]:
    """A cart on a spring with pull · x against it, to be kept at 0.5 to 0.7 m."""
    spec = {
        "kind": "equations",
        "states": {"x": "1", "v": "1"},
        "inputs": {"a": "1"},
        "next": {"x": "x + 0.1*v", "v": f"v + 0.1*(a - {pull}*x)"},
        "period": "0.1 s",
    }
    known = gc.registry()
    model = known.build("model", "equations", known.config("model", "equations").model_validate(spec))
    zone = gc.Domain.of(model, {"x": (0.0, 1.0), "v": (-1.0, 1.0), "a": (low, high)})
    goal = Goal("invariance", Box(model.states, (0.5, -1.0), (0.7, 1.0)))
    return Mpc(horizon=6, **options).synthesize(SynthesisProblem(model, None, zone, goal)).evidence


SUCCESSIVE = {"linearisation": "successive"}
ENDING = {"terminal": {"kind": "symbolic", "cells": {"x": 20, "v": 40}, "inputs": {"a": 17}}}


@pytest.mark.parametrize(
    ("pull", "options"),
    [(1.3, {}), (3.1, {}), *(pytest.param(*p, marks=pytest.mark.exam) for p in ((3.1, SUCCESSIVE), (1.3, ENDING)))],
    ids=str,
)
def test_inputs_that_are_too_weak_are_told_with_what_suffices(pull: float, options: dict[str, Any]) -> None:
    told = held(pull, -0.3, 0.3, **options)
    assert told["domain_fraction"] == 0
    assert told["reason"].startswith("a: the inputs are too weak, for γ = 0 too, where a in [-0.3, ")
    low, high = told["change"]["inputs"]["a"]
    assert low == -0.3
    # What holds the cart at 0.5 m is the least.
    assert 0.5 * pull <= high <= 0.5 * pull + 1.3
    assert held(pull, low, high, **options)["domain_fraction"] > 0
    assert "reason" in held(pull, low, 0.49 * pull, **options)


def test_a_goal_that_no_input_keeps_is_told_after_much_wider_ones_were_tried() -> None:
    moves = {"x": "x + v", "v": "v + 0.1*a"}
    spec = {"kind": "equations", "states": {"x": "1", "v": "1"}, "inputs": {"a": "1"}, "next": moves, "period": "0.1 s"}
    known = gc.registry()
    model = known.build("model", "equations", known.config("model", "equations").model_validate(spec))
    zone = gc.Domain.of(model, {"x": (0.0, 1.0), "v": (0.2, 0.6), "a": (-1.0, 1.0)})
    goal = Goal("invariance", Box(model.states, (0.0, 0.2), (1.0, 0.6)))
    told = Mpc(horizon=4).synthesize(SynthesisProblem(model, None, zone, goal)).evidence
    assert told["domain_fraction"] == 0
    assert told["reason"].endswith("; for γ = 0, inputs 33 times as wide do not help either")
