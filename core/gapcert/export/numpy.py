"""One Python file and its tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gapcert.control import GridController
from gapcert.export import standalone
from gapcert.policies import efforts
from gapcert.sampling import npz_bytes, write_atomic


def write_numpy(controller: GridController, out: Path) -> list[Path]:
    """`controller.py` and `controller.npz`."""
    stay = controller.goal.stay
    held = np.empty((2, 0)) if controller.held is None else np.array([controller.held.low, controller.held.high])
    tables: dict[str, npt.NDArray[Any]] = {f"edges{j}": e for j, e in enumerate(controller.edges)}
    tables |= {"points": controller.points, "efforts": efforts(controller.points), "held": held}
    tables |= {"stay": np.array([stay.low, stay.high])}
    program, data = out / "controller.py", out / "controller.npz"
    write_atomic(program, Path(standalone.__file__).read_bytes())
    tables |= {
        "bits": controller.bits,
        "values": controller.values,
        "on": np.array(controller.on),
        "angle": np.array([a.kind == "angle" for a in stay.axes]),
        "states": np.array(stay.names),
        "digest": np.array(controller.digest()),
    }
    write_atomic(data, npz_bytes(tables, compress=True))
    return [program, data]
