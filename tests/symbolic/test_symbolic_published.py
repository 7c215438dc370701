"""The problems that SCOTS 0.2 was published with, from their specs: as many cells win as it says, on as many cells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gapcert as gc
import gapcert_cells
from gapcert.cli.main import main
from gapcert_cells.testing import Band, rod_problem
from gapcert_symbolic.cells.bounds import Grown
from gapcert_symbolic.synthesizer import Symbolic

SPECS = Path(__file__).parents[2] / "specs" / "benchmarks"


def solved(name: str, gap: gc.GapFunction | None = None, **eta: float) -> gapcert_cells.GridController:
    spec = gc.load_spec(SPECS / f"{name}.yaml", overrides=[f"controller.eta.{k}={v}" for k, v in eta.items()])
    model, made = spec.build("model"), spec.build("controller")
    domain = gc.Domain.of(model, dict(spec.config.domain))
    return made.synthesize(gc.SynthesisProblem(model, gap, domain, spec.goal(domain)))


def counted(controller: gapcert_cells.GridController) -> tuple[int, int, int]:
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


@pytest.mark.exam
@pytest.mark.parametrize(("gap", "winning"), [(None, 95_521), (Band((-5e-4, -3e-3), (5e-4, 3e-3)), 70_515)])
def test_pendulum(gap: Band | None, winning: int) -> None:
    assert counted(solved("pendulum", gap))[:2] == (100_701, winning)


@pytest.mark.exam
def test_vehicle_on_finer_cells() -> None:
    cells, winning, targets = counted(solved("vehicle_fine"))
    assert (cells, winning - targets) == (724_271, 567_904)


@pytest.mark.exam
def test_aircraft_on_coarser_cells() -> None:
    """The targets are fewer than SCOTS's; the cells that win without being one are the same."""
    cells, winning, targets = counted(solved("aircraft_coarse"))
    assert (cells, winning - targets) == (2_428_470, 361_211)


def test_radii_are_those_of_each_input() -> None:
    """However the inputs repeat themselves in the rows."""
    rng = np.random.default_rng(3)
    model, radius = (gc.load_spec(SPECS / path).build("model") for path in ("vehicle.yaml", "growth/vehicle.yaml"))
    grown = Grown(model, radius, np.full(3, 1e-11))
    values = rng.uniform(-1, 1, (4, 2))
    for which in (np.arange(20) % 4, np.arange(20) // 5, rng.integers(0, 4, 20)):
        low, u = rng.uniform(-3, 3, (20, 3)), values[which]
        box = grown.over(low, low + 0.25, values, which)
        for i in range(20):
            one = grown.over(low[i : i + 1], low[i : i + 1] + 0.25, u[i : i + 1])
            assert np.abs(np.concatenate([one.lo - box.lo[i], one.hi - box.hi[i]])).max() < 1e-12


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
