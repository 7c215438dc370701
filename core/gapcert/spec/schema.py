"""The JSON Schema of a spec with every installed kind: editors complete plugins' options, offer units and explain on hover."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Mapping
from typing import Any

from pydantic import BaseModel, TypeAdapter

from gapcert.contracts.plugins.registry import Registry, registry
from gapcert.spec.check import BOUNDED, COMPONENTS, PLAIN, SAMPLING, bare
from gapcert.spec.sections import sections as s
from gapcert.spec.sections.plugin_sections import Drawn, Schema, contributed

DIALECT = "https://json-schema.org/draft/2020-12/schema"
UNITS: Mapping[str, str] = {
    "1": "a pure number",
    "rad": "angle",
    "rad/s": "angular velocity",
    "rad/s^2": "angular acceleration",
    "deg": "angle",
    "m": "length",
    "m/s": "velocity",
    "m/s^2": "acceleration",
    "kg": "mass",
    "kg*m^2": "moment of inertia",
    "N": "force",
    "N*m": "torque",
    "N/m": "stiffness",
    "N*m/rad": "stiffness of a joint",
    "N*s/m": "viscous friction",
    "N*m*s": "viscous friction of a joint",
    "s": "time",
    "ms": "time",
    "Hz": "frequency",
    "V": "voltage",
    "A": "current",
    "K": "temperature",
    "Pa": "pressure",
}
_OFTEN: Mapping[str, Mapping[str, str]] = {
    "": {f"1 {u}": t for u, t in UNITS.items() if u != "1"},
    "s": {"5 ms": "milliseconds", "0.5 s": "seconds"},
    "%": {"10 %": "a share"},
}
_LISTED, _NAMED = ("anyOf", "oneOf", "allOf", "prefixItems"), ("properties", "$defs", "patternProperties")
_SINGLE = ("items", "additionalProperties", "if", "then", "else", "not")


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
        "hidden": drawn.plain(TypeAdapter(s.Hidden).json_schema(), "hidden"),
        **{name: section.schema(drawn) for name, section in more.items()},
        "expect": {"type": "object"},
    }
    executors = {"anyOf": [{"enum": known.names("executor")}, {"type": "string", "pattern": ":"}], "default": "processes"}
    for kind in SAMPLING:
        definitions[f"sampling.{kind}"]["properties"]["executor"] = executors
    whole: Schema = {"properties": properties, "required": ["version", "name"], "$defs": definitions}
    offered = _dressed(whole)
    over = _overlaid(offered)
    return {
        "$schema": DIALECT,
        "title": "Gapcert spec",
        "type": "object",
        "properties": {k: {"description": more[k].about if k in more else s.SECTIONS[k]} for k in properties},
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
                body["properties"]["goal"] = drawn.plain(s.GoalConfig.model_json_schema(), "goal")
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


def _dressed(schema: Schema) -> Schema:
    """A schema whose markers `quantity` and `unit` have become offers, and whose options say on hover what they do."""
    offers: dict[str, Schema] = {}

    def dress(node: Schema) -> Schema:
        node = {k: v for k, v in node.items() if k != "title" and not (k == "default" and v is None)}
        # Other people's schemas may use these words for something else.
        if isinstance(unit := node.get("quantity"), str):
            del node["quantity"]
            node = _offer(offers, node, [_quantity(text, what) for text, what in _OFTEN.get(unit, {f"1 {unit}": ""}).items()])
        if node.get("unit") is True:
            del node["unit"]
            node = _offer(offers, node, [{"label": u, "description": what, "body": u} for u, what in UNITS.items()])
        for name, option in node.get("properties", {}).items():
            if isinstance(option, dict) and "description" not in option and (told := _about(name, node.get("description", ""))):
                option["description"] = told
        return node

    found = _walk(schema, dress)
    titled = {k: {"title": _title(k), **v} for k, v in found["$defs"].items()}
    return {**found, "$defs": titled | {f"offer{k}": v for k, v in enumerate(offers.values())}}


def _title(definition: str) -> str:
    """`mujoco` of `backend.mujoco`, `output` of `model.equations.OutputConfig`."""
    name = definition.rpartition(".")[2].strip("_").removesuffix("Config")
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()


def _offer(offers: dict[str, Schema], node: Schema, snippets: list[Schema]) -> Schema:
    """The node with the snippets, which all nodes that offer the same share: each list is written once."""
    shared = {k: node.pop(k) for k in ("type", "anyOf") if k in node} | {"defaultSnippets": snippets}
    offers.setdefault(key := json.dumps(shared), shared)
    return node | {"$ref": f"#/$defs/offer{list(offers).index(key)}"}


def _quantity(text: str, what: str) -> Schema:
    """`5 ms` as a snippet: the label is the unit, and the number is selected, to be typed over."""
    number, _, unit = text.partition(" ")
    return {"label": unit, "description": what, "body": f"${{1:{number}}} {unit}"}


def _about(name: str, text: str) -> str:
    """The sentences of a section's description that speak of one of its options."""
    sentences = re.split(r"(?<=\.)\s+", text.strip())
    word = re.escape(name)
    return " ".join(" ".join(s.split()) for s in sentences if re.search(rf"`{word}[`:]|(?:^|\s){word}:", s))


def _overlaid(schema: Schema) -> Schema:
    """The same for a spec that extends another: nothing is required, null removes what was there, and no kind need be said."""
    shared = {k for k, v in schema["$defs"].items() if "defaultSnippets" in v}

    def loosen(node: Schema) -> Schema:
        node = {k: v for k, v in node.items() if k not in ("required", "discriminator", "minProperties")}
        if "$ref" in node and node["$ref"].rpartition("/")[2] not in shared:
            node["$ref"] = node["$ref"].replace("#/$defs/", "#/$defs/part.").replace("#/else/", "#/then/")
        if "oneOf" in node:
            node["anyOf"] = node.pop("oneOf")
        if isinstance(given := node.get("properties"), dict):
            node["properties"] = {k: _or_null(v) for k, v in given.items()}
        if isinstance(given := node.get("additionalProperties"), dict):
            node["additionalProperties"] = _or_null(given)
        return node

    found = _walk(schema, loosen)
    return {**found, "$defs": {f"part.{k}": v for k, v in found["$defs"].items() if k not in shared}}


def _or_null(node: Any) -> Any:
    if not isinstance(node, dict):
        return node
    told = {"description": node["description"]} if "description" in node else {}
    return {"anyOf": [node, {"type": "null"}], **told}


def _walk(node: Any, change: Callable[[Schema], Schema]) -> Any:
    """Every schema inside a schema, the inner ones first; an option that is called `items` only looks like one."""
    if not isinstance(node, dict):
        return node
    out = dict(node)
    for key in _NAMED:
        if isinstance(out.get(key), dict):
            out[key] = {k: _walk(v, change) for k, v in out[key].items()}
    for key in _LISTED:
        if isinstance(out.get(key), list):
            out[key] = [_walk(v, change) for v in out[key]]
    for key in _SINGLE:
        if key in out:
            out[key] = _walk(out[key], change)
    return change(out)
