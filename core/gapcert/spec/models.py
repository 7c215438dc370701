"""Pydantic's errors as problems of a spec: where they stand, what was found, what was expected, what is near."""

from __future__ import annotations

import difflib
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any

from pydantic import BaseModel, ValidationError

from gapcert.contracts.data.units import shown
from gapcert.numerics.errors import GapcertError
from gapcert.spec.source import At, Problem

_TYPES = {
    "int": "a whole number",
    "float": "a number",
    "string": "text",
    "str": "text",
    "bool": "true or false",
    "dict": "a mapping",
    "mapping": "a mapping",
    "model": "a mapping",
    "dataclass": "a mapping",
    "list": "a list",
    "tuple": "a list",
    "path": "a path",
    "decimal": "a number",
}


def validate(model: type[BaseModel], data: Any, path: At, problems: list[Problem]) -> Any:
    """An instance of `model`, or None with one problem per place where `data` does not fit."""
    if not isinstance(data, Mapping):
        problems.append(Problem(path, f"found {shown(data)}; expected a mapping"))
        return None
    if model.model_config.get("extra") is None:
        problems += [unknown_key((*path, k), keys_at(model, ())) for k in data if k not in keys_at(model, ())]
    try:
        return model.model_validate(data)
    except ValidationError as error:
        problems += _problems(model, data, path, error)
    except GapcertError as error:
        problems.append(Problem(path, str(error)))
    return None


def unknown_key(path: At, known: Iterable[str], what: str = "key") -> Problem:
    """An unknown key, with the nearest known one."""
    return Problem(path, f"unknown {what} '{path[-1]}'", near(str(path[-1]), known), "key")


def near(name: str, known: Iterable[str]) -> str:
    """`did you mean 'x'?`, or the list of what there is."""
    names = sorted(known)
    match = difflib.get_close_matches(name, names, 1, cutoff=0.6)
    return f"did you mean '{match[0]}'?" if match else f"known: {', '.join(names) or 'none'}"


def _problems(model: type[BaseModel], data: Any, base: At, error: ValidationError) -> list[Problem]:
    """One problem per place. The branches of a union that do not fit are told as one: `a number or a list`."""
    found: dict[tuple[At, str, str], list[tuple[Problem, bool]]] = {}
    branches: dict[At, tuple[int | str, ...]] = {}
    for item in error.errors(include_url=False):
        problem, expected = _translate(model, _locate(item, data), item, base)
        lacking = item["type"] == "missing"
        # Of a union, the keys that one branch lacks are told: each of them, and not those of the others.
        if lacking and branches.setdefault(problem.path, item["loc"][:-1]) != item["loc"][:-1]:
            continue
        own = problem.message if lacking else ""
        found.setdefault((problem.path, problem.where, own), []).append((problem, expected))
    deepest = {p for p, _, _ in found}
    out = []
    for (path, _, _), group in found.items():
        # A union's scalar branches fail at the value itself; where a branch for mappings fails inside it, that one was meant.
        if len(group) > 1 or group[0][1]:
            inner = [p for p in deepest if len(p) > len(path) and p[: len(path)] == path]
            if inner and all(expected for _, expected in group):
                continue
        messages = list(dict.fromkeys(p.message for p, _ in group))
        parts = [m.partition("; expected ") for m in messages]
        if len(messages) > 1 and all(p[1] and p[0] == parts[0][0] for p in parts):
            messages = [f"{parts[0][0]}; expected " + " or ".join(dict.fromkeys(p[2] for p in parts))]
        first = group[0][0]
        out.append(Problem(first.path, messages[0], first.hint, first.where))
    return out


def _locate(item: Any, data: Any) -> At:
    """The part of a pydantic location that exists in the data, with a missing key's name: tags of union branches drop out."""
    path: list[int | str] = []
    node, loc = data, item["loc"]
    for i, part in enumerate(loc):
        if (isinstance(node, Mapping) and part in node) or (
            isinstance(node, list) and isinstance(part, int) and part < len(node)
        ):
            node = node[part]
            path.append(part)
        elif i == len(loc) - 1 and item["type"] == "missing":
            path.append(part)
    return tuple(path)


def _translate(model: type[BaseModel], path: At, item: Any, base: At) -> tuple[Problem, bool]:
    """(problem, whether it only says what type was expected)."""
    kind, value, full = str(item["type"]), item["input"], (*base, *path)
    if kind == "missing":
        return Problem(full[:-1], f"missing required key '{full[-1]}'", f"add {full[-1]}:", "key"), False
    if kind == "extra_forbidden":
        return unknown_key(full, keys_at(model, path[:-1])), False
    if item["loc"] and item["loc"][-1] == "[key]":
        return Problem(full, _sentence(kind, value, item), "", "key"), False
    if kind in ("literal_error", "enum"):
        options = str(item["ctx"]["expected"])
        names = [w.strip("' ") for w in options.replace(" or ", ", ").split(",")]
        hint = near(value, names) if isinstance(value, str) else ""
        return Problem(full, f"found {shown(value)}; expected {options}", hint if hint.startswith("did") else ""), True
    return Problem(full, _sentence(kind, value, item)), kind.rpartition("_")[2] in ("type", "parsing")


def _sentence(kind: str, value: Any, item: Any) -> str:
    message = str(item["msg"])
    stem = kind.rpartition("_")[0]
    if kind == "value_error":
        return str(item["ctx"]["error"])
    if kind == "int_from_float":
        return f"found {shown(value)}; expected a whole number"
    if kind.endswith(("_type", "_parsing")) and (name := _TYPES.get(stem.removeprefix("is_"))):
        return f"found {shown(value)}; expected {name}"
    if kind == "string_pattern_mismatch":
        return f"found {shown(value)}; expected text that matches {item['ctx']['pattern']}"
    if kind in ("too_short", "too_long"):
        wanted = item["ctx"].get("min_length", item["ctx"].get("max_length"))
        return (
            f"found {item['ctx']['actual_length']} items; expected {'at least' if kind == 'too_short' else 'at most'} {wanted}"
        )
    if message.startswith("Input should be "):
        return f"found {shown(value)}; expected {message.removeprefix('Input should be ').removeprefix('a valid ')}"
    return message[:1].lower() + message[1:]


def keys_at(model: Any, path: At) -> set[str]:
    """The keys that a model allows at a path inside it, over all branches of its unions."""
    models = _models(model)
    for part in path:
        below: list[Any] = []
        for m in models:
            for name, info in m.model_fields.items():
                if part in (name, info.alias):
                    below += _models(info.annotation)
        # An index or a free key of a mapping stays within what the field's annotation names.
        models = below or models
    return {str(info.alias or name) for m in models for name, info in m.model_fields.items()}


def _models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is not None:
        return [m for argument in typing.get_args(annotation) for m in _models(argument)]
    return []
