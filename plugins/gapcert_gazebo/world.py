"""A robot in a world of Gazebo's physics, advanced row by row in C++."""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert import Array, UsageError
from gapcert_engines import Drive, EngineWorld

from .shim import failure, shim


def opened(text: str, options: tuple[str, str, str], nanoseconds: int, file: str) -> int:
    """A handle on the robot of an SDF text; options: model, collision detector, solver, empty where none is named."""
    handle = shim().open(text.encode(), *(o.encode() for o in options), nanoseconds)
    if handle is None:
        raise UsageError(f"robot: {file}: {failure()}")
    return int(handle)


@final
class GazeboWorld(EngineWorld):
    """One robot; `order` is the order in which the shim takes the native parameters."""

    copies = 1

    def __init__(self, handle: int, order: tuple[str, ...], substeps: int, file: str) -> None:
        self._handle, self._order, self._substeps, self._file = handle, order, substeps, file
        self._values: tuple[float, ...] = ()
        self._motors = 0
        self._finalizer = weakref.finalize(self, shim().close, handle)

    def follow(self, drive: Drive, joints: list[int]) -> None:
        """The drive's elements, as numbers of movable joints."""
        self._motors = len(joints)
        arrays = np.array(joints, dtype=np.int64), np.ascontiguousarray(drive.yaw), np.ascontiguousarray(drive.yaw_rate)
        gain, limit = drive.gain or 0.0, np.inf if drive.limit is None else drive.limit
        self._check(shim().drive(self._handle, len(joints), *map(_at, arrays), gain, limit, drive.every))

    def set(self, values: Mapping[str, float]) -> None:
        # Where nothing can touch, the factor on the friction of contacts is no parameter.
        wanted = tuple(values.get(name, 1.0) for name in self._order)
        if wanted != self._values:
            array = np.array(wanted)
            self._check(shim().set(self._handle, _at(array)))
            self._values = wanted

    def advance(
        self, joints: Array, effort: Array, base: Array | None = None, command: Array | None = None
    ) -> tuple[Array, Array | None]:
        joints, effort = np.ascontiguousarray(joints), np.ascontiguousarray(effort)
        base = None if base is None else np.ascontiguousarray(base)
        command = np.zeros((len(joints), self._motors)) if command is None else np.ascontiguousarray(command)
        after, after_base = np.empty_like(joints), None if base is None else np.empty_like(base)
        arrays = joints, effort, base, command, after, after_base
        self._check(shim().advance(self._handle, len(joints), self._substeps, effort.shape[1] == 1, *map(_at, arrays)))
        return after, after_base

    def poses(self, position: Array, base: Array | None, links: int) -> Array:
        """Of the file's links, (n, links, 7), at rest in these positions (n, nj) and places of the base (n, 13)."""
        joints = np.ascontiguousarray(np.stack([position, np.zeros_like(position)], axis=2))
        placed = None if base is None else np.ascontiguousarray(np.hstack([base[:, :7], np.zeros((len(base), 6))]))
        out = np.empty((len(position), links, 7))
        self._check(shim().poses(self._handle, len(position), *map(_at, (joints, placed, out))))
        return out

    def close(self) -> None:
        self._finalizer()

    def _check(self, code: int) -> None:
        if code:
            raise UsageError(f"robot: {self._file}: {failure()}")


def _at(array: npt.NDArray[Any] | None) -> int | None:
    """Its address; whoever asks keeps it alive."""
    return None if array is None else array.ctypes.data
