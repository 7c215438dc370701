"""The reference of spec files has every section, every kind that is installed and every option, each with what it means."""

import re
import sys
from pathlib import Path

import pytest
from pydantic import BaseModel, Field

import gapcert
from gapcert.components import KINDS
from gapcert.spec import areas, comparison, cuts, engine, hidden, sections, stochastic
from gapcert.spec.schema import schema

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs"))
import generate  # noqa: E402

PAGE = (ROOT / "docs" / "spec.md").read_text()
ASKED = re.findall(r"^```{options} (\w+)$", PAGE, re.MULTILINE)
CONFIGURED = [
    (c.kind, c.name) for k in KINDS for c in generate.components(k) if gapcert.registry().config(c.kind, c.name) is not None
]
# Whole sections of the core, and what wraps them for the checker alone.
WRAPPERS = {"_Sampling", "_Sampled", "_Head", "_Ranges", "_Relations", "_Coordinates", "_Named", "Section"}


@pytest.fixture(scope="module")
def tables():
    """What the page shows of options, all directives together."""
    return "\n\n".join(generate.option_tables(name) for name in ASKED)


@pytest.mark.parametrize(("kind", "name"), CONFIGURED)
def test_every_kind_is_in_the_reference_with_all_its_options(kind, name, tables):
    assert f"**`kind: {name}`**" in tables
    for option in gapcert.registry().config(kind, name).model_json_schema().get("properties", {}):
        assert option == "kind" or f"| `{option}` |" in tables


MODELS = [
    m
    for module in (areas, comparison, cuts, engine, hidden, sections, stochastic)
    for m in vars(module).values()
    if isinstance(m, type) and issubclass(m, BaseModel) and m.__module__ == module.__name__ and m.__name__ not in WRAPPERS
]


@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.__name__)
def test_every_section_of_the_core_is_in_the_reference(model, tables):
    assert model.__name__ in ASKED or generate._own_table(model.model_json_schema()) in tables


@pytest.mark.parametrize("key", list(schema()["properties"]))
def test_every_key_of_a_spec_is_explained(key):
    assert re.search(rf"^## {key}$", PAGE, re.MULTILINE) or re.search(rf"`{key}[:`]", PAGE)


def test_no_option_lacks_its_meaning(tables):
    rows = [row.split(" | ") for row in re.findall(r"^\| `.*$", tables, re.MULTILINE)]
    assert len(rows) > 300
    assert [row for row in rows if len(row) != 4 or row[3].strip(" |") == ""] == []


def test_an_option_without_a_meaning_would_be_noticed():
    class Fan(BaseModel):
        blades: int
        speed: int = Field(1, description="in turns per second")

    silent, told = re.findall(r"^\| `.*$", generate.option_table(Fan.model_json_schema()), re.MULTILINE)
    assert silent.endswith("|  |")
    assert told.endswith("in turns per second |")
