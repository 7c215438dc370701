"""Plain data with one text, whatever objects it is made of: what a digest is taken of."""

from __future__ import annotations

import hashlib
import json
import types
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from gapcert.numerics.errors import UsageError
from gapcert.numerics.identities import identity


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
