"""What a controller is made of, as numbers, and how a file has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, final, get_args, get_type_hints

import numpy as np

from gapcert.plugin import Array
from gapcert_mpc.program.corridors import Scene
from gapcert_mpc.program.linearise import Frame, Stages
from gapcert_mpc.program.program import Preferred, Program, Rows, Weights
from gapcert_mpc.program.tube import Section
from gapcert_mpc.program.tuning import Tuning

from .plans import Pool


@final
@dataclass(frozen=True)
class Course:
    """Steady references (T, n+m) in the frame, each wanted from its `first` (T,) step of a run on; the first of these is 0."""

    first: Array
    references: Array

    def ahead(self, step: int, count: int) -> Array:
        """(count, n+m): what is wanted at this step of a run and at those that follow."""
        return np.asarray(self.references[np.searchsorted(self.first, step + np.arange(count), side="right") - 1])

    def shown(self, frame: Frame, names: Sequence[str], period: float) -> list[dict[str, float]]:
        """JSON-able: each reference in its units, with the time `from` which it is wanted, in s."""
        at = [dict(zip(names, frame.out(z).tolist(), strict=True)) for z in self.references]
        return [{"from": step * period, **z} for step, z in zip(self.first.tolist(), at, strict=True)]


@final
@dataclass(frozen=True)
class Ends:
    """boxes (k, 2, n): [low, high] in the frame, the one that is wanted most first; F as in `Program`."""

    boxes: Array
    F: Array


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
        for part in fields(self):
            if is_dataclass(value := getattr(self, part.name)):
                out |= {f"{part.name}.{f.name}": np.asarray(getattr(value, f.name)) for f in fields(value)}
        return out

    @classmethod
    def of(cls, arrays: Mapping[str, Array]) -> Design:
        """Inverse of `arrays`."""

        def read(name: str) -> Any:
            value = np.asarray(arrays[name])
            return value if value.ndim else value.item()

        there, found = {name.partition(".")[0] for name in arrays}, dict[str, Any]()
        for part in fields(cls):
            if part.default is None and part.name not in there:
                continue
            kind = PARTS.get(part.name)
            parts = {} if kind is None else {f.name: read(f"{part.name}.{f.name}") for f in fields(kind)}
            found[part.name] = read(part.name) if kind is None else kind(**parts)
        return cls(**found)


PARTS: dict[str, Any] = {
    name: kind for name, of in get_type_hints(Design).items() for kind in get_args(of) or (of,) if is_dataclass(kind)
}
"""Those that are several arrays."""
