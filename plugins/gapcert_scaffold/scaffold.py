"""A new plugin as a distribution of its own: a small working component of any kind, its contract test, and a spec that uses it.

Templates lie beside this module in `templates/`: `common/` for every kind, over it what the kind has of its own. `@token@`
stands for a name, `PACKAGE` and `SNAKE` in file names as well.
"""

from __future__ import annotations

import contextlib
import difflib
import importlib.metadata
import importlib.util
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import final

from gapcert.plugin import COMPONENTS, SECTIONS, Answer, Arguments, UsageError, installed

_NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
_LONGEST = 30  # characters of a name; chosen, not measured


@final
@dataclass(frozen=True)
class _Template:
    """What differs by kind: the module, what it defines beside it in the entry of the component, and what that is."""

    module: str
    target: str
    summary: str
    packages: tuple[str, ...] = ("gapcert", "numpy", "pydantic")


_TEMPLATES = {
    "model": _Template("model", "@Camel@Model", "a robot on two driven wheels"),
    "backend": _Template("backend", "@Camel@Backend", "a mass on a spring in still air"),
    "gap_family": _Template("family", "@Camel@Family", "a quadratic with margins that are proved"),
    "lipschitz": _Template("estimator", "@Camel@Estimator", "the steepest of many close pairs, times a safety factor"),
    "synthesizer": _Template("synthesizer", "@Camel@Synthesizer", "controllers on cells, by fixed points in plain NumPy"),
    "effect": _Template("effect", "@Camel@Effect", "a grease that thins under shear", ("gapcert",)),
    "reader": _Template("reader", "@Camel@Reader", "columns of numbers under a header with units"),
    "executor": _Template("executor", "make", "worker processes of low priority", ("gapcert",)),
    "observer": _Template("observer", "@Camel@Observer", "a line per stage, in the folder of the run", ("gapcert",)),
    "study": _Template("study", "@Camel@Study", "the largest gap that is allowed for, at points of the domain"),
}
OFFERED = tuple(_TEMPLATES)


@final
@dataclass(frozen=True)
class Scaffold:
    """A distribution that is not written yet: its names, and the text of each file by its path."""

    kind: str
    name: str
    distribution: str
    package: str
    texts: Mapping[str, str]

    def write(self, folder: Path) -> list[Path]:
        """The files, written below a folder that is new or empty; UsageError where it is neither, OSError leaves nothing."""
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise UsageError(f"{folder}: it exists and is not an empty folder; expected a new one; choose another with --out")
        made: list[Path] = []
        try:
            for name, text in self.texts.items():
                path = folder / name
                path.parent.mkdir(parents=True, exist_ok=True)
                made.append(path)
                with path.open("x", encoding="utf-8") as file:
                    file.write(text)
        except OSError:
            for path in reversed(made):
                path.unlink(missing_ok=True)
                with contextlib.suppress(OSError):  # not empty yet, or not ours
                    path.parent.rmdir()
            raise
        return made


def scaffold(kind: str, name: str) -> Scaffold:
    """A new component of a kind; UsageError where either name cannot be used, or somebody has it."""
    if kind not in OFFERED:
        near = [*COMPONENTS.get(kind, ()), *difflib.get_close_matches(kind, OFFERED, 1)]
        meant = f"; did you mean '{near[0]}'?" if near else ""
        raise UsageError(f"plugins new: '{kind}' is no kind of component; expected one of {', '.join(OFFERED)}{meant}")
    _usable(kind, name)
    snake = name.replace("-", "_")
    camel = "".join(part.capitalize() for part in name.split("-"))
    distribution, package, template = f"gapcert-{name}", f"gapcert_{snake}", _TEMPLATES[kind]
    _free(kind, name, distribution, package)
    words = {
        "kind": kind,
        "article": "an" if kind[0] in "aeiou" else "a",
        "name": name,
        "snake": snake,
        "Camel": camel,
        "package": package,
        "distribution": distribution,
        "module": template.module,
        "Target": template.target.replace("@Camel@", camel),
        "summary": template.summary,
        "Summary": template.summary[0].upper() + template.summary[1:],
        "dependencies": ", ".join(f'"{p}"' for p in template.packages),
    }
    for part in ("use", "change"):
        words[part] = _filled((_templates() / kind / f"{part}.md").read_text(encoding="utf-8").strip(), words)
    found = {**dict(_read(_templates() / "common")), **dict(_read(_templates() / kind))}
    paths = {p.replace("PACKAGE", package).replace("SNAKE", snake): text for p, text in found.items()}
    return Scaffold(kind, name, distribution, package, {p: _filled(text, words) for p, text in sorted(paths.items())})


def _usable(kind: str, name: str) -> None:
    """Names of effects are a contract of their own: their first word has no digits."""
    expected = "lower-case letters and digits in words joined by '-', such as my-robot"
    if _NAME.fullmatch(name) is None or len(name) > _LONGEST:
        near = re.sub(r"[^a-z0-9]+", "-", re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", name).lower()).strip("-")
        hint = f"; did you mean '{near}'?" if _NAME.fullmatch(near) and len(near) <= _LONGEST else ""
        raise UsageError(f"plugins new: found name '{name[:80]}'; expected up to {_LONGEST} {expected}{hint}")
    if kind == "effect" and not name.partition("-")[0].isalpha():
        raise UsageError(f"plugins new: found name '{name}'; expected {expected}, without digits in an effect's first word")


def _free(kind: str, name: str, distribution: str, package: str) -> None:
    """A section of a spec takes components of one kind, or models and backends: names are looked for in all of these.
    A study is a section.
    """
    shared = (("model", "backend"), ("study", "section"))
    rivals = next((kinds for kinds in shared if kind in kinds), (kind,))
    if kind == "study" and name in SECTIONS:
        raise UsageError(f"plugins new: section '{name}' is Gapcert's own; choose another name")
    for c in (*installed().components.values(), *(c for same in installed().rivals.values() for c in same)):
        if c.name == name and c.kind in rivals:
            whose = f"{c.distribution} ({c.target})"
            raise UsageError(f"plugins new: {c.kind} '{name}' is there already, in {whose}; choose another name")
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        found = importlib.metadata.distribution(distribution)
        raise UsageError(f"plugins new: {distribution} {found.version} is installed already; choose another name")
    if importlib.util.find_spec(package) is not None:
        owners = importlib.metadata.packages_distributions().get(package, [])
        whose = f"of {owners[0]}" if owners else "on the path"
        raise UsageError(f"plugins new: there is a package {package} {whose} already; choose another name")


def _templates() -> Traversable:
    return files(__package__) / "templates"


def _read(folder: Traversable, at: str = "") -> Iterator[tuple[str, str]]:
    """(path without its ending `.in`, text) of every template."""
    for entry in folder.iterdir():
        if entry.is_dir():
            yield from _read(entry, f"{at}{entry.name}/")
        elif entry.name.endswith(".in"):
            yield at + entry.name.removesuffix(".in"), entry.read_text(encoding="utf-8")


def _filled(text: str, words: Mapping[str, str]) -> str:
    return re.sub(r"@(\w+)@", lambda hit: words[hit[1]], text)


def command(options: Arguments) -> Answer:
    """Writes a new distribution (default: into a folder of its name here); what was done, as data and in words."""
    made = scaffold(options.kind, options.name)
    folder = Path(made.distribution) if options.out is None else options.out
    paths = [str(p) for p in made.write(folder)]
    shown = os.fspath(folder)
    steps = [f"cd {shown}", "pip install -e '.[test]'", "pytest"]
    facts = {"kind": made.kind, "name": made.name, "distribution": made.distribution, "package": made.package}
    words = [*paths, "", "next:", *(f"  {s}" for s in steps), f"then read {folder / 'README.md'}"]
    return Answer({**facts, "folder": shown, "files": paths, "next": steps}, words)
