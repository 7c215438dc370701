"""Licences of what is needed: complete, and none that would bind those who use Gapcert."""

import importlib.metadata
import re

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from gapcert.cli.doctor import licences
from gapcert.cli.main import main

PERMISSIVE = re.compile(
    r"MIT|BSD|Apache|PSF|Python Software Foundation|[Zz]lib|ISC|0BSD|CC0|BSL-1\.0|HPND|Unlicense|any-OSI|public domain", re.I
)


# Packages whose metadata say too little, and MOSEK, which is not free: Drake's wheel has it, and nothing here calls it.
KNOWN = {"drake": "Various", "fmpy": None, "mosek": "https://mosek.com/products/license-agreement"}


def permissive(text):
    """Whoever may choose among licences joined by `or` chooses one; those joined by `and` all hold."""
    choices = [re.split(r"\s+and\s+|,|;", part, flags=re.I) for part in re.split(r"\s+or\s+", text, flags=re.I)]
    return any(all(map(PERMISSIVE.search, part)) for part in choices)


def test_everything_that_is_installed_for_gapcert_is_under_a_permissive_licence():
    rows = licences()
    unclear = {r.package: r.licence for r in rows if r.version and not permissive(r.licence or "")}
    assert unclear.items() <= KNOWN.items()
    assert not permissive("GPL-3.0 AND MIT")
    assert permissive("GPL-3.0 OR MIT")


def test_every_named_requirement_and_what_it_needs_has_a_row():
    rows = {r.package: r for r in licences()}
    for need in map(Requirement, importlib.metadata.requires("gapcert")):
        extra = re.search(r"extra == [\"'](\w+)", str(need.marker or ""))
        group = extra[1] if extra else "core"
        if need.name != "gapcert" and group not in ("dev", "all"):
            row = rows[canonicalize_name(need.name)]
            assert group in row.needed_by or row.needed_by == ("core",)
    assert rows["mpmath"].needed_by == ("core",), "sympy needs it"
    assert rows["numpy"].version == importlib.metadata.version("numpy")


@pytest.mark.exam
def test_what_only_tests_need_is_told_apart():
    own = {r.package for r in licences()}
    both = {r.package: r for r in licences(development=True)}
    assert own < set(both)
    assert both["pytest"].needed_by == ("dev",)
    assert "pytest" not in own


@pytest.mark.exam
def test_the_command_lists_them(capsys):
    assert main(["doctor", "--licences"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0].split() == ["package", "version", "licence", "needed", "by"]
    assert len(out) == 1 + len(licences())
