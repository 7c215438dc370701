"""Discovery that neither hangs nor dies, and errors that say what to do."""

import importlib.metadata
import pickle
import re
import sys
import types
from dataclasses import dataclass, replace

import pytest

import gapcert
from gapcert import Component, Context, Event, MissingDependency, UsageError, hookimpl
from gapcert.contracts.plugins.component import KINDS, load
from gapcert.contracts.plugins.events import broadcast, silent
from gapcert.contracts.plugins.registry import discover, registry
from gapcert.numerics.digest import digest


@dataclass
class Distribution:
    name: str
    version: str


@dataclass
class Point:
    """What an entry point looks like to the loader."""

    name: str
    module: object
    dist: Distribution | None

    def load(self):
        if isinstance(self.module, BaseException):
            raise self.module
        return self.module


def plugin(*components, observe=None):
    module = types.ModuleType("toy")
    module.gapcert_components = hookimpl(lambda: list(components))
    if observe is not None:
        module.gapcert_event = hookimpl(observe)
    return module


def point(name, *components, distribution="toys", version="1.0", observe=None):
    return Point(name, plugin(*components, observe=observe), Distribution(distribution, version))


def part(kind="gap_family", name="toy", **more):
    return Component(kind, name, "a toy", f"{__name__}:Toy", **more)


class Toy:
    def __init__(self, **options):
        self.options = options


# --- discovery


def test_components_know_the_distribution_that_declares_them():
    found = discover([point("a", part())])
    assert found.get("gap_family", "toy").distribution == "toys 1.0"
    assert found.get("executor", "processes").distribution == f"gapcert {gapcert.__version__}"
    assert found.broken == ()


@pytest.mark.fault(
    "a plugin cannot be imported, or ends the interpreter on import", shows="its name, version and reason; the others work"
)
@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (ImportError("No module named 'nowhere'"), "ImportError: No module named 'nowhere'"),
        (RuntimeError("bad day"), "RuntimeError: bad day"),
        (SystemExit(3), "SystemExit: 3"),
        (SyntaxError("what"), "SyntaxError: what"),
    ],
)
def test_a_broken_plugin_is_reported_and_the_others_still_work(fault, reason):
    found = discover(
        [point("a", part(name="one")), Point("bad", fault, Distribution("acme", "0.3")), point("z", part(name="two"))]
    )
    assert found.names("gap_family") == ["one", "two"]
    (broken,) = found.broken
    assert (broken.distribution, broken.entry_point, broken.reason) == ("acme 0.3", "bad", reason)
    assert found.listing()[-1] == {
        "kind": "plugin",
        "name": "bad",
        "distribution": "acme 0.3",
        "available": False,
        "reason": reason,
    }


def test_a_component_of_an_unknown_kind_breaks_only_its_plugin():
    found = discover([point("a", part()), point("b", part("engine", "x"), part(name="y"), distribution="acme")])
    assert found.names("gap_family") == ["toy"]
    assert "unknown kind 'engine'" in found.broken[0].reason
    assert KINDS[0] in found.broken[0].reason


@pytest.mark.fault("a plugin for another version of the interface", shows="only this plugin is left out")
def test_a_hook_with_a_wrong_argument_breaks_only_its_plugin():
    found = discover([point("a", part()), point("b", observe=lambda nonsense: None, distribution="acme")])
    assert found.names("gap_family") == ["toy"]
    assert "nonsense" in found.broken[0].reason


def test_a_collision_names_both_distributions():
    points = [point("a", part()), point("a", part(), distribution="acme", version="2.0")]
    found = discover([*points, point("b", part(name="other"))])
    words = r"2 distributions declare gap_family 'toy': acme 2\.0 .* and toys 1\.0 .*uninstall all but one"
    with pytest.raises(UsageError, match=words):
        found.checked()
    with pytest.raises(UsageError, match=words):
        found.get("gap_family", "toy")
    rows = [r for r in found.listing() if r["kind"] == "gap_family"]
    assert [(r["name"], r["distribution"], r["available"]) for r in rows] == [
        ("other", "toys 1.0", True),
        ("toy", "acme 2.0", False),
        ("toy", "toys 1.0", False),
    ]
    assert all(re.match(words, r["reason"]) for r in rows[1:])
    assert found.names("gap_family") == ["other"]


def test_the_registry_of_the_process_refuses_a_collision(monkeypatch):
    twice = discover([point("a", part()), point("a", part(), distribution="acme")])
    monkeypatch.setattr("gapcert.contracts.plugins.registry.installed", lambda: twice)
    with pytest.raises(UsageError, match="2 distributions declare gap_family 'toy'"):
        registry()


def test_one_entry_point_name_in_two_distributions_is_no_collision():
    found = discover([point("a", part(name="one")), point("a", part(name="two"), distribution="acme")])
    assert found.names("gap_family") == ["one", "two"]


def test_an_unknown_name_comes_with_the_nearest_one():
    found = discover([point("a", part(name="envelope"), part(name="constant"))])
    with pytest.raises(
        UsageError,
        match=r"no plugin provides gap_family 'envelop' \(installed: constant, envelope\); did you mean 'envelope'\?",
    ):
        found.get("gap_family", "envelop")
    with pytest.raises(UsageError, match="see `gapcert plugins`"):
        found.get("gap_family", "xyz")


# --- what is missing


@pytest.mark.fault("a package, module or Debian package of a component is missing", shows="the pip or apt-get line, exit 3")
@pytest.mark.parametrize(
    ("more", "line"),
    [
        ({"extra": "toy"}, "pip install 'gapcert[toy]'"),
        ({}, "pip install no_such_module"),
        ({"install": "apt-get install toy"}, "apt-get install toy"),
    ],
)
def test_a_missing_dependency_is_one_sentence_with_the_install_line(more, line):
    component = part(requires=("no_such_module", "json"), **more)
    sentence = f"gap_family 'toy' needs no_such_module, which is not installed; run: {line}"
    assert component.missing().startswith(sentence)
    with pytest.raises(MissingDependency, match="needs no_such_module"):
        component.load()
    assert MissingDependency.exit_code == 3


def lacks_a_compiler():
    return ["c++", "libtoy-dev"]


def test_a_check_lists_what_else_is_absent():
    component = part(requires=("no_such_module",), check=f"{__name__}:lacks_a_compiler", install="apt-get install toy")
    assert component.missing() == (
        "gap_family 'toy' needs no_such_module, c++, libtoy-dev, which is not installed; run: apt-get install toy"
    )
    with pytest.raises(MissingDependency, match="needs no_such_module, c"):
        component.load()
    assert part(check=f"{__name__}:list_nothing").missing() is None


def list_nothing():
    return []


def test_looking_for_a_requirement_imports_nothing():
    before = set(sys.modules)
    assert part(requires=("xml.dom.minidom",)).missing() is None
    assert not {m for m in set(sys.modules) - before if m.startswith("xml")}


# --- building


class Configured:
    @classmethod
    def from_config(cls, config, context):
        made = cls()
        made.config, made.context = config, context
        return made


def test_a_component_is_built_by_from_config_or_by_its_options():
    import pydantic

    class Options(pydantic.BaseModel):
        kind: str = "toy"
        size: int = 3

    found = discover([point("a", part(), replace(part(name="made"), target=f"{__name__}:Configured"))])
    assert found.build("gap_family", "toy", Options()).options == {"size": 3}
    assert found.build("gap_family", "toy").options == {}
    context = Context(seed=4)
    made = found.build("gap_family", "made", "config", context)
    assert (made.config, made.context) == ("config", context)


def test_code_in_a_spec_is_refused_before_anything_of_it_is_loaded():
    found = discover([point("a", replace(part(code=True), target="nowhere:Nothing"))])
    with pytest.raises(UsageError, match="runs code that the spec names; pass --allow-code"):
        found.build("gap_family", "toy")
    with pytest.raises(ModuleNotFoundError):
        found.build("gap_family", "toy", context=Context(allow_code=True))


# --- observers


def test_each_plugin_observes_on_its_own():
    heard = []

    def fails(event):
        raise RuntimeError("no viewer")

    points = [
        point("a", observe=fails),
        point("b", observe=lambda event: heard.append(event.name)),
        point("c", observe=lambda: heard.append("c")),
    ]
    emit = broadcast(*discover(points).observers())
    with pytest.warns(RuntimeWarning, match="an observer was dropped after RuntimeError: no viewer"):
        emit(Event("stage-started", "x"))
    emit(Event("stage-finished", "x"))
    assert sorted(heard) == ["c", "c", "stage-finished", "stage-started"]
    silent(Event("stage-started", "x"))


# --- what is installed here


def complaint(component):
    """Why a component is not there, where it does not say itself what is missing."""
    try:
        return None if callable(component.load()) else "it cannot be called"
    except MissingDependency as error:
        return None if component.missing() and "run: " in str(error) else str(error)
    except (ImportError, AttributeError) as error:
        return str(error)


def test_every_declared_component_loads_or_says_what_is_missing():
    components = registry().components.values()
    assert {f"{c.kind} {c.name}": why for c in components if (why := complaint(c))} == {}
    assert len(components) > 60


def test_every_config_model_is_strict_and_discriminated():
    configured = {c: load(c.config) for c in registry().components.values() if c.config and c.kind in KINDS}
    loose = [c.name for c, model in configured.items() if model.model_config.get("extra") != "forbid"]
    alike = [c.name for c, model in configured.items() if model.model_fields["kind"].annotation.__args__ != (c.name,)]
    assert (loose, alike, [c.name for c in configured if not c.summary]) == ([], [], [])
    assert len(configured) > 25


def test_nothing_installed_here_is_broken():
    assert registry().broken == ()
    assert {p.name for p in importlib.metadata.entry_points(group="gapcert")} >= {"bounds", "equations", "pybullet"}


def test_who_loads_models_for_a_component_is_no_part_of_what_it_is():
    """Contexts are kept by systems, which go to other processes and have digests."""
    alone, within = Context(seed=3), Context(seed=3, loader=lambda path: path)
    assert within.other("a.yaml") == "a.yaml"
    assert pickle.loads(pickle.dumps(within)) == alone
    assert digest(within) == digest(alone)
    with pytest.raises(UsageError, match=r"a\.yaml: the model of another spec is taken only from within a spec"):
        alone.other("a.yaml")
