"""Every mode of MPC ends in a controller, in a reason or in one sentence, whatever the gap leaves of the goal."""

from __future__ import annotations

import pytest
from drawn_mpc import MODES, drawn, ended

import gapcert as gc
from gapcert.plugin import SynthesisProblem
from gapcert_cells.testing import Band


@pytest.mark.parametrize("seed", range(660, 660 + len(MODES)), ids=MODES)
def test_each_mode_ends_in_an_answer(seed: int) -> None:
    assert ended(seed) in ("made", "nothing", "refused")


@pytest.mark.exam
def test_so_do_hundreds_of_drawn_ones() -> None:
    endings = [ended(seed) for seed in range(3 * len(MODES), 15 * len(MODES))]
    assert set(endings) <= {"made", "nothing", "refused"}
    assert 20 < endings.count("nothing") < len(endings) - 20


@pytest.mark.parametrize("solver", ["osqp", "piqp", "clarabel"])
@pytest.mark.parametrize("mode", ["reach", "around"])
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
