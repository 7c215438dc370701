"""Measured trajectories as they were logged, flaws included, and split before anything is fitted."""

from __future__ import annotations

import difflib
import functools
import hashlib
import itertools
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, final

import numpy as np

from gapcert.contracts.data.units import magnitude, stated_units
from gapcert.contracts.thresholds import THRESHOLDS
from gapcert.numerics.arrays import Array
from gapcert.numerics.errors import UsageError, clipped

Place = Callable[[str, int], str]
"""(name of a table, row counted from 0) → where that row stands, in words."""
LACKING = frozenset({"", "na", "n/a", "#n/a", "nan", "null", "none"})
"""Texts that stand for a value that is missing."""


def as_numbers(values: Any) -> Array | None:
    """A column (n,) as numbers, with NaN for what is missing (None, empty, `NA`, `NaN`); None where it holds anything else."""
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        if first_text(values) is not None:
            return None
        return np.array([np.nan if _lacking(v) else float(v) for v in values])


def first_text(values: Any) -> tuple[int, str] | None:
    """(row counted from 0, the value) of the first that is neither a number nor missing."""
    for row, value in enumerate(values):
        if _lacking(value):
            continue
        try:
            float(value)
        except (TypeError, ValueError):
            return row, clipped(str(value), longest=40)[0]
    return None


def counted(table: str, row: int) -> str:
    """Where a row stands, of a file that has no lines."""
    return f"row {row + 1}"


def _lacking(value: Any) -> bool:
    return value is None or (isinstance(value, str) and value.strip().lower() in LACKING)


SHORTEST = 16  # samples: below this no noise floor can be estimated
Hold = Literal["zero", "first"]
HELD = ("diagnose", "hold_out")  # where a spec says what is held out


@final
@dataclass(frozen=True)
class Trajectory:
    """One measurement as logged: times t (T,) in s and named channels (T,) each.

    NaN stands for what is missing; times may be uneven, jump, or start again. A diagnosis repairs that, and says so.
    """

    t: Array
    channels: Mapping[str, Array]
    name: str = "0"

    def __post_init__(self) -> None:
        where = f"recording: trajectory '{self.name}'"
        if self.t.size == 0:
            raise UsageError(f"{where} has no rows; expected at least {SHORTEST} samples; see whether the log was written")
        if self.t.ndim != 1 or len(self.t) < SHORTEST:
            count = f"{self.t.size} sample{'s' * (self.t.size != 1)}"
            raise UsageError(f"{where} has {count}; at least {SHORTEST} are needed; record for longer")
        for name, values in {"time": self.t, **self.channels}.items():
            if values.shape != self.t.shape:
                raise UsageError(f"{where}: '{name}' has shape {values.shape}; expected {self.t.shape}, one number per time")
            if not np.isfinite(values).any():
                raise UsageError(f"{where}: '{name}' holds no finite number; expected measurements; leave the channel out")

    def __len__(self) -> int:
        return len(self.t)

    def part(self, start: int, stop: int) -> Trajectory:
        """Samples start ≤ k < stop."""
        return replace(self, t=self.t[start:stop], channels={n: v[start:stop] for n, v in self.channels.items()})

    @property
    def period(self) -> float:
        """The median time from one sample to the next, in s."""
        steps = np.diff(self.t)
        return float(np.median(steps[steps > 0])) if (steps > 0).any() else np.nan


@final
@dataclass(frozen=True)
class Recording:
    """Trajectories with the same channels. `units` names the unit of a channel where it is not the model's own.

    hold: how inputs go on from one sample to the next: held (`zero`) or in a straight line (`first`); None: not known.
    every: the period in s to which a diagnosis resamples. noise: how exact channels are, in their units, where that is known
    beforehand (a simulator's resolution); then values are taken as they are. Empty: the noise floor is estimated.
    """

    trajectories: tuple[Trajectory, ...]
    units: Mapping[str, str] = field(default_factory=dict)
    hold: Hold | None = None
    every: float | None = None
    noise: Mapping[str, float] = field(default_factory=dict)

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
    def of(
        cls,
        t: Array,
        channels: Mapping[str, Array],
        units: Mapping[str, str] | None = None,
        *,
        hold: Hold | None = None,
        every: float | None = None,
    ) -> Recording:
        """One trajectory from arrays."""
        arrays = {n: np.asarray(v, dtype=np.float64) for n, v in channels.items()}
        return cls((Trajectory(np.asarray(t, dtype=np.float64), arrays),), units or {}, hold, every)

    @classmethod
    def from_columns(
        cls,
        tables: Sequence[tuple[str, Mapping[str, Array]]],
        *,
        time: str,
        columns: Mapping[str, str],
        units: Mapping[str, str] | None = None,
        trajectory: str | None = None,
        hold: Hold | None = None,
        every: float | None = None,
        place: Place = counted,
        units_in_names: bool = True,
    ) -> Recording:
        """From named tables of columns, as readers find them.

        columns: channel → column; units: column → unit, the time's too; units_in_names: by default it is what the name ends in;
        trajectory: a column whose value changes between trajectories; place: (table, row) → where it stands, for a value that
        is no number. Times since an epoch are counted from the first.
        """
        units = {**(stated_units([time, *columns.values()]) if units_in_names else {}), **(units or {})}
        places = {n: ("units", n) for n in units}
        if (channel := next((n for n in units if n in columns and n not in (time, *columns.values())), None)) is not None:
            what = f"units: '{channel}' is a channel, and units are those of columns; write '{columns[channel]}'"
            raise UsageError(f"recording: {what}", ("recording", "units", channel))
        _known("recording: units", places, [time, *columns.values()], "is not one of the columns read")
        wanted: dict[str, tuple[str, ...]] = {column: ("columns", channel) for channel, column in columns.items()}
        wanted = {time: ("time",), **wanted, **({trajectory: ("trajectory",)} if trajectory else {})}
        found = []
        for name, table in tables:
            _known(f"recording: {name}", wanted, table, "is not a column")
            t = seconds(name, time, table[time], units.get(time, "s"), place)
            label = np.asarray(table[trajectory]) if trajectory else np.zeros(len(t))
            cuts = [0, *(np.flatnonzero(label[1:] != label[:-1]) + 1).tolist(), len(t)]
            whole = {c: _numbers(name, column, table[column], place, ("columns", c)) for c, column in columns.items()}
            for start, stop in itertools.pairwise(cuts):
                title = f"{label[start]}" if trajectory else name
                found.append(Trajectory(t[start:stop], {c: v[start:stop] for c, v in whole.items()}, title))
        return cls(tuple(found), {c: units[column] for c, column in columns.items() if column in units}, hold, every)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.trajectories[0].channels)

    @functools.cached_property
    def period(self) -> float:
        """The sampling period in s: `every`, or the median of all steps."""
        steps = np.concatenate([np.diff(tr.t) for tr in self.trajectories])
        if not (steps > 0).any():
            raise UsageError("recording: time never goes forward; name the column that counts the seconds as `time`")
        return self.every or float(np.median(steps[steps > 0]))

    def split(self, hold_out: Mapping[str, Any], train: Mapping[str, Any] | None = None) -> tuple[Recording, Recording]:
        """(for fitting, held out). `{last: share}` takes the end of each trajectory, `{trajectories: [name, …]}` whole ones.

        `{from: s, to: s}` takes what was measured in that time; either may be left out. `{every: n, first: k}` takes the
        trajectories k, k + n, k + 2 n, … counted from 0. train: the same of whole trajectories, of which those that are not
        held out are fitted; the rest takes no part.
        """
        if train is not None:
            return self._chosen(train, "train")._without(self._chosen(hold_out, "hold_out")), self._chosen(hold_out, "hold_out")
        if set(hold_out) <= {"every", "first"} and "every" in hold_out:
            return self._without(self._chosen(hold_out, "hold_out")), self._chosen(hold_out, "hold_out")
        if set(hold_out) == {"last"}:
            fraction = _fraction(hold_out["last"])
            cuts = [(tr, round(len(tr) * (1 - fraction))) for tr in self.trajectories]
            return self._with(tr.part(0, k) for tr, k in cuts), self._with(tr.part(k, len(tr)) for tr, k in cuts)
        if hold_out and set(hold_out) <= {"from", "to"}:
            return self._block(_bound(hold_out.get("from", -np.inf)), _bound(hold_out.get("to", np.inf)))
        if set(hold_out) == {"trajectories"}:
            names = [str(n) for n in hold_out["trajectories"]]
            _known("hold_out", names, [tr.name for tr in self.trajectories], "is not a trajectory")
            kept = [tr for tr in self.trajectories if tr.name not in names]
            if not names or not kept:
                count = f"{len(names)} of {len(self.trajectories)} trajectories"
                raise UsageError(f"hold_out: {count}; expected at least one on either side; name fewer or more", HELD)
            return self._with(kept), self._with(tr for tr in self.trajectories if tr.name in names)
        expected = "{last: 25 %}, {from: 10 s, to: 20 s}, {trajectories: [name, …]} or {every: 5}"
        raise UsageError(f"hold_out: found {dict(hold_out)}; expected {expected}", HELD)

    def _chosen(self, rule: Mapping[str, Any], where: str) -> Recording:
        """Whole trajectories, by name or by number."""
        if set(rule) == {"trajectories"}:
            names = [str(n) for n in rule["trajectories"]]
            _known(where, names, [tr.name for tr in self.trajectories], "is not a trajectory")
            return self._with(tr for tr in self.trajectories if tr.name in names)
        every, first = rule.get("every", 0), rule.get("first", 0)
        if not set(rule) <= {"every", "first"} or every < 1 or not 0 <= first < len(self.trajectories):
            expected = f"{{trajectories: [name, …]}} or {{every: n, first: k}} of {len(self.trajectories)} trajectories"
            raise UsageError(f"{where}: found {dict(rule)}; expected {expected}", ("diagnose", where))
        return self._with(self.trajectories[first::every])

    def _without(self, other: Recording) -> Recording:
        """The trajectories that are not among another's; UsageError where none is left."""
        taken = {id(tr) for tr in other.trajectories}
        kept = [tr for tr in self.trajectories if id(tr) not in taken]
        if not kept:
            what = f"hold_out: all {len(self.trajectories)} trajectories"
            raise UsageError(f"{what}; expected some for the fit; hold out fewer", HELD)
        return self._with(kept)

    def _block(self, low: float, high: float) -> tuple[Recording, Recording]:
        """Stretches outside and inside low ≤ t < high; those too short to be of use go to neither."""
        sides: tuple[list[Trajectory], list[Trajectory]] = [], []
        for tr in self.trajectories:
            inside = (tr.t >= low) & (tr.t < high)
            cuts = [0, *(np.flatnonzero(inside[1:] != inside[:-1]) + 1).tolist(), len(tr)]
            for start, stop in itertools.pairwise(cuts):
                if stop - start >= SHORTEST:
                    name = tr.name if stop - start == len(tr) else f"{tr.name} from {tr.t[start]:.6g} s"
                    sides[int(inside[start])].append(replace(tr.part(start, stop), name=name))
        if not sides[0] or not sides[1]:
            t = np.concatenate([tr.t for tr in self.trajectories])
            span = f"the recording goes from {np.nanmin(t):.6g} to {np.nanmax(t):.6g} s"
            what = "hold_out: " + " ".join(f"{w} {e:g} s" for w, e in (("from", low), ("to", high)) if np.isfinite(e))
            raise UsageError(f"{what}; expected at least {SHORTEST} samples on either side; {span}", HELD)
        return self._with(sides[0]), self._with(sides[1])

    def led_up(self, part: Recording) -> tuple[Recording, tuple[float, ...]]:
        """(the trajectories of a part with what was measured before them, when each part begins in s).

        A model with memory needs that past. Where time goes back, there is none.
        """
        whole, since = [], []
        for tr in part.trajectories:
            source = next((s for s in self.trajectories if tr.name == s.name or tr.name.startswith(f"{s.name} from ")), tr)
            end = int(np.searchsorted(source.t, tr.t[-1], "right")) if bool((np.diff(source.t) >= 0).all()) else 0
            whole.append(replace(source.part(0, end), name=tr.name) if end >= len(tr) else tr)
            since.append(float(tr.t[0]))
        return self._with(whole), tuple(since)

    def digest(self) -> str:
        """SHA-256 of times and channels, in order."""
        total = hashlib.sha256(json.dumps([sorted(self.units.items()), self.hold]).encode())
        for tr in self.trajectories:
            for name, values in (("", tr.t), *sorted(tr.channels.items())):
                total.update(f"{name}:{len(values)}:".encode() + np.ascontiguousarray(values, dtype=np.float64).tobytes())
        return total.hexdigest()

    def converted(self, units: Mapping[str, str]) -> Recording:
        """With channels in the given units (channel → unit); UsageError where a dimension does not fit."""
        factors = {n: _factor(n, self.units[n], to) for n, to in units.items() if self.units.get(n, to) != to}
        if not factors:
            return self

        def convert(tr: Trajectory) -> Trajectory:
            return replace(tr, channels={n: v * factors[n] if n in factors else v for n, v in tr.channels.items()})

        noise = {n: e * factors.get(n, 1.0) for n, e in self.noise.items()}
        return replace(self, trajectories=tuple(map(convert, self.trajectories)), units={**self.units, **units}, noise=noise)

    def _with(self, trajectories: Any) -> Recording:
        return replace(self, trajectories=tuple(trajectories))


class Reader(ABC):
    """A file format: what a plugin of kind `reader` implements, built by `from_config(config, context)`.

    suffixes: of the files that it understands; `tables` lists what is in one, for a look before anything is configured;
    units_in_names: is what a column's name has in brackets at its end its unit, `speed [m/s]`, and no element's name?
    """

    suffixes: ClassVar[tuple[str, ...]] = ()
    units_in_names: ClassVar[bool] = True

    @abstractmethod
    def read(self) -> Recording:
        """The recording; UsageError names the file where it is missing or cannot be understood."""

    @classmethod
    def tables(cls, path: Path) -> Sequence[tuple[str, Mapping[str, Any]]]:
        """All columns of a file, as (name of the table, {column: values}); none where the format is another one."""
        return ()

    @classmethod
    def place(cls, path: Path, row: int) -> str:
        """Where a row of a file, counted from 0, stands, in words."""
        return counted(path.name, row)


def _fraction(value: Any) -> float:
    text = str(value).strip()
    try:
        fraction = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        fraction = np.nan
    if not 0 < fraction < 1:
        what = f"hold_out: last = {value}"
        raise UsageError(f"{what}; expected a fraction between 0 and 1, such as 25 %", (*HELD, "last"))
    return fraction


def _bound(value: Any) -> float:
    try:
        return magnitude(value, "s")
    except ValueError as error:
        raise UsageError(f"hold_out: {error}; expected a time such as 10 s", HELD) from None


def _known(where: str, wanted: Any, known: Any, problem: str) -> None:
    known = [str(k) for k in known]
    for name in wanted:
        if str(name) not in known:
            near = difflib.get_close_matches(str(name), known, 1)
            hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(sorted(known))}"
            keys = ("recording", *wanted[name]) if isinstance(wanted, Mapping) else ("diagnose", where, "trajectories")
            raise UsageError(f"{where}: '{name}' {problem}; {hint}", keys)


def _numbers(table: str, column: str, values: Any, place: Place, at: tuple[str, ...] = ("time",)) -> Array:
    if (numbers := as_numbers(values)) is not None:
        return numbers
    row, text = first_text(values) or (0, "")
    what = f"column '{column}' holds '{text}' in {place(table, row)}; expected a number in every row"
    raise UsageError(f"recording: {table}: {what}; mend it, or leave it empty: it is missing then", ("recording", *at))


def seconds(table: str, column: str, values: Any, unit: str, place: Place = counted) -> Array:
    """Times in s; differences are formed in the column's own numbers, which may be nanoseconds since 1970."""
    raw = np.asarray(values)
    if raw.dtype.kind == "M":
        return np.asarray((raw - raw[0]) / np.timedelta64(1, "s"), dtype=np.float64)
    factor = _factor(column, unit, "s") if unit != "s" else 1.0
    numbers = raw.astype(np.int64) if raw.dtype.kind in "iu" else _numbers(table, column, values, place)
    finite = numbers[np.isfinite(numbers)]
    if len(finite) and float(finite[0]) * factor > THRESHOLDS.epoch:
        numbers = numbers - finite[0]
    return np.asarray(numbers, dtype=np.float64) * factor


def _factor(channel: str, unit: str, to: str) -> float:
    try:
        zero, one = (magnitude(f"{v} {unit}", to) for v in "01")
    except ValueError as error:
        what = f"recording: '{channel}': {error}; give the column's unit, of that dimension"
        raise UsageError(what, ("recording", "units", channel)) from None
    if zero != 0:
        what = f"recording: '{channel}' is in {unit}, whose zero is {zero:g} {to}"
        what = f"{what}; expected a unit that differs by a factor; convert the column first"
        raise UsageError(what, ("recording", "units", channel))
    return one
