"""HTML from Python calls: everything that is not already Html is escaped."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING, Any, final

if TYPE_CHECKING:
    from gapcert_report.pictures.svg import Picture

_VOID = {"meta", "br", "hr"}
_PARTS = ("style.css", "plots.js", "page.js")


@final
class Html(str):
    """Text that is markup already."""

    __slots__ = ()


def h(tag: str, *children: object, **attributes: str) -> Html:
    """`<tag key="value">children</tag>`; `class_` is class, other underscores are hyphens; None children are left out."""
    names = {k: "class" if k == "class_" else k.replace("_", "-") for k in attributes}
    head = "".join(f' {names[k]}="{escape(v, quote=True)}"' for k, v in attributes.items())
    return Html(f"<{tag}{head}>" if tag in _VOID else f"<{tag}{head}>{join(children)}</{tag}>")


def join(children: Iterable[object]) -> Html:
    """Children one after the other: text is escaped, markup is not, None is left out."""
    return Html("".join(c if isinstance(c, Html) else escape(str(c)) for c in children if c is not None))


def section(title: str, *parts: object) -> Html | None:
    """A section of a page; None where there is nothing in it."""
    return h("section", h("h2", title), *parts) if any(p is not None for p in parts) else None


def part(title: str, *parts: object) -> Html | None:
    """A part of a section, likewise."""
    return join([h("h3", title), *parts]) if any(p is not None for p in parts) else None


def folded(title: str, *parts: object) -> Html | None:
    """What is seen when its title is pressed, likewise."""
    return h("details", h("summary", title), *parts) if any(p is not None for p in parts) else None


def said(text: str | None, **attributes: str) -> Html | None:
    """A paragraph; None for no text."""
    return h("p", text, **attributes) if text else None


def table(caption: str, head: Sequence[object], rows: Iterable[Sequence[object]], text_columns: int = 1) -> Html | None:
    """A table that scrolls inside its own box on narrow screens; the first columns are text, the rest numbers.

    None where there are no rows.
    """

    def cell(i: int, value: object) -> Html:
        if i == 0:
            return h("th", value, scope="row")
        return h("td", value) if i < text_columns else h("td", value, class_="n")

    body = [h("tr", *(cell(i, v) for i, v in enumerate(row))) for row in rows]
    if not body:
        return None
    top = [h("th", v, scope="col", class_="n" if i >= text_columns else "t") for i, v in enumerate(head)]
    inner = h("table", h("caption", caption), h("thead", h("tr", *top)), h("tbody", *body))
    return h("div", inner, class_="scroll", tabindex="0", role="region", aria_label=caption)


def listing(text: str, name: str) -> Html:
    """Text as it is, in a box that the keyboard can scroll."""
    return h("pre", text, tabindex="0", role="region", aria_label=name)


def gallery(drawn: Sequence[Picture], kind: str = "pictures") -> Html | None:
    """Pictures side by side; nothing for none."""
    return h("div", *map(figure, drawn), class_=kind) if drawn else None


def figure(p: Picture) -> Html:
    """A picture with its title, its legend, its caption, and the values that the page's script reads from it."""
    return h(
        "figure",
        h("h3", p.title),
        legend(p),
        h("div", Html(p.svg), class_="plot"),
        h("figcaption", p.caption),
        _values(p.data) if p.data else None,
    )


def legend(p: Picture) -> Html | None:
    """What the colours and marks of a picture stand for, as text beside it; None where nothing is to be told apart."""
    entries = (
        h("li", Html(f'<svg viewBox="0 0 22 10" aria-hidden="true">{e.swatch}</svg>'), h("span", e.name)) for e in p.legend
    )
    return h("ul", *entries, class_="legend") if p.legend else None


def _values(data: Mapping[str, Any]) -> Html:
    # A browser does not run it, and no text in it can end it.
    text = json.dumps(data, ensure_ascii=False, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return Html(f'<script type="application/json">{text}</script>')


def framed(head: Sequence[object], main: Iterable[object], version: str) -> tuple[Html, ...]:
    """The landmarks of a page."""
    return (
        h("header", *head),
        h("main", *main, id="main", tabindex="-1"),
        h("footer", f"Gapcert {version}. This page needs no network."),
    )


def document(title: str, *body: object) -> Html:
    """A whole page that needs, and may run, nothing but what is in it: a browser is told so by digests."""
    style, *scripts = (files(__package__).joinpath(name).read_text(encoding="utf-8") for name in _PARTS)
    lines = (line.strip() for line in "\n".join(scripts).splitlines())
    script = "\n".join(line for line in lines if line and not line.startswith("//"))
    content, rules = _sheet(join(body))
    style += rules
    policy = (
        f"default-src 'none'; script-src {_digest(script)}; style-src {_digest(style)}; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )
    head = h(
        "head", h("meta", charset="utf-8"), h("meta", http_equiv="Content-Security-Policy", content=policy),
        h("meta", name="viewport", content="width=device-width, initial-scale=1"), h("title", title), h("style", Html(style)),
    )  # fmt: skip
    skip = h("a", "Skip to the answer", href="#main", class_="skip")
    inner = h("body", skip, content, h("script", Html(script)))
    return Html("<!doctype html>\n" + h("html", head, inner, lang="en") + "\n")


def _sheet(body: Html) -> tuple[Html, str]:
    """Styles of single elements, which a strict policy forbids, as classes; few differ, so the page is smaller, too."""
    names: dict[str, str] = {}

    def as_class(match: re.Match[str]) -> str:
        name = names.setdefault(match[2], f"m{len(names)}")
        return f'{match[1]}class="{name}"'

    # Between < and > there is no text of a user's that could look like an attribute: quotes in attributes are escaped.
    text = re.sub(r'(<[a-zA-Z]+ [^<>]*?)\bstyle="([^"<>]*)"', as_class, body)
    return Html(text), "".join(f".{name} {{ {style} }}\n" for style, name in names.items())


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
