"""No block of the documentation is unaccounted for: each is run (test_docs), or checked here, or declared to be only shown."""

import json
import re
import shlex
import shutil
import sys
import textwrap
import tomllib
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from ruamel.yaml import YAML

import gapcert

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs"))
import blocks  # noqa: E402

ALL = [b for path in blocks.PAGES for b in blocks.blocks(path)]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
TARGETS = re.findall(r"^([\w-]+):(?!=)", (ROOT / "Makefile").read_text(), re.MULTILINE)
FILES = ("./", ".ci/", "specs/", "docs/", "benchmarks/", "tests/")


def of(*languages):
    found = [b for b in ALL if b.language in languages]
    assert found, "nothing is checked"
    return found


def place(block):
    return f"{block.page}:{block.line}"


def test_every_block_has_a_language_that_is_allowed():
    assert [f"{b.page}:{b.line} {b.language}" for b in ALL if b.how == "unknown"] == []


def test_where_a_page_shows_what_some_machines_print_it_shows_what_the_others_print():
    of_some = {(b.page, *b.where) for b in ALL if b.where}
    other = {"there": "missing", "missing": "there"}
    assert {(page, kind, name, other[state]) for page, kind, name, state in of_some} == of_some


def loose_fences(path):
    """How many fences of a page belong to no block."""
    found = list(blocks.blocks(path))
    fences, *inner = (len(re.findall(r"^(?:```+|:::+)", t, re.MULTILINE)) for t in (path.read_text(), *(b.text for b in found)))
    return fences - 2 * len(found) - sum(inner)


def test_every_fence_is_a_block():
    assert {p.name: n for p in blocks.PAGES if (n := loose_fences(p))} == {}


def test_a_block_of_no_kind_is_noticed(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("```cobol\nDISPLAY 1.\n```\n\n```\nno language\n```\n")
    assert [b.how for b in blocks.blocks(page)] == ["unknown", "unknown"]


@pytest.fixture(scope="module")
def clone(tmp_path_factory):
    """What fragments of specs are merged into."""
    folder = tmp_path_factory.mktemp("clone")
    for path in (ROOT / "specs").rglob("*"):
        there = folder / path.relative_to(ROOT)
        if path.is_file():
            there.parent.mkdir(parents=True, exist_ok=True)
            there.symlink_to(path)
    return folder


def problems_of(fragment, base, clone):
    """What is wrong with a part of a spec that is merged into a whole one, files that it names apart."""
    data = YAML().load(textwrap.dedent(fragment))
    if fragment.startswith("  "):  # what stands inside of a controller
        data = {"controller": data}
    path = clone / Path(base).parent / "fragment.yaml"
    whole = YAML().load(clone / base) if "model" in data else {"extends": Path(base).name}
    with path.open("w") as file:
        YAML().dump({**whole, **data}, file)
    try:
        gapcert.load_spec(path)
    except gapcert.GapcertError as error:
        return [p for p in error.problems if not str(p["message"]).startswith("no file")]
    return []


def test_yaml_is_a_spec_or_fits_into_one(clone):
    parts = [b for b in of("yaml") if not b.text.startswith("version:")]  # test_docs loads whole ones
    lost = [place(b) for b in parts if not b.fragment_of]
    assert lost == [], "say which spec it is a part of: % fragment of specs/NAME.yaml"
    assert {place(b): found for b in parts if (found := problems_of(b.text, b.fragment_of, clone))} == {}


def test_a_fragment_that_fits_nowhere_is_noticed(clone):
    wrong = "controller:\n  kind: symbolic\n  cels: {theta: 20}\n"
    assert any("cels" in str(p["message"]) for p in problems_of(wrong, "specs/pendulum.yaml", clone))


READERS = {"toml": tomllib.loads, "json": json.loads, "xml": ElementTree.fromstring}


def unread(block):
    """Why a block cannot be read, or None."""
    try:
        READERS[block.language](block.text)
    except (ValueError, ElementTree.ParseError) as error:
        return str(error)
    return None


def test_data_can_be_read():
    assert {place(b): why for b in of(*READERS) if (why := unread(b))} == {}


def complaint(line):
    """What is wrong with a command that the documentation asks for and that is not run here, or None."""
    program, *words = shlex.split(line, comments=True)
    name = program.rpartition("/")[2]
    if program.startswith(FILES):
        return None if (ROOT / program).exists() else f"there is no {program}"
    if name == "make":
        return next((f"make has no target {w}" for w in words if "=" not in w and w not in TARGETS), None)
    if name == "gapcert":
        lost = [w for w in words[1:] if "/" in w and w.endswith(".yaml") and not (ROOT / w).exists()]
        return f"there is no {lost[0]}" if lost else None
    if name == "pip":
        extras = [e for w in words for e in re.findall(r"\[([^]]*)\]", w)]
        unknown = [e for some in extras for e in some.split(",") if e not in PROJECT["optional-dependencies"]]
        lost = [w for w in words if w.endswith(".txt") and not (ROOT / w).exists()]
        return f"nothing is called {(unknown + lost)[0]}" if unknown + lost else None
    if re.fullmatch(r"python(3\.\d+)?", name):
        if words[0] == "-m":
            return None if words[1] in ("venv", "pytest", "sphinx", "build") else f"what is {words[1]}?"
        source = ROOT / words[0]
        if not source.exists():
            return f"there is no {words[0]}"
        unknown = [w for w in words[1:] if w.startswith("--") and f'"{w}"' not in source.read_text() + HARNESS]
        return f"{words[0]} has no option {unknown[0]}" if unknown else None
    beside = Path(sys.executable).with_name(program)  # of the environment that the tests run in
    return None if shutil.which(program) or beside.exists() else f"what is {program}?"


HARNESS = (ROOT / "benchmarks" / "harness.py").read_text()


def test_commands_that_install_name_what_is_there():
    lines = [(place(b), line) for b in of("sh") for line in b.text.splitlines() if line]
    assert [(where, line, said) for where, line in lines if (said := complaint(line))] == []


@pytest.mark.parametrize(
    "line",
    [
        "make tests",
        "pip install 'gapcert[everything]'",
        ".venv/bin/pip install -c pins.txt -e .",
        "gapcert run specs/pendulm.yaml",
        "python benchmarks/speed.py",
        "python benchmarks/diagnosis.py --sings",
        ".ci/go",
        "gapcrt run",
    ],
)
def test_a_command_that_does_not_exist_is_noticed(line):
    assert complaint(line)


def test_c_uses_names_that_are_exported():
    made = "".join(p.read_text() for p in (ROOT / "plugins/gapcert_cells/export").glob("*.py")).lower()
    used = {place(b): set(re.findall(r"\b(?:controller|CONTROLLER)_\w+", b.text)) for b in of("c")}
    assert [where for where, names in used.items() if not names] == []
    assert [(where, n) for where, names in used.items() for n in names if n.lower() not in made] == []


def test_a_diff_is_of_a_file_that_is_there():
    texts = [f.read_text() for f in (ROOT / "specs").rglob("*.xml")]
    removed = [(place(b), line[1:].strip()) for b in of("diff") for line in b.text.splitlines() if line.startswith("-")]
    assert [(where, line) for where, line in removed if not any(line in text for text in texts)] == []
