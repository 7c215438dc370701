"""Tables of numbers read through Arrow."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
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

    A comma may be the decimal sign where it does not stand between values; a file has one decimal sign.
    """

    form = "values separated by commas, semicolons or tabs, below a header"
    suffixes: ClassVar = (".csv",)

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
