"""Saved controllers as programs that need no Gapcert: C without libraries, or one Python file with NumPy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Answer, Arguments, Controller, UsageError, npz_bytes, write_atomic
from gapcert_cells.automaton_controller import AutomatonController
from gapcert_cells.grid_controller import GridController, efforts
from gapcert_cells.load import load_controller

from . import standalone
from .c import write_c
from .parts import Exported, cells_of, ends_of, memory_tables, parts_of, winning_of


def write_numpy(controller: Exported, out: Path) -> list[Path]:
    """`controller.py` and `controller.npz`."""
    parts, stay = parts_of(controller), controller.goal.stay
    one = parts[0]
    tables: dict[str, npt.NDArray[Any]] = {f"edges{j}": e for j, e in enumerate(one.edges)}
    tables |= {
        "points": one.points,
        "efforts": efforts(one.points),
        "held": np.empty((4, 0)) if one.held is None else np.array(ends_of(one.held)).T,
        "stay": np.array(ends_of(stay)).T,
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
    program, data = out / "controller.py", out / "controller.npz"
    write_atomic(program, Path(standalone.__file__).read_bytes())
    write_atomic(data, npz_bytes(tables, compress=True))
    return [program, data]


FORMS: dict[str, Callable[[Exported, Path], list[Path]]] = {"c": write_c, "numpy": write_numpy}


def find(folder: Path | str, which: str = "with_gamma") -> Controller:
    """The controller of a run folder, or the one saved in a folder itself."""
    folder = Path(folder)
    inner = folder / "controller" / which
    if not (folder / "controller.json").is_file() and not inner.is_dir():
        raise UsageError(
            f"{folder}: no controller '{which}'; give the folder of a run that made one, or one that holds controller.json"
        )
    return load_controller(inner if inner.is_dir() else folder)


def export(controller: Controller, to: str, out: Path | str) -> dict[str, Any]:
    """Write the controller into the folder `out` as `c` or `numpy`, and say what was written.

    Policies first, middle, last and least-effort go along, for NumPy random too; outside the domain C returns a code other
    than 0, and Python raises ValueError. One with a memory reads it and moves it on as the original does.
    """
    if to not in FORMS:
        raise UsageError(f"export: '{to}' is unknown; use one of {', '.join(FORMS)}")
    if not isinstance(controller, GridController | AutomatonController):
        raise UsageError(
            f"export: a controller of kind '{controller.kind}' has no form without Gapcert; expected one on cells, as the "
            f"synthesizer symbolic makes; use gapcert.load_controller where Gapcert runs"
        )
    parts, winning = parts_of(controller), winning_of(controller)
    if not winning:
        reason = controller.evidence.get("reason", "")
        raise UsageError(f"export: the controller's domain is empty{f' ({reason})' if reason else ''}; nothing was written")
    out = Path(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{out}: cannot be made ({error.strerror}); choose another folder with --out") from None
    files = FORMS[to](controller, out)
    return {
        "to": to,
        "files": [str(f) for f in files],
        "cells": cells_of(controller),
        "winning_cells": winning,
        **({"memories": len(parts)} if isinstance(controller, AutomatonController) else {}),
        "inputs": len(parts[0].points),
        "digest": controller.digest(),
    }


def command(options: Arguments) -> Answer:
    """`gapcert export`."""
    controller = find(options.run, "without_gamma" if options.without_gamma else "with_gamma")
    done = export(controller, options.to, options.out)
    return Answer(done, done["files"])
