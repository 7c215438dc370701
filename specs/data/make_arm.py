"""Makes arm_hidden.csv: MuJoCo's arm of two links with more damping in its shoulder and dry friction in its elbow, and noise of
1 % on both angles.
"""

from pathlib import Path

import numpy as np

import gapcert as gc
from gapcert.testing import multisine, write_csv

HERE = Path(__file__).parent
PERIOD, SECONDS, NOISE = 0.004, 12.0, 0.01
REAL = {"damping.shoulder": 0.25, "frictionloss.elbow": 0.12}


def arm() -> gc.Backend:
    registry = gc.registry()
    options = {
        "kind": "mujoco",
        "robot": "models/arm.xml",
        "states": {
            "shoulder": "shoulder.position",
            "elbow": "elbow.position",
            "shoulder_dot": "shoulder.velocity",
            "elbow_dot": "elbow.velocity",
        },
        "inputs": {"shoulder_torque": "shoulder", "elbow_torque": "elbow"},
        "period": f"{PERIOD} s",
        "substeps": 2,
    }
    config = registry.config("backend", "mujoco")
    assert config is not None
    backend: gc.Backend = registry.build("backend", "mujoco", config(**options), gc.Context(HERE.parent))
    return backend


def main() -> None:
    played = (3.5, (0.2, 1.6)), (0.9, (0.3, 2.4))
    u = np.round(np.hstack([multisine(SECONDS, PERIOD, *signal, seed=k) for k, signal in enumerate(played)]), 4)
    real = {name: np.array([value]) for name, value in REAL.items()}
    x = arm().rollout(np.array([[0.3, -0.2, 0.0, 0.0]]), u[None], parameters=real).x[0, :-1]
    rng = np.random.default_rng(12)
    measured = x[:, :2] + NOISE * x[:, :2].std(axis=0) * rng.standard_normal((len(u), 2))
    columns = {"shoulder": measured[:, 0], "elbow": measured[:, 1], "shoulder_torque": u[:, 0], "elbow_torque": u[:, 1]}
    write_csv(gc.Recording.of(np.arange(len(u)) * PERIOD, columns), HERE / "arm_hidden.csv", digits=6)


if __name__ == "__main__":
    main()
