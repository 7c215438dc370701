"""What causes buy on data that took no part: free rollouts over held-out stretches, before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, UsageError, difference
from gapcert_diagnosis.data.dataset import Dataset, Windows, once
from gapcert_diagnosis.results import Gain
from gapcert_diagnosis.thresholds import THRESHOLDS

from .fit import Fit, followed


@final
@dataclass(frozen=True)
class Stretches:
    """Held-out windows of one horizon; `lead` samples come first, from which each model finds its own start."""

    horizon: float
    lead: int
    windows: Windows
    _rolled: dict[int, tuple[Fit, Array, Array]] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def of(cls, held: Dataset, horizon: float, lead: float = THRESHOLDS.rollout_leads[-1]) -> Stretches:
        """`lead` in s, or less where the held-out data leave less beside the horizon."""
        length, least = held.samples(horizon), THRESHOLDS.lead_samples
        room = max(len(y) - held.first(i) for i, y in enumerate(held.outputs)) - length
        lead = max(least, min(held.samples(lead), room))
        longest = room - lead
        if horizon <= 0 or longest < 0:
            used, left = (
                (least + (0 if held.since else held.history)) * held.period,
                max((room + length - least) * held.period, 0.0),
            )
            raise UsageError(
                f"diagnose: a horizon of {horizon:g} s does not fit the held-out data: {used:.2g} s serve to find a start and "
                f"{left:.3g} s are left; expected a positive horizon up to that; shorten it or hold out more",
                ("diagnose", "horizons"),
            )
        return cls(horizon, lead, held.windows(lead + length, max(1, min(length // 2, longest // THRESHOLDS.rollout_starts))))

    @staticmethod
    def fits(held: Dataset, horizon: float) -> bool:
        """Do any of the data hold a rollout so long, behind the shortest lead?"""
        room = max(len(y) - held.first(i) for i, y in enumerate(held.outputs))
        return room - held.samples(horizon) >= THRESHOLDS.lead_samples

    def simulate(self, fitted: Fit) -> Array:
        """Outputs (W, H, ny) of free rollouts; each fit is rolled out once."""
        return self._known(fitted)[1]

    def start(self, fitted: Fit) -> Array:
        """Where its rollouts begin, (W, nx)."""
        return self._known(fitted)[2]

    def _known(self, fitted: Fit) -> tuple[Fit, Array, Array]:
        return once(self._rolled, id(fitted), lambda: (fitted, *self._simulated(fitted)))

    def _simulated(self, fitted: Fit) -> tuple[Array, Array]:
        """(outputs, starts); the search for starts begins where that of another fit ended, or at what was measured."""
        known = next((start for _, _, start in self._rolled.values()), None)
        led = followed(fitted.hypothesis, fitted.theta, self.windows.head(self.lead), known)
        y = led.hypothesis.simulate(self.windows, np.empty((1, 0)), led.start[None])[0, :, self.lead :]
        # A model that blows up over the horizon is as wrong as anything can be, and a comparison needs a number.
        return np.nan_to_num(y, nan=1e6, posinf=1e6, neginf=-1e6), led.start

    def squares(self, fitted: Fit) -> Array:
        """Mean squared error (W, ny) of every rollout and channel."""
        error = difference(self.windows.measured.channels, self.simulate(fitted), self.windows.y[:, self.lead :])
        most, seen = THRESHOLDS.blown_residual * self.windows.measured.spread, self.windows.weight[:, self.lead :]
        return np.asarray(np.sum(seen * np.clip(error, -most, most) ** 2, axis=1) / np.maximum(np.sum(seen, axis=1), 1))

    def blocks(self, fitted: Fit) -> Array:
        """E² of stretches that share no data, or of the rollouts, where there is one such stretch."""
        each, groups = np.mean(self.squares(fitted) / self.windows.measured.spread**2, axis=1), self._groups()
        return np.asarray(np.bincount(groups, each) / np.bincount(groups))

    def _groups(self) -> npt.NDArray[np.intp]:
        w = self.windows
        block = np.stack([w.trajectory, np.floor((w.t - w.t.min()) / self.horizon + 1e-9)], axis=-1)
        groups = np.unique(block, axis=0, return_inverse=True)[1].ravel()
        return groups if groups.max() else np.arange(len(w))

    def error(self, fitted: Fit) -> float:
        """E: root mean square over all channels, each divided by its standard deviation in the data."""
        return float(np.sqrt(np.mean(self.squares(fitted) / self.windows.measured.spread**2)))

    def floors(self, fitted: Fit) -> Array:
        """Root mean square error (ny,) in noise floors."""
        return np.asarray(np.sqrt(np.mean(self.squares(fitted), axis=0)) / self.windows.measured.sigma)

    def rms(self, fitted: Fit) -> dict[str, float]:
        """Root mean square error per channel."""
        errors = np.sqrt(np.mean(self.squares(fitted), axis=0))
        return dict(zip((c.name for c in self.windows.measured.channels), errors.tolist(), strict=True))

    def gains(self, before: Fit, after: Fit, seed: int) -> dict[str, Gain]:
        """Per channel. Overlapping rollouts are resampled together, so the interval does not count them twice."""
        old, new = self.squares(before), self.squares(after)
        groups = self._groups()
        count = int(groups.max()) + 1
        sums = np.stack([np.bincount(groups, column, count) for column in new.T], axis=-1)
        sizes = np.bincount(groups, minlength=count)
        drawn = np.random.default_rng(seed).integers(count, size=(THRESHOLDS.resamples, count))
        means = sums[drawn].sum(axis=1) / sizes[drawn].sum(axis=1)[:, None]
        low, high = np.sqrt(np.quantile(means, [0.025, 0.975], axis=0))
        rms = [np.sqrt(np.mean(a, axis=0)) for a in (old, new)]
        columns = np.stack([*rms, low, high])
        return {c.name: Gain(*map(float, columns[:, i])) for i, c in enumerate(self.windows.measured.channels)}


def stretches(held: Dataset, horizons: Sequence[float], fitted: Fit | None = None) -> tuple[Stretches, ...]:
    """One per horizon, shortest first.

    A short lead leaves the start to noise, a long one to what the model lacks: where a fit is given, the lead is the one with
    the least error on the data that it was made to.
    """
    return tuple(Stretches.of(held, h, _lead(h, fitted)) for h in sorted(horizons))


def _lead(horizon: float, fitted: Fit | None) -> float:
    if fitted is None:
        return THRESHOLDS.rollout_leads[-1]
    leads = {}
    for lead in THRESHOLDS.rollout_leads:
        try:
            leads[lead] = Stretches.of(fitted.windows.measured, horizon, lead).error(fitted)
        except UsageError:
            break  # too little was fitted for so long a horizon; what is held out may be longer
    return min(leads, key=lambda k: leads[k]) if leads else THRESHOLDS.rollout_leads[-1]
