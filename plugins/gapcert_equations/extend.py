"""Effects written into a model's text, so that the extended model is a spec like any other."""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from gapcert import Extension, Parameter, UsageError
from gapcert_equations import checks
from gapcert_equations.config import EquationsConfig, OutputConfig, ParameterConfig
from gapcert_equations.grammar import near, parse, substitute

Texts = dict[str, str]


def extended(config: EquationsConfig, extensions: Sequence[Extension]) -> EquationsConfig:
    """The config with each effect added in turn."""
    for e in extensions:
        config = _add(config, e)
    return config


def _add(config: EquationsConfig, e: Extension) -> EquationsConfig:
    where = f"effect '{e.effect}' at '{e.site}'"
    taken = {*checks.states(config), *config.inputs, *config.parameters}
    if (double := next((p.name for p in e.parameters if p.name in taken), None)) is not None:
        raise UsageError(f"{where}: parameter '{double}' is already a name of the model; rename it")
    changes: dict[str, Any] = {"parameters": {**config.parameters, **{p.name: _stated(p) for p in e.parameters}}}
    if e.force is not None:
        key = "forces" if config.form == "mechanical" else "derivative"
        texts = dict(getattr(config, key) or {})
        changes[key] = texts | {e.site: _sum(texts.get(e.site), _filled(config, e, e.force))}
    if e.dry_friction is not None:
        texts = config.dry_friction
        changes["dry_friction"] = texts | {e.site: _sum(texts.get(e.site), _filled(config, e, e.dry_friction))}
    if e.input is not None or e.delay is not None:
        _require(where, e.site, config.inputs)
    if e.delay is not None:
        changes["input_delay"] = config.input_delay | {e.site: _later(where, config.input_delay.get(e.site), e)}
    if e.output is not None:
        changes["outputs"] = _outputs(config, e, where)
    new = config.model_copy(update=changes)
    return _everywhere(new, {e.site: _filled(config, e, e.input)}) if e.input is not None else new


def _filled(config: EquationsConfig, e: Extension, text: str) -> str:
    """The effect's text with the site's names for {q}, {v} and {u}."""
    where = f"effect '{e.effect}' at '{e.site}'"
    names: Texts = {}
    if e.input is not None and text is e.input:
        names["{u}"] = e.site
    else:
        _require(where, e.site, checks.sites(config))
        if config.form == "mechanical":
            names = {"{q}": e.site, "{v}": f"{e.site}_dot"}
        else:
            names["{v}"] = e.site
            integrals = [q for q, v in checks.positions(config.derivative or {}).items() if v == e.site]
            names |= {"{q}": integrals[0]} if integrals else {}
    for placeholder in re.findall(r"\{\w*\}", text):
        if placeholder not in names:
            raise UsageError(f"{where}: the site has no {placeholder}; it has {', '.join(names)}")
        text = text.replace(placeholder, names[placeholder])
    return text


def _require(where: str, site: str, known: Sequence[str] | Mapping[str, Any]) -> None:
    if site not in known:
        raise UsageError(f"{where}: the model has no such site; {near(site, known)}")


def _later(where: str, old: str | None, e: Extension) -> str:
    new = (e.delay or "").replace("{u}", e.site)
    seconds = checks.delay_seconds(old) if old is not None else 0.0
    if seconds == 0:
        return new
    if seconds is not None:
        raise UsageError(
            f"{where}: the input already has the fixed delay {old}; make it a parameter, then the two can be added"
        )
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


def _outputs(config: EquationsConfig, e: Extension, where: str) -> dict[str, str | OutputConfig]:
    outputs: dict[str, str | OutputConfig] = dict(config.outputs) or {x: x for x in checks.states(config)}
    _require(where, e.site, outputs)
    old = outputs[e.site]
    text = old.expr if isinstance(old, OutputConfig) else old
    new = (e.output or "").replace("{y}", text if text.isidentifier() else f"({text})")
    return outputs | {e.site: old.model_copy(update={"expr": new}) if isinstance(old, OutputConfig) else new}


def _everywhere(config: EquationsConfig, replacement: Texts) -> EquationsConfig:
    """An input replaced in every expression of the dynamics; the outputs show what was commanded."""

    def texts(section: Mapping[str, str] | None) -> Texts | None:
        return None if section is None else {k: substitute(t, replacement) for k, t in section.items()}

    sections = {k: texts(getattr(config, k)) for k in ("derivative", "next", "bias", "forces", "dry_friction")}
    matrix = None if config.mass_matrix is None else [[substitute(t, replacement) for t in row] for row in config.mass_matrix]
    return config.model_copy(update={**sections, "mass_matrix": matrix})
