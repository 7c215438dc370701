"""The reference of spec files has every section, every kind that is installed and every option, each with what it means."""

import importlib
import re
import sys
from pathlib import Path

import pytest
from pydantic import BaseModel, Field

import gapcert
from gapcert.contracts.plugins.component import KINDS
from gapcert.spec.schema import schema
from gapcert.spec.sections import sections
from gapcert.spec.sections.plugin_sections import contributed
from gapcert_calibrate import config as stochastic
from gapcert_engines import model_config as engine

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs"))
PAGE = (ROOT / "docs" / "spec.md").read_text()
ASKED = re.findall(r"^```{options} (\w+)$", PAGE, re.MULTILINE)
# Whole sections of the core, and what wraps them for the checker alone.
WRAPPERS = {"_Sampling", "Sampled", "_Head", "_Ranges", "_Named", "Section"}


@pytest.fixture(scope="module")
def generate():
    """What writes the tables: it imports Sphinx."""
    return importlib.import_module("generate")


@pytest.fixture(scope="module")
def tables(generate):
    """What the page shows of options, all directives together."""
    return "\n\n".join(generate.option_tables(name) for name in ASKED)


def test_every_kind_is_in_the_reference_with_all_its_options(tables):
    registry, lost, seen = gapcert.registry(), [], 0
    for kind in KINDS:
        for name in registry.names(kind):
            config = registry.config(kind, name)
            if config is not None:
                options = config.model_json_schema().get("properties", {})
                wanted = [f"**`kind: {name}`**", *(f"| `{option}` |" for option in options if option != "kind")]
                lost += [f"{kind} {name}: {text}" for text in wanted if text not in tables]
                seen += 1
    assert lost == []
    assert seen > 25


CONTRIBUTED = {sys.modules[type(s).__module__] for s in contributed(gapcert.registry()).values()}
MODELS = [
    m
    for module in (engine, sections, stochastic, *CONTRIBUTED)
    for m in vars(module).values()
    if isinstance(m, type) and issubclass(m, BaseModel) and m.__module__ == module.__name__ and m.__name__ not in WRAPPERS
]


def test_every_section_of_the_core_is_in_the_reference(generate, tables):
    shown = [m.__name__ in ASKED or generate._own_table(m.model_json_schema()) in tables for m in MODELS]
    assert [m.__name__ for m, is_shown in zip(MODELS, shown, strict=True) if not is_shown] == []
    assert len(MODELS) > 20


def test_every_key_of_a_spec_is_explained():
    assert [key for key in schema()["properties"] if not re.search(rf"^## {key}$|`{key}[:`]", PAGE, re.MULTILINE)] == []


def test_no_option_lacks_its_meaning(tables):
    rows = [row.split(" | ") for row in re.findall(r"^\| `.*$", tables, re.MULTILINE)]
    assert len(rows) > 300
    assert [row for row in rows if len(row) != 4 or row[3].strip(" |") == ""] == []


def test_an_option_without_a_meaning_would_be_noticed(generate):
    class Fan(BaseModel):
        blades: int
        speed: int = Field(1, description="in turns per second")

    silent, told = re.findall(r"^\| `.*$", generate.option_table(Fan.model_json_schema()), re.MULTILINE)
    assert silent.endswith("|  |")
    assert told.endswith("in turns per second |")
