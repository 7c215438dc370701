"""Drake against a bare Python loop over its own calls."""

from __future__ import annotations

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from engines.case import MODELS, PERIOD, Array, Engine, Peer


def peer(substeps: int) -> Peer:
    """What a user would write who wants transitions, and not a simulation: the plant's own discrete update."""
    plant = MultibodyPlant(PERIOD / substeps)
    Parser(plant).AddModels(str(MODELS / "pendulum.urdf"))
    plant.SetUseSampledOutputPorts(False)
    plant.Finalize()
    context, port = plant.CreateDefaultContext(), plant.get_applied_generalized_force_input_port()

    def step(x: Array, u: Array) -> Array:
        out = np.empty_like(x)
        for k in range(len(x)):
            port.FixValue(context, u[k])
            context.SetDiscreteState(x[k])
            for i in range(substeps):
                after = plant.EvalUniquePeriodicDiscreteUpdate(context).value()
                if i + 1 < substeps:
                    context.SetDiscreteState(after)
            out[k] = after
        return out

    return Peer("bare Python loop over FixValue, SetDiscreteState, EvalUniquePeriodicDiscreteUpdate", step, step)


ENGINE = Engine("drake", peer, tiles=64, options={})
