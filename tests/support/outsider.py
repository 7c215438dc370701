"""A third party's System with the default digest: what it holds is of Gapcert, and may be moved there."""

from typing import Any

import gapcert as gc

LINE = {"kind": "equations", "states": {"x": "1"}, "inputs": {"u": "1"}, "period": "1 s", "next": {"x": "0.5*x + u"}}


class Outsider(gc.Backend):
    """x⁺ = x/2 + u + size · (x − x³), the same to the last bit everywhere; it keeps a model of its own, as a wrapper does,
    and public things of several kinds.
    """

    def __init__(self, size: float, *held: Any) -> None:
        self.states = (gc.StateSpec("x"),)
        self.inputs = (gc.StateSpec("u"),)
        self.period = 1.0
        self.parameters = (gc.Parameter("size", size, "1", 0.0, 1.0),)
        self.size, self.held = size, held

    def _step(self, x, u, **options):
        return 0.5 * x + u + self.size * (x - x * x * x)


def model() -> gc.Model:
    return gc.registry().build("model", "equations", gc.registry().config("model", "equations").model_validate(LINE))


def domain() -> gc.Domain:
    return gc.Domain.of(model(), {"x": (-1, 1), "u": (-1, 1)})
