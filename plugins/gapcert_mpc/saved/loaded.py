"""Controllers from what they have saved."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gapcert import Goal, UsageError
from gapcert_cells import loading
from gapcert_mpc.program.linearise import Nominal

from .saved_models import known

if TYPE_CHECKING:
    from gapcert_mpc.controller import MpcController
    from gapcert_mpc.variants.adaptive import AdaptiveMpcController
    from gapcert_mpc.variants.disturbance import DisturbanceMpcController


def loaded(
    kind: type[MpcController], folder: Path, nominal: Nominal | None
) -> MpcController | DisturbanceMpcController | AdaptiveMpcController:
    """See `MpcController.load`."""
    from gapcert_mpc.controller import Design

    with loading(folder) as (data, arrays):
        design = Design.of({k: arrays[k] for k in arrays.files}) if arrays.files else None
        if design is not None and design.ends is not None:
            raise UsageError(f"{folder}: where its plans end another controller takes over; load it with load_controller")
        goal, levels = Goal.from_data(data["goal"]), None
        told: Mapping[str, Any] | None = known(data["kept"], arrays) if data.get("kept") else None
        if told is not None and "adapt" in data:
            from gapcert_mpc.variants.adaptive import Levels

            levels = Levels.again(told, goal, data["adapt"])
        asks = design is not None and design.successive
        if asks and nominal is None:
            if told is None:
                raise UsageError(
                    f"{folder}: this controller linearises its model at every step, and its model or gap could not be saved as "
                    f"data; give both as MpcController.load(folder, Nominal(model, gap))"
                )
            # Of parameters the first controller's model is the one in the middle of their range.
            own = told if levels is None else vars(levels.family.within(levels.family.range))
            nominal = Nominal(own["model"], own["gap"])
        fixed = kind(goal, design, data["evidence"], data["solver"], nominal=nominal if asks else None)
        made: MpcController | DisturbanceMpcController | AdaptiveMpcController = fixed
        if levels is not None:
            made = levels.begun(fixed)
        if data.get("feedback") == "disturbance" and design is not None:
            from gapcert_mpc.variants.disturbance import DisturbanceMpcController

            made = DisturbanceMpcController(fixed)
    if made.digest() != data.get("digest"):
        raise UsageError(f"{folder}: controller.npz and controller.json do not belong together; synthesize it again")
    return made
