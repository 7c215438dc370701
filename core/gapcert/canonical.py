"""Plain data with one text, whatever the identity of its parts: what a digest is taken of."""

from __future__ import annotations

import hashlib
import types
from collections.abc import Mapping
from typing import Any

import numpy as np

from gapcert.errors import UsageError


def digest(value: Any) -> str:
    """SHA-256 of the class and the attributes of a value, and of theirs; of functions and classes, the name alone.

    UsageError where an attribute cannot be pickled, or leads back to what holds it.
    """
    try:
        text = repr(_canonical(value))
    except (TypeError, RecursionError) as error:
        why = "an attribute leads back to it" if isinstance(error, RecursionError) else str(error)
        what = "expected attributes that can be pickled and do not contain it, as a bound method of its own does"
        raise UsageError(f"{type(value).__name__}: no digest ({why}); {what}; leave it out, or override digest()") from None
    return hashlib.sha256(text.encode()).hexdigest()


def _canonical(value: Any) -> Any:
    """Data whose `repr` depends neither on the identity of its parts nor on the order of its sets (pickles depend on both)."""
    if value is None or isinstance(value, bool | int | str | bytes):
        return value
    if isinstance(value, float):
        return value.hex()
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
    if isinstance(value, Mapping):
        return "mapping", sorted((repr(_canonical(k)), _canonical(v)) for k, v in value.items())
    if isinstance(value, set | frozenset):
        return "set", sorted(repr(_canonical(v)) for v in value)
    if isinstance(value, list | tuple):
        return [_canonical(v) for v in value]
    if isinstance(value, type | types.FunctionType | types.BuiltinFunctionType):
        return f"{value.__module__}.{value.__qualname__}"
    reduced = value.__reduce_ex__(4)
    if isinstance(reduced, str):
        return f"{type(value).__module__}.{reduced}"
    build, arguments, state, items, pairs = (*reduced, None, None, None)[:5]
    return _canonical([build, arguments, state, list(items or ()), list(pairs or ())])
