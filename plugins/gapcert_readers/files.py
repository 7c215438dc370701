"""What all readers share: files found, columns named, one recording made."""

from __future__ import annotations

import contextlib
import re
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import gapcert as gc
from gapcert_readers.thresholds import THRESHOLDS

from .config import Log, Table

Columns = Mapping[str, Any]
TIME = "(time)"


class FileReader(gc.plugin.Reader):
    """A Recording from one or more files. `form` says in a sentence what kind of file is expected."""

    form: str

    def __init__(self, config: Any, folder: Path) -> None:
        self.config, self.folder = config, folder

    @classmethod
    def from_config(cls, config: Log, context: gc.Context) -> FileReader:
        return cls(config, context.folder)

    def read(self) -> gc.Recording:
        """All files, in order."""
        c = self.config
        paths = [path for name in c.files for path in self._paths(name)]
        found = [table for path in paths for table in self.from_file(path, self._title(path))]
        titled = {self._title(path): path for path in paths}

        def place(table: str, row: int) -> str:
            return self.place(titled.get(table, self.folder), row)

        shared: dict[str, Any] = {"columns": c.columns, "units": c.units, "hold": c.hold, "every": c.every, "place": place}
        shared["units_in_names"] = type(self).units_in_names
        if not isinstance(c, Table):
            return gc.Recording.from_columns(found, time=TIME, **{**shared, "units": {**c.units, TIME: "ns"}})
        if c.period is None:
            return gc.Recording.from_columns(found, time=c.time, trajectory=c.trajectory, **shared)
        counted = [(name, {**table, TIME: self._counted(name, table)}) for name, table in found]
        return gc.Recording.from_columns(counted, time=TIME, trajectory=c.trajectory, **shared)

    def _counted(self, name: str, table: Columns) -> Any:
        channel, first = next(iter(self.config.columns.items()))
        if first not in table:
            what = f"recording: {name}: '{first}' is not a column; there are {', '.join(sorted(table))}"
            raise gc.UsageError(what, ("recording", "columns", channel))
        return np.arange(len(table[first])) * self.config.period

    def from_file(self, path: Path, title: str) -> Sequence[tuple[str, Columns]]:
        """(name, columns) of each trajectory, or of several at once, in a file; by default all its tables."""
        return self.tables(path, title)

    @classmethod
    @abstractmethod
    def tables(cls, path: Path, title: str | None = None) -> Sequence[tuple[str, Columns]]:
        """(name, columns) of what is in a file, which errors and a lone table call by the title, or by its name."""

    def _paths(self, name: str) -> list[Path]:
        path = self.folder / name
        found = sorted(path.parent.glob(re.sub(r"\*+", "*", path.name))) if "*" in path.name else [path] * path.exists()
        # A device or a pipe may never end.
        found = [p for p in found if p.is_file() or p.is_dir()]
        if not found:
            raise gc.UsageError(f"recording: there is no file {name}; expected it at {path}; check `files`")
        return found

    def _title(self, path: Path) -> str:
        """The file as the spec names it."""
        given = [n for n in self.config.files if self.folder / n == path]
        return str(given[0]) if given else path.name


def broken(title: str, reason: object, form: str) -> gc.UsageError:
    """The error for a file that is not what it should be."""
    first = (str(reason).splitlines() or ["it is empty"])[0]
    return gc.UsageError(f"recording: {title} cannot be read: {first}; expected {form}")


def spread(name: str, values: Any, labels: Sequence[str] = ()) -> Iterable[tuple[str, Any]]:
    """A column, or the columns `name[i]` (and `name[label]`) of an array (T, k)."""
    array = np.asarray(values)
    if array.ndim == 1:
        yield name, array
    elif array.ndim == 2 and array.shape[1] <= THRESHOLDS.named_columns:
        for i in range(array.shape[1]):
            yield f"{name}[{i}]", array[:, i]
        if len(labels) == array.shape[1]:
            yield from ((f"{name}[{label}]", array[:, i]) for i, label in enumerate(labels))


@contextlib.contextmanager
def told(title: str, form: str) -> Iterator[None]:
    """Whatever a decoder raises on a file that is not what it says becomes one sentence."""
    try:
        yield
    except gc.GapcertError:
        raise
    except Exception as error:  # the decoders raise what their parsers raise
        raise broken(title, error, form) from None
