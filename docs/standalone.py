"""A picture of a report as a file of its own: with its legend, its styles, the page's colours, and a card behind it."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from importlib.resources import files
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gapcert_report.pictures.svg import Picture

FRAME = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'
MARGIN, ROW, SIZE = 6, 13, 8.5  # around the picture; of the legend: a row's height, and that of its letters


def cut(page: str, title: str) -> str:
    """The picture under `title` of a report's page."""
    for figure in re.findall(r"<figure\b.*?</figure>", page, re.DOTALL):
        heading = re.search(r"<h3[^>]*>(.*?)</h3>", figure, re.DOTALL)
        if heading and html.unescape(re.sub(r"<[^>]+>", "", heading[1])) == title:
            drawing = re.search(r'<div class="plot">(<svg\b.*?</svg>)</div>', figure, re.DOTALL)
            style = re.search(r"<style>(.*?)</style>", page, re.DOTALL)
            assert drawing is not None, f"no drawing under {title!r}"
            assert style is not None, "the page has no style sheet"
            legend = re.findall(r"<li><svg[^>]*>(.*?)</svg><span>(.*?)</span></li>", figure, re.DOTALL)
            return alone(drawing[1], style[1], [(swatch, html.unescape(name)) for swatch, name in legend])
    raise SystemExit(f"the report has no picture {title!r}")


def drawn(picture: Picture) -> str:
    """A picture that no page has."""
    style = files("gapcert_report.pages").joinpath("style.css").read_text(encoding="utf-8")
    return alone(picture.svg, style, [(e.swatch, e.name) for e in picture.legend])


def alone(svg: str, style: str, legend: Sequence[tuple[str, str]] = ()) -> str:
    """An inline SVG, and its legend of (swatch, name), with what they take from the page that has that style sheet."""
    light, dark, *_ = re.findall(r":root\b[^{]*{([^}]*)}", style)
    rules = dict(re.findall(r"^\.(m\d+) { (.*) }$", style, re.MULTILINE))
    colours = re.sub(r"\s+", " ", f":root {{{light}}} @media (prefers-color-scheme: dark) {{ :root {{{dark}}} }}")
    text = "text { font-family: system-ui, sans-serif; }"
    card = '<rect x="-2000" y="-2000" width="4000" height="4000" style="fill: var(--card)"/>'
    box = re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', svg)
    assert box is not None
    names, rows = _legend(legend, float(box[1]))
    head, _, body = svg.replace(box[0], _framed(float(box[1]), float(box[2]), rows * ROW), 1).partition(">")
    start = head.replace("<svg", f"<svg {FRAME}", 1)
    whole = f"{start}><style>{colours} {text}</style>{card}{names}{body}\n"
    return re.sub(r'class="(m\d+)"', lambda m: f'style="{rules[m[1]]}"', whole)


def _framed(width: float, height: float, above: float) -> str:
    w, h = width + 2 * MARGIN, height + 2 * MARGIN + above
    return f'viewBox="{-MARGIN} {-MARGIN - above:g} {w:g} {h:g}" width="{w * 1.6:.0f}" height="{h * 1.6:.0f}"'


def _legend(entries: Sequence[tuple[str, str]], width: float) -> tuple[str, int]:
    """The legend above a picture of that width, and how many rows it has."""
    from matplotlib.textpath import TextPath

    placed, row, at = [], 0, 0.0
    for swatch, name in entries:
        # Few letters are wider than those of matplotlib's own font.
        needed = 26 + TextPath((0, 0), name, size=SIZE).get_extents().width
        if at > 0 and at + needed > width:
            row, at = row + 1, 0.0
        placed.append((row, at, swatch, name))
        at += needed + 12
    rows = row + 1 if placed else 0
    text = "".join(
        f'<g transform="translate({x:.1f} {(r - rows) * ROW})">{swatch}'
        f'<text x="26" y="8" style="font-size: {SIZE}px; fill: var(--ink)">{html.escape(name)}</text></g>'
        for r, x, swatch, name in placed
    )
    return text, rows
