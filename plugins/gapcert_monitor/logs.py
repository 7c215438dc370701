"""A log for a certificate: its columns, and how far they may be wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gapcert.plugin import Model, Recording, Trajectory, UsageError, magnitude, stated_units, without_units
from gapcert_recordings import axes

from .certified import Certified

if TYPE_CHECKING:
    from gapcert_recordings import Table


def read_log(path: Path | str, certified: Certified) -> Recording:
    """A log by its columns, which bear the names of states and inputs; or the recording of a spec, which maps them."""
    from gapcert.plugin import load_spec
    from gapcert_recordings import inspect

    where = Path(path)
    if where.suffix in (".yaml", ".yml"):
        spec = load_spec(where)
        if spec.config.recording is None:
            raise UsageError(f"{path}: the spec has no recording; expected a log, or the spec of a diagnosis")
        return spec.recorded()
    tables, names = inspect(where), axes(certified.model)
    named = [(t, without_units(c.name for c in t.columns)) for t in tables]
    whole = [(t, [(n, of[n]) for n in names]) for t, of in named if t.time is not None and set(names) <= of.keys()]
    if not whole:
        columns = [*dict.fromkeys(c.name for t in tables for c in t.columns)]
        lacking = next((n for n in names if not any(n in of for _, of in named)), None)
        what = f"no column '{lacking}'" if lacking else "no table with the times (time or t) and all of " + ", ".join(names)
        raise UsageError(
            f"{path}: {what} (there are {', '.join(columns)}); expected the times and columns {', '.join(names)}, in the "
            f"model's units or with their own, '{names[0]} [{certified.model.states[0].unit}]'; the spec of a diagnosis, whose "
            f"`recording:` maps other names, serves as well"
        )
    return Recording(tuple(_trajectory(t, dict(of), certified.model) for t, of in whole))


def _trajectory(table: Table, columns: Mapping[str, str], model: Model) -> Trajectory:
    """Of the columns that channels have, in the model's units."""
    values = {c.name: c.values for c in table.columns}
    own = Trajectory(table.t, {n: values[c] for n, c in columns.items()}, table.name)
    units = {n: unit for n, c in columns.items() for unit in stated_units([c]).values()}
    to = {s.name: s.unit for s in (*model.states, *model.inputs) if s.name in units}
    return Recording((own,), units).converted(to).trajectories[0]


def stated_noise(texts: Sequence[str], certified: Certified) -> dict[str, float]:
    """From texts such as `theta=0.1 deg`, in the model's units."""
    units = {s.name: s.unit for s in (*certified.model.states, *certified.model.inputs)}
    out = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            out[name] = magnitude(value, units.get(name, "1"))
        except ValueError as error:
            raise UsageError(f"--noise {text}: {error}; write CHANNEL=VALUE") from None
    return out
