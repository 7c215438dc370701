"""LeRobot data sets: Parquet files below data/, described by meta/info.json."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np

import gapcert as gc

from .files import Columns, FileReader, told
from .tables import flat

FORM = "a LeRobot data set, a folder with meta/info.json and data/"


@final
class LerobotReader(FileReader):
    """The episodes of a data set."""

    form = FORM
    suffixes: ClassVar = ("",)

    def from_file(self, path: Path, title: str) -> Sequence[tuple[str, Columns]]:
        """One table of all episodes that are asked for."""
        table = _table(path, title)
        if (wanted := self.config.episodes) is None:
            return [(title, table)]
        have = np.asarray(table["episode_index"])
        if absent := [e for e in wanted if e not in have]:
            known = f"0 to {have.max()}" if len(have) else "none"
            raise gc.UsageError(f"recording: {title} has no episode {absent[0]}; there are {known}; check `episodes`")
        rows = np.isin(have, wanted)
        return [(title, {name: np.asarray(values)[rows] for name, values in table.items()})]

    @classmethod
    def tables(cls, path: Path, title: str | None = None) -> Sequence[tuple[str, Columns]]:
        """Every episode as a table."""
        if not (path / "meta" / "info.json").is_file():
            return ()
        table = _table(path, title or path.name)
        label = np.asarray(table["episode_index"])
        return [(f"episode {e}", {n: np.asarray(v)[label == e] for n, v in table.items()}) for e in np.unique(label).tolist()]


def _table(path: Path, title: str) -> dict[str, Any]:
    import pyarrow
    from pyarrow import parquet

    with told(title, FORM):
        features: Mapping[str, Any] = json.loads((path / "meta" / "info.json").read_text())["features"]
        files = sorted((path / "data").rglob("*.parquet"))
        table = flat(pyarrow.concat_tables([parquet.read_table(f) for f in files], promote_options="default"))
    for name, feature in features.items():
        for i, label in enumerate(_names(feature.get("names"))):
            if f"{name}[{i}]" in table:
                table[f"{name}[{label}]"] = table[f"{name}[{i}]"]
    return table


def _names(given: Any) -> list[str]:
    """The names of a feature's elements: a list, or lists by kind of part."""
    if isinstance(given, Mapping):
        return [n for part in given.values() for n in _names(part)]
    return [str(n) for n in given] if isinstance(given, list) else []
