"""Models and gap functions beside a saved controller, which asks them again as it runs: data alone, and no code."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any, final

import numpy as np

from gapcert.plugin import Array, Domain, GapFunction, Model, identity, located, registry
from gapcert_mpc.variants.parameters import built

PLAIN = (bool, int, float, str, type(None))


@final
class NotKept(Exception):
    """What it names cannot be written as data."""


def kept(value: Any, path: str, arrays: dict[str, Array]) -> Any:
    """JSON of a value, its arrays put into `arrays` by their path. NotKept where something in it is no data.

    Models of kind equations are their specs; of other objects, which are of Gapcert or of plugins that are declared to it, the
    attributes are kept, without what these cache.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, PLAIN):
        return value
    if isinstance(value, np.ndarray) and value.dtype != object:
        arrays[path] = value
        return {"array": path}
    if isinstance(value, tuple | list):
        name = "tuple" if isinstance(value, tuple) else "list"
        return {name: [kept(v, f"{path}.{i}", arrays) for i, v in enumerate(value)]}
    if isinstance(value, Mapping):
        return {"items": [[kept(k, f"{path}.key", {}), kept(v, f"{path}.{k}", arrays)] for k, v in value.items()]}
    if isinstance(value, Model):
        return {"model": _spec(value)}
    kind = type(value)
    name = identity(kind)
    if not hasattr(value, "__dict__") or isinstance(value, type) or not _known(name):
        raise NotKept(name)
    own = {k: v for k, v in vars(value).items() if not isinstance(getattr(kind, k, None), cached_property)}
    return {"object": name, "has": {k: kept(v, f"{path}.{k}", arrays) for k, v in own.items()}}


def _spec(model: Model) -> Mapping[str, Any]:
    try:
        spec: Mapping[str, Any] = model.to_spec()
    except Exception as error:  # whatever a model says that has none
        raise NotKept(type(model).__name__) from error
    if spec.get("kind") != "equations" or built(spec).digest() != model.digest():
        raise NotKept(type(model).__name__)
    return spec


def _known(name: str) -> bool:
    """Is a class part of Gapcert, of its kits of gaps, or of a package that declares gap families, or routes that move them?"""
    parts = name.partition(":")[0].split(".")
    # A module such as __main__ does something when it is imported.
    return parts[0] in _packages() and not any(part.startswith("_") for part in parts)


def _packages() -> set[str]:
    found = (c.target.partition(".")[0] for c in registry().components.values() if c.kind in ("gap_family", "route"))
    return {"gapcert", "gapcert_cells", "gapcert_functions", "gapcert_networks", *found}


def known(data: Any, arrays: Mapping[str, Array]) -> Mapping[str, Any]:
    """What was kept of a problem, by name. ValueError where something in it is no such thing."""
    found = again(data, arrays)
    expected = {"model": Model, "gap": GapFunction, "domain": Domain, "seed": int}
    if not isinstance(found, Mapping) or not set(found) <= set(expected):
        raise ValueError("what is kept is no problem")
    for name, value in found.items():
        if not isinstance(value, expected[name]) and not (name == "gap" and value is None):
            raise ValueError(f"its {name} is no {expected[name].__name__}")
    return found


def again(data: Any, arrays: Mapping[str, Array]) -> Any:
    """Inverse of `kept`. ValueError where the data name a class that is not known."""
    if not isinstance(data, Mapping):
        return data
    if "array" in data:
        return np.asarray(arrays[data["array"]])
    if "tuple" in data:
        return tuple(again(v, arrays) for v in data["tuple"])
    if "list" in data:
        return [again(v, arrays) for v in data["list"]]
    if "items" in data:
        return {again(k, arrays): again(v, arrays) for k, v in data["items"]}
    if "model" in data:
        return built(data["model"])
    if not _known(name := data["object"]):
        raise ValueError(f"it names {name}, which no installed plugin has")
    try:
        found: Any = located(name, _packages())
    except (ImportError, AttributeError) as error:
        raise ValueError(f"it names {name}: {error}") from None
    if not isinstance(found, type):
        raise ValueError(f"it names {name}, which is no class")
    # A module reaches all that it imports: a class of another one may act when it is let go, as temporary files do.
    if identity(found) != name:
        raise ValueError(f"it names {name}, which is {identity(found)}")
    # No constructor runs: what it would make is what was kept.
    made: Any = object.__new__(found)
    vars(made).update({k: again(v, arrays) for k, v in data["has"].items()})
    return made


def pair(arrays: dict[str, Array], **named: Any) -> Any | None:
    """What `again` makes a mapping of these values of; None where one cannot be kept, and then no array is added."""
    own: dict[str, Array] = {}
    try:
        data = kept(named, "kept", own)
    except NotKept:
        return None
    arrays.update(own)
    return data
