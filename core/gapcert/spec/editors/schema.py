"""The JSON Schema of a spec with every installed kind, so that editors complete plugins' options."""

from __future__ import annotations

import inspect
from collections.abc import Mapping

from pydantic import BaseModel, TypeAdapter

from gapcert.contracts.plugins.registry import Registry, registry
from gapcert.spec.check import BOUNDED, COMPONENTS, PLAIN, SAMPLING, bare
from gapcert.spec.editors.offers import SECTIONS, dressed, overlaid
from gapcert.spec.sections import hidden
from gapcert.spec.sections import sections as s
from gapcert.spec.sections.areas import GoalConfig
from gapcert.spec.sections.plugin_sections import Drawn, Schema, contributed

DIALECT = "https://json-schema.org/draft/2020-12/schema"


def schema(components: Registry | None = None) -> Schema:
    """The schema of a whole spec. Each section with a `kind` is a `oneOf` over the installed kinds; `kind` is required.

    It has two halves: `else` is a spec by itself; `then` one that `extends` another: nothing is required, and null removes.
    """
    known, definitions, part = components or registry(), Schema(), Schema()
    drawn, more = Drawn(part, definitions, known), contributed(known)
    part |= {name: _choice(name, drawn) for name in COMPONENTS}
    properties: Schema = {
        "version": {"const": 1},
        "name": {"type": "string", "pattern": f"^{s.NAME}$"},
        "extends": {"type": "string"},
        "matrix": {"type": "object", "additionalProperties": {"type": "array", "minItems": 1}},
        "seed": {"type": "integer", "minimum": 0},
        "domain": drawn.plain(TypeAdapter(s.Boxes).json_schema(), "domain"),
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
        "sampling": _one_of({k: drawn.plain(m.model_json_schema(), f"sampling.{k}") for k, m in SAMPLING.items()}),
        "lipschitz": {
            "type": "object",
            "properties": {k: part[f"lipschitz.{k}"] for k in BOUNDED},
            "additionalProperties": False,
        },
        **{k: v for k, v in part.items() if "." not in k},
        **{k: drawn.plain(m.model_json_schema(), k) for k, m in PLAIN.items()},
        "hidden": drawn.plain(hidden.schema(), "hidden"),
        **{name: section.schema(drawn) for name, section in more.items()},
        "expect": {"type": "object"},
    }
    executors = {"anyOf": [{"enum": known.names("executor")}, {"type": "string", "pattern": ":"}], "default": "processes"}
    for kind in SAMPLING:
        definitions[f"sampling.{kind}"]["properties"]["executor"] = executors
    whole: Schema = {"properties": properties, "required": ["version", "name"], "$defs": definitions}
    offered = dressed(whole)
    over = overlaid(offered)
    return {
        "$schema": DIALECT,
        "title": "Gapcert spec",
        "type": "object",
        "properties": {k: {"description": more[k].about if k in more else SECTIONS[k]} for k in properties},
        "additionalProperties": False,
        "if": {"required": ["extends"]},
        "then": {"properties": over["properties"]},
        "else": {k: offered[k] for k in ("properties", "required")},
        "$defs": offered["$defs"] | over["$defs"],
    }


def _choice(section: str, drawn: Drawn) -> Schema:
    options: dict[str, Schema] = {}
    known = drawn.registry
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
            if of := known.get(kind, name).of:
                body["properties"]["of"] = {"$ref": f"#/else/properties/{section if of == COMPONENTS[section] else of[0]}"}
            summary = known.get(kind, name).summary
            body["description"] = "\n\n".join([summary, *_told(model)])
            body.setdefault("properties", {}).setdefault("kind", {"const": name})["description"] = summary
            if section == "controller":
                body["properties"]["goal"] = drawn.plain(GoalConfig.model_json_schema(), "goal")
                body["required"].append("goal")
            options[name] = drawn.plain(body, f"{section}.{name}")
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
