"""HTML from Python calls: everything that is not already Html is escaped."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING, final

if TYPE_CHECKING:
    from gapcert.report.svg import Picture

_VOID = {"meta", "br", "hr"}


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


def table(caption: str, head: Sequence[object], rows: Iterable[Sequence[object]], text_columns: int = 1) -> Html:
    """A table that scrolls inside its own box on narrow screens; the first columns are text, the rest numbers."""

    def cell(i: int, value: object) -> Html:
        if i == 0:
            return h("th", value, scope="row")
        return h("td", value) if i < text_columns else h("td", value, class_="n")

    body = [h("tr", *(cell(i, v) for i, v in enumerate(row))) for row in rows]
    top = [h("th", v, scope="col", class_="n" if i >= text_columns else "t") for i, v in enumerate(head)]
    inner = h("table", h("caption", caption), h("thead", h("tr", *top)), h("tbody", *body))
    return h("div", inner, class_="scroll", tabindex="0", role="region", aria_label=caption)


def gallery(drawn: Sequence[Picture], kind: str = "pictures") -> Html | None:
    """Pictures side by side, each with its title and caption; nothing for none."""
    if not drawn:
        return None
    figures = (h("figure", h("h3", p.title), Html(p.svg), h("figcaption", p.caption)) for p in drawn)
    return h("div", *figures, class_=kind)
