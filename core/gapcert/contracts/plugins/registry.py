"""How a declared name becomes an object: hooks, tolerant discovery, lazy loading, one-sentence errors.

A plugin module implements any of the hooks, decorated with `gapcert.hookimpl`.
"""

from __future__ import annotations

import difflib
import functools
import importlib.metadata
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, final

import pluggy

from gapcert.contracts.plugins.component import INNER, KINDS, Component, Context, load
from gapcert.numerics.errors import UsageError
from gapcert.version import __version__

if TYPE_CHECKING:
    from gapcert.contracts.plugins.events import Emit, Event

GROUP = "gapcert"
_OWN = f"gapcert {__version__}"

hookspec = pluggy.HookspecMarker("gapcert")
hookimpl = pluggy.HookimplMarker("gapcert")


@hookspec
def gapcert_components() -> list[Component]:  # type: ignore[empty-body]  # pluggy never calls a specification
    """Declare what this plugin offers. Called once, when components are first listed; must import nothing heavy."""


@hookspec
def gapcert_event(event: Event) -> None:
    """Observe a run: called for every event (stages, progress, warnings), never per sample. Errors are reported, not fatal."""


@final
@dataclass(frozen=True)
class Broken:
    """A plugin that could not be imported: reported, never fatal."""

    distribution: str
    entry_point: str
    reason: str


@final
class Registry:
    """All declared components, by (kind, name)."""

    def __init__(self, components: Iterable[Component], broken: Iterable[Broken], manager: pluggy.PluginManager) -> None:
        self.broken = tuple(broken)
        self.manager = manager
        declared: dict[tuple[str, str], list[Component]] = {}
        for c in components:
            declared.setdefault((c.kind, c.name), []).append(c)
        self.components = {key: same[0] for key, same in declared.items() if len(same) == 1}
        self.rivals = {key: same for key, same in declared.items() if len(same) > 1}

    def collisions(self) -> list[str]:
        """One sentence per component that more than one distribution declares."""
        return [
            f"{len(same)} distributions declare {kind} '{name}': "
            f"{' and '.join(f'{c.distribution} ({c.target})' for c in same)}; uninstall all but one of them"
            for (kind, name), same in sorted(self.rivals.items())
        ]

    def checked(self) -> Registry:
        """This registry; UsageError where two distributions declare one component."""
        if found := self.collisions():
            raise UsageError("; ".join(found))
        return self

    def listing(self) -> list[dict[str, Any]]:
        """What there is, whether it can be loaded and why not; plugins that could not be imported stand last.

        Kinds that are no `kind:` of a spec are there where others than Gapcert offer them.
        """
        reasons = dict(zip(sorted(self.rivals), self.collisions(), strict=True))
        declared = [*self.components.values(), *(c for same in self.rivals.values() for c in same)]
        declared.sort(key=lambda c: (c.kind, c.name, c.distribution))
        told = (c for c in declared if c.kind not in INNER or c.distribution != _OWN)
        parts = [(c.kind, c.name, c.distribution, reasons.get((c.kind, c.name)) or c.missing()) for c in told]
        lost = [("plugin", b.entry_point, b.distribution, b.reason) for b in self.broken]
        keys = ("kind", "name", "distribution", "available", "reason")
        return [dict(zip(keys, (k, n, d, reason is None, reason), strict=True)) for k, n, d, reason in parts + lost]

    def observers(self) -> tuple[Emit, ...]:
        """One Emit per plugin that implements `gapcert_event`, so that one which fails can be dropped without the others."""
        return tuple(
            functools.partial(_tell, implementation) for implementation in self.manager.hook.gapcert_event.get_hookimpls()
        )

    def of(self, kind: str) -> list[Component]:
        """All of a kind, by name."""
        return [self.components[key] for key in sorted(self.components) if key[0] == kind]

    def names(self, *kinds: str) -> list[str]:
        return sorted(name for kind, name in self.components if kind in kinds)

    def get(self, kind: str, name: str) -> Component:
        """The declaration; UsageError with the nearest name when there is none."""
        try:
            return self.components[kind, name]
        except KeyError:
            if (kind, name) in self.rivals:
                self.checked()
            near = difflib.get_close_matches(name, self.names(kind), 1)
            hint = f"did you mean '{near[0]}'?" if near else "see `gapcert plugins`"
            raise UsageError(f"no plugin provides {kind} '{name}' (installed: {', '.join(self.names(kind))}); {hint}") from None

    def find(self, kinds: Iterable[str], name: Any) -> Component | None:
        """The declaration under the first of the kinds that has one of this name."""
        return next((c for k in kinds if (c := self.components.get((k, name))) is not None), None)

    def config(self, kind: str, name: str) -> type[Any] | None:
        """The pydantic config model of a component, or None when it takes no options."""
        component = self.get(kind, name)
        return load(component.config) if component.config else None

    def build(self, kind: str, name: str, config: Any = None, context: Context | None = None) -> Any:
        """Construct a component: `Class.from_config(config, context)` where defined, else `Class(**options)`.

        An option whose class has a method `made(context)` is replaced by what that returns.
        """
        component, context = self.get(kind, name), context or Context()
        if component.code and not context.allow_code:
            raise UsageError(f"{kind} '{name}' runs code that the spec names; pass --allow-code if you trust it")
        implementation = component.load()
        builder: Callable[..., Any] | None = getattr(implementation, "from_config", None)
        if builder is not None:
            return builder(config, context)
        options = {} if config is None else {f: getattr(config, f) for f in type(config).model_fields if f != "kind"}
        return implementation(**{name: _made(option, context) for name, option in options.items()})


def _made(option: Any, context: Context) -> Any:
    made = getattr(type(option), "made", None)
    return option if made is None else made(option, context)


def registry() -> Registry:
    """The process-wide registry, discovered once through entry points in group `gapcert`; UsageError where names collide."""
    return installed().checked()


@functools.cache
def installed() -> Registry:
    """What is installed, collisions included: for listings, which must answer even then."""
    return discover(importlib.metadata.entry_points(group=GROUP))


def discover(entry_points: Iterable[importlib.metadata.EntryPoint]) -> Registry:
    """Load every plugin module that loads; remember, with distribution and version, those that do not, and collisions."""
    manager = pluggy.PluginManager("gapcert")
    manager.add_hookspecs(sys.modules[__name__])
    components, broken = [replace(c, distribution=_OWN) for c in BUILTIN], []
    for owner, point in sorted(((_owner(p), p) for p in entry_points), key=lambda pair: (pair[0], pair[1].name)):
        try:
            module = point.load()
            # Keyed by distribution as well: two distributions may use one entry-point name without shadowing each other.
            manager.register(module, name=f"{owner}:{point.name}")
            declared = [replace(c, distribution=owner) for c in getattr(module, "gapcert_components", list)()]
            if strange := {c.kind for c in declared} - {*KINDS, *INNER}:
                raise UsageError(f"a component of unknown kind '{min(strange)}'; kinds are {', '.join(KINDS)}")
            components += declared
        except (Exception, SystemExit) as error:  # a third party's import may fail in any way; the program must not
            broken.append(Broken(owner, point.name, f"{type(error).__name__}: {error}"))
    return Registry(components, broken, manager)


def _tell(implementation: pluggy.HookImpl, event: Event) -> None:
    # pluggy lets an implementation leave out arguments that it does not need.
    implementation.function(*[event for name in implementation.argnames if name == "event"])


def _owner(point: importlib.metadata.EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist is not None else "unknown"


BUILTIN = (
    Component("executor", "processes", "worker processes on this machine", "gapcert.certification.samples.executors:processes"),
    Component("executor", "threads", "threads of this process", "gapcert.certification.samples.executors:threads"),
    Component("route", "theorem1", "a cover of Z and the margin of its radius", "gapcert.certification.routes:Theorem1"),
    Component("route", "dominate", "what dominates the envelope on all of Z", "gapcert.certification.routes:Dominate"),
    Component("route", "declared", "what a person states", "gapcert.certification.routes:Declared", claim="assumed"),
)
"""Of the core itself."""
