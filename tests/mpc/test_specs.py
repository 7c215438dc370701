"""Whole runs of the specs with a robust MPC."""

from __future__ import annotations

from pathlib import Path

import pytest

import gapcert

SPECS = Path(__file__).parents[2] / "specs"


@pytest.mark.exam
@pytest.mark.parametrize(
    ("name", "sooner"),
    [
        ("mecanum_mpc", ["certificate.violation=1e-2", "closed_loop.starts=20"]),
        ("pendulum_adaptive", ["closed_loop.starts=20"]),
        ("pendulum_mpc", ["closed_loop.starts=20"]),
    ],
)
def test_expectations_are_met(name: str, sooner: list[str], tmp_path: Path) -> None:
    run = gapcert.run(gapcert.load_spec(SPECS / f"{name}.yaml", sooner), out=tmp_path)
    assert run.exit_code == 0, run.summary["expectations"]
    loaded = gapcert.load_controller(next(tmp_path.glob("*/controller/with_gamma")))
    assert loaded.kind == "mpc"
