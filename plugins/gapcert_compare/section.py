"""The `compare:` section: a matrix of certificates, and what is asked of each pair of backends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, final

from pydantic import Field

from gapcert.plugin import (
    At,
    Axes,
    Config,
    Count,
    Drawn,
    Name,
    Problem,
    Registry,
    Schema,
    Section,
    SpecSection,
    Whole,
    backend_axes,
    near,
    shown,
    unknown_key,
    validate,
)

if TYPE_CHECKING:
    from gapcert.plugin import Checker

ENTRIES = {"families": ("gap_family",), "lipschitz": ("lipschitz",)}
ALONE = ("controller", "closed_loop", "recording", "reality")
TWICE = {"families": "gap", "lipschitz": "lipschitz"}


@final
class PairsConfig(Section):
    """Two backends meet at `points` uniform points, in `rollouts` runs of `steps` steps under common random inputs, and on a
    map of `cells` × `cells` over `axes` (default: the first two).

    With `settings`, an engine is diagnosed by the motion of the other, options of both are changed one after the other, and
    what closes the difference by at least the share `least` is named.
    """

    points: Count = Field(2000, description="uniform points at which two backends are compared")
    rollouts: Whole = Field(10, description="runs under common random inputs")
    steps: Count = Field(200, description="of each run")
    cells: Whole = Field(40, description="of the map, along each axis")
    axes: Annotated[list[str], Field(min_length=2, max_length=2)] | None = Field(
        None, description="of the map; default: the first two"
    )
    settings: bool = Field(True, description="look for what separates two that differ?")
    least: Annotated[float, Field(strict=True, gt=0, lt=1)] = Field(
        0.01, description="share of the difference that a named setting closes, at least"
    )


@final
class Rest(Section):
    """What of the section is no component."""

    seeds: Annotated[list[Whole], Field(min_length=1)] | None = Field(
        None, description="one row of the matrix each; default: the spec's"
    )
    require: list[Name] = Field(default_factory=list, description="backends that must be installed")
    pairs: PairsConfig = Field(default_factory=PairsConfig, description="how two backends meet")


@final
@dataclass(frozen=True)
class CompareConfig:
    """A checked `compare:` section: plugins' config models by name or label.

    `unavailable` says, in a sentence each, which backends this machine lacks. Without families or constants there is one of
    each, the spec's own; without seeds, the spec's seed.
    """

    backends: Mapping[str, Any]
    families: Mapping[str, Any] = field(default_factory=dict)
    lipschitz: Mapping[str, Any] = field(default_factory=dict)
    seeds: tuple[int, ...] = ()
    require: tuple[str, ...] = ()
    pairs: PairsConfig = field(default_factory=PairsConfig)
    unavailable: Mapping[str, str] = field(default_factory=dict)


def _backends(checker: Checker, section: Mapping[str, Any], required: Sequence[str]) -> tuple[dict[str, Any], dict[str, str]]:
    """Config by name, and why some cannot be used here; a required one that cannot is an error."""
    at: At = ("compare", "backends")
    found = section.get("backends")
    if "backends" not in section:
        checker.say(at[:1], "missing required key 'backends'", "add backends: {name: {kind: ...}}", "key")
        return {}, {}
    if not isinstance(found, Mapping) or not found:
        checker.say(at, f"found {shown(found)}; expected a mapping of names to backends", "write name: {kind: ...}")
        return {}, {}
    checker.problems += [
        Problem(("compare", "require", i), f"no backend '{name}'", near(name, found))
        for i, name in enumerate(required)
        if name not in found
    ]
    configs: dict[str, Any] = {}
    unavailable: dict[str, str] = {}
    for name, one in found.items():
        renamed: list[Problem] = []
        validate(_Named, {"name": name}, (), renamed)
        checker.problems += [Problem((*at, name), p.message, p.hint, "key") for p in renamed]

        def absent(reason: str, name: str = name) -> bool:
            unavailable[name] = reason
            return name not in required

        if (config := checker.component((*at, name), one, ("backend", "model"), absent)) is not None:
            configs[name] = config
    return configs, unavailable


@final
class _Named(Section):
    name: Name = Field(description="of a backend in the comparison")


def _entries(checker: Checker, at: At, section: Any, kinds: tuple[str, ...]) -> dict[str, Any]:
    """Config by label; `envelope` is short for `{kind: envelope}`."""
    if not isinstance(section, list) or not section:
        checker.say(at, f"found {shown(section)}; expected a list of at least one", "write [{kind: ...}], or [name]")
        return {}
    written = [{"kind": one} if isinstance(one, str) else one for one in section]
    labels = _labels(written)
    made = {label: checker.component((*at, i), one, kinds) for i, (label, one) in enumerate(zip(labels, written, strict=True))}
    return {label: config for label, config in made.items() if config is not None}


def _labels(written: Sequence[Any]) -> list[str]:
    """The kind, with the options in which entries of one kind differ, or a number where they do not."""
    kinds = [str(w.get("kind")) if isinstance(w, Mapping) else "?" for w in written]
    out: list[str] = []
    for kind, one in zip(kinds, written, strict=True):
        same = [w for k, w in zip(kinds, written, strict=True) if k == kind and isinstance(w, Mapping)]
        if len(same) > 1:
            names = dict.fromkeys(n for w in same for n in w if n != "kind")
            differing = [n for n in names if any(w.get(n) != one.get(n) for w in same)]
            kind = " ".join([kind, *(f"{n}={one[n]}" for n in differing if n in one)])
        out.append(kind)
    return [label if out.count(label) == 1 else f"{label} #{i}" for i, label in enumerate(out, 1)]


@final
class CompareSection(SpecSection):
    model = Rest
    about = "simulators side by side"
    needs = ("model", "domain")
    instead = ("backend",)
    alone = True

    def read(self, checker: Checker, section: Any) -> CompareConfig | None:
        at: At = ("compare",)
        if not isinstance(section, Mapping):
            checker.say(at, f"found {shown(section)}; expected a mapping", "write compare: {backends: {name: {kind: ...}}}")
            return None
        known = ("backends", *ENTRIES, *Rest.model_fields)
        checker.problems += [unknown_key((*at, k), known) for k in section if k not in known]
        plain = validate(Rest, {k: v for k, v in section.items() if k in Rest.model_fields}, at, checker.problems)
        required = plain.require if plain is not None else []
        backends, unavailable = _backends(checker, section, required)
        entries = {key: _entries(checker, (*at, key), section[key], kinds) for key, kinds in ENTRIES.items() if key in section}
        if plain is None or not backends:
            return None
        return CompareConfig(
            backends,
            **entries,
            seeds=tuple(plain.seeds or ()),
            require=tuple(required),
            pairs=plain.pairs,
            unavailable=unavailable,
        )

    def relate(self, config: Config, data: Mapping[str, Any], axes: Axes, registry: Registry) -> list[Problem]:
        """What does not go with it, backends with other axes than the model's, and axes of its maps that there are not."""
        section = data["compare"]
        if not isinstance(section, Mapping):
            return []
        told = "'{}' does not go with 'compare'"
        found = [
            Problem((k,), told.format(k), f"write it in a spec of its own, or {k}: null", "key") for k in ALONE if k in data
        ]
        if "backend" in data:
            found.append(Problem(("backend",), told.format("backend"), "move it to compare.backends", "key"))
        found += [
            Problem(("compare", key), f"'{key}' stands beside the section '{other}'", "give one of them", "key")
            for key, other in TWICE.items()
            if key in section and other in data
        ]
        pairs, names = section.get("pairs"), (*axes.states, *axes.inputs)
        chosen = pairs.get("axes") if isinstance(pairs, Mapping) else None
        for i, name in enumerate(chosen if isinstance(chosen, list) and names else ()):
            if name not in names:
                found.append(Problem(("compare", "pairs", "axes", i), f"no axis '{name}'", near(str(name), names)))
        made: CompareConfig | None = config.sections.get("compare")
        backends, known = section.get("backends"), {} if made is None else made.backends
        for name, one in backends.items() if isinstance(backends, Mapping) else ():
            found += backend_axes(one, axes, registry, ("compare", "backends", name), known.get(name))
        return found

    def schema(self, drawn: Drawn) -> Schema:
        """Backends by name, lists of families and constants (a name is short for its kind), and the plain rest."""
        body = drawn.plain(Rest.model_json_schema(), "compare.rest")
        properties = dict(drawn.definitions[body["$ref"].rpartition("/")[2]]["properties"])
        properties["backends"] = {"type": "object", "minProperties": 1, "additionalProperties": drawn.parts["backend"]}
        for (key, (kind,)), part in zip(ENTRIES.items(), ("gap", "lipschitz.residual"), strict=True):
            either = [{"enum": drawn.registry.names(kind)}, drawn.parts[part]]
            properties[key] = {"type": "array", "minItems": 1, "items": {"anyOf": either}}
        return {"type": "object", "properties": properties, "required": ["backends"], "additionalProperties": False}
