"""A recording cut into windows: the units of a calibration on measurements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Domain, Model, Recording, UsageError
from gapcert_monitor import Certified
from gapcert_recordings import Transitions

Index = npt.NDArray[np.intp]
CALLER = "calibration"


@final
@dataclass(frozen=True)
class Windows:
    """Transitions in Z: when they begin (n,) in s, z (n, nz), r (n, nx), and the number of the window that each lies in (n,).

    Of `rows` rows, `skipped` begin no transition, and `outside` begin one that is outside Z or in no whole window.
    """

    t: Array
    z: Array
    r: Array
    window: Index
    rows: int
    skipped: int
    outside: int

    def __len__(self) -> int:
        """How many windows there are."""
        return len(np.unique(self.window))

    @property
    def unused(self) -> dict[str, int]:
        """The rows of which nothing is said, by reason."""
        return {"all": self.rows, "no_transition": self.skipped, "outside": self.outside}

    def of(self, windows: Index) -> Windows:
        rows = np.isin(self.window, windows)
        own = self.t[rows], self.z[rows], self.r[rows], self.window[rows]
        return Windows(*own, self.rows, self.skipped, self.outside)

    @classmethod
    def cut(cls, model: Model, recording: Recording, domain: Domain, length: float | None) -> Windows:
        """Transitions that begin in Z and lie in one whole window; windows are numbered among those that have any.

        length: in s; None: a whole trajectory. UsageError where no transition is left.
        """
        steps = Transitions.of(model, recording, CALLER)
        if length is not None and not length >= model.period:
            raise UsageError(f"{CALLER}: window = {length} s; expected at least the period of {model.period:g} s")
        number, keep = np.zeros(len(steps), dtype=np.int64), np.ones(len(steps), dtype=bool)
        if length is not None:
            ends = [(float(np.nanmin(tr.t)), float(np.nanmax(tr.t))) for tr in recording.trajectories]
            first, last = (np.array(side)[steps.trajectory] for side in zip(*ends, strict=True))
            slack = 1e-9 * length
            number = np.floor((steps.t - first + slack) / length).astype(np.int64)
            begin = first + number * length
            keep = (steps.t + model.period <= begin + length + slack) & (begin + length <= last + slack)
        known = Certified(model, domain.zone, lambda z: (z, z))
        z = known.points(steps.x, steps.u)
        whole = int(keep.sum())
        keep &= domain.contains(z)
        if not keep.any():
            short = f"no trajectory is as long as a window of {length} s; take shorter ones"
            away = "no transition of a whole window begins in the domain; take a larger one"
            raise UsageError(f"{CALLER}: {away if whole else short}")
        _, which = np.unique(np.stack([steps.trajectory, number], axis=1)[keep], axis=0, return_inverse=True)
        r = known.residual(steps.x[keep], steps.u[keep], steps.x_next[keep])
        left = int((~keep).sum())
        index = np.asarray(which, dtype=np.intp).reshape(-1)
        return cls(steps.t[keep], z[keep], r, index, len(steps) + steps.skipped, steps.skipped, left)
