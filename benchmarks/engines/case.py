"""What an engine's module supplies to benchmarks/throughput.py, and the pendulum that all of them step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import gapcert

Array = npt.NDArray[np.float64]
MODELS = Path(__file__).parents[2] / "specs/models"
PERIOD = 0.005
PENDULUM: dict[str, Any] = {
    "robot": MODELS / "pendulum.urdf",
    "states": {"theta": "hinge.position", "omega": "hinge.velocity"},
    "inputs": {"torque": "hinge"},
    "period": f"{PERIOD} s",
}


@dataclass(frozen=True)
class Peer:
    """The bare engine: `run(x, u)` steps as many rows, `answer(x, u)` gives their x⁺; they may be the same.

    The answer is compared with the backend's bit for bit; it need not be fast.
    """

    name: str
    run: Callable[[Array, Array], object]
    answer: Callable[[Array, Array], Array]


@dataclass(frozen=True)
class Engine:
    """A backend by name: its peer with so many engine steps per transition, and how many copies it steps at once.

    `tiles` = 1 where the engine cannot tile.
    """

    name: str
    peer: Callable[[int], Peer]
    tiles: int
    options: dict[str, Any]

    def backend(self, tiles: int, substeps: int) -> gapcert.Backend:
        registry = gapcert.registry()
        config = registry.config("backend", self.name)
        assert config is not None, "an engine has options"
        backend: gapcert.Backend = registry.build(
            "backend", self.name, config(**PENDULUM | self.options | {"tiles": tiles, "substeps": substeps})
        )
        return backend
