"""The documentation cannot rot: Python runs, commands print what is shown, specs are valid, public names are all there."""

import glob
import importlib
import re
import shlex
import shutil
import sys
from functools import partial
from pathlib import Path

import pytest
from commands import command
from sybil import Sybil
from sybil.parsers.myst import CodeBlockParser, PythonCodeBlockParser

import gapcert
from gapcert.contracts.plugins.component import KINDS

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs"))
import blocks  # noqa: E402

# What runs specs from end to end: the pendulum, also in every engine, an arm, and the tutorials.
SLOW = {"start.md", "concepts.md", "compare.md", "runs.md", *(p.name for p in (ROOT / "docs").glob("tutorial_*.md"))}


def same(wanted, output):
    """Whether an output is what is shown, `...` standing for what varies, and white space for white space."""
    parts = (re.escape(" ".join(part.split())) for part in f" {wanted.strip()} ".split("..."))
    return re.fullmatch(r"\s*" + r"\s*.*?\s*".join(parts) + r"\s*", " ".join(output.split()), re.DOTALL) is not None


def console(capfd, example):
    """`$ gapcert …` is run and prints the lines below it, `...` standing for what varies; `# exit 1` says how it ends."""
    if not here(example).suits:
        return  # test_blocks: the page has one for this machine, too
    for block in re.split(r"^\$ ", example.parsed, flags=re.MULTILINE)[1:]:
        line, _, wanted = block.partition("\n")
        line, _, code = line.partition("# exit")
        program, *arguments = [hit for word in shlex.split(line) for hit in (glob.glob(word) or [word])]
        assert program == "gapcert", f"{example.path}:{example.line}: only gapcert runs in a console block"
        done = command(capfd, *arguments)
        said = f"$ {line}\n{done.out}{done.err}"
        assert done.code == int(code or 0), said
        if wanted.strip():
            assert same(wanted, done.out + done.err), said


def spec(example):
    """A block that begins with `version:` is a whole spec file; what comes before its first line are options of the block."""
    block = here(example)
    if block.text.startswith("version:"):
        path = Path(block.caption) if block.caption else Path("specs") / "of_the_docs.yaml"
        path.write_text(block.text)
        gapcert.load_spec(path)


def here(example):
    """The block of the page that an example is."""
    return next(b for b in blocks.blocks(Path(example.path)) if b.line in (example.line, example.line - 1))


def saved(example):
    """A block whose caption names a file is that file."""
    block = here(example)
    if block.caption:
        Path(block.caption).write_text(block.text)


@pytest.mark.parametrize(
    "page", [pytest.param(p, id=p.name, marks=[pytest.mark.exam] * (p.name in SLOW)) for p in blocks.PAGES]
)
def test_blocks_of_a_page(page, tmp_path, monkeypatch, capfd):
    shutil.copytree(ROOT / "specs", tmp_path / "specs")
    (tmp_path / "tests").symlink_to(ROOT / "tests")
    monkeypatch.chdir(tmp_path)
    readers = {"console": partial(console, capfd), "yaml": spec, "xml": saved, "toml": saved}
    sybil = Sybil([PythonCodeBlockParser(), *(CodeBlockParser(*one) for one in readers.items())], path=str(ROOT))
    for example in sybil.parse(page).examples():
        example.evaluate()


def test_a_wrong_output_in_a_console_block_is_noticed(tmp_path, capfd):
    page = tmp_path / "page.md"
    page.write_text("```console\n$ gapcert --version\ngapcert 0.0.0-never\n```\n")
    (example,) = Sybil([CodeBlockParser("console", partial(console, capfd))], path=str(tmp_path)).parse(page).examples()
    with pytest.raises(AssertionError, match="gapcert --version"):
        example.evaluate()


def text(page):
    return (ROOT / "docs" / page).read_text()


def test_every_public_name_is_in_the_reference():
    page = text("reference.md")
    told = set(re.findall(r"^\.\. (?:auto\w+|data):: ([\w.]+)$", page, re.MULTILINE))
    assert [n for n in gapcert.__all__ if n not in told and not n.startswith("__")] == []
    assert len(gapcert.__all__) <= 60
    elsewhere = [n.rpartition(".")[::2] for n in told if "." in n]
    assert [(home, n) for home, n in elsewhere if n not in importlib.import_module(home)._HOME] == []
    assert len(elsewhere) > 50
    assert "```{offered} gapcert.plugin\n" in page


def test_old_names_answer_and_say_where_they_are_now():
    for name, home in gapcert._MOVED.items():
        with pytest.warns(DeprecationWarning, match=rf"^gapcert\.{name} is {home}\.{name} now"):
            assert getattr(gapcert, name) is getattr(importlib.import_module(home), name)
    assert not gapcert._MOVED.keys() & gapcert._HOME.keys()


def test_every_kind_is_explained():
    assert [kind for kind in KINDS if f"`{kind}`" not in text("plugins.md")] == []


def test_the_readme_has_as_many_effects_and_the_families_that_there_are():
    page, registry = (ROOT / "README.md").read_text(), gapcert.registry()
    own = {
        kind: {c.name for c in registry.of(kind) if c.distribution.startswith("gapcert ")} for kind in ("effect", "gap_family")
    }
    assert re.findall(r"\[(\d+) effects\]", page) == [str(len(own["effect"]))]
    (families,) = re.findall(r"^\| gap families \| (.*?):", page, re.MULTILINE)
    assert set(re.findall(r"`(\S+?)`", families)) == own["gap_family"]
