"""What a spec may ask where no simulator is there to be asked: of a gap that a person declares, and of a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gapcert.contracts.plugins.options import of_config
from gapcert.contracts.plugins.registry import Registry
from gapcert.spec.sections.plugin_sections import SpecSection
from gapcert.spec.sections.sections import CertificateConfig, Config
from gapcert.spec.source import Problem

BESIDE_DECLARED = ("sampling", "symmetries")
BESIDE_MEASURED = ("sampling", "hidden", "symmetries", "coordinates", "controller")
"""Sections that need a simulator, which can be asked at any point."""


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
    asking = _asking(BESIDE_DECLARED, data, more)
    found += [Problem((k,), f"'{k}' {what}", "add backend:, or remove it", "key") for k in asking]
    spent = () if asked is None else sorted(asked.model_fields_set - {"claim"})
    found += [Problem(("certificate", k), f"'{k}' {what}", "add backend:, or remove it", "key") for k in spent]
    if config.report.beside:
        found.append(Problem(("report", "beside"), f"'beside' {what}", "add backend:, or remove it", "key"))
    return found


def measured(data: Mapping[str, Any], more: Mapping[str, SpecSection]) -> bool:
    """Is it a recording that the model is certified against?"""
    others = ("backend", "reality", *(name for name, section in more.items() if section.alone))
    return {"recording", "certificate"} <= data.keys() and not any(section in data for section in others)


def measured_problems(
    config: Config, data: Mapping[str, Any], axes: Mapping[str, str], more: Mapping[str, SpecSection]
) -> list[Problem]:
    """axes: states and inputs of the model, with their units."""
    asked = config.certificate
    if not measured(data, more):
        own = [k for k in ("window", "fit") if asked is not None and getattr(asked, k) is not None]
        what = "only a recording in place of a backend has windows"
        return [Problem(("certificate", k), what, f"remove {k}:", "key") for k in own]
    hint = "the spec has a recording in its place"
    found = [Problem((k,), f"'{k}' needs a simulator", hint, "key") for k in _asking(BESIDE_MEASURED, data, more)]
    if config.report.beside:
        found.append(
            Problem(("report", "beside"), "certificates of a recording have none beside them", "remove beside:", "key")
        )
    if option := of_config(config.recording, "resampled"):
        what = "a calibration takes rows as they were measured, one period of the model apart"
        found.append(Problem(("recording", option), what, f"remove {option}:", "key"))
    told = of_config(config.recording, "channels")
    # A rotation's parts have columns of their own, and are refused as what they are.
    have = set(axes) if told is None else {str(c).partition(".")[0] for c in told[1]}
    if missing := [n for n in axes if n not in have]:
        what = f"nothing for '{missing[0]}'; every state and input of the model has to be measured ({', '.join(axes)})"
        found.append(Problem(("recording", told[0]), what, f"add {missing[0]}:", "key"))
    return found + ([] if asked is None else _claim(asked))


def _asking(own: Sequence[str], data: Mapping[str, Any], more: Mapping[str, SpecSection]) -> list[str]:
    """Sections that are there and ask a simulator: some of the core's own, and those of plugins that say so."""
    return [k for k in (*own, *(name for name, section in more.items() if section.simulated)) if k in data]


def _claim(asked: CertificateConfig) -> list[Problem]:
    found = []
    if asked.route not in (None, "calibrate"):
        what = f"route {asked.route} asks a simulator at points of its own choice, and there is a recording"
        found.append(Problem(("certificate", "route"), what, "use route: calibrate"))
    if asked.claim != "statistical":
        found.append(Problem(("certificate", "claim"), "a recording gives a statistical claim", "use claim: statistical"))
    for name, plain in (("attack", 0), ("exceedances", 0), ("repeats", 1)):
        if getattr(asked, name) != plain:
            what = f"'{name}' is about points drawn from a simulator, and there is a recording"
            found.append(Problem(("certificate", name), what, f"remove {name}:", "key"))
    return found
