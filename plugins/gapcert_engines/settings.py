"""Options of a component's config: as dotted paths, set anew, and which others are worth trying."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel

from gapcert.plugin import leaves, of_config

Options = dict[str, Any]


def short(options: Options) -> Any:
    """One value where all options share it, else the mapping."""
    values = [plain(v) for v in options.values()]
    return values[0] if all(v == values[0] for v in values) else dict(zip(options, values, strict=True))


def plain(value: Any) -> Any:
    """A value as JSON has it."""
    return json.loads(json.dumps(value.model_dump() if isinstance(value, BaseModel) else value, default=str))


def flat(config: Any) -> Options:
    """Every option of a config by its dotted path; `kind` names the component and is none."""
    return {k: v for k, v in leaves(config.model_dump()) if k != "kind"} if isinstance(config, BaseModel) else {}


def changed(config: Any, options: Mapping[str, Any]) -> Any:
    """The config with some options set anew, checked by its own model."""
    data = config.model_dump(exclude_unset=True)
    for path, value in options.items():
        node, (*outer, last) = data, path.split(".")
        for part in outer:
            node = node.setdefault(part, {})
        node[last] = value
    return type(config).model_validate(data)


def declared(config: Any) -> list[tuple[str, Options]]:
    """(setting, options that it changes) of everything that a config says may be tried."""
    known: Mapping[str, Sequence[Any]] = of_config(config, "settings")
    return [(name, dict(v) if isinstance(v, Mapping) else {name: v}) for name, values in known.items() for v in values]
