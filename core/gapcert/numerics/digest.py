"""Digests of plain data, whatever objects it is made of, and what classes and functions are called in them.

The names outlive moves: what ledgers and saved controllers hold is found by them, too.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import json
import types
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gapcert.numerics.errors import UsageError

HOMES = "identities.json"
"""A file beside the `__init__` of a package where something has moved: module, or `module:Name`, as it is → as it was first."""


def digest(value: Any, apart: Callable[[Any], bool] = lambda part: False) -> str:
    """SHA-256 of the class and the attributes of a value, and of theirs; of functions and classes, the identity alone.

    What is `apart` counts by its own digest(). UsageError where an attribute cannot be pickled, or leads back to what holds it.
    """
    try:
        text = repr(_attributes(value, apart))
    except (TypeError, RecursionError) as error:
        why = "an attribute leads back to it" if isinstance(error, RecursionError) else str(error)
        what = "expected attributes that can be pickled and do not contain it, as a bound method of its own does"
        raise UsageError(f"{type(value).__name__}: no digest ({why}); {what}; leave it out, or override digest()") from None
    return hashlib.sha256(text.encode()).hexdigest()


def json_digest(*parts: Any) -> str:
    """SHA-256 of plain data, as a list in JSON."""
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _canonical(value: Any, apart: Callable[[Any], bool]) -> Any:
    """Data whose `repr` depends neither on the identity of its parts nor on the order of its sets (pickles depend on both)."""
    if value is None or isinstance(value, bool | int | str | bytes):
        return value
    if isinstance(value, float):
        return value.hex()
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
    if isinstance(value, Mapping):
        return "mapping", sorted((repr(_canonical(k, apart)), _canonical(v, apart)) for k, v in value.items())
    if isinstance(value, set | frozenset):
        return "set", sorted(repr(_canonical(v, apart)) for v in value)
    if isinstance(value, list | tuple):
        return [_canonical(v, apart) for v in value]
    if isinstance(value, type | types.FunctionType | types.BuiltinFunctionType):
        return identity(value).replace(":", ".")
    return ("digest", value.digest()) if apart(value) else _attributes(value, apart)


def _attributes(value: Any, apart: Callable[[Any], bool]) -> Any:
    reduced = value.__reduce_ex__(4)
    if isinstance(reduced, str):
        return f"{identity(type(value)).partition(':')[0]}.{reduced}"
    build, arguments, state, items, pairs = (*reduced, None, None, None)[:5]
    return _canonical([build, arguments, state, list(items or ()), list(pairs or ())], apart)


def identity(value: Any) -> str:
    """`module:Name`, where a class or function was first."""
    module, name = str(value.__module__), value.__qualname__
    homes = _homes(module.partition(".")[0])
    return homes.get(f"{module}:{name}") or f"{homes.get(module, module)}:{name}"


def located(name: str, packages: Iterable[str]) -> Any:
    """What has this identity, perhaps in these packages by now; ImportError or AttributeError where nothing has."""
    now = {was: here for package in packages for here, was in _homes(package).items()}
    module, _, path = name.partition(":")
    module, _, path = now.get(name, f"{now.get(module, module)}:{path}").partition(":")
    return functools.reduce(getattr, path.split("."), importlib.import_module(module))


@functools.cache
def _homes(package: str) -> Mapping[str, str]:
    try:
        folders = getattr(importlib.import_module(package), "__path__", ())
    except ImportError:  # the module of what C code has made may be none
        return {}
    tables = [table for folder in folders if (table := Path(folder, HOMES)).exists()]
    return {here: was for table in tables for here, was in json.loads(table.read_text(encoding="utf-8")).items()}
