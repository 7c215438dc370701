"""Tables of numbers read through Arrow: separated text, Parquet, and LeRobot data sets, which are Parquet below data/."""

from __future__ import annotations

import json
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np

import gapcert as gc

from .files import Columns, FileReader, spread, told
from .separated import line_of, separated


class TableReader(FileReader):
    """A Recording from files that hold one table each."""

    @classmethod
    def tables(cls, path: Path, title: str | None = None) -> Sequence[tuple[str, Columns]]:
        """The one table of a file."""
        with told(title or path.name, cls.form):
            return [(title or path.name, flat(cls.arrow(path)))]

    @classmethod
    @abstractmethod
    def arrow(cls, path: Path) -> Any:
        """The file as a pyarrow.Table; ArrowInvalid where it is none."""


def flat(table: Any) -> dict[str, Any]:
    """The columns of a pyarrow.Table; lists of equal length become one column per element."""
    import pyarrow

    out: dict[str, Any] = {}
    for name in table.column_names:
        column = table[name]
        kind = column.type
        lists = pyarrow.types.is_list(kind) or pyarrow.types.is_large_list(kind) or pyarrow.types.is_fixed_size_list(kind)
        if pyarrow.types.is_null(kind):
            out[name] = np.full(len(column), np.nan)
        elif not lists:
            out[name] = column.to_numpy()
        elif len(column):
            whole = column.combine_chunks()
            if len(whole.flatten()) % len(column) == 0 and not pyarrow.types.is_nested(kind.value_type):
                out.update(spread(name, np.reshape(whole.flatten().to_numpy(zero_copy_only=False), (len(column), -1))))
    return out


@final
class CsvReader(TableReader):
    """Text with one header line and a row per line; commas, semicolons, tabs or blanks stand between the values.

    A comma may be the decimal sign where it does not stand between values; a file has one decimal sign. What stands above the
    header is passed over, a header behind # is one, times of day are in seconds, and columns of one name are numbered.
    """

    form = "values separated by commas, semicolons or tabs, below a header"
    suffixes: ClassVar = (".csv", ".txt", ".dat", ".tsv")

    @classmethod
    def arrow(cls, path: Path) -> Any:
        return separated(path)

    @classmethod
    def place(cls, path: Path, row: int) -> str:
        return f"line {line_of(path, row)}" if path.is_file() else super().place(path, row)


@final
class ParquetReader(TableReader):
    """Apache Parquet."""

    form = "a Parquet file"
    suffixes: ClassVar = (".parquet", ".pq")

    @classmethod
    def arrow(cls, path: Path) -> Any:
        from pyarrow import parquet

        if not path.is_file():
            raise gc.UsageError(f"recording: {path.name} is a folder; expected {cls.form}; add /*.parquet to read all in it")
        return parquet.read_table(path)


@final
class LerobotReader(FileReader):
    """The episodes of a data set."""

    form = "a LeRobot data set, a folder with meta/info.json and data/"
    suffixes: ClassVar = ("",)
    units_in_names: ClassVar = False

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

    with told(title, LerobotReader.form):
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
