"""The JSON Schema of a spec with every installed kind, so that editors complete plugins' options."""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, TypeAdapter

from gapcert.components import Registry, registry
from gapcert.spec import hidden
from gapcert.spec import sections as s
from gapcert.spec.areas import GoalConfig
from gapcert.spec.check import BOUNDED, COMPONENTS, PLAIN, SAMPLING, bare
from gapcert.spec.comparison import Rest
from gapcert.spec.offers import SECTIONS, dressed, overlaid

DIALECT = "https://json-schema.org/draft/2020-12/schema"
Schema = dict[str, Any]


def schema(components: Registry | None = None) -> Schema:
    """The schema of a whole spec. Each section with a `kind` is a `oneOf` over the installed kinds; `kind` is required.

    It has two halves: `else` is a spec by itself; `then` one that `extends` another: nothing is required, and null removes.
    """
    known, definitions = components or registry(), Schema()
    part: Schema = {name: _choice(name, known, definitions) for name in COMPONENTS}
    properties: Schema = {
        "version": {"const": 1},
        "name": {"type": "string", "pattern": f"^{s.NAME}$"},
        "extends": {"type": "string"},
        "matrix": {"type": "object", "additionalProperties": {"type": "array", "minItems": 1}},
        "seed": {"type": "integer", "minimum": 0},
        "domain": _plain(TypeAdapter(s.Boxes).json_schema(), "domain", definitions),
        "relations": {
            "type": "array",
            "minItems": 1,
            "items": {"type": "string", "description": "linear, such as abs(u - v) <= 0.5 m/s"},
        },
        "coordinates": {
            "type": "object",
            "minProperties": 1,
            "additionalProperties": {"type": "string", "description": "in place of an input: it and states, such as u - v"},
        },
        "sampling": _one_of({k: _plain(m.model_json_schema(), f"sampling.{k}", definitions) for k, m in SAMPLING.items()}),
        "lipschitz": {
            "type": "object",
            "properties": {k: part[f"lipschitz.{k}"] for k in BOUNDED},
            "additionalProperties": False,
        },
        **{k: v for k, v in part.items() if "." not in k},
        **{k: _plain(m.model_json_schema(), k, definitions) for k, m in PLAIN.items()},
        "compare": _comparison(part, definitions),
        "hidden": _plain(hidden.schema(), "hidden", definitions),
        "expect": {"type": "object"},
    }
    _names(properties, definitions, known)
    whole: Schema = {"properties": properties, "required": ["version", "name"], "$defs": definitions}
    offered = dressed(whole)
    part = overlaid(offered)
    return {
        "$schema": DIALECT,
        "title": "Gapcert spec",
        "type": "object",
        "properties": {k: {"description": SECTIONS[k]} for k in properties},
        "additionalProperties": False,
        "if": {"required": ["extends"]},
        "then": {"properties": part["properties"]},
        "else": {k: offered[k] for k in ("properties", "required")},
        "$defs": offered["$defs"] | part["$defs"],
    }


def _names(properties: Schema, definitions: Schema, known: Registry) -> None:
    """What else is chosen by name: effects, and executors, those with an address as well."""
    effects = {"anyOf": [{"const": "all"}, {"type": "array", "items": {"enum": known.names("effect")}}], "default": "all"}
    definitions["diagnose"]["properties"]["effects"] = effects
    executors = {"anyOf": [{"enum": known.names("executor")}, {"type": "string", "pattern": ":"}], "default": "processes"}
    for kind in SAMPLING:
        definitions[f"sampling.{kind}"]["properties"]["executor"] = executors
    for key, kind in (("families", "gap_family"), ("lipschitz", "lipschitz")):
        properties["compare"]["properties"][key]["items"]["anyOf"][0] = {"enum": known.names(kind)}


def _comparison(part: Mapping[str, Schema], definitions: Schema) -> Schema:
    """Backends by name, lists of families and constants (a name is short for its kind), and the plain rest."""
    body = _plain(Rest.model_json_schema(), "compare.rest", definitions)
    properties = dict(definitions[body["$ref"].rpartition("/")[2]]["properties"])
    properties["backends"] = {"type": "object", "minProperties": 1, "additionalProperties": part["backend"]}
    for key, section in (("families", "gap"), ("lipschitz", "lipschitz.residual")):
        properties[key] = {"type": "array", "minItems": 1, "items": {"anyOf": [{"type": "string"}, part[section]]}}
    return {"type": "object", "properties": properties, "required": ["backends"], "additionalProperties": False}


def _choice(section: str, known: Registry, definitions: Schema) -> Schema:
    options: dict[str, Schema] = {}
    for kind in COMPONENTS[section]:
        for name in known.names(kind):
            if name in options:
                continue
            try:
                model: type[BaseModel] = known.config(kind, name) or bare(name)
                body = model.model_json_schema()
            except Exception:  # a plugin's config module may fail in any way; validation names the fault
                continue
            body["required"] = sorted({"kind", *body.get("required", [])})
            if "of" in body.get("properties", {}):
                body["properties"]["of"] = {"$ref": f"#/else/properties/{getattr(model, 'OF', (section,))[0]}"}
            summary = known.get(kind, name).summary
            body["description"] = "\n\n".join([summary, *_told(model)])
            body.setdefault("properties", {}).setdefault("kind", {"const": name})["description"] = summary
            if section == "controller":
                body["properties"]["goal"] = _plain(GoalConfig.model_json_schema(), "goal", definitions)
                body["required"].append("goal")
            options[name] = _plain(body, f"{section}.{name}", definitions)
    return _one_of(options)


def _told(model: type[BaseModel]) -> list[str]:
    """What an option model and those that it extends say of themselves."""
    own = [c for c in model.__mro__ if issubclass(c, BaseModel) and c not in (BaseModel, s.Section)]
    return [inspect.cleandoc(text) for c in own if (text := vars(c).get("__doc__"))]


def _one_of(options: Mapping[str, Schema]) -> Schema:
    mapping = {name: option["$ref"] for name, option in options.items()}
    return {
        "type": "object",
        "required": ["kind"],
        "oneOf": list(options.values()),
        "discriminator": {"propertyName": "kind", "mapping": mapping},
    }


def _plain(body: Schema, name: str, definitions: Schema) -> Schema:
    """Move a schema into the common definitions, its own ones under its name, and refer to it."""
    own = body.pop("$defs", {})
    for key, value in {**{f"{name}.{k}": v for k, v in own.items()}, name: body}.items():
        text = json.dumps(value)
        for k in own:
            text = text.replace(f'"#/$defs/{k}"', json.dumps(f"#/$defs/{name}.{k}"))
        definitions[key] = json.loads(text)
    return {"$ref": f"#/$defs/{name}"}
