"""Cells where SCOTS has them, and growth bounds that are declared."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gapcert import Interval, Model, Region, SynthesisProblem, UsageError, run
from gapcert.cli.main import main
from gapcert_cells import GROWTH, SEEN
from gapcert_cells.testing import Rod, rod_problem
from gapcert_symbolic.cells.abstraction import windows
from gapcert_symbolic.cells.bounds import Enclosed, Grown, structure
from gapcert_symbolic.cells.grid import Grid, multiples
from gapcert_symbolic.synthesizer import Symbolic


class Radii(Rod):
    """|θ⁺ − θ′⁺| ≤ r_θ + τ r_ω, |ω⁺ − ω′⁺| ≤ r_ω + τ (3g/2l) r_θ."""

    def _step(self, x: np.ndarray, u: np.ndarray, **options: object) -> np.ndarray:
        slope = np.abs(Rod.jacobian(self, np.zeros_like(x), np.zeros_like(u))[:, :, :2])
        return np.einsum("nij,nj->ni", slope, x)


def problem() -> SynthesisProblem:
    return rod_problem()


ETA = {"theta": 0.004, "omega": 0.005, "torque": 0.25}


@pytest.mark.parametrize(
    ("low", "high", "eta", "count", "first"),
    [
        (0.0, 10.0, 0.2, 51, 0.0),
        (-3.5, 3.5, 0.2, 35, -3.4),
        (1.15, 1.55, 2 / 4e3, 800, 1.1505),
        (5.45, 5.85, 2 / 4e3, 799, 5.4505),
        (-1.0, 1.0, 0.3, 7, -0.9),
    ],
)
def test_nodes_are_those_of_scots(low: float, high: float, eta: float, count: int, first: float) -> None:
    """Counts as SCOTS 0.2 prints them."""
    nodes = multiples(low, high, eta)
    assert len(nodes) == count
    assert nodes[0] == pytest.approx(first, abs=1e-12)
    assert np.diff(nodes) == pytest.approx(eta)


def test_no_multiple_is_refused() -> None:
    with pytest.raises(UsageError, match=r"controller.eta: no multiple of 1 lies in \[0.2, 0.7\]"):
        multiples(0.2, 0.7, 1.0)


def test_cells_about_nodes() -> None:
    stay = problem().goal.stay
    grid = Grid.scots(stay, (0.01, 0.02))
    for nodes, edges, (lower, upper) in zip(grid.nodes or (), grid.edges, grid.ends, strict=True):
        assert (lower + upper) / 2 == pytest.approx(nodes, abs=1e-15)
        assert edges[:-1] == pytest.approx(lower, abs=1e-13)
        assert edges[1:] == pytest.approx(upper, abs=1e-13)


def test_errors_of_measurement_widen_a_cell_before_the_step_and_after_it() -> None:
    spare, u = np.array([0.01, 0.03]), np.zeros((1, 1))
    half = np.array([[0.1, 0.2]])
    grown = Radii()._step(half + spare, u) + spare
    assert Grown(Rod(), Radii(), spare).spread(half, u)[0] == pytest.approx(grown, rel=1e-12)


def test_growth_bounds_contain_what_intervals_do_not_exceed_by_much() -> None:
    """A growth bound that holds gives a controller no larger than the enclosures do, up to a cell at the boundary."""
    model: Model = Rod()
    low, high = np.array([[0.05, -0.1]]), np.array([[0.06, -0.08]])
    u = np.array([[0.3]])
    grown, proved = Grown(model, Radii(), np.full(2, 1e-12)).over(low, high, u), Enclosed(model).over(low, high, u)
    rng = np.random.default_rng(0)
    x = low + (high - low) * rng.random((10_000, 2))
    after = model.step(x, np.repeat(u, len(x), axis=0)).x
    for box in (grown, proved):
        assert ((box.lo <= after) & (after <= box.hi)).all()
    assert (grown.width <= 1.01 * proved.width + 1e-9).all()


def test_a_controller_on_trust_says_so() -> None:
    made = Symbolic(align="scots", eta=ETA, growth=Radii()).synthesize(problem())
    assert made.evidence["winning_cells"] > 0
    assert made.evidence["assumptions"] == [GROWTH]
    assert "assumptions" not in Symbolic({"theta": 20, "omega": 20}, {"torque": 5}).synthesize(problem()).evidence


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"eta": {"theta": 0.01}}, "controller.eta: nothing for 'omega'; add omega: a distance in rad/s"),
        ({"eta": {**ETA, "omega": 0.0}}, "controller.eta: omega is 0; give a positive distance"),
        ({"eta": {**ETA, "speed": 1.0}}, "controller.eta: 'speed' is unknown"),
        ({"eta": ETA, "cells": {"theta": 3}}, "align: scots takes distances"),
    ],
)
def test_distances_are_asked_for(options: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        Symbolic(align="scots", **options).synthesize(problem())


class Opaque(Rod):
    """Says nothing of ranges and derivatives over boxes."""

    def enclosure(self, z: Interval) -> Interval:
        raise UsageError("model.function: says nothing about its range")

    jacobian_enclosure = enclosure


def test_an_opaque_model_has_the_same_controller() -> None:
    """What it depends on is seen at points; a bound is declared for it."""
    eta = {**ETA, "theta": 0.008}
    known, opaque = (
        Symbolic(align="scots", eta=eta, growth=Radii()).synthesize(replace(problem(), model=model))
        for model in (Rod(), Opaque())
    )
    assert known.evidence["winning_cells"] > 0
    assert np.array_equal(known.bits, opaque.bits)
    assert (known.evidence["assumptions"], opaque.evidence["assumptions"]) == ([GROWTH], [GROWTH, SEEN])
    view = windows(
        Grown(Opaque(), Radii(), np.full(2, 1e-12)), Grid(problem().goal.stay, (9, 8)), (np.linspace(-1, 1, 3),), None
    )
    assert [(axis.on, axis.moves) for axis in view.axes] == [((1,), True), ((0,), True)]
    with pytest.raises(UsageError, match="says nothing about its range"):
        Symbolic({"theta": 9, "omega": 8}, {"torque": 3}).synthesize(replace(problem(), model=Opaque()))


class Hiding(Opaque):
    """θ⁺ depends on the torque as well, in a twentieth of the speeds, where it moves θ by a tenth of a cell."""

    def _step(self, x: np.ndarray, u: np.ndarray, **options: Any) -> np.ndarray:
        after = np.array(super()._step(x, u, **options))
        after[:, 0] += 1e-3 * u[:, 0] * (np.abs(x[:, 1] - 0.1) < 0.0125)
        return after


def test_a_dependence_that_pairs_of_points_show_is_in_the_windows() -> None:
    """In a twentieth of the pairs; a window that leaves it out would be the same for all torques."""
    grid, axes = Grid(problem().goal.stay, (20, 40)), (np.linspace(-1, 1, 3),)
    plain, hiding = (structure(Enclosed(model), grid, axes) for model in (Opaque(), Hiding()))
    assert [p.inputs for p in plain] == [(False,), (True,)]
    assert [p.inputs for p in hiding] == [(True,), (True,)]
    made = Symbolic(align="scots", eta=ETA, growth=Radii()).synthesize(replace(problem(), model=Hiding()))
    assert SEEN in made.evidence["assumptions"]


def test_radii_of_other_states_are_refused() -> None:
    class Other(Radii):
        def __init__(self) -> None:
            super().__init__()
            self.states = self.states[::-1]

    with pytest.raises(UsageError, match=r"controller.growth: its model has the states omega, theta; expected theta, omega"):
        Symbolic(align="scots", eta=ETA, growth=Other()).synthesize(problem())


RADII = """version: 1
name: radii
model:
  kind: equations
  states: {theta: {unit: rad, kind: angle}, omega: rad/s}
  inputs: {torque: N*m}
  parameters: {a: 14.715 1/s^2, tau: 5 ms}
  next: {theta: theta + tau*omega, omega: omega + tau*a*theta}
  period: 5 ms
"""


@pytest.mark.exam
def test_a_spec_names_the_model_of_radii(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "radii.yaml").write_text(RADII)
    pendulum = Path(__file__).parents[2] / "specs" / "pendulum.yaml"
    text = pendulum.read_text().replace("models/pendulum.urdf", str(pendulum.parent / "models" / "pendulum.urdf"))
    text = text.replace(
        "  cells: {theta: 200, omega: 200}\n  inputs: {torque: 201}\n",
        "  align: scots\n  eta: {theta: 0.002 rad, omega: 0.005 rad/s, torque: 0.1 N*m}\n  growth: {model: radii.yaml}\n",
    )
    text = text[: text.index("expect:")].replace("attack: 1000000", "attack: 0")
    (tmp_path / "spec.yaml").write_text(text)
    code = main(["run", str(tmp_path / "spec.yaml"), "--out", str(tmp_path / "out"), "--json"])
    out = capsys.readouterr().out
    assert code == 0, out
    assert GROWTH in out


def test_cells_that_stick_out_are_not_safe() -> None:
    p = problem()
    grid = Grid.scots(p.goal.stay, (0.013, 0.02))
    assert grid.inside(Region((p.goal.stay,))).sum() < grid.size
    made = Symbolic(align="scots", eta={**ETA, "theta": 0.0043}, growth=Radii()).synthesize(p)
    x = made.draw(2000, np.random.default_rng(0))
    assert len(x)
    assert p.goal.stay.contains(x).all()


CART = """version: 1
name: cart
model: &model
  kind: equations
  states: {x: m, v: m/s}
  inputs: {a: m/s^2}
  parameters: {tau: 0.1 s}
  next: {x: x + tau*v, v: v + tau*a}
  period: 0.1 s
backend: *model
domain: {x: [-1, 1], v: [-1, 1], a: [-2, 2]}
lipschitz: {residual: {kind: interval}}
certificate: {claim: deterministic}
controller:
  kind: symbolic
  goal: {invariance: {x: [-1, 1], v: [-1, 1]}}
  align: scots
  eta: {x: 0.05 m, v: 0.05 m/s, a: 0.5 m/s^2}
  growth: {model: radii.yaml}
report: {rerun: false, html: false}
"""
CART_RADII = """version: 1
name: radii
model:
  kind: equations
  states: {x: m, v: m/s}
  inputs: {a: m/s^2}
  parameters: {tau: 0.1 s}
  next: {x: x + tau*v, v: v}
  period: 0.1 s
"""


@pytest.mark.parametrize("trusted", [True, False])
def test_a_bound_on_trust_carries_no_proof_over(tmp_path: Path, trusted: bool) -> None:
    """The certificate is deterministic either way, the controller only where its successors are bounded by what is proved."""
    (tmp_path / "radii.yaml").write_text(CART_RADII)
    text = CART if trusted else CART.replace("  growth: {model: radii.yaml}\n", "")
    (tmp_path / "spec.yaml").write_text(text)
    made = run(tmp_path / "spec.yaml", out=tmp_path / "out")
    assert made.summary["certificate"]["claim"]["kind"] == "deterministic"
    assert made.summary["controller"]["winning_cells"] > 0
    assert made.summary["controller"]["claim"]["kind"] == ("empirical" if trusted else "deterministic")
