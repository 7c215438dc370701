"""Whole runs of the specs with a robust MPC."""

from __future__ import annotations

from pathlib import Path

import pytest

import gapcert
from gapcert_report import illustrator

SPECS = Path(__file__).parents[2] / "specs"
TWENTY = (
    "expect={verdict: holds, closed_loop.with_gamma.violations: 0, closed_loop.with_gamma.broken_promises: 0,"
    " closed_loop.with_gamma.reached: 20, 'closed_loop.without_gamma.broken_promises >': 0}"
)
"""What the spec expects of a hundred runs, of twenty."""


@pytest.mark.exam
@pytest.mark.parametrize(
    ("name", "sooner"),
    [
        ("mecanum_mpc", ["certificate.violation=1e-2", "closed_loop.starts=20", TWENTY]),
        ("pendulum_adaptive", ["closed_loop.starts=20"]),
        ("pendulum_mpc", ["closed_loop.starts=20"]),
    ],
)
def test_expectations_are_met(name: str, sooner: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # A third of the run would be one picture, which other tests draw.
    monkeypatch.setattr(illustrator, "winning_figure", lambda *_, **__: None)
    run = gapcert.run(gapcert.load_spec(SPECS / f"{name}.yaml", sooner), out=tmp_path)
    assert run.exit_code == 0, run.summary["expectations"]
    loaded = gapcert.load_controller(next(tmp_path.glob("*/controller/with_gamma")))
    assert loaded.kind == "mpc"
