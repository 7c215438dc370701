"""Links of a page: to its sections, and to the other runs of a matrix."""

from __future__ import annotations

import json
import re
from pathlib import Path
from urllib.parse import quote

from .pages.html import Html, h


def contents(body: Html) -> tuple[Html, Html]:
    """Links to the sections, and the page with the places that they lead to."""
    names = re.findall("<h2>(.*?)</h2>", body)
    for k, name in enumerate(names):
        body = Html(body.replace(f"<h2>{name}</h2>", f'<h2 id="part{k}">{name}</h2>', 1))
    links = (h("a", Html(name), href=f"#part{k}") for k, name in enumerate(names))
    return h("nav", *links, class_="contents", aria_label="On this page"), body


def neighbours(folder: Path) -> Html | None:
    """Links to the other runs of a matrix."""
    if not (file := folder / "matrix.json").is_file():
        return None
    links = []
    for one in json.loads(file.read_text(encoding="utf-8")):
        text = ", ".join(f"{k} = {v}" for k, v in one["values"].items()) or one["folder"]
        here = {"aria_current": "page"} if one["folder"] == folder.name else {}
        links.append(h("a", text, href=f"../{quote(one['folder'])}/report.html", **here))
    return h("nav", h("span", "Runs of this matrix:"), *links, aria_label="Runs of this matrix")
