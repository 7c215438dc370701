"""The shapes of JSON on the command line's page: commands print no key that is not there, and it has none that no code has."""

import json
import re
from pathlib import Path

import pytest

from gapcert.cli.main import main

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "cli.md").read_text()
TOKEN = re.compile(r'\s*("(?:[^"])*"|[{}\[\]:,|]|\.\.|[A-Z][A-Z_]+|[a-z][a-z ]+)')


class Shape:
    """A tree of what a block says: objects as dicts (`NAME` and `..` stand for others), lists as lists, the rest as None."""

    def __init__(self, text):
        self.tokens = TOKEN.findall(text)
        assert "".join(self.tokens).replace(" ", "") == re.sub(r"\s", "", text), "a block that is no shape"
        self.tree = self.value()

    def take(self, *which):
        if self.tokens and (not which or self.tokens[0] in which):
            return self.tokens.pop(0)
        return ""

    def value(self):
        found = self.one()
        while self.take("|"):
            other = self.one()
            found = {**found, **other} if isinstance(found, dict) and isinstance(other, dict) else found or other
        return found

    def one(self):
        if self.take("{"):
            return self.object()
        if not self.take("["):
            self.take()
            return None
        items = [self.value()]
        while self.take(","):
            items.append(self.value())
        assert self.take("]")
        return items

    def object(self):
        found = {}
        while not self.take("}"):
            key = self.take().strip('"')
            found[key] = self.value() if self.take(":") else None
            self.take(",")
        return found


def shape_below(heading):
    """The shape in the section whose heading begins like this, in a block of its own or within a line."""
    section = PAGE.partition(f"## {heading}")[2].partition("\n## ")[0]
    block = re.search(r"```text\n(.*?)```", section, re.S) or re.search(r"`(\[?\{.*?\}\]?)`", section, re.S)
    return Shape(block[1]).tree


def shape_of(command):
    """What the section of a command of the family `runs` says in its table."""
    (block,) = re.findall(r"```text\n(runs list.*?)```", PAGE, re.S)
    (text,) = re.findall(rf"^{command} +(.*?)(?=^\S|\Z)", block, re.S | re.M)
    return Shape(text).tree


def strangers(value, shape, at=""):
    """The keys of a JSON value that its shape does not have, as paths."""
    if isinstance(value, dict) and isinstance(shape, dict) and ".." not in shape:
        named = next((s for key, s in shape.items() if key.isupper()), None)
        open_ = any(key.isupper() for key in shape)
        for key, inner in value.items():
            if key in shape or open_:
                yield from strangers(inner, shape.get(key, named), f"{at}.{key}")
            else:
                yield f"{at}.{key}"
    elif isinstance(value, list) and isinstance(shape, list):
        for inner in value:
            yield from strangers(inner, shape[0], at)


def documented(shape):
    """Every key of a shape."""
    if isinstance(shape, dict):
        for key, inner in shape.items():
            yield from () if key.isupper() or key == ".." else (key,)
            yield from documented(inner)
    for inner in shape if isinstance(shape, list) else ():
        yield from documented(inner)


HEADINGS = re.findall(r"^## (What `gapcert \w+ .*)$", PAGE, re.M)
SHAPES = {heading.split()[2].strip("`"): heading for heading in HEADINGS if "`gapcert runs`" not in heading}
PENDULUM = str(ROOT / "specs" / "diagnose" / "pendulum.yaml")
QUICK = ["diagnose.effects=[viscous-friction, quadratic-drag]", "report.html=false", "report.rerun=false"]


@pytest.fixture
def printed(capsys):
    """The JSON that a command prints."""

    def run(*arguments):
        main([*map(str, arguments), "--json"])
        return json.loads(capsys.readouterr().out)

    return run


def test_every_section_has_a_shape():
    assert SHAPES.keys() == {"run", "diagnose", "inspect", "compare", "verify", "check", "plugins"}


def test_a_run_is_shaped_as_the_page_says(printed, small_run, tmp_path):
    run, folder = shape_below(SHAPES["run"]), small_run.folder
    assert list(strangers(json.loads((folder / "summary.json").read_text()), run)) == []
    assert list(strangers(printed("verify", folder), shape_below(SHAPES["verify"]))) == []
    assert list(strangers(printed("runs", "list", folder.parent), shape_of("runs list"))) == []
    log = tmp_path / "log.csv"
    log.write_text("t,theta,omega,torque\n" + "".join(f"{0.02 * k},0.1,{0.01 * k},0\n" for k in range(20)))
    checked = printed("check", folder, log)
    assert checked["violations"]
    assert list(strangers(checked, shape_below(SHAPES["check"]))) == []


@pytest.mark.run
def test_a_diagnosis_is_shaped_as_the_page_says(printed, tmp_path):
    found = printed("diagnose", PENDULUM, "--out", tmp_path, *(part for one in QUICK for part in ("--set", one)))
    assert found["verdict"] == "causes"
    assert list(strangers(found, shape_below(SHAPES["diagnose"]))) == []
    looked = printed("inspect", PENDULUM, "--out", tmp_path)
    assert looked["could_show"]["seen"]
    assert list(strangers(looked, shape_below(SHAPES["inspect"]))) == []


def test_a_comparison_is_shaped_as_the_page_says(printed, small_spec, tmp_path):
    semi = small_spec["backend"]
    pairs = {"points": 50, "rollouts": 2, "steps": 20, "cells": 0}
    backends = {"euler": small_spec["model"], "semi": semi}
    spec = {k: small_spec[k] for k in ("version", "name", "model", "domain", "sampling")} | {
        "compare": {"backends": backends, "families": ["envelope"], "lipschitz": ["interval"], "pairs": pairs},
        "report": {"html": False, "rerun": False},
    }
    (tmp_path / "compare.yaml").write_text(json.dumps(spec))
    found = printed("compare", tmp_path / "compare.yaml", "--out", tmp_path)
    assert found["pairs"][0]["explained_by"]
    assert list(strangers(found, shape_below(SHAPES["compare"]))) == []


def test_the_components_are_shaped_as_the_page_says(printed):
    assert list(strangers(printed("plugins"), shape_below(SHAPES["plugins"]))) == []


@pytest.mark.parametrize("heading", SHAPES.values(), ids=SHAPES)
def test_no_key_of_the_page_is_without_code(heading):
    code = "\n".join(p.read_text() for folder in ("core", "plugins") for p in (ROOT / folder).rglob("*.py"))
    assert [key for key in documented(shape_below(heading)) if not re.search(rf"\b{key}\b", code)] == []


def test_a_key_that_the_page_does_not_have_is_noticed():
    shape = Shape('{"a": {NAME: {"b"}}, "c": [{"d"}] | null, "e": {..}}').tree
    assert list(strangers({"a": {"x": {"b": 1}}, "c": [{"d": 1}], "e": {"f": 1}}, shape)) == []
    told = {"a": {"x": {"b": 1, "z": 2}}, "c": [{"y": 1}], "f": 0}
    assert list(strangers(told, shape)) == [".a.x.z", ".c.y", ".f"]
    assert list(documented(shape)) == ["a", "b", "c", "d", "e"]
