"""The shuttle as a pure function of (x, u, hidden, forces)."""

import numpy as np

import gapcert as gc
from gapcert_shuttle.simulator import Shuttle


class ShuttleBackend(gc.Backend):
    """x = position and velocity of the carriage, u = the force on it. Hidden: the block's place in the slot, its velocity, and
    the rubber's force, which the simulator remembers from its last tick. Forces act on carriage and block, tick by tick.
    """

    states = (gc.StateSpec("p", "m"), gc.StateSpec("v", "m/s"))
    inputs = (gc.StateSpec("force", "N"),)
    hidden = (gc.StateSpec("block", "m"), gc.StateSpec("block_velocity", "m/s"), gc.StateSpec("rubber", "N"))
    hidden_default = (0.0, 0.0, 0.0)
    period, substeps = 0.01, 20
    coordinates = ("p", "block")
    capabilities = frozenset({"hidden", "forces"})

    def _step(self, x, u, hidden, forces=None):
        shuttle, after = Shuttle(), np.empty((len(x), 5))
        if forces is None:
            forces = np.zeros((len(x), self.substeps, 2))
        pushes = (forces + u[:, None] * [1.0, 0.0]).tolist()
        for k, start in enumerate(np.concatenate([x, hidden], axis=1).tolist()):
            # The whole state is set before every query: nothing is left over from the last one.
            shuttle.position, shuttle.velocity, shuttle.block, shuttle.block_velocity, shuttle.rubber = start
            for on_carriage, on_block in pushes[k]:
                shuttle.tick(on_carriage, on_block)
            after[k] = shuttle.position, shuttle.velocity, shuttle.block, shuttle.block_velocity, shuttle.rubber
        return gc.plugin.Step(after[:, :2], after[:, 2:])
