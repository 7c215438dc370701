"""Measured trajectories: validated when they are made, and split before anything is fitted."""

from __future__ import annotations

import difflib
import functools
import itertools
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np

from gapcert.errors import UsageError
from gapcert.system import Array

SHORTEST = 16  # samples: below this no noise floor can be estimated
JITTER = 1e-3  # of the sampling period


@final
@dataclass(frozen=True)
class Trajectory:
    """One uninterrupted measurement: times t (T,) in s, strictly increasing, and named channels (T,) each.

    Inputs are held from one sample to the next: u[k] acts on [t[k], t[k + 1]).
    """

    t: Array
    channels: Mapping[str, Array]
    name: str = "0"

    def __post_init__(self) -> None:
        where = f"recording: trajectory '{self.name}'"
        if self.t.ndim != 1 or len(self.t) < SHORTEST:
            raise UsageError(f"{where} has {self.t.size} samples; at least {SHORTEST} are needed; record for longer")
        for name, values in {"time": self.t, **self.channels}.items():
            if values.shape != self.t.shape:
                raise UsageError(f"{where}: '{name}' has shape {values.shape}; expected {self.t.shape}, one number per time")
            if not np.isfinite(values).all():
                row = int(np.flatnonzero(~np.isfinite(values))[0])
                raise UsageError(
                    f"{where}: '{name}' is {values[row]} in row {row}; expected a finite number; remove or repair it"
                )
        if (steps := np.diff(self.t)).min() <= 0:
            row = int(np.argmax(steps <= 0)) + 1
            what = "stands still" if steps[row - 1] == 0 else "runs backwards"
            raise UsageError(
                f"{where}: time {what} in row {row} ({self.t[row - 1]:.9g} s, then {self.t[row]:.9g} s); expected increasing "
                "times; sort the rows, or name the column that tells trajectories apart as `trajectory`"
            )

    def __len__(self) -> int:
        return len(self.t)

    def part(self, start: int, stop: int) -> Trajectory:
        """Samples start ≤ k < stop."""
        return replace(self, t=self.t[start:stop], channels={n: v[start:stop] for n, v in self.channels.items()})


@final
@dataclass(frozen=True)
class Recording:
    """Trajectories with the same channels. `units` names the unit of a channel where it is not the model's own."""

    trajectories: tuple[Trajectory, ...]
    units: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.trajectories:
            raise UsageError("recording: there is no trajectory; name at least one file with rows")
        for trajectory in self.trajectories[1:]:
            if set(trajectory.channels) != set(self.names):
                raise UsageError(
                    f"recording: trajectory '{trajectory.name}' has channels {sorted(trajectory.channels)}, "
                    f"the first one {sorted(self.names)}; give all of them the same"
                )

    @classmethod
    def of(cls, t: Array, channels: Mapping[str, Array], units: Mapping[str, str] | None = None) -> Recording:
        """One trajectory from arrays."""
        arrays = {n: np.asarray(v, dtype=np.float64) for n, v in channels.items()}
        return cls((Trajectory(np.asarray(t, dtype=np.float64), arrays),), units or {})

    @classmethod
    def from_columns(
        cls,
        tables: Sequence[tuple[str, Mapping[str, Array]]],
        *,
        time: str,
        columns: Mapping[str, str],
        units: Mapping[str, str] | None = None,
        trajectory: str | None = None,
    ) -> Recording:
        """From named tables of columns, as readers find them.

        columns: channel → column; units: column → unit; trajectory: a column whose value changes between trajectories.
        """
        units = units or {}
        _known("units", units, columns.values(), "is not one of the columns read")
        found = []
        for name, table in tables:
            wanted = [time, *columns.values(), *([trajectory] if trajectory else [])]
            _known(f"recording: {name}", wanted, table, "is not a column")
            length = len(table[time])
            label = np.asarray(table[trajectory]) if trajectory else np.zeros(length)
            cuts = [0, *(np.flatnonzero(label[1:] != label[:-1]) + 1).tolist(), length]
            for start, stop in itertools.pairwise(cuts):
                title = f"{label[start]}" if trajectory else name
                channels = {c: _numbers(name, column, table[column])[start:stop] for c, column in columns.items()}
                found.append(Trajectory(_numbers(name, time, table[time])[start:stop], channels, title))
        return cls(tuple(found), {c: units[column] for c, column in columns.items() if column in units})

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.trajectories[0].channels)

    @functools.cached_property
    def period(self) -> float:
        """The sampling period in s; UsageError where the times are not evenly spaced to within 1e-3 of it."""
        period = float(np.median(np.concatenate([np.diff(tr.t) for tr in self.trajectories])))
        for trajectory in self.trajectories:
            off = np.abs(np.diff(trajectory.t) - period)
            if (late := off > JITTER * period).any():
                row = int(np.argmax(late)) + 1
                raise UsageError(
                    f"recording: trajectory '{trajectory.name}' is not evenly sampled: row {row} is {off[row - 1]:.3g} s off "
                    f"a period of {period:.6g} s; expected less than {JITTER * period:.1g} s; resample it to even times"
                )
        return period

    def split(self, hold_out: Mapping[str, Any]) -> tuple[Recording, Recording]:
        """(for fitting, held out). `{last: share}` takes the end of each trajectory, `{trajectories: [name, …]}` whole ones."""
        if set(hold_out) == {"last"}:
            fraction = _fraction(hold_out["last"])
            cuts = [(tr, round(len(tr) * (1 - fraction))) for tr in self.trajectories]
            return self._with(tr.part(0, k) for tr, k in cuts), self._with(tr.part(k, len(tr)) for tr, k in cuts)
        if set(hold_out) == {"trajectories"}:
            names = [str(n) for n in hold_out["trajectories"]]
            _known("hold_out", names, [tr.name for tr in self.trajectories], "is not a trajectory")
            kept = [tr for tr in self.trajectories if tr.name not in names]
            if not names or not kept:
                count = f"{len(names)} of {len(self.trajectories)} trajectories"
                raise UsageError(f"hold_out: {count}; expected at least one on either side; name fewer or more")
            return self._with(kept), self._with(tr for tr in self.trajectories if tr.name in names)
        raise UsageError(f"hold_out: found {dict(hold_out)}; expected {{last: 25 %}} or {{trajectories: [name, …]}}")

    def converted(self, units: Mapping[str, str]) -> Recording:
        """With channels in the given units (channel → unit); UsageError where a dimension does not fit."""
        factors = {n: _factor(n, self.units[n], to) for n, to in units.items() if self.units.get(n, to) != to}
        if not factors:
            return self

        def convert(tr: Trajectory) -> Trajectory:
            return replace(tr, channels={n: v * factors[n] if n in factors else v for n, v in tr.channels.items()})

        return Recording(tuple(map(convert, self.trajectories)), {**self.units, **units})

    def _with(self, trajectories: Any) -> Recording:
        return replace(self, trajectories=tuple(trajectories))


class Reader(ABC):
    """A file format: what a plugin of kind `reader` implements, built by `from_config(config, context)`."""

    @abstractmethod
    def read(self) -> Recording:
        """The recording; UsageError names the file where it is missing or cannot be understood."""


def _fraction(value: Any) -> float:
    text = str(value).strip()
    try:
        fraction = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        fraction = np.nan
    if not 0 < fraction < 1:
        raise UsageError(f"hold_out: last = {value}; expected a fraction between 0 and 1, such as 25 %")
    return fraction


def _known(where: str, wanted: Any, known: Any, problem: str) -> None:
    known = [str(k) for k in known]
    for name in wanted:
        if str(name) not in known:
            near = difflib.get_close_matches(str(name), known, 1)
            hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(sorted(known))}"
            raise UsageError(f"{where}: '{name}' {problem}; {hint}")


def _numbers(table: str, column: str, values: Any) -> Array:
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise UsageError(f"recording: {table}: column '{column}' does not hold numbers; expected one number per row") from None


def _factor(channel: str, unit: str, to: str) -> float:
    from gapcert.spec.units import magnitude

    try:
        return magnitude(f"1 {unit}", to)
    except ValueError as error:
        raise UsageError(f"recording: '{channel}': {error}; give the column's unit, of that dimension") from None
