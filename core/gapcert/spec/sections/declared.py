"""What a spec may ask of a gap that a person declares."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gapcert.contracts.plugins.registry import Registry
from gapcert.spec.sections.config import Config
from gapcert.spec.sections.plugin_sections import SpecSection, simulated
from gapcert.spec.text.source import Problem

SIMULATED = ("sampling", "symmetries")
"""Sections that need a simulator."""


def declared(data: Mapping[str, Any], registry: Registry) -> bool:
    """Is γ what a person says?"""
    gap = data.get("gap")
    component = registry.components.get(("gap_family", str(gap.get("kind")))) if isinstance(gap, Mapping) else None
    return component is not None and component.claim == "assumed"


def unasked(data: Mapping[str, Any], registry: Registry, more: Mapping[str, SpecSection]) -> bool:
    """Is it declared where no simulator and no recording is there to be asked?"""
    others = ("backend", "reality", "recording", *(name for name, section in more.items() if "backend" in section.instead))
    return declared(data, registry) and not any(section in data for section in others)


def declared_problems(
    config: Config, data: Mapping[str, Any], registry: Registry, more: Mapping[str, SpecSection]
) -> list[Problem]:
    """What does not go with a declared γ, or goes with nothing else."""
    asked = config.certificate
    if not declared(data, registry):
        if asked is None or asked.claim != "assumed":
            return []
        hint = "use claim: empirical, or gap: {kind: declared, gamma: {state: ..}}"
        return [Problem(("certificate", "claim"), "only a declared γ is assumed, and this one is found", hint)]
    found = []
    if "lipschitz" in data:
        found.append(Problem(("lipschitz",), "a declared γ rests on no constants", "remove lipschitz:", "key"))
    if not unasked(data, registry, more):
        return found
    what = "needs a simulator, and γ is declared without one"
    short = [k for k in ("model", "domain") if k not in data and {"controller", "certificate"} & data.keys()]
    found += [Problem(("gap",), f"'gap' needs '{k}', which is missing", f"add {k}:", "key") for k in short]
    found += [
        Problem((k,), f"'{k}' {what}", "add backend:, or remove it", "key") for k in simulated(SIMULATED, more) if k in data
    ]
    spent = () if asked is None else sorted(asked.model_fields_set - {"claim"})
    found += [Problem(("certificate", k), f"'{k}' {what}", "add backend:, or remove it", "key") for k in spent]
    if config.report.beside:
        found.append(Problem(("report", "beside"), f"'beside' {what}", "add backend:, or remove it", "key"))
    return found
