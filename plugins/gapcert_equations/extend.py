"""Effects written into a model's text, so that the extended model is a spec like any other."""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from gapcert import Parameter, UsageError
from gapcert.plugin import Extension
from gapcert_equations.thresholds import THRESHOLDS

from .config import EquationsConfig, MemoryConfig, OutputConfig, ParameterConfig
from .text import declarations
from .text.grammar import near, parse, substitute
from .text.units import SECOND

Texts = dict[str, str]

_PLACEHOLDER = re.compile(r"\{\w*\}")


def extended(config: EquationsConfig, extensions: Sequence[Extension]) -> EquationsConfig:
    """The config with each effect added in turn."""
    through = declarations.shown(config)
    for e in extensions:
        config = _add(config, e, through)
    return config


def _add(config: EquationsConfig, e: Extension, through: Sequence[str]) -> EquationsConfig:
    """through: outputs that show inputs through the plant."""
    where = f"effect '{e.effect}' at '{e.site}'"
    _names_are_free(config, e, where)
    instant = e.input and _written(config, _replaced(e, input=_instant(e.input)), where)[0].input
    e, clock = _written(config, e, where)
    changes: dict[str, Any] = {"parameters": {**config.parameters, **{p.name: _stated(p) for p in e.parameters}}}
    forces = {site: text for site, text in {e.site: e.force, **e.forces}.items() if text is not None}
    added = {"forces" if config.form == "mechanical" else "derivative": forces}
    laws = ("dry_friction", "payload", "tilt", "implicit")
    added |= {section: {e.site: text} for section in laws if (text := getattr(e, section)) is not None}
    for section, texts in added.items():
        old = getattr(config, section) or {}
        if texts:
            changes[section] = {**old, **{site: _sum(old.get(site), text) for site, text in texts.items()}}
    for section, late in (("input_delay", e.delay), ("output_delay", e.output_delay)):
        if late is not None:
            delays = getattr(config, section)
            changes[section] = delays | {e.site: _later(where, delays.get(e.site), late)}
    if e.substeps > config.substeps:
        changes["substeps"] = e.substeps
    if e.output is not None:
        changes["outputs"] = _outputs(config, e)
    new = config.model_copy(update=changes)
    if e.input is not None and instant is not None:
        new = _everywhere(new, {e.site: e.input}, {e.site: instant}, through)
    # Its own memory sees the input as it was commanded, so it comes after the replacement.
    memory = {m.name: MemoryConfig(unit=m.unit, next=m.next, start=m.start) for m in e.memory}
    return new.model_copy(update={"memory": {**new.memory, **memory, **clock}}) if memory or clock else new


def _names_are_free(config: EquationsConfig, e: Extension, where: str) -> None:
    taken = {*declarations.states(config), *config.inputs, *config.parameters, *config.memory, declarations.substep(config)}
    for kind, name in [("parameter", p.name) for p in e.parameters] + [("memory", m.name) for m in e.memory]:
        if name in taken:
            raise UsageError(f"{where}: {kind} '{name}' is already a name of the model; rename it")
        taken.add(name)


def _written(config: EquationsConfig, e: Extension, where: str) -> tuple[Extension, dict[str, MemoryConfig]]:
    """The effect with the site's names for its placeholders, and the clock that `{t}` needs."""
    names, used = _placeholders(config, e, where), set()

    def fill(text: str) -> str:
        def one(match: re.Match[str]) -> str:
            if match[0] not in names:
                raise UsageError(f"{where}: the site has no {match[0]}; it has {', '.join(names)}")
            used.add(match[0])
            return names[match[0]]

        return _PLACEHOLDER.sub(one, text)

    texts = ("force", "dry_friction", "input", "output", "delay", "output_delay", "tilt", "payload", "implicit")
    filled: dict[str, Any] = {t: None if (text := getattr(e, t)) is None else fill(text) for t in texts}
    filled["forces"] = {q: fill(text) for q, text in e.forces.items()}
    filled["memory"] = tuple(_replaced(m, next=fill(m.next)) for m in e.memory)
    clock = {}
    if "{t}" in used and "time" not in config.memory:
        if "time" in {*declarations.states(config), *config.inputs, *config.parameters}:
            raise UsageError(f"{where}: the model has a 'time' of its own, which the clock of effects needs; rename it")
        clock = {"time": MemoryConfig(unit="s", next=f"time + {declarations.substep(config)}")}
    return _replaced(e, **filled), clock


def _instant(text: str | None) -> str | None:
    """What acts when a sample is taken, of what acts on average over a sub-step: the average over next to nothing."""
    return text and text.replace("{h}", f"({THRESHOLDS.instant!r}*{{h}})")


def _replaced(data: Any, **changes: Any) -> Any:
    """`dataclasses.replace`, without its cost."""
    return type(data)(**{**vars(data), **changes})


def _placeholders(config: EquationsConfig, e: Extension, where: str) -> Texts:
    """What {q}, {v}, {u}, {f}, {y}, {t}, {h} stand for at the site."""
    general = {"{t}": "time", "{h}": declarations.substep(config)}
    if e.input is not None or e.delay is not None:
        _require(where, e.site, config.inputs)
        return {"{u}": e.site, **general}
    if e.output is not None or e.output_delay is not None:
        known = dict(config.outputs) or {x: x for x in declarations.states(config)}
        _require(where, e.site, known)
        old = known[e.site]
        return {"{y}": _bracketed(old.expr if isinstance(old, OutputConfig) else old), **general}
    acts = (e.force, e.dry_friction, e.tilt, e.payload, e.implicit)
    if all(text is None for text in acts) and not e.forces and not e.memory:
        if e.frees is not None:
            _require(where, e.frees, config.parameters)
        return general
    for site in (e.site, *e.forces):
        _require(where, site, declarations.sites(config))
    if config.form == "mechanical":
        names = {"{q}": e.site, "{v}": f"{e.site}_dot", "{f}": config.forces.get(e.site, "0")}
    else:
        if e.tilt is not None or e.payload is not None or e.implicit is not None:
            raise UsageError(f"{where}: gravity, payloads and inertia act through a mass_matrix; this model is a derivative")
        names = {"{v}": e.site, "{f}": (config.derivative or {})[e.site]}
        integrals = [q for q, v in declarations.positions(config.derivative or {}).items() if v == e.site]
        if integrals:
            names["{q}"] = integrals[0]
    return {**names, "{f}": _bracketed(names["{f}"]), **general}


def _bracketed(text: str) -> str:
    return text if text.isidentifier() else f"({text})"


def _require(where: str, site: str, known: Sequence[str] | Mapping[str, Any]) -> None:
    if site not in known:
        raise UsageError(f"{where}: the model has no such site; {near(site, known)}")


def _later(where: str, old: str | None, new: str) -> str:
    seconds = declarations.quantity_in(old, SECOND) if old is not None else 0.0
    if seconds == 0:
        return new
    if seconds is not None:
        raise UsageError(f"{where}: there is already the fixed delay {old}; make it a parameter, then the two can be added")
    return _sum(old, new)


def _sum(old: str | None, new: str) -> str:
    """old + new as it would be written by hand."""
    if old is None or old.strip() in ("0", "0.0"):
        return new
    tree = parse(new)
    if isinstance(tree, ast.BinOp) and isinstance(tree.op, ast.Add | ast.Sub):
        return f"{old} + ({new})"
    return f"{old} - {new.strip()[1:].lstrip()}" if new.strip().startswith("-") else f"{old} + {new}"


def _stated(p: Parameter) -> ParameterConfig:
    def quantity(value: float) -> str | float:
        return value if p.unit == "1" else f"{value!r} {p.unit}"

    return ParameterConfig(
        value=quantity(p.value),
        tolerance=quantity(p.tolerance) if p.tolerance else None,
        low=quantity(p.low) if math.isfinite(p.low) else None,
        high=quantity(p.high) if math.isfinite(p.high) else None,
    )


def _outputs(config: EquationsConfig, e: Extension) -> dict[str, str | OutputConfig]:
    outputs: dict[str, str | OutputConfig] = dict(config.outputs) or {x: x for x in declarations.states(config)}
    return outputs | {e.site: _output(outputs[e.site], lambda _: e.output or "")}


def _output(old: str | OutputConfig, new: Callable[[str], str]) -> str | OutputConfig:
    return new(old) if isinstance(old, str) else old.model_copy(update={"expr": new(old.expr)})


def _everywhere(config: EquationsConfig, replacement: Texts, instant: Texts, through: Sequence[str]) -> EquationsConfig:
    """An input replaced in every expression of the dynamics, and in outputs that show what acts at an instant."""

    def texts(section: Mapping[str, str] | None) -> Texts | None:
        return None if section is None else {k: substitute(t, replacement) for k, t in section.items()}

    sections = {k: texts(getattr(config, k)) for k in ("derivative", "next", "bias", "forces", "dry_friction", "implicit")}
    matrix = None if config.mass_matrix is None else [[substitute(t, replacement) for t in row] for row in config.mass_matrix]
    memory = {z: m.model_copy(update={"next": substitute(m.next, replacement)}) for z, m in config.memory.items()}
    seen = {y: _output(o, lambda t: substitute(t, instant)) if y in through else o for y, o in config.outputs.items()}
    return config.model_copy(update={**sections, "mass_matrix": matrix, "memory": memory, "outputs": seen})
