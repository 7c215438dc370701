"""What is in a log, before anything is asked of it: rates, gaps, ranges and noise of every column."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, final

import numpy as np

from gapcert import Array, MissingDependency, Recording, StateSpec, Trajectory, UsageError
from gapcert.plugin import SHORTEST, Reader, as_numbers, first_text, harmless, seconds, stated_units

from .flaws import flaws
from .resampling import Log, pieces, readings

TIMES = ("t", "time", "timestamp", "(time)", "stamp", "times", "t_s", "time_s")
_WITH_UNIT = re.compile(r"(.*\S)\s*(?:\[\s*(s|ms|us|µs|ns)\s*\]|\(\s*(s|ms|us|µs|ns)\s*\))")


@final
@dataclass(frozen=True)
class Column:
    """One column: its values (n,), how many are missing or absurd, range, standard deviation, noise floor, the step of its
    values where they lie on a lattice, and what is wrong with its sensor, in words."""

    name: str
    values: Array
    missing: int
    outliers: int
    low: float
    high: float
    spread: float
    noise: float | None = None
    step: float | None = None
    unit: str = ""
    flaws: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """The name with the unit, which it may end in."""
        return f"{self.name} [{self.unit}]" if self.unit and not stated_units([self.name]) else self.name

    def facts(self) -> dict[str, Any]:
        """As plain data."""
        kept = ("name", "unit", "low", "high", "spread", "noise", "step", "missing", "outliers")
        found = {k: getattr(self, k) for k in kept}
        return {k: None if v != v else v for k, v in found.items()} | {"flaws": list(self.flaws)}


@final
@dataclass(frozen=True)
class Table:
    """One table of a log: its times t (n,) in s (rows are counted where no column has them), columns, and their repairs.

    text: columns that do not hold numbers, each with the place and the value of the first that is none.
    """

    name: str
    time: str | None
    t: Array
    columns: tuple[Column, ...]
    log: Log = field(default_factory=Log)
    text: Mapping[str, tuple[str, str]] = field(default_factory=dict)

    @property
    def period(self) -> float | None:
        """Median step in s."""
        steps = np.diff(self.t)
        return float(np.median(steps[steps > 0])) if self.time is not None and (steps > 0).any() else None

    def facts(self) -> dict[str, Any]:
        """As plain data."""
        out: dict[str, Any] = {"name": self.name, "rows": len(self.t), "time": self.time}
        if (period := self.period) is not None:
            out |= {"start": float(np.nanmin(self.t)), "seconds": float(np.nanmax(self.t) - np.nanmin(self.t))}
            out |= {"period": period, "rate": 1 / period}
            kept = ("jitter", "dropped", "duplicates", "gaps", "resets")
            out |= {k: getattr(self.log, k) for k in kept}
        text = [{"name": n, "at": place, "value": value} for n, (place, value) in self.text.items()]
        return {**out, "columns": [c.facts() for c in self.columns], "not_numbers": text}


def inspect(path: Path | str) -> tuple[Table, ...]:
    """The tables of a log, or the trajectories of a spec's recording as the spec maps them."""
    where = Path(path)
    if not where.exists():
        raise UsageError(f"{path}: there is no such file; expected a log, a folder with one, or a spec that names one")
    if where.suffix in (".yaml", ".yml"):
        recording = _recorded(where)
        return tuple(_described(tr.name, "t", tr.t, tr.channels, recording.units) for tr in recording.trajectories)
    readers = _readers(where)
    for reader in readers:
        if found := [_table(reader, where, name, columns) for name, columns in reader.tables(where)]:
            return tuple(found)
    raise UsageError(f"{path}: nothing in it is a table of numbers; expected a log; `gapcert plugins` lists the readers")


def _recorded(path: Path) -> Recording:
    from gapcert.plugin import load_spec

    spec = load_spec(path)
    if spec.config.recording is None:
        raise UsageError(f"{path}: the spec has no recording; expected a log, or a spec with `recording:`")
    return spec.recorded()


def _readers(path: Path) -> list[type[Reader]]:
    """Those whose files end like this one."""
    from gapcert.plugin import registry

    known, found, absent = registry(), [], []
    suffix = "" if path.is_dir() else path.suffix.lower()
    for name in known.names("reader"):
        try:
            reader: type[Reader] = known.get("reader", name).load()
        except MissingDependency as error:
            absent.append(str(error))
            continue
        if suffix in reader.suffixes:
            found.append(reader)
    if not found:
        said = "; ".join(["`gapcert plugins` lists the readers", *absent])
        raise UsageError(f"{path}: no reader knows files that end in '{path.suffix}'; expected one that does; {said}")
    return found


def _table(reader: type[Reader], path: Path, name: str, columns: Mapping[str, Any]) -> Table:
    given = {harmless(n): np.asarray(v) for n, v in columns.items() if np.ndim(v) == 1}
    found = {n: v if v.dtype.kind in "fiubM" else as_numbers(v) for n, v in given.items() if v.dtype.kind in "fiubMOUST"}
    every = {n: v for n, v in found.items() if v is not None}
    text = {n: first_text(given[n]) or (0, "") for n, v in found.items() if v is None}
    length = max(map(len, every.values()), default=0)
    dates = [n for n, v in every.items() if v.dtype.kind == "M"]
    time = next((n for n in [*filter(_is_time, every), *dates] if len(every[n]) == length), None)
    counted = np.arange(length, dtype=np.float64)
    t = seconds(name, time, every[time], _stated(time)[1] or _unit(every[time])) if time else counted
    rest = {n: v.astype(np.float64) for n, v in every.items() if v.dtype.kind != "M" and n != time and len(v) == length}
    told = {n: (reader.place(path, row), value) for n, (row, value) in text.items()}
    return replace(_described(name, time, t, rest, stated_units(rest) if reader.units_in_names else {}), text=told)


def _is_time(column: str) -> bool:
    return _stated(column)[0].strip("_") in TIMES


def _stated(column: str) -> tuple[str, str]:
    """(the name of a column, the unit of time that its header states): `time [ms]` is a time in ms."""
    last = column.rpartition("/")[2].lower()
    hit = _WITH_UNIT.fullmatch(last)
    return (hit[1], hit[2] or hit[3]) if hit else (last, "")


def _unit(times: Array) -> str:
    """Of a column of times: whole numbers since 1970 that are too large for seconds are parts of them."""
    if np.asarray(times).dtype.kind in "iu" and len(times):
        for unit, most in (("s", 1e11), ("ms", 1e14), ("us", 1e17)):
            if abs(float(times[0])) < most:
                return unit
        return "ns"
    return "s"


def _described(name: str, time: str | None, t: Array, columns: Mapping[str, Array], units: Mapping[str, str]) -> Table:
    logs: list[Log] = []
    with np.errstate(all="ignore"):  # numbers at the end of their range are shown as they are
        described = tuple(_column(n, t, v, units.get(n, ""), logs) for n, v in columns.items())
    return Table(name, time, t, described, max(logs, key=lambda log: log.dropped, default=Log()))


def _column(name: str, t: Array, values: Array, unit: str, logs: list[Log]) -> Column:
    values = readings(values)
    there = values[np.isfinite(values)]
    if not len(there):
        return Column(name, values, len(values), 0, np.nan, np.nan, np.nan, unit=unit)
    facts = float(there.min()), float(there.max()), float(there.std())
    noise, outliers = None, 0
    if len(t) >= SHORTEST and facts[2] > 0 and np.isfinite(t).any():
        log, tr = Log(), Trajectory(t, {name: values})
        found = pieces(tr, (StateSpec(name),), (), tr.period, None, log) if np.isfinite(tr.period) else []
        if found:
            sizes = [len(p.t) for p in found]
            noise = float(np.sqrt(np.average([np.nan_to_num(p.noise[0]) ** 2 for p in found], weights=sizes)))
        outliers = log.outliers.get(name, 0)
        logs.append(log)
    missing = int(np.sum(~np.isfinite(values)))
    return Column(name, values, missing, outliers, *facts, noise, _step(there), unit, tuple(flaws(t, values)))


def _step(values: Array) -> float | None:
    """The smallest distance between values, where many share few of them."""
    unique = np.unique(values)
    if len(unique) < 3 or len(unique) > len(values) / 2:
        return None
    apart = np.diff(unique)
    apart = apart[apart > 1e-9 * (unique[-1] - unique[0])]
    return float(apart.min()) if len(apart) else None


def in_words(tables: Sequence[Table]) -> list[str]:
    """For the terminal."""
    from gapcert.plugin import columns

    lines = []
    for table in tables:
        lines.append(f"{table.name}: {sentence(table)}")
        head = ("column", "least", "greatest", "deviation", "noise floor", "step", "missing", "outliers")
        rows = [
            (c.title, *map(_number, (c.low, c.high, c.spread, c.noise, c.step)), c.missing or "", c.outliers or "")
            for c in table.columns
        ]
        lines += [f"  {line}" for line in columns(head, rows)] if rows else []
        lines += [f"  {told}" for told in flawed(table)]
        lines += [f"  {not_numbers(table)}"] if table.text else []
        lines.append("")
    return lines


def flawed(table: Table) -> list[str]:
    """What is wrong with its sensors: `q stays at its greatest value, 1.2, in 8 % of the samples: ...`."""
    return [f"{c.name} {told}" for c in table.columns for told in c.flaws]


def not_numbers(table: Table) -> str:
    """The columns that are left out, and the value for which each of them is."""
    return "not numbers: " + ", ".join(f"{n} ({place}: '{value}')" for n, (place, value) in table.text.items())


def sentence(table: Table) -> str:
    """Rows, rate, and what is wrong with the times."""
    if not len(table.t):
        return "no rows"
    if (period := table.period) is None:
        return f"{len(table.t):,} rows; no column is called time or t (in a spec, `time:` names the one that has their times)"
    f, log = table.facts(), table.log
    text = f"{len(table.t):,} rows over {f['seconds']:.6g} s, {1 / period:.6g} Hz (every {period:.6g} s)"
    said = [
        (log.jitter > 0, f"jitter {log.jitter:.3g} s rms"),
        (log.dropped, f"{log.dropped} samples lost"),
        (log.gaps, f"{len(log.gaps)} gaps, the longest {max((g['seconds'] for g in log.gaps), default=0):.3g} s"),
        (log.resets, f"the clock is set back {len(log.resets)} times"),
        (log.duplicates, f"{log.duplicates} rows whose time does not go forward"),
    ]
    return "; ".join([text, *(words for true, words in said if true)])


def _number(value: float | None) -> str:
    return "" if value is None or np.isnan(value) else f"{value:.4g}"
