"""What can be wrong inside the sections of a spec, found in one pass before anything runs."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, final

from pydantic import BaseModel, Field, create_model

from gapcert.contracts.data.units import shown
from gapcert.contracts.plugins.component import Component
from gapcert.contracts.plugins.options import of_config
from gapcert.contracts.plugins.registry import Registry
from gapcert.numerics.errors import GapcertError, clipped
from gapcert.spec.compose import crowded, matching, near_file, regular
from gapcert.spec.expect import key_problem
from gapcert.spec.models import near, unknown_key, validate
from gapcert.spec.sections import sections as s
from gapcert.spec.sections.plugin_sections import contributed
from gapcert.spec.sections.simulator_absence import measured
from gapcert.spec.source import At, Problem, Tree, dotted

# Which kinds of component may stand in a section.
COMPONENTS: dict[str, tuple[str, ...]] = {
    "model": ("model",),
    "backend": ("backend", "model"),
    "gap": ("gap_family",),
    "controller": ("synthesizer",),
    "recording": ("reader",),
    "reality": ("backend", "model"),
    "lipschitz.residual": ("lipschitz",),
    "lipschitz.network": ("lipschitz",),
    "lipschitz.expression": ("lipschitz",),
}
PLAIN: dict[str, type[BaseModel]] = {
    "certificate": s.CertificateConfig,
    "report": s.ReportConfig,
    "symmetries": s.SymmetriesConfig,
}
SAMPLING: dict[str, type[BaseModel]] = {"grid": s.GridSampling, "adaptive": s.AdaptiveSampling, "lattice": s.LatticeSampling}
BOUNDED = ("residual", "network", "expression")
Absent = Callable[[str], bool]


@final
class _Head(s.Section):
    version: Literal[1]
    name: s.Name
    seed: s.Whole = 0


@final
class _Values(s.Section):
    """Sections that are no mapping of options: `domain` is still in the units in which it was written."""

    domain: s.Boxes = Field({})
    relations: list[str] = Field([], min_length=1)
    coordinates: dict[str, str] = Field({}, min_length=1)


@final
class SpecChecker:
    """Collects the problems of one tree, section by section."""

    def __init__(self, tree: Tree, registry: Registry, folder: Path) -> None:
        self.tree, self.registry, self.folder = tree, registry, folder
        self.contributed = contributed(registry)
        self.problems: list[Problem] = list(tree.problems)
        self.paths: dict[At, Path] = {}

    def say(self, path: At, message: str, hint: str = "", where: Literal["key", "value"] = "value") -> None:
        self.problems.append(Problem(path, message, hint, where))

    def config(self) -> s.Config | None:
        """The typed spec; sections with problems are left out, and None stands for what is no mapping at all."""
        data = self.tree.data
        if not isinstance(data, dict):
            self.say((), f"found {shown(data)}; expected a mapping with version, name, ...")
            return None
        readers: dict[str, Callable[[str, Any], Any]] = {
            **dict.fromkeys(PLAIN, lambda name, section: validate(PLAIN[name], section, (name,), self.problems)),
            **dict.fromkeys((k for k in COMPONENTS if "." not in k), lambda name, section: self.component((name,), section)),
            "domain": self.value,
            "sampling": self.sampling,
            "lipschitz": self.lipschitz,
            "expect": self.expect,
            "relations": self.value,
            "coordinates": self.value,
            "hidden": self.hidden,
            **{name: lambda key, section: self.contributed[key].read(self, section) for name in self.contributed},
        }
        head = tuple(_Head.model_fields)
        self.problems += [unknown_key((k,), (*head, *readers, "extends", "matrix")) for k in data if k not in (*head, *readers)]
        top = validate(_Head, {k: data[k] for k in head if k in data}, (), self.problems)
        parts = {name: read(name, data[name]) for name, read in readers.items() if name in data}
        if isinstance(data.get("controller"), dict):
            parts["goal"] = self.goal(data["controller"])
        given = {k: v for k, v in parts.items() if v is not None}
        more = {k: given.pop(k) for k in self.contributed if k in given}
        study = next((k for k in more if self.contributed[k].alone), "recording" if measured(data, self.contributed) else "")
        return s.Config(name=top.name if top else "", seed=top.seed if top else 0, sections=more, study=study, **given)

    def component(self, path: At, section: Any, kinds: tuple[str, ...] = (), absent: Absent | None = None) -> Any:
        """A section whose `kind` is a plugin's: its config, with its own checks made.

        `absent` is told of a component that is not installed, and says whether that may be.
        """
        kinds = kinds or COMPONENTS[dotted(path)]
        if (name := self.kind(path, section, kinds)) is None:
            return None
        component = self.registry.find(kinds, name)
        assert component is not None, "`kind` knows only what is declared"
        if absent is None or (reason := component.missing()) is None or not absent(reason):
            self.installed((*path, "kind"), component)
        try:
            model = self.registry.config(component.kind, name) or bare(name)
        except Exception as error:  # a plugin's config module may fail in any way
            what = f"the options of '{name}' cannot be read ({type(error).__name__}: {error})"
            self.say((*path, "kind"), what, f"a fault of {component.distribution}; see `gapcert plugins`")
            return None
        own = {k: v for k, v in section.items() if path != ("controller",) or k != "goal" or k in model.model_fields}
        if (config := validate(model, own, path, self.problems)) is not None:
            self.own_checks(path, config)
            self.files(path, config)
            if component.of:
                # What it wraps is a section with its own place in the file.
                inner = self.component((*path, "of"), section["of"], component.of, absent)
                return None if inner is None else config.model_copy(update={"of": inner})
        return config

    def kind(self, path: At, section: Any, kinds: tuple[str, ...]) -> str | None:
        """The `kind` of a section, if one of its plugins provides it."""
        names = self.registry.names(*kinds)
        if (kind := self.tag(path, section, names)) is None or kind in names:
            return kind
        extras = importlib.metadata.metadata("gapcert").get_all("Provides-Extra") or []
        hint = near(kind, names)
        if kind in extras:
            hint = f"install it: pip install 'gapcert[{kind}]'"
        elif hint.startswith("did"):
            hint += f" (installed: {', '.join(names)})"
        lost = [f"{b.distribution} could not be loaded: {b.reason}" for b in self.registry.broken]
        what = kinds[0].replace("_", " ")
        self.say((*path, "kind"), f"no plugin provides {what} '{kind}'", "; ".join([hint, *lost]))
        return None

    def tag(self, path: At, section: Any, names: list[str]) -> str | None:
        """What a section's `kind` says."""
        if not isinstance(section, Mapping):
            self.say(path, f"found {shown(section)}; expected a mapping with kind: {' | '.join(names) or '...'}")
        elif "kind" not in section:
            self.say(path, "missing required key 'kind'", f"kinds: {', '.join(names) or 'none is installed'}", "key")
        elif not isinstance(section["kind"], str):
            self.say((*path, "kind"), f"found {shown(section['kind'])}; expected a name", f"kinds: {', '.join(names)}")
        else:
            return section["kind"]
        return None

    def installed(self, path: At, component: Component) -> None:
        if (reason := component.missing()) is not None:
            self.problems.append(Problem(path, reason, component.install_line(), missing=True))

    def own_checks(self, path: At, config: Any) -> None:
        """What a component's config model says against its options itself."""
        try:
            for inner, message, offset in of_config(config, "check"):
                at = tuple(inner) if isinstance(inner, tuple | list) else (inner,)
                self.problems.append(Problem((*path, *at), str(message), offset=int(offset or 0)))
        except GapcertError as error:
            self.say(path, str(error), where="key")

    def files(self, path: At, config: BaseModel) -> None:
        """Every option of type Path, and what else names a file, is there, relative to the file that names it."""
        for inner, value in [*_paths(config, ()), *of_config(config, "paths")]:
            at = (*path, *inner)
            mark = self.tree.mark(at)
            full = (mark.source.folder if mark is not None else self.folder) / value
            try:
                beside = [p.name for p in full.parent.iterdir()] if full.parent.is_dir() else []
                found = full.exists() or ("*" in full.name and any(p.name for p in matching(full)))
            except OSError as error:  # a name that the system refuses, or a folder that cannot be listed
                self.say(at, f"'{clipped(str(value))[0]}': {(error.strerror or str(error)).lower()}")
                continue
            if found and not (full.is_dir() or "*" in full.name or regular(full)):
                self.say(at, f"'{value}' is a device or a pipe, which may never end", "give a file")
            elif found and full.is_dir() and (text := crowded(full)):
                self.say(at, f"'{value}' {text}", "give a file, or the folder of a bag or data set")
            elif found:
                self.paths[at] = full
            else:
                meant = near_file(full.name, [n for n in beside if Path(n).suffix == full.suffix] or beside)
                rule = "paths are relative to the spec that names them"
                self.say(at, f"no file '{value}'", f"did you mean '{meant}'?" if meant else rule)

    def sampling(self, _: str, section: Any) -> Any:
        if (kind := self.tag(("sampling",), section, sorted(SAMPLING))) is None:
            return None
        if kind not in SAMPLING:
            self.say(("sampling", "kind"), f"found '{kind}'; expected {' or '.join(sorted(SAMPLING))}", near(kind, SAMPLING))
            return None
        config = validate(SAMPLING[kind], section, ("sampling",), self.problems)
        if config is not None:
            place, executors = ("sampling", "executor"), self.registry.names("executor")
            name = config.executor.partition(":")[0]
            if name in executors:
                self.installed(place, self.registry.get("executor", name))
            else:
                self.say(place, f"no plugin provides executor '{name}'", near(name, executors))
        return config

    def lipschitz(self, _: str, section: Any) -> dict[str, Any] | None:
        if not isinstance(section, Mapping):
            self.say(("lipschitz",), f"found {shown(section)}; expected a mapping", "write lipschitz: {residual: {kind: ...}}")
            return None
        self.problems += [unknown_key(("lipschitz", k), BOUNDED) for k in section if k not in BOUNDED]
        return {k: self.component(("lipschitz", k), v) for k, v in section.items() if k in BOUNDED}

    def goal(self, controller: Mapping[str, Any]) -> Any:
        if "goal" not in controller:
            self.say(("controller",), "missing required key 'goal'", "add goal: {invariance: {state: [low, high]}}", "key")
            return None
        config = validate(s.GoalConfig, controller["goal"], ("controller", "goal"), self.problems)
        if config is not None:
            self.files(("controller", "goal"), config)
        return config

    def value(self, name: str, section: Any) -> Any:
        what = f"found {shown(section)}; expected"
        if name == "relations" and not isinstance(section, list):
            self.say((name,), f"{what} a list of texts", "write relations: [abs(u - v) <= 0.5, ...]")
        elif name == "coordinates" and not isinstance(section, Mapping):
            self.say((name,), f"{what} a mapping", "write coordinates: {dx: ux - vx, ...}")
        elif (config := validate(_Values, {name: section}, (), self.problems)) is not None:
            found = getattr(config, name)
            return tuple(found) if isinstance(found, list) else found
        return None

    def hidden(self, _: str, section: Any) -> s.HiddenConfig | None:
        """A word, or a mapping with `sample`."""
        if isinstance(section, Mapping):
            made = validate(s.Sampled, section, ("hidden",), self.problems)
            return None if made is None else s.HiddenConfig("sample", made.sample, dict(made.sample.ranges or {}))
        if section in s.HIDDEN_WORDS:
            return s.HiddenConfig(section)
        hint = near(section, s.HIDDEN_WORDS) if isinstance(section, str) else ""
        what = f"found {shown(section)}; expected {', '.join(s.HIDDEN_WORDS)} or a mapping with sample"
        self.say(("hidden",), what, hint if hint.startswith("did") else s.HIDDEN_HINT)
        return None

    def expect(self, _: str, section: Any) -> dict[str, Any] | None:
        if not isinstance(section, Mapping):
            self.say(("expect",), f"found {shown(section)}; expected a mapping", 'write expect: {verdict: holds, "path <=": 1}')
            return None
        for key, value in section.items():
            if (message := key_problem(key, value)) is not None:
                self.say(("expect", key), message, where="key")
        return dict(section)


def bare(name: str) -> type[BaseModel]:
    """The config of a component that takes no options."""
    field: Any = (Literal[name], ...)
    return create_model("Bare", __base__=s.Section, kind=field)


def _paths(value: Any, path: At) -> Iterator[tuple[At, Path]]:
    """Every pathlib.Path in a config model."""
    if isinstance(value, Path):
        yield path, value
    elif isinstance(value, BaseModel):
        for name in type(value).model_fields:
            yield from _paths(getattr(value, name), (*path, name))
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from _paths(item, (*path, key))
    elif isinstance(value, list | tuple):
        for i, item in enumerate(value):
            yield from _paths(item, (*path, i))
