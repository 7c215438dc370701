"""Nested dataclasses with arrays in them, as JSON and a table of arrays, and back."""

from __future__ import annotations

import types
import typing
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from gapcert.plugin import Array


def flatten(value: Any, path: str, arrays: dict[str, Array]) -> Any:
    """JSON of a dataclass, its arrays put into `arrays` by their path."""
    if isinstance(value, np.ndarray):
        arrays[path] = value
        return path
    if is_dataclass(value):
        return {f.name: flatten(getattr(value, f.name), f"{path}/{f.name}", arrays) for f in fields(value)}
    if isinstance(value, tuple):
        return [flatten(v, f"{path}/{i}", arrays) for i, v in enumerate(value)]
    return value


def restore(kind: Any, data: Any, arrays: Mapping[str, Array]) -> Any:
    """The value of type `kind` that `flatten` made `data` and `arrays` from."""
    if data is None:
        return None
    if isinstance(kind, types.UnionType):
        kind = next(k for k in typing.get_args(kind) if k is not type(None))
    origin = typing.get_origin(kind)
    if origin is np.ndarray:
        return arrays[data]
    if origin is tuple:
        return tuple(restore(typing.get_args(kind)[0], d, arrays) for d in data)
    if is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        return typing.cast(Any, kind)(**{name: restore(hints[name], d, arrays) for name, d in data.items()})
    return data
