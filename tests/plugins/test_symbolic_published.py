"""The problems that SCOTS 0.2 was published with, from their specs: as many cells win as it says, on as many cells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gapcert as gc
from gapcert.cli import main
from gapcert.testing.synthesis import Band, rod_problem
from gapcert_symbolic.bounds import Grown
from gapcert_symbolic.synthesizer import Symbolic

SPECS = Path(__file__).parents[2] / "specs" / "benchmarks"


def solved(name: str, gap: gc.GapFunction | None = None, **eta: float) -> gc.GridController:
    spec = gc.load_spec(SPECS / f"{name}.yaml", overrides=[f"controller.eta.{k}={v}" for k, v in eta.items()])
    model, made = spec.build("model"), spec.build("controller")
    made.growth = gc.load_spec(spec.folder / made.growth.model).build("model")
    domain = gc.Domain.of(model, dict(spec.config.domain))
    return made.synthesize(gc.SynthesisProblem(model, gap, domain, spec.goal(domain)))


def counted(controller: gc.GridController) -> tuple[int, int, int]:
    """Cells, cells that win, and targets among these."""
    return controller.values.size, int((controller.values >= 0).sum()), int((controller.values == 0).sum())


def test_vehicle() -> None:
    cells, winning, targets = counted(solved("vehicle"))
    assert (cells, winning - targets, targets) == (91_035, 48_018, 140)


@pytest.mark.parametrize(("gap", "winning"), [(None, 18_660), (Band((-5e-4, -3e-3), (5e-4, 3e-3)), 11_579)])
def test_pendulum_on_fewer_cells(gap: Band | None, winning: int) -> None:
    assert counted(solved("pendulum", gap, theta=0.0022, omega=0.0022))[:2] == (20_657, winning)


def test_converter() -> None:
    controller = solved("dcdc")
    assert controller.counts == (800, 799)
    assert counted(controller)[:2] == (639_200, 593_089)


@pytest.mark.slow
@pytest.mark.parametrize(("gap", "winning"), [(None, 95_521), (Band((-5e-4, -3e-3), (5e-4, 3e-3)), 70_515)])
def test_pendulum(gap: Band | None, winning: int) -> None:
    assert counted(solved("pendulum", gap))[:2] == (100_701, winning)


@pytest.mark.slow
def test_vehicle_on_finer_cells() -> None:
    cells, winning, targets = counted(solved("vehicle_fine"))
    assert (cells, winning - targets) == (724_271, 567_904)


@pytest.mark.slow
def test_aircraft_on_coarser_cells() -> None:
    """The targets are fewer than SCOTS's; the cells that win without being one are the same."""
    cells, winning, targets = counted(solved("aircraft_coarse"))
    assert (cells, winning - targets) == (2_439_360, 361_211)


def test_affine_maps_are_bounded_by_their_slopes() -> None:
    """As the map itself bounds them, but for rounding; a map that is not affine has no slopes."""
    rng, u = np.random.default_rng(3), np.tile([[1.0], [2.0]], (200, 1))
    model, radius = (gc.load_spec(SPECS / path).build("model") for path in ("dcdc.yaml", "growth/dcdc.yaml"))
    hull, spare = (np.array([1.15, 5.45]), np.array([1.55, 5.85])), np.full(2, 5e-14)
    low = rng.uniform(*hull, (400, 2))
    flat, plain = Grown(model, radius, spare, hull), Grown(model, radius, spare)
    a, b = (g.over(low, low + 5e-4, u) for g in (flat, plain))
    assert flat.known[u[:2].tobytes()] is not None
    assert plain.known[u[:2].tobytes()] is None
    assert np.abs(np.stack([a.lo - b.lo, a.hi - b.hi])).max() < 1e-13
    bent, radius = (gc.load_spec(SPECS / path).build("model") for path in ("pendulum.yaml", "growth/pendulum.yaml"))
    grown = Grown(bent, radius, spare, (np.array([0.0, -0.25]), np.array([0.2, 0.25])))
    grown.over(low, low, u)
    assert grown.known[u[:2].tobytes()] is None


@pytest.mark.parametrize("path", sorted(SPECS.glob("*.yaml")), ids=lambda p: p.stem)
def test_specs_are_valid(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["validate", str(path)]) == 0, capsys.readouterr()


def test_errors_of_measurement_widen_cells_and_successors() -> None:
    """A growth bound that is linear makes of an error z a gap of z + L z."""
    growth = gc.load_spec(SPECS / "growth" / "pendulum.yaml").build("model")
    problem = rod_problem()
    eta = {"theta": 0.004, "omega": 0.005, "torque": 0.25}
    error = {"theta": 1e-5, "omega": "2e-4 rad/s"}
    z = np.array([1e-5, 2e-4])
    gap = z + growth.step(z[None], np.zeros((1, 1))).x[0]
    problems = rod_problem(gap=Band(-gap, gap)), problem
    wide, erring = (
        Symbolic(align="scots", eta=eta, growth=growth, error=e).synthesize(p)
        for e, p in zip(({}, error), problems, strict=True)
    )
    assert np.array_equal(wide.bits, erring.bits)
    free = Symbolic(align="scots", eta=eta, growth=growth).synthesize(problem)
    assert 0 < erring.evidence["winning_cells"] < free.evidence["winning_cells"]


@pytest.mark.parametrize(
    ("error", "message"),
    [
        ({"phi": 1e-3}, "controller.error: 'phi' is no state; expected some of theta, omega"),
        ({"theta": -1e-3}, "controller.error: theta is -0.001; give a distance"),
    ],
)
def test_wrong_errors(error: dict[str, float], message: str) -> None:
    growth = gc.load_spec(SPECS / "growth" / "pendulum.yaml").build("model")
    with pytest.raises(gc.UsageError, match=message):
        Symbolic({"theta": 9, "omega": 9}, {"torque": 3}, growth=growth, error=error).synthesize(rod_problem())
    with pytest.raises(gc.UsageError, match="need a growth bound; add growth"):
        Symbolic({"theta": 9, "omega": 9}, {"torque": 3}, error={"theta": 1e-3}).synthesize(rod_problem())
