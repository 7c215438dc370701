"""A simulator with contacts and memory as a third party's backend: its contract, and what is caught when the memory leaks."""

import sys
from pathlib import Path

import numpy as np
import pytest

import gapcert as gc
from gapcert.testing import SystemContract

sys.path.append(str(Path(__file__).parent / "gapcert_shuttle"))

from gapcert_shuttle.backend import ShuttleBackend
from gapcert_shuttle.simulator import Shuttle

pytestmark = pytest.mark.contract


class TestShuttle(SystemContract):
    def system(self):
        return ShuttleBackend()


def test_block_hits_the_ends():
    """Without contact the block stays behind by the carriage's way; the slot's end takes it along."""
    out = ShuttleBackend().rollout(np.array([[0.0, 0.0]]), np.full((1, 60, 1), 4.0))
    assert np.abs(out.hidden[0, 0]) < 0.03
    assert out.x[0, -1, 1] == pytest.approx(4.0 / 3.0 * 0.6, rel=0.1)  # one body of 3 kg in the mean


def test_momentum_is_kept():
    b, rng = ShuttleBackend(), np.random.default_rng(0)
    x, hidden = rng.uniform(-1, 1, (40, 2)), rng.uniform(-1, 1, (40, 3)) * [0.025, 1, 0]
    out = b.step(x, np.zeros((40, 1)), hidden=hidden)
    assert np.abs(2 * x[:, 1] + hidden[:, 1] - 2 * out.x[:, 1] - out.hidden[:, 1]).max() < 1e-12


class Leaking(ShuttleBackend):
    """The rubber's force is left over from the query before."""

    hidden_default = (0.021, 0.5, 0.0)

    def _step(self, x, u, hidden, forces=None):
        last = 0.0
        after = []
        for k in range(len(x)):
            shuttle = Shuttle()
            shuttle.rubber = last
            shuttle.position, shuttle.velocity = x[k].tolist()
            shuttle.block, shuttle.block_velocity = hidden[k, :2].tolist()
            for _ in range(self.substeps):
                shuttle.tick(float(u[k, 0]))
            last = shuttle.rubber
            after.append([shuttle.position, shuttle.velocity, shuttle.block, shuttle.block_velocity, shuttle.rubber])
        after = np.array(after)
        return gc.plugin.Step(after[:, :2], after[:, 2:])


@pytest.mark.parametrize("check", ["test_order_does_not_matter", "test_batch_equals_singles"])
def test_leak_is_caught(check):
    contract = TestShuttle()
    contract.system = lambda: Leaking()
    with pytest.raises(AssertionError, match="other bits"):
        getattr(contract, check)()
