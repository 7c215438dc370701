"""A picture of the gallery stands alone: cut from a report as it is written today, it has its legend, styles and colours."""

import re
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs"))
from standalone import cut, drawn  # noqa: E402

from gapcert_report.pages.html import Html, document, figure  # noqa: E402
from gapcert_report.pictures.svg import TRUTH, WITH, draw  # noqa: E402

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def picture():
    def paint(ax):
        ax.plot([0, 1], [0, 1], color=TRUTH, label="measured <a> & b")
        ax.plot([0, 1], [1, 0], color=WITH, ls="--", label="a name that is so long that it needs a row of its own, or nearly")
        ax.set(xlabel="t [s]")
        ax.legend()

    return draw("alone", "A & B", "What is to be seen.", paint)


@pytest.fixture(scope="module")
def page(picture):
    return document("a page", Html(figure(picture)))


def test_a_picture_of_a_report_is_a_drawing_with_its_legend(page):
    root = ET.fromstring(cut(page, "A & B"))
    said = ["".join(t.itertext()) for t in root.iter(f"{SVG}text")]
    assert "t [s]" in said
    assert "measured <a> & b" in said
    assert any(s.startswith("a name that") for s in said)


def test_its_legend_is_above_the_drawing_and_inside_of_the_file(page):
    root = ET.fromstring(cut(page, "A & B"))
    left, top, width, _ = map(float, root.attrib["viewBox"].split())
    rows = [g.attrib["transform"] for g in root if g.tag == f"{SVG}g" and "transform" in g.attrib]
    places = [tuple(map(float, re.findall(r"-?[\d.]+", r))) for r in rows]
    assert [y for _, y in places] == [-26.0, -13.0]
    assert all(left <= x < left + width and top <= y for x, y in places)


def test_its_styles_are_those_of_the_page(page, picture):
    text = cut(page, "A & B")
    assert not re.findall(r'class="m\d+"', text)
    assert "var(--truth)" in text
    assert sorted(re.findall(r'style="[^"]*"', text)) == sorted(re.findall(r'style="[^"]*"', drawn(picture)))


def test_its_colours_are_the_light_and_the_dark_ones_of_the_page(page):
    style = re.search(r"<style>(.*?)</style>", page, re.DOTALL)[1]
    light, dark = re.findall(r"--ink: (#\w+)", cut(page, "A & B"))
    assert light != dark
    assert [light, dark] == re.findall(r"--ink: (#\w+)", style)[:2]


def test_a_title_that_no_picture_has_is_told(page):
    with pytest.raises(SystemExit, match="no picture 'C'"):
        cut(page, "C")


def test_the_pictures_that_are_kept_are_whole():
    kept = {p.name: p.read_text() for p in (ROOT / "docs" / "images" / "gallery").glob("*.svg")}
    roots = {name: ET.fromstring(text) for name, text in kept.items()}
    assert [name for name, root in roots.items() if root.tag != f"{SVG}svg"] == []
    assert [name for name, root in roots.items() if sum(1 for _ in root.iter(f"{SVG}text")) <= 3] == []
    assert [name for name, text in kept.items() if re.search(r'class="m\d+"', text)] == []
    assert len(kept) > 15
