"""The two files of a saved controller."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from gapcert.plugin import DAMAGE, UsageError, clipped, npz_bytes, write_atomic

C = TypeVar("C", bound=Any)


def write_saved(folder: Path | str, data: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """`controller.json`, which names the synthesizer as its `kind`, and `controller.npz`; each whole or not at all."""
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder}: the controller cannot be written ({error.strerror}); give a writable folder") from None
    write_atomic(folder / "controller.npz", npz_bytes(arrays, compress=True))
    write_atomic(folder / "controller.json", (json.dumps(data, indent=1) + "\n").encode())


def saved_data(folder: Path) -> dict[str, Any]:
    """What stands in `controller.json`; UsageError where there is none, or no object in it."""
    with _told(folder):
        data = json.loads((folder / "controller.json").read_text(encoding="utf-8"))
        if not isinstance(data, dict):
            raise TypeError("controller.json holds no object")
        return data


@contextmanager
def loading(folder: Path | str) -> Iterator[tuple[dict[str, Any], Any]]:
    """(data, arrays) that `write_saved` wrote; UsageError for absent files, or whatever goes wrong with their contents."""
    folder = Path(folder)
    with _told(folder):
        data = saved_data(folder)
        with (folder / "controller.npz").open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            yield data, arrays


def loaded(
    folder: Path | str,
    made: Callable[[dict[str, Any], dict[str, npt.NDArray[Any]]], C],
    files: str = "controller.npz and controller.json",
) -> C:
    """What is made of the data and arrays in a folder; UsageError where they are absent, damaged, or not of one controller."""
    with loading(folder) as (data, arrays):
        found = made(data, {name: arrays[name] for name in arrays.files})
    if found.digest() != data.get("digest"):
        raise UsageError(f"{Path(folder)}: {files} do not belong together; synthesize it again")
    return found


@contextmanager
def _told(folder: Path) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError as error:
        raise UsageError(f"{folder}: no saved controller ({Path(error.filename).name} is missing)") from None
    except DAMAGE as error:
        what = f"{folder}: the saved controller is damaged ({clipped(str(error))[0]})"
        raise UsageError(f"{what}; synthesize it again") from None
