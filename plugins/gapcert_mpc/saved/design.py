"""What a controller is made of, as numbers, and how a file has them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, final

import numpy as np

from gapcert import Array
from gapcert_mpc.program.corridors import Scene
from gapcert_mpc.program.linearise import Frame, Stages
from gapcert_mpc.program.program import Program, Rows, Weights
from gapcert_mpc.program.soft_constraints import Preferred
from gapcert_mpc.program.tube import Section
from gapcert_mpc.program.tuning import Tuning
from gapcert_mpc.tracking import Course
from gapcert_mpc.variants.arrival import Pool
from gapcert_mpc.variants.terminal_boxes import Ends


@final
@dataclass(frozen=True)
class Design:
    """Everything that a step is made of, as numbers in the frame."""

    frame: Frame
    stages: Stages
    section: Section
    rows: Rows
    weights: Weights
    reference: Array
    tolerance: float
    successive: bool = False
    tuning: Tuning = field(default_factory=Tuning)
    scene: Scene | None = None
    pool: Pool | None = None
    ends: Ends | None = None
    rates: Array | None = None
    course: Course | None = None
    soft: Preferred | None = None

    def program(self) -> Program:
        parts = self.stages, self.section, self.rows, self.weights, self.tolerance, self.successive
        given = self.scene or self.ends
        made = Program(*parts, given is None, None if given is None else given.F, self.rates, self.soft)
        made.aim(self.reference[: self.frame.nx], self.reference[self.frame.nx :])
        return made

    def arrays(self) -> dict[str, Array]:
        """Flat, for a file."""
        out: dict[str, Array] = {"reference": self.reference, "tolerance": np.array(self.tolerance)}
        out["successive"] = np.array(self.successive)
        if self.rates is not None:
            out["rates"] = self.rates
        for name in ("frame", "stages", "section", "rows", "weights", "tuning", "scene", "pool", "ends", "course", "soft"):
            if (part := getattr(self, name)) is None:
                continue
            out |= {f"{name}.{f.name}": np.asarray(getattr(part, f.name)) for f in fields(part)}
        return out

    @classmethod
    def of(cls, arrays: Mapping[str, Array]) -> Design:
        """Inverse of `arrays`."""

        def made(name: str, kind: Any) -> Any:
            return kind(**{f.name: np.asarray(arrays[f"{name}.{f.name}"]) for f in fields(kind)})

        frame = Frame(arrays["frame.middle"], arrays["frame.half"], int(arrays["frame.nx"]))
        parts = made("stages", Stages), made("section", Section), made("rows", Rows), made("weights", Weights)
        tuning = Tuning(float(arrays["tuning.rho"]), float(arrays["tuning.alpha"]), np.asarray(arrays["tuning.pieces"]))
        scalars = float(arrays["tolerance"]), bool(arrays["successive"])
        found = cls(frame, *parts, np.asarray(arrays["reference"]), *scalars, tuning)
        if "rates" in arrays:
            found = replace(found, rates=np.asarray(arrays["rates"]))
        if "course.first" in arrays:
            found = replace(found, course=made("course", Course))
        if "soft.axis" in arrays:
            found = replace(found, soft=made("soft", Preferred))
        if "ends.F" in arrays:
            return replace(found, ends=made("ends", Ends))
        return replace(found, scene=made("scene", Scene), pool=made("pool", Pool)) if "scene.low" in arrays else found
