"""One Python file and its tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gapcert.plugin import npz_bytes, write_atomic
from gapcert_cells.automaton_controller import AutomatonController
from gapcert_cells.input_choice import efforts

from . import standalone
from .parts import Exported, memory_tables, parts_of


def write_numpy(controller: Exported, out: Path) -> list[Path]:
    """`controller.py` and `controller.npz`."""
    parts, stay = parts_of(controller), controller.goal.stay
    one = parts[0]
    held = np.empty((2, 0)) if one.held is None else np.array([one.held.low, one.held.high])
    tables: dict[str, npt.NDArray[Any]] = {f"edges{j}": e for j, e in enumerate(one.edges)}
    tables |= {"points": one.points, "efforts": efforts(one.points), "held": held}
    tables |= {"stay": np.array([stay.low, stay.high])}
    program, data = out / "controller.py", out / "controller.npz"
    write_atomic(program, Path(standalone.__file__).read_bytes())
    tables |= {
        "bits": np.stack([part.bits for part in parts]),
        "values": np.stack([part.values for part in parts]),
        "on": np.array(one.on),
        "angle": np.array([a.kind == "angle" for a in stay.axes]),
        "states": np.array(stay.names),
        "digest": np.array(controller.digest()),
    }
    tables |= memory_tables(controller) if isinstance(controller, AutomatonController) else {}
    if one.splits is not None:
        tables |= {"splits": one.splits.first, "halvings": np.array(one.splits.levels)}
    write_atomic(data, npz_bytes(tables, compress=True))
    return [program, data]
