"""What a spec may ask of a recording that stands where others have a backend."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gapcert.contracts.plugins.options import of_config
from gapcert.spec.sections.config import Config
from gapcert.spec.sections.plugin_sections import SpecSection, simulated
from gapcert.spec.sections.sections import CertificateConfig
from gapcert.spec.text.source import Problem

SIMULATED = ("sampling", "hidden", "symmetries", "coordinates", "controller")
"""Sections that need a simulator, which can be asked at any point."""


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
    found = [Problem((k,), f"'{k}' needs a simulator", hint, "key") for k in simulated(SIMULATED, more) if k in data]
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
