"""Tables of numbers read through Arrow."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, final

import gapcert as gc
from gapcert_readers.config import Csv, Parquet


class TableReader(gc.Reader):
    """A Recording from one or more files that have named columns."""

    form: str

    def __init__(self, config: Csv | Parquet, folder: Path) -> None:
        self.config, self.folder = config, folder

    @classmethod
    def from_config(cls, config: Csv | Parquet, context: gc.Context) -> TableReader:
        return cls(config, context.folder)

    def read(self) -> gc.Recording:
        """All files, in order."""
        c = self.config
        tables = [(name, self._table(name)) for name in c.files]
        return gc.Recording.from_columns(tables, time=c.time, columns=c.columns, units=c.units, trajectory=c.trajectory)

    def _table(self, name: str) -> Mapping[str, Any]:
        import pyarrow

        path = self.folder / name
        if not path.is_file():
            raise gc.UsageError(f"recording: there is no file {name}; expected it at {path}; check `files`")
        try:
            table = self._arrow(path)
        except pyarrow.ArrowInvalid as error:
            reason = str(error).splitlines()[0]
            raise gc.UsageError(f"recording: {name} cannot be read: {reason}; expected {self.form}") from None
        return {column: table[column].to_numpy() for column in table.column_names}

    @abstractmethod
    def _arrow(self, path: Path) -> Any:
        """The file as a pyarrow.Table; ArrowInvalid where it is none."""


@final
class CsvReader(TableReader):
    """Comma-separated text with one header line."""

    form = "comma-separated text with a header"

    def _arrow(self, path: Path) -> Any:
        from pyarrow import csv

        return csv.read_csv(path)


@final
class ParquetReader(TableReader):
    """Apache Parquet."""

    form = "a Parquet file"

    def _arrow(self, path: Path) -> Any:
        from pyarrow import parquet

        return parquet.read_table(path)
