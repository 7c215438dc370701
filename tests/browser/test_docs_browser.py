"""The tables of the documentation on a phone: numbers are whole, and what a row says has room."""

from pathlib import Path

import pytest

CSS = Path(__file__).parents[2] / "docs" / "static" / "tables.css"
ROW = (
    '<tr><td><code>integrator</code></td><td class="text-right">7.4e-5</td><td>almost the exact flow of the equations</td></tr>'
)


@pytest.fixture
def cells(visit, tmp_path):
    page = tmp_path / "page.html"
    text = f"<article><table>{ROW}</table></article>"
    page.write_text(f"<!doctype html><meta charset=utf-8><style>{CSS.read_text()}</style>{text}")
    page, _, _ = visit(page, 120)
    lines = "c => { const r = document.createRange(); r.selectNodeContents(c); return r.getClientRects().length; }"
    return page.eval_on_selector_all("td", f"all => all.map(c => [c.getBoundingClientRect().width, ({lines})(c)])")


def test_a_number_is_not_broken_at_its_sign(cells):
    assert cells[1][1] == 1


def test_what_a_row_says_has_room(cells):
    assert cells[2][0] >= 190
