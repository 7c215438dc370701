"""What makes a schema a help in an editor: units that are offered, words on hover, and specs that extend others."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from typing import Any

Schema = dict[str, Any]
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
SECTIONS: Mapping[str, str] = {
    "version": "of the format: 1",
    "name": "of the run, in lower-case letters, digits, - and _",
    "extends": "another spec that this one is merged over; null removes what it has",
    "matrix": "path of a value: list of values; one run for each combination",
    "seed": "of everything that is drawn",
    "model": "what is trusted to be right up to a gap: equations whose slopes and ranges are known",
    "backend": "the simulator that the model is certified against",
    "reality": "what stands for the real system in a diagnosis: any backend or model, to which inputs are played",
    "recording": "a log of the real system",
    "domain": "name of a state or input: [low, high]; where the claim holds",
    "relations": "linear inequalities that cut the domain",
    "coordinates": "linear combinations that take the place of an input",
    "symmetries": "what leaves the gap as it is",
    "sampling": "which transitions of the simulator are looked at",
    "lipschitz": "how fast the gap can change between samples, and how that is known",
    "gap": "the family of functions that bounds the gap",
    "certificate": "what is claimed of the bound, and by which route",
    "hidden": "what happens to state that the simulator has and the model has not",
    "controller": "a goal, and what makes a controller that reaches it against the gap",
    "report": "what a run leaves behind besides its summary",
    "expect": "path into the summary, with an operator after a space: value",
}
_LISTED, _NAMED = ("anyOf", "oneOf", "allOf", "prefixItems"), ("properties", "$defs", "patternProperties")
_SINGLE = ("items", "additionalProperties", "if", "then", "else", "not")


def dressed(schema: Schema) -> Schema:
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


def overlaid(schema: Schema) -> Schema:
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
