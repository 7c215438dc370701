"""Makes pendulum_hidden.csv: PyBullet's pendulum with PyBullet's own drag, swung widely; 0.5 mrad of noise on the angle."""

from pathlib import Path

import numpy as np
from exams.hide import hide

import gapcert as gc
from gapcert.testing import multisine, write_csv

HERE = Path(__file__).parent
PERIOD, SECONDS = 0.005, 24.0


def pendulum() -> gc.Backend:
    registry = gc.registry()
    options = {
        "kind": "pybullet",
        "robot": "models/pendulum.urdf",
        "states": {"theta": "hinge.position", "theta_dot": "hinge.velocity"},
        "inputs": {"torque": "hinge"},
        "period": f"{PERIOD} s",
    }
    config = registry.config("backend", "pybullet")
    assert config is not None
    backend: gc.Backend = registry.build("backend", "pybullet", config(**options), gc.Context(HERE.parent))
    return backend


def main() -> None:
    torque = np.round(multisine(SECONDS, PERIOD, 2.5, (0.2, 1.4), seed=4), 4)
    recording = hide(pendulum(), x0=[0.3, 0.0], u=torque, noise={"theta": 5e-4}, seed=11)
    write_csv(recording, HERE / "pendulum_hidden.csv", digits=7)


if __name__ == "__main__":
    main()
