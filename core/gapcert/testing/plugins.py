"""What every plugin declares, whatever its kind, as named checks."""

from __future__ import annotations

import inspect
import subprocess
import sys
from abc import ABC
from typing import Any

from pydantic import BaseModel, ValidationError

from gapcert.contracts.plugins.component import KINDS, Component, load
from gapcert.contracts.plugins.options import ConfigContract
from gapcert.contracts.plugins.registry import Registry, installed
from gapcert.spec.sections.plugin_sections import SpecSection
from gapcert.testing.checks import expect

_LISTING = """
import sys
sys.path[:] = {path!r}
import gapcert.contracts.plugins.registry
before = set(sys.modules)
import importlib
importlib.import_module({module!r}).gapcert_components()
print(*sorted(m.partition(".")[0] for m in set(sys.modules) - before))
"""
LIGHT = ("gapcert", "pluggy", "numpy")


class PluginContract(ABC):
    """Subclass in a test module as `Test…` and set `plugin`, the module of the entry point: pytest then runs every `test_…`
    below on what it declares, as it is installed.
    """

    plugin: str

    def test_is_installed(self) -> None:
        broken = [f"{b.entry_point}: {b.reason}" for b in self._registry().broken if b.entry_point]
        for c in self._declared():
            found = self._registry().components.get((c.kind, c.name))
            why = "; ".join([*self._registry().collisions(), *broken]) or "is it installed? (pip install -e .)"
            expect(found is not None and found.target == c.target, f"{c.kind} '{c.name}' is not what gapcert finds: {why}")

    def test_can_be_used(self) -> None:
        for c in self._declared():
            expect((reason := c.missing()) is None, str(reason))

    def test_declaring_imports_nothing_heavy(self) -> None:
        """`gapcert plugins` and `gapcert validate` stay quick: what is heavy is imported when it is used."""
        own = self.plugin.partition(".")[0]
        code = _LISTING.format(path=sys.path, module=self.plugin)
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
        expect(done.returncode == 0, f"{self.plugin} cannot be imported: {done.stderr[-800:]}")
        heavy = sorted(set(done.stdout.split()) - {own, *LIGHT} - set(sys.stdlib_module_names))
        expect(not heavy, f"{self.plugin} imports {', '.join(heavy)}; keep what it declares apart from what that is")

    def test_says_what_it_is(self) -> None:
        for c in self._declared():
            expect(bool(c.summary.strip()), f"the summary of {c.kind} '{c.name}' is empty; editors show it")

    def test_targets_are_there(self) -> None:
        for c in self._declared():
            what: Any = c.load()
            expect(callable(what), f"{c.target} is {what!r}; expected a class or function")
            missing = ", ".join(sorted(getattr(what, "__abstractmethods__", ())))
            expect(c.kind == "contract" or not inspect.isabstract(what), f"{c.target} lacks {missing}")

    def test_claims_no_more_than_it_can(self) -> None:
        """On an estimate no deterministic certificate can rest: a spec that asks for one is refused before anything is run."""
        for c in self._declared():
            if getattr(c.load(), "provenance", "") == "estimated" and c.kind == "lipschitz":
                expect(c.claim != "deterministic", f'{c.target} estimates; expected claim="statistical" in its Component')

    def test_options_name_their_kind(self) -> None:
        for c, config in self._configs():
            if c.kind not in KINDS:
                continue  # a section of its own, by its name
            kind = config.model_fields.get("kind")
            schema = config.model_json_schema().get("properties", {}).get("kind", {})
            expect(kind is not None and schema.get("const") == c.name, f'{c.config}: expected kind: Literal["{c.name}"]')

    def test_unknown_options_are_refused(self) -> None:
        """A typo in a spec is an error with its line, and not an option that is silently left out."""
        for c, config in self._configs():
            try:
                config.model_validate({"kind": c.name, "no such option": 1})
            except ValidationError as error:
                if any(e["type"] == "extra_forbidden" for e in error.errors()):
                    continue
            raise AssertionError(f'{_named(c)} takes unknown options; expected model_config = ConfigDict(extra="forbid")')

    def test_options_are_frozen(self) -> None:
        for c, config in self._configs():
            expect(bool(config.model_config.get("frozen")), f"{_named(c)} can be changed; expected ConfigDict(frozen=True)")

    def test_readers_tell_what_their_options_mean(self) -> None:
        """Options are never read by their names: a spec asks a reader's config for its columns, and whether it resamples."""
        for c, config in self._configs():
            for option, method in (("columns", "channels"), ("every", "resampled")) if c.kind == "reader" else ():
                told = getattr(config, method, None) not in (None, getattr(ConfigContract, method))
                expect(told or option not in config.model_fields, f"{c.config} has `{option}`; expected its method `{method}`")

    def _declared(self) -> list[Component]:
        return list(load(f"{self.plugin}:gapcert_components")())

    def _configs(self) -> list[tuple[Component, type[BaseModel]]]:
        found = [(c, load(where)) for c in self._declared() if (where := _named(c))]
        return [(c, what.model if issubclass(what, SpecSection) else what) for c, what in found]

    def _registry(self) -> Registry:
        return installed()


def _named(c: Component) -> str:
    """Where the options of a component stand: in its `config`; a section is itself what has them."""
    return c.target if c.kind == "section" else c.config
