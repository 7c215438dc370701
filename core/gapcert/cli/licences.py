"""Under which licences that stands which Gapcert needs, as the packages' own metadata state it."""

from __future__ import annotations

import importlib.metadata
from dataclasses import asdict, dataclass
from typing import Any, final

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

BESIDE = ("all", "dev")
"""Extras that are no group of their own: the sum of the others, and what only the tests need."""
SHORT = 60  # characters: longer texts are the licence itself


@final
@dataclass(frozen=True)
class Licence:
    """A package that the core (`core`) or extras need, directly or not, with its licence in its authors' words.

    `licence` is None where the package states none, `version` where it is not installed.
    """

    package: str
    version: str | None
    licence: str | None
    needed_by: tuple[str, ...]

    def facts(self) -> dict[str, Any]:
        return asdict(self)


def licences(development: bool = False) -> list[Licence]:
    """One row per package that `gapcert` and its extras need on this machine; with what only tests need, for `development`."""
    extras = [e for e in importlib.metadata.metadata("gapcert").get_all("Provides-Extra") or () if e not in BESIDE]
    groups = {"core": "", **{e: e for e in [*extras, *(["dev"] if development else [])]}}
    needs = {name: _needed(extra) for name, extra in groups.items()}
    rows = []
    for package in sorted(set().union(*needs.values())):
        by = tuple(name for name, packages in needs.items() if package in packages)
        rows.append(Licence(package, *_stated(package), ("core",) if "core" in by else by))
    return rows


def _needed(extra: str) -> set[str]:
    """Packages that `gapcert[extra]` needs, directly or not, as markers hold on this machine."""
    found: set[str] = set()
    waiting = [("gapcert", {extra})]
    seen: set[tuple[str, str]] = set()
    while waiting:
        package, asked = waiting.pop()
        for line in _requires(package):
            need = Requirement(line)
            if not any(need.marker is None or need.marker.evaluate({"extra": e}) for e in asked | {""}):
                continue
            name = canonicalize_name(need.name)
            if name != "gapcert":
                found.add(name)
            if fresh := {(name, e) for e in need.extras | {""}} - seen:
                seen |= fresh
                waiting.append((name, set(need.extras)))
    return found


def _requires(package: str) -> list[str]:
    try:
        return importlib.metadata.requires(package) or []
    except importlib.metadata.PackageNotFoundError:
        return []


def _stated(package: str) -> tuple[str | None, str | None]:
    """(version, licence): the SPDX expression, else a short licence field, else classifiers, else the text's first line."""
    try:
        about = importlib.metadata.metadata(package)
    except importlib.metadata.PackageNotFoundError:
        return None, None
    text, expression = (next(iter(about.get_all(key) or ()), "").strip() for key in ("License", "License-Expression"))
    classifiers = [c.rpartition("::")[2].strip() for c in about.get_all("Classifier") or () if c.startswith("License ::")]
    told = expression or (text if len(text) <= SHORT and "\n" not in text else "")
    first = next((line.strip(" =") for line in text.splitlines() if line.strip(" =")), None)
    return about["Version"], told or " or ".join(classifiers) or first
