"""Files of arrays by name: HDF5, and MATLAB's .mat, which since version 7.3 is HDF5 too."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, final

import h5py
import numpy as np

import gapcert as gc
from gapcert_readers.thresholds import THRESHOLDS

from .files import Columns, FileReader, broken, spread, told

FORM = "an HDF5 file"


@final
class Hdf5Reader(FileReader):
    """Data sets of a file, or of each of its groups that match a pattern."""

    form = FORM
    suffixes: ClassVar = (".h5", ".hdf5", ".hdf")

    def from_file(self, path: Path, title: str) -> Sequence[tuple[str, Columns]]:
        """One trajectory, or one per group."""
        pattern = self.config.groups
        found = list(type(self).tables(path, title, pattern))
        if not found:
            raise gc.UsageError(f"recording: {title}: no group matches '{pattern}'; check `groups`")
        return found

    @classmethod
    def tables(cls, path: Path, title: str | None = None, pattern: str | None = None) -> Sequence[tuple[str, Columns]]:
        """All data sets with numbers, by their path below the root or the group."""
        with told(title or path.name, FORM), _open(path, title or path.name) as file:
            if pattern is None:
                return [(title or path.name, _below(file, "/"))]
            groups: list[str] = []
            file.visititems(lambda n, item: groups.append(n) if isinstance(item, h5py.Group) else None)
            return [(n, _below(file[n], "/")) for n in _natural(fnmatch.filter(groups, pattern.strip("/")))]


@final
class MatReader(FileReader):
    """Variables of a .mat file."""

    form = "a MATLAB file, version 5 to 7.3"
    suffixes: ClassVar = (".mat",)

    @classmethod
    def tables(cls, path: Path, title: str | None = None) -> Sequence[tuple[str, Columns]]:
        """All variables with numbers."""
        return [(title or path.name, _matlab(path, title or path.name))]


def _open(path: Path, title: str) -> Any:
    try:
        return h5py.File(path, "r")
    except OSError as error:
        raise broken(title, error, FORM) from None


def _natural(names: Sequence[str]) -> list[str]:
    """demo_2 before demo_10."""
    return sorted(names, key=lambda n: [*map(int, re.findall(r"\d+", n)), len(n)])


def _below(group: Any, mark: str, turned: bool = False) -> dict[str, Any]:
    """Data sets of numbers below a group, by their path with a mark between its parts; `turned`: last axis first."""
    out: dict[str, Any] = {}

    def add(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.dtype.kind in "fiub" and not name.startswith("#") and item.ndim <= 2:
            _own(item, name)
            values = item[()].T if turned else item[()]
            out.update(spread(name.replace("/", mark), _column(values) if turned else values))

    group.visititems(add)
    return out


def _own(item: Any, name: str) -> None:
    """Only what a file holds itself is read: it may name other files, or state a size that it does not fill."""
    if item.is_virtual or item.external:
        raise gc.UsageError(
            f"recording: '{name}' has its values in another file; expected a file that holds them; copy it whole"
        )
    if item.nbytes > THRESHOLDS.always_read and item.nbytes > THRESHOLDS.packed_times * item.id.get_storage_size():
        what = f"'{name}' states {item.nbytes:,} bytes, of which the file holds {item.id.get_storage_size():,}"
        raise gc.UsageError(f"recording: {what}; expected data that are there")


def _column(values: Any) -> Any:
    """MATLAB's vectors are matrices with one row or one column."""
    array = np.asarray(values)
    return array.ravel() if array.ndim == 2 and 1 in array.shape else array


def _matlab(path: Path, title: str) -> dict[str, Any]:
    from scipy.io import loadmat

    if h5py.is_hdf5(path):  # version 7.3
        with told(title, MatReader.form), _open(path, title) as file:
            return _below(file, ".", turned=True)
    with told(title, MatReader.form):
        content = loadmat(path, simplify_cells=True)
    out: dict[str, Any] = {}
    _fields(content, "", out)
    return out


def _fields(content: Mapping[str, Any], prefix: str, out: dict[str, Any]) -> None:
    for name, value in content.items():
        if isinstance(value, Mapping):
            _fields(value, f"{prefix}{name}.", out)
        elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub" and not name.startswith("__"):
            out.update(spread(prefix + name, _column(value)))
